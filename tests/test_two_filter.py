"""Two beliefs about one state made into one: the product in closed form, each prior counted once."""

import math

import numpy as np
import pytest
from honest_flight import EXPECTED

from magmav.core.estimators.adaptive import layout as at
from magmav.core.estimators.adaptive.bank import Bank
from magmav.core.estimators.adaptive.tuning import MODELS, Tuning
from magmav.core.rotation import TAU
from magmav.core.two_filter import SHARED, product

FIELD = (EXPECTED.horizontal_mg, 4.0, EXPECTED.down_mg, 4.0)


def begun():
    return Bank.begun(FIELD, Tuning())


def shared_prior(model):
    """Information of what both sides begin with, on SHARED; none of the heading."""
    bank = begun()
    (row, *_) = np.flatnonzero(bank.model == model)
    p = bank.p[row][np.ix_(SHARED, SHARED)]
    info = np.linalg.inv(p)
    info[0, :] = info[:, 0] = 0.0
    return info, bank.x[row][SHARED]


def bank_of(beliefs, model=0):
    """A bank of these (mean, covariance) on SHARED; all else unknown by one unit."""
    n = len(beliefs)
    x, p = np.zeros((n, at.SIZE)), np.tile(np.eye(at.SIZE), (n, 1, 1))
    for i, (mean, covariance) in enumerate(beliefs):
        x[i, SHARED] = mean
        p[i][np.ix_(SHARED, SHARED)] = covariance
    return Bank(x, p, np.full(n, model), np.zeros(n), Tuning())


def evidence(seed, rows=30):
    """Linear readings of the state: their information matrix and vector, in units of the prior's sigmas."""
    rng = np.random.default_rng(seed)
    scale = np.sqrt(np.diag(begun().p[0])[SHARED])
    scale[0] = 0.1
    design = rng.normal(0, 1, (rows, len(SHARED))) / scale
    truth = scale * rng.normal(0, 1, len(SHARED))
    truth[0] = 0.2
    return design.T @ design, design.T @ (design @ truth + rng.normal(0, 1, rows))


def gaussian(info, vector):
    covariance = np.linalg.inv(info)
    return covariance @ vector, 0.5 * (covariance + covariance.T)


def round_time(belief):
    """The same belief as the side sees it for which time runs the other way: the gyro's bias has the other sign."""
    sign = np.array([-1.0 if at.G.start <= i < at.G.stop else 1.0 for i in SHARED])
    return belief[0] * sign, belief[1] * sign * sign[:, None]


@pytest.mark.parametrize("seed", range(3))
def test_the_product_is_what_one_filter_makes_of_all_the_readings(seed):
    """Linear and Gaussian: the prior is counted once, and nothing is lost."""
    info0, x0 = shared_prior(0)
    (a, u), (b, v) = evidence(seed), evidence(100 + seed)
    before = gaussian(info0 + a, info0 @ x0 + u)
    after = gaussian(info0 + b, info0 @ x0 + v)
    want, covariance = gaussian(info0 + a + b, info0 @ x0 + u + v)
    got = product(bank_of([before]), bank_of([round_time(after)]), begun(), 0.25)
    assert got.x[0, SHARED] == pytest.approx(want, rel=1e-6, abs=1e-6)
    assert got.p[0][np.ix_(SHARED, SHARED)] == pytest.approx(covariance, rel=1e-6, abs=1e-9)


def test_a_side_that_knows_nothing_changes_nothing():
    info0, x0 = shared_prior(0)
    a, u = evidence(5)
    before = gaussian(info0 + a, info0 @ x0 + u)
    nothing = info0.copy()
    nothing[0, 0] = 1e-9
    after = gaussian(nothing, info0 @ x0)
    got = product(bank_of([before]), bank_of([round_time(after)]), begun(), 0.25)
    assert got.x[0, SHARED] == pytest.approx(before[0], rel=1e-4, abs=1e-4)
    assert np.diag(got.p[0])[SHARED] == pytest.approx(np.diag(before[1]), rel=1e-4)


def test_the_side_that_knows_the_heading_tells_the_other_also_a_turn_away():
    """Two headings before, one of them seen after, given as a whole turn more."""
    info0, x0 = shared_prior(0)
    a, u = evidence(7)
    info = info0 + 0.02 * a
    info[0, 0] += 400.0
    mean, covariance = gaussian(info, info @ x0 + 0.02 * u)
    other = mean.copy()
    other[0] += math.pi
    seen = mean.copy()
    seen[0] += TAU
    got = product(
        bank_of([(mean, covariance), (other, covariance)]), bank_of([round_time((seen, covariance))]), begun(), 1.0
    )
    best = got.x[np.argmax(got.weights())]
    assert got.weights().max() > 0.99
    assert best[0] == pytest.approx(mean[0], abs=0.05)


def test_where_the_frame_was_lost_headings_have_nothing_to_say():
    info0, x0 = shared_prior(0)
    (a, u), (b, v) = evidence(8), evidence(9)
    before = gaussian(info0 + a, info0 @ x0 + u)
    after = gaussian(info0 + b, info0 @ x0 + v)
    turned = after[0].copy()
    turned[0] += 1.7
    one, two = (
        product(bank_of([before]), bank_of([round_time((mean, after[1]))]), begun(), 0.25, heading=False)
        for mean in (after[0], turned)
    )
    assert one.x == pytest.approx(two.x)
    assert np.all(np.diag(one.p[0])[at.B] < np.diag(before[1])[1:4])


def test_models_are_weighed_by_both_sides():
    """A model that neither side believes is not believed by both."""
    info0, x0 = shared_prior(0)
    a, u = evidence(11)
    belief = gaussian(info0 + a, info0 @ x0 + u)
    sides = []
    for one in (belief, round_time(belief)):
        bank = bank_of([one] * len(MODELS))
        bank.model = np.arange(len(MODELS))
        bank.prior = np.log([m.weight for m in MODELS])
        bank.log_weight = np.log((0.9, 0.05, 0.05))
        sides.append(bank)
    got = product(*sides, begun(), 0.0)
    first = got.weights()[got.model == 0].sum()
    weights = np.array((0.9, 0.05, 0.05)) ** 2 / np.array([m.weight for m in MODELS])
    assert first == pytest.approx(weights[0] / weights.sum(), abs=1e-3)
