"""Hard iron as the centre of the sphere the body-frame field lies on. Needs no attitude; needs motion in 3-D.

Fitted through the autopilot's own scale and matrix: the points are matrix @ sensor + motor, so that a stored soft-iron
matrix makes them round, and the centre is taken back to the sensor's axes.
"""

from __future__ import annotations

import math

import numpy as np

from magmav.core.estimators.centred import CentredFitter
from magmav.core.field import ExpectedField
from magmav.core.rotation import level_from_body
from magmav.core.types import Estimate, Sample, vec3

_FOREVER_S = 1e9


class SphereEstimator:
    """Least-squares sphere over everything learnt."""

    def __init__(self) -> None:
        self._fitter = CentredFitter(3)
        self._matrix = np.eye(3)
        self._n = 0
        # Mean down row of R_lb and mean levelled down field: the vertical field, once the centre is known.
        self._down_row = np.zeros(3)
        self._down_mg = 0.0

    def step(self, sample: Sample) -> None:
        """Learn from one sample."""
        if not sample.learn:
            return
        self._matrix = sample.shaping.matrix
        point = self._matrix @ sample.mag_b_mg + sample.shaping.motor_b_mg
        self._fitter.add(point)
        row = level_from_body(sample.roll_rad, sample.pitch_rad)[2]
        self._n += 1
        self._down_row += (row - self._down_row) / self._n
        self._down_mg += (float(row @ point) - self._down_mg) / self._n

    def estimate(self, expected: ExpectedField | None) -> Estimate | None:
        """Centre of the sphere. The expected field is not used: a sphere needs none."""
        fit = self._fitter.fit()
        if fit is None:
            return None
        back = np.linalg.inv(self._matrix)
        covariance = back @ fit.covariance @ back.T
        down = self._down_mg - float(self._down_row @ fit.centre)
        return Estimate(
            hard_iron_b_mg=vec3(back @ fit.centre, "hard iron"),
            covariance_mg2=covariance,
            own_sigma_mg=vec3(np.sqrt(np.diag(covariance)), "sigma"),
            horizontal_mg=math.sqrt(max(fit.radius**2 - down**2, 0.0)),
            down_mg=down,
            residual_mg=fit.residual,
            step_nis=1.0,
            samples=fit.samples,
            changed_ago_s=_FOREVER_S,
        )
