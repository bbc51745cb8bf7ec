"""All of a flight at once: the measurement equation of every reading, solved as one least squares.

columns   a stretch of Samples as arrays, and which of them teach
nodes     a few readings in a row each, and the time between them
forth     the estimator that flies over some of the nodes: where to begin, and sudden changes noticed
linear    the equation made linear about a path
noise     as it shows in what is left over
chain     the solution, node by node: filter forwards, smoother backwards, evidence of each model
changes   sudden changes of the iron: where, how far, and whether at all

The equation, its priors and its models are those of core.estimators.adaptive; linear about a path that all of the
flight has shaped, instead of about what was believed on the way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from magmav.core.estimators.adaptive import layout as at
from magmav.core.estimators.adaptive.bank import Bank
from magmav.core.estimators.adaptive.layout import Array
from magmav.core.estimators.adaptive.tuning import MODELS, Tuning
from magmav.core.smoother import changes
from magmav.core.smoother.chain import Chain, Solved, Way
from magmav.core.smoother.columns import Columns
from magmav.core.smoother.forth import Forth
from magmav.core.smoother.linear import leftover, linear
from magmav.core.smoother.nodes import Nodes
from magmav.core.smoother.noise import Noise
from magmav.core.types import Estimate, Sample

_ROUNDS = 3  # about the path of the round before: the third moves nothing by a tenth of its sigma any more
_LATE_NS = 6_000_000_000  # a change is noticed within so long
_READINGS, _BLOCKS = 8000, 1000  # about, at most, of the forward pass: it only says where to begin
_WIDE_MG = 100.0  # the iron may step so far where a change was noticed, and more where it did
_SHARE = 1.5
_FAR_MG = 60.0
_EDGE_S = 10.0  # so near to take-off and landing steel on the ground looks like a change of the iron
_MOST_CHANGES = 12
_LIKELY_S = 200.0  # of data: more do not make a model more likely, because no model is true
_LEAST_LOG = -15.0
_NEVER_S = 1e9
_AROUND = 4  # nodes on either side, for where north is at the start
_LASTLY = 50  # nodes
_LEAST_NODES = 3
_OUTLIER_MG = 60.0  # a reading further off counts so much in what is left over


class Smoothed:
    """A stretch solved. solved : under each of MODELS.  changes : the iron stepped right after these nodes."""

    def __init__(
        self,
        nodes: Nodes,
        solved: Sequence[Solved],
        changes: Sequence[int],
        left_mg: Array,
        noise: Noise,
        forth: Forth,
        n: Tuning,
    ) -> None:
        """left_mg : (n, m, 3), what is left of each reading."""
        self.nodes, self.solved, self.changes, self.noise, self.tuning = nodes, solved, changes, noise, n
        self._forth = forth
        self.boot_ns = nodes.boot_ns
        self.log_weights = weights(solved, float(nodes.dt_s.sum()), n)  # of the models, the best one zero
        best, axes, there = solved[int(np.argmax(self.log_weights))], nodes.columns.axes, nodes.there
        undisturbed = (left_mg + best.passing[:, None, -3:])[..., :axes]
        # RMS of what iron, field and turning leave over
        self.residual_mg = float(np.sqrt((np.clip(undisturbed[there], -_OUTLIER_MG, _OUTLIER_MG) ** 2).mean()))
        squares = np.where(there[..., None], left_mg[..., :axes] ** 2, 0.0).sum((1, 2)) / (axes * there.sum(1))
        sums = np.concatenate(([0.0], np.cumsum(squares)))
        rows = np.arange(len(nodes))
        first = np.maximum(rows - _LASTLY, 0)
        # of single readings before each node, per axis
        self._nis = (sums[rows + 1] - sums[first]) / (rows + 1 - first) / (noise.white_mg2 + noise.common_mg2)

    def first(self, count: int) -> Smoothed | None:
        """As it would have been solved with the first nodes alone."""
        if count < _LEAST_NODES:
            return None
        nodes = self.nodes.first(count)
        return _Search(nodes, self._forth.first(nodes), self.tuning).run()

    def estimate(self, i: int) -> Estimate | None:
        """At one node, with all of the flight known."""
        x = np.array([one.path_at(i) for one in self.solved])
        p = np.array([one.covariance(i) for one in self.solved])
        bank = Bank(x, p, np.arange(len(MODELS)), self.log_weights, self.tuning)
        since = [float(self.boot_ns[i] - self.boot_ns[c]) / 1e9 for c in self.changes if c < i]
        return self._forth.says(bank, min(since, default=_NEVER_S), self.residual_mg, float(self._nis[i]))


def smooth(samples: Sequence[Sample], tuning: Tuning | None = None) -> Smoothed | None:
    """The stretch solved, each sample with a frame of its own (core.stretch.framed); None where nothing teaches."""
    n = tuning or Tuning()
    nodes = Nodes.of(Columns.of(samples, n), n) if samples else None
    if nodes is None or len(nodes) < _LEAST_NODES:
        return None
    forth = Forth(nodes.columns, replace(n, most=len(MODELS)))
    coarse = Nodes.of(nodes.columns.thinned(_READINGS), replace(n, block_s=2.0 * n.block_s, nodes_most=_BLOCKS))
    assert coarse is not None  # what fills fine ones
    forth.go(coarse, _LATE_NS)
    return _Search(nodes, forth, n).run()


class _Search:
    """Rounds of solving, each about the path of the one before."""

    def __init__(self, nodes: Nodes, forth: Forth, n: Tuning) -> None:
        self.nodes, self.forth, self.n = nodes, forth, n
        self.noise = Noise.first(n)
        self.opened = np.zeros(len(nodes) - 1)  # sigma of a step, mG
        boot_ns = nodes.boot_ns
        self._windows = [
            slice(*np.searchsorted(boot_ns, (notice.from_ns, notice.to_ns)).clip(0, len(nodes) - 1))
            for notice in forth.notices
        ]
        for w in self._windows:
            self.opened[w] = np.maximum(self.opened[w], _WIDE_MG / np.sqrt(max(w.stop - w.start, 1)))
        self.x = begin(nodes, forth)
        self.left = np.empty(0)
        at_s = np.cumsum(nodes.dt_s)
        self._edge = (at_s < _EDGE_S) | (at_s > at_s[-1:].sum() - _EDGE_S)
        self.solved: list[Solved] = []

    def run(self) -> Smoothed:
        """Solve, place what was noticed, look for what was not, and solve once more."""
        for _ in range(_ROUNDS):
            self._round()
        placed = self._places()
        return Smoothed(self.nodes, self.solved, placed, self.left, self.noise, self.forth, self.n)

    def _round(self) -> None:
        n = self.n
        if self.solved:
            self.noise = self.noise.seen(self.nodes, leftover(self.nodes, self.x), self.x, n)
        info, left = linear(self.nodes, self.x, self.noise, n)
        walks = sorted({m.iron_walk_mg for m in MODELS})
        chain = Chain(self.nodes, info, Way.of(self.nodes, self.noise, walks, self.opened, n))
        self.solved = [chain.solve(walks.index(m.iron_walk_mg), self.forth.field, m, n) for m in MODELS]
        self.x, self.left = self._best.path, left

    @property
    def _best(self) -> Solved:
        log = weights(self.solved, float(self.nodes.dt_s.sum()), self.n)
        return self.solved[int(np.argmax(log))]

    def _places(self) -> list[int]:
        """Where the iron stepped; found one after the other, each round with the ones before let go."""
        axes, placed = self.nodes.columns.axes, []
        sizes: dict[int, float] = {}
        for window in self._windows:
            if self._edge[window].all():
                continue
            moved = np.linalg.norm(np.diff(self._best.passing[:, 1:4], axis=0)[window, :axes], axis=1)
            place = window.start + int(np.argmax(moved))
            sizes[place] = float(moved.max())
        if self._windows:
            self._let_go(sizes)
            self._round()
        while len(sizes) < _MOST_CHANGES:
            but = (self.opened > 0.0) | self._edge
            found = changes.clearest(self._best, axes, but)
            if found is None:
                break
            sizes[found[0]] = found[1]
            self._let_go(sizes)
            self._round()
            if found[1] > _FAR_MG:  # where it was taken for no step, even north was wrong
                self.x = self.x.copy()
                self.x[:, at.ALPHA] = north(self.nodes, self.x)
                self._round()
                self._round()
        placed = [p for p in sorted(sizes) if changes.real(self._best, p, axes)]
        if len(placed) < len(sizes):
            self._let_go({p: sizes[p] for p in placed})
            self._round()
        return placed

    def _let_go(self, sizes: dict[int, float]) -> None:
        self.opened[:] = 0.0
        for place, size in sizes.items():
            self.opened[place] = max(_WIDE_MG, _SHARE * size)


def weights(solved: Sequence[Solved], fly_s: float, n: Tuning) -> Array:
    """Log weights of MODELS, the best one zero. Who needs more soft iron than there is counts as little as can be."""
    evidence = np.array([one.log_evidence for one in solved])
    log = n.temper * min(1.0, _LIKELY_S / max(fly_s, 1.0)) * evidence + np.log([m.weight for m in MODELS])
    astray = np.array([np.abs(one.path_at(0)[at.S]).max() > n.soft_most for one in solved])
    if not astray.all():
        log = np.where(astray, -np.inf, log)
    return np.asarray(np.maximum(log - log.max(), _LEAST_LOG))


def begin(nodes: Nodes, forth: Forth) -> Array:
    """A path to begin with, (n, SIZE): the iron as the forward pass knew it in the end, and north as it then shows.

    Where it noticed changes, the iron of each part as it was known at that part's end.
    """
    x = np.repeat(forth.believed[-1:], len(nodes), axis=0)
    x[:, at.E], x[:, at.D] = 0.0, 0.0
    start, boot_ns = 0, nodes.boot_ns
    for notice in forth.notices:
        end = int(np.searchsorted(boot_ns, (notice.from_ns + notice.to_ns) // 2))
        x[start:end, at.B] = forth.at(notice.from_ns)[at.B]
        start = end
    x[:, at.ALPHA] = north(nodes, x)
    return x


def north(nodes: Nodes, x: Array) -> Array:
    """Where north is along a path whose iron is about right, (n,) rad in the own frame: as a few nodes together show.

    What the gyro's bias turns is taken out first, so that no more than half a turn lies between two nodes.
    """
    r = nodes.readings(0, len(nodes))
    iron = (nodes.matrix() @ x[:, at.B, None])[:, None, :, 0]
    seen = r.z - iron - nodes.columns.drive[nodes.rows][..., None] * x[:, None, at.K]
    level = ((r.body_from_own.swapaxes(-1, -2) @ seen[..., None])[..., 0] * nodes.there[..., None]).sum(1)
    turned = np.concatenate(([0.0], np.cumsum(nodes.down_s @ x[-1, at.G] + nodes.turned_rad)))
    sums = np.concatenate(([0.0], np.cumsum((level[:, 0] + 1j * level[:, 1]) * np.exp(-1j * turned))))
    a = np.arange(len(nodes))
    around = sums[np.minimum(a + _AROUND + 1, len(nodes))] - sums[np.maximum(a - _AROUND, 0)]
    return np.asarray(np.unwrap(np.angle(around)) + turned)
