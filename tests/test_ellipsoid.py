"""Hard and soft iron in three dimensions: the right heading at any tilt, silence where the motion does not show it."""

from dataclasses import replace

import numpy as np
import pytest
from figures import ball, fitted, fitter, rotation, sample, seen_from, taught
from hypothesis import given, settings
from hypothesis import strategies as st

from magmav.core.channel import Channel, Circumstances
from magmav.core.estimators import ESTIMATORS
from magmav.core.field import ExpectedField
from magmav.core.gate import Limits
from magmav.core.heading import magnetic_heading
from magmav.core.types import Shaping, mat3, vec3

IRON = np.array([310.0, -140.0, 220.0])
SOFT = np.array([[1.15, 0.08, -0.05], [0.08, 0.9, 0.06], [-0.05, 0.06, 1.0]])  # what the iron does to the field
EARTH = np.array([205.0, 0.0, 430.0])  # magnetic north, so that heading is yaw


def attitudes(n, seed=0, tilt=np.pi):
    """Random attitudes: roll, pitch (n,) up to ``tilt``, yaw (n,) all round."""
    r = np.random.default_rng(seed)
    pitch = np.clip(r.uniform(-tilt, tilt, n), -1.4, 1.4)
    return r.uniform(-tilt, tilt, n), pitch, r.uniform(0.0, 2 * np.pi, n)


def distorted(n=200, noise=0.0, seed=0):
    """A whole ball through soft and hard iron, (n, 3)."""
    points = ball(n, seed=seed) @ SOFT.T + IRON
    return points + np.random.default_rng(seed + 1).normal(0.0, noise, points.shape)


def test_without_noise_the_iron_comes_back():
    got = fitted("ellipsoid", distorted())
    assert got.centre == pytest.approx(IRON, abs=1e-6)
    size = np.linalg.det(SOFT) ** (1 / 3)
    assert got.matrix @ SOFT == pytest.approx(np.eye(3) * size, abs=1e-8)
    assert np.linalg.det(got.matrix) == pytest.approx(1.0)
    assert got.radius == pytest.approx(476.0 * size)


def test_streaming_equals_the_quadric_through_all_points_at_once():
    """Written otherwise: a general quadric with constant term 1 by least squares has another weighting, so no noise."""
    points = distorted(80)
    u = (points - points.mean(0)) / 400.0
    x, y, z = u.T
    design = np.column_stack((x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, 2 * x, 2 * y, 2 * z))
    a = np.linalg.lstsq(design, np.ones(80), rcond=None)[0]
    G = np.array([[a[0], a[3], a[4]], [a[3], a[1], a[5]], [a[4], a[5], a[2]]])
    c = -np.linalg.solve(G, a[6:])
    Q = G / (1.0 + c @ G @ c)
    got = fitted("ellipsoid", points)
    assert got.centre == pytest.approx(points.mean(0) + 400.0 * c, abs=1e-6)
    W = got.matrix / got.radius
    assert pytest.approx(Q / 400.0**2, abs=1e-9 * np.abs(Q).max() / 400.0**2) == W @ W


@settings(max_examples=15, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    st.tuples(*[st.floats(-3000.0, 3000.0)] * 3),
    st.floats(1e-3, 1e3),
)
def test_the_answer_turns_shifts_and_grows_with_the_points(seed, angles, shift, factor):
    points, turn = distorted(80, noise=6.0, seed=seed), rotation(3, *angles)
    here = fitted("ellipsoid", points)
    there = fitted("ellipsoid", factor * (points @ turn.T + shift), 200.0 * factor)
    assert there.centre / factor == pytest.approx(turn @ here.centre + shift, abs=1e-6)
    assert there.matrix == pytest.approx(turn @ here.matrix @ turn.T, abs=1e-9)
    assert there.covariance / factor**2 == pytest.approx(turn @ here.covariance @ turn.T, abs=1e-4)


def test_two_halves_merged_are_the_whole():
    points, halves = distorted(200, noise=4.0), [fitter("ellipsoid", 3) for _ in range(2)]
    for f, part in zip(halves, (points[:70], points[70:]), strict=True):
        for p in part:
            f.add(p)
    both, whole = halves[0].then(halves[1]).fit(), fitted("ellipsoid", points)
    assert both.centre == pytest.approx(whole.centre, abs=1e-6)
    assert both.matrix == pytest.approx(whole.matrix, abs=1e-9)


def test_the_claimed_covariance_of_the_centre_is_honest():
    squares = []
    for seed in range(40):
        got = fitted("ellipsoid", distorted(150, noise=6.0, seed=seed))
        error = got.centre - IRON
        squares.append(error @ np.linalg.solve(got.covariance, error) / 3.0)
    assert 0.7 < np.sqrt(np.mean(squares)) < 1.2


def test_a_vehicle_with_soft_iron_gets_the_right_heading_at_any_tilt():
    """A known soft iron through the estimator; its matrix is symmetric, so nothing stays hidden."""
    roll, pitch, yaw = attitudes(300)
    true = seen_from(roll, pitch, yaw, EARTH)
    seen = true @ SOFT.T + IRON
    got = taught(ESTIMATORS["ellipsoid"](), seen, roll, pitch).estimate(None)
    plain = taught(ESTIMATORS["bullock"](), seen, roll, pitch).estimate(None)
    roll, pitch, yaw = attitudes(60, seed=5, tilt=0.6)
    fresh = seen_from(roll, pitch, yaw, EARTH) @ SOFT.T + IRON
    errors = []
    for e in (got, plain):
        corrected = (fresh - e.hard_iron_b_mg) @ e.soft_iron_b.T
        away = [magnetic_heading(m, r, p) - y for m, r, p, y in zip(corrected, roll, pitch, yaw, strict=True)]
        errors.append(np.abs(np.remainder(np.array(away) + np.pi, 2 * np.pi) - np.pi).max())
    assert errors[0] < 1e-7
    assert errors[1] > np.radians(5.0)
    size = np.linalg.det(SOFT) ** (1 / 3)
    assert (got.horizontal_mg, got.down_mg) == pytest.approx((205.0 * size, 430.0 * size), abs=1e-4)


def test_the_channel_uses_the_matrix_for_field_and_heading():
    roll, pitch, yaw = attitudes(300, seed=2)
    seen = seen_from(roll, pitch, yaw, EARTH) @ SOFT.T + IRON
    here = Circumstances(ExpectedField(205.0, 430.0, 0.0), False, False, False, False, 0.0)
    channel = Channel(ESTIMATORS["ellipsoid"], Limits(10.0, np.radians(3.0), 30.0, 0.15, 15.0, 100), 10.0)
    taught(_Into(channel, here), seen, roll, pitch)
    last = replace(sample(seen[7], roll=roll[7], pitch=pitch[7]), boot_ns=40_000_000_000)
    finding = channel.step(last, vec3(seen[7], "sent"), here)
    size = np.linalg.det(SOFT) ** (1 / 3)
    true = seen_from(roll[7:8], pitch[7:8], yaw[7:8], EARTH)[0]
    assert finding.corrected_b_mg == pytest.approx(size * true, abs=1e-3)
    assert finding.heading.valid
    assert np.remainder(finding.heading.magnetic_rad - yaw[7] + np.pi, 2 * np.pi) == pytest.approx(np.pi, abs=1e-5)


class _Into:
    """Lets ``taught`` fill a channel."""

    def __init__(self, channel, circumstances):
        self._channel, self._circumstances, self._ns = channel, circumstances, 0

    def step(self, s):
        self._ns += 100_000_000
        self._channel.step(replace(s, boot_ns=self._ns), s.mag_b_mg, self._circumstances)


def test_what_the_autopilot_already_corrects_is_fitted_through():
    """Truth is soft_iron_b @ (matrix @ (sensor - iron) + motor): half of the soft iron is stored, half is found."""
    roll, pitch, yaw = attitudes(300, seed=3)
    true = seen_from(roll, pitch, yaw, EARTH)
    stored, motor = np.diag([1.1, 0.95, 1.0]), np.array([5.0, -3.0, 2.0])
    left = np.array([[1.0, 0.05, 0.0], [0.05, 1.02, 0.0], [0.0, 0.0, 0.99]])
    sensor = (true @ left.T - motor) @ np.linalg.inv(stored).T + IRON
    shaping = Shaping(mat3(stored, "m"), vec3(motor, "motor"))
    got = taught(ESTIMATORS["ellipsoid"](), sensor, roll, pitch, shaping).estimate(None)
    assert got.hard_iron_b_mg == pytest.approx(IRON, abs=1e-5)
    size = np.linalg.det(left) ** (1 / 3)
    assert got.soft_iron_b @ left == pytest.approx(np.eye(3) * size, abs=1e-8)


def test_level_turns_show_no_ellipsoid():
    r = np.random.default_rng(3)
    roll, pitch = r.normal(0.0, 0.02, (2, 400))
    seen = seen_from(roll, pitch, np.linspace(0.0, 12.0, 400), EARTH) + IRON + r.normal(0.0, 4.0, (400, 3))
    e = taught(ESTIMATORS["ellipsoid"](), seen, roll, pitch)
    assert e.estimate(None) is None and e.why_not()
