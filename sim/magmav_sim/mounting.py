"""How a sensor may sit: MAV_SENSOR_ORIENTATION 0 to 40, taken from what MAVLink calls each of them."""

from __future__ import annotations

import math

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav_sim.faults import Vector

Matrix = tuple[Vector, Vector, Vector]
MOST = 40


def _angles_deg(name: str) -> tuple[float, float, float]:
    """Roll, pitch, yaw out of a name like MAV_SENSOR_ROTATION_ROLL_180_YAW_45."""
    words = name.removeprefix("MAV_SENSOR_ROTATION_").split("_")
    turns = dict(zip(words[::2], map(float, words[1::2]), strict=False))
    return turns.get("ROLL", 0.0), turns.get("PITCH", 0.0), turns.get("YAW", 0.0)


_ORIENTATIONS = dialect.enums["MAV_SENSOR_ORIENTATION"]
_ROTATIONS_DEG = {number: _angles_deg(_ORIENTATIONS[number].name) for number in range(MOST + 1)}
# The matrix ArduPilot applies for 38 is that of these angles, PX4's is that of the name (autopilots.md, rotations).
_ARDUPILOT_DEG = _ROTATIONS_DEG | {38: (90.0, 68.8, 293.3)}


def turned(roll_deg: float, pitch_deg: float, yaw_deg: float) -> Matrix:
    """Rz(yaw) Ry(pitch) Rx(roll): sensor axes to body axes."""
    roll, pitch, yaw = map(math.radians, (roll_deg, pitch_deg, yaw_deg))
    sr, cr, sp, cp, sy, cy = (f(a) for a in (roll, pitch, yaw) for f in (math.sin, math.cos))
    return (
        (cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy),
        (cp * sy, sr * sp * sy + cr * cy, cr * sp * sy - sr * cy),
        (-sp, sr * cp, cr * cp),
    )


def rotation_matrix(orient: int, kind: str = "ardupilot") -> Matrix:
    """Sensor axes to body axes for a number 0 to 40, as this kind of autopilot has it. ValueError for others."""
    table = _ARDUPILOT_DEG if kind == "ardupilot" else _ROTATIONS_DEG
    if orient not in table:
        raise ValueError(f"orient: mountings 0 to {MOST} are simulated, got {orient}")
    return turned(*table[orient])
