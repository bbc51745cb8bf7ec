"""Methods II, III and Taubin's on one accumulator: other people's numbers, batch forms, laws, honest sigma."""

import copy
import pickle

import numpy as np
import pytest
from figures import ROUND, ball, figure, fitted, fitter, ring, rotation
from hypothesis import given, settings
from hypothesis import strategies as st
from seed_vectors import load

from magmav.core.estimators.centred import bullock, kasa, taubin
from magmav.core.estimators.fit import Fit, Refusal
from magmav.core.estimators.moments import Moments

SEED = load()["circle"]
SOLVE = {"kasa": kasa, "bullock": bullock, "taubin": taubin}


def moments(points, scale=200.0, forget=1.0):
    points = np.asarray(points, dtype=float)
    m = Moments(points.shape[1], scale, forget)
    for p in points:
        m.add(p)
    return m


def solved(method, points, scale=200.0, forget=1.0):
    """Centre and radius by the equations alone, however short the arc."""
    m = moments(points, scale, forget)
    c, square = SOLVE[method](m.within(np.eye(m.dimensions)))
    return np.append(m.shift + m.scale * c, m.scale * np.sqrt(square))


def batch(points, weights=None):
    """Weighted least squares of 2 p.c + w = |p|^2 by numpy, about the mean for its digits. Centre and radius."""
    points = np.asarray(points, dtype=float)
    root = np.sqrt(np.ones(len(points)) if weights is None else weights)
    middle = points.mean(0)
    u = points - middle
    design = np.hstack((2.0 * u, np.ones((len(u), 1)))) * root[:, None]
    *c, w = np.linalg.lstsq(design, (u * u).sum(1) * root, rcond=None)[0]
    return np.append(middle + c, np.sqrt(w + np.dot(c, c)))


# ---------------------------------------------------------------- other people's numbers


@pytest.mark.parametrize("case", SEED, ids=lambda c: c["name"])
@pytest.mark.parametrize("scale", [1.0, 5.0, 500.0])
@pytest.mark.parametrize("method", ["kasa", "bullock"])
def test_circles_of_the_seed_papers(case, scale, method):
    assert solved(method, case["points"], scale) == pytest.approx(case["II_III"], rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("case", SEED[:2], ids=lambda c: c["name"])
def test_taubin_is_exact_where_the_points_are(case):
    assert solved("taubin", case["points"], 5.0) == pytest.approx(case["II_III"], abs=1e-12)


@pytest.mark.parametrize("d", [2, 3])
def test_streaming_taubin_is_the_batch_eigenproblem(d):
    """M y = eta N y on the design matrix itself, N the mean of the squared gradients, smallest eta."""
    points = figure(d, 300, noise=15.0, seed=7, centre=np.full(d, 900.0))[: 300 if d == 3 else 200]
    u = (points - points.mean(0)) / 200.0
    design = np.column_stack(((u * u).sum(1), u, np.ones(len(u))))
    gradient = np.diag([4.0 * design[:, 0].mean(), *[1.0] * d, 0.0])
    values, vectors = np.linalg.eig(np.linalg.solve(design.T @ design / len(u), gradient))
    A, *B, C = vectors[:, np.argmax(values.real)].real
    centre = -np.array(B) / (2.0 * A)
    expected = np.append(points.mean(0) + 200.0 * centre, 200.0 * np.sqrt(centre @ centre - C / A))
    assert solved("taubin", points) == pytest.approx(expected, abs=1e-7)


def test_table_3_1_of_the_paper():
    """The paper's circle with the three spikes its table implies: II and III hardly notice (see also test_minmax)."""
    points = spiked()
    two, three = fitted("kasa", points, 1500.0), fitted("bullock", points, 1500.0)
    assert [*three.centre, three.radius] == pytest.approx([1973.3, -2570.1, 1528.9], abs=1.0)
    assert np.abs(two.centre - three.centre).max() < 1e-9 * three.radius


def spiked(n=1000):
    """Sawicki 2017, figure 7: the circle of table 3.1, and one-sided spikes that make method I answer as printed."""
    a = np.linspace(0.0, 2 * np.pi, n, endpoint=False)
    points = 1528.9 * np.stack((np.cos(a), np.sin(a)), 1) + (1973.3, -2570.1)
    points += np.random.default_rng(3).uniform(-5.0, 5.0, points.shape)
    left, low = points.min(0)
    points[0] = (2 * 2079.0 - left, -2570.1)  # method I: 2079.0, -2537.0
    points[n // 4] = (1973.3, 2 * -2537.0 - low)
    return points


@settings(max_examples=40, deadline=None)
@given(st.integers(2, 3), st.integers(1, 14), st.integers(0, 2**32 - 1), st.floats(-1e4, 1e4))
def test_moments_count_directions_as_far_as_they_can(d, n, seed, shift):
    """n places give n directions, up to 6 in the plane and 10 in space; on a circle or sphere one fewer."""
    places = np.random.default_rng(seed).uniform(-300.0, 300.0, (n, d))
    most = 6 if d == 2 else 10
    got = moments(np.repeat(places, 7, 0) + shift).directions(np.eye(d), np.full(d, shift), 200.0)
    assert got <= min(n, most)
    apart = ring(n, 200.0, seed=seed) if d == 2 else ball(n, 200.0, seed=seed)
    assert moments(np.repeat(apart, 7, 0) + shift).directions(np.eye(d), np.full(d, shift), 200.0) <= min(n, most - 1)
    angles = np.arange(n) * 2 * np.pi / n
    even = 200.0 * np.stack((np.cos(angles), np.sin(angles)), 1)
    axes = np.eye(d)[:, :2]
    deep = even if d == 2 else np.column_stack((even, np.full(n, 650.0)))
    assert moments(np.repeat(deep, 7, 0) + shift).directions(axes, np.full(d, shift), 200.0) == min(n, 5)


# ---------------------------------------------------------------- equal to each other and to the batch


points_2d = st.integers(0, 2**32 - 1)


@settings(max_examples=40, deadline=None)
@given(points_2d, st.integers(2, 3), st.floats(-1e5, 1e5), st.floats(0.0, 0.1), st.floats(60.0, 360.0))
def test_II_is_III(seed, d, offset_radii, noise, degrees):
    """To 1e-9 of the radius, on arcs and wholes, at offsets up to 1e5 radii."""
    r = np.random.default_rng(seed)
    centre = offset_radii * 200.0 * rotation(d, r.uniform(0, 6))[0]
    kind = ring(40, 200.0, centre, degrees, 0.0, noise * 200.0, seed) if d == 2 else ball(40, 200.0, centre, 20.0, seed)
    two, three = solved("kasa", kind), solved("bullock", kind)
    assert np.abs(two - three).max() < 1e-9 * three[-1]


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("method", ["kasa", "bullock"])
@pytest.mark.parametrize("offset", [0.0, 500.0, 2000.0])
def test_streaming_equals_batch(d, method, offset):
    points = figure(d, 800, noise=10.0, seed=3, centre=np.full(d, offset))
    assert solved(method, points) == pytest.approx(batch(points), rel=0.0, abs=1e-9 * 200.0)


@pytest.mark.parametrize("method", ["kasa", "bullock"])
@pytest.mark.parametrize("forget", [0.9, 0.99, 0.999])
def test_forgetting_is_a_weighted_batch(method, forget):
    points = ring(600, noise=8.0, seed=4, centre=(300.0, -90.0))
    weights = forget ** np.arange(len(points) - 1, -1, -1.0)
    assert solved(method, points, forget=forget) == pytest.approx(batch(points, weights), rel=0.0, abs=1e-8)


def test_with_forgetting_the_circle_follows_and_without_it_is_torn():
    path = np.vstack((ring(400, centre=(40.0, 0.0), seed=1), ring(400, centre=(-30.0, 20.0), seed=2)))
    assert fitted("bullock", path, forget=0.96).centre == pytest.approx((-30.0, 20.0), abs=0.01)
    assert np.linalg.norm(fitted("bullock", path).centre - (-30.0, 20.0)) > 30.0


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(2, 3), st.integers(0, 60), st.sampled_from([1.0, 0.98, 0.9]))
def test_two_halves_merged_are_the_whole(seed, d, cut, forget):
    points = figure(d, 60, noise=9.0, seed=seed, centre=np.array([310.0, -140.0, 220.0])[:d])
    whole = moments(points, forget=forget)
    both = moments(points[:cut].reshape(-1, d), forget=forget).then(moments(points[cut:].reshape(-1, d), forget=forget))
    assert (both.samples, both.weight, both.weight2) == pytest.approx((60, whole.weight, whole.weight2))
    for solve in (kasa, bullock, taubin):
        a, b = (np.append(m.shift + m.scale * solve(m.within(np.eye(d)))[0], 0.0) for m in (both, whole))
        assert a == pytest.approx(b, abs=1e-9 * 200.0)


def test_halves_that_do_not_go_together_are_refused():
    for other in (Moments(3, 200.0), Moments(2, 100.0), Moments(2, 200.0, 0.9)):
        with pytest.raises(ValueError, match="halves must agree"):
            Moments(2, 200.0).then(other)


@pytest.mark.parametrize(
    ("wrong", "names"),
    [
        ((4, 1.0, 1.0), "dimensions"),
        ((2, 0.0, 1.0), "scale"),
        ((2, 1.0, 1.1), "forget"),
        ((2, 1.0, 0.0), "forget"),
    ],
)
def test_a_wrong_accumulator_names_what_is_wrong(wrong, names):
    with pytest.raises(ValueError, match=names):
        Moments(*wrong)


# ---------------------------------------------------------------- laws


@settings(max_examples=40, deadline=None)
@given(
    st.sampled_from(ROUND),
    st.integers(2, 3),
    st.integers(0, 2**32 - 1),
    st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    st.tuples(*[st.floats(-2000.0, 2000.0)] * 3),
    st.floats(1e-3, 1e3),
)
def test_the_answer_turns_shifts_and_grows_with_the_points(method, d, seed, angles, shift, factor):
    points = figure(d, 40, noise=8.0, seed=seed)
    turn, by = rotation(d, *angles), np.array(shift)[:d]
    here = fitted(method, points)
    there = fitted(method, factor * (points @ turn.T + by), 200.0 * factor)
    assert there.centre / factor == pytest.approx(turn @ here.centre + by, abs=1e-7)
    assert there.radius / factor == pytest.approx(here.radius, rel=1e-9)
    assert there.residual / factor == pytest.approx(here.residual, rel=1e-6)
    assert there.covariance / factor**2 == pytest.approx(turn @ here.covariance @ turn.T, abs=1e-6)


@pytest.mark.parametrize("method", ROUND)
def test_points_in_a_plane_of_space_give_the_circle_in_it(method):
    """Whatever way the plane lies, and noise across it too; the third direction is left at zero and not seen."""
    turn = rotation(3, 0.3, -0.5, 1.1)
    flat = np.column_stack((ring(300, centre=(70.0, -40.0), noise=3.0, seed=2), np.full(300, 430.0)))
    noise = np.random.default_rng(5).normal(0.0, 3.0, 300)
    for points, near in ((flat, 1e-7), (flat + np.outer(noise, (0, 0, 1)), 1e-7)):
        inside = fitted(method, points[:, :2])
        got = fitted(method, points @ turn.T)
        assert got.seen.shape == (3, 2)
        assert got.centre == pytest.approx(turn @ np.append(inside.centre, 0.0), abs=near if points is flat else 5.0)
        assert got.radius == pytest.approx(inside.radius, abs=1.0)
        assert turn[:, 2] @ got.covariance @ turn[:, 2] < 0.1


def test_short_arcs_draw_II_and_III_as_predicted_and_not_taubin():
    """90 degrees, 5 % noise: the mean of the arc lies .9 r off, and by s^2 / (C + s^2) of that the centre is drawn."""
    half, noise = np.pi / 4, 10.0
    away = 200.0 * np.sin(half) / half
    across = 200.0**2 * (0.5 + np.sin(2 * half) / (4 * half)) - away**2
    off = {m: [] for m in ROUND}
    for seed in range(12):
        arc = ring(600, degrees=90.0, start=-45.0, noise=noise, seed=seed)
        for m in ROUND:
            off[m].append(solved(m, arc)[0])
    drawn = noise**2 / (across + noise**2) * away
    assert drawn / 200.0 == pytest.approx(0.22, abs=0.005)  # the reference's figure
    assert np.mean(off["kasa"]) == pytest.approx(drawn, rel=0.05)
    assert off["bullock"] == pytest.approx(off["kasa"])
    assert abs(np.mean(off["taubin"])) < 0.02 * 200.0
    assert fitted("kasa", arc) is Refusal.ARC_TOO_SHORT
    assert isinstance(fitted("taubin", arc), Fit)


def test_the_residual_is_the_scatter_about_the_circle():
    r = np.random.default_rng(4)
    a = r.uniform(0, 2 * np.pi, 1500)
    points = (300 + r.normal(0, 7.0, a.size))[:, None] * np.stack((np.cos(a), np.sin(a)), 1) + (40, 90)
    for method in ROUND:
        fit = fitted(method, points)
        assert fit.residual == pytest.approx(7.0, rel=0.05)
        misfits = np.array([fit.misfit(p) for p in points])
        assert np.sqrt(np.mean(misfits**2)) == pytest.approx(fit.residual, rel=0.05)
        assert fit.roundness > 0.95


@pytest.mark.parametrize(
    ("degrees", "roundness", "weak"), [(360, 1.0, False), (270, 0.5, False), (180, 0.19, True), (90, 0.043, True)]
)
def test_roundness_of_arcs(degrees, roundness, weak):
    a = np.radians(np.linspace(0, degrees, 800, endpoint=False))
    fit = fitted("bullock", 200 * np.stack((np.cos(a), np.sin(a)), 1))
    assert fit.roundness == pytest.approx(roundness, rel=0.05)
    assert fit.weak is weak
    assert fit.centre == pytest.approx([0, 0], abs=1e-6)


# ---------------------------------------------------------------- honesty


@pytest.mark.parametrize("method", ROUND)
@pytest.mark.parametrize(("degrees", "noise"), [(360.0, 4.0), (90.0, 2.0), (120.0, 6.0)])
def test_claimed_covariance_is_honest_on_wholes_and_on_arcs(method, degrees, noise):
    """Squared error in units of the claim, per axis; what noise draws a short arc by is in the claim."""
    squares = []
    for seed in range(40):
        fit = fitted(method, ring(90, degrees=degrees, start=30.0, noise=noise, seed=seed))
        squares.append(fit.centre @ np.linalg.solve(fit.covariance, fit.centre) / 2.0)
    assert 0.7 < np.sqrt(np.mean(squares)) < 1.2


def test_the_claim_on_a_full_circle_is_two_sigma_squared_over_n():
    fit = fitted("bullock", ring(2000, noise=4.0, seed=1))
    assert np.diag(fit.covariance) == pytest.approx(2 * 4.0**2 / 2000, rel=0.08)


def test_neighbouring_errors_that_are_alike_count_less():
    r, a = np.random.default_rng(6), np.linspace(0, 40, 2000)
    circle = np.stack((np.cos(a), np.sin(a)), 1)
    slow = np.interp(np.arange(2000), np.arange(0, 2001, 50), r.normal(0, 6.0, 41))
    sigmas = []
    for e in (slow, r.permutation(slow)):
        f = fitter("bullock", 2, watch=True)
        for p in (200 + e)[:, None] * circle:
            f.add(p)
        sigmas.append(np.sqrt(np.trace(f.fit().covariance)))
    assert sigmas[0] > 4.0 * sigmas[1]


@pytest.mark.parametrize("method", [*ROUND, "ellipsoid"])
def test_a_copy_goes_on_to_the_same_bits(method):
    points = ball(200, noise=5.0, seed=8)
    whole = fitter(method, 3, watch=True)
    for p in points:
        whole.add(p)
    for clone in (copy.deepcopy, lambda f: pickle.loads(pickle.dumps(f))):
        half = fitter(method, 3, watch=True)
        for p in points[:90]:
            half.add(p)
        half = clone(half)
        for p in points[90:]:
            half.add(p)
        assert half.fit().centre.tobytes() == whole.fit().centre.tobytes()
        assert half.fit().covariance.tobytes() == whole.fit().covariance.tobytes()


def test_halves_of_a_watched_stream_keep_their_watch():
    points = ring(400, noise=5.0, seed=9)
    halves = [fitter("bullock", 2, watch=True) for _ in range(2)]
    for h, part in zip(halves, (points[:150], points[150:]), strict=True):
        for p in part:
            h.add(p)
    both, whole = halves[0].then(halves[1]), fitter("bullock", 2, watch=True)
    for p in points:
        whole.add(p)
    assert both.fit().centre == pytest.approx(whole.fit().centre, abs=1e-9)
    assert both.independent() == pytest.approx(whole.independent(), abs=0.1)
