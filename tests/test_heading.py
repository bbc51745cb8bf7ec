"""Heading and its sigma: the seed papers' numbers, and what many noisy fields really do."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from seed_vectors import load
from synthetic_flight import turn

from magmav.core.heading import heading, heading_sigma, magnetic_heading
from magmav.core.types import vec3

SEED = load()


@pytest.mark.parametrize("case", SEED["tilt"], ids=lambda c: f"{c['roll']}/{c['pitch']}/{c['psi']}")
def test_heading_of_the_seed_attitudes(case):
    field = 500.0 * np.array(case["m_unit"])
    got = magnetic_heading(field, math.radians(case["roll"]), math.radians(case["pitch"]))
    assert got is not None
    assert math.remainder(math.degrees(got) - case["psi"], 360.0) == pytest.approx(0.0, abs=1e-10)


@pytest.mark.parametrize("case", SEED["heading_hxhy"], ids=lambda c: f"{c['psi']:g}")
def test_heading_of_level_fields(case):
    got = magnetic_heading(np.array([case["hx"], case["hy"], 0.7]), 0.0, 0.0)
    assert math.degrees(got or 0.0) == pytest.approx(case["psi"], abs=1e-12)


@given(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(0.0, 6.28), st.floats(-1.0, 1.0))
def test_heading_is_yaw_less_declination_at_any_tilt(roll, pitch, yaw, declination):
    earth = 200.0 * np.array([math.cos(declination), math.sin(declination), 2.1])
    body = turn(0, roll) @ turn(1, pitch) @ turn(2, yaw) @ earth
    got = heading(vec3(body, "field"), roll, pitch, 0.01, declination)
    assert got.valid
    assert got.true_valid
    assert math.remainder(got.magnetic_rad - (yaw - declination), math.tau) == pytest.approx(0.0, abs=1e-9)
    assert math.remainder(got.true_rad - yaw, math.tau) == pytest.approx(0.0, abs=1e-9)
    assert 0.0 <= got.magnetic_rad < math.tau
    assert 0.0 <= got.true_rad < math.tau


def test_without_declination_the_heading_is_magnetic_only():
    got = heading(vec3((100, -100, 300), "field"), 0.0, 0.0, 0.02, None)
    assert (got.valid, got.true_valid) == (True, False)
    assert math.degrees(got.magnetic_rad) == pytest.approx(45.0)
    assert got.sigma_rad == 0.02


def test_near_a_magnetic_pole_there_is_no_heading():
    assert magnetic_heading(np.array([0.0, 0.0, 600.0]), 0.0, 0.0) is None
    assert not heading(vec3((14, 14, 600), "field"), 0.0, 0.0, 0.0, 0.1).valid
    assert heading(vec3((15, 15, 600), "field"), 0.0, 0.0, 0.0, 0.1).valid


COVARIANCES = {
    "round": np.diag([16.0, 16.0, 16.0]),
    "x only": np.diag([64.0, 0.0, 0.0]),
    "z only": np.diag([0.0, 0.0, 100.0]),
    "leaning": np.array([[30.0, 12.0, -8.0], [12.0, 20.0, 15.0], [-8.0, 15.0, 60.0]]),
}


@pytest.mark.parametrize(("roll_deg", "pitch_deg"), [(0, 0), (25, -10), (-40, 15)])
@pytest.mark.parametrize("name", COVARIANCES)
def test_heading_sigma_is_the_scatter_of_many_headings(name, roll_deg, pitch_deg):
    """4000 offset errors over all headings, through the heading itself. 4000 draws know a sigma to 1.1 %."""
    r, n = np.random.default_rng(7), 4000
    roll, pitch = math.radians(roll_deg), math.radians(pitch_deg)
    errors = r.multivariate_normal(np.zeros(3), COVARIANCES[name], n)
    yaws = r.uniform(0.0, math.tau, n)
    tilt = turn(0, roll) @ turn(1, pitch)
    off = []
    for yaw, error in zip(yaws, errors, strict=True):
        body = tilt @ turn(2, yaw) @ np.array([205.0, 0.0, 430.0]) + error
        off.append(math.remainder((magnetic_heading(body, roll, pitch) or 0.0) - yaw, math.tau))
    claimed = heading_sigma(COVARIANCES[name], 205.0, 430.0, roll, pitch, 0.0)
    if claimed == 0.0:
        assert max(map(abs, off)) < 1e-12
    else:
        assert np.std(off) == pytest.approx(claimed, rel=0.06)


def test_heading_sigma_of_tilt_is_the_tangent_of_the_dip():
    """One axis of tilt error in four thousand headings: crosswise to the heading it counts fully."""
    r, sigma = np.random.default_rng(8), math.radians(0.7)
    off = []
    for yaw, roll, pitch in zip(r.uniform(0, math.tau, 4000), *r.normal(0, sigma, (2, 4000)), strict=True):
        body = turn(2, yaw) @ np.array([205.0, 0.0, 430.0])
        off.append(math.remainder((magnetic_heading(body, roll, pitch) or 0.0) - yaw, math.tau))
    assert np.std(off) == pytest.approx(heading_sigma(np.zeros((3, 3)), 205.0, 430.0, 0, 0, sigma), rel=0.06)


def test_heading_sigma_never_passes_half_a_turn():
    assert heading_sigma(np.eye(3) * 1e8, 1.0, 500.0, 0.0, 0.0, 0.1) == math.pi
    assert heading_sigma(np.eye(3) * 1e8, 0.0, 500.0, 0.0, 0.0, 0.1) == math.pi
