"""A compass of two axes: the third is reckoned from the dip (Sytnyk et al. 2014, after Cho and Park 2005).

With the field forward x and right y in body axes (iron removed, mG), roll phi, pitch theta, and the Earth's downward
field V = rho tan I (rho the radius of the calibrated circle, I the dip):
    hx = (x + V sin theta) / cos theta
    hy = (y - hx sin theta sin phi - V cos theta sin phi) / cos phi          heading = atan2(-hy, hx)
That is the levelling of all three axes solved for the two that are missing: exact while the dip is, upright only.
A dip wrong by e turns the heading by up to e sec^2 I tan(tilt), so steep fields want a good dip or little tilt.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from magmav.core.azimuth import finite
from magmav.core.heading import UNKNOWN
from magmav.core.rotation import tilt_angle, wrap_tau
from magmav.core.types import Heading, Mat3

MAX_TILT_RAD = math.radians(60.0)
"""Beyond this the two axes see too little of the horizontal field: every function here refuses."""
_WEAKEST_MG = 20.0  # as for three axes, see core.heading


def down_from_dip(radius_mg: float, dip_rad: float) -> float:
    """V = rho tan I, mG. ValueError for a radius that is not above 0 or a dip that is not under 90 degrees.

    DEVIATES: the paper writes sin(lambda), which holds for a total field of 1 only, while its own normalisation (3)
    leaves a circle of radius 0.5. At a dip of 67 degrees that costs half a degree per degree of roll.
    """
    finite(radius_mg=radius_mg, dip_rad=dip_rad)
    if not (radius_mg > 0.0 and abs(dip_rad) < math.pi / 2.0):
        raise ValueError(f"want a radius above 0 and a dip under 90 degrees, got {radius_mg!r} mG, {dip_rad!r} rad")
    return radius_mg * math.tan(dip_rad)


def vertical_component(x_b_mg: float, y_b_mg: float, roll_rad: float, pitch_rad: float, down_mg: float) -> float | None:
    """Z_ES, mG: what the missing body-z axis would read. None beyond 60 degrees of tilt.

    The printed signs are right for forward-right-down axes; the print's sin(lambda) is down_mg (``down_from_dip``).
    """
    finite(x_b_mg=x_b_mg, y_b_mg=y_b_mg, roll_rad=roll_rad, pitch_rad=pitch_rad, down_mg=down_mg)
    if tilt_angle(roll_rad, pitch_rad) > MAX_TILT_RAD:
        return None
    cr, sr, cp, sp = math.cos(roll_rad), math.sin(roll_rad), math.cos(pitch_rad), math.sin(pitch_rad)
    return (down_mg + x_b_mg * sp - y_b_mg * cp * sr) / (cp * cr)


def level_two_axes(
    x_b_mg: float, y_b_mg: float, roll_rad: float, pitch_rad: float, down_mg: float
) -> tuple[float, float] | None:
    """Horizontal field ahead and to the right, mG. None beyond 60 degrees of tilt.

    DEVIATES: the printed X_TILT and X_TILT_EX begin with Y cos(theta); it is X cos(theta).
    """
    finite(x_b_mg=x_b_mg, y_b_mg=y_b_mg, roll_rad=roll_rad, pitch_rad=pitch_rad, down_mg=down_mg)
    if tilt_angle(roll_rad, pitch_rad) > MAX_TILT_RAD:
        return None
    cr, sr, cp, sp = math.cos(roll_rad), math.sin(roll_rad), math.cos(pitch_rad), math.sin(pitch_rad)
    ahead = (x_b_mg + down_mg * sp) / cp
    return ahead, (y_b_mg - ahead * sp * sr - down_mg * cp * sr) / cr


def two_axis_heading(
    x_b_mg: float, y_b_mg: float, roll_rad: float, pitch_rad: float, radius_mg: float, dip_rad: float
) -> float | None:
    """Magnetic heading in [0, 2 pi); None beyond 60 degrees of tilt or without a horizontal field."""
    level = level_two_axes(x_b_mg, y_b_mg, roll_rad, pitch_rad, down_from_dip(radius_mg, dip_rad))
    if level is None or math.hypot(*level) < 1e-9:
        return None
    return wrap_tau(math.atan2(-level[1], level[0]))


@dataclass(frozen=True, slots=True, eq=False)
class Doubts:
    """One sigma of everything a two-axis heading rests on.

    covariance_b_mg2 : (2, 2) of the field forward and right, mG^2: the hard iron's, plus noise if one reading counts.
    dip_rad, radius_mg : of the dip and of the circle's radius.  tilt_rad : of roll and of pitch, each, independent.
    """

    covariance_b_mg2: Mat3
    dip_rad: float
    tilt_rad: float
    radius_mg: float = 0.0


class Slopes(NamedTuple):
    """How the heading answers to what it is made of: rad per mG, and rad per rad."""

    x: float
    y: float
    roll: float
    pitch: float
    radius: float
    dip: float


def heading_slopes(
    x_b_mg: float, y_b_mg: float, roll_rad: float, pitch_rad: float, radius_mg: float, dip_rad: float
) -> Slopes | None:
    """Exact partial derivatives of ``two_axis_heading``; None where there is no heading."""
    down = down_from_dip(radius_mg, dip_rad)
    level = level_two_axes(x_b_mg, y_b_mg, roll_rad, pitch_rad, down)
    if level is None or math.hypot(*level) < 1e-9:
        return None
    return _slopes(level, roll_rad, pitch_rad, radius_mg, dip_rad)


def _slopes(level: tuple[float, float], roll_rad: float, pitch_rad: float, radius_mg: float, dip_rad: float) -> Slopes:
    """The derivatives where the levelled field is known already."""
    hx, hy = level
    down = radius_mg * math.tan(dip_rad)
    cr, cp, sp = math.cos(roll_rad), math.cos(pitch_rad), math.sin(pitch_rad)
    tr, tp = math.tan(roll_rad), math.tan(pitch_rad)
    square = hx * hx + hy * hy

    def turn(ahead: float, right: float) -> float:
        return (hy * ahead - hx * right) / square

    by_down = turn(tp, -tr / cp)
    return Slopes(
        x=turn(1.0 / cp, -tp * tr),
        y=turn(0.0, 1.0 / cr),
        roll=turn(0.0, hy * tr - hx * sp - down * cp),
        pitch=turn(down + hx * tp, -tr * hx / cp),
        radius=by_down * math.tan(dip_rad),
        dip=by_down * radius_mg / math.cos(dip_rad) ** 2,
    )


def two_axis_sigma(
    x_b_mg: float,
    y_b_mg: float,
    roll_rad: float,
    pitch_rad: float,
    radius_mg: float,
    dip_rad: float,
    doubts: Doubts,
) -> float | None:
    """One sigma of the heading at this attitude and heading, rad, at most pi; None where there is no heading.

    Linearised: good while the answer is well under a radian.
    """
    slopes = heading_slopes(x_b_mg, y_b_mg, roll_rad, pitch_rad, radius_mg, dip_rad)
    return None if slopes is None else _sigma(slopes, doubts)


def _sigma(slopes: Slopes, doubts: Doubts) -> float:
    field = np.array([slopes.x, slopes.y])
    return min(
        math.pi,
        math.hypot(
            math.sqrt(max(float(field @ doubts.covariance_b_mg2 @ field), 0.0)),
            slopes.dip * doubts.dip_rad,
            slopes.radius * doubts.radius_mg,
            math.hypot(slopes.roll, slopes.pitch) * doubts.tilt_rad,
        ),
    )


def worst_turn_per_dip(tilt_rad: float, dip_rad: float) -> float:
    """Heading error per error of dip at the worst heading, rad per rad: sec^2 I tan(tilt).

    Any roll and pitch with the same tilt between body down and earth down give the same.
    """
    finite(tilt_rad=tilt_rad, dip_rad=dip_rad)
    if not (0.0 <= tilt_rad < math.pi / 2.0 and abs(dip_rad) < math.pi / 2.0):
        raise ValueError(f"want a tilt and a dip under 90 degrees, got {tilt_rad!r} and {dip_rad!r} rad")
    return math.tan(tilt_rad) / math.cos(dip_rad) ** 2


def heading_of_two_axes(
    x_b_mg: float,
    y_b_mg: float,
    roll_rad: float,
    pitch_rad: float,
    radius_mg: float,
    dip_rad: float,
    doubts: Doubts,
    declination_rad: float | None,
) -> Heading:
    """The heading as it is published, with its sigma: not valid where refused or where the field is too weak."""
    level = level_two_axes(x_b_mg, y_b_mg, roll_rad, pitch_rad, down_from_dip(radius_mg, dip_rad))
    if level is None or math.hypot(*level) < _WEAKEST_MG:
        return UNKNOWN
    sigma = _sigma(_slopes(level, roll_rad, pitch_rad, radius_mg, dip_rad), doubts)
    magnetic = wrap_tau(math.atan2(-level[1], level[0]))
    if declination_rad is None:
        return Heading(True, False, magnetic, 0.0, sigma)
    return Heading(True, True, magnetic, wrap_tau(magnetic + declination_rad), sigma)
