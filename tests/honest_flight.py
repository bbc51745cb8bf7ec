"""Seeded flights for judging claimed sigmas: truth first, then what sensors and autopilot would report of it.

Nothing here uses a formula of magmav: attitudes are products of plain rotations, the reported tilt wanders as a
Gauss-Markov process, the gyro's heading walks, and the compass is noisy and cut to whole milligauss.
"""

from typing import NamedTuple

import numpy as np
from synthetic_flight import EARTH_MG, HARD_IRON_MG

from magmav.core.field import ExpectedField
from magmav.core.types import NO_SHAPING, Sample, vec3

RATE_HZ = 10.0
EXPECTED = ExpectedField(float(np.hypot(*EARTH_MG[:2])), float(EARTH_MG[2]), 0.0)


class Motion(NamedTuple):
    """True roll, pitch and unwrapped yaw over time, rad, each (N,)."""

    roll_rad: np.ndarray
    pitch_rad: np.ndarray
    yaw_rad: np.ndarray


def figure_eight(t: np.ndarray, r: np.random.Generator) -> Motion:
    """Whole turns both ways, banked up to 30 degrees."""
    a, b, c = r.uniform(0.0, 6.0, 3)
    roll = np.radians(30.0) * np.cos(t / 6.0 + a)
    return Motion(roll, np.radians(4.0) * np.sin(0.7 * t + b) + 0.05, 8.0 * np.sin(t / 6.0 + a) + c)


def survey(t: np.ndarray, r: np.random.Generator) -> Motion:
    """Legs of 12 s and half turns of 4 s in alternate directions, 20 degrees of bank in the turns, some wobble."""
    a, b, c = r.uniform(0.0, 6.0, 3)
    leg, phase = np.divmod(t + 2.0 * a, 16.0)
    part = np.clip((phase - 12.0) / 4.0, 0.0, 1.0)
    side = np.where(leg % 2 == 0, 1.0, -1.0)
    yaw = c + np.where(leg % 2 == 0, 0.0, np.pi) + side * np.pi * (part - np.sin(2 * np.pi * part) / (2 * np.pi))
    roll = side * np.radians(20.0) * np.sin(np.pi * part) + np.radians(2.0) * np.sin(1.1 * t + b)
    return Motion(roll, np.radians(3.0) * np.sin(0.8 * t + c), yaw)


def hover_turns(t: np.ndarray, r: np.random.Generator) -> Motion:
    """A multirotor on one spot turning all the way round, leaning 4 to 8 degrees as it holds against wind."""
    a, b, c = r.uniform(0.0, 6.0, 3)
    lean = np.radians(6.0 + 2.0 * np.sin(0.5 * t + b))
    yaw = c + 3.0 * np.pi * np.sin(t / 10.0 + a)
    roll = lean * np.sin(yaw) + np.radians(1.5) * np.sin(1.7 * t)
    return Motion(roll, -lean * np.cos(yaw) + np.radians(1.5) * np.sin(1.3 * t + a), yaw)


MOTIONS = {"figure eight": figure_eight, "survey": survey, "hover turns": hover_turns}


def field_in_body(m: Motion, earth_mg: np.ndarray = EARTH_MG) -> np.ndarray:
    """The Earth's field in body axes, (N, 3), one plain rotation after the other."""
    north, east, down = earth_mg
    ahead = north * np.cos(m.yaw_rad) + east * np.sin(m.yaw_rad)
    right = -north * np.sin(m.yaw_rad) + east * np.cos(m.yaw_rad)
    x = ahead * np.cos(m.pitch_rad) - down * np.sin(m.pitch_rad)
    z = ahead * np.sin(m.pitch_rad) + down * np.cos(m.pitch_rad)
    return np.stack(
        (x, right * np.cos(m.roll_rad) + z * np.sin(m.roll_rad), z * np.cos(m.roll_rad) - right * np.sin(m.roll_rad)), 1
    )


def body_rates(m: Motion, dt_s: float) -> np.ndarray:
    """Body rates, rad/s, (N, 3), from finite differences of the angles."""
    p, q, r = (np.gradient(a, dt_s) for a in m)
    cr, sr, cp, sp = np.cos(m.roll_rad), np.sin(m.roll_rad), np.cos(m.pitch_rad), np.sin(m.pitch_rad)
    return np.stack((p - r * sp, q * cr + r * cp * sr, r * cp * cr - q * sr), 1)


def wander(r: np.random.Generator, n: int, dt_s: float, sigma: float, tau_s: float) -> np.ndarray:
    """A stationary Gauss-Markov process, (n,)."""
    fade = np.exp(-dt_s / tau_s)
    kicks = r.normal(0.0, sigma * np.sqrt(1.0 - fade * fade), n)
    out = np.empty(n)
    out[0] = r.normal(0.0, sigma)
    for i in range(1, n):
        out[i] = fade * out[i - 1] + kicks[i]
    return out


def samples(
    motion: str,
    seed: int,
    seconds: float = 60.0,
    iron_mg: np.ndarray = HARD_IRON_MG,
    noise_mg: float = 4.0,
    tilt_deg: float = 0.5,
    walk_deg: float = 0.05,
    whole: bool = True,
    earth_mg: np.ndarray = EARTH_MG,
) -> list[Sample]:
    """Samples as the assembler would hand them over. iron_mg is (3,) or (N, 3); walk_deg is per root second."""
    r = np.random.default_rng(seed)
    n, dt = int(seconds * RATE_HZ), 1.0 / RATE_HZ
    t = np.arange(n) * dt
    m = MOTIONS[motion](t, r)
    mag = field_in_body(m, earth_mg) + iron_mg + r.normal(0.0, noise_mg, (n, 3))
    mag = np.trunc(mag) if whole else mag
    roll = m.roll_rad + wander(r, n, dt, np.radians(tilt_deg), 12.0)
    pitch = m.pitch_rad + wander(r, n, dt, np.radians(tilt_deg), 12.0)
    steps = np.diff(m.yaw_rad, prepend=m.yaw_rad[0]) + r.normal(0.0, np.radians(walk_deg) * np.sqrt(dt), n)
    rates = body_rates(m, dt)
    return [
        Sample(
            system=1,
            compass=1,
            boot_ns=int(1e9 * (10.0 + t[i])),
            dt_s=dt if i else 0.0,
            mag_b_mg=vec3(mag[i], "field"),
            shaping=NO_SHAPING,
            rate_b_rads=vec3(rates[i], "rate"),
            roll_rad=float(roll[i]),
            pitch_rad=float(pitch[i]),
            yaw_step_rad=float(steps[i]) if i else 0.0,
            lead_rad=0.0,
            age_s=0.0,
            gap=i == 0,
            tilt_from="ATTITUDE",
            learn=True,
        )
        for i in range(n)
    ]
