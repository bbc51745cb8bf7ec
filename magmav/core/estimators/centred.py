"""The centred accumulator behind the circle and the sphere fit.

Sawicki's method III (Bullock's circle) is a linear regression of z = |u|^2 on the coordinates u about any fixed
shift: centre = 1/2 Cov(u)^-1 Cov(u, z). The same holds in any number of dimensions. Welford's update keeps mean and
covariance of (u, z) in O(1), to 12 digits (seed-methods.md S4). Method II gives the identical answer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]


@dataclass(frozen=True, slots=True, eq=False)
class CentredFit:
    """A circle or sphere: centre (d,), radius, RMS distance of the points from it, covariance (d, d) of the centre.

    roundness is lmin/lmax of the points' covariance: 1 for a full circle, .19 for half, .02 for 60 degrees.
    """

    centre: Array
    radius: float
    residual: float
    covariance: Array
    roundness: float
    samples: int


class CentredFitter:
    """Streaming least-squares circle (d = 2) or sphere (d = 3)."""

    def __init__(self, dimensions: int, scale: float = 500.0) -> None:
        self._d = dimensions
        self._scale = scale  # about the expected radius, so that z and u are of one size
        self._shift: Array | None = None
        self._n = 0
        self._mean = np.zeros(dimensions + 1)
        self._moment = np.zeros((dimensions + 1, dimensions + 1))
        # Neighbouring errors are alike (tilt, motors); their correlation says how many samples really count.
        self._last_error = 0.0
        self._error_products = np.zeros(2)

    def add(self, point: Array) -> None:
        """Take one point, shape (d,)."""
        if self._shift is None:
            self._shift = point.copy()
        u = (point - self._shift) / self._scale
        self._watch(u)
        w = np.append(u, u @ u)
        self._n += 1
        d = w - self._mean
        self._mean += d / self._n
        self._moment += np.outer(d, w - self._mean)

    def _watch(self, u: Array) -> None:
        solved = self._solve() if self._n > 4 * self._d else None
        if solved is None:
            return
        c, alpha = solved
        error = math.hypot(*(u - c)) - math.sqrt(alpha)
        self._error_products += (error * self._last_error, error * error)
        self._last_error = error

    def _solve(self) -> tuple[Array, float] | None:
        d = self._d
        spread = self._moment[:d, :d]
        try:
            c = np.linalg.solve(spread, self._moment[:d, d] / 2.0)
        except np.linalg.LinAlgError:
            return None
        alpha = float(self._mean[d] - 2.0 * c @ self._mean[:d] + c @ c)
        return (c, alpha) if math.isfinite(alpha) and alpha > 0.0 else None

    def fit(self) -> CentredFit | None:
        """The circle or sphere of everything taken so far; None while the points do not make one."""
        if self._shift is None or self._n < 2 * self._d + 2:
            return None
        solved = self._solve()
        if solved is None:
            return None
        c, alpha = solved
        d, n = self._d, self._n
        spread = self._moment[:d, :d] / n
        eigen = np.linalg.eigvalsh(spread)
        roundness = float(eigen[0] / eigen[-1]) if eigen[-1] > 0.0 else 0.0
        if not roundness > 1e-9:
            return None
        rss = max(float(self._moment[d, d] - 2.0 * c @ self._moment[:d, d]), 0.0)
        residual = math.sqrt(rss / n) / (2.0 * math.sqrt(alpha))
        like, own = self._error_products
        rho = min(max(like / own, 0.0), 0.999) if own > 0.0 else 0.0
        effective = max(n * (1.0 - rho) / (1.0 + rho), 1.0)
        # Cov(centre) = r^2 sigma^2 (N C)^-1, C the covariance of the points (seed-methods.md S4, statistics).
        covariance = alpha * residual**2 / effective * np.linalg.inv(spread) * self._scale**2
        return CentredFit(
            self._shift + self._scale * c,
            self._scale * math.sqrt(alpha),
            self._scale * residual,
            covariance,
            roundness,
            n,
        )
