"""One compass from Sample to verdict: readiness, sudden changes, holding, headings of now."""

import math
from dataclasses import replace

import numpy as np
import pytest
from honest_flight import EXPECTED, MOTIONS, RATE_HZ, samples
from synthetic_flight import HARD_IRON_MG
from test_kalman import yaw_only

from magmav.core.channel import Channel, Circumstances
from magmav.core.correction import iron_of_offsets
from magmav.core.estimators import ESTIMATORS
from magmav.core.gate import Limits
from magmav.core.types import IDENTITY3, AxisState, Reason, Shaping, State, mat3, vec3

LIMITS = Limits(10.0, math.radians(3.0), 30.0, 0.15, 15.0, 100)
HERE = Circumstances(EXPECTED, relative=False, assumed=False, parameters_changed=False, grounded=False, frozen_s=0.0)
NOWHERE = replace(HERE, expected=None)


def channel(name="kalman"):
    return Channel(ESTIMATORS[name], LIMITS, 10.0)


def run(flight, c=None, where=HERE):
    c = c or channel()
    return [c.step(s, s.mag_b_mg, where) for s in flight]


@pytest.mark.parametrize("motion", MOTIONS)
def test_a_fair_flight_is_ready_within_a_minute_and_right(motion):
    flight = samples(motion, 31)
    found = run(flight)
    last = found[-1]
    assert last.verdict.state is State.READY
    assert last.verdict.axes == (AxisState.OBSERVED,) * 3
    assert np.all(np.abs(last.offsets_mg + HARD_IRON_MG) < 3.5 * last.sigma_mg)
    assert last.offsets_mg == pytest.approx(-last.estimate.hard_iron_b_mg)
    states = [f.verdict.state for f in found]
    first = states.index(State.READY)
    assert first > 9 * RATE_HZ  # not before it has stood still for (nearly) ten seconds
    assert all(s is State.READY for s in states[first:])


def test_the_heading_is_right_and_its_sigma_covers_it():
    """True yaw is rebuilt from the steps: they are integrated gyro, with 0.05 degrees of walk per root second."""
    flight = samples("figure eight", 33, tilt_deg=0.3)
    found = run(flight)
    yaw = np.cumsum([s.yaw_step_rad for s in flight])
    off = np.array([math.remainder(f.heading.true_rad - y, math.tau) for f, y in zip(found, yaw, strict=True)][300:])
    start = np.angle(np.mean(np.exp(1j * off)))
    wrong = np.degrees(np.angle(np.exp(1j * (off - start))))
    claimed = np.degrees([f.heading.sigma_rad for f in found[300:]])
    assert np.sqrt(np.mean(wrong**2)) < 2.5
    assert np.mean(np.abs(wrong) < 2.5 * claimed) > 0.95


def test_without_position_the_heading_is_magnetic_only_and_says_so():
    found = run(samples("figure eight", 34, seconds=40.0), where=NOWHERE)[-1]
    assert (found.heading.valid, found.heading.true_valid) == (True, False)
    assert Reason.NO_POSITION in found.verdict.reasons


def test_nothing_is_published_before_anything_is_known():
    found = run(samples("figure eight", 35, seconds=3.0))
    assert not found[0].heading.valid
    assert found[0].verdict.state is State.LEARNING
    assert found[0].verdict.reasons[0] is Reason.TOO_LITTLE_DATA
    assert min(found[0].sigma_mg) > 100.0


def test_on_the_ground_it_waits_for_take_off():
    ground = [replace(s, learn=False) for s in samples("figure eight", 35, seconds=5.0)]
    last = run(ground, where=replace(HERE, grounded=True))[-1]
    assert last.verdict.reasons[0] is Reason.NOT_FLYING
    assert not last.heading.valid


@pytest.mark.parametrize("motion", MOTIONS)
def test_a_magnet_in_mid_flight(motion):
    """580 mG at 60 s: JUST_CHANGED at once, the new iron within 15 s, READY only after the wait."""
    at, step = 600, np.array([-60.0, 10.0, -577.0])
    iron = np.tile(HARD_IRON_MG, (1200, 1)) + np.where(np.arange(1200)[:, None] >= at, step, 0.0)
    found = run(samples(motion, 36, seconds=120.0, iron_mg=iron))
    assert found[at - 1].verdict.state is State.READY
    reported = next(i for i in range(at, 1200) if Reason.JUST_CHANGED in found[i].verdict.reasons)
    assert reported - at < 5 * RATE_HZ
    after = found[at + int(15 * RATE_HZ)]
    assert np.all(np.abs(after.offsets_mg + iron[-1]) < (20.0, 20.0, 25.0))
    assert after.verdict.state is not State.READY
    again = next(i for i in range(reported, 1200) if found[i].verdict.state is State.READY)
    assert 15 * RATE_HZ - 2 <= again - reported < 40 * RATE_HZ
    assert np.all(np.abs(found[-1].offsets_mg + iron[-1]) < 4.0 * found[-1].sigma_mg)


def test_iron_that_keeps_creeping_is_never_ready():
    """5 mG a second: the estimate follows, and is not written while it moves."""
    creeping = HARD_IRON_MG + np.arange(900)[:, None] / RATE_HZ * np.array([5.0, -3.0, 0.0])
    found = run(samples("figure eight", 45, seconds=90.0, iron_mg=creeping))
    late = [f.verdict for f in found[450:]]
    assert all(v.state is not State.READY for v in late)
    assert np.mean([Reason.STILL_MOVING in v.reasons for v in late]) > 0.5


def test_level_turns_rest_on_the_field_model_for_the_down_axis():
    """And say so; without a position the axis stays unknown. Either way the level axes are written."""
    for where, axis, reason in (
        (HERE, AxisState.FROM_MODEL, Reason.Z_FROM_MODEL),
        (NOWHERE, AxisState.NOT_OBSERVED, Reason.Z_NOT_OBSERVED),
    ):
        last = run(yaw_only(60.0), where=where)[-1]
        assert last.verdict.axes == (AxisState.OBSERVED, AxisState.OBSERVED, axis)
        assert reason in last.verdict.reasons
        assert last.verdict.state is State.READY
        assert bool(last.sigma_mg[2] < 10.0) is (where is HERE)


def test_held_means_the_answer_stays_while_samples_are_still_judged():
    flight = samples("figure eight", 37, seconds=60.0)
    c = channel()
    ready = run(flight[:400], c)[-1]
    c.held = True
    held = run([replace(s, learn=False) for s in flight[400:]], c)
    assert {f.offsets_mg.tobytes() for f in held} == {ready.offsets_mg.tobytes()}
    assert {f.verdict.state for f in held} == {State.READY}
    assert all(f.heading.valid for f in held)
    assert len({f.heading.magnetic_rad for f in held}) > 100
    c.held = False
    resumed = run(flight[500:600], c)[-1]
    assert np.all(np.abs(resumed.offsets_mg + HARD_IRON_MG) < 10.0)


def test_a_restart_forgets_everything():
    c = channel()
    run(samples("figure eight", 38), c)
    c.restart()
    first = run(samples("figure eight", 39, seconds=1.0), c)[0]
    assert first.estimate.samples == 0
    assert not first.heading.valid
    assert first.coverage <= 1 / 24


def test_time_on_the_ground_after_the_flight_keeps_ready():
    flight = samples("figure eight", 40, seconds=60.0)
    c = channel()
    assert run(flight, c)[-1].verdict.state is State.READY
    later = [replace(s, boot_ns=s.boot_ns + 60 * 10**9, learn=False) for s in flight[1:300]]
    assert run(later, c)[-1].verdict.state is State.READY


def test_a_field_that_is_not_the_earths_is_refused():
    strong = samples("figure eight", 41, earth_mg=np.array([300.0, 20.0, 620.0]))
    last = run(strong)[-1]
    assert last.verdict.state is State.REFUSED
    assert Reason.FIELD_NOT_EARTHLIKE in last.verdict.reasons


def test_scatter_is_refused():
    last = run(samples("figure eight", 42, noise_mg=60.0))[-1]
    assert last.verdict.state is State.REFUSED
    assert Reason.RESIDUAL_TOO_LARGE in last.verdict.reasons


def test_the_heading_is_turned_on_to_the_time_of_the_message():
    flight = samples("hover turns", 43)
    c, twin = channel(), channel()
    run(flight[:-1], c)
    run(flight[:-1], twin)
    now = c.step(flight[-1], flight[-1].mag_b_mg, HERE).heading
    late = twin.step(replace(flight[-1], lead_rad=0.2), flight[-1].mag_b_mg, HERE).heading
    assert math.remainder(late.magnetic_rad - now.magnetic_rad, math.tau) == pytest.approx(0.2)
    assert math.remainder(late.true_rad - now.true_rad, math.tau) == pytest.approx(0.2)


@pytest.mark.parametrize("name", ["bullock", "bullock_level"])
def test_the_other_estimators_go_the_same_way(name):
    """Banked turns are beyond a circle that levels first, so it gets a hover."""
    motion = "hover turns" if name == "bullock_level" else "figure eight"
    last = run(samples(motion, 44, seconds=40.0), channel(name))[-1]
    assert np.all(np.abs(last.offsets_mg + HARD_IRON_MG)[:2] < 60.0)
    assert last.verdict.state in (State.LEARNING, State.READY, State.REFUSED)
    assert last.verdict.axes[2] is (AxisState.NOT_OBSERVED if name == "bullock_level" else AxisState.OBSERVED)


def test_offsets_alone_take_the_share_of_soft_iron_that_stands_still_when_level():
    """Level, at every heading: what is left after the best constant averages to nothing, in all three axes."""
    bend = np.array([[1.05, 0.02, -0.04], [0.02, 0.96, 0.03], [-0.04, 0.03, 1.01]])  # what the sensor makes of a field
    stored = np.diag((1.1, 0.9, 1.0))
    s = replace(samples("figure eight", 1, seconds=1.0)[0], shaping=Shaping(mat3(stored, "m"), vec3((0, 0, 0), "e")))
    e = run(samples("figure eight", 1, seconds=20.0))[-1].estimate
    e = replace(e, soft_iron_b=mat3(np.linalg.inv(bend), "s"))
    iron = iron_of_offsets(s, e, EXPECTED)
    turn = np.linspace(0.0, 2.0 * np.pi, 360, endpoint=False)
    h, v = EXPECTED.horizontal_mg, EXPECTED.down_mg
    truth = np.stack((h * np.cos(turn), -h * np.sin(turn), np.full(360, v)), 1)
    sensor = np.linalg.solve(stored, (truth @ bend.T).T).T + e.hard_iron_b_mg
    left = (sensor - iron) @ stored.T - truth
    assert left.mean(axis=0) == pytest.approx(0.0, abs=1e-9)
    assert iron_of_offsets(s, replace(e, soft_iron_b=IDENTITY3), EXPECTED) is e.hard_iron_b_mg
