"""Every reason the gate can give, one by one, and what a verdict clings to."""

import math
from dataclasses import replace

import numpy as np
import pytest

from magmav.core.field import ExpectedField
from magmav.core.gate import NOTHING, Evidence, Limits, axis_states, floored, judge
from magmav.core.types import AxisState, Estimate, Reason, State, vec3

SEEN, MODEL, BLIND = AxisState.OBSERVED, AxisState.FROM_MODEL, AxisState.NOT_OBSERVED
LIMITS = Limits(10.0, math.radians(3.0), 30.0, 0.15, 15.0, 100)
FIELD = ExpectedField(200.0, 430.0, 0.05)
GOOD = Estimate(
    hard_iron_b_mg=vec3((300, -100, 50), "b"),
    covariance_mg2=np.diag([4.0, 4.0, 9.0]),
    own_sigma_mg=vec3((2, 2, 4), "own"),
    horizontal_mg=200.0,
    down_mg=430.0,
    residual_mg=8.0,
    step_nis=1.0,
    samples=500,
    changed_ago_s=1e9,
)
FINE = Evidence(
    estimate=GOOD,
    expected=FIELD,
    sigma_mg=vec3((2.5, 2.5, 5.8), "sigma"),
    offsets_heading_sigma_rad=math.radians(1.0),
    field_mg=FIELD.total_mg,
    level_mg=FIELD.horizontal_mg,
    steady=True,
    sectors=8,
    frozen_s=0.0,
    has_attitude=True,
    relative=False,
    assumed=False,
    parameters_changed=False,
    grounded=False,
)


def verdict(was=State.LEARNING, estimate=None, **changes):
    evidence = replace(FINE, **changes)
    return judge(replace(evidence, estimate=replace(GOOD, **estimate)) if estimate else evidence, LIMITS, was)


def test_a_good_estimate_is_ready_without_any_reason():
    got = verdict()
    assert (got.state, got.axes, got.reasons) == (State.READY, (SEEN, SEEN, SEEN), ())


def sigma(x, y, z):
    return {"sigma_mg": vec3((x, y, z), "s"), "estimate": {"own_sigma_mg": vec3((x, y, z), "s")}}


CASES = {
    Reason.TOO_LITTLE_DATA: (State.LEARNING, {"estimate": {"samples": 99}}),
    Reason.X_NOT_OBSERVED: (State.LEARNING, sigma(11, 2, 2)),
    Reason.Y_NOT_OBSERVED: (State.LEARNING, sigma(2, 11, 2)),
    Reason.Z_NOT_OBSERVED: (State.READY, sigma(2, 2, 200)),
    Reason.Z_FROM_MODEL: (State.READY, {"estimate": {"own_sigma_mg": vec3((2, 2, 200), "s")}}),
    Reason.STILL_MOVING: (State.LEARNING, {"steady": False}),
    Reason.JUST_CHANGED: (State.LEARNING, {"estimate": {"changed_ago_s": 14.9}}),
    Reason.HEADING_UNSURE: (State.LEARNING, {"offsets_heading_sigma_rad": math.radians(3.1)}),
    Reason.RELATIVE_ONLY: (State.LEARNING, {"relative": True}),
    Reason.FIELD_NOT_EARTHLIKE: (State.REFUSED, {"field_mg": FIELD.total_mg * 1.16}),
    Reason.RESIDUAL_TOO_LARGE: (State.REFUSED, {"estimate": {"residual_mg": 30.1}}),
    Reason.FROZEN: (State.REFUSED, {"frozen_s": 3.1}),
    Reason.NO_POSITION: (State.READY, {"expected": None}),
    Reason.HORIZONTAL_WEAK: (State.READY, {"expected": ExpectedField(99.0, 464.0, 0.0)}),
    Reason.NO_ATTITUDE: (State.READY, {"has_attitude": False}),
    Reason.ASSUMED_DEFAULT: (State.READY, {"assumed": True}),
    Reason.PARAMETERS_CHANGED: (State.READY, {"parameters_changed": True}),
}


@pytest.mark.parametrize("reason", CASES, ids=lambda r: r.name)
def test_each_reason_alone(reason):
    state, changes = CASES[reason]
    got = verdict(**changes)
    assert got.reasons == (reason,)
    assert got.state is state


@pytest.mark.parametrize(
    "changes",
    [
        {"estimate": {"samples": 100}},
        sigma(10, 10, 10),
        {"estimate": {"changed_ago_s": 15.0}},
        {"offsets_heading_sigma_rad": math.radians(3.0)},
        {"sectors": 3},
        {"field_mg": FIELD.total_mg * 1.149},
        {"field_mg": FIELD.total_mg * 0.851},
        {"estimate": {"residual_mg": 30.0}},
        {"frozen_s": 3.0},
        {"expected": None, "field_mg": 150.0},
        {"expected": None, "field_mg": 950.0},
    ],
)
def test_on_the_line_is_still_good(changes):
    assert verdict(**changes).state is State.READY


def test_too_few_headings_make_the_heading_unsure():
    assert verdict(sectors=2).reasons == (Reason.HEADING_UNSURE,)


@pytest.mark.parametrize("field_mg", [149.0, 951.0])
def test_without_a_position_the_field_must_be_earthlike_at_all(field_mg):
    got = verdict(expected=None, field_mg=field_mg)
    assert got.state is State.REFUSED
    assert Reason.FIELD_NOT_EARTHLIKE in got.reasons


def test_a_young_estimate_is_not_accused_of_a_bad_field():
    got = verdict(field_mg=2000.0, estimate={"samples": 99, "residual_mg": 99.0})
    assert got.state is State.LEARNING
    assert got.reasons == (Reason.TOO_LITTLE_DATA,)


def test_nothing_learnt_yet():
    nothing = judge(replace(FINE, estimate=None, grounded=True), LIMITS, State.NO_DATA)
    assert (nothing.state, nothing.reasons) == (State.LEARNING, (Reason.NOT_FLYING,))
    assert nothing.axes == NOTHING.axes == (BLIND, BLIND, BLIND)
    flying = judge(replace(FINE, estimate=None, relative=True, has_attitude=False), LIMITS, State.NO_DATA)
    assert flying.reasons == (Reason.TOO_LITTLE_DATA, Reason.RELATIVE_ONLY, Reason.NO_ATTITUDE)
    assert NOTHING.state is State.NO_DATA


def test_what_was_learnt_in_somebodys_hands_alone_is_not_ready():
    got = verdict(grounded=True)
    assert (got.state, got.axes, got.reasons) == (State.LEARNING, (SEEN, SEEN, SEEN), (Reason.NOT_FLYING,))
    assert verdict(grounded=True, was=State.READY).state is State.LEARNING


# ------------------------------------------------------------ hysteresis


@pytest.mark.parametrize(
    ("share", "changes"),
    [
        (1.2, lambda f: {"offsets_heading_sigma_rad": math.radians(3.0) * f}),
        (1.2, lambda f: {"estimate": {"residual_mg": 30.0 * f}}),
        (1.2, lambda f: {"field_mg": FIELD.total_mg * (1 + 0.15 * f)}),
    ],
)
def test_ready_is_left_a_little_later_than_it_is_entered(share, changes):
    assert verdict(State.LEARNING, **changes(share)).state is not State.READY
    assert verdict(State.READY, **changes(share)).state is State.READY
    assert verdict(State.READY, **changes(1.3)).state is not State.READY
    assert verdict(State.LEARNING, **changes(0.99)).state is State.READY


def test_a_sudden_change_ends_ready_at_once():
    assert verdict(State.READY, estimate={"changed_ago_s": 0.2}).state is State.LEARNING
    assert verdict(State.READY, frozen_s=4.0).state is State.REFUSED


def test_refused_names_what_is_wrong_first_and_all_the_rest_after():
    got = verdict(estimate={"residual_mg": 99.0, "changed_ago_s": 1.0}, assumed=True)
    assert got.state is State.REFUSED
    assert got.reasons == (Reason.RESIDUAL_TOO_LARGE, Reason.JUST_CHANGED, Reason.ASSUMED_DEFAULT)


# ------------------------------------------------------------ axes


@pytest.mark.parametrize(
    ("own", "all_in", "want"),
    [(3, 3, SEEN), (10, 11, SEEN), (10.01, 10, MODEL), (200, 5, MODEL), (200, 10.01, BLIND), (11, 200, BLIND)],
)
def test_axis_state_from_both_sigmas(own, all_in, want):
    assert axis_states(vec3((own, 1, 1), "o"), vec3((all_in, 1, 1), "s"), 10.0) == (want, SEEN, SEEN)
    assert axis_states(vec3((1, 1, own), "o"), vec3((1, 1, all_in), "s"), 10.0) == (SEEN, SEEN, want)


def test_an_axis_from_the_model_is_enough_for_ready():
    got = verdict(estimate={"own_sigma_mg": vec3((2, 2, 300), "s")})
    assert (got.state, got.axes) == (State.READY, (SEEN, SEEN, MODEL))


def test_claimed_sigma_adds_the_floor_in_quadrature_and_survives_a_negative_variance():
    estimate = replace(GOOD, covariance_mg2=np.diag([4.0, 0.0, -1e-9]), floor_mg=(1.5, 1.5, 5.0))
    assert floored(estimate) == pytest.approx([2.5, 1.5, 5.0])


def test_every_reason_has_its_own_number_and_a_plain_sentence():
    numbers = [r.number for r in Reason]
    assert len(set(numbers)) == len(numbers)
    assert all(0 < n < 100 for n in numbers)
    assert all(r.text[0].islower() or r.text.startswith("ATTITUDE") for r in Reason)


def test_where_the_down_axis_is_unknown_only_the_horizontal_field_is_judged():
    """The length of a field whose third axis is not corrected says nothing."""
    blind = sigma(2, 2, 400)
    far_off = {**blind, "field_mg": FIELD.total_mg * 1.9}
    assert verdict(**far_off).state is State.READY
    strong = {**blind, "level_mg": FIELD.horizontal_mg + 0.16 * FIELD.total_mg}
    assert Reason.FIELD_NOT_EARTHLIKE in verdict(**strong).reasons
    assert verdict(level_mg=FIELD.horizontal_mg + 0.3 * FIELD.total_mg).state is State.READY  # z known: length counts
    nowhere = {**blind, "expected": None, "level_mg": 30.0}
    assert Reason.FIELD_NOT_EARTHLIKE in verdict(**nowhere).reasons
