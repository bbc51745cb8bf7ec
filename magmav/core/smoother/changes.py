"""Sudden changes of the iron, with all of the flight known: where, how far, and whether there was one at all.

A walk of the iron that is held tight still shows where it would rather have stepped. At each node the step that would
fit best, and its covariance, follow from one smoothing pass (de Jong and Penzer 1998: diagnosing shocks): with q the
variance of the walk there, m the smoothed move and C its covariance, the pull is m / q, its variance 1 / q - C / q^2.
"""

from __future__ import annotations

import numpy as np

from magmav.core.estimators.adaptive.layout import Array
from magmav.core.smoother.chain import Solved
from magmav.core.smoother.columns import Flags

_CLEAR = 80.0  # chi squared of three axes from which a step is one; likelihoods count a quarter (tuning.temper)
_LEAST_MG = 15.0
_NOTHING = 1e-9


def steps(solved: Solved, axes: int) -> tuple[Array, Array]:
    """Of each place between two nodes, (n - 1,): chi squared of a step there against none, and its length, mG."""
    moved, covariance = solved.step_covariance()
    tie = solved.ties()[:, None]
    pull = (tie * moved)[:, :axes]
    variance = tie[..., None] * np.eye(3) - tie[..., None] ** 2 * covariance
    variance = 0.5 * (variance + variance.transpose(0, 2, 1))[:, :axes, :axes]
    variance += _NOTHING * np.eye(axes)
    step = np.linalg.solve(variance, pull[..., None])[..., 0]
    return (step * pull).sum(1), np.linalg.norm(step, axis=1)


def clearest(solved: Solved, axes: int, but: Flags) -> tuple[int, float] | None:
    """The place of the clearest step that is none of those, (n - 1,) flags, and its length; None where none is."""
    chi2, length_mg = steps(solved, axes)
    chi2 = np.where(but | (length_mg < _LEAST_MG), 0.0, chi2)
    place = int(np.argmax(chi2)) if len(chi2) else 0
    return (place, float(length_mg[place])) if len(chi2) and chi2[place] > _CLEAR else None


def real(solved: Solved, place: int, axes: int) -> bool:
    """Is the iron after this place, where it may step, another one than before?"""
    moved, covariance = solved.step_covariance()
    away = moved[place, :axes]
    return float(away @ np.linalg.solve(covariance[place, :axes, :axes], away)) > 0.25 * _CLEAR
