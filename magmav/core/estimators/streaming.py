"""A fitter on moments that also watches how alike neighbouring misfits are.

Errors of tilt and motors last for seconds, so a thousand samples are not a thousand independent ones. With rho the
correlation of neighbouring misfits, (1 - rho) / (1 + rho) of them are, as in a first-order process. Misfits are
measured from a figure that is renewed now and then; those from the first, poor figures are large and all alike, so
only the later half to three quarters of the samples are looked at.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from magmav.core.estimators.centred import BULLOCK, KASA, TAUBIN, Round, round_fit
from magmav.core.estimators.ellipse import conic_fit
from magmav.core.estimators.fit import Array, Fit, Refusal
from magmav.core.estimators.moments import Moments

Method = Callable[[Moments, int, float], Fit | Refusal]
"""(moments, fewest points, share of them that is independent) -> figure."""


class MomentsFitter:
    """Any method that works on moments. ``least``: fewest points; ``watch``: points come in order of time."""

    def __init__(self, moments: Moments, method: Method, least: int, watch: bool = False) -> None:
        self.moments = moments
        self._method = method
        self._least = least
        self._watch = watch
        self._figure: Fit | Refusal = Refusal.TOO_FEW  # of some time ago: the yardstick of misfits
        self._renew_at = least
        self._last_misfit = 0.0
        self._products = np.zeros(2)  # of neighbours, and of each with itself, since _begun
        self._before = np.zeros(2)  # the same in the stretch before that
        self._begun = least

    def add(self, point: Array) -> None:
        """Take one finite point, (d,)."""
        m = self.moments
        m.add(point)
        if not self._watch:
            return
        if m.samples >= self._renew_at:
            self._figure = self._method(m, self._least, 1.0)
            self._renew_at = m.samples + max(1, min(m.samples, int(m.weight)) // 8)
            if m.samples >= 2 * self._begun:
                self._before, self._products, self._begun = self._products, np.zeros(2), m.samples
        if isinstance(self._figure, Fit):
            misfit = self._figure.misfit(point)
            self._products = self._products + np.array((misfit * self._last_misfit, misfit * misfit))
            self._last_misfit = misfit

    def fit(self) -> Fit | Refusal:
        """The figure of everything taken so far."""
        return self._method(self.moments, self._least, self.independent())

    def independent(self) -> float:
        """Share of the samples whose errors are independent, 0 to 1."""
        neighbours, own = self._products + self._before
        rho = min(max(neighbours / own, 0.0), 0.999) if own > 0.0 else 0.0
        return (1.0 - rho) / (1.0 + rho)

    def then(self, later: MomentsFitter) -> MomentsFitter:
        """These points and after them ``later``'s. ValueError where the moments do not go together."""
        out = MomentsFitter(self.moments.then(later.moments), self._method, self._least, self._watch)
        out._products, out._before = self._products + later._products, self._before + later._before
        out._figure, out._last_misfit = later._figure, later._last_misfit
        out._renew_at = out._begun = out.moments.samples
        return out


def _round(way: Round, m: Moments, least: int, independent: float) -> Fit | Refusal:
    return round_fit(m, way, least, independent)


METHODS: dict[str, Method] = {
    "kasa": partial(_round, KASA),
    "bullock": partial(_round, BULLOCK),
    "taubin": partial(_round, TAUBIN),
    "ellipse": conic_fit,
    "ellipsoid": conic_fit,
}
