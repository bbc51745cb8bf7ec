"""What an estimate makes of one sample: the corrected field and the heading, for compasses of three axes and of two."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magmav.core.dip import dip_from_model
from magmav.core.field import MODEL_SIGMA_MG, ExpectedField
from magmav.core.heading import UNKNOWN, heading
from magmav.core.rotation import euler_rates, wrap_tau
from magmav.core.threes import inverse3
from magmav.core.two_axis import Doubts, down_from_dip, heading_of_two_axes, vertical_component
from magmav.core.types import IDENTITY3, NO_SHAPING, Estimate, Heading, Mat3, Sample, Shaping, Vec3, mat3, vec3

_LEAST_LEVEL = 0.05  # of what two axes see of the level plane; 1 when both lie in it
_WEAKEST_MG = 20.0  # a circle smaller than this is none
_UNKNOWN_MG2 = mat3(1e6 * np.eye(3), "covariance")


def corrected_field(s: Sample, e: Estimate, expected: ExpectedField | None) -> Vec3:
    """soft iron (A (m - b) + motor), (3,) mG, body axes, b at this throttle. Of two axes the third comes from the dip.

    Where that cannot be (no position, or beyond 60 degrees of tilt) it is 0.
    """
    field: Vec3 = s.mag_b_mg - e.hard_iron_b_mg
    if s.shaping is not NO_SHAPING:
        field = s.shaping.matrix @ field + s.shaping.motor_b_mg
    if s.throttle is not None:
        field = field - (s.throttle - e.throttle_mean) * e.throttle_b_mg
    field = e.soft_iron_b @ field
    return field if s.axes == 3 else with_third(field, s, _radius(e, expected), expected)


def iron_at_throttle(e: Estimate, matrix: Mat3, throttle: NDArray[np.float64]) -> NDArray[np.float64]:
    """The hard iron with the motors at each throttle, (N,) to (N, 3) mG, the sensor's axes; NaN: at mean power.

    matrix : the autopilot's own, (3, 3), which what the motors add does not go through.
    """
    away = np.where(np.isfinite(throttle), throttle - e.throttle_mean, 0.0)
    return np.asarray(e.hard_iron_b_mg + away[:, None] * np.linalg.solve(matrix, e.throttle_b_mg))


def iron_of_offsets(s: Sample, e: Estimate, expected: ExpectedField | None) -> Vec3:
    """The hard iron that offsets alone should take away, (3,) mG: with the soft iron's share of a level vehicle.

    Held level, soft iron bends the downward field into a constant that looks like hard iron; the rest turns with the
    heading and no offset can take it (estimation.md section 5). Without soft iron it is the hard iron itself.
    """
    if e.soft_iron_b is IDENTITY3:
        return e.hard_iron_b_mg
    down_mg = field_of(e, expected)[1]
    bent: NDArray[np.floating[Any]] = inverse3(e.soft_iron_b)[:, 2] * down_mg
    bent[2] -= down_mg
    if s.shaping.matrix is not IDENTITY3:
        bent = np.linalg.solve(s.shaping.matrix, bent)
    return vec3(e.hard_iron_b_mg + bent, "hard iron")


def with_third(field_b_mg: Vec3, s: Sample, radius_mg: float, expected: ExpectedField | None) -> Vec3:
    """The field of a two-axis compass with its third component (Sytnyk et al. 2014, Z_ES), or with 0 there."""
    down: float | None = None
    if expected is not None and expected.horizontal_mg >= _WEAKEST_MG:
        x, y, _ = field_b_mg.tolist()
        v = down_from_dip(max(radius_mg, _WEAKEST_MG), dip_from_model(expected))
        down = vertical_component(x, y, s.roll_rad, s.pitch_rad, v)
    out: Vec3 = np.array([field_b_mg[0], field_b_mg[1], down or 0.0])
    return out


def _radius(e: Estimate, expected: ExpectedField | None) -> float:
    """Of the calibrated circle; before it is known, what the model says."""
    return e.horizontal_mg if expected is None or e.horizontal_mg >= _WEAKEST_MG else expected.horizontal_mg


def covariance_of_field(s: Sample, e: Estimate) -> Mat3:
    """What the estimate's doubt is worth in the corrected field, (3, 3) mG^2, body axes."""
    by = e.soft_iron_b @ s.shaping.matrix
    out: Mat3 = by @ e.covariance_mg2 @ by.T
    if s.axes == 2:
        out[2, :] = out[:, 2] = 0.0  # the third component is not measured
    return out


def field_of(e: Estimate, expected: ExpectedField | None) -> tuple[float, float]:
    """Horizontal and downward field, mG: the model's, or what the data imply."""
    if expected is not None:
        return expected.horizontal_mg, expected.down_mg
    return e.horizontal_mg, e.down_mg


def published(
    s: Sample,
    field_b_mg: Vec3,
    radius_mg: float,
    covariance_b_mg2: Mat3,
    sigma_rad: float,
    tilt_sigma_rad: float,
    expected: ExpectedField | None,
) -> Heading:
    """The heading at the time of measurement. ``sigma_rad`` is that of three axes; two axes reckon their own.

    Two axes without a position have no dip, hence no heading.
    """
    declination = None if expected is None else expected.declination_rad
    if s.axes == 3:
        return heading(field_b_mg, s.roll_rad, s.pitch_rad, sigma_rad, declination)
    if expected is None or expected.horizontal_mg < _WEAKEST_MG:
        return UNKNOWN
    dip_sigma = MODEL_SIGMA_MG / expected.total_mg
    doubts = Doubts(covariance_b_mg2[:2, :2], dip_sigma, tilt_sigma_rad, MODEL_SIGMA_MG)
    x, y, _ = field_b_mg.tolist()
    radius, dip = max(radius_mg, _WEAKEST_MG), dip_from_model(expected)
    return heading_of_two_axes(x, y, s.roll_rad, s.pitch_rad, radius, dip, doubts, declination)


def turned_on(s: Sample, delay_s: float, h: Heading) -> Heading:
    """The heading of the measurement, turned on to the time of the message by the gyro."""
    lead = s.lead_rad + delay_s * euler_rates(s.roll_rad, s.pitch_rad, s.rate_b_rads)[2]
    magnetic, true = wrap_tau(h.magnetic_rad + lead), wrap_tau(h.true_rad + lead)
    return Heading(h.valid, h.true_valid, magnetic, true, h.sigma_rad)


def stored_heading(s: Sample, sent_b_mg: Vec3, expected: ExpectedField | None) -> Heading:
    """The heading of the stream as the autopilot corrects it. Its sigma is not known: pi."""
    radius = 0.0 if expected is None else expected.horizontal_mg
    h = published(s, sent_b_mg, radius, _UNKNOWN_MG2, math.pi, 0.0, expected)
    return h if s.axes == 3 or not h.valid else replace(h, sigma_rad=math.pi)


def without_third(undo: Callable[[Vec3], Vec3], shaping: Shaping) -> tuple[Callable[[Vec3], Vec3], Shaping]:
    """The autopilot's correction and its inverse for two axes: no third component takes part, in or out.

    undo(m) = L (m - motor) - offset in three axes. What a stored matrix mixes in from the third axis is not known here
    and taken as nothing. ValueError where that leaves nothing, as with a sensor mounted upright.
    """
    motor = shaping.motor_b_mg
    offset = -undo(motor)
    columns = [undo(vec3(motor + unit, "field")) + offset for unit in np.eye(3)]
    level = _two(np.linalg.inv(np.column_stack(columns)))
    if abs(np.linalg.det(level)) < _LEAST_LEVEL:
        raise ValueError("two axes: neither of the sensor's first two axes lies level")
    inverse = np.linalg.inv(level)
    kept = np.array([1.0, 1.0, 0.0])

    def two(sent_b_mg: Vec3) -> Vec3:
        return vec3(kept * (inverse @ (sent_b_mg - motor) - offset), "field")

    return two, Shaping(mat3(_two(shaping.matrix), "matrix"), vec3(kept * motor, "motor term"))


def _two(matrix: Mat3) -> Mat3:
    """Upper left block, and 1 for the third."""
    out = np.eye(3)
    out[:2, :2] = matrix[:2, :2]
    return out
