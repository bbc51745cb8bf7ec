"""Closed-form manoeuvres: ZYX angles of any size over time, so that loops and vertical flight are nothing special.

A motion is a function (tau, rng) -> Path. tau (N,) is the motion's own time, s: flights stretch it while the vehicle
stands on the ground. Angles are smooth functions of tau; C_bn = Rx(roll) Ry(pitch) Rz(yaw) takes north-east-down to
body axes forward-right-down.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
GRAVITY_MSS = 9.80665

QUAD, PLANE, ROVER, BOAT, TAILSITTER = 2, 1, 10, 11, 23  # MAV_TYPE


class Path(NamedTuple):
    """roll, pitch, yaw (N,) rad, unbounded; speed (N,) m/s along the nose (unused for quads); bob (N,) share by which
    the throttle swings about its mean."""

    roll_rad: Array
    pitch_rad: Array
    yaw_rad: Array
    speed_mps: Array
    bob: Array


Motion = Callable[[Array, np.random.Generator], Path]


def _deg(value: float) -> float:
    return float(np.radians(value))


def wobble(tau: Array, r: np.random.Generator, size_deg: float) -> Array:
    """Three sines of random phase, RMS size_deg, (N,) rad."""
    out = np.zeros_like(tau)
    for rate in r.uniform((0.25, 0.7, 1.4), (0.5, 1.2, 2.4)):
        out += np.sin(rate * tau + r.uniform(0.0, 2.0 * np.pi))
    return np.asarray(_deg(size_deg) * out * np.sqrt(2.0 / 3.0))


def ease(x: Array) -> Array:
    """0 before 0, 1 after 1, and between them a step whose speed begins and ends at rest."""
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(x - np.sin(2.0 * np.pi * x) / (2.0 * np.pi))


def _path(tau: Array, roll: Array, pitch: Array, yaw: Array, speed: float | Array = 0.0, bob: float = 0.08) -> Path:
    return Path(roll, pitch, yaw, np.broadcast_to(np.asarray(speed, dtype=float), tau.shape), bob * np.sin(1.1 * tau))


def hover_yaw(tau: Array, r: np.random.Generator) -> Path:
    """A multirotor on one spot turning all the way round both ways, leaning 3 to 5 degrees against the wind."""
    a, b = r.uniform(0.0, 2.0 * np.pi, 2)
    yaw = b + 2.5 * np.pi * np.sin(tau / 9.0 + a)
    lean = _deg(4.0) + wobble(tau, r, 0.7)
    roll = lean * np.sin(yaw - b) + wobble(tau, r, 0.8)
    return _path(tau, roll, -lean * np.cos(yaw - b) + wobble(tau, r, 0.8), yaw)


def figure8(tau: Array, r: np.random.Generator) -> Path:
    """Whole turns both ways, banked up to 28 degrees."""
    a, b = r.uniform(0.0, 2.0 * np.pi, 2)
    roll = _deg(28.0) * np.cos(tau / 6.0 + a) + wobble(tau, r, 1.0)
    pitch = _deg(-4.0) + _deg(4.0) * np.sin(0.7 * tau + b) + wobble(tau, r, 0.7)
    return _path(tau, roll, pitch, b + 8.0 * np.sin(tau / 6.0 + a))


def survey(tau: Array, r: np.random.Generator) -> Path:
    """Legs of 11 s and half turns of 4 s in alternate directions, nose down 7 degrees, 18 degrees of bank in turns."""
    a, b = r.uniform(0.0, 6.0), r.uniform(0.0, 2.0 * np.pi)
    leg, phase = np.divmod(tau + a, 15.0)
    part = (phase - 11.0) / 4.0
    side = np.where(leg % 2 == 0, 1.0, -1.0)
    yaw = b + np.where(leg % 2 == 0, 0.0, np.pi) + side * np.pi * ease(part) + wobble(tau, r, 1.0)
    bank = _deg(18.0) * np.sin(np.pi * np.clip(part, 0.0, 1.0)) ** 2
    return _path(tau, side * bank + wobble(tau, r, 1.2), _deg(-7.0) + wobble(tau, r, 1.0), yaw)


def loiter_fw(tau: Array, r: np.random.Generator) -> Path:
    """A plane circling to the right for 100 s, then to the left, 28 degrees of bank, 18 m/s."""
    speed = 18.0
    bank = _deg(28.0) * (1.0 - 2.0 * ease((tau - 100.0) / 5.0))
    step = float(tau[1] - tau[0]) if len(tau) > 1 else 0.0
    rate = GRAVITY_MSS * np.tan(bank) / speed
    yaw = r.uniform(0.0, 2.0 * np.pi) + np.cumsum(rate * np.diff(tau, prepend=tau[0] - step))
    return _path(tau, bank + wobble(tau, r, 1.0), _deg(3.0) + wobble(tau, r, 0.8), yaw, speed)


def aggressive(tau: Array, r: np.random.Generator) -> Path:
    """A multirotor thrown about: 40 degrees of roll, 30 of pitch, yaw swinging through whole turns."""
    a, b, c = r.uniform(0.0, 2.0 * np.pi, 3)
    roll = _deg(40.0) * np.sin(0.9 * tau + a) * np.cos(0.11 * tau)
    return _path(tau, roll, _deg(30.0) * np.sin(0.7 * tau + b), c + 5.0 * np.sin(tau / 5.0 + a), bob=0.15)


def cruise(tau: Array, r: np.random.Generator) -> Path:
    """A plane straight ahead, 20 m/s, in light turbulence."""
    yaw = r.uniform(0.0, 2.0 * np.pi) + wobble(tau, r, 2.0)
    return _path(tau, wobble(tau, r, 2.0), _deg(2.0) + wobble(tau, r, 1.2), yaw, 20.0)


def hover_only(tau: Array, r: np.random.Generator) -> Path:
    """A multirotor holding position and heading; it sways by a degree and a half."""
    a = r.uniform(0.0, 2.0 * np.pi)
    roll = _deg(3.0) * np.sin(a) + wobble(tau, r, 1.4)
    return _path(tau, roll, _deg(3.0) * np.cos(a) + wobble(tau, r, 1.4), a + wobble(tau, r, 1.5))


def tailsitter(tau: Array, r: np.random.Generator) -> Path:
    """Nose straight up and turning about the vertical; over into forward flight with banked turns; up again."""
    a = r.uniform(0.0, 2.0 * np.pi)
    phase = np.mod(tau, 90.0)
    forward = ease((phase - 25.0) / 5.0) - ease((phase - 75.0) / 5.0)
    pitch = _deg(90.0) - _deg(86.0) * forward + wobble(tau, r, 1.2)
    roll = forward * _deg(25.0) * np.sin(tau / 5.0) + wobble(tau, r, 1.0)
    yaw = a + 3.0 * np.sin(tau / 7.0 + a) + forward * np.sin(tau / 5.0)
    return _path(tau, roll, pitch, yaw, 16.0 * forward)


def boat(tau: Array, r: np.random.Generator) -> Path:
    """A boat that rolls 5 degrees and pitches 2 on the waves while it changes course."""
    a, b = r.uniform(0.0, 2.0 * np.pi, 2)
    roll = _deg(5.0) * np.sin(1.5 * tau + a)
    yaw = a + 2.6 * np.sin(tau / 18.0 + b) + 0.02 * tau
    return _path(tau, roll, _deg(2.0) * np.sin(1.1 * tau + b), yaw, 3.0)


def rover(tau: Array, r: np.random.Generator) -> Path:
    """A rover on a flat field, hardly a third of a degree off level, driving curves both ways."""
    a, b = r.uniform(0.0, 2.0 * np.pi, 2)
    yaw = a + 3.5 * np.sin(tau / 11.0 + b) + 0.03 * tau
    return _path(tau, wobble(tau, r, 0.3), wobble(tau, r, 0.3), yaw, 2.0)


def aerobatics(tau: Array, r: np.random.Generator) -> Path:
    """A plane flying loops, rolls and steep turns, 25 m/s; a cycle of 30 s."""
    a = r.uniform(0.0, 2.0 * np.pi)
    cycle, phase = np.divmod(tau + r.uniform(0.0, 5.0), 30.0)
    loop = 2.0 * np.pi * ease((phase - 4.0) / 8.0)
    spin = 2.0 * np.pi * ease((phase - 15.0) / 4.0)
    part = (phase - 21.0) / 8.0
    bank = _deg(45.0) * np.sin(np.pi * np.clip(part, 0.0, 1.0)) ** 2
    yaw = a + _deg(150.0) * (cycle + ease(part))
    return _path(tau, spin + bank + wobble(tau, r, 0.8), loop + wobble(tau, r, 0.8), yaw, 25.0)
