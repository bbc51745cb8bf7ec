"""Streaming estimators of hard (and soft) iron: one method per file, one contract.

An estimator takes Samples one at a time in O(1) and says on request what it believes. It must not know where Samples
come from. It can be copied at any moment (copy.deepcopy, pickle) and the copy goes on to the same bits.

kalman           a linear Kalman filter: levelled field constant but for the turning the gyro reports
adaptive         a bank of filters over headings and models: also soft iron, drift, throttle (the default)
twostep          the field's length alone, windowed (Alonso and Shuster 2002): a second opinion without attitude
minmax           Sawicki 2017, method I: middle of the extremes
kasa, bullock    methods II and III: the same least-squares circle or sphere, by two sets of equations
taubin           the same without the pull of short arcs to small circles
ellipse          Sytnyk et al. 2014, soft iron in the well-posed form, in the level plane
ellipsoid        the same in three dimensions, body axes
sytnyk           the printed chain: extremes, turn, extremes again

The four circles are fitted in body axes; with ``_level`` they are fitted to levelled data, as the papers do
(orders.py says what that costs).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Protocol

from magmav.core.field import ExpectedField
from magmav.core.types import Estimate, Sample


class Estimator(Protocol):
    """What every method offers. Those made by ``fitted`` also have has_sigma and why_not, why_weak() -> str | None."""

    def step(self, sample: Sample) -> None:
        """Learn from one sample (or only carry time forward, where sample.learn is False)."""
        ...

    def estimate(self, expected: ExpectedField | None) -> Estimate | None:
        """What is believed now; None while there is too little to say anything. Changes nothing."""
        ...


class Idle:
    """Learns nothing, at no cost: for who wants Samples alone, which do not depend on what is learnt from them."""

    def step(self, sample: Sample) -> None:
        """Nothing."""

    def estimate(self, expected: ExpectedField | None) -> Estimate | None:
        """Nothing."""
        return None


LEAST_SAMPLES = 20


def fitted(method: str, order: str = "body", forget: float = 1.0) -> Estimator:
    """A figure fitted to the points of samples.

    method : minmax, kasa, bullock, taubin, ellipse (level), ellipsoid (body) or sytnyk (level).
    order  : "body" subtracts in body axes and then levels; "level" fits levelled data.
    forget : weight of a sample against that of the next, above 0 to 1; minmax and sytnyk cannot forget.
    ValueError naming a method, order or forgetting that does not exist.
    """
    from magmav.core.estimators.fit import Fitter
    from magmav.core.estimators.minmax import MinMaxFitter
    from magmav.core.estimators.moments import Moments
    from magmav.core.estimators.orders import BodyOrder, FitEstimator, LevelOrder
    from magmav.core.estimators.streaming import METHODS, MomentsFitter
    from magmav.core.estimators.sytnyk import SytnykFitter

    if method not in (*METHODS, "minmax", "sytnyk"):
        raise ValueError(f"method: no {method!r}; choose {', '.join((*METHODS, 'minmax', 'sytnyk'))}")
    if order not in ("body", "level"):
        raise ValueError(f"order: want body or level, got {order!r}")
    if method in ("minmax", "sytnyk") and forget != 1.0:
        raise ValueError(f"forget: {method} keeps extremes and cannot forget, got {forget}")
    if {"ellipse": "level", "sytnyk": "level", "ellipsoid": "body"}.get(method, order) != order:
        raise ValueError(f"order: {method} does not work in order {order!r}")
    moments = Moments(3, 500.0, forget) if order == "body" else Moments(2, 200.0, forget)
    fitter: Fitter
    if method == "minmax":
        fitter = MinMaxFitter(moments, LEAST_SAMPLES)
    elif method == "sytnyk":
        fitter = SytnykFitter(moments, LEAST_SAMPLES)
    else:
        fitter = MomentsFitter(moments, METHODS[method], LEAST_SAMPLES, watch=True)
    return FitEstimator(BodyOrder() if order == "body" else LevelOrder(), fitter, method not in ("minmax", "sytnyk"))


def _kalman() -> Estimator:
    from magmav.core.estimators.kalman import KalmanEstimator

    return KalmanEstimator()


def _adaptive() -> Estimator:
    from magmav.core.estimators.adaptive import AdaptiveEstimator

    return AdaptiveEstimator()


def _twostep() -> Estimator:
    from magmav.core.estimators.twostep import TwostepEstimator

    return TwostepEstimator()


ESTIMATORS: dict[str, Callable[[], Estimator]] = {
    "kalman": _kalman,
    "adaptive": _adaptive,
    "twostep": _twostep,
    "minmax": partial(fitted, "minmax"),
    "kasa": partial(fitted, "kasa"),
    "bullock": partial(fitted, "bullock"),
    "taubin": partial(fitted, "taubin"),
    "minmax_level": partial(fitted, "minmax", "level"),
    "kasa_level": partial(fitted, "kasa", "level"),
    "bullock_level": partial(fitted, "bullock", "level"),
    "taubin_level": partial(fitted, "taubin", "level"),
    "ellipse": partial(fitted, "ellipse", "level"),
    "ellipsoid": partial(fitted, "ellipsoid"),
    "sytnyk": partial(fitted, "sytnyk", "level"),
}
