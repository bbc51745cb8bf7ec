"""ArduPilot's compass correction and heading, in its order: rotation, offsets, scale, matrix, motor."""

from __future__ import annotations

import math
from typing import NamedTuple

from magmav_sim.faults import Vector
from magmav_sim.mounting import rotation_matrix
from magmav_sim.parameters import Parameters, compass_name

_LEAST_SCALE, _MOST_SCALE = 1 / 1.5, 1.5


class Correction(NamedTuple):
    """The stored correction of one compass, read once per change."""

    rotation: tuple[Vector, Vector, Vector] | None
    offsets_mg: Vector
    scale: float
    diagonal: Vector
    off_diagonal: Vector
    motor_mg: Vector
    motor_by: int  # COMPASS_MOTCT: 0 nothing, 1 throttle, 2 current

    def apply(self, sensor_mg: Vector, throttle: float, ampere: float) -> Vector:
        """The field the autopilot publishes, mG, body axes."""
        x, y, z = sensor_mg
        if self.rotation is not None:
            x, y, z = (row[0] * x + row[1] * y + row[2] * z for row in self.rotation)
        x, y, z = x + self.offsets_mg[0], y + self.offsets_mg[1], z + self.offsets_mg[2]
        if _LEAST_SCALE <= self.scale <= _MOST_SCALE:
            x, y, z = x * self.scale, y * self.scale, z * self.scale
        if self.diagonal != (0.0, 0.0, 0.0):
            (dx, dy, dz), (xy, xz, yz) = self.diagonal, self.off_diagonal
            x, y, z = dx * x + xy * y + xz * z, xy * x + dy * y + yz * z, xz * x + yz * y + dz * z
        by = throttle if self.motor_by == 1 else ampere if self.motor_by == 2 else 0.0
        return x + self.motor_mg[0] * by, y + self.motor_mg[1] * by, z + self.motor_mg[2] * by


def stored_correction(parameters: Parameters, compass: int) -> Correction:
    """What the parameters say for a compass. COMPASS_ORIENT counts for external compasses only."""
    orient = 0
    if parameters[compass_name("EXTERNAL", compass)] > 0:
        orient = int(parameters[compass_name("ORIENT", compass)])
    try:
        rotation = rotation_matrix(orient) if orient else None
    except ValueError:  # a mounting the simulator does not know corrects nothing
        rotation = None
    return Correction(
        rotation,
        parameters.vector("OFS", compass),
        parameters[compass_name("SCALE", compass)],
        parameters.vector("DIA", compass),
        parameters.vector("ODI", compass),
        parameters.vector("MOT", compass),
        int(parameters["COMPASS_MOTCT"]),
    )


def heading_rad(field_b_mg: Vector, roll_rad: float, pitch_rad: float) -> float:
    """Magnetic heading of a field, tilt undone."""
    x, y, z = field_b_mg
    sr, cr, sp, cp = math.sin(roll_rad), math.cos(roll_rad), math.sin(pitch_rad), math.cos(pitch_rad)
    return math.atan2(z * sr - y * cr, x * cp + y * sr * sp + z * cr * sp)
