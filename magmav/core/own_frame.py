"""The own frame: level with the earth, and carried along by the gyro alone.

A frame stands here as the unit quaternion (w, x, y, z) that takes it to body axes, in plain numbers: this runs for
every attitude, and at that size numpy takes longer to make an array than the arithmetic does.
"""

from __future__ import annotations

import math
from struct import Struct

import numpy as np

from magmav.core.types import Mat3

Frame = tuple[float, float, float, float]
Vector = tuple[float, float, float]

_OPPOSITE = -0.999
_NINE = Struct("=9d")


def of_attitude(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Frame:
    """North, east and down themselves, seen from this attitude."""
    cr, sr = math.cos(0.5 * roll_rad), math.sin(0.5 * roll_rad)
    cp, sp = math.cos(0.5 * pitch_rad), math.sin(0.5 * pitch_rad)
    cy, sy = math.cos(0.5 * yaw_rad), math.sin(0.5 * yaw_rad)
    x, y, z = sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy
    return cr * cp * cy + sr * sp * sy, -x, -y, -z


def stepped(frame: Frame, before: Frame, after: Frame) -> Frame:
    """After a step of attitude from ``before`` to ``after``, both as of_attitude gives them."""
    return product(product(after, inverse(before)), frame)


def inverse(frame: Frame) -> Frame:
    """From body axes to the frame."""
    w, x, y, z = frame
    return w, -x, -y, -z


def carried(frame: Frame, rate_b_rads: Vector, dt_s: float) -> Frame:
    """After the body has turned by these rates for a time."""
    (x, y, z), (a, b, c, d) = rate_b_rads, frame
    rate = math.sqrt(x * x + y * y + z * z)
    half = 0.5 * rate * dt_s
    by, w = -math.sin(half) / rate if rate > 1e-12 else -0.5 * dt_s, math.cos(half)
    x, y, z = by * x, by * y, by * z
    return (
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    )


def levelled(frame: Frame, down_b: Vector) -> Frame:
    """Turned by the shortest way until it is level with the earth; as it is where that would be half a turn.

    down_b : where down is, seen from the body.
    """
    (w, x, y, z), (bx, by, bz) = frame, down_b
    ax, ay, az = 2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)  # its own down
    c = ax * bx + ay * by + az * bz
    if c < _OPPOSITE:
        return frame
    a, p, q, r = 1.0 + c, ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    w, x, y, z = (
        a * w - p * x - q * y - r * z,
        a * x + p * w + q * z - r * y,
        a * y - p * z + q * w + r * x,
        a * z + p * y - q * x + r * w,
    )
    n = math.sqrt(w * w + x * x + y * y + z * z)
    return w / n, x / n, y / n, z / n


def matrix(frame: Frame) -> Mat3:
    """From the own frame to body axes, (3, 3), read-only."""
    w, x, y, z = frame
    xx, yy, zz, xy, xz, yz, wx, wy, wz = x * x, y * y, z * z, x * y, x * z, y * z, w * x, w * y, w * z
    rows = _NINE.pack(
        *(1.0 - 2.0 * (yy + zz), 2.0 * (xy - wz), 2.0 * (xz + wy)),
        *(2.0 * (xy + wz), 1.0 - 2.0 * (xx + zz), 2.0 * (yz - wx)),
        *(2.0 * (xz - wy), 2.0 * (yz + wx), 1.0 - 2.0 * (xx + yy)),
    )
    return np.frombuffer(rows).reshape(3, 3)  # takes a third of what an array of tuples does


def product(p: Frame, q: Frame) -> Frame:
    """First q, then p."""
    a, b, c, d = p
    w, x, y, z = q
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )
