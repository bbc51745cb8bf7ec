"""The streaming circle and sphere fit: other people's numbers, batch least squares, degenerate input."""

import copy
import json
import pickle
from pathlib import Path

import numpy as np
import pytest

from magmav.core.estimators.centred import CentredFitter

SEED = json.loads((Path(__file__).parent / "authorities" / "seed_vectors.json").read_text())


def fitted(points, dimensions=2, scale=500.0):
    fitter = CentredFitter(dimensions, scale)
    for p in np.asarray(points, dtype=float):
        fitter.add(p)
    return fitter


def batch(points):
    """Kasa: 2 p.c + w = |p|^2 by numpy's least squares, about the mean for its digits. Centre and radius."""
    points = np.asarray(points, dtype=float)
    middle = points.mean(0)
    u = points - middle
    design = np.hstack((2.0 * u, np.ones((len(u), 1))))
    *c, w = np.linalg.lstsq(design, (u * u).sum(1), rcond=None)[0]
    return middle + c, np.sqrt(w + np.dot(c, c))


def solved(points, dimensions=2, scale=500.0):
    """Centre and radius however few the points are."""
    fitter = fitted(points, dimensions, scale)
    c, alpha = fitter._solve()
    return fitter._shift + scale * c, scale * np.sqrt(alpha)


@pytest.mark.parametrize("case", SEED["circle"], ids=lambda c: c["name"])
@pytest.mark.parametrize("scale", [1.0, 5.0, 500.0])
def test_circles_of_the_seed_papers(case, scale):
    centre, radius = solved(case["points"], scale=scale)
    assert [*centre, radius] == pytest.approx(case["II_III"], abs=1e-9)
    if len(case["points"]) >= 6:
        fit = fitted(case["points"], scale=scale).fit()
        assert [*fit.centre, fit.radius] == pytest.approx(case["II_III"], abs=1e-9)


@pytest.mark.parametrize("dimensions", [2, 3])
@pytest.mark.parametrize("offset", [0.0, 500.0, 2000.0])
def test_streaming_equals_batch(dimensions, offset):
    r = np.random.default_rng(3)
    directions = r.normal(size=(3000, dimensions))
    points = 460.0 * directions / np.linalg.norm(directions, axis=1)[:, None]
    points += offset + r.normal(0.0, 12.0, points.shape)
    fit = fitted(points, dimensions).fit()
    centre, radius = batch(points)
    digits = 1e-9 if offset < 1000.0 else 4e-9  # twelve of them
    assert fit.centre == pytest.approx(centre, abs=digits)
    assert fit.radius == pytest.approx(radius, abs=digits)
    assert fit.samples == 3000


def test_the_residual_is_the_scatter_about_the_circle():
    r = np.random.default_rng(4)
    a = r.uniform(0, 2 * np.pi, 4000)
    points = (300 + r.normal(0, 7.0, a.size))[:, None] * np.stack((np.cos(a), np.sin(a)), 1) + (40, 90)
    fit = fitted(points).fit()
    assert fit.residual == pytest.approx(7.0, rel=0.03)
    assert fit.roundness > 0.95


@pytest.mark.parametrize(("degrees", "roundness"), [(360, 1.0), (180, 0.19), (60, 0.019)])
def test_roundness_of_arcs(degrees, roundness):
    a = np.radians(np.linspace(0, degrees, 2000, endpoint=False))
    fit = fitted(200 * np.stack((np.cos(a), np.sin(a)), 1)).fit()
    assert fit.roundness == pytest.approx(roundness, rel=0.05)
    assert fit.centre == pytest.approx([0, 0], abs=1e-6)


def test_claimed_covariance_of_white_noise_is_honest():
    """2 sigma^2 / N on a full circle, and the scatter of 200 fits agrees with what they claim."""
    r, errors = np.random.default_rng(5), []
    for _ in range(200):
        a = r.uniform(0, 2 * np.pi, 80)
        fit = fitted(200 * np.stack((np.cos(a), np.sin(a)), 1) + r.normal(0, 4.0, (80, 2)), scale=200.0).fit()
        errors.append(fit.centre / np.sqrt(np.diag(fit.covariance)))
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(1.0, abs=0.17)


def test_neighbouring_errors_that_are_alike_count_less():
    r, a = np.random.default_rng(6), np.linspace(0, 40, 2000)
    circle = np.stack((np.cos(a), np.sin(a)), 1)
    slow = np.interp(np.arange(2000), np.arange(0, 2001, 50), r.normal(0, 6.0, 41))
    fast = r.permutation(slow)
    sigmas = [np.sqrt(np.trace(fitted((200 + e)[:, None] * circle).fit().covariance)) for e in (slow, fast)]
    assert sigmas[0] > 4.0 * sigmas[1]


DEGENERATE = {
    "nothing": [],
    "one point": [(1.0, 2.0)],
    "five points": [(1.0, 2.0), (2.0, 4.0), (5.0, 1.0), (0.0, 0.0), (3.0, 3.0)],
    "one point many times": [(310.0, -140.0)] * 50,
    "two points": [(1.0, 2.0), (3.0, 4.0)] * 30,
    "a line": [(float(i), 2.0 * i) for i in range(50)],
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_what_is_no_circle_gives_none(name):
    assert fitted(DEGENERATE[name]).fit() is None


def test_a_plane_is_no_sphere():
    a = np.linspace(0, 20, 200)
    ring = np.stack((205 * np.cos(a), 205 * np.sin(a), np.full_like(a, 430.0)), 1)
    assert fitted(ring, 3).fit() is None


def test_a_copy_goes_on_to_the_same_bits():
    points = np.random.default_rng(8).normal(size=(200, 3)) * 300
    whole = fitted(points, 3)
    for clone in (copy.deepcopy, lambda f: pickle.loads(pickle.dumps(f))):
        half = clone(fitted(points[:90], 3))
        for p in points[90:]:
            half.add(p)
        assert half.fit().centre.tobytes() == whole.fit().centre.tobytes()
        assert half.fit().covariance.tobytes() == whole.fit().covariance.tobytes()
