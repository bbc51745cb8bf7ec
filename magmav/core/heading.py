"""Heading from a corrected field (Sawicki 2017 eq. 5-8, signs corrected as in seed-methods.md S1)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magmav.core.rotation import wrap_tau
from magmav.core.types import Heading, Mat3, Vec3

UNKNOWN = Heading(False, False, 0.0, 0.0, 0.0)
_WEAKEST_MG = 20.0
"""Under this much horizontal field (within some 2 degrees of a magnetic pole) a direction means nothing."""


def level_field(field_b_mg: NDArray[np.float64], roll_rad: float, pitch_rad: float) -> tuple[float, float]:
    """The horizontal field ahead and to the right, mG: rows 1 and 2 of R_lb times the field, in plain numbers."""
    x, y, z = field_b_mg.tolist()
    cr, sr, cp, sp = math.cos(roll_rad), math.sin(roll_rad), math.cos(pitch_rad), math.sin(pitch_rad)
    return cp * x + sp * (sr * y + cr * z), cr * y - sr * z


def magnetic_heading(field_b_mg: NDArray[np.float64], roll_rad: float, pitch_rad: float) -> float | None:
    """Magnetic heading in [0, 2 pi), or None when the field has no horizontal part.

    DEVIATES: the paper prints arctan2(hx, hy); that is the heading plus 90 degrees. Right is atan2(-hy, hx).
    """
    ahead, right = level_field(field_b_mg, roll_rad, pitch_rad)
    if math.hypot(ahead, right) < 1e-9:
        return None
    return wrap_tau(math.atan2(-right, ahead))


def heading_sigma(
    covariance_b_mg2: Mat3,
    horizontal_mg: float,
    down_mg: float,
    roll_rad: float,
    pitch_rad: float,
    tilt_sigma: float,
) -> float:
    """One sigma of the heading, rad, at this tilt, from the hard iron's covariance and the tilt's own sigma (rad).

    An offset error e turns the heading by (its level, crosswise part) / H, so the mean over all headings is the
    RMS of both level axes; a tilt error turns it by tan(dip) = V / H per radian (seed-methods.md S1).
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = covariance_b_mg2.tolist()
    cp = math.cos(pitch_rad)
    x, y, z = -math.sin(pitch_rad), cp * math.sin(roll_rad), cp * math.cos(roll_rad)  # down; level is all but that
    down = x * (x * xx + y * (xy + yx) + z * (xz + zx)) + y * (y * yy + z * (yz + zy)) + z * z * zz
    spread = (xx + yy + zz - down) / 2.0
    return min(math.pi, math.hypot(math.sqrt(max(spread, 0.0)), down_mg * tilt_sigma) / max(horizontal_mg, 1.0))


def heading(
    field_b_mg: Vec3, roll_rad: float, pitch_rad: float, sigma_rad: float, declination_rad: float | None
) -> Heading:
    """The published heading: invalid where the field is too weak, true only where the declination is known."""
    ahead, right = level_field(field_b_mg, roll_rad, pitch_rad)
    if math.hypot(ahead, right) < _WEAKEST_MG:
        return UNKNOWN
    magnetic = wrap_tau(math.atan2(-right, ahead))
    if declination_rad is None:
        return Heading(True, False, magnetic, 0.0, sigma_rad)
    return Heading(True, True, magnetic, wrap_tau(magnetic + declination_rad), sigma_rad)
