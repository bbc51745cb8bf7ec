"""Sawicki 2017, method III: circle through the tilt-compensated field (eq. 15-20), streaming.

The paper's own order of operations: level first, then fit. It is exact where the tilt hardly changes, and blind to
the down axis, which is reported as not observed and as zero. DEVIATES: the centre, found in levelled axes, is taken to
body axes with the mean tilt, so that the answer can be compared with the other methods'.
"""

from __future__ import annotations

import numpy as np

from magmav.core.estimators.centred import CentredFitter
from magmav.core.field import ExpectedField
from magmav.core.rotation import level_from_body
from magmav.core.types import Estimate, Sample, vec3

_UNKNOWN_MG = 1000.0
"""One sigma of an axis this method says nothing about."""
_FOREVER_S = 1e9


class CircleEstimator:
    """Least-squares circle in the horizontal plane over everything learnt."""

    def __init__(self) -> None:
        self._fitter = CentredFitter(2, scale=200.0)
        self._matrix = np.eye(3)
        self._level = np.zeros((3, 3))
        self._down_mg = 0.0
        self._n = 0

    def step(self, sample: Sample) -> None:
        """Learn from one sample."""
        if not sample.learn:
            return
        self._matrix = sample.shaping.matrix
        level = level_from_body(sample.roll_rad, sample.pitch_rad)
        point = level @ (self._matrix @ sample.mag_b_mg + sample.shaping.motor_b_mg)
        self._fitter.add(point[:2])
        self._n += 1
        self._level += (level - self._level) / self._n
        self._down_mg += (float(point[2]) - self._down_mg) / self._n

    def estimate(self, expected: ExpectedField | None) -> Estimate | None:
        """Centre of the circle in the level plane; the down axis stays unknown."""
        fit = self._fitter.fit()
        if fit is None:
            return None
        level_covariance = np.diag([0.0, 0.0, _UNKNOWN_MG**2])
        level_covariance[:2, :2] = fit.covariance
        back = np.linalg.inv(self._level @ self._matrix)
        covariance = back @ level_covariance @ back.T
        iron = back @ np.append(fit.centre, 0.0)
        return Estimate(
            hard_iron_b_mg=vec3(iron, "hard iron"),
            covariance_mg2=covariance,
            own_sigma_mg=vec3(np.sqrt(np.diag(covariance)), "sigma"),
            horizontal_mg=fit.radius,
            down_mg=self._down_mg,
            residual_mg=fit.residual,
            step_nis=1.0,
            samples=fit.samples,
            changed_ago_s=_FOREVER_S,
        )
