"""Sytnyk, Honcharov, Raievskyi 2014: offset and scale (1)-(3), then soft iron by turning and rescaling the ellipse.

As printed, corrected only where the print plainly slips:
DEVIATES: (2), (3) divide by the peak-to-peak, which makes a circle of radius 1/2; half of it is meant.
DEVIATES: the angle of the major axis is printed arcsin(Y / X), which does not exist for |Y| > |X|; it is atan2(Y, X).
DEVIATES: (4) is fed the vector before it is turned back; the matrix here turns back.

What is left is a property of the method (seed-methods.md Y2), and why `ellipse` exists. After (3) the bounding box is
square, so the axes always lie at 45 degrees and the angle found says nothing. The farthest point is one point, hence
noisy. The matrix is not symmetric: a constant heading error of about -1/2 (A11 - A22) A12 / mean^2 rad stays, 2.3
degrees for A = [1.2 .2; .2 .8]. And an ellipse whose axes are those of the sensor is round after (3), so that its
farthest point is noise.

Streaming keeps, for each of 64 directions, the point that lies farthest in it: all that extremes are made of.
Whether there is an ellipse at all, and whether the extremes are its own, is judged by the conic fit. That judge is
ours, not the paper's.
"""

from __future__ import annotations

import math

import numpy as np

from magmav.core.estimators.ellipse import conic_fit
from magmav.core.estimators.fit import Array, Fit, Refusal
from magmav.core.estimators.minmax import FAR, POORER, off_centre
from magmav.core.estimators.moments import Moments

_DIRECTIONS = 64
_ENOUGH = 0.4  # roundness of the true ellipse made round: two thirds of a turn
_ANGLES = np.arange(_DIRECTIONS) * (math.tau / _DIRECTIONS)
_AXES = np.stack((np.cos(_ANGLES), np.sin(_ANGLES)), 1)


def offset_and_scale(points: Array) -> tuple[Array, Array]:
    """Eq. (1), (2): middle of the extremes and half the peak-to-peak of points (n, 2), each (2,)."""
    high, low = points.max(0), points.min(0)
    return (high + low) / 2.0, (high - low) / 2.0


def turn_and_rescale(points: Array) -> tuple[Array, Array]:
    """Eq. (1)-(3), the turn by the angle of the farthest point, (1)-(3) again, and the turn back.

    Gives centre (2,) and matrix (2, 2): matrix @ (point - centre) lies about the unit circle. Points (n, 2) must span
    both axes.
    """
    offset, half = offset_and_scale(points)
    real = (points - offset) / half
    far = real[int(np.argmax(np.einsum("ij,ij->i", real, real)))]
    c, s = far / math.hypot(*far)
    turn = np.array([[c, s], [-s, c]])
    offset_turned, half_turned = offset_and_scale(real @ turn.T)
    scaled_turn = turn / half
    centre = offset + np.linalg.solve(scaled_turn, offset_turned)
    return centre, turn.T @ (scaled_turn / half_turned[:, None])


class SytnykFitter:
    """The printed chain, two dimensions, on the extremes of what was taken."""

    def __init__(self, moments: Moments, least: int) -> None:
        self._moments = moments
        self._least = least
        self._reach: Array = np.full(_DIRECTIONS, -np.inf)
        self._extremes: Array = np.zeros((_DIRECTIONS, 2))

    def add(self, point: Array) -> None:
        """Take one finite point, (2,)."""
        self._moments.add(point)
        reach = _AXES @ point
        farther = reach > self._reach
        if farther.any():
            self._reach = np.where(farther, reach, self._reach)
            self._extremes = np.where(farther[:, None], point, self._extremes)

    def fit(self) -> Fit | Refusal:
        """The ellipse of the printed chain; its matrix has determinant 1 and is not symmetric."""
        m = self._moments
        judged = conic_fit(m, self._least)
        if isinstance(judged, Refusal):
            return judged
        if judged.roundness < _ENOUGH:
            return Refusal.ARC_TOO_SHORT
        centre, to_unit = turn_and_rescale(self._extremes)
        radius = 1.0 / math.sqrt(float(np.linalg.det(to_unit)))
        matrix = radius * to_unit
        residual = m.misfit(centre, matrix.T @ matrix, radius)
        away = off_centre(centre, np.ones(2, dtype=bool), m, judged) / radius
        if away > FAR or residual > judged.residual + POORER * radius:
            return Refusal.EXTREMES
        spread = matrix @ m.covariance() @ matrix.T
        rounded = np.linalg.eigvalsh(spread)
        return Fit(
            centre=centre,
            radius=radius,
            residual=residual,
            covariance=None,
            seen=np.eye(2),
            matrix=matrix,
            roundness=float(rounded[0] / rounded[-1]),
            weak=judged.weak or away > FAR / 2.0,
            samples=m.samples,
        )

    def then(self, later: SytnykFitter) -> SytnykFitter:
        """These points and after them ``later``'s. ValueError where the moments do not go together."""
        out = SytnykFitter(self._moments.then(later._moments), self._least)
        farther = later._reach > self._reach
        out._reach = np.where(farther, later._reach, self._reach)
        out._extremes = np.where(farther[:, None], later._extremes, self._extremes)
        return out
