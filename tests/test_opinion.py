"""The second opinion: joined as two measurements are, doubted as it disagrees, deaf to what is old, and a way back."""

import copy
import math

import numpy as np
import pytest
from honest_flight import EXPECTED, samples
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_flight import HARD_IRON_MG
from test_adaptive import HERE, placed, taught

from magmav.core.estimators.adaptive import AdaptiveEstimator
from magmav.core.estimators.adaptive import layout as at
from magmav.core.estimators.adaptive.answer import inverse2, surprise, symmetric, without_prior
from magmav.core.estimators.adaptive.bank import Bank, field_covariance
from magmav.core.estimators.adaptive.block import Gathering
from magmav.core.estimators.adaptive.opinion import doubt, own_covariance, stale
from magmav.core.estimators.adaptive.tuning import HARD, MODELS, SOFT_IRON, Tuning
from magmav.core.estimators.twostep import TwostepEstimator, distance
from magmav.core.rotation import body_from_earth
from magmav.core.types import IDENTITY3, Estimate, vec3

N = Tuning()
SEEDS = st.integers(0, 10**6)


class Said:
    """Somebody with an opinion."""

    def __init__(self, iron_mg, covariance_mg2, own_sigma_mg=None, reaches_back_s=0.0):
        own = np.sqrt(np.diag(covariance_mg2)) if own_sigma_mg is None else own_sigma_mg
        self.reaches_back_s = reaches_back_s
        self.said = Estimate(
            vec3(iron_mg, "b"), covariance_mg2, vec3(own, "s"), *HERE, residual_mg=4.0, step_nis=1.0, samples=500,
            changed_ago_s=1e9,
        )  # fmt: skip

    def estimate(self, expected):
        return self.said

    opinion = estimate

    def step(self, s):
        pass


def covariance(r, size, scale=1.0):
    root = r.normal(0.0, scale, (size, size))
    return root @ root.T + 0.1 * scale**2 * np.eye(size)


def bank_of(model=HARD):
    bank = Bank.begun((HERE[0], 4.0, HERE[1], 4.0), N)
    bank.keep(np.flatnonzero(bank.model == MODELS.index(model)))
    return bank


def joining(second, model=HARD, changed_ago_s=1e9):
    e = AdaptiveEstimator()
    e._bank, e._second, e._change.since_s = bank_of(model), second, changed_ago_s
    return e


# ---------------------------------------------------------------- joined


def two(seed, apart):
    """A state with its covariance and an opinion on the iron, so many sigmas from it."""
    r = np.random.default_rng(seed)
    mean, p = r.normal(0.0, 100.0, at.SIZE), covariance(r, at.SIZE, 3.0)
    take = np.zeros((3, at.SIZE))
    take[:, at.B], take[:, at.K] = np.eye(3), r.uniform(-0.5, 0.5) * np.eye(3)
    theirs, off = covariance(r, 3, 2.0), r.normal(0.0, 1.0, 3)
    iron = take @ p @ take.T
    off *= apart / distance(off, iron, theirs)
    return mean, p, take, theirs, take @ mean + off


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.floats(0.01, 1.5))
def test_two_gaussian_opinions_are_joined_by_adding_their_information(seed, apart):
    """The whole state and the iron's covariance, as P^-1 + H' R^-1 H says it; any correlation with the iron helps."""
    mean, p, take, theirs, iron = two(seed, apart)
    own = take @ p @ take.T + np.diag((10.0, 20.0, 400.0))
    e = joining(Said(iron, theirs, 3.0 * np.sqrt(np.diag(theirs))))
    got, iron_mg2, own_mg2, said_apart = e._joined(mean, take, p @ take.T, take @ p @ take.T, own, EXPECTED)
    inside, outside = np.linalg.inv(p), np.linalg.inv(theirs)
    joined = np.linalg.inv(inside + take.T @ outside @ take)
    want = joined @ (inside @ mean + take.T @ outside @ iron)
    assert got == pytest.approx(want, rel=1e-6, abs=1e-5)
    assert iron_mg2 == pytest.approx(take @ joined @ take.T, rel=1e-6, abs=1e-6)
    assert own_mg2 == pytest.approx(np.linalg.inv(np.linalg.inv(own) + outside / 9.0), rel=1e-6, abs=1e-6)
    assert said_apart == pytest.approx(apart)
    assert np.array_equal(iron_mg2, iron_mg2.T) and np.linalg.eigvalsh(iron_mg2).min() > 0.0


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.floats(1.5, 100.0))
def test_further_apart_the_seconds_variance_grows_with_the_fourth_power(seed, apart):
    mean, p, take, theirs, iron = two(seed, apart)
    before = take @ p @ take.T
    got, iron_mg2, _, _ = joining(Said(iron, theirs))._joined(mean, take, p @ take.T, before, before, EXPECTED)
    wider = theirs * (apart / 1.5) ** 4
    want = np.linalg.inv(np.linalg.inv(before) + np.linalg.inv(wider))
    assert iron_mg2 == pytest.approx(want, rel=1e-6, abs=1e-6)
    gain = before @ np.linalg.inv(before + wider)
    assert take @ got == pytest.approx(take @ mean + gain @ (iron - take @ mean), rel=1e-6, abs=1e-5)


def test_far_apart_the_bank_is_left_alone_and_that_is_said():
    mean, p, take, theirs, iron = two(4, 60.0)
    before = take @ p @ take.T
    got, after, own, apart = joining(Said(iron, theirs))._joined(mean, take, p @ take.T, before, before, EXPECTED)
    sigma = np.sqrt(np.diag(before))
    assert np.all(np.abs(take @ (got - mean)) < 0.01 * sigma)
    assert np.diag(after) == pytest.approx(np.diag(before), rel=1e-3)
    assert np.diag(own) == pytest.approx(np.diag(before), rel=1e-3)
    assert apart == pytest.approx(60.0)


def test_the_doubt_is_one_up_to_its_line_and_then_steep_enough_that_the_pull_falls():
    assert doubt(0.0) == doubt(1.5) == 1.0
    assert doubt(3.0) == pytest.approx(16.0)
    apart = np.linspace(2.0, 50.0, 200)
    pull = [a / (1.0 + doubt(a)) for a in apart]  # of equals, in sigmas
    assert np.all(np.diff(pull) < 0.0)


def test_where_soft_iron_is_believed_the_second_is_doubted_unless_the_tilt_is_its_own():
    """As one number by which its whole covariance grows; where the tilt is its own, it is the bank that is doubted."""
    mean, p, take, theirs, iron = two(7, 1.0)
    before = take @ p @ take.T

    def times(model, own_tilt):
        e = joining(Said(iron, theirs), model)
        e._own_tilt = own_tilt
        got, after, _, apart = e._joined(mean, take, p @ take.T, before, before, EXPECTED)
        assert apart == pytest.approx(1.0)  # neither doubt makes them agree any better
        if own_tilt:
            wide = Tuning().own_tilt_joined * before
            gain = wide @ np.linalg.inv(wide + theirs)
            assert take @ (got - mean) == pytest.approx(gain @ (iron - take @ mean), rel=1e-6)
            left = np.eye(3) - gain  # the error of what was weighed so, were both claims true
            assert after == pytest.approx(left @ before @ left.T + gain @ theirs @ gain.T, rel=1e-6)
            return 1.0
        much = np.linalg.solve(theirs, np.linalg.inv(np.linalg.inv(after) - np.linalg.inv(before)))
        assert much == pytest.approx(much[0, 0] * np.eye(3), abs=1e-5 * much[0, 0])
        return float(much[0, 0])

    assert times(HARD, False) == pytest.approx(1.0, rel=1e-5)
    assert times(SOFT_IRON, False) > 2.0
    assert times(SOFT_IRON, True) == pytest.approx(1.0, rel=1e-5)


def test_of_motors_the_second_knows_nothing():
    """What throttle moves the iron by, at the RMS it was flown with, is white to who does not know of it."""
    mean, p, take, theirs, iron = two(8, 0.5)
    mean[at.K] = (30.0, -40.0, 0.0)
    take[:, at.K] = 0.0
    before = take @ p @ take.T
    iron = take @ mean
    e = joining(Said(iron, theirs))
    e._drives = (0.0, 0.04)
    got = e._joined(mean, take, p @ take.T, before, before, EXPECTED)[1]
    wider = theirs + 0.04 * 2500.0 * np.eye(3)
    assert got == pytest.approx(np.linalg.inv(np.linalg.inv(before) + np.linalg.inv(wider)))


def test_its_sigma_without_the_model_keeps_its_correlations_and_is_never_smaller():
    r = np.random.default_rng(2)
    p = covariance(r, 3, 5.0)
    sigma = np.sqrt(np.diag(p))
    said = Said((0, 0, 0), p, sigma * (0.5, 1.0, 7.0)).said
    own = own_covariance(said)
    assert np.sqrt(np.diag(own)) == pytest.approx(sigma * (1.0, 1.0, 7.0))
    corr = [c / np.sqrt(np.outer(np.diag(c), np.diag(c))) for c in (p, own)]
    assert corr[0] == pytest.approx(corr[1])


# ---------------------------------------------------------------- stale


@given(st.floats(0.0, 600.0), st.floats(0.0, 600.0))
def test_what_began_more_than_two_seconds_before_the_change_is_stale(reach_s, ago_s):
    assert stale(Said((0, 0, 0), np.eye(3), reaches_back_s=reach_s), ago_s) is (reach_s > ago_s + 2.0)


def test_an_opinion_from_before_a_change_is_not_heard_but_how_far_it_is_off_is_told():
    mean, p, take, theirs, iron = two(9, 1.0)
    before = take @ p @ take.T
    e = joining(Said(iron, theirs, reaches_back_s=30.0), changed_ago_s=5.0)
    got, iron_mg2, own_mg2, apart = e._joined(mean, take, p @ take.T, before, before + 1.0, EXPECTED)
    assert np.array_equal(got, mean)
    assert np.array_equal(iron_mg2, before) and np.array_equal(own_mg2, before + 1.0)
    assert apart == pytest.approx(1.0)


def test_in_flight_it_falls_silent_when_the_iron_changes_and_is_heard_again_once_its_data_are_new():
    """A payload of 90 mG dropped at 30 s."""
    iron = np.tile(HARD_IRON_MG, (600, 1))
    iron[300:] += (60.0, -60.0, 40.0)
    flight = placed(samples("figure eight", 3, seconds=60.0, iron_mg=iron))
    e, silent, heard = AdaptiveEstimator(), [], []
    for i, s in enumerate(flight):
        e.step(s)
        if i < 200 or i % 10:
            continue
        alone = copy.copy(e)
        alone._second = None
        with_it, without = e.estimate(EXPECTED), alone.estimate(EXPECTED)
        same = np.array_equal(with_it.hard_iron_b_mg, without.hard_iron_b_mg)
        (silent if same else heard).append(i)
        assert same is stale(e._second, e._change.since_s), i
    assert heard[0] < 300
    assert silent and 300 < min(silent) < 380
    assert max(heard) > max(silent)


# ---------------------------------------------------------------- without one


def test_without_a_second_opinion_the_answer_is_the_banks_own():
    e = taught(placed(samples("figure eight", 21, seconds=20.0)), AdaptiveEstimator(second=False))
    mean, p = e._bank.mixture()
    got = e.estimate(EXPECTED)
    assert got.hard_iron_b_mg == pytest.approx(mean[at.B] + e._drives[0] * mean[at.K], abs=1e-12)
    assert got.covariance_mg2 == pytest.approx(p[at.B, at.B], abs=1e-9)
    assert got.apart == pytest.approx(1.2 * surprise(mean[at.H], mean[at.V], HERE, N))  # only the world model's word
    assert (got.horizontal_mg, got.down_mg) == (mean[at.H], mean[at.V])


def test_a_second_opinion_that_knows_nothing_yet_changes_nothing():
    e = taught(placed(samples("figure eight", 21, seconds=20.0)))
    e._second = TwostepEstimator()
    alone = copy.copy(e)
    alone._second = None
    a, b = e.estimate(EXPECTED), alone.estimate(EXPECTED)
    assert np.array_equal(a.hard_iron_b_mg, b.hard_iron_b_mg) and np.array_equal(a.covariance_mg2, b.covariance_mg2)


def test_joined_it_is_surer_than_either_and_no_less_right():
    """Errors over a dozen flights: honest, and in the mean not worse than the bank's alone."""
    errors = []
    for seed in range(6):
        e = taught(placed(samples("figure eight", 60 + seed, seconds=25.0)))
        alone = copy.copy(e)
        alone._second = None
        both = [one.estimate(EXPECTED) for one in (e, alone)]
        said = e._second.estimate(EXPECTED)
        sigma = [np.diag(o.covariance_mg2) for o in (*both, said)]
        assert np.all(sigma[0] <= np.minimum(sigma[1], doubt(both[0].apart) * 10.0 * sigma[2]) + 1e-9)
        errors.append([o.hard_iron_b_mg - HARD_IRON_MG for o in both])
    rms = np.sqrt(np.mean(np.square(errors), axis=(0, 2)))
    assert rms[0] < 1.2 * rms[1]


# ---------------------------------------------------------------- competing


def block_at(roll, pitch, yaw, z):
    gathering = Gathering()
    (s,) = samples("figure eight", 5, seconds=1.0)[:1]
    gathering.add(s, z, body_from_earth(roll, pitch, yaw), 0.0, 0.0)
    return gathering.close()


@settings(max_examples=25, deadline=None)
@given(st.floats(-2.5, 2.5), st.floats(-1.2, 1.2), st.floats(-3, 3), st.floats(-3, 3), st.booleans())
def test_what_joins_begins_at_that_iron_with_north_where_the_last_reading_shows_it(roll, pitch, yaw, north, known):
    body = body_from_earth(roll, pitch, yaw)
    u = body @ (HERE[0] * math.cos(north), HERE[0] * math.sin(north), HERE[1])
    iron, sigma = np.array((120.0, -80.0, 33.0)), np.array((4.0, 5.0, 6.0))
    bank = Bank.begun((HERE[0], 4.0, HERE[1], 4.0), N)
    before = copy.deepcopy(bank)
    bank.join(iron, sigma, block_at(roll, pitch, yaw, u + iron), HERE if known else None, N)
    k = len(before)
    assert len(bank) == k + len(MODELS)
    for name in ("x", "p", "model", "log_weight", "white_mg2", "last"):
        assert np.array_equal(getattr(bank, name)[:k], getattr(before, name))
    new = slice(k, None)
    assert bank.model[new].tolist() == list(range(len(MODELS)))
    assert bank.x[new, at.B] == pytest.approx(np.tile(iron, (3, 1)))
    assert [math.remainder(a - north, math.tau) for a in bank.x[new, at.ALPHA]] == pytest.approx([0.0] * 3, abs=1e-9)
    assert bank.x[new, at.H : at.V + 1] == pytest.approx(np.tile(HERE, (3, 1)))
    p = bank.p[new]
    assert np.einsum("kii->ki", p)[:, at.B] == pytest.approx(np.tile(sigma**2, (3, 1)))
    want = field_covariance(*HERE, N) if known else None
    assert want is None or p[0, at.H : at.V + 1, at.H : at.V + 1] == pytest.approx(want)
    assert bank.log_weight[new] == pytest.approx(
        before.log_weight.max() - N.join_behind + np.log([m.weight for m in MODELS])
    )
    assert bank.walk_mg[new].tolist() == [m.iron_walk_mg for m in MODELS]


def led_astray(second, off_mg):
    """An estimator whose every hypothesis has been made sure of an iron that is wrong, and what it finds afterwards."""
    flight = placed(samples("figure eight", 31, seconds=60.0))
    e = taught(flight[:250], AdaptiveEstimator(second=second))
    e._bank.x[:, at.B] += off_mg
    for part in (at.B,):
        e._bank.p[:, part, :] = 0.0
        e._bank.p[:, :, part] = 0.0
    np.einsum("kii->ki", e._bank.p)[:, at.B] = 0.5**2
    e._change.step = lambda *_: False  # whoever is astray for long has no change to notice
    wrong = []
    for s in flight[250:]:
        e.step(s)
        wrong.append(float(np.abs(e._bank.mixture()[0][at.B] - HARD_IRON_MG).max()))
    return np.array(wrong)


def test_a_bank_that_is_sure_of_a_wrong_iron_is_brought_back_by_the_second():
    off = np.array((90.0, -120.0, 60.0))
    alone, with_it = led_astray(False, off), led_astray(True, off)
    assert alone[100:150].mean() > 30.0  # 10 to 15 s later it still is
    assert with_it[150:].max() < 10.0


def test_nobody_competes_who_agrees_or_is_stale_or_was_just_there():
    e = taught(placed(samples("figure eight", 33, seconds=30.0)))
    block = block_at(0.1, 0.2, 0.3, np.array((300.0, 0.0, 600.0)))
    iron, p = e._bank.mixture()[0][at.B], e._second.estimate(None).covariance_mg2
    k = len(e._bank)
    for second, joins in (
        (Said(iron, p), False),
        (Said(iron + 150.0, p, reaches_back_s=1e12), False),
        (Said(iron + 150.0, p), True),
    ):
        one = copy.deepcopy(e)
        one._second, one._joined_ago_s = second, 100.0
        one._compete(block)
        assert len(one._bank) == k + joins * len(MODELS)
        assert one._joined_ago_s == (0.0 if joins else 100.0)
    again = replace_second(e, Said(iron + 150.0, p))
    counts = []
    for s in placed(samples("figure eight", 33, seconds=60.0))[300:]:
        again.step(s)
        counts.append(again._joined_ago_s)
    begun = np.flatnonzero(np.diff(counts) < 0.0)
    assert len(begun) >= 2 and np.diff(begun).min() >= N.join_every_s * 10.0


def replace_second(e, second):
    out = copy.deepcopy(e)
    out._second = second
    return out


# ---------------------------------------------------------------- the answer's algebra


@given(st.floats(0.1, 1e4), st.floats(0.1, 1e4), st.floats(-0.99, 0.99))
def test_the_inverse_of_two_by_two(a, c, rho):
    b = rho * math.sqrt(a * c)
    assert np.array(inverse2(a, b, c)) == pytest.approx(np.linalg.inv(np.array(((a, b), (b, c)))), rel=1e-6)


@settings(max_examples=50, deadline=None)
@given(SEEDS, st.floats(-1.0, 1.0))
def test_without_the_models_word_nobody_is_surer(seed, learnt):
    """Whatever was made of the field, from all (1) to nothing (0) and less, by time; and it stays a covariance."""
    r = np.random.default_rng(seed)
    prior = field_covariance(*HERE, N)
    field = (1.0 - 0.999 * learnt) * prior
    root = r.normal(0.0, 1.0, (2, 3))
    cross = np.linalg.cholesky(field) @ root
    iron = root.T @ root + np.diag(r.uniform(0.5, 9.0, 3))  # no more shared than there is
    out = without_prior(iron, cross, field, *HERE, N)
    assert np.isfinite(out).all() and np.array_equal(out, out.T)
    assert np.linalg.eigvalsh(out - iron).min() > -1e-6 * np.abs(out).max()


def test_symmetric_is_the_mean_of_both_halves():
    m = np.arange(9.0).reshape(3, 3)
    assert symmetric(m) == pytest.approx((m + m.T) / 2.0)
    assert np.array_equal(symmetric(np.asarray(IDENTITY3)), np.eye(3))
