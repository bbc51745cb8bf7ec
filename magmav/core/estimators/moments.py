"""The one accumulator behind circle, sphere, ellipse and ellipsoid: moments of the points up to the fourth, in O(1).

Kept are the weighted mean and scatter of w = (u_i, u_i u_j for i <= j), u = (point - shift) / scale, by Welford's
update. The shift is the first point and the scale about the radius, so that offsets of 1e5 radii cost no digits
(seed-methods.md S4, conditioning). All sums of the seed papers' methods are linear in these.

With forgetting, the sample k steps ago has the weight forget^k. Merging is Chan's formula, after the other half has
been moved to our shift: u + a squared is u squared + 2 a u + a squared, so the move is linear in w and exact.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from magmav.core.estimators.fit import Array

_NO_SPAN = 1e-5  # of the radius squared
_PAIRS = {d: np.triu_indices(d) for d in (2, 3)}


class Moments:
    """Moments of points (d,). ``scale`` is about the radius, in the points' unit; 0 < forget <= 1."""

    def __init__(self, dimensions: int, scale: float = 500.0, forget: float = 1.0) -> None:
        if dimensions not in _PAIRS:
            raise ValueError(f"dimensions: want 2 or 3, got {dimensions}")
        if not 0.0 < forget <= 1.0:
            raise ValueError(f"forget: want a number above 0, 1 at most, got {forget}")
        if not scale > 0.0:
            raise ValueError(f"scale: want a length above 0, got {scale}")
        self.dimensions, self.scale, self.forget = dimensions, scale, forget
        size = dimensions + len(_PAIRS[dimensions][0])
        self.shift: Array | None = None
        self.samples = 0
        self.weight = 0.0
        self.weight2 = 0.0  # sum of squared weights: weight^2 / weight2 samples really count
        self.mean: Array = np.zeros(size)
        self.scatter: Array = np.zeros((size, size))

    def add(self, point: Array) -> None:
        """Take one finite point, (d,)."""
        if self.shift is None:
            self.shift = np.array(point, dtype=np.float64)
        i, j = _PAIRS[self.dimensions]
        u = (point - self.shift) / self.scale
        w = np.concatenate((u, u[i] * u[j]))
        self.samples += 1
        self.weight = self.forget * self.weight + 1.0
        self.weight2 = self.forget**2 * self.weight2 + 1.0
        away = w - self.mean
        self.mean = self.mean + away / self.weight
        self.scatter = self.forget * self.scatter + np.outer(away, away) * (1.0 - 1.0 / self.weight)

    @property
    def effective(self) -> float:
        """How many samples of equal weight would say as much."""
        return self.weight**2 / self.weight2 if self.weight2 > 0.0 else 0.0

    def then(self, later: Moments) -> Moments:
        """These points and after them ``later``'s, as if one accumulator had taken them all (Chan 1979).

        ValueError unless dimensions, scale and forgetting agree.
        """
        if (self.dimensions, self.scale, self.forget) != (later.dimensions, later.scale, later.forget):
            raise ValueError("moments: dimensions, scale and forgetting of the two halves must agree")
        if self.shift is None or later.shift is None:
            return (later if self.shift is None else self)._copy()
        out = self._copy()
        mean, scatter = later.moved((later.shift - self.shift) / self.scale)
        fade = self.forget**later.samples
        ours = self.weight * fade
        out.samples += later.samples
        out.weight = ours + later.weight
        out.weight2 = self.weight2 * fade * fade + later.weight2
        apart = mean - self.mean
        out.mean = self.mean + apart * (later.weight / out.weight)
        out.scatter = self.scatter * fade + scatter + np.outer(apart, apart) * (ours * later.weight / out.weight)
        return out

    def moved(self, by: Array) -> tuple[Array, Array]:
        """Mean and scatter of w were every u greater by ``by`` (d,)."""
        d = self.dimensions
        i, j = _PAIRS[d]
        change, rows = np.eye(len(self.mean)), np.arange(d, len(self.mean))
        np.add.at(change, (rows, j), by[i])
        np.add.at(change, (rows, i), by[j])
        return change @ self.mean + np.concatenate((by, by[i] * by[j])), change @ self.scatter @ change.T

    def _copy(self) -> Moments:
        out = Moments(self.dimensions, self.scale, self.forget)
        out.shift, out.samples, out.weight, out.weight2 = self.shift, self.samples, self.weight, self.weight2
        out.mean, out.scatter = self.mean, self.scatter  # never changed in place
        return out

    # ------------------------------------------------------------ what the fits ask

    def covariance(self) -> Array:
        """Covariance of u, (d, d)."""
        d = self.dimensions
        return self.scatter[:d, :d] / self.weight

    def middle(self) -> Array:
        """Mean of the points, (d,), in their own unit."""
        shift = np.zeros(self.dimensions) if self.shift is None else self.shift
        out: Array = shift + self.scale * self.mean[: self.dimensions]
        return out

    def spreads(self) -> bool:
        """Whether the points differ by more than rounding."""
        if self.shift is None:
            return False
        finest = 1e-12 * float(np.linalg.norm(self.shift)) / self.scale
        return bool(np.trace(self.covariance()) > finest * finest)

    def misfit(self, centre: Array, form: Array, radius: float) -> float:
        """RMS of (a' form a - radius^2) / (2 radius), a = point - centre: nearly the distance from the figure."""
        shift = np.zeros(self.dimensions) if self.shift is None else self.shift
        mean, scatter = self.moved((shift - centre) / self.scale)
        q, r = np.concatenate((np.zeros(self.dimensions), quadratic(form))), radius / self.scale
        away = float(q @ mean) - r * r
        return self.scale * math.sqrt(max(float(q @ scatter @ q) / self.weight, 0.0) + away * away) / (2.0 * r)

    def directions(self, axes: Array, centre: Array, radius: float) -> int:
        """In how many directions from a centre (d,) the points lie, within ``axes`` (d, k), as far as moments can tell.

        n directions give coordinates and their products a covariance of rank n - 1; more than that rank can be are not
        told apart (6 in a plane, 10 in space). What spans under 0.3 % of the radius is rounding, and no direction.
        """
        d, k = axes.shape
        i, j = _PAIRS[k]
        shift = np.zeros(d) if self.shift is None else self.shift
        _, scatter = self.moved(axes @ (axes.T @ (shift - centre)) / self.scale)
        ratio = self.scale / radius
        rows = np.zeros((k + len(i), len(scatter)))
        rows[:k, :d] = axes.T * ratio
        for row, a, b in zip(rows[k:], axes.T[i], axes.T[j], strict=True):
            row[d:] = quadratic(np.outer(a, b) + np.outer(b, a)) * (ratio * ratio / 2.0)
        spread = np.linalg.eigvalsh(rows @ scatter @ rows.T / self.weight)
        return 1 + int(np.count_nonzero(spread > _NO_SPAN))

    def within(self, axes: Array) -> Scatter:
        """Moments of v = axes' u, (k,), and z = |v|^2; ``axes`` (d, k) has orthonormal columns."""
        d = self.dimensions
        q = quadratic(axes @ axes.T)
        plain, mixed, square = self.scatter[:d, :d], self.scatter[:d, d:], self.scatter[d:, d:]
        return Scatter(
            axes.T @ self.mean[:d],
            axes.T @ plain @ axes / self.weight,
            axes.T @ (mixed @ q) / self.weight,
            float(q @ self.mean[d:]),
            float(q @ square @ q) / self.weight,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Scatter:
    """Mean (k,) and covariance (k, k) of v; covariance of v with z (k,); mean and variance of z = |v|^2."""

    mean: Array
    vv: Array
    vz: Array
    z_mean: float
    zz: float


def quadratic(form: Array) -> Array:
    """Weights of the products u_i u_j, i <= j, that make up u' form u; ``form`` (d, d) symmetric."""
    i, j = _PAIRS[len(form)]
    out: Array = np.where(i == j, 1.0, 2.0) * form[i, j]
    return out
