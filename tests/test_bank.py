"""The bank of hypotheses: one model while the heading is unknown, all models once it is; saved by halves."""

import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
from honest_flight import EXPECTED, samples
from hypothesis import given, settings
from hypothesis import strategies as st

from magmav.core.estimators.adaptive import AdaptiveEstimator
from magmav.core.estimators.adaptive import layout as at
from magmav.core.estimators.adaptive.answer import surprise
from magmav.core.estimators.adaptive.bank import Bank, field_covariance
from magmav.core.estimators.adaptive.tuning import FIRST, MODELS, SOFT_IRON, Tuning
from magmav.core.packing import upper, whole
from magmav.core.types import vec3

N = Tuning()
HERE = (EXPECTED.horizontal_mg, EXPECTED.down_mg)
FIELD = (HERE[0], N.model_mg, HERE[1], N.model_mg)


def placed(flight):
    """With a position from the start."""
    return [replace(s, model_mg=HERE) for s in flight]


def one(model):
    """A bank of one hypothesis of a model as it begins."""
    bank = Bank.begun(FIELD, Tuning(yaws=1))
    bank.keep(np.flatnonzero(bank.model == model))
    return bank


def test_it_begins_with_one_model_at_every_heading():
    bank = Bank.opened(FIELD, N)
    assert not bank.parted and len(bank) == N.yaws
    gaps = np.diff(np.sort(bank.x[:, at.ALPHA] % math.tau))
    assert gaps == pytest.approx(np.full(N.yaws - 1, math.tau / N.yaws))
    assert bank.weights().sum() == pytest.approx(1.0)


def test_before_any_data_the_parts_are_what_each_model_begins_with():
    bank = Bank.opened(FIELD, N)
    bank.part(N)
    assert bank.parted and len(bank) == N.yaws * len(MODELS)
    w = bank.weights()
    for m, model in enumerate(MODELS):
        rows = bank.model == m
        assert w[rows].sum() == pytest.approx(model.weight)
        diagonal = np.einsum("kii->ki", bank.p[rows])
        assert diagonal[:, at.S] == pytest.approx(np.tile(model.soft_variances(), (N.yaws, 1)))
        assert bank.walk_mg[rows] == pytest.approx(model.iron_walk_mg)
        assert np.all(bank.x[rows, at.S] == 0.0)


def taught(bank, jacobian, z, noise_mg2):
    """A linear measurement of one state: the log of its likelihood; the bank is changed in place."""
    expected = jacobian @ bank.p[0] @ jacobian.T + noise_mg2 * np.eye(len(z))
    off = z - jacobian @ bank.x[0]
    gain = bank.p[0] @ jacobian.T @ np.linalg.inv(expected)
    bank.x[0] += gain @ off
    p = bank.p[0] - gain @ jacobian @ bank.p[0]
    bank.p[0] = 0.5 * (p + p.T)
    return -0.5 * (float(off @ np.linalg.solve(expected, off)) + np.linalg.slogdet(expected)[1])


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 30))
def test_knowing_afterwards_is_knowing_from_the_start_where_all_is_linear(seed, rows):
    """State, covariance and evidence of the wide model, from the narrow one's alone."""
    rng = np.random.default_rng(seed)
    jacobian = rng.normal(0.0, 1.0, (rows, at.SIZE))
    jacobian[:, at.S] *= 400.0  # mG per unit of soft iron
    z, noise = rng.normal(0.0, 300.0, rows), 25.0
    soft = MODELS.index(SOFT_IRON)
    first, other = one(FIRST), one(soft)
    by_first, by_other = taught(first, jacobian, z, noise), taught(other, jacobian, z, noise)
    n = Tuning(temper=1.0)
    before = float(first.log_weight[0])
    first.part(n)
    (late,) = np.flatnonzero(first.model == soft)
    scale = np.sqrt(np.diagonal(other.p[0]))
    assert (first.x[late] - other.x[0]) / scale == pytest.approx(np.zeros(at.SIZE), abs=1e-4)
    assert (first.p[late] - other.p[0]) / np.outer(scale, scale) == pytest.approx(np.zeros((at.SIZE,) * 2), abs=1e-5)
    evidence = float(first.log_weight[late]) - before - math.log(SOFT_IRON.weight / MODELS[FIRST].weight)
    assert evidence == pytest.approx(by_other - by_first, abs=1e-3 + 1e-5 * abs(by_first))


def test_losing_the_heading_keeps_all_else_and_begins_with_one_model_again():
    bank = Bank.begun(FIELD, N)
    rng = np.random.default_rng(3)
    bank.x[:, at.B] = rng.normal(0.0, 100.0, (len(bank), 3))
    bank.log_weight = rng.normal(0.0, 1.0, len(bank))
    best = max(np.flatnonzero(bank.model == FIRST), key=lambda i: bank.log_weight[i])
    iron, p = bank.x[best, at.B].copy(), bank.p[best, at.B, at.B].copy()
    bank.lose_heading(N)
    assert not bank.parted and len(bank) == N.yaws_again
    assert bank.x[:, at.B] == pytest.approx(np.tile(iron, (N.yaws_again, 1)))
    assert all(np.array_equal(one_p, p) for one_p in bank.p[:, at.B, at.B])
    assert bank.weights() == pytest.approx(np.full(N.yaws_again, 1.0 / N.yaws_again))


@pytest.mark.parametrize("motion", ["figure eight", "survey", "hover turns"])
def test_a_state_stays_under_fifty_kilobytes_at_every_moment(motion):
    e, most = AdaptiveEstimator(), 0
    for i, s in enumerate(placed(samples(motion, 4, seconds=40.0))):
        e.step(replace(s, gap=True) if i == 250 else s)  # the link was lost: any heading again
        if i % 5 == 0:
            most = max(most, len(pickle.dumps(e, protocol=pickle.HIGHEST_PROTOCOL)))
    assert 10_000 < most < 50_000


@given(st.integers(1, 4), st.integers(1, 9), st.integers(0, 2**32 - 1))
def test_halves_give_back_every_bit(k, n, seed):
    full = np.random.default_rng(seed).normal(0.0, 1.0, (k, n, n))
    full = full + full.transpose(0, 2, 1)
    assert np.array_equal(whole(upper(full), n), full)
    assert upper(full).size == k * n * (n + 1) // 2


def test_covariances_stay_symmetric_to_the_bit_or_halves_would_lose_something():
    e = AdaptiveEstimator()
    for i, s in enumerate(placed(samples("figure eight", 6, seconds=20.0))):
        e.step(s)
        if e._bank is not None and i % 7 == 0:
            assert np.array_equal(e._bank.p, e._bank.p.transpose(0, 2, 1))
            sums = e._second._blocks.sums
            assert np.array_equal(sums, sums.transpose(0, 2, 1))


@given(st.floats(-40.0, 40.0), st.floats(-40.0, 40.0))
def test_surprise_is_the_models_own_doubts_distance(dh, dv):
    off = np.array((dh, dv))
    want = math.sqrt(float(off @ np.linalg.solve(field_covariance(*HERE, N), off)))
    assert surprise(HERE[0] + dh, HERE[1] + dv, HERE, N) == pytest.approx(want, abs=1e-9)


@pytest.mark.parametrize(("gain", "told"), [(0.7, True), (1.0, False), (1.3, True)])
def test_a_wrong_scale_shows_as_two_opinions_long_before_a_cause_is_found(gain, told):
    """The iron is bent to make up for it: 30 % of the field stand in the down axis."""
    flight = placed(samples("figure eight", 12, seconds=30.0, iron_mg=np.zeros(3)))
    scaled = [replace(s, mag_b_mg=vec3(s.mag_b_mg * gain, "m")) for s in flight]
    e = AdaptiveEstimator()
    for s in scaled:
        e.step(s)
    assert (e.estimate(EXPECTED).apart > 4.0) is told
