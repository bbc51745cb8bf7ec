"""What TWOSTEP takes for granted, and what its misfits say about their own size."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from magmav.core.estimators.twostep_window import UNIT_MG, Array


@dataclass(frozen=True, slots=True)
class Tuning:
    """Every number that was chosen."""

    prior_mg: float = 300.0  # one sigma of the hard iron per axis
    model_mg: float = 5.0  # of the world model's length
    blind_mg: tuple[float, float] = (450.0, 130.0)  # length and sigma where no position is known
    white_mg: float = 5.0  # noise of a value, to begin with
    structure_mg: float = 2.0  # of misfits that last, to begin with
    structure_weight: float = 6.0  # of that beginning, in seconds' blocks
    memory_s: float = 60.0  # of the noise statistics
    clip: float = 9.0  # a squared misfit counts for no more than this
    alike: float = 0.95  # of neighbouring misfits, at most
    slack: float = 1.1  # a longer stretch is preferred while it claims no more than this, squared
    soft: float = 0.007  # one sigma of the soft iron's diagonal, to begin with
    soft_most: float = 0.05
    soft_weight: float = 2.0  # of that beginning against six entries
    soft_cross: float = 0.71  # of the others
    moved_mg: float = 5.0  # of the centre, unknown after a change of the stored matrix


class Noise:
    """What misfits say about themselves. Squared, in UNIT_MG.

    A block's mean misfit varies by white2 / values + structure2 about what the answer's own doubt explains.
    """

    def __init__(self, n: Tuning) -> None:
        self._t = n
        self.white2 = (n.white_mg / UNIT_MG) ** 2  # of a value
        self.structure2 = (n.structure_mg / UNIT_MG) ** 2  # of what lasts for a block or longer
        self.nis = 1.0
        self.alarm2 = 0.0  # of what came lately and cannot be explained: the iron may have changed
        self._values = 0.0  # of a block
        self._pairs = 10.0
        self._weight = n.structure_weight
        self._products = 0.0
        self._squares = 5.0
        self._last = 0.0

    def see(self, weight: Array, misfit: Array, doubt2: float) -> None:
        """The misfits (C,) of a new block's cells of so many values, and what the answer was unsure of their mean."""
        n = self._t
        values = float(weight.sum())
        self.count(values)
        if len(misfit) > 1:
            apart = np.diff(misfit) ** 2 / (1.0 / weight[1:] + 1.0 / weight[:-1])
            for v in np.minimum(apart, n.clip * self.white2).tolist():
                self._pairs = min(self._pairs + 1.0, 500.0)
                self.white2 += (v - self.white2) / self._pairs
        mean = float(weight @ misfit) / values
        share = 1.0 / n.memory_s
        usual2 = self.structure2 + self.white2 / values
        nis = mean * mean / (doubt2 + usual2)
        self.nis += 0.2 * (min(nis, 16.0) - self.nis)
        self.alarm2 = max((0.7 if nis > 4.0 else 0.4) * self.alarm2, mean * mean - n.clip * (doubt2 + usual2))
        # What a doubtful answer foretold badly says little about noise: weights as of variances' own variance.
        sure = (usual2 / (usual2 + doubt2)) ** 2
        self._weight = min(self._weight + sure, n.memory_s)
        beyond2 = min(mean * mean, n.clip * (usual2 + doubt2)) - doubt2 - self.white2 / values
        self.structure2 = max(self.structure2 + sure / self._weight * (beyond2 - self.structure2), 0.0)
        like = min(max(mean / math.sqrt(usual2 + doubt2), -3.0), 3.0)
        self._products += like * self._last - share * self._products
        self._squares += like * like - share * self._squares
        self._last = like

    def count(self, values: float) -> None:
        """How many values a block had."""
        self._values += 0.1 * (values - self._values) if self._values else values

    @property
    def value2(self) -> float:
        """Variance of a value such that the mean of a block has this over their number."""
        return self.white2 + self._values * self.structure2

    def lasting2(self) -> float:
        """The same for long stretches, where what lasts for longer than a block counts once."""
        alike = min(max(self._products / self._squares, 0.0), self._t.alike) if self._squares > 0.0 else 0.0
        return self.white2 + self._values * self.structure2 * (1.0 + alike) / (1.0 - alike)
