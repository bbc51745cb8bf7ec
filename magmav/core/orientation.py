"""How a sensor sits in its vehicle: the numbers of MAV_SENSOR_ORIENTATION, and what each autopilot adds to them.

A triple is (roll, pitch, yaw) in degrees; the rotation Rz(yaw) Ry(pitch) Rx(roll) takes sensor axes to body axes.
Beyond 40 the two autopilots use the same numbers for different mountings, so a number means nothing without a table.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from magmav.core.rotation import body_from_earth
from magmav.core.types import Mat3, mat3

CUSTOM = 100
"""The number that says: see the three angles stored next to it."""


class Orientation(NamedTuple):
    """A mounting: degrees, roll first, then pitch, then yaw."""

    name: str
    roll_deg: float
    pitch_deg: float
    yaw_deg: float


def _table(*rows: tuple[float, float, float]) -> list[Orientation]:
    return [Orientation(_name(*row), *row) for row in rows]


def _name(*angles_deg: float) -> str:
    """As MAVLink calls it: the angles that are not zero, cut to whole degrees."""
    axes = zip(("ROLL", "PITCH", "YAW"), angles_deg, strict=True)
    return "_".join(f"{axis}_{int(angle)}" for axis, angle in axes if angle) or "NONE"


# fmt: off
_COMMON = _table(
    (0, 0, 0), (0, 0, 45), (0, 0, 90), (0, 0, 135), (0, 0, 180), (0, 0, 225), (0, 0, 270), (0, 0, 315),
    (180, 0, 0), (180, 0, 45), (180, 0, 90), (180, 0, 135), (0, 180, 0), (180, 0, 225), (180, 0, 270), (180, 0, 315),
    (90, 0, 0), (90, 0, 45), (90, 0, 90), (90, 0, 135), (270, 0, 0), (270, 0, 45), (270, 0, 90), (270, 0, 135),
    (0, 90, 0), (0, 270, 0), (0, 180, 90), (0, 180, 270), (90, 90, 0), (180, 90, 0), (270, 90, 0), (90, 180, 0),
    (270, 180, 0), (90, 270, 0), (180, 270, 0), (270, 270, 0), (90, 180, 90), (90, 0, 270), (90, 68, 293),
    (0, 315, 0), (90, 315, 0),
)
_PX4_MORE = _table(
    (270, 0, 180), (270, 0, 270), (0, 90, 180), (0, 9, 180), (0, 45, 0), (270, 0, 225), (270, 0, 315),
)
# fmt: on
_ARDUPILOT_MORE = _table((0, 7, 0), (45, 0, 0), (315, 0, 0))

MAVLINK: Mapping[int, Orientation] = dict(enumerate(_COMMON))
"""MAV_SENSOR_ORIENTATION of the MAVLink common dialect, 0 to 40."""

PX4: Mapping[int, Orientation] = dict(enumerate(_COMMON + _PX4_MORE))
"""enum Rotation of PX4 (src/lib/conversion/rotation.h), as CAL_MAGn_ROT and SENS_BOARD_ROT hold it."""

ARDUPILOT: Mapping[int, Orientation] = {
    **dict(enumerate(_COMMON + _ARDUPILOT_MORE)),
    # DEVIATES: the name says 68 and 293; the matrix ArduPilot applies is that of 68.8 and 293.3 (its rotations.h).
    38: Orientation("ROLL_90_PITCH_68_YAW_293", 90, 68.8, 293.3),
}
"""enum Rotation of ArduPilot, as COMPASS_ORIENT and AHRS_ORIENTATION hold it."""


def body_from_sensor(roll_deg: float, pitch_deg: float, yaw_deg: float) -> Mat3:
    """R_bs, (3, 3): Rz(yaw) Ry(pitch) Rx(roll), takes sensor axes to body axes. Angles in degrees."""
    turned = body_from_earth(math.radians(roll_deg), math.radians(pitch_deg), math.radians(yaw_deg)).T
    return mat3(np.where(abs(turned) < 1e-15, 0.0, turned), "orientation")


def rotation(number: int, table: Mapping[int, Orientation] = MAVLINK) -> Mat3:
    """R_bs, (3, 3), of a numbered mounting. ValueError for a number the table does not hold (CUSTOM among them)."""
    known = table.get(number)
    if known is None:
        raise ValueError(f"orientation {number}: not one of the {len(table)} known mountings")
    return body_from_sensor(known.roll_deg, known.pitch_deg, known.yaw_deg)
