"""Vehicles on the ground, on water and in somebody's hands, as bytes; the truth is plain rotations (honest_flight)."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from honest_flight import Motion, body_rates, field_in_body, wander
from memory_flight import STORED, Frame, Teller
from synthetic_flight import HARD_IRON_MG

COPTER, ROVER, BOAT = 2, 10, 11


def eased(t: np.ndarray, seconds: float = 2.0) -> np.ndarray:
    """From 0 at rest to 1 at rest, (N,)."""
    x = np.clip(t / seconds, 0.0, 1.0)
    return x - np.sin(2.0 * np.pi * x) / (2.0 * np.pi)


def boat(t: np.ndarray, r: np.random.Generator) -> Motion:
    """Two full turns in two minutes, rolling 5 degrees on the waves and pitching 3, around no tilt at all."""
    a, b, c = r.uniform(0.0, 2.0 * np.pi, 3)
    roll, pitch = np.radians(5.0) * np.sin(1.5 * t + a), np.radians(3.0) * np.sin(1.1 * t + b)
    return Motion(roll, pitch, c + 4.0 * np.pi * t / 120.0)


def rover(t: np.ndarray, r: np.random.Generator) -> Motion:
    """A flat yard: two full turns in two minutes and no tilt."""
    return Motion(0.0 * t, 0.0 * t, r.uniform(0.0, 2.0 * np.pi) + 4.0 * np.pi * t / 120.0)


def tumble(t: np.ndarray, r: np.random.Generator) -> Motion:
    """Taken up after 3 s and turned through all attitudes, at up to a radian a second."""
    a, up = r.uniform(0.0, 2.0 * np.pi), eased(t - 3.0)
    since = np.maximum(t - 3.0, 0.0)
    roll = np.radians(150.0) * np.sin(0.33 * since)
    return Motion(roll * up, np.radians(60.0) * np.sin(0.45 * since) * up, a + 0.4 * since * up)


def parked(t: np.ndarray, r: np.random.Generator) -> Motion:
    """Wind rocks it by 3 degrees; after 20 s somebody turns it flat on its wheels, once around and back."""
    a, way = r.uniform(0.0, 2.0 * np.pi), eased(t - 20.0, 8.0) - eased(t - 30.0, 8.0)
    return Motion(np.radians(3.0) * np.sin(1.7 * t), np.radians(2.0) * np.sin(0.9 * t + a), a + 2.0 * np.pi * way)


def frames(
    motion: Callable[[np.ndarray, np.random.Generator], Motion],
    kind: int,
    seconds: float,
    seed: int = 0,
    *,
    armed: bool = False,
    gps: bool = True,
    iron_mg: np.ndarray = HARD_IRON_MG,
    hz: int = 25,
    tilt_deg: float = 0.3,
    height_m: float = 0.0,
    from_ms: int = 10_000,
    told: Mapping[str, float] = STORED,
    near_mg: np.ndarray | None = None,
) -> list[Frame]:
    """Attitude and compass of this motion, hz times a second.

    near_mg (3,) or (N, 3) is what steel nearby adds, north-east-down.
    """
    r = np.random.default_rng(seed)
    n = int(seconds * hz)
    m = motion(np.arange(n) / hz, r)
    field = field_in_body(m)
    for axis in range(3 if near_mg is not None else 0):
        unit = np.eye(3)[axis]
        field += np.broadcast_to(near_mg, (n, 3))[:, axis, None] * field_in_body(m, unit)
    stored = np.array([told[f"COMPASS_OFS_{axis}"] for axis in "XYZ"])
    sent = np.trunc(field + iron_mg + r.normal(0.0, 3.0, (n, 3)) + stored)
    told_roll = m.roll_rad + wander(r, n, 1 / hz, np.radians(tilt_deg), 12.0)
    told_pitch = m.pitch_rad + wander(r, n, 1 / hz, np.radians(tilt_deg), 12.0)
    rates = body_rates(m, 1 / hz)
    tell, out = Teller(), []
    for i in range(n):
        ms = from_ms + i * 1000 // hz
        if i % hz == 0:
            out.append((ms, tell.heartbeat(armed, kind) + (tell.height(ms, height_m) if gps else b"")))
        if i == 0:
            out.append((ms, tell.params(told)))
        attitude = tell.attitude(ms, told_roll[i], told_pitch[i], m.yaw_rad[i], rates[i])
        out.append((ms, attitude + tell.imu(ms, sent[i])))
    return out


def true_yaw(motion: Callable[..., Motion], seconds: float, seed: int, hz: int) -> np.ndarray:
    """Of the same frames, (N,) rad."""
    return motion(np.arange(int(seconds * hz)) / hz, np.random.default_rng(seed)).yaw_rad
