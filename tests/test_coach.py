"""The coach: advice that teaches most, that fits a text, that the vehicle can follow, and that ends."""

import math
import re
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from flight_rig import Flight, staying
from honest_flight import Motion, body_rates, field_in_body
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_flight import HARD_IRON_MG, turn

from magmav.core import coach, gate
from magmav.core.coach import LONGEST, advise, attitudes, motions, next_step
from magmav.core.estimators.kalman import KalmanEstimator
from magmav.core.types import (
    NO_SHAPING,
    AxisState,
    Estimate,
    Reason,
    Sample,
    State,
    Verdict,
    vec3,
)
from magmav.settings import Settings, with_value

ROVER, COPTER, PLANE, VTOL, BOAT = 10, 2, 1, 20, 11
KINDS = (None, ROVER, COPTER, PLANE, VTOL, BOAT)


def estimate(sigma_mg, turned=None):
    """An estimate whose doubt has these sigmas along the body axes, or along axes turned from them."""
    covariance = np.diag(np.square(np.asarray(sigma_mg, dtype=float)))
    if turned is not None:
        covariance = turned @ covariance @ turned.T
    return Estimate(vec3((0, 0, 0), "b"), covariance, vec3((1, 1, 1), "s"), 200.0, 400.0, 5.0, 1.0, 100, 1e9)


sigmas = st.tuples(*[st.floats(1.0, 300.0)] * 3)
angles = st.floats(-0.5, 0.5)


@settings(max_examples=40, deadline=None)
@given(sigmas, angles, angles, st.sampled_from(KINDS))
def test_every_advice_fits_a_text_and_can_be_followed(sigma, roll, pitch, kind):
    """MMAG c1: and the advice fit one STATUSTEXT, and a vehicle is asked only for what its kind can do (AT-1c)."""
    text = advise(estimate(sigma), roll, pitch, None, kind)
    assert len("MMAG c1: " + text) <= LONGEST
    assert text == "" or text in {m.text for m in motions(kind)}
    if kind in (None, ROVER, BOAT):
        assert not re.search("bank|pitch|climb|eight", text)
    if kind == PLANE:
        assert "yaw" not in text
    if kind == COPTER:
        assert "eight" not in text


@settings(max_examples=30)
@given(st.floats(0.1, 7.9), angles, angles, st.sampled_from(KINDS))
def test_silent_when_every_axis_is_under_the_line(sigma, roll, pitch, kind):
    assert advise(estimate((sigma, sigma, sigma)), roll, pitch, None, kind) == ""


@pytest.mark.parametrize("kind", [ROVER, BOAT, None])
def test_a_level_rover_is_not_asked_for_what_turning_cannot_show(kind):
    """Only the down axis is unknown: turning on the flat says nothing of it, so nothing is asked."""
    assert advise(estimate((3, 3, 400)), 0.0, 0.0, None, kind) == ""
    assert advise(estimate((40, 3, 400)), 0.0, 0.0, None, kind).startswith("yaw")


def test_it_asks_for_the_axis_that_is_missing():
    assert advise(estimate((40, 40, 4)), 0.0, 0.0, None, COPTER).startswith("yaw")
    assert re.match("bank|pitch", advise(estimate((4, 4, 40)), 0.0, 0.0, None, COPTER))
    assert re.search("bank|eight", advise(estimate((4, 4, 40)), 0.0, 0.0, None, PLANE))


def test_already_banked_right_it_asks_for_the_left():
    assert advise(estimate((4, 4, 40)), math.radians(12), 0.0, None, COPTER) == "bank 15 degrees left"
    assert advise(estimate((4, 4, 40)), math.radians(-12), 0.0, None, COPTER) == "bank 15 degrees right"


@pytest.mark.parametrize("reason", [Reason.HEADING_UNSURE, Reason.X_NOT_OBSERVED, Reason.Y_NOT_OBSERVED])
@pytest.mark.parametrize(("kind", "word"), [(COPTER, "yaw"), (ROVER, "yaw"), (None, "yaw"), (PLANE, "turn|eight")])
def test_the_down_axis_waits_until_the_level_ones_and_the_headings_are_there(reason, kind, word):
    """Few headings: the level axes claim 6 mG, nothing is known of the third, and only turning heals the reason."""
    few = estimate((6, 5, 200))
    assert re.search(word, advise(few, 0.0, 0.0, None, kind, reasons=(reason, Reason.Z_NOT_OBSERVED)))
    assert re.search(word, advise(estimate((40, 30, 200)), 0.0, 0.0, None, kind, reasons=(reason,)))
    only_down = advise(few, 0.0, 0.0, None, kind, reasons=(Reason.Z_NOT_OBSERVED, Reason.NO_POSITION))
    assert only_down == advise(few, 0.0, 0.0, None, kind)
    assert not re.search("yaw", only_down)


@settings(max_examples=40, deadline=None)
@given(sigmas, angles, angles, st.sampled_from(KINDS))
def test_where_headings_are_missing_no_other_motion_teaches_the_worse_level_axis_more(sigma, roll, pitch, kind):
    e = estimate(sigma, turn(1, 0.2))
    text = advise(e, roll, pitch, None, kind, reasons=(Reason.HEADING_UNSURE,))
    left = {m.text: coach.sigma_after(m, e.covariance_mg2, roll, pitch)[:2] for m in motions(kind)}
    own = np.sqrt(np.diag(e.covariance_mg2))[:2]
    helped = [i for i in (0, 1) if min(v[i] for v in left.values()) < 0.9 * own[i]]
    if not helped:
        assert text == ""
        return
    worst = max(helped, key=lambda i: gate.floored(e)[i])
    assert left[text][worst] <= 1.01 * min(v[worst] for v in left.values())


def test_in_a_weak_field_turning_goes_on_under_the_line_of_an_axis():
    """9 mG are under the line, and 8.6 degrees of heading where only 60 mG are level: the coach is not silent."""
    e = replace(estimate((9, 9, 4)), horizontal_mg=60.0)
    assert advise(e, 0.0, 0.0, None, COPTER) == ""
    assert advise(e, 0.0, 0.0, None, COPTER, reasons=(Reason.HEADING_UNSURE,)) == "yaw right 180 degrees"


@settings(max_examples=40, deadline=None)
@given(sigmas, st.floats(0.05, 0.5), st.sampled_from(KINDS), st.floats(0.0, 6.28))
def test_left_and_right_are_alike_and_heading_does_not_matter(sigma, roll, kind, heading):
    """Mirror vehicle and doubt: the mirrored advice, or one that is worth the same to within a hundredth."""
    e = estimate(sigma, turn(0, 0.3) @ turn(2, 0.4))
    flip = np.diag([1.0, -1.0, 1.0])  # a pseudovector's covariance and a vector's mirror alike
    mirrored = replace(e, covariance_mg2=flip @ e.covariance_mg2 @ flip)
    here, there = advise(e, roll, 0.0, heading, kind), advise(mirrored, -roll, 0.0, None, kind)
    assert advise(e, roll, 0.0, None, kind) == here
    by_text = {m.text: m for m in motions(kind)}
    assert bool(here) is bool(there)
    if here and not by_text[here].back_and_forth:
        other = here.replace("right", "*").replace("left", "right").replace("*", "left")
        asked, mirror = (coach.sigma_after(by_text[t], mirrored.covariance_mg2, -roll, 0.0) for t in (there, other))
        axis = int(np.argmax(np.diag(mirrored.covariance_mg2)))
        assert asked[axis] <= 1.02 * mirror[axis] or kind in (None, ROVER, BOAT)


def joint_sigma(e, roll, pitch, seen):
    """Six unknowns, hard iron and level field, told apart by batch least squares: none of coach's algebra.

    Before: the doubt about the iron, the field wholly unknown, and a minute of readings at the present attitude.
    """
    information = np.zeros((6, 6))
    information[:3, :3] = np.linalg.inv(e.covariance_mg2)
    now = turn(0, roll) @ turn(1, pitch)
    for c, seconds in [(now, 600.0), *((c, 1.0) for c in seen)]:
        row = np.hstack([np.eye(3), c])
        information += seconds * row.T @ row / 8.0**2
    return np.sqrt(np.diag(np.linalg.inv(information))[:3])


@pytest.mark.parametrize("kind", [COPTER, PLANE, VTOL, ROVER])
@pytest.mark.parametrize("seed", range(8))
def test_the_advice_shrinks_the_worst_sigma_faster_than_any_other(kind, seed):
    """Judged by batch least squares in hard iron and field together, over every motion the vehicle has."""
    r = np.random.default_rng(seed)
    sigma = r.uniform(5.0, 80.0, 3) if kind != ROVER else np.append(r.uniform(12.0, 80.0, 2), 6.0)
    e = estimate(sigma, turn(0, r.uniform(-0.3, 0.3)) if kind != ROVER else None)
    roll, pitch = (0.0, 0.0) if kind == ROVER else r.uniform(-0.2, 0.2, 2)
    text = advise(e, roll, pitch, None, kind)
    before = joint_sigma(e, roll, pitch, [])
    after = {m.text: joint_sigma(e, roll, pitch, attitudes(m, roll, pitch)) for m in motions(kind)}
    wanted = [i for i in range(3) if before[i] > 10.0 and any(a[i] < 0.9 * before[i] for a in after.values())]
    if not text:
        assert not wanted
        return
    axis = max(wanted, key=lambda i: before[i])
    left = {name: a[axis] for name, a in after.items()}
    assert left[text] <= 1.03 * min(left.values())
    assert left[text] < 0.9 * before[axis]


def flown(pieces, seed, rate_hz=10.0):
    """A Kalman filter over attitudes in degrees as (seconds, roll, pitch, yaw) to go to, one after the other."""
    r = np.random.default_rng(seed)
    corner = [(0.0, 0.0, 0.0, 0.0), *pieces]
    times = np.cumsum([c[0] for c in corner])
    t = np.arange(0.0, times[-1], 1.0 / rate_hz)
    m = Motion(*(np.radians(np.interp(t, times, [c[i] for c in corner])) for i in (1, 2, 3)))
    mag = field_in_body(m) + HARD_IRON_MG + r.normal(0.0, 4.0, (len(t), 3))
    rates = body_rates(m, 1.0 / rate_hz)
    k = KalmanEstimator()
    for i in range(len(t)):
        step = float(m.yaw_rad[i] - m.yaw_rad[i - 1]) if i else 0.0
        roll, pitch = (float(a[i]) + r.normal(0.0, 0.003) for a in m[:2])
        k.step(
            Sample(1, 1, int(1e9 * (10.0 + t[i])), 0.1 if i else 0.0, vec3(mag[i], "m"), NO_SHAPING,
                   vec3(rates[i], "w"), roll, pitch, step, 0.0, 0.0, i == 0, "ATTITUDE", True)
        )  # fmt: skip
    return k.estimate(None)


@pytest.mark.parametrize("start", ["hovering on one heading", "turned on the spot"])
def test_a_real_filter_learns_most_by_the_advice(start):
    """By the service's own filter, on a copter: of all advices the one given helps its worst axis most."""
    past = [(20.0, 0.0, 0.0, 15.0)] if start.startswith("hover") else [(20.0, 0.0, 0.0, 500.0)]
    yaw = past[-1][3]
    e = flown(past, 1)
    text = advise(e, 0.0, 0.0, None, COPTER)
    worst = {}
    for m in motions(COPTER):
        roll, pitch = m.to_roll_deg or 0.0, m.to_pitch_deg or 0.0
        then = flown([*past, (6.0, roll, pitch, yaw + m.turn_deg), (6.0, roll, pitch, yaw + m.turn_deg)], 1)
        worst[m.text] = np.sqrt(np.diag(then.covariance_mg2))
    before = np.sqrt(np.diag(e.covariance_mg2))
    axis = int(np.argmax(before))
    got = {name: s[axis] for name, s in worst.items()}
    assert got[text] <= 1.05 * min(got.values())
    assert got[text] < 0.2 * before[axis]


@given(st.sampled_from(State), st.sets(st.sampled_from(Reason)), st.sampled_from(["", "yaw right 120 degrees"]))
def test_AT_3c_every_state_but_ready_has_a_next_step(state, reasons, advice):
    verdict = Verdict(state, (AxisState.NOT_OBSERVED,) * 3, tuple(reasons))
    text = next_step(verdict, advice)
    if state is State.READY:
        assert text == ""
    else:
        assert len(text) > 5 and len("MMAG c1: " + text) <= LONGEST


@pytest.mark.parametrize(
    ("reason", "state", "word"),
    [
        (Reason.NO_COMPASS, State.NO_DATA, "messages"),
        (Reason.NOT_FLYING, State.LEARNING, "take off"),
        (Reason.FROZEN, State.REFUSED, "power"),
        (Reason.FIELD_NOT_EARTHLIKE, State.REFUSED, "magnet or steel"),
        (Reason.MOUNTING_WRONG, State.REFUSED, "orientation"),
        (Reason.X_NOT_OBSERVED, State.LEARNING, "yaw right"),
    ],
)
def test_AT_3c_the_step_fits_the_state(reason, state, word):
    verdict = Verdict(state, (AxisState.NOT_OBSERVED,) * 3, (reason,))
    assert word in next_step(verdict, "yaw right 120 degrees")


def test_AT_1c_a_boat_is_never_asked_to_bank_pitch_or_be_turned_over():
    """Whatever is unknown, however it rocks, and in no hint either."""
    for sigma, roll in product(product((3, 40, 400), repeat=3), (-0.1, 0.0, 0.1)):
        assert not re.search("bank|pitch|roll|nose|invert", advise(estimate(sigma), roll, 0.0, None, BOAT))
    for reason in Reason:
        verdict = Verdict(State.LEARNING, (AxisState.NOT_OBSERVED,) * 3, (reason,))
        assert not re.search("nose|invert|over", next_step(verdict, ""))


def test_the_wire_hears_the_coach_only_where_it_is_asked_for(tmp_path):
    """The first seconds on the ground: one hint that fits one text, or by default none."""
    for say in (False, True):
        folder = tmp_path / str(say)
        folder.mkdir()
        f = Flight(staying(), folder, settings=with_value(Settings(), "coach", "say", say))
        f.fly(seconds=8.0)
        f.end()
        texts = [m.text for m in f.said() if m.get_type() == "STATUSTEXT"]
        hints = [t for t in texts if "take off" in t]
        assert hints == (["MMAG c1: take off: the ground teaches nothing"] if say else [])
        assert not say or len(hints[0]) <= LONGEST
