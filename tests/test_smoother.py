"""All of a flight as one least squares: against the same solved densely, and the parts against those that fly."""

from dataclasses import replace

import numpy as np
import pytest
from honest_flight import EXPECTED, samples
from hypothesis import given
from hypothesis import strategies as st
from synthetic_flight import HARD_IRON_MG

from magmav.core.after_flight import after_flight
from magmav.core.estimators.adaptive import AdaptiveEstimator
from magmav.core.estimators.adaptive import layout as at
from magmav.core.estimators.adaptive.measurement import equation, shared_by_all, smear
from magmav.core.estimators.adaptive.robust import Stillness, WildGate
from magmav.core.estimators.adaptive.tuning import HARD, MODELS, SOFT_IRON, Tuning
from magmav.core.smoother import changes, smooth
from magmav.core.smoother.chain import PASSING, STAYING, Chain, Way, staying_prior
from magmav.core.smoother.columns import Columns, still, wild
from magmav.core.smoother.linear import linear
from magmav.core.smoother.nodes import Nodes
from magmav.core.smoother.noise import Noise
from magmav.core.stretch import framed
from magmav.core.types import vec3

N = Tuning()
FIELD = (EXPECTED.horizontal_mg, N.model_mg, EXPECTED.down_mg, N.model_mg)
WALKS = sorted({m.iron_walk_mg for m in MODELS})


def flown(seconds=6.0, seed=3, motion="figure eight"):
    here = (EXPECTED.horizontal_mg, EXPECTED.down_mg)
    return framed([replace(s, model_mg=here) for s in samples(motion, seed, seconds=seconds)])


def made(seconds=6.0, noise=None, gap_at=None, tuning=N):
    """Nodes of a short flight, a path about which it is linear, and what is linear there."""
    flight = flown(seconds)
    if gap_at is not None:
        flight[gap_at] = replace(flight[gap_at], gap=True)
    nodes = Nodes.of(Columns.of(flight, tuning), tuning)
    rng = np.random.default_rng(5)
    x = rng.normal(0.0, 0.01, (len(nodes), at.SIZE))
    x[:, at.H], x[:, at.V] = FIELD[0], FIELD[2]
    x[:, at.B] = HARD_IRON_MG
    noise = noise or Noise(9.0, 4.0, 2.0)
    return nodes, x, noise, linear(nodes, x, noise, tuning)


# ---------------------------------------------------------------- the equation, linear


def test_information_is_that_of_every_nodes_own_covariance():
    """Taken node by node with the whole covariance written out; robust weights are one where noise is wide."""
    wide = Noise(300.0**2, 100.0**2, 2.0)
    nodes, x, noise, (info, left) = made(noise=wide)
    assert nodes.there.all(axis=1).any() and not nodes.there.all()  # some are full, some are not
    for i in range(len(nodes)):
        m = int(nodes.there[i].sum())
        _, j, of_u = equation(x[i : i + 1], nodes.readings(i, i + 1))
        expected = noise.common_mg2 * shared_by_all(m, 3) + noise.white_mg2 * np.eye(3 * m)
        own = smear(of_u, nodes.readings(i, i + 1), N.sync_s)[0]
        for a in range(m):
            expected[3 * a : 3 * a + 3, 3 * a : 3 * a + 3] += own[a]
        rows = j[0, :m].reshape(3 * m, at.SIZE)
        target = left[i, :m].ravel() + rows @ x[i]
        both = np.column_stack((rows, target))
        assert info[i] == pytest.approx(both.T @ np.linalg.solve(expected, both), rel=1e-6, abs=1e-6)


def test_a_strange_reading_counts_less_and_its_neighbours_as_before():
    nodes, x, noise, (info, _) = made()
    z = nodes.columns.z.copy()
    z[nodes.rows[4, 1]] += 500.0
    struck = replace(nodes, columns=replace(nodes.columns, z=z))
    again, _ = linear(struck, x, noise, N)
    assert np.trace(again[4][:-1, :-1]) < np.trace(info[4][:-1, :-1])
    assert np.array_equal(np.delete(again, 4, axis=0), np.delete(info, 4, axis=0))


# ---------------------------------------------------------------- the chain against a dense solution


def dense(nodes, info, way, which, model):
    """Normal matrix and right side of everything at once, unknowns node by node and then what stays; log of priors."""
    n, p, s = len(nodes), len(PASSING), len(STAYING)
    matrix, right = np.zeros((n * p + s, n * p + s)), np.zeros(n * p + s)
    square, log_prior = 0.0, 0.0
    stays = slice(n * p, None)
    for i in range(n):
        mine = np.concatenate((np.arange(i * p, (i + 1) * p), np.arange(n * p, n * p + s)))
        order = np.concatenate((PASSING, STAYING))
        matrix[np.ix_(mine, mine)] += info[i][np.ix_(order, order)]
        right[mine] += info[i][order, -1]
        square += info[i][-1, -1]
    matrix[range(p), range(p)] += way.first
    log_prior += np.log(way.first).sum()
    for i in range(n - 1):
        for k in range(p):
            tie = way.ties[i, which, k]
            row = np.zeros(n * p + s)
            row[(i + 1) * p + k], row[i * p + k] = 1.0, -way.fades[i, k]
            turned = 0.0
            if k == 0:
                row[n * p + np.searchsorted(STAYING, range(at.G.start, at.G.stop))] = -nodes.down_s[i]
                turned = nodes.turned_rad[i]
            matrix += tie * np.outer(row, row)
            right += tie * turned * row
            square += tie * turned**2
            log_prior += np.log(tie) if tie > 0.0 else 0.0
    mean, information = staying_prior(FIELD, model, N)
    matrix[stays, stays] += information
    right[stays] += information @ mean
    square += mean @ information @ mean
    log_prior += np.linalg.slogdet(information)[1]
    best = np.linalg.solve(matrix, right)
    evidence = 0.5 * (log_prior - np.linalg.slogdet(matrix)[1] - square + right @ best)
    return best, np.linalg.inv(matrix), evidence


@pytest.mark.parametrize("gap_at", [None, 30])
@pytest.mark.parametrize("model", MODELS)
def test_node_by_node_is_what_all_at_once_is(gap_at, model):
    nodes, _, noise, (info, _) = made(gap_at=gap_at)
    assert nodes.lost.any() == (gap_at is not None)
    opened = np.zeros(len(nodes) - 1)
    opened[7] = 50.0
    way, which = Way.of(nodes, noise, WALKS, opened, N), WALKS.index(model.iron_walk_mg)
    solved = Chain(nodes, info, way).solve(which, FIELD, model, N)
    best, covariance, evidence = dense(nodes, info, way, which, model)
    n, p = len(nodes), len(PASSING)
    sigma = np.sqrt(np.diag(covariance))
    got = np.concatenate((solved.passing.ravel(), solved.staying))
    assert np.all(np.abs(got - best) < 1e-6 * sigma)
    assert solved.log_evidence == pytest.approx(evidence, rel=1e-7)
    for i in (0, 8, n - 1):
        mine = np.concatenate((np.arange(i * p, (i + 1) * p), np.arange(n * p, len(best))))
        order = np.concatenate((PASSING, STAYING))
        want = np.empty((at.SIZE, at.SIZE))
        want[np.ix_(order, order)] = covariance[np.ix_(mine, mine)]
        scale = np.sqrt(np.outer(np.diag(want), np.diag(want)))
        assert np.all(np.abs(solved.covariance(i) - want) < 1e-6 * scale)
        assert solved.path_at(i)[order] == pytest.approx(best[mine], rel=1e-6, abs=1e-9)
    moved, spread = solved.step_covariance()
    pick = np.zeros((3, len(best)))
    pick[:, 8 * p + 1 : 8 * p + 4], pick[:, 7 * p + 1 : 7 * p + 4] = np.eye(3), -np.eye(3)
    assert moved[7] == pytest.approx(pick @ best, rel=1e-6, abs=1e-9)
    assert spread[7] == pytest.approx(pick @ covariance @ pick.T, rel=1e-6)


def test_the_chi_squared_of_a_step_is_what_letting_it_go_takes_off_the_misfit():
    nodes, _, noise, (info, _) = made()
    closed, opened = np.zeros(len(nodes) - 1), np.zeros(len(nodes) - 1)
    place, free_mg = 6, 1e5
    opened[place] = free_mg

    def misfit(step_mg):
        """Twice the log evidence less its determinants: chi squared at the best path."""
        way = Way.of(nodes, noise, WALKS, step_mg, N)
        _, covariance, evidence = dense(nodes, info, way, 0, HARD)
        log_prior = np.log(way.ties[:, 0]).sum()
        return -2.0 * evidence + log_prior + np.linalg.slogdet(covariance)[1]

    solved = Chain(nodes, info, Way.of(nodes, noise, WALKS, closed, N)).solve(0, FIELD, HARD, N)
    chi2, length_mg = changes.steps(solved, 3)
    assert chi2[place] == pytest.approx(misfit(closed) - misfit(opened), rel=1e-3)
    free = Chain(nodes, info, Way.of(nodes, noise, WALKS, opened, N)).solve(0, FIELD, HARD, N)
    assert length_mg[place] == pytest.approx(np.linalg.norm(free.step_covariance()[0][place]), rel=1e-2)


def test_evidence_prefers_the_model_that_made_the_data():
    """Of two models alike but for soft iron, the one with room for it is believed only where there is some."""
    plain, soft = flown(60.0), np.eye(3) + np.array([[0.06, 0.03, 0.0], [0.03, -0.05, 0.02], [0.0, 0.02, 0.03]])
    bent = [replace(s, mag_b_mg=vec3(HARD_IRON_MG + soft @ (s.mag_b_mg - HARD_IRON_MG), "mag")) for s in plain]
    for flight, best in ((plain, HARD), (bent, SOFT_IRON)):
        evidence = [one.log_evidence for one in smooth(flight).solved]
        assert MODELS[int(np.argmax(evidence))] is best


# ---------------------------------------------------------------- the parts against those that fly


class Listening(AdaptiveEstimator):
    """Keeps the blocks it takes in."""

    def __init__(self):
        super().__init__(second=False)
        self.blocks = []

    def _take_in(self, block):
        self.blocks.append(block)
        super()._take_in(block)


def test_nodes_are_the_blocks_of_the_estimator_that_flies():
    flight = flown(20.0)
    flight[40] = replace(flight[40], gap=True)
    for i in range(70, 76):
        flight[i] = replace(flight[i], learn=False)
    flight[100] = replace(flight[100], mag_b_mg=vec3(flight[100].mag_b_mg + 400.0, "mag"))  # wild
    one = Listening()
    for s in flight:
        one.step(s)
    mine = list(Nodes.of(Columns.of(flight, N), N).blocks())
    assert len(mine) in (len(one.blocks), len(one.blocks) + 1)  # the last one need not be full
    for i, (got, want) in enumerate(zip(mine, one.blocks, strict=False)):
        for name in ("z", "body_from_own", "turns_b", "rate_rads2", "ahead_s", "calmed_rad"):
            assert getattr(got, name) == pytest.approx(getattr(want, name), abs=1e-9), name
        for name in ("dt_s", "down_s", "turn_rad2", "turned_rad"):
            assert i == 0 or getattr(got, name) == pytest.approx(getattr(want, name), rel=1e-9, abs=1e-12), name


readings = st.lists(st.tuples(st.floats(-500, 500), st.floats(-500, 500), st.floats(-500, 500)), max_size=25)


@given(readings, st.floats(0.0, 0.2))
def test_all_wild_readings_at_once_are_those_found_one_by_one(rows, turn):
    z, gate = np.array(rows).reshape(-1, 3), WildGate()
    turns = np.full(len(z), turn)
    assert wild(z, turns).tolist() == [gate.step(row, turn) for row in z]


speeds = st.lists(st.sampled_from((0.0, 0.001, 0.03, 0.2)), min_size=1, max_size=12)


@given(speeds, st.floats(0.05, 0.3), st.integers(0, 2**16))
def test_all_that_stands_still_at_once_is_what_is_found_one_by_one(rates, dt_s, seed):
    """Stretches of some seconds at one speed each, the field with as little noise as a table shows."""
    rng = np.random.default_rng(seed)
    speed = np.repeat(rates, round(4.0 / dt_s) // 2)
    z = np.cumsum(speed[:, None] * rng.normal(0.0, 30.0, (len(speed), 3)), axis=0) + rng.normal(
        0.0, 0.5, (len(speed), 3)
    )
    dt, watch = np.full(len(speed), dt_s), Stillness()
    learn = rng.random(len(speed)) < 0.97
    one_by_one = [bool(taught) and watch.step(*row) for taught, *row in zip(learn, z, speed, dt, strict=True)]
    assert still(z, speed, dt, learn).tolist() == one_by_one


@pytest.mark.parametrize("seed", range(3))
def test_noise_that_was_put_in_is_found(seed):
    rng = np.random.default_rng(seed)
    nodes, x, _, _ = made(seconds=60.0)
    count, m = nodes.rows.shape
    white, common, disturbance = 5.0, 4.0, 6.0
    slow = np.zeros((count, 3))
    for i in range(1, count):
        fade = np.exp(-nodes.dt_s[i - 1] / N.disturbance_tau_s)
        slow[i] = fade * slow[i - 1] + np.sqrt(1.0 - fade**2) * rng.normal(0.0, disturbance, 3)
    shared = rng.normal(0.0, common, (count, 1, 3))
    left = rng.normal(0.0, white, (count, m, 3)) + shared + slow[:, None]
    x[:, at.D] = 0.0
    found = Noise.first(N).seen(nodes, left, x, N)
    assert found.white_mg2**0.5 == pytest.approx(white, rel=0.2)
    assert found.common_mg2**0.5 == pytest.approx(common, rel=0.5)
    assert found.disturbance_mg == pytest.approx(disturbance, rel=0.3)


def test_what_is_foretold_hears_nothing_of_what_came_after():
    flight = flown(40.0)
    half = len(flight) // 2
    until_ns, other_mg = flight[half].boot_ns, np.array((90.0, -60.0, 40.0))
    other = [s if s.boot_ns <= until_ns else replace(s, mag_b_mg=vec3(s.mag_b_mg + other_mg, "mag")) for s in flight]
    one, two = (after_flight(f, until_ns=until_ns) for f in (flight, other))
    assert np.array_equal(one.foretold.hard_iron_b_mg, two.foretold.hard_iron_b_mg)
    assert np.array_equal(one.foretold.covariance_mg2, two.foretold.covariance_mg2)
    assert not np.allclose(one.answer.hard_iron_b_mg, two.answer.hard_iron_b_mg, atol=10.0)


def test_a_long_flight_has_longer_nodes_and_the_same_answer():
    flight = flown(90.0)
    few = replace(N, nodes_most=60)
    one, two = after_flight(flight), after_flight(flight, few)
    assert len(Nodes.of(Columns.of(flight, few), few)) < 70 < len(Nodes.of(Columns.of(flight, N), N))
    sigma = np.sqrt(np.diag(one.answer.covariance_mg2))
    assert np.all(np.abs(one.answer.hard_iron_b_mg - two.answer.hard_iron_b_mg) < 0.7 * sigma)
