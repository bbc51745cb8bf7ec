"""The conic form of Sytnyk's soft iron in the level plane: exact, indifferent to axes, honest, right in its heading."""

import numpy as np
import pytest
from figures import fitted, fitter, ring, rotation, taught
from hypothesis import given, settings
from hypothesis import strategies as st
from seed_vectors import load

from magmav.core.estimators import ESTIMATORS
from magmav.core.estimators.fit import Refusal
from magmav.core.heading import magnetic_heading

SEED = load()["ellipse"]
SOFT = np.array([[1.2, 0.2], [0.2, 0.8]])  # the example of the reference: what the iron does to the field
IRON = np.array([310.0, -120.0])


def headings(points):
    return np.degrees(np.arctan2(-points[:, 1], points[:, 0])) % 360.0


def distorted(n=400, noise=0.0, seed=0, degrees=360.0, soft=SOFT, radius=200.0):
    """The true points (n, 2), and what the sensor sees."""
    true = ring(n, radius, degrees=degrees, seed=seed)
    return true, true @ soft.T + IRON + np.random.default_rng(seed + 1).normal(0.0, noise, (n, 2))


def test_the_ellipse_of_the_reference():
    got = fitted("ellipse", SEED["points"])
    assert got.centre == pytest.approx(SEED["centre"], abs=1e-9)
    assert got.matrix / got.radius == pytest.approx(np.array(SEED["W"]), abs=1e-15)
    unit = (np.array(SEED["points"]) - got.centre) @ (got.matrix / got.radius).T
    assert unit == pytest.approx(np.array(SEED["unit_after"]), abs=1e-12)
    away = (headings(unit) - SEED["headings_deg"] + 180.0) % 360.0 - 180.0
    assert np.abs(away).max() < 1e-10


def test_without_noise_the_iron_comes_back_and_mg_stay_mg():
    true, seen = distorted()
    got = fitted("ellipse", seen)
    assert got.centre == pytest.approx(IRON, abs=1e-7)
    assert np.linalg.det(got.matrix) == pytest.approx(1.0)
    assert got.matrix == pytest.approx(got.matrix.T)
    assert got.matrix @ SOFT == pytest.approx(np.eye(2) * np.sqrt(np.linalg.det(SOFT)), abs=1e-9)
    assert got.radius == pytest.approx(200.0 * np.sqrt(np.linalg.det(SOFT)))
    assert np.abs(headings((seen - got.centre) @ got.matrix.T) - headings(true)).max() < 1e-6


def batch(points):
    """The same regression on the plain design matrix by numpy's least squares: centre and unit-circle matrix."""
    middle, size = points.mean(0), points.std()
    u, v = ((points - middle) / size).T
    design = np.column_stack((u * u - v * v, 2 * u * v, 2 * u, 2 * v, np.ones_like(u)))
    p = np.linalg.lstsq(design, u * u + v * v, rcond=None)[0]
    G = np.array([[1 - p[0], -p[1]], [-p[1], 1 + p[0]]])
    c = np.linalg.solve(G, p[2:4])
    Q = G / (p[4] + c @ G @ c) / size**2
    root = np.sqrt(np.linalg.det(Q))
    return middle + size * c, (Q + root * np.eye(2)) / np.sqrt(np.trace(Q) + 2 * root)


@pytest.mark.parametrize("offset", [0.0, 2000.0, 2e7])
def test_streaming_equals_batch(offset):
    points = distorted(600, noise=4.0)[1] + offset
    centre, to_unit = batch(points)
    got = fitted("ellipse", points)
    assert got.centre == pytest.approx(centre, rel=0.0, abs=2e-7 + 1e-12 * offset)
    assert got.matrix / got.radius == pytest.approx(to_unit, abs=1e-9 * np.abs(to_unit).max())


@settings(max_examples=20, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.floats(-3.0, 3.0),
    st.tuples(*[st.floats(-3000.0, 3000.0)] * 2),
    st.floats(1e-3, 1e3),
)
def test_the_answer_turns_shifts_and_grows_with_the_points(seed, angle, shift, factor):
    points, turn = distorted(60, noise=6.0, seed=seed)[1], rotation(2, angle)
    here = fitted("ellipse", points)
    there = fitted("ellipse", factor * (points @ turn.T + shift), 200.0 * factor)
    assert there.centre / factor == pytest.approx(turn @ here.centre + shift, abs=1e-6)
    assert there.matrix == pytest.approx(turn @ here.matrix @ turn.T, abs=1e-9)
    assert there.radius / factor == pytest.approx(here.radius, rel=1e-9)
    assert there.covariance / factor**2 == pytest.approx(turn @ here.covariance @ turn.T, abs=1e-5)


def test_two_halves_merged_are_the_whole_and_forgetting_follows():
    points = distorted(400, noise=4.0)[1]
    halves = [fitter("ellipse", 2) for _ in range(2)]
    for f, part in zip(halves, (points[:90], points[90:]), strict=True):
        for p in part:
            f.add(p)
    both, whole = halves[0].then(halves[1]).fit(), fitted("ellipse", points)
    assert both.centre == pytest.approx(whole.centre, abs=1e-7)
    assert both.matrix == pytest.approx(whole.matrix, abs=1e-9)
    moved = np.vstack((points, distorted(400, seed=5)[1] + 50.0))
    assert fitted("ellipse", moved, forget=0.95).centre == pytest.approx(IRON + 50.0, abs=0.1)


@pytest.mark.parametrize(("degrees", "worst_deg"), [(360.0, 0.1), (270.0, 0.3)])
def test_heading_error_at_one_percent_of_noise(degrees, worst_deg):
    """The reference: 0.05 degrees on a whole turn, 0.08 on three quarters, with 1800 points."""
    worst = []
    for seed in range(2):
        seen = distorted(1800, noise=2.0, seed=seed, degrees=degrees)[1]
        got = fitted("ellipse", seen)
        everywhere = ring(400, seed=9)
        error = headings((everywhere @ SOFT.T + IRON - got.centre) @ got.matrix.T) - headings(everywhere)
        worst.append(np.abs((error + 180.0) % 360.0 - 180.0).max())
    assert np.mean(worst) < worst_deg


@pytest.mark.parametrize("degrees", [360.0, 240.0])
def test_the_claimed_covariance_of_the_centre_is_honest(degrees):
    squares = []
    for seed in range(40):
        got = fitted("ellipse", distorted(150, noise=3.0, seed=seed, degrees=degrees)[1])
        if got is Refusal.ARC_TOO_SHORT:
            continue
        error = got.centre - IRON
        squares.append(error @ np.linalg.solve(got.covariance, error) / 2.0)
    assert len(squares) > 25
    assert 0.7 < np.sqrt(np.mean(squares)) < 1.2


def test_a_turn_of_the_sensor_cannot_be_found():
    """A = P O: the ellipse shows P, and O stays as a constant heading offset (6.01 degrees for this A)."""
    skew = np.array([[1.0, 0.3], [0.1, 0.9]])
    true, seen = distorted(soft=skew)
    got = fitted("ellipse", seen)
    left = (headings((seen - got.centre) @ got.matrix.T) - headings(true) + 180.0) % 360.0 - 180.0
    assert left == pytest.approx(np.full(len(true), left[0]), abs=1e-6)
    assert abs(left[0]) == pytest.approx(6.01, abs=0.01)


def test_the_estimator_corrects_the_heading_at_a_steady_lean():
    """Levelled points; the centre and the matrix are taken back to body axes with the lean."""
    roll, pitch = 0.15, -0.1
    to_level = np.array([[np.cos(pitch), np.sin(pitch) * np.sin(roll), np.sin(pitch) * np.cos(roll)],
                         [0.0, np.cos(roll), -np.sin(roll)],
                         [-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)]])  # fmt: skip
    true, seen = distorted(300)
    level = np.column_stack((seen, np.full(300, 430.0)))
    body = level @ to_level  # its inverse is its transpose
    got = taught(ESTIMATORS["ellipse"](), body, roll, pitch).estimate(None)
    corrected = (body - got.hard_iron_b_mg) @ got.soft_iron_b.T
    for m, t in zip(corrected[::20], true[::20], strict=True):
        expected = np.arctan2(-t[1], t[0]) % (2 * np.pi)
        assert magnetic_heading(m, roll, pitch) == pytest.approx(expected, abs=1e-8)
    assert np.linalg.det(got.soft_iron_b) == pytest.approx(1.0)
    assert np.abs(np.diag(to_level @ got.covariance_mg2 @ to_level.T)[:2]).max() < 0.01
    assert got.own_sigma_mg[2] > 900.0
