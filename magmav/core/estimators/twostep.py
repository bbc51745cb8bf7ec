"""A second opinion that knows nothing of attitude: TWOSTEP on the field's length, windowed, robust, in O(1).

The length of the field must be the same however the vehicle turns. twostep_equation has the equation, after Alonso and
Shuster 2002; twostep_window what is remembered. Once a second, when a block of values is complete:

noise    White noise per value from neighbouring cells, and what the last answer foretold of the new block's length
         against what came: misfits that are alike from second to second (soft iron, motors) count as one, not as many.
window   One linear step for every stretch of time that ends now. The answer is that of the longest stretch whose claim
         is about the best: after a step of the iron long stretches fit badly and claim little, in a hover short ones
         know nothing. So nothing is forgotten for its age alone, and nothing is kept that no longer fits.
answer   On that stretch, with the soft iron as a doubt whose size the data choose (MacKay's evidence).
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from magmav.core.estimators.twostep_equation import RHO, STATE, C, D, drawn, rows, soft_root
from magmav.core.estimators.twostep_noise import Noise, Tuning
from magmav.core.estimators.twostep_solve import Priors, Stretch, cost, length_of, solved
from magmav.core.estimators.twostep_window import UNIT_MG, Array, Blocks, Cells, Sieve
from magmav.core.field import ExpectedField
from magmav.core.rotation import level_from_body
from magmav.core.threes import inverse3, squared_distance
from magmav.core.types import IDENTITY3, NO_SHAPING, Estimate, Sample, mat3, vec3

_WILD_MG = 2e4
_LEAST_SAMPLES, _LEAST_BLOCKS = 20, 3
_ROUGH, _SETTLED, _LOOK_EVERY = 6, 30, 8  # blocks: the start may be far away until, every second until, twins sought
_SURE_MG = 10.0  # who knows the centre so well has no twin
_SAME_MG = 0.1  # lengths
KNOWS_MG = 60.0
"""One sigma: who is less sure of a direction than this cannot contradict there."""
_FOREVER_S = 1e9
_EYE3 = np.eye(3)


class TwostepEstimator:
    """One compass's second opinion. ``tuning`` holds every number that was chosen."""

    def __init__(self, tuning: Tuning | None = None) -> None:
        self.tuning = tuning or Tuning()
        self._shaping, self._plain = NO_SHAPING, True
        self._matrix, self._back = IDENTITY3, IDENTITY3  # and its inverse
        self._sieve, self._blocks = Sieve(), Blocks()
        self._noise = Noise(self.tuning)
        n = self.tuning
        self._soft_scale = np.array((1.0,) * 3 + (n.soft_cross**2,) * 3)
        iron = np.eye(3) * (UNIT_MG / n.prior_mg) ** 2
        self._priors = Priors(np.zeros(3), iron, *self._length(None), n.soft**2 * self._soft_scale)
        self._x: Array | None = None
        self._covariance: Array = np.zeros((STATE, STATE))
        self._stretch: Stretch | None = None
        self._now_s = 0.0
        self._begun_s, self._changed_s = 0.0, -_FOREVER_S
        self._samples = self._seen = self._blocks_seen = 0
        self._spread: Array = np.zeros((3, 3))  # of other answers that fit nearly as well
        self._model_mg: float | None = None
        self._axes = 3
        self._said: tuple[float, Estimate] | None = None  # for which length, since the last block
        self._down: Array = np.zeros((3, 4))  # mean of down (x) (y, 1)

    # ------------------------------------------------------------ learning

    def step(self, s: Sample) -> None:
        """Learn from one sample; time that teaches nothing is only counted."""
        self._now_s += max(s.dt_s, 0.0)
        self._axes = s.axes
        if not s.learn or s.axes != 3:
            return
        if s.model_mg is not None:
            self._model_mg = math.hypot(*s.model_mg)
        if s.shaping is not self._shaping:
            self._shaping = s.shaping
            self._reshape(s.shaping.matrix)
            self._plain = bool((s.shaping.matrix == IDENTITY3).all() and not s.shaping.motor_b_mg.any())
        field_b_mg = s.mag_b_mg if self._plain else self._matrix @ s.mag_b_mg + s.shaping.motor_b_mg
        x, y, z = field_b_mg.tolist()
        if not (abs(x) < _WILD_MG and abs(y) < _WILD_MG and abs(z) < _WILD_MG):
            return
        passed = self._sieve.step(self._now_s, (x, y, z))
        if passed is None:
            return
        self._samples += 1
        closed = self._blocks.add(*passed)
        if closed is not None:
            self._said = None
            self._learn(closed)
            self._look_down(s, np.array((x, y, z, UNIT_MG)) / UNIT_MG)

    def _reshape(self, matrix: Array) -> None:
        """The autopilot's matrix is another: sums of values that went through the old one are of no use, b is."""
        if np.array_equal(matrix, self._matrix):
            return
        if self._stretch is not None and self._x is not None:
            turn = matrix @ np.linalg.inv(self._matrix)
            moved = self._covariance[C, C] + np.eye(3) * (self.tuning.moved_mg / UNIT_MG) ** 2
            self._x = np.concatenate((turn @ self._x[C], self._x[3:4], np.zeros(6)))
            self._priors = replace(self._priors, centre=self._x[C].copy(), info=np.linalg.inv(turn @ moved @ turn.T))
        self._matrix, self._back = mat3(matrix, "matrix"), inverse3(matrix)
        self._stretch, self._said, self._seen, self._spread = None, None, 0, np.zeros((3, 3))
        self._sieve, self._blocks = Sieve(), Blocks()

    def _length(self, model_mg: float | None) -> tuple[float, float]:
        n = self.tuning
        mean, sigma = n.blind_mg if model_mg is None else (model_mg, n.model_mg)
        return mean / UNIT_MG, sigma / UNIT_MG

    def _learn(self, new: Cells) -> None:
        length, sigma = self._length(self._model_mg)
        self._priors = replace(self._priors, length=length, length_sigma=sigma)
        if self._x is None:
            self._x = np.zeros(STATE)
            self._x[RHO] = length**2
        T = rows(self._x)
        if self._stretch is not None:
            self._foretold(new, T)
            self._blocks_seen += 1
            if self._blocks_seen > _SETTLED and self._blocks_seen % 2:
                return  # every other second is often enough by then
        else:
            self._noise.count(float(new.weight.sum()))
        sums, cells = np.cumsum(self._blocks.sums[::-1], axis=0), np.cumsum(self._blocks.cells[::-1])
        if len(sums) <= _ROUGH:
            start = Stretch(sums[-1], float(cells[-1]), self._noise.value2, 0.0)
            self._x, _ = solved(self._x, start, self._priors, self._noise.white2, _ROUGH)
            T = rows(self._x)
        k, self._stretch = self._choose(T, sums, cells)
        self._x, P = solved(self._x, self._stretch, self._priors, self._noise.white2, 2)
        if self._blocks_seen <= _ROUGH or self._blocks_seen % _LOOK_EVERY == 0:
            self._x, P = self._look_elsewhere(self._x, P, self._stretch)
        self._evidence(P)
        P[C, C] += self._spread
        self._covariance = P
        begun_s = self._blocks.begun_s[-1 - k]
        was, now = self._now_s - self._begun_s, self._now_s - begun_s
        if now < 0.5 * was and was > 10.0:
            self._changed_s = self._now_s
        self._begun_s = begun_s

    def _foretold(self, new: Cells, T: Array) -> None:
        """What the last answer foretold of a new block."""
        assert self._x is not None
        per_mg = 1.0 / (2.0 * length_of(self._x))
        mean = new.weight @ new.mean / new.weight.sum()
        slope = (T[:STATE] @ mean) * per_mg
        self._noise.see(new.weight, (new.mean @ T[STATE]) * per_mg, float(slope @ self._covariance @ slope))

    def _choose(self, T: Array, sums: Array, cells: Array) -> tuple[int, Stretch]:
        """Which of the stretches (K, 11, 11) that end now to believe, by one linear step from the last answer."""
        assert self._x is not None
        noise, x = self._noise, self._x
        f = 1.0 / (4.0 * length_of(x) ** 2)
        T = T[[0, 1, 2, RHO, STATE]]
        half = T @ self._blocks.sums[::-1]
        G = np.cumsum(half @ T.T, axis=0) * f
        info, slope, square = G[:, :4, :4], G[:, :4, 4], G[:, 4, 4]
        values = sums[:, 0, 0]
        slope = slope - drawn((sums[:, 0] @ T[:4].T) / values[:, None], cells, noise.white2 * f, 4)
        prior, pull = self._priors.pull(x)
        down = (slope / noise.value2 + pull[:4])[:, :, None]
        dx = -np.linalg.solve(info / noise.value2 + prior[:4, :4], down)[:, :, 0]
        # Misfits of every block under every stretch's answer, in units of what one value would have.
        means = half[:, :, 0]
        n_block = self._blocks.sums[::-1, 0, 0]
        misfit = (dx @ means[:, :4].T + means[:, 4]) * np.sqrt(f / n_block)
        K = len(sums)
        misfit *= _until(K)
        alike = np.maximum((misfit[:, 1:] * misfit[:, :-1]).sum(1), 0.0)
        own2 = ((misfit * misfit).sum(1) + 2.0 * alike) / np.maximum(np.arange(-2, K - 2), 1)
        own2[:4] = 0.0
        value2 = np.maximum(own2, noise.lasting2())
        left2 = square + 2.0 * (dx * G[:, :4, 4]).sum(1) + (dx * (info @ dx[:, :, None])[:, :, 0]).sum(1)
        white2 = noise.white2 * (cells + 2.0 * np.sqrt(2.0 * cells))
        structure2 = np.maximum((left2 - white2) / values, 0.0)
        P = np.linalg.inv(info / value2[:, None, None] + prior[:4, :4])
        claim2 = P[:, 0, 0] + P[:, 1, 1] + P[:, 2, 2] + 3.0 * structure2
        claims2 = claim2.tolist()
        most = self.tuning.slack * min(claims2)
        k = max(i for i, claimed2 in enumerate(claims2) if claimed2 <= most)
        return k, Stretch(sums[k], float(cells[k]), float(value2[k]), float(structure2[k]))

    def _look_elsewhere(self, x: Array, P: Array, stretch: Stretch) -> tuple[Array, Array]:
        """Points in a plane, or on a line, have a centre on either side: the best of them, and doubt about the rest."""
        self._spread = np.zeros((3, 3))
        if float(np.trace(P[C, C])) < (_SURE_MG / UNIT_MG) ** 2:
            return x, P
        sums = stretch.sums / stretch.sums[0, 0]
        middle = sums[0, 1:4]
        _, ways = np.linalg.eigh(sums[1:4, 1:4] - np.outer(middle, middle))
        off = x[C] - middle
        flat, line = ways[:, 0] * float(ways[:, 0] @ off), ways[:, 1] * float(ways[:, 1] @ off)
        found = [(x, P)]
        for start in (off - 2.0 * flat, off - 2.0 * line, off - 2.0 * (flat + line)):
            begin = np.concatenate((middle + start, x[3:]))
            found.append(solved(begin, stretch, self._priors, self._noise.white2, 4))
        costs = np.array([cost(one, stretch, self._priors) for one, _ in found])
        x, P = found[int(np.argmin(costs))]
        weights = np.exp(0.5 * np.maximum(costs.min() - costs, -700.0))
        apart = np.array([one[C] for one, _ in found]) - x[C]
        self._spread = (apart.T * weights) @ apart / weights.sum()
        return x, P

    def _evidence(self, P: Array) -> None:
        """Renew the size of the soft iron: squares of its entries against how many of them the data have decided."""
        assert self._x is not None
        n = self.tuning
        decided = max(float((1.0 - 0.25 * P.diagonal()[D] / self._priors.soft2).sum()), 0.0)
        squares = float((self._x[D] ** 2 / (4.0 * self._soft_scale)).sum())
        soft2 = min((n.soft_weight * n.soft**2 + squares) / (n.soft_weight + decided), n.soft_most**2)
        self._priors = replace(self._priors, soft2=soft2 * self._soft_scale)

    def _look_down(self, s: Sample, point: Array) -> None:
        """Where down was, only to say how the field divides into horizontal and down: nothing is learnt from it."""
        down = s.body_from_own[:, 2] if s.body_from_own is not None else level_from_body(s.roll_rad, s.pitch_rad)[2]
        self._seen += 1
        self._down = self._down + (down[:, None] * point - self._down) / min(self._seen, 60)

    @property
    def reaches_back_s(self) -> float:
        """Age of the oldest value that the answer rests on."""
        return self._now_s - self._begun_s

    # ------------------------------------------------------------ answer

    def estimate(self, expected: ExpectedField | None) -> Estimate | None:
        """Belief now; None for a compass of two axes, and before three seconds and 20 values."""
        said = self.opinion(expected)
        if said is None:
            return None
        ago_s = min(self._now_s - self._changed_s, _FOREVER_S)
        return replace(said, samples=self._samples, changed_ago_s=ago_s)

    def opinion(self, expected: ExpectedField | None) -> Estimate | None:
        """The same without what changes from sample to sample: counts and ages as they were at the last block."""
        got, x = self._stretch, self._x
        if got is None or x is None or self._axes != 3 or self._samples < _LEAST_SAMPLES:
            return None
        if len(self._blocks.sums) < _LEAST_BLOCKS:
            return None
        length, sigma = self._length(self._model_mg if expected is None else expected.total_mg)
        if self._said is None or self._said[0] != length:
            self._said = length, self._answer(x, got, length, sigma)
        return self._said[1]

    def __getstate__(self) -> dict[str, Any]:
        """What was said since the last block is made again when asked."""
        return self.__dict__ | {"_said": None}

    def _answer(self, x: Array, got: Stretch, length: float, sigma: float) -> Estimate:
        P, priors = self._covariance, self._priors
        if abs(length - priors.length) > _SAME_MG / UNIT_MG:
            priors = replace(priors, length=length, length_sigma=sigma)
            x, P = solved(x, got, priors, self._noise.white2, 4)
            P[C, C] += self._spread
        blind = P[C, C]
        told = priors.length_info(x) - priors.length_info(x, self._length(None)[1])
        if told > 0.0:  # the model's word taken back, as a measurement can be
            of_length = P[C, RHO]
            blind = blind + of_length[:, None] * of_length / max(1.0 / told - float(P[RHO, RHO]), 1e-9)
        bent = self._bent(got.sums, x, P[C, C]) + _EYE3 * (got.structure2 + 3.0 * self._noise.alarm2)
        back = self._back
        covariance = back @ (P[C, C] + bent) @ back.T * UNIT_MG**2
        own = back @ (blind + bent) @ back.T * UNIT_MG**2
        soft = soft_root(x)
        down = float((self._down[:, :3] * soft).sum() - self._down[:, 3] @ (soft @ x[C]))
        left2 = self._noise.white2 + got.structure2
        return Estimate(
            hard_iron_b_mg=vec3(back @ x[C] * UNIT_MG, "hard iron"),
            covariance_mg2=0.5 * (covariance + covariance.T),
            own_sigma_mg=vec3(np.sqrt(own.diagonal()), "sigma"),
            horizontal_mg=math.sqrt(max(length_of(x) ** 2 - down * down, 0.0)) * UNIT_MG,
            down_mg=down * UNIT_MG,
            residual_mg=math.sqrt(left2) * UNIT_MG,
            step_nis=self._noise.nis,
            samples=self._samples,
            changed_ago_s=_FOREVER_S,
            soft_iron_b=mat3(soft, "soft iron"),
        )

    @staticmethod
    def _bent(sums: Array, x: Array, P: Array) -> Array:
        """What a straight covariance misses: values that hardly turn leave the centre anywhere on a sphere about them.

        Across the line of sight u the centre may be off by t; then it is t^2 / 2 |B| off along it.
        """
        sight = sums[0, 1:4] / sums[0, 0] - x[C]
        u = sight / max(math.hypot(*sight.tolist()), 1e-9)
        along: Array = u[:, None] * u
        across = _EYE3 - along
        T = across @ P @ across
        wide = float(T.trace())
        size2 = (2.0 * float((T * T).sum()) + wide * wide) / (4.0 * length_of(x) ** 2)
        return along * size2


@cache
def _until(k: int) -> Array:
    """(k, k): one where a block, the latest first, is part of a stretch."""
    return np.tril(np.ones((k, k)))


def distance(apart_mg: Array, a_mg2: Array, b_mg2: Array, knows_mg: float = KNOWS_MG) -> float:
    """By how many sigmas two opinions on one iron are apart, in the direction in which it is most.

    apart_mg (n,) : their difference.  a_mg2, b_mg2 (n, n) : their covariances, b's that of the second opinion.
    Only directions count in which the second knows the hard iron to ``knows_mg`` (one sigma) or better; where it knows
    nothing it cannot contradict. That is the Mahalanobis distance with both covariances added, within those
    directions. Both learnt from the same values, so their errors are alike and truly differ by less: the sum overstates
    what the difference may be, and a distance is never claimed too large for that reason. Of two honest opinions with
    errors of their own, three directions give 3.4 or more in one case of a hundred.
    """
    both, off = a_mg2 + b_mg2, apart_mg
    if b_mg2.trace() > knows_mg**2:
        variances, ways = np.linalg.eigh(b_mg2)
        ways = ways[:, variances <= knows_mg**2]
        if ways.shape[1] == 0:
            return 0.0
        both, off = ways.T @ both @ ways, ways.T @ apart_mg
    return math.sqrt(max(squared_distance(off, both), 0.0))
