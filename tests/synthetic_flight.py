"""A flight made with plain rotation matrices, so that tests have a truth no formula of ours had a hand in."""

from typing import NamedTuple

import numpy as np

EARTH_MG = np.array([205.0, 14.0, 430.0])  # north, east, down; true north
DECLINATION_RAD = float(np.arctan2(EARTH_MG[1], EARTH_MG[0]))
HARD_IRON_MG = np.array([310.0, -140.0, 220.0])
SOFT_IRON = np.array([[1.05, 0.02, -0.01], [0.02, 0.96, 0.03], [-0.01, 0.03, 1.01]])  # what corrects it


class SyntheticFlight(NamedTuple):
    """boot_s (N,); angles (N,) rad; sensor and true body field (N, 3) mG."""

    boot_s: np.ndarray
    roll_rad: np.ndarray
    pitch_rad: np.ndarray
    yaw_rad: np.ndarray
    sensor_b_mg: np.ndarray
    true_b_mg: np.ndarray


def turn(axis: int, angle: float) -> np.ndarray:
    """Coordinates of a fixed vector in axes turned by ``angle`` about ``axis``."""
    c, s = np.cos(angle), np.sin(angle)
    out = np.eye(3)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    out[i, i] = out[j, j] = c
    out[i, j], out[j, i] = s, -s
    return out


def fly(
    seconds: float = 120.0, rate_hz: float = 25.0, noise_mg: float = 0.0, soft: bool = False, seed: int = 0
) -> SyntheticFlight:
    """Figure eights: yaw sweeps several whole turns both ways, banked up to 35 degrees, pitch up to 8."""
    t = np.arange(int(seconds * rate_hz)) / rate_hz
    yaw = 9.0 * np.sin(2 * np.pi * t / 60.0) + 0.4
    roll = np.radians(35.0) * np.cos(2 * np.pi * t / 60.0) + np.radians(3.0) * np.sin(1.3 * t)
    pitch = np.radians(5.0) * np.sin(0.7 * t) + np.radians(3.0)
    true = np.array([turn(0, r) @ turn(1, p) @ turn(2, y) @ EARTH_MG for r, p, y in zip(roll, pitch, yaw, strict=True)])
    matrix = SOFT_IRON if soft else np.eye(3)
    noise = np.random.default_rng(seed).normal(0.0, noise_mg, true.shape) if noise_mg else 0.0
    sensor = true @ np.linalg.inv(matrix).T + HARD_IRON_MG + noise
    return SyntheticFlight(10.0 + t, roll, pitch, yaw, sensor, true)
