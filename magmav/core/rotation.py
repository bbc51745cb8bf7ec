"""Rotations between body, levelled and earth axes, and angles that wrap.

Euler angles are ZYX (roll phi, pitch theta, yaw psi). C_bn = Rx(phi) Ry(theta) Rz(psi) takes north-east-down to body
(seed-methods.md, section 0).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magmav.core.types import Mat3

TAU = 2.0 * math.pi


def wrap_pi(angle_rad: float) -> float:
    """The same angle in (-pi, pi]."""
    out = math.remainder(angle_rad, TAU)
    return math.pi if out <= -math.pi else out


def wrap_tau(angle_rad: float) -> float:
    """The same angle in [0, 2 pi). A tiny negative angle is 0, not 2 pi."""
    out = math.fmod(angle_rad, TAU)
    out = out + TAU if out < 0.0 else out
    return 0.0 if out >= TAU else out


def level_from_body(roll_rad: float, pitch_rad: float) -> Mat3:
    """R_lb = Ry(-theta) Rx(-phi), (3, 3): undoes roll and pitch (Sawicki 2017 eq. 6, row 3 corrected)."""
    cr, sr = math.cos(roll_rad), math.sin(roll_rad)
    cp, sp = math.cos(pitch_rad), math.sin(pitch_rad)
    return np.array([[cp, sp * sr, sp * cr], [0.0, cr, -sr], [-sp, cp * sr, cp * cr]])


def body_from_earth(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Mat3:
    """C_bn, (3, 3), from ZYX Euler angles."""
    cy, sy = math.cos(yaw_rad), math.sin(yaw_rad)
    rz = np.array([[cy, sy, 0.0], [-sy, cy, 0.0], [0.0, 0.0, 1.0]])
    out: Mat3 = level_from_body(roll_rad, pitch_rad).T @ rz
    return out


def euler_from_quaternion(w: float, x: float, y: float, z: float) -> tuple[float, float, float] | None:
    """Roll, pitch, yaw of a quaternion that takes body to earth, rad; None when it has no usable length."""
    n = math.sqrt(w * w + x * x + y * y + z * z)
    if not 0.5 < n < 2.0:
        return None
    w, x, y, z = w / n, x / n, y / n, z / n
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x))))
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return roll, pitch, yaw


def euler_rates(roll_rad: float, pitch_rad: float, rate_b_rads: NDArray[np.float64]) -> tuple[float, float, float]:
    """Rates of roll, pitch and yaw from body rates, rad/s. Near +-90 degrees of pitch the cosine is held at 0.05."""
    p, q, r = rate_b_rads.tolist()  # plain numbers: numpy's own are slow one by one
    cr, sr, cp, sp = math.cos(roll_rad), math.sin(roll_rad), math.cos(pitch_rad), math.sin(pitch_rad)
    return euler_rates_at(cr, sr, cp, sp, p, q, r)


def euler_rates_at(
    cr: float, sr: float, cp: float, sp: float, p: float, q: float, r: float
) -> tuple[float, float, float]:
    """The same from cosine and sine of roll and of pitch, and body rates as plain numbers."""
    cp = math.copysign(max(abs(cp), 0.05), cp)
    turn = q * sr + r * cr
    return p + turn * sp / cp, q * cr - r * sr, turn / cp


def tilt_from_force(force_b: NDArray[np.float64]) -> tuple[float, float] | None:
    """Roll and pitch from specific force, rad; None in free fall (seed-methods.md section 0)."""
    fx, fy, fz = force_b.tolist()
    if fx * fx + fy * fy + fz * fz < 1e-6:
        return None
    return math.atan2(-fy, -fz), math.atan2(fx, math.hypot(fy, fz))


def tilt_angle(roll_rad: float, pitch_rad: float) -> float:
    """Angle between body down and earth down, rad."""
    return math.acos(max(-1.0, min(1.0, math.cos(roll_rad) * math.cos(pitch_rad))))


def cross_matrix(x: float, y: float, z: float) -> Mat3:
    """[v x], (3, 3): its product with u is v x u."""
    return np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))


def rotation(turn_rad: NDArray[np.float64]) -> Mat3:
    """Rotation by the vector ``turn_rad`` (3,), (3, 3), Rodrigues' formula; exact to rounding at any size."""
    x, y, z = turn_rad.tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    if angle < 1e-9:
        return np.eye(3)
    cross = cross_matrix(x, y, z)
    first, second = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle**2
    out: Mat3 = np.eye(3) + first * cross + second * (cross @ cross)
    return out
