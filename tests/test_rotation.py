"""Rotations against quaternion algebra, finite differences and the seed papers' numbers."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from seed_vectors import load

from magmav.core.rotation import (
    body_from_earth,
    euler_from_quaternion,
    euler_rates,
    level_from_body,
    tilt_angle,
    tilt_from_force,
    wrap_pi,
    wrap_tau,
)

SEED = load()
ANGLE = st.floats(-math.pi, math.pi)
STEEP = st.floats(-1.5, 1.5)


def times(p, q):
    """Hamilton product."""
    a, b, c, d = p
    e, f, g, h = q
    return np.array(
        [a * e - b * f - c * g - d * h, a * f + b * e + c * h - d * g, a * g - b * h + c * e + d * f,
         a * h + b * g - c * f + d * e]
    )  # fmt: skip


def quaternion(roll, pitch, yaw):
    """Body to earth, as three turns about single axes."""
    z = (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
    y = (math.cos(pitch / 2), 0.0, math.sin(pitch / 2), 0.0)
    x = (math.cos(roll / 2), math.sin(roll / 2), 0.0, 0.0)
    return times(times(z, y), x)


def turned(q, v):
    back = q * (1, -1, -1, -1)
    return times(times(q, (0.0, *v)), back)[1:]


@given(ANGLE, STEEP, ANGLE)
def test_body_from_earth_is_the_inverse_of_the_quaternion(roll, pitch, yaw):
    q = quaternion(roll, pitch, yaw)
    for v in np.eye(3):
        assert body_from_earth(roll, pitch, yaw) @ turned(q, v) == pytest.approx(v, abs=1e-14)


@given(ANGLE, STEEP)
def test_levelling_undoes_roll_and_pitch_but_not_yaw(roll, pitch):
    q = quaternion(roll, pitch, 0.0)
    v = np.array([0.3, -0.5, 0.8])
    assert level_from_body(roll, pitch) @ v == pytest.approx(turned(q, v), abs=1e-14)
    assert level_from_body(roll, pitch) @ level_from_body(roll, pitch).T == pytest.approx(np.eye(3), abs=1e-15)


@given(ANGLE, STEEP, ANGLE, st.floats(0.6, 1.9), st.sampled_from((1.0, -1.0)))
def test_euler_from_quaternion_inverts_and_ignores_length_and_sign(roll, pitch, yaw, length, sign):
    got = euler_from_quaternion(*(sign * length * quaternion(roll, pitch, yaw)))
    assert got is not None
    assert got[1] == pytest.approx(pitch, abs=1e-7)
    assert wrap_pi(got[0] - roll) == pytest.approx(0.0, abs=1e-9)
    assert wrap_pi(got[2] - yaw) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("q", [(0, 0, 0, 0), (0.1, 0, 0, 0), (9, 0, 0, 0), (math.nan, 0, 0, 1), (math.inf, 0, 0, 0)])
def test_what_is_no_rotation_gives_none(q):
    assert euler_from_quaternion(*q) is None


def test_quaternion_of_the_marg_paper():
    m = SEED["marg"]
    assert quaternion(*(math.radians(m[k]) for k in ("roll", "pitch", "yaw"))) == pytest.approx(m["q_true"], abs=1e-12)
    got = euler_from_quaternion(*m["q_true"])
    assert [math.degrees(a) for a in got or ()] == pytest.approx([m["roll"], m["pitch"], m["yaw"]], abs=1e-10)
    c_bn = body_from_earth(*(got or (0, 0, 0)))
    assert c_bn @ m["mref"] == pytest.approx(m["m_body"], abs=1e-12)


@given(ANGLE, st.floats(-1.4, 1.4), st.tuples(STEEP, STEEP, STEEP))
def test_euler_rates_are_the_slope_of_the_turned_attitude(roll, pitch, rate):
    """Turn by the rate for a moment about body axes and compare the angles."""
    h = 1e-6
    half = np.array(rate) * h / 2
    after = times(quaternion(roll, pitch, 0.3), (1.0, *half))
    before = times(quaternion(roll, pitch, 0.3), (1.0, *-half))
    a, b = euler_from_quaternion(*after), euler_from_quaternion(*before)
    slope = [wrap_pi(x - y) / (2 * h) for x, y in zip(a or (), b or (), strict=True)]
    assert euler_rates(roll, pitch, np.array(rate)) == pytest.approx(slope, abs=2e-6)


def test_euler_rates_stay_finite_at_the_singularity():
    for pitch in (math.pi / 2, -math.pi / 2, math.pi / 2 - 1e-9):
        assert max(abs(v) for v in euler_rates(0.3, pitch, np.array([1.0, 1.0, 1.0]))) < 40.0


@pytest.mark.parametrize("case", SEED["tilt"], ids=lambda c: f"{c['roll']}/{c['pitch']}/{c['psi']}")
def test_tilt_from_force_and_levelled_field_of_the_seed_papers(case):
    got = tilt_from_force(9.80665 * np.array(case["f_over_g"]))
    assert [math.degrees(a) for a in got or ()] == pytest.approx([case["roll"], case["pitch"]], abs=1e-10)
    level = level_from_body(*(got or (0, 0)))
    assert level @ case["m_unit"] == pytest.approx(case["h"], abs=1e-12)


def test_free_fall_has_no_tilt():
    assert tilt_from_force(np.zeros(3)) is None
    assert tilt_from_force(np.full(3, 1e-5)) is None


@given(ANGLE, STEEP)
def test_tilt_angle_is_the_angle_between_the_two_downs(roll, pitch):
    down = level_from_body(roll, pitch)[2]
    assert math.cos(tilt_angle(roll, pitch)) == pytest.approx(down[2], abs=1e-12)


def test_wrap_tables():
    for angle, want in SEED["wrap"]["wrap_360"]:
        assert math.degrees(wrap_tau(math.radians(angle))) == pytest.approx(want, abs=1e-12)
    for angle, want in SEED["wrap"]["wrap_180"]:
        assert math.degrees(wrap_pi(math.radians(angle))) == pytest.approx(want, abs=1e-12)


def test_the_edges_of_wrapping():
    assert wrap_tau(-1e-20) == 0.0
    assert wrap_tau(2 * math.pi) == 0.0
    assert wrap_pi(-math.pi) == math.pi
    assert wrap_pi(math.pi) == math.pi


@settings(max_examples=200)
@given(st.floats(-1e6, 1e6))
def test_wrapping_keeps_the_angle_and_its_range(angle):
    full, half = wrap_tau(angle), wrap_pi(angle)
    assert 0.0 <= full < 2 * math.pi
    assert -math.pi < half <= math.pi
    for got in (full, half):
        assert math.cos(got) == pytest.approx(math.cos(angle), abs=1e-9)
        assert math.sin(got) == pytest.approx(math.sin(angle), abs=1e-9)
