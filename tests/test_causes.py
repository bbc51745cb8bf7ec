"""The cause finder: each fault is named with a figure that is true to its sigma, and a sound compass is left alone.

Acceptance tests of users.md that other files hold: AT-3b test_excitation (a level turn fills one ring only), AT-3c
test_coach, AT-12a test_channel (without position magnetic only), AT-12b test_geomag, AT-13b test_score and test_table,
AT-17a and AT-17b test_trust, and for the write itself test_upload, test_store and test_end_to_end.
"""

import math
import pickle
import re
from dataclasses import replace
from pathlib import Path

import memory_flight
import numpy as np
import pytest
from honest_flight import EXPECTED, MOTIONS, RATE_HZ, Motion, field_in_body, samples, wander
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_flight import EARTH_MG, HARD_IRON_MG
from test_channel import HERE, NOWHERE, channel, run
from test_kalman import yaw_only

from magmav.appraisal import CompassLog, describe
from magmav.coaching import EVERY_NS, Coaching
from magmav.core import causes, causes_fit
from magmav.core.causes import Causes
from magmav.core.causes_blocks import AMPERE, BLOCK_S, DOWN, FEATURES, FIRST, ONE, SECOND, Blocks, shaped
from magmav.core.causes_fit import fit, turn_by, turn_of
from magmav.core.causes_linear import FIELD_MG, IRON_MG, POWER_MG, Problem, linear, right_angles
from magmav.core.field import ExpectedField
from magmav.core.orientation import MAVLINK, rotation
from magmav.core.types import AxisState, Estimate, Reason, Sample, State, vec3
from magmav.view.table import replay_view, to_text

NOTHING = Estimate(vec3((0, 0, 0), "b"), np.eye(3) * 1e6, vec3((9, 9, 9), "s"), 0.0, 0.0, 0.0, 1.0, 0, 1e9)
GRID = np.eye(3)


def about(**degrees):
    """Rotation of a vector by so many degrees about forward (x), right (y) or down (z)."""
    return turn_by(np.radians([degrees.get(a, 0.0) for a in "xyz"]))


def bent(flight, matrix=GRID, bias_rads=0.0, compass=1, iron_mg=HARD_IRON_MG):
    """The same flight, seen by a sensor that makes ``matrix`` times the field of it, and by a gyro with a bias."""
    return [
        replace(
            s,
            compass=compass,
            mag_b_mg=vec3(matrix @ (s.mag_b_mg - iron_mg) + iron_mg, "m"),
            yaw_step_rad=s.yaw_step_rad + bias_rads * s.dt_s,
        )
        for s in flight
    ]


def watch(flight, expected=EXPECTED, power=None, grounded=0, found=None):
    """Causes over a flight; power: (ampere per sample); grounded: so many samples first stand on the ground."""
    found = found or Causes()
    if power is not None:
        found.current(float(power[0]))
    for i, s in enumerate(flight):
        if power is not None:
            found.current(float(power[i]))
        s = replace(s, learn=False) if i < grounded else s
        found.step(s, NOTHING, expected, vec3(s.mag_b_mg - HARD_IRON_MG, "u"), i < grounded)
    return found


def codes(found, compass=1):
    return {c.code for c in found.of(compass)}


def only(found, code):
    got = {c.code: c for c in found.of(1)}
    assert set(got) == {code}
    return got[code]


def fitted(flight, expected=EXPECTED):
    blocks = Blocks()
    for s in flight:
        blocks.step(s, shaped(s), 0.0, (0.0, 0.0), 0, False)
    return fit(blocks.all(), expected)


# ---------------------------------------------------------------- the sums and the fit


def test_sums_of_products_say_what_the_samples_say():
    """A block's misfit and fit are those of least squares over its rows."""
    flight = samples("figure eight", 1, seconds=9.0)
    blocks = Blocks()
    for s in flight:
        blocks.step(s, shaped(s), 0.0, (0.0, 0.0), 0, False)
    (block,) = blocks.all()
    z = np.array([s.mag_b_mg for s in flight])
    assert block.n == len(flight)
    assert block.sums[ONE, FEATURES:] == pytest.approx(z.sum(axis=0))
    assert np.einsum("rr->", block.sums[FEATURES:, FEATURES:]) == pytest.approx((z**2).sum())


def test_asking_on_the_way_and_stopping_change_no_bit_of_the_sums():
    flight = samples("figure eight", 4, seconds=47.0)
    quiet, asked, resumed = Blocks(), Blocks(), Blocks()
    for i, s in enumerate(flight):
        for blocks in (quiet, asked, resumed):
            blocks.step(s, shaped(s), 0.04, (5.0 + i % 7, 0.5), 0, False)
        asked.all()
        if i % 50 == 31:
            resumed = pickle.loads(pickle.dumps(resumed))
    sums = [[b.sums.tobytes() for b in blocks.all()] for blocks in (quiet, asked, resumed)]
    assert len(sums[0]) == 5
    assert sums[0] == sums[1] == sums[2]


def test_a_sample_is_the_field_seen_with_the_attitude_it_was_measured_at():
    """One row of features, worked out by hand: nose up, rolled and turned on by the gyro for the compass's delay."""
    s = replace(
        samples("survey", 2, seconds=1.0)[1],
        rate_b_rads=vec3(np.array([0.3, -0.2, 0.5]), "w"),
        roll_rad=0.2,
        pitch_rad=-0.4,
    )
    blocks = Blocks()
    for i in range(10):
        blocks.step(replace(s, yaw_step_rad=0.0 if i else 0.9), shaped(s), 0.1, (3.0, 0.7), 0, False)
    (block,) = blocks.all()
    level = (
        turn_by(np.array([0.0, 0.0, 0.9])) @ turn_by(np.array([0.0, -0.4, 0.0])) @ turn_by(np.array([0.2, 0.0, 0.0]))
    )
    seen = level[[2, 0, 1]] + 0.1 * np.cross(s.rate_b_rads, level[[2, 0, 1]])
    t = -0.5 * BLOCK_S
    mean = block.sums[ONE] / block.n
    assert mean[:9].tolist() == pytest.approx(seen.ravel().tolist())
    assert mean[9:15].tolist() == pytest.approx((t * seen[1:]).ravel().tolist())
    assert mean[15:].tolist() == pytest.approx([1.0, 3.0, 0.7, *s.mag_b_mg.tolist()])


def test_a_mounting_that_is_held_is_solved_as_least_squares_over_all_unknowns():
    """The level fields taken out block by block: the same answer as the whole system solved densely."""
    blocks = Blocks()
    for i, s in enumerate(samples("figure eight", 5, seconds=58.0)):
        blocks.step(s, shaped(s), 0.0, (5.0 + i % 7, 0.0), 0, False)
    p, variance = Problem(blocks.all(), EXPECTED, 3), 36.0
    turns = np.array(right_angles())[[0, 5, 17]]
    held = linear(p, turns, variance)
    j = p.blocks
    e = EXPECTED
    sigmas = [0.3 * e.total_mg, *[IRON_MG] * 3, *[POWER_MG[AMPERE]] * 3, *[IRON_MG] * 3, *[FIELD_MG] * 2 * j]
    for k, turn in enumerate(turns):
        by = np.zeros((j, 10 + 2 * j, FEATURES, 3))
        by[:, 0, DOWN] = turn.T
        for i in range(j):
            by[i, 10 + 2 * i, FIRST], by[i, 11 + 2 * i, SECOND] = turn.T, turn.T
        for axis in range(3):
            by[:, 1 + axis, ONE, axis], by[3:, 7 + axis, ONE, axis] = 1.0, 1.0
            by[:, 4 + axis, AMPERE, axis] = 1.0
        normal = np.einsum("jafi,jfg,jbgi->ab", by, p.x, by)
        right = np.einsum("jafi,jfi->a", by, p.y)
        prior = np.diag(np.array(sigmas) ** -2.0)
        best = np.linalg.solve(normal / variance + prior, right / variance + prior[:, 0] * e.down_mg)
        assert held.shared[k] == pytest.approx(best[:10], rel=1e-8, abs=1e-8)
        assert held.level_mg[k].ravel() == pytest.approx(best[10:], rel=1e-8, abs=1e-8)
        misfit = p.square - 2.0 * best @ right + best @ normal @ best
        assert held.misfit[k] == pytest.approx(misfit, rel=1e-8)


def test_memory_does_not_grow_and_holds_the_last_five_minutes():
    blocks = Blocks()
    s = samples("survey", 2, seconds=1.0)[1]
    for i in range(5000):
        blocks.step(replace(s, boot_ns=int(i * 2e8), dt_s=0.2), shaped(s), 0.0, (0.0, 0.0), 0, False)
    held = blocks.all()
    assert len(held) <= 31
    assert held[-1].begin_s - held[0].begin_s == pytest.approx(30 * BLOCK_S, abs=BLOCK_S)


def test_derivatives_agree_with_finite_differences():
    r = np.random.default_rng(3)
    late = np.array([0.0, 0.0, 1.0, 1.0])
    shared = np.array([430.0, 9, 8, 7, 1, 2, 3, 4, 5, 6])
    state = causes_fit._State(about(x=20, z=70), shared, r.normal(0, 200, (4, 2)), 1.1, late, r.normal(0, 0.5, 3))
    state = state.moved(
        np.concatenate(
            [
                *(r.normal(0, s, n) for s, n in ((0.02, 9), (5, 6), (5, 2))),
                [0.02],
                r.normal(0, 5, 3),
                r.normal(0, 9, 9),
                np.zeros(4),
            ]
        )
    )
    by = state.derivatives(causes_fit.AMPERE)
    for p in range(causes_fit.SHARED + 1):
        step = np.zeros(causes_fit.SHARED + 4)
        step[causes_fit.SHARED if p == causes_fit.SHARED else p] = h = 1e-5
        ahead, back = state.moved(step).theta(causes_fit.AMPERE), state.moved(-step).theta(causes_fit.AMPERE)
        numeric = (ahead - back) / (2 * h)
        which = slice(0, 1) if p == causes_fit.SHARED else slice(None)
        assert by[which, p] == pytest.approx(numeric[which], rel=1e-4, abs=1e-3)


@settings(deadline=None)
@given(st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3))
def test_a_turn_is_the_same_there_and_back(vector):
    matrix = turn_by(np.array(vector))
    assert turn_by(turn_of(matrix)) == pytest.approx(matrix, abs=1e-6)
    assert np.linalg.norm(turn_of(matrix)) <= math.pi + 1e-9


def test_there_are_24_right_angled_mountings_and_all_have_a_name():
    all_of_them = right_angles()
    assert len(all_of_them) == 24
    assert np.array_equal(all_of_them[0], np.eye(3))
    assert len({causes._orientation(m) for m in all_of_them}) == 24


@settings(max_examples=6, deadline=None)
@given(st.lists(st.floats(-20.0, 20.0), min_size=3, max_size=3))
def test_turning_the_sensor_turns_the_answer(degrees):
    turn = turn_by(np.radians(degrees))
    flight = samples("figure eight", 4, seconds=40.0, whole=False)
    plain, turned = fitted(flight), fitted(bent(flight, turn, iron_mg=np.zeros(3)))
    assert np.degrees(turn_of(turned.turn @ (turn @ plain.turn).T)) == pytest.approx(0.0, abs=1.0)
    assert turned.gain == pytest.approx(plain.gain, abs=0.01)
    assert turned.iron_b_mg == pytest.approx(turn @ plain.iron_b_mg, abs=8.0)


def test_sigmas_are_honest():
    """Pooled over motions and seeds: error over sigma of gain, turn and drift. Loose above too: priors are in it."""
    off = []
    for motion in MOTIONS:
        for seed in range(5):
            f = fitted(samples(motion, 100 + seed, seconds=45.0))
            spread = np.sqrt(np.diag(f.covariance))
            turn = turn_of(f.turn) / spread[causes_fit.TURN]
            off.append([(f.gain - 1.0) / spread[0], *turn, f.drift_rads / spread[causes_fit.DRIFT]])
    rms = np.sqrt(np.mean(np.square(off), axis=0))
    assert np.all((rms > 0.2) & (rms < 1.5)), rms


# ---------------------------------------------------------------- a sound compass


@pytest.mark.parametrize("motion", MOTIONS)
def test_a_sound_compass_is_left_alone(motion):
    """Iron, noise, wandering tilt, a walking gyro, a model 3 mG off, swinging power, one wild reading in a hundred."""
    for seed in range(3):
        r = np.random.default_rng(seed)
        flight = samples(motion, 200 + seed, seconds=60.0, earth_mg=EARTH_MG + r.normal(0.0, 3.0, 3))
        wild = [
            replace(s, mag_b_mg=vec3(s.mag_b_mg + (r.normal(0, 200.0, 3) if r.random() < 0.01 else 0.0), "m"))
            for s in flight
        ]
        power = 15.0 + wander(r, len(flight), 1 / RATE_HZ, 3.0, 2.0)
        assert codes(watch(wild, power=power)) == set()


def test_too_little_motion_names_nothing_but_keeps_wide_sigmas():
    """Hovering on one heading: a turned mount cannot be seen, so none is claimed, however long it lasts."""
    still = bent(samples("hover turns", 5, seconds=60.0), about(z=90))[:1] * 1
    flight = [replace(still[0], boot_ns=int(1e9 + i * 1e8), dt_s=0.1, gap=i == 0, yaw_step_rad=0.0) for i in range(600)]
    assert codes(watch(flight)) == set()
    assert np.degrees([fitted(flight).sigma(6 + i) for i in range(3)]).max() > 20.0


def test_a_two_axis_compass_is_left_out():
    assert codes(watch([replace(s, axes=2) for s in bent(samples("survey", 6), about(z=90))])) == set()


# ---------------------------------------------------------------- the acceptance tests


def arc(degrees=40.0, seconds=60.0):
    """Level, swinging through an arc of yaw, 10 Hz."""
    r = np.random.default_rng(7)
    t = np.arange(int(seconds * RATE_HZ)) / RATE_HZ
    yaw = np.radians(degrees / 2.0) * np.sin(0.5 * t)
    first = samples("hover turns", 7, seconds=1.0)[1]
    out = []
    for i in range(len(t)):
        c, s = math.cos(yaw[i]), math.sin(yaw[i])
        n, e, d = EARTH_MG
        field = np.array([c * n + s * e, c * e - s * n, d]) + HARD_IRON_MG + r.normal(0, 4.0, 3)
        step = float(yaw[i] - yaw[i - 1]) if i else 0.0
        out.append(
            replace(first, boot_ns=int(1e10 + i * 1e8), dt_s=0.1 if i else 0.0, gap=i == 0, yaw_step_rad=step,
                    mag_b_mg=vec3(field, "m"), roll_rad=r.normal(0, 0.003), pitch_rad=r.normal(0, 0.003),
                    rate_b_rads=vec3((0, 0, step * RATE_HZ), "w"))
        )  # fmt: skip
    return out


def test_AT_2a_a_narrow_arc_is_not_enough_and_the_motion_that_is_missing_is_named():
    from magmav.core.coach import advise, next_step

    last = run(arc(), where=NOWHERE)[-1]
    assert last.verdict.state is State.LEARNING
    turning = {Reason.X_NOT_OBSERVED, Reason.Y_NOT_OBSERVED, Reason.HEADING_UNSURE}
    assert turning & set(last.verdict.reasons)
    assert re.search("yaw|turn", next_step(last.verdict, advise(last.estimate, 0.0, 0.0, None, 10)))


def test_AT_2d_an_unknown_down_axis_holds_nothing_up_and_is_not_dragged_along():
    """Level turns, position unknown. That its stored value stays bit for bit is test_laws' S4."""
    last = run(yaw_only(60.0), where=NOWHERE)[-1]
    assert last.verdict.state is State.READY
    assert last.verdict.axes[2] is AxisState.NOT_OBSERVED
    assert np.all(np.abs(last.offsets_mg + HARD_IRON_MG)[:2] < 10.0)


def test_AT_3a_a_strange_field_is_named_at_the_tenth_sample_with_its_value():
    """3800 mG from hatch magnets: at 10 Hz that is one second, and the coach says it in the same breath."""
    found, said = Causes(), []
    flight = samples("hover turns", 8, seconds=3.0)

    def see(strength, n):
        for s in flight[:n]:
            found.step(s, NOTHING, EXPECTED, vec3((strength, 0, 0), "u"), True)

    see(3800.0, 9)
    see(500.0, 1)
    see(3800.0, 9)
    assert found.latest(1) == ()
    see(3800.0, 1)
    (cause,) = found.latest(1)
    assert cause.code == "MAGNET_NEARBY"
    assert "3800 mG" in cause.text and "magnet or steel near compass" in cause.text
    assert cause.figure == {"field_mg": 3800.0}
    weak = Causes()
    for s in flight[:10]:
        weak.step(s, NOTHING, EXPECTED, vec3((100, 0, 0), "u"), True)
    assert "100 mG" in weak.latest(1)[0].text

    class Flown:
        causes = found
        phase = type("P", (), {"kind": 2})()
        settings = memory_flight.Settings()

    record = memory_flight.Bench().play(memory_flight.flight(seconds=1.0))[-1]
    coaching = Coaching({1: Flown()}, lambda text, now: said.append((now, text)))
    for t in range(0, 2 * EVERY_NS, 200_000_000):
        coaching.on_record(replace(record, t_ns=t))
    assert said[0] == (0, f"c1: {cause.text}")
    assert sum(text.endswith(cause.text) for _, text in said) == 1
    steps = [t for t, text in said if not text.endswith(cause.text)]
    assert len(steps) == 2 and steps[1] - steps[0] >= EVERY_NS


def test_a_strange_field_that_was_ordinary_iron_is_withdrawn_and_a_magnets_is_kept():
    """Where the Earth's field is weak, 140 mG of iron can leave under 150 mG to see for a while."""
    for iron, stays in ((np.array([140.0, 0, 0]), False), (np.array([700.0, 0, 300.0]), True)):
        found = Causes()
        flight = samples("figure eight", 10, iron_mg=iron)
        for i, s in enumerate(flight):
            found.step(s, NOTHING, EXPECTED, vec3((100.0 if i < 20 else 400.0, 0, 0), "u"), False)
        for s in flight[-20:] if not stays else ():  # standing on that heading again, once it is known
            found.step(s, NOTHING, EXPECTED, vec3((100.0, 0, 0), "u"), False)
        assert ("MAGNET_NEARBY" in codes(found)) is stays


def test_AT_3d_every_cause_has_a_stable_code_a_sentence_and_stands_in_the_page():
    root = Path(__file__).parents[1]
    source = "".join((root / "magmav" / name).read_text() for name in ("core/causes.py", "fitting/why.py"))
    made = set(re.findall(r'"([A-Z]+_[A-Z_]+)"', source))
    page = (root / "docs" / "causes.md").read_text()
    assert made == set(re.findall(r"^\| `([A-Z_]+)` \|", page, flags=re.M))
    assert "failed" not in source.lower()


def height_flight(seed, anomaly_mg):
    """A minute: fifteen seconds on disturbed ground, climbing out of a field that falls with height, then flying."""
    flight = samples("figure eight", seed, seconds=75.0)
    out = []
    still = flight[0]
    for i, s in enumerate(flight):
        if i < 150:
            earth = field_in_body_at(still, EARTH_MG + anomaly_mg)
            near = replace(still, mag_b_mg=vec3(earth + HARD_IRON_MG, "m"), yaw_step_rad=0.0)
            s = replace(near, boot_ns=s.boot_ns, dt_s=s.dt_s, gap=i == 0)
        out.append(s)
    # The flight goes on from where it stood: the first heading is the ground's.
    return [s if i != 150 else replace(s, yaw_step_rad=yaw_between(flight[0], flight[:151])) for i, s in enumerate(out)]


def yaw_between(first, flight):
    return float(sum(s.yaw_step_rad for s in flight[1:]))


def field_in_body_at(s, earth_mg):
    """The field at the attitude of the flight's first sample, whose yaw is that of the motion at its start."""
    r = np.random.default_rng(SEED)
    m = MOTIONS["figure eight"](np.arange(2) / RATE_HZ, r)
    return field_in_body(m, earth_mg)[0]


SEED = 9


def test_AT_11a_what_was_learnt_is_clean_and_the_ground_is_named():
    """The error at the end of such a flight by the simulator, with its dipole, is test_damage's iron under the pad."""
    flight = height_flight(SEED, np.array([120.0, -180.0, 90.0]))
    cause = only(watch(flight, grounded=150), "GROUND_DISTURBED")
    assert cause.figure["off_mg"] == pytest.approx(np.linalg.norm([120, -180, 90]), abs=4 * cause.figure["sigma_mg"])
    assert codes(watch(height_flight(SEED, np.zeros(3)), grounded=150)) == set()
    c = channel()
    ground = [replace(s, learn=False) for s in flight[:150]]
    last = run([*ground, *flight[150:]], c)[-1]
    assert np.all(np.abs(last.offsets_mg + HARD_IRON_MG) < 10.0)


@pytest.mark.parametrize("turned", [about(z=60), about(x=25)], ids=["sideways", "steeper"])
def test_AT_11b_a_field_as_strong_as_the_earths_but_turned_is_seen_by_gyro_and_dip(turned):
    anomaly = turned @ EARTH_MG - EARTH_MG
    assert np.linalg.norm(EARTH_MG + anomaly) == pytest.approx(np.linalg.norm(EARTH_MG))
    cause = only(watch(height_flight(SEED, anomaly), grounded=150), "GROUND_DISTURBED")
    assert cause.figure["off_mg"] == pytest.approx(np.linalg.norm(anomaly), abs=4 * cause.figure["sigma_mg"])


def test_AT_11c_a_whole_session_among_steel_is_never_ready():
    """A rover between steel racks: the field wanders by 80 mG over some seconds. Not one moment is READY."""
    r = np.random.default_rng(12)
    flight = samples("hover turns", 12, seconds=90.0)
    steel = np.stack([wander(r, len(flight), 1 / RATE_HZ, 80.0, 3.0) for _ in range(3)], 1)
    wandering = [replace(s, mag_b_mg=vec3(s.mag_b_mg + d, "m")) for s, d in zip(flight, steel, strict=True)]
    assert all(f.verdict.state is not State.READY for f in run(wandering))


@pytest.mark.parametrize("motion", ["figure eight", "survey"])
def test_AT_12c_a_gyro_bias_is_called_one_and_the_offsets_are_right(motion):
    flight = bent(samples(motion, 13, seconds=90.0), bias_rads=0.02)
    cause = only(watch(flight), "GYRO_BIAS")
    assert cause.figure["bias_degs"] == pytest.approx(math.degrees(0.02), abs=4 * cause.figure["sigma_degs"])
    assert "compass is not to blame" in cause.text
    iron = fitted(flight).iron_b_mg
    assert np.all(np.abs(iron - HARD_IRON_MG)[:2] < 10.0)
    last = run(flight)[-1]
    right = np.all(np.abs(last.offsets_mg + HARD_IRON_MG) < np.maximum(10.0, 3.0 * last.sigma_mg))
    assert right or last.verdict.state is not State.READY


MOUNTS = {"YAW_90": about(z=90), "YAW_180": about(z=180), "ROLL_180": about(x=180), "PITCH_90": about(y=90)}


@pytest.mark.parametrize("name", MOUNTS)
@pytest.mark.parametrize("motion", ["figure eight", "hover turns"])
def test_AT_15a_a_mount_at_right_angles_is_named_as_the_orientation_to_set(motion, name):
    """A sensor sitting as ``name`` says gives R' times the field of the body; set so, it is right."""
    cause = next(c for c in watch(bent(samples(motion, 14), MOUNTS[name].T)).of(1) if c.code.startswith("MOUNTED"))
    assert cause.code == "MOUNTED_WRONG"
    number = next(n for n, o in MAVLINK.items() if o.name == cause.figure["orientation"])
    assert rotation(number) == pytest.approx(MOUNTS[name], abs=1e-9)
    assert cause.figure["orientation"] in cause.text


def mounted(matrix, seed=15, seconds=36.0):
    """A whole vehicle's bytes with compass 1 turned."""
    m = MOTIONS["figure eight"](
        np.arange(int(seconds * memory_flight.HZ)) / memory_flight.HZ, np.random.default_rng(seed)
    )
    off = field_in_body(m) @ (matrix - np.eye(3)).T
    return memory_flight.flight(seconds=seconds, seed=seed, offsets_mg=off)


def test_AT_15a_the_service_refuses_such_a_compass_and_writes_nothing():
    bench = memory_flight.Bench()
    records = bench.play(mounted(about(z=90).T))
    assert records[-1].verdict.state is State.REFUSED
    assert records[-1].verdict.reasons[0] is Reason.MOUNTING_WRONG
    vehicle = bench.pipeline.vehicles[1]
    log = CompassLog()
    log.add(records[-1], vehicle.calibrations.shaping(1))
    entry = describe(log, vehicle, None, None)
    assert [c["code"] for c in entry["causes"]] == ["MOUNTED_WRONG"]
    assert "YAW_90" in to_text(replay_view({"vehicles": [{"system": 1, "autopilot": 3, "compasses": [entry]}]}))
    good = memory_flight.Bench()
    assert good.play(memory_flight.flight(seconds=36.0, seed=15))[-1].verdict.state is State.READY
    assert good.pipeline.vehicles[1].causes.of(1) == ()


@pytest.mark.parametrize("degrees", [30.0, -30.0, 15.0])
def test_AT_15b_a_crooked_mount_is_reported_in_degrees(degrees):
    cause = only(watch(bent(samples("figure eight", 16), about(z=degrees).T)), "MOUNTED_CROOKED")
    assert cause.figure["yaw_deg"] == pytest.approx(degrees, abs=5.0)
    assert cause.figure["turn_deg"] == pytest.approx(abs(degrees), abs=max(3 * cause.figure["sigma_deg"], 1.0))
    assert "about the down axis" in cause.text


def test_AT_15b_a_tilted_mount_too():
    cause = only(watch(bent(samples("figure eight", 17), about(y=12).T)), "MOUNTED_CROOKED")
    assert cause.figure["pitch_deg"] == pytest.approx(12.0, abs=2.0)
    assert "about the right axis" in cause.text


@pytest.mark.parametrize("gain", [0.7, 0.85, 1.15, 1.28, 1.4])
@pytest.mark.parametrize("motion", ["figure eight", "hover turns"])
def test_AT_19a_scale_is_called_scale_and_beyond_a_fifth_it_is_refused(motion, gain):
    found = watch(bent(samples(motion, 18), gain * GRID))
    cause = only(found, "SCALE_WRONG")
    assert cause.figure["gain"] == pytest.approx(gain, abs=4 * cause.figure["sigma"])
    assert found.refuses(1) is (Reason.SCALE_WRONG if abs(gain - 1.0) > 0.2 else None)
    fit_of_it = found._watched[1].fitted
    assert np.all(np.abs(fit_of_it.iron_b_mg - HARD_IRON_MG) < [4 * fit_of_it.sigma(9 + i) for i in range(3)])


def test_AT_19a_without_a_position_nothing_is_said_of_scale():
    assert codes(watch(bent(samples("figure eight", 18), 1.3 * GRID), expected=None)) == set()


def test_AT_20a_a_weak_horizontal_field_makes_the_heading_as_unsure_as_it_is_and_is_said():
    steep = np.array([60.0, 0.0, 560.0])
    weak = run(
        samples("figure eight", 19, earth_mg=steep), where=replace(HERE, expected=ExpectedField(60.0, 560.0, 0.0))
    )
    strong = run(samples("figure eight", 19))
    assert Reason.HORIZONTAL_WEAK in weak[-1].verdict.reasons
    assert Reason.HORIZONTAL_WEAK not in strong[-1].verdict.reasons
    grown = np.median([f.heading.sigma_rad for f in weak[-100:]]) / np.median(
        [f.heading.sigma_rad for f in strong[-100:]]
    )
    assert grown > 0.7 * EXPECTED.horizontal_mg / 60.0


# ---------------------------------------------------------------- the other causes


@pytest.mark.parametrize("by", ["ampere", "throttle"])
def test_a_field_that_follows_power_is_measured_per_unit(by):
    r = np.random.default_rng(21)
    flight = samples("figure eight", 21)
    power = 15.0 + wander(r, len(flight), 1 / RATE_HZ, 4.0, 3.0)
    per = np.array([2.0, -1.5, 2.5])
    driven = [replace(s, mag_b_mg=vec3(s.mag_b_mg + per * p, "m")) for s, p in zip(flight, power, strict=True)]
    if by == "ampere":
        cause = only(watch(driven, power=power), "FOLLOWS_CURRENT")
        unit = 1.0
    else:
        found = Causes()
        for s, p in zip(driven, power, strict=True):
            found.throttle(p / 40.0)
            found.step(s, NOTHING, EXPECTED, vec3(s.mag_b_mg - HARD_IRON_MG, "u"), False)
        cause, unit = only(found, "FOLLOWS_THROTTLE"), 40.0
    got = np.array([cause.figure[f"{a}_mg"] for a in "xyz"])
    assert np.linalg.norm(got - unit * per) < 4.0 * cause.figure["sigma_mg"]


def test_the_bad_one_of_several_is_named_in_every_entry():
    found = Causes()
    flight = samples("figure eight", 22)
    shaken = bent(flight, np.eye(3) + np.array([[0, 0.15, 0], [0.1, 0, 0], [0, 0, 0.1]]), compass=2)
    for good, bad, third in zip(flight, shaken, bent(flight, compass=3), strict=True):
        for s in (good, bad, third):
            found.step(s, NOTHING, EXPECTED, vec3(s.mag_b_mg - HARD_IRON_MG, "u"), False)
    assert "COMPASS_BAD" in codes(found, 2)
    for compass in (1, 3):
        (cause,) = found.of(compass)
        assert (cause.code, cause.figure["compass"]) == ("OTHER_COMPASS_BAD", 2.0)
        assert "compass 2 is the bad one" in cause.text


def test_a_magnet_that_is_attached_in_flight_is_measured():
    at, step = 300, np.array([-60.0, 45.0, 120.0])
    iron = np.tile(HARD_IRON_MG, (900, 1)) + np.where(np.arange(900)[:, None] >= at, step, 0.0)
    flight = samples("figure eight", 23, seconds=90.0, iron_mg=iron)
    c, found = channel(), Causes()
    for s in flight:
        e = c.step(s, s.mag_b_mg, HERE).estimate
        found.step(s, e, EXPECTED, vec3(s.mag_b_mg - HARD_IRON_MG, "u"), False)
    cause = only(found, "IRON_CHANGED")
    assert cause.figure["change_mg"] == pytest.approx(np.linalg.norm(step), abs=4 * cause.figure["sigma_mg"])


def test_a_restart_forgets():
    found = watch(bent(samples("figure eight", 24), about(z=90)))
    assert codes(found)
    found.restart(1)
    assert codes(found) == set()
    assert found.refuses(1) is None


def test_stopping_to_ask_changes_nothing():
    flight = bent(samples("survey", 25), about(z=30))
    once, often = Causes(), Causes()
    for i, s in enumerate(flight):
        for one in (once, often):
            one.step(s, NOTHING, EXPECTED, vec3(s.mag_b_mg - HARD_IRON_MG, "u"), False)
        if i % 97 == 0:
            often.of(1)
    assert [c.as_json() for c in once.of(1)] == [c.as_json() for c in often.of(1)]


def test_a_sample_is_never_changed_by_being_watched():
    s: Sample = samples("survey", 26, seconds=1.0)[0]
    before = s.mag_b_mg.tobytes()
    watch([s])
    assert s.mag_b_mg.tobytes() == before


# ---------------------------------------------------------------- what a motion cannot show


def flat(t, r):
    """A rover driving curves both ways over ground a third of a degree off level."""
    rate, phase = r.uniform([0.25, 0.7, 1.4], [0.5, 1.2, 2.4], (2, 3)), r.uniform(0.0, 6.3, (2, 3))
    waves = np.sin(rate[:, :, None] * t + phase[:, :, None]).sum(axis=1)
    a, b = r.uniform(0.0, 6.0, 2)
    return Motion(*(np.radians(0.25) * waves), a + 3.5 * np.sin(t / 11.0 + b) + 0.03 * t)


@pytest.fixture
def on_the_flat(monkeypatch):
    """Three minutes of it by seed; the attitude errs by more than the vehicle tilts."""
    monkeypatch.setitem(MOTIONS, "flat", flat)
    return lambda seed: samples("flat", seed, seconds=180.0, tilt_deg=0.45)


def test_on_the_flat_a_turn_about_the_down_axis_is_not_shown_and_its_sigma_says_so(on_the_flat):
    """The attitude's errors, taken for tilts, must neither turn the mounting nor weaken the field."""
    off = []
    for seed in range(6):
        f = fitted(on_the_flat(seed))
        spread = np.sqrt(np.diag(f.covariance))
        assert spread[8] > math.radians(15.0) > spread[6]
        off.append([*(turn_of(f.turn) / spread[causes_fit.TURN]), (f.gain - 1.0) / spread[0]])
    assert np.all(np.abs(np.mean(off, axis=0)) < 1.2), off
    assert np.abs(off).max() < 3.0


@pytest.mark.parametrize(
    ("matrix", "expected"),
    [
        (GRID, set()),
        (about(z=30), set()),
        (about(y=15), {"MOUNTED_CROOKED"}),
        (about(x=180), {"MOUNTED_WRONG"}),
        (1.3 * GRID, {"SCALE_WRONG"}),
    ],
    ids=["sound", "turned flat", "nose down", "upside down", "strong"],
)
def test_on_the_flat_what_turning_shows_is_named_and_nothing_else(on_the_flat, matrix, expected):
    assert codes(watch(bent(on_the_flat(3), matrix))) == expected


def test_an_estimator_that_searches_does_not_take_the_data_away():
    """A compass turned on its mount makes an estimator call one sudden change after the other: they are no change."""
    found = Causes()
    for i, s in enumerate(bent(samples("figure eight", 27), about(z=90))):
        called = replace(NOTHING, changed_ago_s=1e9 if i < 40 else (0.1 * (i - 40)) % 4.0)
        found.step(s, called, EXPECTED, vec3(s.mag_b_mg - HARD_IRON_MG, "u"), False)
    assert "MOUNTED_WRONG" in codes(found)
