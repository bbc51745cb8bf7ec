"""The magnetic reference vector: the paper's numbers, and the facts proved about its references and solvers."""

import math
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from seed_vectors import load

from magmav.core import marg
from magmav.core.heading import magnetic_heading
from magmav.core.rotation import body_from_earth, euler_from_quaternion, tilt_from_force

SEED = load()["marg"]
ONE = np.array((1.0, 0.0, 0.0, 0.0))
REFERENCES = (False, True)  # direct, dynamic


def measured(roll, pitch, yaw, dip, noise=0.0, rng=None):
    """A pair as an accelerometer and a magnetometer would give it, all angles rad, in odd units on purpose."""
    C = body_from_earth(roll, pitch, yaw)
    force, field = -9.8 * C @ (0.0, 0.0, 1.0), 480.0 * C @ (math.cos(dip), 0.0, math.sin(dip))
    if rng is not None:
        force, field = force + 9.8 * noise * rng.normal(size=3), field + 480.0 * noise * rng.normal(size=3)
    return marg.pair(force, field), force, field


def reference(q, p, dynamic):
    return marg.dynamic_reference(q, p) if dynamic else marg.direct_reference(p)


def stepped(step, q, p, dynamic):
    return step(q, marg.jacobian(q, p), marg.error(q, p, reference(q, p, dynamic)))


def apart(q, other):
    """Distance of two rotations in quaternion space: half the angle between them, rad, when small."""
    return float(np.linalg.norm(marg.aligned(q, other) - other))


def near(q, turn_rad):
    return marg.multiply(marg.turned(np.asarray(turn_rad, dtype=float)), q)


angles = st.floats(-3.1, 3.1)
pitches = st.floats(-1.4, 1.4)
dips = st.floats(-1.2, 1.2)


# ------------------------------------------------------------ the paper's numbers


def seed_pair():
    return marg.pair(-np.array(SEED["a_down_body"]), np.array(SEED["m_body"]))


def test_seed_references_and_closed_form():
    p = seed_pair()
    assert marg.direct_reference(p) == pytest.approx(SEED["mref"], abs=1e-12)
    assert marg.dynamic_reference(ONE, p) == pytest.approx(SEED["mref_dynamic_from_identity"], abs=1e-12)
    assert marg.closed_form(p) == pytest.approx(SEED["q_closed_form"], abs=1e-12)
    assert marg.closed_form(p) == pytest.approx(SEED["q_true"], abs=1e-12)
    got = np.degrees(euler_from_quaternion(*marg.closed_form(p)))
    assert got == pytest.approx((SEED["roll"], SEED["pitch"], SEED["yaw"]), abs=1e-10)


@pytest.mark.parametrize("name", SEED["first5"])
def test_seed_steps(name):
    step = marg.gauss_newton if name.startswith("gn") else partial(marg.descend, mu=SEED["mu"])
    q, p = np.array(SEED["q0"]), seed_pair()
    for want in SEED["first5"][name]:
        q = stepped(step, q, p, name.endswith("dynamic"))
        assert q == pytest.approx(want, abs=1e-12)


# ------------------------------------------------------------ quaternions


@given(angles, pitches, angles, angles, pitches, angles)
@settings(max_examples=60, deadline=None)
def test_quaternions_are_rotations(r1, p1, y1, r2, p2, y2):
    A, B = body_from_earth(r1, p1, y1).T, body_from_earth(r2, p2, y2).T
    a, b = marg.from_matrix(A), marg.from_matrix(B)
    assert marg.matrix(a) == pytest.approx(A, abs=1e-14)
    assert marg.matrix(marg.multiply(a, b)) == pytest.approx(A @ B, abs=1e-14)
    assert marg.matrix(marg.conjugate(a)) == pytest.approx(A.T, abs=1e-14)
    turn = marg.turn_between(a, b)
    assert np.linalg.norm(turn) <= math.pi + 1e-12
    assert marg.matrix(near(a, turn)) == pytest.approx(B, abs=1e-12)


@pytest.mark.parametrize("axis", np.eye(3))
@pytest.mark.parametrize("angle", [0.0, 1e-13, 1e-9, 1e-5, 1.0, 3.1])
def test_a_turn_comes_back(axis, angle):
    assert marg.turn_between(ONE, marg.turned(angle * axis)) == pytest.approx(angle * axis, rel=1e-9, abs=1e-20)


def test_half_a_turn_keeps_its_digits():
    for axis in np.eye(3):
        R = 2.0 * np.outer(axis, axis) - np.eye(3)
        assert marg.matrix(marg.from_matrix(R)) == pytest.approx(R, abs=1e-15)


# ------------------------------------------------------------ references


@given(angles, pitches, angles, dips)
@settings(max_examples=60, deadline=None)
def test_at_the_true_tilt_both_references_are_the_field_whatever_the_yaw(roll, pitch, yaw, dip):
    p, _, _ = measured(roll, pitch, yaw, dip)
    want = (math.cos(dip), 0.0, math.sin(dip))
    assert marg.direct_reference(p) == pytest.approx(want, abs=1e-13)
    for other in (yaw, yaw + 1.0, 0.0):
        q = marg.from_matrix(body_from_earth(roll, pitch, other).T)
        assert marg.dynamic_reference(q, p) == pytest.approx(want, abs=1e-13)


def test_a_tilt_error_goes_into_the_dynamic_reference_alone():
    """Fact 1: about magnetic east it is the inclination's error, degree for degree."""
    p, _, _ = measured(0.3, -0.2, 1.0, math.radians(66.0))
    q, off = marg.closed_form(p), math.radians(5.0)
    x, _, z = marg.dynamic_reference(near(q, (0.0, off, 0.0)), p)
    assert abs(math.degrees(math.atan2(z, x)) - 66.0) == pytest.approx(5.0, abs=1e-9)


@pytest.mark.parametrize("declination", [-0.4, 0.0, 0.2])
@pytest.mark.parametrize("dynamic", REFERENCES)
def test_beta_turns_magnetic_north_to_its_azimuth(declination, dynamic):
    p, _, _ = measured(0.2, 0.1, 1.0, 1.0)
    want = marg.closed_form(p, declination)
    assert euler_from_quaternion(*want) == pytest.approx((0.2, 0.1, 1.0 + declination), abs=1e-12)
    got = marg.solve(near(want, (0.3, 0.2, -0.4)), p, marg.gauss_newton, dynamic=dynamic, north_rad=declination)
    assert apart(got.q, want) < 1e-12


def test_specific_force_taken_for_down_gives_the_attitude_upside_down():
    """The trap of M6: 10, 5, 40 degrees become -170, -5, 320."""
    _, force, field = measured(*np.radians((10.0, 5.0, 40.0, 66.0)))
    q = marg.closed_form(marg.pair(-force, field))
    assert np.degrees(euler_from_quaternion(*q)) == pytest.approx((-170.0, -5.0, -40.0), abs=1e-10)


# ------------------------------------------------------------ error and Jacobian


@given(angles, pitches, angles, dips, st.integers(0, 2**31))
@settings(max_examples=40, deadline=None)
def test_jacobian_against_finite_differences(roll, pitch, yaw, dip, seed):
    """Of q v q* as it stands: the four parts of q are moved one by one, q is not made unit again."""
    p, _, _ = measured(roll, pitch, yaw, dip)
    q = marg.unit(np.random.default_rng(seed).normal(size=4))

    def turned(at, v):
        vector = np.concatenate(((0.0,), v))
        return marg.multiply(marg.multiply(at, vector), marg.conjugate(at))[1:]

    J, h = marg.jacobian(q, p), 1e-6
    for k in range(4):
        ahead, back = q.copy(), q.copy()
        ahead[k] += h
        back[k] -= h
        for rows, v in ((slice(0, 3), p.down_b), (slice(3, 6), p.field_b)):
            assert J[rows, k] == pytest.approx((turned(ahead, v) - turned(back, v)) / (2.0 * h), abs=1e-8)


def test_jacobian_has_full_rank_but_at_the_pole():
    for dip in (0.0, 40.0, 66.0, 88.0):
        p, _, _ = measured(0.4, -0.3, 2.0, math.radians(dip))
        s = math.sin(math.radians(dip))
        want = sorted((2 * math.sqrt(2), 2 * math.sqrt(2), 2 * math.sqrt(1 + s), 2 * math.sqrt(1 - s)))
        got = np.linalg.svd(marg.jacobian(marg.closed_form(p), p), compute_uv=False)
        assert sorted(got) == pytest.approx(want, abs=1e-12)


@pytest.mark.parametrize("dynamic", REFERENCES)
def test_the_residual_is_zero_at_the_answer_and_so_cannot_show_a_disturbance(dynamic):
    p, _, field = measured(0.4, -0.3, 2.0, 1.0)
    disturbed = marg.pair(-9.8 * p.down_b, field + np.array((300.0, -200.0, 100.0)))
    q = marg.closed_form(disturbed)
    assert marg.error(q, disturbed, reference(q, disturbed, dynamic)) == pytest.approx(np.zeros(6), abs=1e-14)


# ------------------------------------------------------------ equivalence


@pytest.mark.parametrize("seed", range(8))
def test_both_references_both_solvers_and_the_closed_form_are_one(seed):
    """Fact 2, on noisy data: 5 % of each vector's length."""
    rng = np.random.default_rng(seed)
    roll, pitch, yaw = rng.uniform(-1.0, 1.0, 3) * (3.1, 1.4, 3.1)
    p, force, field = measured(roll, pitch, yaw, math.radians(rng.uniform(-70.0, 70.0)), 0.05, rng)
    q = marg.closed_form(p)
    start = near(q, math.radians(45.0) * marg.unit(rng.normal(size=3)))
    for dynamic in REFERENCES:
        for step in (marg.gauss_newton, partial(marg.descend, mu=0.2)):
            got = marg.solve(start, p, step, dynamic=dynamic)
            assert got.settled
            assert apart(got.q, q) < 1e-12
    tilt = tilt_from_force(force)
    got = euler_from_quaternion(*q)
    assert got[:2] == pytest.approx(tilt, abs=1e-12)  # the tilt is the accelerometer's, whatever the field
    assert math.remainder(got[2] - magnetic_heading(field, *tilt), math.tau) == pytest.approx(0.0, abs=1e-12)


@given(angles, pitches, angles, dips, angles)
@settings(max_examples=40, deadline=None)
def test_turning_the_vehicle_about_down_turns_the_yaw_and_nothing_else(roll, pitch, yaw, dip, more):
    one, other = (marg.closed_form(measured(roll, pitch, y, dip)[0]) for y in (yaw, yaw + more))
    assert apart(near(one, (0.0, 0.0, more)), other) < 1e-12


# ------------------------------------------------------------ rates


def modes(dip):
    """The three small turns, earth axes, that a step only shrinks: about east, a + m (slow) and a - m (fast)."""
    m, a = np.array((math.cos(dip), 0.0, math.sin(dip))), np.array((0.0, 0.0, 1.0))
    return {"east": np.array((0.0, 1.0, 0.0)), "slow": marg.unit(a + m), "fast": marg.unit(a - m)}


def shrinkage(step, p, dynamic, direction):
    q, small = marg.closed_form(p), 1e-5
    left = marg.turn_between(q, stepped(step, near(q, small * direction), p, dynamic)) / small
    assert left - (left @ direction) * direction == pytest.approx(np.zeros(3), abs=1e-4)
    return left @ direction


@pytest.mark.parametrize("dip_deg", [20.0, 66.0])
@pytest.mark.parametrize("mu", [0.05, 0.2, 0.28])
@pytest.mark.parametrize("dynamic", REFERENCES)
def test_rates_of_gradient_descent(dip_deg, mu, dynamic):
    """Fact 3. Negative: it oversteps; beyond -1 it runs away (direct from mu = 1/4)."""
    dip = math.radians(dip_deg)
    p, _, _ = measured(0.4, -0.3, 2.0, dip)
    s, step = math.sin(dip), partial(marg.descend, mu=mu)
    want = {"east": 1.0 if dynamic else 2.0, "fast": 1.0 + s, "slow": 1.0 - s}
    for name, direction in modes(dip).items():
        assert shrinkage(step, p, dynamic, direction) == pytest.approx(1.0 - 4.0 * mu * want[name], abs=1e-4)


@pytest.mark.parametrize("dip_deg", [20.0, 66.0])
def test_gauss_newton_halves_a_tilt_about_east_under_the_dynamic_reference_alone(dip_deg):
    """It takes the reference for a constant, but half of the error is in the reference."""
    dip = math.radians(dip_deg)
    p, _, _ = measured(0.4, -0.3, 2.0, dip)
    for dynamic in REFERENCES:
        for name, direction in modes(dip).items():
            want = 0.5 if dynamic and name == "east" else 0.0
            assert shrinkage(marg.gauss_newton, p, dynamic, direction) == pytest.approx(want, abs=1e-4)


@pytest.mark.parametrize("seed", range(12))
def test_gauss_newton_from_45_degrees_off(seed):
    """Five steps with the direct reference; with the dynamic one each step halves what is left."""
    rng = np.random.default_rng(100 + seed)
    roll, pitch, yaw = rng.uniform(-1.0, 1.0, 3) * (3.1, 1.4, 3.1)
    p, _, _ = measured(roll, pitch, yaw, math.radians(rng.uniform(-70.0, 70.0)), 0.03, rng)
    q = marg.closed_form(p)
    start = near(q, math.radians(45.0) * marg.unit(rng.normal(size=3)))
    assert apart(marg.solve(start, p, marg.gauss_newton, limit=5).q, q) < 1e-9
    left, at = [], start
    for _ in range(16):
        at = stepped(marg.gauss_newton, at, p, dynamic=True)
        left.append(apart(at, q))
    assert left[-1] / left[-2] == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("off_deg", [-10.0, 4.0])
def test_an_inclination_held_fixed_and_wrong_tilts_by_half_and_turns_nothing(off_deg):
    """Fact 4: why the reference is taken from the measurement."""
    dip, off = math.radians(60.0), math.radians(off_deg)
    p, _, _ = measured(0.4, -0.3, 2.0, dip)
    wrong = np.array((math.cos(dip + off), 0.0, math.sin(dip + off)))
    q = marg.closed_form(p)
    for _ in range(60):
        q = marg.gauss_newton(q, marg.jacobian(q, p), marg.error(q, p, wrong))
    turn = marg.turn_between(marg.closed_form(p), q)
    assert np.abs(turn) == pytest.approx((0.0, abs(off) / 2.0, 0.0), abs=1e-9)


def test_a_normalised_gradient_hops_for_ever_between_two_points():
    """Fact 5: half a step to either side of the answer; its mean part is (mu / 2) 4 / (3 pi) over all attitudes."""
    mu, rng, parts = 0.2, np.random.default_rng(3), []
    step = partial(marg.descend_normalised, mu=mu)
    for _ in range(40):
        roll, pitch, yaw = rng.uniform(-1.0, 1.0, 3) * (3.1, 1.4, 3.1)
        p, _, _ = measured(roll, pitch, yaw, math.radians(66.0))
        q = marg.closed_form(p)
        at = near(q, 0.2 * rng.normal(size=3))
        for _ in range(400):
            at = stepped(step, at, p, dynamic=False)
        there = stepped(step, at, p, dynamic=False)
        back = stepped(step, there, p, dynamic=False)
        assert apart(back, at) < 1e-3
        assert apart(at, q) == pytest.approx(mu / 2.0, rel=0.02)
        assert apart(there, q) == pytest.approx(mu / 2.0, rel=0.02)
        parts.append(np.abs(marg.aligned(at, q) - q).mean())
    assert np.mean(parts) == pytest.approx(mu / 2.0 * 4.0 / (3.0 * math.pi), rel=0.06)


# ------------------------------------------------------------ refusals


@pytest.mark.parametrize("dip_deg", [90.0, -90.0, 88.5, -89.0])
def test_the_pole_is_refused(dip_deg):
    assert measured(0.4, -0.3, 2.0, math.radians(dip_deg))[0] is None


def test_just_off_the_pole_it_still_works():
    p, _, _ = measured(0.4, -0.3, 2.0, math.radians(88.0))
    assert euler_from_quaternion(*marg.closed_form(p)) == pytest.approx((0.4, -0.3, 2.0), abs=1e-10)


@pytest.mark.parametrize(
    ("force", "field"),
    [
        ((1.0, 2.0, 3.0), (-2.0, -4.0, -6.0)),
        ((1.0, 2.0, 3.0), (1.0, 2.0, 3.0)),
        ((0.0, 0.0, 0.0), (1.0, 2.0, 3.0)),
        ((1.0, 2.0, 3.0), (0.0, 0.0, 0.0)),
        ((math.nan, 0.0, 1.0), (1.0, 2.0, 3.0)),
        ((0.0, 0.0, 1.0), (math.inf, 2.0, 3.0)),
    ],
)
def test_parallel_missing_and_broken_vectors_are_refused(force, field):
    assert marg.pair(np.array(force), np.array(field)) is None


@given(angles, pitches, angles, st.floats(0.031, 3.1))
@settings(max_examples=60, deadline=None)
def test_the_sine_keeps_its_digits_near_the_pole(roll, pitch, yaw, angle):
    p, _, _ = measured(roll, pitch, yaw, math.pi / 2.0 - angle)
    assert p.sine == pytest.approx(math.sin(angle), rel=1e-12)
    assert p.cosine == pytest.approx(math.cos(angle), abs=1e-13)
