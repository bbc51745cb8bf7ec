"""The adaptive bank: its equation against finite differences, its algebra against filterpy's, and flights."""

import copy
import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter
from honest_flight import EXPECTED, MOTIONS, samples
from synthetic_flight import HARD_IRON_MG

from magmav.core.estimators import ESTIMATORS
from magmav.core.estimators.adaptive import AdaptiveEstimator
from magmav.core.estimators.adaptive import layout as at
from magmav.core.estimators.adaptive.answer import without_prior
from magmav.core.estimators.adaptive.bank import Bank, field_covariance
from magmav.core.estimators.adaptive.block import Gathering
from magmav.core.estimators.adaptive.measurement import equation, smear, soft_matrix
from magmav.core.estimators.adaptive.process import advance
from magmav.core.estimators.adaptive.tuning import MODELS, Tuning
from magmav.core.rotation import body_from_earth
from magmav.core.types import ZERO3, Shaping, mat3, vec3

HERE = (EXPECTED.horizontal_mg, EXPECTED.down_mg)


def placed(flight):
    return [replace(s, model_mg=HERE) for s in flight]


def taught(flight, estimator=None):
    estimator = estimator or AdaptiveEstimator()
    for s in flight:
        estimator.step(s)
    return estimator


def states(seed, k=4):
    """Plausible states, far enough from zero that every term shows."""
    rng = np.random.default_rng(seed)
    x = np.zeros((k, at.SIZE))
    x[:, at.ALPHA] = rng.uniform(-3, 3, k)
    x[:, at.B] = rng.normal(0, 200, (k, 3))
    x[:, at.H], x[:, at.V] = rng.uniform(150, 300, k), rng.uniform(-450, 450, k)
    for part, size in ((at.E, 0.01), (at.D, 4), (at.K, 50), (at.G, 0.01), (at.R, 0.01)):
        x[:, part] = rng.normal(0, size, x[:, part].shape)
    x[:, at.T], x[:, at.KAPPA] = rng.normal(0, 0.03, k), rng.normal(0, 0.02, k)
    return x


def readings_of(seed, n):
    """n times (attitude, turn rate, throttle - 1/2): at any attitude, turning fast."""
    rng = np.random.default_rng(200 + seed)
    return [
        (body_from_earth(*rng.uniform(-3, 3, 3)), rng.normal(0, 0.5, 3), float(rng.uniform(-0.5, 0.5)))
        for _ in range(n)
    ]


def block_of(seed, n=3):
    """Those readings in a row, through a matrix that is not the identity."""
    rng = np.random.default_rng(100 + seed)
    shaping = Shaping(mat3(np.eye(3) + rng.normal(0, 0.05, (3, 3)), "matrix"), ZERO3)
    gathering = Gathering()
    (first,) = samples("figure eight", 5, seconds=1.0)[:1]
    for body, rate, drive in readings_of(seed, n):
        gathering.passes(0.07, body[:, 2], 1e-6)
        s = replace(first, shaping=shaping, rate_b_rads=vec3(rate, "rate"))
        gathering.add(s, rng.normal(0, 300, 3), body, 0.01, drive)
    return gathering.close()


@pytest.mark.parametrize("seed", range(4))
def test_every_column_of_the_jacobian_is_the_derivative(seed):
    """At S = 0, whatever the tilt error, mounting, delay and kappa."""
    x, block = states(seed), block_of(seed)
    x[:, at.E] = x[:, at.R] = x[:, at.T : at.T + 1] = x[:, at.KAPPA : at.KAPPA + 1] = 0.0
    _, j, of_u = equation(x, block)
    u = of_u[..., (2, 0, 1), (1, 2, 0)]
    assert of_u == pytest.approx(-of_u.swapaxes(2, 3))
    assert np.linalg.norm(u, axis=2) == pytest.approx(np.tile(np.hypot(x[:, at.H], x[:, at.V]), (3, 1)).T)
    x[:, at.E] *= 10.0  # some six degrees
    _, j, _ = equation(x, block)
    for i in range(at.SIZE):
        step = 1e-6 * max(1.0, float(np.abs(x[:, i]).max()))
        up, down = x.copy(), x.copy()
        up[:, i] += step
        down[:, i] -= step
        slope = (equation(up, block)[0] - equation(down, block)[0]) / (2 * step)
        assert slope == pytest.approx(j[..., i], rel=1e-6, abs=1e-5), i


def test_the_equation_is_the_one_that_is_written():
    """Term by term, in plain matrices, for one hypothesis and one reading."""
    x, block = states(8, k=1), block_of(8, n=2)
    (y, *_), (row,) = equation(x, block)[0], x
    for i, (r, rate, drive) in enumerate(readings_of(8, 2)):
        a = row[at.ALPHA] - row[at.G] @ block.ahead_s[i]
        u = r @ (row[at.H] * math.cos(a), row[at.H] * math.sin(a), row[at.V])
        lean = np.cross((0.0, 0.0, 1.0), r[:, 2])
        moved = r @ (*row[at.E], 0.0) + (*row[at.R], 0.0) + row[at.KAPPA] * lean
        q = moved + row[at.T] * rate
        turned = u + np.cross(q, u) + 0.5 * np.cross(q, np.cross(q, u))
        want = (np.eye(3) + soft_matrix(row[at.S])) @ turned + block.shaping.matrix @ row[at.B]
        assert y[i] == pytest.approx(want + row[at.D] + drive * row[at.K])


def test_time_is_f_p_f_and_q():
    rng = np.random.default_rng(1)
    n, dt = Tuning(), 0.7
    bank = Bank.begun((*HERE[:1], 5.0, HERE[1], 5.0), n)
    bank.keep(np.arange(4))
    root = rng.normal(0, 1, (4, at.SIZE, at.SIZE))
    bank.x, bank.p = states(2), root @ root.transpose(0, 2, 1)
    bank.walk_mg, bank.disturbance_mg = np.array((0.05, 1.5, 0.05, 0.3)), np.full(4, 2.0)
    down = np.array((0.1, -0.2, 0.6))
    for own, sigma, tau in ((None, n.tilt_rad, n.tilt_tau_s), (0.05, 0.05 * n.own_tilt_doubt, n.own_tilt_tau_s)):
        f, q = np.eye(at.SIZE), np.zeros((4, at.SIZE, at.SIZE))
        f[at.ALPHA, at.G] = down
        tilt, short = math.exp(-dt / tau), math.exp(-dt / n.disturbance_tau_s)
        f[at.E, at.E], f[at.D, at.D] = tilt * np.eye(2), short * np.eye(3)
        q[:, 0, 0] = 0.02
        for i in range(3):
            q[:, at.B.start + i, at.B.start + i] = bank.walk_mg**2 * dt
            q[:, at.D.start + i, at.D.start + i] = (1 - short**2) * bank.disturbance_mg**2
        for i in range(2):
            q[:, at.E.start + i, at.E.start + i] = (1 - tilt**2) * sigma**2
        want_x, want_p = bank.x @ f.T, f @ bank.p @ f.T + q
        advance(bank, dt, down, 0.02, own, n)
        assert bank.x == pytest.approx(want_x, abs=1e-12)
        assert bank.p == pytest.approx(want_p, rel=1e-10, abs=1e-10)


@pytest.mark.parametrize("readings", [1, 4])
def test_a_bank_of_one_is_filterpys_extended_kalman_filter_step_for_step(readings):
    """Same model, same noise, no doubt and no adaptation: only the algebra is left."""
    calm = Tuning(
        doubt_nis=1e12,
        least_tilt_rad=0.0,
        adapt_after=10**9,
        change_chi2=1e12,
        prune_every=10**9,
        block_readings=readings,
    )
    mine = AdaptiveEstimator(replace(calm, block_s=10.0), second=False)
    flight = placed(samples("figure eight", 5, seconds=12.0))
    bank = Bank.begun((HERE[0], calm.model_mg, HERE[1], calm.model_mg), calm)
    bank.keep(np.array([3]))
    mine._bank, mine._model_mg = bank, HERE
    mine._still._still_s = -1e9  # it has long been moving
    theirs = ExtendedKalmanFilter(dim_x=at.SIZE, dim_z=3 * readings)
    theirs.x, theirs.P = bank.x[0].copy(), bank.p[0].copy()
    copy_of, gathering, yaw = copy.deepcopy(bank), Gathering(), 0.0
    for i, s in enumerate(flight, 1):
        yaw += s.yaw_step_rad
        body = body_from_earth(s.roll_rad, s.pitch_rad, yaw)
        about_down = float(s.rate_b_rads @ body[:, 2]) * s.dt_s
        turn2 = calm.turn_walk_rad**2 * s.dt_s + (calm.turn_scale * about_down) ** 2
        gathering.passes(s.dt_s, body[:, 2], turn2)
        gathering.add(s, s.mag_b_mg, body, 0.0, 0.0)
        mine.step(s)
        if i % readings:
            continue
        block = gathering.close()
        copy_of.x, copy_of.p = theirs.x[None].copy(), theirs.P[None].copy()
        if i > readings:
            advance(copy_of, block.dt_s, block.down_s, block.turn_rad2, None, calm)
        theirs.x, theirs.P = copy_of.x[0], copy_of.p[0]
        y, j, of_u = equation(copy_of.x, block)
        r = np.kron(np.ones((readings, readings)), calm.common_mg**2 * np.eye(3))
        for m, one in enumerate(smear(of_u, block, calm.sync_s)[0]):
            r[3 * m : 3 * m + 3, 3 * m : 3 * m + 3] += one + calm.white_mg**2 * np.eye(3)
        rows, said = j[0].reshape(-1, at.SIZE).copy(), y[0].ravel().copy()
        theirs.update(block.z.ravel(), lambda _, j=rows: j, lambda _, y=said: y, R=r)
        assert mine._bank.x[0] == pytest.approx(theirs.x, rel=1e-8, abs=1e-7)
        assert mine._bank.p[0] == pytest.approx(theirs.P, rel=1e-5, abs=1e-6)


def test_taking_the_prior_back_leaves_what_the_data_say():
    """Linear and Gaussian: with the wide prior from the start the covariance is the same."""
    rng = np.random.default_rng(3)
    n = Tuning()
    rows = rng.normal(0, 1, (40, at.SIZE))
    other = np.diag(rng.uniform(0.5, 2.0, at.SIZE))
    hv = slice(at.H, at.V + 1)
    information = rows.T @ rows + other
    known, wide = information.copy(), information.copy()
    known[hv, hv] += np.linalg.inv(field_covariance(*HERE, n))
    wide[hv, hv] += np.diag((1 / n.blind_h_mg[1] ** 2, 1 / n.blind_v_mg**2))
    p = np.linalg.inv(known)
    got = without_prior(p[at.B, at.B], p[hv, at.B], p[hv, hv], *HERE, n)
    assert got == pytest.approx(np.linalg.inv(wide)[at.B, at.B], rel=1e-6, abs=1e-9)


def test_merging_hypotheses_keeps_all_belief():
    n = Tuning()
    bank = Bank.begun((*HERE[:1], 5.0, HERE[1], 5.0), n)
    bank.x[:, at.ALPHA] = 0.3
    bank.log_weight = np.log(np.random.default_rng(1).uniform(0.1, 1.0, len(bank)))
    before = {m: bank.weights()[bank.model == m].sum() for m in range(len(MODELS))}
    bank.tidy(n, 6)
    assert len(bank) == len(MODELS)
    assert dict(zip(bank.model.tolist(), bank.weights(), strict=True)) == pytest.approx(before)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda e: pickle.loads(pickle.dumps(e))])
def test_stopping_and_resuming_changes_no_bit(copied):
    flight = placed(samples("survey", 7, seconds=20.0))
    one = taught(flight)
    two = taught(flight[90:], copied(taught(flight[:90])))
    a, b = one.estimate(EXPECTED), two.estimate(EXPECTED)
    assert np.array_equal(a.hard_iron_b_mg, b.hard_iron_b_mg)
    assert np.array_equal(a.covariance_mg2, b.covariance_mg2)
    assert len(pickle.dumps(one)) < 50_000


@pytest.mark.parametrize("motion", MOTIONS)
def test_it_is_right_and_knows_how_right(motion):
    ratios = []
    for seed in range(8):
        e = taught(placed(samples(motion, 40 + seed))).estimate(EXPECTED)
        sigma = np.sqrt(np.diag(e.covariance_mg2))
        ratios.append((e.hard_iron_b_mg - HARD_IRON_MG) / sigma)
        assert np.all(sigma < 12.0)
    assert 0.2 < np.sqrt(np.mean(np.square(ratios))) < 1.3


def test_a_step_of_the_iron_is_followed_within_eight_seconds():
    iron = np.tile(HARD_IRON_MG, (600, 1))
    iron[300:] += (45.0, -45.0, 30.0)
    flight = placed(samples("figure eight", 3, seconds=60.0, iron_mg=iron))
    e = taught(flight[:380])
    got = e.estimate(EXPECTED)
    assert got.changed_ago_s < 8.0
    assert np.abs(got.hard_iron_b_mg - iron[-1])[:2] == pytest.approx(0.0, abs=6.0)


def test_soft_iron_is_told_from_hard():
    bend = np.array([[1.05, 0.02, -0.03], [0.02, 0.96, 0.03], [-0.03, 0.03, 1.01]])
    plain = samples("figure eight", 9, seconds=120.0, iron_mg=np.zeros(3), whole=False)
    bent = [replace(s, mag_b_mg=vec3(bend @ s.mag_b_mg + HARD_IRON_MG, "m")) for s in placed(plain)]
    e = taught(bent).estimate(EXPECTED)
    assert np.linalg.inv(e.soft_iron_b) == pytest.approx(bend, abs=0.02)
    assert e.hard_iron_b_mg == pytest.approx(HARD_IRON_MG, abs=8.0)


def test_without_a_position_it_learns_and_with_one_later_it_is_surer():
    flight = samples("figure eight", 11, seconds=40.0)
    blind = taught(flight).estimate(None)
    late = taught([*flight[:200], *placed(flight[200:])]).estimate(EXPECTED)
    sigma = [np.sqrt(np.diag(e.covariance_mg2)) for e in (blind, late)]
    assert sigma[1][2] < 0.9 * sigma[0][2]  # down is what the model knows best
    for e, s in zip((blind, late), sigma, strict=True):
        assert np.all(np.abs(e.hard_iron_b_mg - HARD_IRON_MG) < 4.0 * s + 3.0)


def test_being_told_the_field_makes_no_hypothesis_less_sure_of_anything():
    """Of the mixture that is no law: belief may shift to a wider one."""
    bank = taught(samples("figure eight", 11, seconds=20.0))._bank
    before = np.einsum("kii->ki", bank.p).copy()
    bank.tell_field(*HERE, Tuning())
    after = np.einsum("kii->ki", bank.p)
    assert np.all(after <= before * (1.0 + 1e-9))
    assert np.all(after[:, at.V] < 0.5 * before[:, at.V])


def test_after_a_gap_any_heading_is_possible_and_the_iron_is_kept():
    flight = placed(samples("figure eight", 13, seconds=40.0))
    e = taught(flight[:300])
    before = e.estimate(EXPECTED).hard_iron_b_mg
    turned = [replace(flight[300], gap=True, yaw_step_rad=2.5), *flight[301:]]
    after = taught(turned, e).estimate(EXPECTED)
    assert after.hard_iron_b_mg == pytest.approx(before, abs=6.0)
    assert after.changed_ago_s > 1000.0


def test_it_can_be_chosen():
    assert isinstance(ESTIMATORS["adaptive"](), AdaptiveEstimator)
