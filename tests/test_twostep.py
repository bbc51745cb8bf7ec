"""The second opinion: exact without noise, blind to attitude, forgets what no longer fits, and knows its doubt."""

import copy
import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from synthetic_flight import turn

from magmav.core.estimators import ESTIMATORS
from magmav.core.estimators.twostep import TwostepEstimator, distance
from magmav.core.estimators.twostep_equation import C, D, drawn, rows, soft_root, symmetric
from magmav.core.estimators.twostep_noise import Tuning
from magmav.core.estimators.twostep_window import Blocks, Sieve
from magmav.core.field import ExpectedField
from magmav.core.types import NO_SHAPING, Estimate, Sample, Shaping, mat3, vec3

FIELD_MG = np.array([205.0, 14.0, 430.0])
IRON_MG = np.array([120.0, -70.0, 50.0])
MODEL_MG = (math.hypot(205.0, 14.0), 430.0)
HZ = 10


def rotations(roll, pitch, yaw):
    """(N, 3, 3), north-east-down to body."""

    def about(axis, angle):
        c, s = np.cos(angle), np.sin(angle)
        i, j = ((1, 2), (2, 0), (0, 1))[axis]
        out = np.broadcast_to(np.eye(3), (len(yaw), 3, 3)).copy()
        out[:, i, i], out[:, j, j], out[:, i, j], out[:, j, i] = c, c, s, -s
        return out

    return about(0, roll) @ about(1, pitch) @ about(2, yaw)


def eights(seconds, r=None, hz=HZ):
    """True body fields of banked turns both ways, (N, 3) mG."""
    t = np.arange(int(seconds * hz)) / hz
    phase, size = (0.0, 1.0) if r is None else (r.uniform(0.0, 6.0), r.uniform(0.6, 1.2))
    swing = np.sin(2 * np.pi * t / 24.0 + phase)
    yaw = 5.0 * size * swing + phase
    roll = np.radians(30.0 * size) * np.cos(2 * np.pi * t / 24.0 + phase) + 0.05 * np.sin(1.3 * t)
    pitch = np.radians(6.0) * np.sin(0.7 * t + phase)
    return rotations(roll, pitch, yaw) @ FIELD_MG


def wobbling(seconds, r, degrees=2.0, turns=0.0, hz=HZ):
    """On one spot, leaning a little this way and that, and turning so many times."""
    t = np.arange(int(seconds * hz)) / hz

    def sway():
        return math.radians(degrees) * sum(np.sin(w * t + r.uniform(0, 6)) for w in r.uniform(0.3, 2.0, 3))

    yaw = r.uniform(0, 6) + 2 * np.pi * turns * t / seconds + sway()
    return rotations(sway(), sway(), yaw) @ FIELD_MG


def sample(mag, dt=1.0 / HZ, model=MODEL_MG, **more):
    given_ = {
        "system": 1,
        "compass": 1,
        "boot_ns": 0,
        "dt_s": dt,
        "mag_b_mg": vec3(mag, "field"),
        "shaping": NO_SHAPING,
        "rate_b_rads": vec3((0, 0, 0), "rate"),
        "roll_rad": 0.0,
        "pitch_rad": 0.0,
        "yaw_step_rad": 0.0,
        "lead_rad": 0.0,
        "age_s": 0.0,
        "gap": False,
        "tilt_from": "ATTITUDE",
        "learn": True,
        "model_mg": model,
    }
    return Sample(**(given_ | more))


def taught(values, e=None, **more) -> TwostepEstimator:
    e = e or TwostepEstimator()
    for m in values:
        e.step(sample(m, **more))
    return e


def answer(values, e=None, **more) -> Estimate:
    got = taught(values, e, **more).estimate(None)
    assert got is not None
    return got


def sigma(e: Estimate):
    return np.sqrt(np.diag(e.covariance_mg2))


# ---------------------------------------------------------------- the equation

states = arrays(float, 10, elements=st.floats(-0.4, 0.4)).map(lambda v: v + np.eye(10)[3])


@settings(max_examples=40, deadline=None)
@given(states, arrays(float, 3, elements=st.floats(-2.0, 2.0)))
def test_the_last_row_is_the_residual_of_the_ellipsoid(x, y):
    w = np.concatenate(((1.0,), y, (y @ y,), y**2, (y[0] * y[1], y[0] * y[2], y[1] * y[2])))
    Q = np.eye(3) + symmetric(x[D])
    assert rows(x)[10] @ w == pytest.approx((y - x[C]) @ Q @ (y - x[C]) - x[3], abs=1e-12)


@settings(max_examples=20, deadline=None)
@given(states, arrays(float, 3, elements=st.floats(-2.0, 2.0)))
def test_the_other_rows_are_its_derivatives_where_there_is_no_soft_iron(x, y):
    w = np.concatenate(((1.0,), y, (y @ y,), y**2, (y[0] * y[1], y[0] * y[2], y[1] * y[2])))
    x = np.concatenate((x[:4], np.zeros(6)))
    h = 1e-6
    slopes = [(rows(x + h * i)[10] - rows(x - h * i)[10]) @ w / (2 * h) for i in np.eye(10)]
    assert rows(x)[:10] @ w == pytest.approx(slopes, abs=1e-7)


def test_the_soft_iron_is_the_symmetric_root_of_what_is_fitted():
    x = np.zeros(10)
    x[D] = (0.1, -0.05, 0.02, 0.03, -0.04, 0.01)
    root = soft_root(x)
    assert root == pytest.approx(root.T, abs=1e-12)
    assert root @ root == pytest.approx(np.eye(3) + symmetric(x[D]), abs=1e-12)


def test_noise_draws_the_gradient_by_what_is_taken_back():
    """Averaged over much noise, at the truth: the expected gradient of one value's squared residual."""
    r = np.random.default_rng(1)
    s, d = 0.02, np.array((0.6, -0.3, 0.7))
    y = np.concatenate((r.normal(0.0, s, (150_000, 3)),) * 2) * np.repeat((1.0, -1.0), 150_000)[:, None] + d
    x = np.zeros(10)
    x[3] = d @ d
    w = np.column_stack(
        (np.ones(len(y)), y, (y * y).sum(1), y * y, y[:, 0] * y[:, 1], y[:, 0] * y[:, 2], y[:, 1:].prod(1))
    )
    T = rows(x)
    gradient = ((w @ T[:10].T) * (w @ T[10])[:, None]).mean(0)
    exact = np.array((1.0, *d, d @ d, *(d * d), d[0] * d[1], d[0] * d[2], d[1] * d[2]))
    assert gradient == pytest.approx(drawn(T[:10] @ exact, 1.0, s * s), abs=0.05 * 7 * s * s)


# ---------------------------------------------------------------- without noise


def quiet():
    """Told that there is no noise."""
    return TwostepEstimator(Tuning(white_mg=0.01, structure_mg=0.01, model_mg=0.01, prior_mg=1e4))


@settings(max_examples=8, deadline=None)
@given(st.tuples(*[st.floats(-250.0, 250.0)] * 3), st.integers(0, 99))
def test_without_noise_it_is_exact(iron, seed):
    """And within a part of its doubt where it reckons with noise that is not there."""
    flight = eights(40, np.random.default_rng(seed)) + np.array(iron)
    got = answer(flight)
    assert np.all(np.abs(got.hard_iron_b_mg - np.array(iron)) < 0.5 * sigma(got))
    assert answer(flight, quiet()).hard_iron_b_mg == pytest.approx(np.array(iron), abs=0.01)


def test_the_length_need_not_be_known_where_the_vehicle_banks():
    got = answer(eights(60) + IRON_MG, model=None)
    assert got.hard_iron_b_mg == pytest.approx(IRON_MG, abs=4.0)
    assert math.hypot(got.horizontal_mg, got.down_mg) == pytest.approx(np.linalg.norm(FIELD_MG), abs=3.0)


def test_the_length_told_when_asking_counts_as_told_before_and_asking_changes_nothing():
    flight = wobbling(30, np.random.default_rng(0), turns=1.0) + IRON_MG
    told, blind = taught(flight), taught(flight, model=None)
    before = pickle.dumps(blind)
    expected = ExpectedField(*MODEL_MG, 0.0)
    assert blind.estimate(expected).hard_iron_b_mg == pytest.approx(told.estimate(None).hard_iron_b_mg, abs=2.0)
    assert np.trace(blind.estimate(expected).covariance_mg2) < 0.5 * np.trace(blind.estimate(None).covariance_mg2)
    assert pickle.dumps(blind) == before


def test_own_sigma_is_that_without_the_model():
    """Level turns: only the length tells the down axis. Told or not, own_sigma says that motion alone does not."""
    flight = wobbling(40, np.random.default_rng(1), 0.3, turns=3.0) + IRON_MG
    got, blind = answer(flight), answer(flight, model=None)
    assert sigma(got)[2] < 25.0 and got.own_sigma_mg[2] > 40.0
    assert blind.own_sigma_mg[2] == pytest.approx(sigma(blind)[2], rel=1e-6)
    assert max(*sigma(got)[:2], *got.own_sigma_mg[:2]) < 10.0


# ---------------------------------------------------------------- axes

SWAPS = [turn(0, np.pi / 2), turn(1, -np.pi / 2), turn(2, np.pi), turn(0, np.pi / 2) @ turn(2, np.pi / 2), -np.eye(3)]


@pytest.mark.parametrize("way", range(len(SWAPS)))
def test_axes_exchanged_exchange_the_answer(way):
    R = np.round(SWAPS[way])
    flight = eights(30) + IRON_MG + np.random.default_rng(3).normal(0.0, 4.0, (300, 3))
    here, there = answer(flight), answer(flight @ R.T)
    assert there.hard_iron_b_mg == pytest.approx(R @ here.hard_iron_b_mg, abs=1e-5)
    assert there.covariance_mg2 == pytest.approx(R @ here.covariance_mg2 @ R.T, rel=1e-5, abs=1e-5)
    assert there.soft_iron_b == pytest.approx(R @ here.soft_iron_b @ R.T, abs=1e-7)


@settings(max_examples=6, deadline=None)
@given(*[st.floats(-3.1, 3.1)] * 3)
def test_a_sensor_mounted_turned_turns_the_answer(a, b, c):
    """Runs of values are cut by component, so not to the last digit."""
    R = turn(0, a) @ turn(1, b) @ turn(2, c)
    flight = eights(30) + IRON_MG + np.random.default_rng(3).normal(0.0, 4.0, (300, 3))
    here, there = answer(flight), answer(flight @ R.T)
    assert np.linalg.norm(there.hard_iron_b_mg - R @ here.hard_iron_b_mg) < 0.5 * np.linalg.norm(sigma(here))


def test_attitude_is_not_looked_at():
    flight = eights(30) + IRON_MG + np.random.default_rng(3).normal(0.0, 4.0, (300, 3))
    a, b = answer(flight), answer(flight, roll_rad=0.5, pitch_rad=-0.9, yaw_step_rad=1.0, gap=True, throttle=0.9)
    assert a.hard_iron_b_mg.tobytes() == b.hard_iron_b_mg.tobytes()
    assert a.covariance_mg2.tobytes() == b.covariance_mg2.tobytes()


def test_it_fits_through_the_autopilots_matrix_and_motor_term():
    matrix = np.array(((1.15, 0.05, 0.0), (0.05, 0.9, -0.04), (0.0, -0.04, 1.05)))
    motor = np.array((20.0, -30.0, 10.0))
    sensor = (eights(40) - motor) @ np.linalg.inv(matrix).T + IRON_MG
    got = answer(sensor, quiet(), shaping=Shaping(mat3(matrix, "m"), vec3(motor, "motor")))
    assert got.hard_iron_b_mg == pytest.approx(IRON_MG, abs=0.01)


def test_another_matrix_stored_in_flight_keeps_the_iron():
    """And what comes after is learnt through the new one: the old would leave 10 % of soft iron."""
    matrix = np.diag((1.1, 0.9, 1.0))
    e = taught(eights(40) @ np.linalg.inv(matrix).T + IRON_MG, shaping=Shaping(mat3(matrix, "m"), vec3((0, 0, 0), "e")))
    again = wobbling(20, np.random.default_rng(2), 0.5)
    other = np.diag((0.95, 1.05, 1.0))
    got = answer(again @ np.linalg.inv(other).T + IRON_MG, e, shaping=Shaping(mat3(other, "m"), vec3((0, 0, 0), "e")))
    assert got.hard_iron_b_mg == pytest.approx(IRON_MG, abs=5.0)
    assert got.soft_iron_b == pytest.approx(np.eye(3), abs=0.01)
    assert np.all(sigma(got) < 15.0)


def test_a_compass_of_two_axes_gets_no_answer():
    assert taught(eights(30) + IRON_MG, axes=2).estimate(None) is None


# ---------------------------------------------------------------- robustness and forgetting


@pytest.mark.parametrize("seed", range(4))
def test_one_wild_value_in_a_hundred_does_not_matter(seed):
    r = np.random.default_rng(seed)
    flight = eights(60, r) + IRON_MG + r.normal(0.0, 4.0, (600, 3))
    way = r.normal(size=(600, 3))
    wild = way / np.linalg.norm(way, axis=1)[:, None] * r.uniform(300.0, 900.0, (600, 1))
    spoilt = flight + wild * (r.random(600) < 0.01)[:, None]
    clean, got = answer(flight), answer(spoilt)
    assert got.hard_iron_b_mg == pytest.approx(clean.hard_iron_b_mg, abs=1.0)
    assert np.all(np.abs(got.hard_iron_b_mg - IRON_MG) < 3.5 * sigma(got))


def test_the_sieve_drops_single_values_and_pairs_and_keeps_a_step():
    sieve, r = Sieve(), np.random.default_rng(0)
    values = eights(20) + IRON_MG
    values[100:] += (70.0, 0.0, 0.0)
    spoilt = values.copy()
    for i in (20, 60, 61, 120):
        spoilt[i] += r.choice((-1, 1), 3) * r.uniform(200.0, 500.0, 3)
    passed = [got for i, v in enumerate(spoilt) if (got := sieve.step(float(i), tuple(v.tolist()))) is not None]
    assert sorted(set(range(2, 198)) - {int(t) for t, _ in passed}) == [20, 60, 61, 120]
    assert all(v == tuple(values[int(t)]) for t, v in passed)


@pytest.mark.parametrize("seed", range(4))
def test_a_step_of_the_iron_is_followed(seed):
    """70 mG at 90 s: right again within 20 s, and doubtful meanwhile."""
    r = np.random.default_rng(seed)
    way = r.normal(size=3)
    step = 70.0 * way / np.linalg.norm(way)
    flight = eights(125, r) + IRON_MG + r.normal(0.0, 4.0, (1250, 3))
    flight[900:] += step
    e = taught(flight[:900])
    assert e.estimate(None).hard_iron_b_mg == pytest.approx(IRON_MG, abs=3.0)
    got = answer(flight[900:1100], e)
    assert got.hard_iron_b_mg == pytest.approx(IRON_MG + step, abs=8.0)
    assert got.changed_ago_s < 25.0
    later = answer(flight[1100:], e)
    assert later.hard_iron_b_mg == pytest.approx(IRON_MG + step, abs=5.0)


def test_time_alone_makes_it_forget_nothing():
    """A quarter of an hour on one spot after a minute of turns."""
    r = np.random.default_rng(5)
    flight = eights(60, r, hz=5) + IRON_MG
    hover = np.tile(flight[-1], (15 * 60 * 5, 1))
    e = taught(flight + r.normal(0.0, 4.0, flight.shape), dt=0.2)
    before = e.estimate(None)
    after = answer(hover + r.normal(0.0, 4.0, hover.shape), e, dt=0.2)
    assert after.hard_iron_b_mg == pytest.approx(before.hard_iron_b_mg, abs=2.0)
    assert np.all(sigma(after) < 2.0 * sigma(before) + 1.0)


def test_memory_does_not_grow():
    blocks, r = Blocks(), np.random.default_rng(0)
    points = r.normal(0.0, 300.0, (12_000, 3)).tolist()
    sizes = []
    for i, p in enumerate(points):
        blocks.add(0.6 * i, tuple(p))
        if i in (3000, 6000, 11_999):
            sizes.append((len(blocks.sums), len(pickle.dumps(blocks))))
    assert len(blocks.sums) < 20 and max(n for _, n in sizes) < 25_000
    assert blocks.sums[:, 0, 0].sum() > 11_990  # and nothing fell out
    assert np.all(np.diff(blocks.begun_s) > 0.0)


# ---------------------------------------------------------------- honesty


def ratios(make, count=18):
    """error/sigma of flights, (count, 3)."""
    out = []
    for seed in range(count):
        r = np.random.default_rng([seed, 11])
        iron = r.normal(0.0, 70.0, 3)
        got = answer(make(r) + iron)
        out.append((got.hard_iron_b_mg - iron) / sigma(got))
    return np.array(out)


def assumed(r, body):
    """With noise, a model that is wrong and soft iron as the method assumes before it has seen anything."""
    soft = np.eye(3) + symmetric(r.normal(0.0, 0.007, 6) * np.array((1, 1, 1, 0.7, 0.7, 0.7)))
    wrong = 1.0 + r.normal(0.0, 5.0) / np.linalg.norm(FIELD_MG)
    return wrong * body @ soft.T + r.normal(0.0, 4.0, body.shape)


MOTIONS = {
    "eights": lambda r: eights(r.uniform(15, 60), r),
    "turning": lambda r: wobbling(r.uniform(20, 60), r, 2.0, turns=r.uniform(1.0, 3.0)),
    "hover": lambda r: wobbling(r.uniform(20, 60), r, 2.0),
}


def test_sigma_is_honest_over_motions():
    got = {name: ratios(lambda r, m=motion: assumed(r, m(r))) for name, motion in MOTIONS.items()}
    pooled = math.sqrt(np.mean([np.mean(v**2) for v in got.values()]))
    assert 0.6 < pooled < 1.2
    for name, v in got.items():
        assert math.sqrt(np.mean(v**2)) < 1.3, name
        assert np.mean(np.abs(v) > 3.0) < 0.03, name


def test_sigma_does_not_shrink_with_the_root_of_numbers_where_misfits_last():
    """A disturbance that lasts for 5 s, as motors make: three times the white noise is no excuse for claiming ten."""

    def lasting(r):
        body = eights(40, r)
        keep, now = math.exp(-1.0 / (5.0 * HZ)), r.normal(0.0, 12.0, 3)
        slow = np.empty_like(body)
        for i in range(len(body)):
            now = keep * now + r.normal(0.0, 12.0 * math.sqrt(1.0 - keep * keep), 3)
            slow[i] = now
        return body + slow + r.normal(0.0, 4.0, body.shape)

    assert math.sqrt(np.mean(ratios(lasting, 12) ** 2)) < 1.3


def test_soft_iron_of_five_per_cent_is_found_or_doubted():
    def bent(r):
        soft = np.eye(3) + symmetric(r.normal(0.0, 0.05, 6) * np.array((1, 1, 1, 0.7, 0.7, 0.7)))
        body = eights(60, r)
        return body @ soft.T + r.normal(0.0, 4.0, body.shape)

    v = ratios(bent, 12)
    assert math.sqrt(np.mean(v**2)) < 1.3


@pytest.mark.parametrize("seed", range(6))
def test_a_vehicle_that_stands_still_knows_nothing_and_says_so(seed):
    """One direction, and noise. The centre may be anywhere on a sphere about it: not nonsense with a small sigma."""
    r = np.random.default_rng(seed)
    body = rotations(np.zeros(1), np.zeros(1), r.uniform(0, 6, 1)) @ FIELD_MG
    iron = r.normal(0.0, 70.0, 3)
    got = answer(np.tile(body, (400, 1)) + iron + r.normal(0.0, 4.0, (400, 3)))
    off = got.hard_iron_b_mg - iron
    assert np.linalg.eigvalsh(got.covariance_mg2)[1] > 100.0**2
    assert math.sqrt(off @ np.linalg.solve(got.covariance_mg2, off)) < 4.0


@pytest.mark.parametrize("value", [(0.0, 0.0, 0.0), (300.0, 20.0, 600.0), (1.0, 0.0, 0.0)])
def test_a_stuck_sensor_gives_finite_numbers_and_large_doubt(value):
    got = answer([value] * 200)
    assert np.isfinite(got.hard_iron_b_mg).all() and np.isfinite(got.covariance_mg2).all()
    assert np.sort(sigma(got))[1] > 100.0


def test_level_turns_have_a_twin_and_the_likelier_one_is_taken():
    """Of a circle and a length the centre is as well above as below: the smaller iron is likelier."""
    r = np.random.default_rng(2)
    iron = np.array((40.0, -30.0, 60.0))
    got = answer(wobbling(40, r, 0.2, turns=2.0) + iron + r.normal(0.0, 3.0, (400, 3)))
    assert np.all(np.abs(got.hard_iron_b_mg - iron) < 3.0 * sigma(got))
    assert sigma(got)[2] < 60.0
    assert np.linalg.eigvalsh(got.covariance_mg2)[0] > 0.0


# ---------------------------------------------------------------- the contract


def test_it_is_one_of_the_estimators():
    assert isinstance(ESTIMATORS["twostep"](), TwostepEstimator)


def bits(e: Estimate):
    return tuple(
        v.tobytes() if isinstance(v, np.ndarray) else v
        for v in (
            e.hard_iron_b_mg,
            e.covariance_mg2,
            e.own_sigma_mg,
            e.soft_iron_b,
            e.residual_mg,
            e.down_mg,
            e.samples,
        )
    )


def test_saved_and_restored_it_goes_on_to_the_same_bits():
    r = np.random.default_rng(8)
    flight = eights(50, r) + IRON_MG + r.normal(0.0, 4.0, (500, 3))
    e = taught(flight[:237])
    twins = [copy.deepcopy(e), pickle.loads(pickle.dumps(e)), e]
    assert len({bits(answer(flight[237:], twin)) for twin in twins}) == 1
    assert len(pickle.dumps(e)) < 50_000


def test_what_must_not_be_learnt_is_not():
    flight = eights(30) + IRON_MG
    e = taught(flight)
    before = bits(e.estimate(None))
    taught(flight * 3.0, e, learn=False)
    taught([(3e4, 0.0, 0.0)] * 50, e)
    assert bits(e.estimate(None)) == before


def test_before_three_seconds_and_twenty_values_it_says_nothing():
    assert taught(eights(2) + IRON_MG).estimate(None) is None
    assert taught((eights(10) + IRON_MG)[::10], dt=1.0).estimate(None) is None


@pytest.mark.parametrize("hz", [2, 50])
def test_any_rate_will_do(hz):
    r = np.random.default_rng(4)
    flight = eights(60, r, hz) + IRON_MG
    got = answer(flight + r.normal(0.0, 4.0, flight.shape), dt=1.0 / hz)
    assert np.all(np.abs(got.hard_iron_b_mg - IRON_MG) < 3.0 * sigma(got))
    assert np.all(sigma(got) < 15.0)


# ---------------------------------------------------------------- agreement

ONE = answer(eights(20) + IRON_MG)


def opinion(iron, variances, says=(True, True, True)):
    return replace(ONE, hard_iron_b_mg=vec3(iron, "b"), covariance_mg2=np.diag(variances), says_b=says)


def disagreement(a, b):
    return distance(a.hard_iron_b_mg - b.hard_iron_b_mg, a.covariance_mg2, b.covariance_mg2)


def test_disagreement_is_the_distance_in_sigmas_of_both():
    a, b = opinion((10.0, 0.0, 0.0), (9.0, 9.0, 9.0)), opinion((0.0, 0.0, 0.0), (16.0, 16.0, 16.0))
    assert disagreement(a, b) == pytest.approx(2.0)
    assert disagreement(b, a) == pytest.approx(2.0)
    assert disagreement(a, a) == 0.0
    c = opinion((10.0, 10.0, 0.0), (9.0, 9.0, 9.0))
    assert disagreement(c, b) == pytest.approx(2.0 * math.sqrt(2.0))


def test_who_knows_nothing_of_a_direction_cannot_contradict_there():
    sure, vague = opinion((0.0, 0.0, 500.0), (4.0, 4.0, 4.0)), opinion((6.0, 0.0, 0.0), (5.0, 5.0, 300.0**2))
    assert disagreement(sure, vague) == pytest.approx(2.0)
    assert disagreement(vague, sure) > 1.5  # there the second opinion knows
    silent = opinion((6.0, 0.0, 0.0), (300.0**2,) * 3)
    assert disagreement(sure, silent) == 0.0


@settings(max_examples=20, deadline=None)
@given(*[st.floats(-3.1, 3.1)] * 3)
def test_disagreement_does_not_depend_on_axes(a, b, c):
    R = turn(0, a) @ turn(1, b) @ turn(2, c)
    one, two = opinion((10.0, -4.0, 200.0), (9.0, 25.0, 4.0)), opinion((1.0, 3.0, 0.0), (4.0, 100.0, 300.0**2))

    def turned(e):
        return replace(e, hard_iron_b_mg=vec3(R @ e.hard_iron_b_mg, "b"), covariance_mg2=R @ e.covariance_mg2 @ R.T)

    assert disagreement(turned(one), turned(two)) == pytest.approx(disagreement(one, two), rel=1e-9)
