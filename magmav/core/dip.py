"""The dip a two-axis compass needs: from the place, from one reading, or from many (Sytnyk et al. 2014).

The dip I is the angle of the Earth's field below the horizon, rad, down positive: tan I = V / H.
Fields are what the two axes read with the iron removed, body axes, mG; psi is the MAGNETIC heading.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from magmav.core.azimuth import finite
from magmav.core.field import ExpectedField
from magmav.core.types import Mat3

_LEAST_TILT_2 = math.sin(math.radians(3.0)) ** 2
"""Under 3 degrees RMS of tilt, the attitude's own error (0.7 degrees is usual) is 10 % of what the dip is read from."""
_LEAST_READINGS = 10
_LARGEST_SCATTER = 0.2  # of the radius; a circle that is one scatters a tenth of that


def dip_from_latitude(latitude_rad: float) -> float:
    """Dip of a dipole: tan I = 2 tan L. ValueError outside -90 to 90 degrees.

    DEVIATES: the paper puts in the geographic latitude; the formula wants the geomagnetic one. A dipole is a poor
    Earth either way: with geographic latitudes between 60 south and 60 north it misses by some 11 degrees RMS and 31
    at worst. Each of them is up to 1.6 degrees of heading at roll = pitch = 10 where the dip is 67: use dip_from_model.
    """
    finite(latitude_rad=latitude_rad)
    if abs(latitude_rad) > math.pi / 2.0:
        raise ValueError(f"latitude_rad: want -pi/2 to pi/2, got {latitude_rad!r}")
    return math.atan2(2.0 * math.sin(latitude_rad), math.cos(latitude_rad))


def dip_from_model(expected: ExpectedField) -> float:
    """Dip of the world magnetic model's field."""
    return math.atan2(expected.down_mg, expected.horizontal_mg)


class ExtendedDip(NamedTuple):
    """Dip of one reading, with the downward field and the missing body-z component it rests on, mG."""

    dip_rad: float
    down_mg: float
    z_b_mg: float


def extended_dip(
    x_b_mg: float, y_b_mg: float, roll_rad: float, pitch_rad: float, magnetic_rad: float, least_d: float = 0.01
) -> ExtendedDip | None:
    """Eq. (5): the body-z field that leaves nothing to magnetic east, and the dip it implies. Z = -N / D.

    None where |D| < least_d: noise of the field comes out 1 / |D| times larger. D = 0 wherever
    tan(phi) = sin(theta) tan(psi), and not only level as the text says. magnetic_rad must come from elsewhere (gyro, a
    level reading before): from ``two_axis_heading`` at this attitude it gives back the dip that went in.
    Single values are biased by noise (-2 degrees at 10 degrees of tilt and half a per cent): ``DipFitter`` is not.

    DEVIATES: the printed numerator is garbled, and the quotient is Z, not the tangent of the dip; multiplied by
    cos(psi) throughout, so that 90 and 270 degrees are no exception.
    """
    finite(x_b_mg=x_b_mg, y_b_mg=y_b_mg, roll_rad=roll_rad, pitch_rad=pitch_rad, magnetic_rad=magnetic_rad)
    cr, sr, cp, sp = math.cos(roll_rad), math.sin(roll_rad), math.cos(pitch_rad), math.sin(pitch_rad)
    cy, sy = math.cos(magnetic_rad), math.sin(magnetic_rad)
    d = sp * cr * sy - sr * cy
    if abs(d) < max(least_d, 1e-12):
        return None
    z = -(sy * (x_b_mg * cp + y_b_mg * sp * sr) + cy * y_b_mg * cr) / d
    across = y_b_mg * sr + z * cr
    hx, hy, hz = x_b_mg * cp + sp * across, y_b_mg * cr - z * sr, cp * across - x_b_mg * sp
    return ExtendedDip(math.atan2(hz, math.hypot(hx, hy)), hz, z)


class DipFit(NamedTuple):
    """Radius rho and downward field V, mG, with their covariance (2, 2) mG^2 in that order; dip and its sigma, rad.

    residual_mg : RMS of the fit per axis.  tilt_2 : mean sin^2 of the tilt V was read from, less noise and rho's share.
    """

    radius_mg: float
    down_mg: float
    dip_rad: float
    dip_sigma_rad: float
    covariance_mg2: Mat3
    residual_mg: float
    tilt_2: float
    readings: float


class Refused(NamedTuple):
    """No answer, and why, as a plain sentence."""

    why: str


class DipFitter:
    """Least squares for (rho, V) over all readings: no singular heading, no bias from noise of the field, O(1).

    (x, y) = [[C00, C02], [C10, C12]] (rho, V), C = body_from_earth(phi, theta, psi). Replaces the mean of eq. (5).
    Kept as the triangular root of the normal equations, which needs no start value and loses no digits.
    The information on V is the sum of sin^2 theta + cos^2 theta sin^2 phi, which is sin^2 of the tilt. Noise of the
    attitude counts as tilt that never was and would make |V| smaller (the dip by 1.2 degrees at 4 degrees RMS of tilt
    with 0.7 of noise), so its share is taken off; noise of the field does no such thing.

    tilt_sigma_rad : error of roll and of pitch, each.  forget : weight of the past per reading; 1 keeps all.
    """

    def __init__(self, tilt_sigma_rad: float = 0.0, forget: float = 1.0) -> None:
        if not 0.0 < forget <= 1.0:
            raise ValueError(f"forget: want above 0 up to 1, got {forget!r}")
        if not 0.0 <= tilt_sigma_rad < 1.0:
            raise ValueError(f"tilt_sigma_rad: want 0 or more and under 1, got {tilt_sigma_rad!r}")
        self._forget = forget
        self._tilt_noise = 2.0 * tilt_sigma_rad**2
        self._root = [[0.0] * 3 for _ in range(3)]
        self._readings = 0
        self._weight = 0.0
        self._mean = np.zeros(4)  # of the four numbers that describe an attitude, and their scatter
        self._scatter = 0.0

    def add(self, x_b_mg: float, y_b_mg: float, roll_rad: float, pitch_rad: float, magnetic_rad: float) -> None:
        """Take one reading. ValueError unless all are finite."""
        finite(x_b_mg=x_b_mg, y_b_mg=y_b_mg, roll_rad=roll_rad, pitch_rad=pitch_rad, magnetic_rad=magnetic_rad)
        cr, sr, cp, sp = math.cos(roll_rad), math.sin(roll_rad), math.cos(pitch_rad), math.sin(pitch_rad)
        cy, sy = math.cos(magnetic_rad), math.sin(magnetic_rad)
        x_row, y_row = (cp * cy, -sp), (sr * sp * cy - cr * sy, sr * cp)
        self._fade(self._forget)
        _take(self._root, [*x_row, x_b_mg])
        _take(self._root, [*y_row, y_b_mg])
        self._readings += 1
        self._weight += 1.0
        attitude = np.array(x_row + y_row)
        away = attitude - self._mean
        self._mean = self._mean + away / self._weight
        self._scatter += float(away @ (attitude - self._mean))

    def merge(self, other: DipFitter) -> None:
        """Take all that another has seen after this one. ValueError unless both forget and doubt alike."""
        if (self._forget, self._tilt_noise) != (other._forget, other._tilt_noise):
            raise ValueError("dip: forgetting and tilt sigma of the two halves must agree")
        if other._weight == 0.0:
            return
        self._fade(self._forget**other._readings)
        self._readings += other._readings
        weight = self._weight + other._weight
        away = other._mean - self._mean
        for row in other._root:
            _take(self._root, row)
        self._scatter += other._scatter + float(away @ away) * self._weight * other._weight / weight
        self._mean = self._mean + away * other._weight / weight
        self._weight = weight

    def _fade(self, share: float) -> None:
        root = math.sqrt(share)
        self._root = [[root * value for value in row] for row in self._root]
        self._weight *= share
        self._scatter *= share

    def fit(self) -> DipFit | Refused:
        """The answer so far, or why there is none. Changes nothing."""
        if self._weight < _LEAST_READINGS:
            return Refused(f"fewer than {_LEAST_READINGS} readings")
        (a, b, p), (_, c, q), (_, _, rest) = self._root
        information = c * c - self._tilt_noise * self._weight
        tilt_2 = information / self._weight
        if min(self._scatter, a * a) / self._weight < _LEAST_TILT_2:
            return Refused("always the same attitude: turn the vehicle")
        if tilt_2 < _LEAST_TILT_2:
            return Refused("too little tilt: the dip shows only when the vehicle banks or pitches 3 degrees and more")
        down = c * q / information
        radius = (p - b * down) / a
        per_axis = (rest * rest + (q - c * down) ** 2) / (2.0 * self._weight - 2.0)
        lean = np.array([-b / a, 1.0])  # how the radius follows V
        covariance = per_axis * (np.diag([1.0 / a**2, 0.0]) + np.outer(lean, lean) * (c / information) ** 2)
        if radius <= 3.0 * math.sqrt(covariance[0, 0]):
            return Refused("no horizontal field along the headings given: no field, or headings that are wrong")
        if math.sqrt(per_axis) > _LARGEST_SCATTER * radius:
            return Refused("readings scatter too much around the fit")
        slope = np.array([-down, radius]) / (radius**2 + down**2)
        return DipFit(
            radius_mg=radius,
            down_mg=down,
            dip_rad=math.atan2(down, radius),
            dip_sigma_rad=math.sqrt(max(float(slope @ covariance @ slope), 0.0)),
            covariance_mg2=covariance,
            residual_mg=math.sqrt(per_axis),
            tilt_2=tilt_2,
            readings=self._weight,
        )


def _take(root: list[list[float]], row: Sequence[float]) -> None:
    """Turn one row of the regression into the triangular root, in place (Givens)."""
    left = list(row)
    for i, kept in enumerate(root):
        length = math.hypot(kept[i], left[i])
        if length > 0.0:
            c, s = kept[i] / length, left[i] / length
            for j in range(i, len(left)):
                kept[j], left[j] = c * kept[j] + s * left[j], c * left[j] - s * kept[j]
