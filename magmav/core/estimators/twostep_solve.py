"""Gauss-Newton on the sums of one stretch of time, with priors on centre, length and soft iron."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from magmav.core.estimators.twostep_equation import RHO, STATE, C, D, drawn, rows
from magmav.core.estimators.twostep_window import Array

_LEAST_RHO = 0.05
_SMALL, _NOTHING = 0.02, 4e-4  # steps, of the field: too short to go wrong, and too short to go on
_LONGEST = 0.7
_SOFT_LIMIT = 0.5


class Stretch(NamedTuple):
    """Sums (11, 11) of some time's values, of how many cells, the variance of a value and that of what lasts."""

    sums: Array
    cells: float
    value2: float
    structure2: float


@dataclass(frozen=True, slots=True, eq=False)
class Priors:
    """Known beforehand, in UNIT_MG: centre (3,), its information (3, 3), length, sigma, variances of soft iron (6,)."""

    centre: Array
    info: Array
    length: float
    length_sigma: float
    soft2: Array

    def pull(self, x: Array) -> tuple[Array, Array]:
        """Information (10, 10) and gradient (10,) at a state."""
        out, pull = np.zeros((STATE, STATE)), np.empty(STATE)
        out[C, C] = self.info
        pull[C] = self.info @ (x[C] - self.centre)
        h = length_of(x)
        out[RHO, RHO] = self.length_info(x)
        pull[RHO] = 2.0 * h * (h - self.length) * out[RHO, RHO]
        out.flat[44 :: STATE + 1] = 0.25 / self.soft2
        pull[D] = 0.25 / self.soft2 * x[D]
        return out, pull

    def length_info(self, x: Array, sigma: float | None = None) -> float:
        """Information on rho; with another sigma of the length where one is given."""
        return 1.0 / (2.0 * length_of(x) * (sigma or self.length_sigma)) ** 2

    def cost(self, x: Array) -> float:
        """Squared distance from what was expected, in units of its variance."""
        off, d = x[C] - self.centre, x[D]
        length = (length_of(x) - self.length) / self.length_sigma
        return float(off @ self.info @ off) + length * length + float((d * d / self.soft2).sum()) / 4.0


def length_of(x: Array) -> float:
    """|B| of a state."""
    return math.sqrt(max(float(x[RHO]), _LEAST_RHO))


def cost(x: Array, stretch: Stretch, priors: Priors) -> float:
    """Squared misfit of values and priors, in units of their variance."""
    return _misfit(rows(x)[STATE], stretch, priors) + priors.cost(x)


def _misfit(last: Array, stretch: Stretch, priors: Priors) -> float:
    return float(last @ stretch.sums @ last) / (4.0 * priors.length**2 * stretch.value2)


def solved(x: Array, stretch: Stretch, priors: Priors, white2: float, rounds: int) -> tuple[Array, Array]:
    """The state after some rounds, fewer where it stands still, and its covariance (10, 10).

    white2 : variance of the noise of a value, which is noise in the regressors.
    """
    f = 1.0 / (4.0 * priors.length**2 * stretch.value2)
    T = rows(x)
    for _ in range(rounds):
        half = T @ stretch.sums
        G = (half @ T.T) * f
        info, pull = priors.pull(x)
        mean = half[:STATE, 0] / stretch.sums[0, 0]
        slope = G[STATE, :STATE] - drawn(mean, stretch.cells, white2 * f) + pull
        P = np.linalg.inv(G[:STATE, :STATE] + info)
        dx = -(P @ slope)
        far = float(np.abs(dx[:4]).max())
        if far < _SMALL:
            x = x + dx
            if far < _NOTHING:
                break
            T = rows(x)
            continue
        way = min(1.0, _LONGEST / far)
        least = float(G[STATE, STATE]) + priors.cost(x)
        for _ in range(6):  # a long step may not fit worse than where it began, but for what noise draws
            there = x + way * dx
            there[D] = np.clip(there[D], -_SOFT_LIMIT, _SOFT_LIMIT)
            T = rows(there)
            if _misfit(T[STATE], stretch, priors) + priors.cost(there) <= least + 1.0:
                break
            way *= 0.3
        else:
            break
        x = there
    return x, P
