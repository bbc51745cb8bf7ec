"""What every figure fitted to points gives back: the figure, or the reason why there is none.

The pure layer: points in, Fit or Refusal out. It knows neither samples nor attitude. Points are (d,), d 2 or 3, in any
unit; the answers are in the same unit and in the points' own axes.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]


class Refusal(Enum):
    """Why points make no figure. The value is the sentence a reader gets."""

    TOO_FEW = "too few points"
    NOT_FINITE = "a point is not a number, or beyond any compass"
    NO_ROTATION = "points scatter about no circle: not turned, or disturbed, or tilted too far to level first"
    COLLINEAR = "all points lie on one line"
    PLANAR = "all points lie in one plane: bank the vehicle while it turns"
    ARC_TOO_SHORT = "too short an arc, or too thin a band of tilts: turn the vehicle further, and bank it"
    FEW_HEADINGS = "points from too few headings to tell how well they fit: turn the vehicle all the way round"
    EXTREMES = "the extremes do not belong to the figure of all points: never met (turn all the way round), or a spike"
    NOT_AN_ELLIPSE = "no ellipse fits: not turned all the way round, or disturbed, or tilted too far to level first"


WEAK = "rests on little (short arc, few headings, a spike), which noise or soft iron moves far: turn further, and bank"
"""What ``Fit.weak`` means, as a sentence."""


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A circle, sphere, ellipse or ellipsoid: |matrix @ (point - centre)| = radius in the seen directions.

    centre     : (d,), zero along directions that were not seen
    radius     : of the corrected figure; of an ellipse the geometric mean of its half axes
    residual   : RMS distance of the points from it
    covariance : (d, d) of the centre, zero along directions that were not seen; None where the method has none
    seen       : (d, k), orthonormal columns: the directions in which the points say something
    matrix     : (d, d), determinant 1, takes the ellipse to a circle; the identity where no soft iron is fitted
    roundness  : smallest over largest variance of the corrected points in the seen directions. A whole circle has 1,
                 270 degrees .50, 180 degrees .19, 60 degrees .02
    weak       : a figure, but resting on so short an arc, or on extremes so far from the rest of the points, that a
                 little noise or soft iron moves it far
    """

    centre: Array
    radius: float
    residual: float
    covariance: Array | None
    seen: Array
    matrix: Array
    roundness: float
    weak: bool
    samples: int

    def misfit(self, point: Array) -> float:
        """How far outside the figure a point (d,) lies."""
        return float(np.linalg.norm(self.seen.T @ (self.matrix @ (point - self.centre)))) - self.radius


class Fitter(Protocol):
    """Takes points one at a time in O(1) and says on request what they make."""

    def add(self, point: Array) -> None:
        """Take one finite point, (d,)."""
        ...

    def fit(self) -> Fit | Refusal:
        """The figure of everything taken so far. Changes nothing."""
        ...


def fit_points(points: Array, fitter: Fitter) -> Fit | Refusal:
    """The figure of many points at once, (n, d), by a fresh fitter: the batch form of every method.

    Refusal.NOT_FINITE where a value is none or too large to be squared twice. ValueError for another shape.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise ValueError(f"points: want shape (n, 2) or (n, 3), got {points.shape}")
    if not np.isfinite(points).all() or (np.abs(points) > 1e60).any():
        return Refusal.NOT_FINITE
    for point in points:
        fitter.add(point)
    return fitter.fit()
