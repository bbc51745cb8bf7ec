"""Somebody writes other offsets in mid-flight: the state goes on exactly, nothing is learnt again (users.md AT-5c)."""

import math
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from memory_flight import HZ, STORED, Bench, Teller, flight

from magmav.core.handover import Handover
from magmav.core.rotation import body_from_earth
from magmav.core.types import NO_SHAPING, Estimate, Reason, Sample, Shaping, State, mat3, vec3
from magmav.settings import Settings, with_value

SECONDS, AT = 40.0, 32 * HZ  # when READY has been reached
AT_NS = 10**10 + AT * 10**9 // HZ
MOVED_MG = (200.0, -120.0, 80.0)
SHAPED = STORED | {"COMPASS_DIA_X": 1.25, "COMPASS_DIA_Y": 0.75, "COMPASS_DIA_Z": 1.5}
FACTOR = np.array([1.25, 0.75, 1.5])  # so that moved offsets move the sent field by whole milligauss
ALONG = [f"COMPASS_OFS_{axis}" for axis in "XYZ"]


@cache
def played(estimator="kalman", shaped=False, moved_mg=None, lag=0, announced=False, paused=False):
    """Records of one flight; at AT the offsets move, and ``lag`` samples later the stream does.

    paused : instead, nothing is taught for as long as after a change. announced : the change is our own.
    """
    n = int(SECONDS * HZ)
    shift = np.zeros((n, 3))
    if moved_mg is not None:
        shift[AT + lag :] = np.array(moved_mg) * (FACTOR if shaped else 1.0)
    bench, at_ms = Bench(with_value(Settings(), "learn", "estimator", estimator)), AT_NS // 10**6
    frames = flight(seconds=SECONDS, told=SHAPED if shaped else STORED, offsets_mg=shift)
    bench.play(f for f in frames if f[0] < at_ms)
    vehicle, tell = bench.pipeline.vehicles[1], Teller(1)
    if paused:
        vehicle.settle(1)
    if moved_mg is not None:
        if announced:
            vehicle.calibrations.expect(ALONG, moved_mg)
        bench.play([tell.param(name, v) for name, v in zip(ALONG, moved_mg, strict=True)])
    bench.play(f for f in frames if f[0] >= at_ms)
    return bench.records


def since(records, after_s=0.0, before_s=math.inf):
    """Records from so long after the change, and to so long after it."""
    return [r for r in records if after_s <= (r.boot_ns - AT_NS) / 1e9 < before_s]


def iron(records):
    return np.array([r.estimate.hard_iron_b_mg for r in records])


@pytest.mark.long
@pytest.mark.parametrize("estimator", ["kalman", "adaptive"])
def test_the_same_flight_with_and_without_new_offsets_is_the_same_to_the_last_bit(estimator):
    """But for a second that teaches nothing: so the twin is paused for it as well."""
    plain, moved = played(estimator, paused=True), played(estimator, moved_mg=MOVED_MG)
    assert len(plain) == len(moved) > 0.99 * SECONDS * HZ
    for a, b in zip(plain, moved, strict=True):
        assert a.mag_b_mg.tobytes() == b.mag_b_mg.tobytes()
        assert a.estimate.hard_iron_b_mg.tobytes() == b.estimate.hard_iron_b_mg.tobytes()
        assert a.sigma_mg.tobytes() == b.sigma_mg.tobytes()
        assert a.heading == b.heading
        assert a.learnt is b.learnt
        assert a.verdict.state is b.verdict.state
    assert {r.verdict.state for r in since(moved)} == {State.READY}
    assert moved[-1].stored_b_mg - plain[-1].stored_b_mg == pytest.approx(MOVED_MG)


def test_through_a_stored_matrix_the_same_to_rounding():
    plain, moved = played(shaped=True, paused=True), played(shaped=True, moved_mg=MOVED_MG)
    assert iron(moved) == pytest.approx(iron(plain), abs=1e-6)
    assert [r.verdict.state for r in moved] == [r.verdict.state for r in plain]


@pytest.mark.long
def test_a_second_not_taught_is_all_that_it_costs():
    """Against the flight that nobody touched: 24 samples fewer, an answer within half a sigma, READY throughout."""
    plain, moved = played(), played(moved_mg=MOVED_MG)
    assert sum(r.learnt for r in plain) - sum(r.learnt for r in moved) == HZ - 1
    assert not any(r.learnt for r in since(moved, 0.0, 0.95))
    off = np.abs(iron(moved) - iron(plain))
    claimed = np.array([r.sigma_mg for r in plain])
    assert np.all(off < np.where(np.array([r.boot_ns < AT_NS for r in plain])[:, None], 1e-12, 0.5 * claimed))
    assert moved[-1].estimate.samples == plain[-1].estimate.samples - (HZ - 1)
    assert {r.verdict.state for r in since(moved)} == {State.READY}


@pytest.mark.parametrize("announced", [False, True])
def test_a_foreign_change_stays_said_and_our_own_is_none(announced):
    moved = played(moved_mg=MOVED_MG, announced=announced)
    assert [Reason.PARAMETERS_CHANGED in r.verdict.reasons for r in (moved[AT - 1], moved[-1])] == [
        False,
        not announced,
    ]
    assert moved[-1].estimate.samples > SECONDS * HZ - 3 * HZ


@pytest.mark.parametrize("lag", [1, 10, 50])
def test_the_values_tell_when_the_stream_has_changed_over(lag):
    """Every value is undone with the offsets it was made with, and a second must pass from the last old one."""
    plain, moved = played(), played(moved_mg=MOVED_MG, lag=lag)
    assert [r.mag_b_mg.tobytes() for r in plain] == [r.mag_b_mg.tobytes() for r in moved]
    assert not any(r.learnt for r in since(moved, 0.0, lag / HZ + 0.91))
    assert all(r.learnt for r in since(moved, lag / HZ + 1.0))
    # Published headings go on all the while.
    off = [
        math.remainder(a.heading.magnetic_rad - b.heading.magnetic_rad, math.tau)
        for a, b in zip(plain, moved, strict=True)
    ]
    assert max(map(abs, off)) < math.radians(1.0)


@pytest.mark.parametrize(
    ("name", "value"),
    [("COMPASS_DIA_X", 1.1), ("COMPASS_ODI_Y", 0.05), ("COMPASS_SCALE", 1.2), ("COMPASS_DEV_ID", 5.0)],
)
def test_what_offsets_cannot_undo_begins_anew(name, value):
    bench = Bench()
    frames = flight(seconds=12.0)
    bench.play(frames[: len(frames) // 2])
    assert bench.records[-1].estimate.samples > 50
    bench.play([Teller(1).param(name, value)])
    after = bench.play(frames[len(frames) // 2 :])
    assert after[0].estimate.samples == 0
    assert Reason.PARAMETERS_CHANGED in after[-1].verdict.reasons


# ---------------------------------------------------------------- the handover by itself

SETTLE_NS = 10**9
FIELD_N = np.array([200.0, 0.0, 430.0])
IRON = np.array([300.0, -150.0, 80.0])


def believed(sigma_mg=3.0, iron_mg=IRON):
    zero = vec3((0, 0, 0), "z")
    covariance = np.eye(3) * sigma_mg**2
    return Estimate(vec3(iron_mg, "b"), covariance, zero, 200.0, 430.0, 5.0, 1.0, 500, 1e9)


def value(t_s, undone_by=(0.0, 0.0, 0.0), rate=0.5, shaping=NO_SHAPING, noise=(0.0, 0.0, 0.0), gap=False):
    """A banked turn at ``rate``; undone with offsets that are this much more than those it was made with."""
    body = body_from_earth(0.3 * math.sin(t_s), 0.2, rate * t_s)
    field = np.linalg.solve(shaping.matrix, body @ FIELD_N - shaping.motor_b_mg)
    return Sample(
        1, 1, round(t_s * 1e9), 0.1, vec3(field + IRON - np.array(undone_by) + noise, "m"), shaping,
        vec3((0, 0, rate), "r"), 0.0, 0.2, 0.0, 0.0, 0.0, gap, "ATTITUDE", True, body_from_own=body,
    )  # fmt: skip


OFFSETS = st.tuples(*[st.floats(-400, 400)] * 3).filter(lambda o: math.hypot(*o) > 60.0)
SHAPINGS = st.sampled_from(
    [NO_SHAPING, Shaping(mat3([[1.1, 0.05, 0], [0.05, 0.9, 0.02], [0, 0.02, 1.0]], "m"), vec3((10, -20, 5), "e"))]
)


@settings(max_examples=25, deadline=None)
@given(OFFSETS, st.integers(0, 30), SHAPINGS, st.integers(0, 100))
def test_any_new_offsets_at_any_lag_are_found(moved, lag, shaping, seed):
    r, h, e = np.random.default_rng(seed), Handover(), believed()
    for i in range(10):
        s = value(i / 10, shaping=shaping, noise=r.normal(0, 4, 3))
        assert h.step(s, e, SETTLE_NS) is s
    h.changed(vec3((7, 8, 9), "old"), vec3(np.array((7, 8, 9)) + moved, "new"), 950_000_000)
    for i in range(10, 60):
        late = i - 10 < lag
        noise = r.normal(0, 4, 3)
        s = value(i / 10, moved if late else (0, 0, 0), shaping=shaping, noise=noise)
        got = h.step(s, e, SETTLE_NS)
        assert got.mag_b_mg == pytest.approx(value(i / 10, shaping=shaping, noise=noise).mag_b_mg, abs=1e-9)
        settled = 100 * i - (950 if lag == 0 else 900 + 100 * lag) >= 1000
        assert got.learn is settled


def test_offsets_written_one_axis_after_the_other():
    h, e = Handover(), believed()
    steps = np.array([[0, 0, 0], [150, 0, 0], [150, -90, 0], [150, -90, 70]], dtype=float)
    for i in range(10):
        h.step(value(i / 10), e, SETTLE_NS)
    for old, new in pairwise(steps):
        h.changed(vec3(old, "old"), vec3(new, "new"), 950_000_000)
    for i in range(10, 40):
        made_with = steps[min((i - 10) // 3, 3)]
        got = h.step(value(i / 10, steps[-1] - made_with), e, SETTLE_NS)
        assert got.mag_b_mg == pytest.approx(value(i / 10).mag_b_mg)
        assert got.learn is (i >= 28)


@pytest.mark.parametrize(
    "why", ["a small move", "an unknown iron after a turn", "nothing before it", "a gap", "too long ago", "two axes"]
)
def test_where_it_cannot_be_told_the_echo_is_believed(why):
    h, e = Handover(), believed(1000.0, np.zeros(3)) if why == "an unknown iron after a turn" else believed()
    if why != "nothing before it":
        for i in range(10):
            h.step(value(i / 10), e, SETTLE_NS)
    moved = (20.0, 0.0, 0.0) if why == "a small move" else (200.0, -50.0, 0.0)
    h.changed(vec3((0, 0, 0), "old"), vec3(moved, "new"), 950_000_000)
    at = {"an unknown iron after a turn": 1.9, "too long ago": 6.0}.get(why, 1.0)
    s = value(at, moved, gap=why == "a gap")
    if why == "two axes":
        s = replace(s, axes=2)
    got = h.step(s, e, SETTLE_NS)
    assert got.mag_b_mg.tobytes() == s.mag_b_mg.tobytes()


def test_an_unknown_iron_is_no_hindrance_while_the_vehicle_hardly_turns():
    h, e = Handover(), believed(1000.0, np.zeros(3))
    for i in range(10):
        h.step(value(i / 1000, rate=0.05), e, SETTLE_NS)
    h.changed(vec3((0, 0, 0), "old"), vec3((200, 0, 0), "new"), 9_500_000)
    got = h.step(value(0.011, (200, 0, 0), rate=0.05), e, SETTLE_NS)
    assert got.mag_b_mg == pytest.approx(value(0.011, rate=0.05).mag_b_mg)


def test_a_stream_that_never_changes_over_is_believed_after_five_seconds():
    h, e = Handover(), believed()
    for i in range(10):
        h.step(value(i / 10), e, SETTLE_NS)
    h.changed(vec3((0, 0, 0), "old"), vec3((200, 0, 0), "new"), 950_000_000)
    taught = [i / 10 for i in range(10, 100) if h.step(value(i / 10, (200, 0, 0)), e, SETTLE_NS).learn]
    assert min(taught) == pytest.approx(6.0)
