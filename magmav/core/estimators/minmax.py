"""Sawicki 2017, method I: the middle between the extremes of each axis (eq. 9), running.

DEVIATES: eq. (10) takes the radius from x alone; here it is the mean half range of the axes.
One spike decides it for ever; there is no forgetting. Exact only where the extremes were met (error up to
r (1 - cos(step / 2))), and noise widens both ends: with 400 points and 2 % of noise the radius comes out 3.4 % too
large. It has no sigma: nothing in six numbers says how good they are.

Whether there is a circle at all is judged by the moments the other methods use; that judge is ours, not the paper's.
"""

from __future__ import annotations

import numpy as np

from magmav.core.estimators.centred import BULLOCK, round_fit
from magmav.core.estimators.fit import Array, Fit, Refusal
from magmav.core.estimators.moments import Moments

_FULL = 0.6
"""An axis counts when its range is this much of the largest: half a turn gives .5, soft iron of 1.2 to .8 gives .67."""
_ENOUGH, _THREE_QUARTERS = 0.3, 0.5  # roundness: five eighths of a turn, and three quarters


class MinMaxFitter:
    """Running extremes of points (d,). In space an axis whose extremes were not met is not seen: z without a tumble."""

    def __init__(self, moments: Moments, least: int) -> None:
        self._moments = moments
        self._least = least
        self._low: Array = np.full(moments.dimensions, np.inf)
        self._high: Array = np.full(moments.dimensions, -np.inf)

    def add(self, point: Array) -> None:
        """Take one finite point, (d,)."""
        self._moments.add(point)
        self._low = np.minimum(self._low, point)
        self._high = np.maximum(self._high, point)

    def fit(self) -> Fit | Refusal:
        """Middle and mean half range of the axes that were seen."""
        m = self._moments
        if m.samples < self._least:
            return Refusal.TOO_FEW
        whole = np.eye(m.dimensions)
        ranges = self._high - self._low
        met = ranges >= _FULL * ranges.max()
        judged = round_fit(m, BULLOCK, self._least)
        if isinstance(judged, Refusal):
            return judged
        if np.count_nonzero(met) < 2:
            return Refusal.ARC_TOO_SHORT
        axes = whole[:, met]
        s = m.within(axes)
        spread = np.linalg.eigvalsh(s.vv)
        roundness = float(spread[0] / spread[-1])
        if roundness < _ENOUGH:
            return Refusal.ARC_TOO_SHORT
        centre = np.where(met, (self._high + self._low) / 2.0, 0.0)
        radius = float(ranges[met].mean()) / 2.0
        return Fit(
            centre=centre,
            radius=radius,
            residual=m.misfit(centre, axes @ axes.T, radius),
            covariance=None,
            seen=axes,
            matrix=whole,
            roundness=roundness,
            weak=roundness < _THREE_QUARTERS,
            samples=m.samples,
        )
