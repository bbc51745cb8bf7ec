"""From Samples to points and from a figure of points to an Estimate, in the two orders of operations.

body    subtract in body axes, then level: the default, right however the vehicle tilts, for the iron is fixed to it
level   level, then fit, as Sawicki 2017 (and Sytnyk et al. 2014) do: a circle stays one only while the tilt does not
        change. Iron of (400, -300, 900) where the field is 1000 horizontally costs, at 2, 5, 10 and 20 degrees of
        wobble, 2.3, 5.9, 12.5 and 26.8 degrees of heading at worst, with perfect tilt angles (seed-methods.md S5)

Points are matrix @ sensor + motor, so that a soft-iron matrix the autopilot already holds makes them round; the centre
is taken back to the sensor's axes.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from magmav.core.estimators.fit import WEAK, Array, Fit, Fitter, Refusal
from magmav.core.field import ExpectedField
from magmav.core.rotation import level_from_body
from magmav.core.types import Estimate, Sample, mat3, vec3

UNKNOWN_MG = 1000.0
"""One sigma of a direction a method says nothing about, and of every direction where a method has no sigma.

It is that of the points' axes: a stored matrix of scale 1.2 makes 833 of it. Estimate.says_b tells such axes apart.
"""
_MOSTLY = 0.5  # an axis of which so much is unseen is one nothing is said of
_FOREVER_S = 1e9
_WILD_MG = 1e6  # a thousand gauss


class Order(Protocol):
    """One order of operations: keeps what is needed to take the figure back to body axes."""

    def point(self, sample: Sample) -> Array:
        """The point (d,) a sample gives the fitter, mG."""
        ...

    def keep(self, sample: Sample) -> None:
        """Take note of the tilt of a sample that was given."""
        ...

    def estimate(self, fit: Fit) -> Estimate:
        """The figure as a belief about the compass."""
        ...


class BodyOrder:
    """Points in body axes, (3,). A two-axis compass has 0 for its third, so its points lie in the plane of x and y."""

    def __init__(self) -> None:
        self._matrix: Array = np.eye(3)
        self._n = 0
        self._mean: Array = np.zeros(3)
        self._row: Array = np.zeros(3)  # mean down row of R_lb, and mean of point x row: the field downward
        self._down: Array = np.zeros((3, 3))
        self._axes = 3

    def point(self, sample: Sample) -> Array:
        """The field through the stored matrix, body axes."""
        out: Array = sample.shaping.matrix @ sample.mag_b_mg + sample.shaping.motor_b_mg
        return out

    def keep(self, sample: Sample) -> None:
        """Carry the means forward."""
        self._matrix, self._axes = sample.shaping.matrix, sample.axes
        point = self.point(sample)
        row = level_from_body(sample.roll_rad, sample.pitch_rad)[2]
        self._n += 1
        self._mean = self._mean + (point - self._mean) / self._n
        self._row = self._row + (row - self._row) / self._n
        self._down = self._down + (np.outer(point, row) - self._down) / self._n

    def estimate(self, fit: Fit) -> Estimate:
        """Hard iron in the sensor's axes; directions the points did not span are zero and unknown."""
        back = np.linalg.inv(self._matrix)
        unseen = np.eye(3) - fit.seen @ fit.seen.T
        if self._axes == 2:
            horizontal, down = fit.radius, 0.0
        else:
            down = float(np.sum(fit.matrix * self._down.T) - self._row @ (fit.matrix @ fit.centre))
            total2 = fit.radius**2 + float(np.sum((unseen @ self._mean) ** 2))
            horizontal = math.sqrt(max(total2 - down**2, 0.0))
        return _estimate(fit, back, fit.centre, unseen, fit.covariance, fit.matrix, horizontal, down)


class LevelOrder:
    """Points are the two horizontal components of the levelled field, (2,): blind to the down axis, and says so.

    DEVIATES: the centre, found in levelled axes, is taken to body axes with the mean tilt, so that the answer can be
    compared with the other methods' and written to an autopilot. A two-axis compass cannot be levelled before it is
    calibrated: its points are x and y as they are.
    """

    def __init__(self) -> None:
        self._matrix: Array = np.eye(3)
        self._level: Array = np.zeros((3, 3))
        self._down_mg = 0.0
        self._n = 0

    def point(self, sample: Sample) -> Array:
        """The levelled field's horizontal part, Sawicki 2017 eq. (6)."""
        out: Array = self._levelled(sample)[1][:2]
        return out

    def keep(self, sample: Sample) -> None:
        """Carry the means forward."""
        level, point = self._levelled(sample)
        self._matrix = sample.shaping.matrix
        self._n += 1
        self._level = self._level + (level - self._level) / self._n
        self._down_mg += (float(point[2]) - self._down_mg) / self._n

    @staticmethod
    def _levelled(s: Sample) -> tuple[Array, Array]:
        level = level_from_body(s.roll_rad, s.pitch_rad) if s.axes == 3 else np.eye(3)
        return level, level @ (s.shaping.matrix @ s.mag_b_mg + s.shaping.motor_b_mg)

    def estimate(self, fit: Fit) -> Estimate:
        """Hard iron in the level plane; the down axis stays unknown."""
        to_body = np.linalg.inv(self._level)
        back = np.linalg.inv(self._matrix) @ to_body
        soft, covariance = np.eye(3), None
        soft[:2, :2] = fit.matrix
        if fit.covariance is not None:
            covariance = np.zeros((3, 3))
            covariance[:2, :2] = fit.covariance
        centre, down = np.append(fit.centre, 0.0), np.diag((0.0, 0.0, 1.0))
        soft = to_body @ soft @ self._level if np.any(fit.matrix != np.eye(2)) else np.eye(3)
        return _estimate(fit, back, centre, down, covariance, soft, fit.radius, self._down_mg)


def _estimate(
    fit: Fit,
    back: Array,
    centre: Array,
    unseen: Array,
    covariance: Array | None,
    soft: Array,
    horizontal_mg: float,
    down_mg: float,
) -> Estimate:
    if covariance is None:
        iron_covariance = np.eye(3) * UNKNOWN_MG**2
    else:
        iron_covariance = back @ (covariance + unseen * UNKNOWN_MG**2) @ back.T
    x, y, z = (np.diag(back @ unseen @ back.T) < _MOSTLY * np.diag(back @ back.T)).tolist()
    return Estimate(
        hard_iron_b_mg=vec3(back @ centre, "hard iron"),
        covariance_mg2=iron_covariance,
        own_sigma_mg=vec3(np.sqrt(np.maximum(np.diag(iron_covariance), 0.0)), "sigma"),
        horizontal_mg=horizontal_mg,
        down_mg=down_mg,
        residual_mg=fit.residual,
        step_nis=1.0,
        samples=fit.samples,
        changed_ago_s=_FOREVER_S,
        soft_iron_b=mat3(soft, "soft iron"),
        says_b=(x, y, z),
    )


class FitEstimator:
    """An estimator made of an order and a fitter. The world model is not used: a figure needs none."""

    def __init__(self, order: Order, fitter: Fitter, has_sigma: bool = True) -> None:
        self._order = order
        self._fitter = fitter
        self.has_sigma = has_sigma  # False: the sigma of the Estimate is "unknown" on every axis
        self._wild = 0

    def step(self, sample: Sample) -> None:
        """Learn from one sample."""
        if not sample.learn:
            return
        point = self._order.point(sample)
        if not float(np.abs(point).max()) < _WILD_MG:
            self._wild += 1
            return
        self._fitter.add(point)
        self._order.keep(sample)

    def estimate(self, expected: ExpectedField | None) -> Estimate | None:
        """What the points make, or None; why_not says why."""
        fit = self._fitter.fit()
        return None if isinstance(fit, Refusal) else self._order.estimate(fit)

    def why_not(self) -> str | None:
        """The reason there is no estimate; None where there is one."""
        fit = self._fitter.fit()
        if not isinstance(fit, Refusal):
            return None
        return (Refusal.NOT_FINITE if fit is Refusal.TOO_FEW and self._wild else fit).value

    def why_weak(self) -> str | None:
        """Why the estimate there is rests on little; None where it does not, or where there is none."""
        fit = self._fitter.fit()
        return WEAK if isinstance(fit, Fit) and fit.weak else None
