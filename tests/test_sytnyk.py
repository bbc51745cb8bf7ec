"""The printed chain of Sytnyk et al.: what its equations give, and the errors the reference says it cannot lose."""

import numpy as np
import pytest
from figures import fitted, ring, rotation, taught
from hypothesis import given, settings
from hypothesis import strategies as st
from test_ellipse import IRON, SOFT, distorted, headings

from magmav.core.estimators import ESTIMATORS
from magmav.core.estimators.fit import Refusal
from magmav.core.estimators.sytnyk import offset_and_scale, turn_and_rescale


def circle(n=720, radius=200.0):
    a = np.linspace(0.0, 2 * np.pi, n, endpoint=False)
    return radius * np.stack((np.cos(a), np.sin(a)), 1)


def errors(points, true, centre, matrix):
    return (headings((points - centre) @ matrix.T) - headings(true) + 180.0) % 360.0 - 180.0


def test_offset_and_scale_make_a_unit_circle_of_a_stretched_one():
    """Equations (1) to (3) alone: right for soft iron along the axes."""
    true = circle()
    points = true * (1.3, 0.8) + IRON
    offset, half = offset_and_scale(points)
    assert offset == pytest.approx(IRON, abs=1e-9)
    assert np.linalg.norm((points - offset) / half, axis=1) == pytest.approx(np.ones(720), abs=1e-9)


def test_after_scaling_the_axes_always_lie_at_45_degrees():
    """Finding 2 of the reference: the bounding box is square, so the angle carries no information."""
    for angle in (0.1, 0.4, 0.7, 1.2):
        turn = rotation(2, angle)
        points = circle() @ (turn @ np.diag([1.3, 0.8]) @ turn.T)
        offset, half = offset_and_scale(points)
        real = (points - offset) / half
        far = real[np.argmax((real**2).sum(1))]
        assert abs(np.degrees(np.arctan2(far[1], far[0]))) % 90.0 == pytest.approx(45.0, abs=0.5)


def test_the_chain_makes_a_circle_and_leaves_a_constant_heading_error():
    """Finding 3: -2.288 degrees measured, -1/2 (A11 - A22) A12 / mean^2 = -2.292 predicted."""
    true = circle(20_000)
    points = true @ SOFT.T + IRON
    centre, matrix = turn_and_rescale(points)
    assert centre == pytest.approx(IRON, abs=1e-9)
    assert np.linalg.norm((points - centre) @ matrix.T, axis=1) == pytest.approx(np.ones(20_000), abs=1e-4)
    left = errors(points, true, centre, matrix)
    predicted = np.degrees(0.5 * (SOFT[0, 0] - SOFT[1, 1]) * SOFT[0, 1] / (np.trace(SOFT) / 2) ** 2)
    assert np.ptp(left) < 0.05
    assert abs(left.mean()) == pytest.approx(2.288, abs=0.01)
    assert abs(left.mean()) == pytest.approx(predicted, abs=0.01)
    conic = fitted("ellipse", points)
    assert np.abs(errors(points, true, conic.centre, conic.matrix)).max() < 1e-6


def test_one_farthest_point_is_noisier_than_all_of_them():
    """Finding 5, as scatter of the heading: the printed chain against the conic on the same points."""
    spread = {"sytnyk": [], "ellipse": []}
    for seed in range(10):
        points = distorted(400, noise=4.0, seed=seed)[1]
        for method, rows in spread.items():
            got = fitted(method, points)
            left = errors(ring(50, seed=1) @ SOFT.T + IRON, ring(50, seed=1), got.centre, got.matrix)
            rows.append(left)
    scatter = {m: np.std(rows, axis=0).mean() for m, rows in spread.items()}
    assert scatter["sytnyk"] > 4.0 * scatter["ellipse"]


def test_the_extremes_kept_while_streaming_are_enough():
    """64 directions: the answer of all points at once to a thousandth of the radius."""
    points = distorted(2000, seed=4)[1]
    got = fitted("sytnyk", points)
    centre, matrix = turn_and_rescale(points)
    assert got.centre == pytest.approx(centre, abs=0.2)
    assert got.matrix / got.radius == pytest.approx(matrix, abs=2e-3 * np.abs(matrix).max())
    assert np.linalg.det(got.matrix) == pytest.approx(1.0)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 3), st.tuples(*[st.floats(-2e3, 2e3)] * 2), st.floats(1e-3, 1e3))
def test_quarter_turns_shifts_and_scale_carry_over(seed, quarters, shift, factor):
    """Only quarter turns: bounding box and farthest point belong to the axes."""
    points, turn = distorted(120, noise=2.0, seed=seed)[1], rotation(2, quarters * np.pi / 2)
    here, there = turn_and_rescale(points), turn_and_rescale(factor * (points @ turn.T + shift))
    assert there[0] / factor == pytest.approx(turn @ here[0] + shift, abs=1e-6)
    assert there[1] * factor == pytest.approx(turn @ here[1] @ turn.T, abs=1e-8)


def test_two_thirds_of_a_turn_are_needed():
    assert fitted("sytnyk", distorted(300, degrees=200.0)[1]) is Refusal.ARC_TOO_SHORT
    assert not isinstance(fitted("sytnyk", distorted(300, degrees=300.0)[1]), Refusal)


def test_the_residual_is_what_is_left_of_the_circle():
    points = distorted(600, noise=5.0, seed=6)[1]
    got = fitted("sytnyk", points)
    misfits = np.array([got.misfit(p) for p in points])
    assert got.residual == pytest.approx(np.sqrt(np.mean(misfits**2)), rel=0.1)


def test_the_estimator_corrects_what_the_chain_can():
    """Soft iron along the sensor's axes, level turns: within two degrees, where hard iron alone leaves fourteen."""
    true = circle(400)
    level = np.column_stack((true * (1.3, 0.8) + IRON, np.full(400, 430.0)))
    worst = {}
    for name in ("sytnyk", "bullock_level"):
        got = taught(ESTIMATORS[name](), level).estimate(None)
        corrected = (level - got.hard_iron_b_mg) @ got.soft_iron_b.T
        worst[name] = np.abs((headings(corrected) - headings(true) + 180.0) % 360.0 - 180.0).max()
    assert worst["sytnyk"] < 2.0
    assert worst["bullock_level"] == pytest.approx(np.degrees(np.arcsin(0.5 / 2.1)), abs=1.0)
