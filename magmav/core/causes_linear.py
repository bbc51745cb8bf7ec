"""The fit behind the causes where it is linear: the sums of the blocks in one stack, and a mounting that is held."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from magmav.core.causes_blocks import AMPERE, DOWN, FEATURES, ONE, THROTTLE, Block
from magmav.core.field import ExpectedField

Array = NDArray[np.float64]

IRON_MG, FIELD_MG = 1000.0, 300.0
POWER_MG = {AMPERE: 10.0, THROTTLE: 200.0}  # per ampere, and per full throttle


@lru_cache(maxsize=1)
def right_angles() -> tuple[Array, ...]:
    """The 24 rotations that take axes to axes, the identity first."""
    out = [
        np.array([[signs[i] if j == order[i] else 0.0 for j in range(3)] for i in range(3)])
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1.0, -1.0), repeat=3)
    ]
    proper = [m for m in out if np.linalg.det(m) > 0.0]
    return tuple(sorted(proper, key=lambda m: -float(np.trace(m))))


class Problem:
    """The blocks of one fit, stacked: sums (J, F, F), products with z (J, F, 3)."""

    def __init__(self, blocks: Sequence[Block], expected: ExpectedField | None, step_at: int | None) -> None:
        self.late = np.array([float(step_at is not None and i >= step_at) for i in range(len(blocks))])
        sums = np.array([b.sums for b in blocks])
        self.x, self.y = sums[:, :FEATURES, :FEATURES], sums[:, :FEATURES, FEATURES:]
        self.square = float(np.einsum("jrr->", sums[:, FEATURES:, FEATURES:]))
        self.n = float(self.x[:, ONE, ONE].sum())
        self.middle_s = np.array([b.middle_s for b in blocks])
        self.chained = np.array([b.chained for b in blocks])
        self.expected = expected
        self.power_by, self.span = self._power()
        self.blocks = len(blocks)
        x = self.x.sum(axis=0) / self.n
        self.down = x[ONE, DOWN]
        self.tilts = x[DOWN, DOWN] - np.outer(self.down, self.down)

    def _power(self) -> tuple[int, float]:
        """What drives the motor term: the battery's ampere where they are known and change, else the throttle."""
        for column, least in ((AMPERE, 0.3), (THROTTLE, 0.02)):
            mean = self.x[:, ONE, column].sum() / self.n
            spread = math.sqrt(max(self.x[:, column, column].sum() / self.n - mean * mean, 0.0))
            if spread > least:
                return column, spread
        return 0, 0.0

    def misfit(self, theta: Array) -> float:
        """Sum of squared residuals, mG^2; theta (J, F, 3)."""
        return self.square - float(theta.ravel() @ (2.0 * self.y - self.x @ theta).ravel())

    def normal(self, by: Array, theta: Array) -> tuple[Array, Array]:
        """Normal matrices (J, P, P) and right sides (J, P), from derivatives by (J, P, F, 3)."""
        j, p, f, axes = by.shape
        through = (self.x @ by.transpose(0, 2, 1, 3).reshape(j, f, p * axes)).reshape(j, f, p, axes)
        flat, left = by.reshape(j, p, f * axes), self.y - self.x @ theta
        matrix = flat @ through.transpose(0, 1, 3, 2).reshape(j, f * axes, p)
        return matrix, (flat @ left.reshape(j, f * axes, 1))[:, :, 0]

    def inflation(self, theta: Array, variance: float) -> float:
        """How many samples are worth one: residuals that go one way through a block are no separate news."""
        left = (self.y - self.x @ theta)[:, [ONE, 0, 1, 3, 4, 6, 7]]
        power = np.maximum(np.einsum("jff->jf", self.x)[:, [ONE, 0, 1, 3, 4, 6, 7]], 1e-9)
        each = (left**2).sum(axis=2) / power / 3.0
        weight = power / power.sum()
        per_block = self.n / self.blocks
        return float(min(max((each * weight).sum() / variance, 0.1 * per_block, 1.0), per_block))


@dataclass(frozen=True, slots=True, eq=False)
class Held:
    """What fits best with the mounting held, for T mountings: misfit (T,) mG^2, shared (T, 10), level (T, J, 2) mG.

    shared : the field downward, and by body axis the iron, what power adds, and what came at the step.
    """

    misfit: Array
    shared: Array
    level_mg: Array


def linear(p: Problem, turns: Array, variance: float) -> Held:
    """Each of the mountings (T, 3, 3) held: all else is linear, and a block's level field is in that block alone.

    So the level fields are taken out of the shared unknowns' equations block by block. A rotation leaves the products
    of g, p and q among each other as they are: only those with what has body axes of its own go by the mounting.
    """
    j, t = p.blocks, len(turns)
    fixed = np.zeros((j, FEATURES, 3))  # what iron, power and step stand by
    fixed[:, ONE, 0], fixed[:, ONE, 2] = 1.0, p.late
    if p.power_by:
        fixed[:, p.power_by, 1] = 1.0
    seen = p.x @ fixed
    among = np.einsum("jafbf->jab", p.x[:, :9, :9].reshape(j, 3, 3, 3, 3))
    across = np.tensordot(turns, seen[:, :9].reshape(j, 3, 3, 3), (2, 2)).transpose(0, 2, 3, 4, 1).reshape(t, j, 3, 9)
    to_z = np.tensordot(turns, p.y[:, :9].reshape(j, 3, 3, 3), ((1, 2), (3, 2)))
    shared, side = np.zeros((t, 10, 10)), np.empty((t, 10))
    shared[:, 0, 0], shared[:, 0, 1:] = among[:, 0, 0].sum(), across[:, :, 0].sum(axis=1)
    shared[:, 1:, 0] = shared[:, 0, 1:]
    shared[:, 1:, 1:] = np.kron((fixed.transpose(0, 2, 1) @ seen).sum(axis=0), np.eye(3))
    side[:, 0], side[:, 1:] = to_z[:, :, 0].sum(axis=1), (fixed.transpose(0, 2, 1) @ p.y).sum(axis=0).ravel()
    links, own, own_side = np.empty((t, j, 2, 10)), among[:, 1:, 1:], to_z[:, :, 1:, None]
    links[..., 0], links[..., 1:] = among[:, 1:, 0], across[:, :, 1:]
    v, v_sigma = (0.0, FIELD_MG * 2.0) if p.expected is None else (p.expected.down_mg, 0.3 * p.expected.total_mg)
    weights = np.array([v_sigma, *[IRON_MG] * 3, *[POWER_MG.get(p.power_by, 1.0)] * 3, *[IRON_MG] * 3]) ** -2.0
    spread = np.linalg.inv(own + variance * np.eye(2) / FIELD_MG**2)
    alone, follows = spread @ own_side, spread @ links
    turned = links.reshape(t, 2 * j, 10).transpose(0, 2, 1)
    matrix = shared + variance * np.diag(weights) - turned @ follows.reshape(t, 2 * j, 10)
    pull = (side - (turned @ alone.reshape(t, 2 * j, 1))[:, :, 0])[:, :, None]
    pull[:, 0] += variance * weights[0] * v
    best = np.linalg.solve(matrix, pull)
    level = alone - follows @ best[:, None]
    said = best * (2.0 * side[:, :, None] - shared @ best - 2.0 * (turned @ level.reshape(t, 2 * j, 1)))
    more = level * (2.0 * own_side - own @ level)
    return Held(p.square - said.sum(axis=(1, 2)) - more.sum(axis=(1, 2, 3)), best[:, :, 0], level[..., 0])
