"""Sawicki 2017, method I: the middle between the extremes of each axis (eq. 9), running.

DEVIATES: eq. (10) takes the radius from x alone; here it is the mean half range of the axes.
One spike decides it for ever; there is no forgetting. Exact only where the extremes were met (error up to
r (1 - cos(step / 2))), and noise widens both ends: with 400 points and 2 % of noise the radius comes out 3.4 % too
large. It has no sigma: nothing in six numbers says how good they are.

Whether there is a circle at all, and whether the extremes are its own, is judged by the moments the other methods use;
that judge is ours, not the paper's. Three headings would be answered a quarter of the radius wrong.
"""

from __future__ import annotations

import numpy as np

from magmav.core.estimators.centred import BULLOCK, round_fit
from magmav.core.estimators.ellipse import conic_fit
from magmav.core.estimators.fit import Array, Fit, Refusal
from magmav.core.estimators.moments import Moments

_FULL = 0.6
"""An axis counts when its range is this much of the largest: half a turn gives .5, soft iron of 1.2 to .8 gives .67."""
FAR = 0.12
"""Beyond this share of the radius the middle of the extremes is not the figure's, and by half of it weak. Whole turns
with 3 % of noise stay under .06; five headings give .06 to .10, three .18 to .25, a spike of half a radius .22, banked
turns where z was not met .10."""
POORER = 0.1  # so much of the radius may the residual be larger than that of the circle of all points
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

    def extremes(self) -> tuple[Array, Array]:
        """Middle and half range of each axis, (d,): eq. (9) and (10), unjudged. Not numbers where nothing was taken."""
        return (self._high + self._low) / 2.0, (self._high - self._low) / 2.0

    def fit(self) -> Fit | Refusal:
        """Middle and mean half range of the axes that were seen."""
        m = self._moments
        if m.samples < self._least:
            return Refusal.TOO_FEW
        whole = np.eye(m.dimensions)
        judged = round_fit(m, BULLOCK, self._least)
        if isinstance(judged, Refusal):
            return judged
        middle, half = self.extremes()
        met = half >= _FULL * half.max()
        if np.count_nonzero(met) < 2:
            return Refusal.ARC_TOO_SHORT
        axes = whole[:, met]
        s = m.within(axes)
        spread = np.linalg.eigvalsh(s.vv)
        roundness = float(spread[0] / spread[-1])
        if roundness < _ENOUGH:
            return Refusal.ARC_TOO_SHORT
        centre = np.where(met, middle, 0.0)
        radius = float(half[met].mean())
        residual = m.misfit(centre, axes @ axes.T, radius)
        away = off_centre(centre, met, m, judged) / radius
        if away > FAR / 2.0:
            # Soft iron moves a circle that is not turned evenly, and neither an ellipse nor the extremes.
            conic = conic_fit(m, self._least)
            away = off_centre(centre, met, m, conic) / radius if isinstance(conic, Fit) else away
        # Banked turns are no circle on the level axes alone: there a residual says nothing of the extremes.
        alike = judged.seen.shape[1] == axes.shape[1]
        if away > FAR or (alike and residual > judged.residual + POORER * radius):
            return Refusal.EXTREMES
        return Fit(
            centre=centre,
            radius=radius,
            residual=residual,
            covariance=None,
            seen=axes,
            matrix=whole,
            roundness=roundness,
            weak=roundness < _THREE_QUARTERS or away > FAR / 2.0,
            samples=m.samples,
        )

    def then(self, later: MinMaxFitter) -> MinMaxFitter:
        """These points and after them ``later``'s. ValueError where the moments do not go together."""
        out = MinMaxFitter(self._moments.then(later._moments), self._least)
        out._low, out._high = np.minimum(self._low, later._low), np.maximum(self._high, later._high)
        return out


def off_centre(centre: Array, met: Array, m: Moments, judge: Fit) -> float:
    """How far a centre (d,) is from another figure's of the same points along the axes ``met``, in their unit.

    Where the other saw nothing the points lie in a plane, and it stands for the mean of the points.
    """
    unseen = np.eye(m.dimensions) - judge.seen @ judge.seen.T
    away = centre - judge.centre - unseen @ m.middle()
    return float(np.linalg.norm(away[met]))
