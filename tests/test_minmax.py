"""Method I: the middle of the extremes. Exact where they were met, ruined by one spike, silent about its error."""

import numpy as np
import pytest
from figures import ball, fitted, fitter, ring, rotation, sample, taught
from hypothesis import given, settings
from hypothesis import strategies as st
from seed_vectors import load
from test_centred import spiked

from magmav.core.estimators import ESTIMATORS
from magmav.core.estimators import fitted as made
from magmav.core.estimators.fit import Fit, Refusal, fit_points

SEED = load()["circle"]


@pytest.mark.parametrize("case", [c for c in SEED if c["name"] != "Bullock parabola"], ids=lambda c: c["name"])
def test_circles_of_the_seed_papers(case):
    f = fitter("minmax", 2)
    got = fit_points(case["points"], f)
    middle, half = f.extremes()
    assert [*middle, half.mean()] == pytest.approx(case["I"], abs=1e-12)
    wrong = np.hypot(*(middle - case["II_III"][:2])) > 0.1 * case["II_III"][2]
    assert got is Refusal.EXTREMES if wrong else got.centre == pytest.approx(middle)


def test_a_parabola_is_no_circle():
    assert fitted("minmax", SEED[2]["points"]) is Refusal.ARC_TOO_SHORT


def test_table_3_1_of_the_paper():
    """Three spikes move it by more than a hundred counts from the circle that the others stay on."""
    points = spiked()
    got = fitted("minmax", points, 1500.0)
    assert got.centre == pytest.approx([2079.0, -2537.0], abs=1e-9)
    assert np.linalg.norm(got.centre - fitted("bullock", points, 1500.0).centre) > 100.0
    assert got.residual > 5.0 * fitted("bullock", points, 1500.0).residual


@settings(max_examples=20, deadline=None)
@given(st.integers(2, 3), st.integers(0, 2**32 - 1), st.integers(0, 3), st.floats(-2e3, 2e3), st.floats(1e-3, 1e3))
def test_quarter_turns_shifts_and_scale_carry_over_and_no_other_turn_does(d, seed, quarters, shift, factor):
    """The extremes are those of the axes, so a turn by 30 degrees is another fit; a quarter turn swaps axes."""
    points = ring(200, noise=4.0, seed=seed) if d == 2 else ball(200, 200.0, noise=4.0, seed=seed)
    turn = rotation(d, quarters * np.pi / 2)
    here, there = fitted("minmax", points), fitted("minmax", factor * (points @ turn.T + shift), 200.0 * factor)
    assert there.centre / factor == pytest.approx(turn @ here.centre + shift, abs=1e-7)
    assert there.radius / factor == pytest.approx(here.radius, rel=1e-9)
    askew = rotation(d, 0.5)
    assert np.abs(fitted("minmax", points @ askew.T).centre - askew @ here.centre).max() > 1e-3


def test_the_residual_is_that_of_its_own_circle():
    points = ring(300, noise=5.0, seed=3, centre=(40.0, -7.0))
    got = fitted("minmax", points)
    misfits = np.array([got.misfit(p) for p in points])
    assert got.residual == pytest.approx(np.sqrt(np.mean(misfits**2)), rel=0.05)


def test_noise_widens_the_ends_and_more_data_hardly_helps():
    """2 % of noise, 400 points: radius 3.4 % too large, the centre's scatter 0.73 %, least squares 0.14 %."""
    got = {"minmax": [], "bullock": []}
    for seed in range(30):
        points = ring(400, noise=4.0, seed=seed)
        for method, rows in got.items():
            fit = fitted(method, points)
            rows.append([*fit.centre, fit.radius])
    wide, fine = (np.array(got[m]) / 200.0 for m in ("minmax", "bullock"))
    assert wide[:, 2].mean() - 1.0 == pytest.approx(0.034, abs=0.005)
    assert wide[:, :2].std() == pytest.approx(0.0073, rel=0.3)
    assert fine[:, :2].std() == pytest.approx(0.0014, rel=0.3)


def test_one_spike_decides_it_for_ever():
    """A small one moves it by half its height, a larger one makes it weak, and one beyond that is refused."""
    points = ring(400, seed=5)
    for height, weak in ((12.0, False), (30.0, True)):
        spoilt = fitted("minmax", np.vstack(([200.0 + height, 0.0], points)))
        assert isinstance(spoilt, Fit) and spoilt.weak is weak
        assert spoilt.centre[0] == pytest.approx(height / 2.0, abs=0.2)
    assert fitted("minmax", np.vstack(([300.0, 0.0], points))) is Refusal.EXTREMES
    assert isinstance(fitted("bullock", np.vstack(([300.0, 0.0], points))), Fit)


@pytest.mark.long
@pytest.mark.parametrize("method", ["minmax", "sytnyk"])
@pytest.mark.parametrize("noise", [pytest.param(0.5, marks=pytest.mark.long), 2.0, 5.0])
def test_extremes_that_were_never_met_are_refused_or_called_weak(method, noise):
    """Vehicles that stood at a few headings: the error is r (1 - cos(half the gap)) / 2, whatever the residual."""
    for seed in range(10):
        for n in (3, 5):
            got = fitted(method, headings_only(n, noise, seed))
            assert isinstance(got, Refusal) or (n == 5 and got.weak)
        got = fitted(method, headings_only(12, noise, seed))
        assert isinstance(got, Fit) and np.linalg.norm(got.centre) < 10.0 and not got.weak


def test_the_same_of_a_level_turn_in_space_where_the_third_axis_is_not_seen():
    for seed in range(5):
        for n, well in ((3, False), (12, True)):
            flat = headings_only(n, 2.0, seed) + np.array((310.0, -140.0))
            got = fitted("minmax", np.column_stack((flat, np.random.default_rng(seed).normal(650.0, 2.0, len(flat)))))
            assert isinstance(got, Fit) is well


def test_soft_iron_and_time_spent_at_one_heading_do_not_count_against_it():
    """The circle of all points is drawn aside there, by .056 of the radius; the extremes are right."""
    for seed in range(10):
        r = np.random.default_rng(seed)
        a = np.concatenate((r.uniform(0.0, 2 * np.pi, 200), r.normal(r.uniform(0.0, 6.0), 0.6, 400)))
        points = 200.0 * np.stack((1.1 * np.cos(a), 0.9 * np.sin(a)), 1) + r.normal(0.0, 4.0, (600, 2))
        got = fitted("minmax", points)
        assert isinstance(got, Fit) and not got.weak
        assert np.linalg.norm(got.centre) < 10.0


@pytest.mark.parametrize(("method", "d"), [("minmax", 2), ("minmax", 3), ("sytnyk", 2)])
@pytest.mark.parametrize("cut", [0, 1, 150, 400])
def test_two_halves_merged_are_the_whole(method, d, cut):
    points = ring(400, noise=4.0, seed=3, centre=(70.0, -20.0)) if d == 2 else ball(400, 200.0, noise=4.0, seed=3)
    one, other, whole = (fitter(method, d) for _ in range(3))
    for f, some in ((one, points[:cut]), (other, points[cut:]), (whole, points)):
        for p in some:
            f.add(p)
    got, want = one.then(other).fit(), whole.fit()
    assert got.centre == pytest.approx(want.centre, abs=1e-9) and got.samples == 400
    assert got.matrix == pytest.approx(want.matrix, abs=1e-9)
    assert got.residual == pytest.approx(want.residual, rel=1e-6)


def headings_only(n, noise, seed):
    """300 points at each of n headings that are evenly spread, about the origin, (300 n, 2)."""
    r = np.random.default_rng(seed)
    a = np.repeat(np.arange(n) * 2 * np.pi / n, 300)
    return 200.0 * np.stack((np.cos(a), np.sin(a)), 1) + r.normal(0.0, noise, (len(a), 2))


def test_z_needs_a_tumble_and_is_left_alone_without_one():
    flat = np.column_stack((ring(400, noise=2.0, seed=1, centre=(310.0, -140.0)), np.full(400, 650.0)))
    got = taught(ESTIMATORS["minmax"](), flat).estimate(None)
    assert got.hard_iron_b_mg[:2] == pytest.approx((310.0, -140.0), abs=3.0)
    assert got.hard_iron_b_mg[2] == 0.0
    whole = taught(ESTIMATORS["minmax"](), ball(800, centre=(310.0, -140.0, 220.0), seed=2)).estimate(None)
    assert whole.hard_iron_b_mg == pytest.approx((310.0, -140.0, 220.0), abs=5.0)


def test_it_claims_no_sigma_and_so_is_never_written():
    for name in ("minmax", "minmax_level", "sytnyk"):
        e = ESTIMATORS[name]()
        assert e.has_sigma is False
        points = np.column_stack((ring(200, seed=1), np.full(200, 430.0)))
        assert np.all(taught(e, points).estimate(None).own_sigma_mg >= 1000.0)
    assert ESTIMATORS["bullock"]().has_sigma is True


def test_it_cannot_forget_and_says_so():
    for method in ("minmax", "sytnyk"):
        with pytest.raises(ValueError, match=method):
            made(method, "level", forget=0.99)


def test_what_must_not_be_learnt_is_not():
    e = taught(ESTIMATORS["minmax"](), ball(300, seed=4))
    before = e.estimate(None).hard_iron_b_mg
    e.step(sample((9000.0, 0.0, 0.0), learn=False))
    assert np.array_equal(e.estimate(None).hard_iron_b_mg, before)
