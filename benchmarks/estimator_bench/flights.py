"""What is true of a flight, at 200 Hz: attitude as rotation matrices, rates, accelerations, height, throttle.

Frames: n north-east-down, b forward-right-down. C_bn (N, 3, 3) takes n to b. Nothing here has Euler angles any more.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from estimator_bench.motions import BOAT, GRAVITY_MSS, ROVER, Array, Motion, Path

TRUTH_HZ = 200
STEP_S = 1.0 / TRUTH_HZ
FLIGHT_S = 180.0
CRUISE_M = 30.0  # height of the flight proper
_DRAG_S = 10.0  # a multirotor's lean no longer accelerates it after about this long
_GROUND_TYPES = (ROVER, BOAT)

Start = Literal["aloft", "ground", "pad"]


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """A flight as it truly was; arrays over N instants STEP_S apart, from 0 s.

    kind : MAV_TYPE.  C_bn (N, 3, 3).  rate_b_rads, accel_n_mss, force_b_mss (specific force), velocity_n_mps (N, 3).
    height_m, throttle (share, 0 to 1) (N,).  takeoff_s : when it left the ground; 0 where it was aloft all along.
    """

    kind: int
    t_s: Array
    C_bn: Array
    rate_b_rads: Array
    accel_n_mss: Array
    force_b_mss: Array
    velocity_n_mps: Array
    height_m: Array
    throttle: Array
    takeoff_s: float

    @property
    def flies(self) -> bool:
        """Does it ever leave the ground?"""
        return self.kind not in _GROUND_TYPES


def rotations(roll_rad: Array, pitch_rad: Array, yaw_rad: Array) -> Array:
    """C_bn (N, 3, 3) of ZYX angles of any size."""
    one, nil = np.ones_like(roll_rad), np.zeros_like(roll_rad)

    def stacked(rows: list[list[Array]]) -> Array:
        return np.moveaxis(np.array(rows), 2, 0)

    c, s = np.cos(roll_rad), np.sin(roll_rad)
    rx = stacked([[one, nil, nil], [nil, c, s], [nil, -s, c]])
    c, s = np.cos(pitch_rad), np.sin(pitch_rad)
    ry = stacked([[c, nil, -s], [nil, one, nil], [s, nil, c]])
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    rz = stacked([[c, s, nil], [-s, c, nil], [nil, nil, one]])
    return np.asarray(rx @ ry @ rz)


def body_rates(C_bn: Array, step_s: float) -> Array:
    """(N, 3) rad/s, from C_bn(t + dt) = exp(-[w dt]x) C_bn(t): the rotation vector of each step, then the mean of both
    sides."""
    turn = C_bn[1:] @ np.swapaxes(C_bn[:-1], 1, 2)
    skew = 0.5 * np.stack(
        (turn[:, 1, 2] - turn[:, 2, 1], turn[:, 2, 0] - turn[:, 0, 2], turn[:, 0, 1] - turn[:, 1, 0]), 1
    )
    sine = np.linalg.norm(skew, axis=1)
    scale = np.ones_like(sine)
    some = sine > 1e-9
    scale[some] = np.arcsin(np.minimum(sine[some], 1.0)) / sine[some]
    steps = skew * scale[:, None] / step_s
    out = np.empty((len(C_bn), 3))
    out[0], out[-1] = steps[0], steps[-1]
    out[1:-1] = 0.5 * (steps[1:] + steps[:-1])
    return out


def followed(values: Array, tau_s: float, step_s: float = STEP_S) -> Array:
    """First-order low-pass of (N, k) along time, begun at the mean of its first 10 s."""
    keep = float(np.exp(-step_s / tau_s))
    begun = values[: int(10.0 / step_s)].mean(axis=0)
    return recursive(keep, (1.0 - keep) * values, begun)


def recursive(keep: float, pushes: Array, begun: Array) -> Array:
    """x_i = keep x_(i-1) + pushes_i for each column of (N, k), from begun (k,)."""
    out = np.empty_like(pushes)
    for k in range(pushes.shape[1]):
        now, column = float(begun[k]), []
        for push in pushes[:, k].tolist():
            now = keep * now + push
            column.append(now)
        out[:, k] = column
    return out


def _own_time(t_s: Array, start: Start) -> tuple[Array, Array, Array, float]:
    """Motion time, share of the motion's tilt (N,), height (N,), take-off."""
    if start == "aloft":
        return t_s, np.ones_like(t_s), np.full_like(t_s, CRUISE_M), 0.0
    if start == "ground":
        up = 25.0
        height = np.clip(1.5 * (t_s - up), 0.0, CRUISE_M)
        moving = np.clip((t_s - up) / 6.0, 0.0, 1.0)
    else:
        # 15 s on the pad, low hover over it, the flight, and down on it again.
        up = 15.0
        low = 2.5 * np.clip((t_s - up) / 2.0, 0.0, 1.0)
        high = (CRUISE_M - 2.5) * (
            np.clip((t_s - up - 15.0) / 15.0, 0.0, 1.0) - np.clip((t_s - 140.0) / 20.0, 0.0, 1.0)
        )
        height = low + (CRUISE_M - 2.5) * high - 2.5 * np.clip((t_s - 160.0) / 3.0, 0.0, 1.0)
        moving = np.clip((t_s - up) / 4.0, 0.0, 1.0) - np.clip((t_s - 155.0) / 5.0, 0.0, 1.0)
    moving = moving**2 * (3.0 - 2.0 * moving)
    return np.cumsum(moving) * STEP_S, moving, height, up


def _thrown(C_bn: Array) -> Array:
    """A multirotor's horizontal acceleration (N, 3): thrust along -z holds it up and pushes it where it leans, until
    drag has caught up."""
    lift = np.maximum(C_bn[:, 2, 2], 0.3)
    push = -C_bn[:, 2, :] * (GRAVITY_MSS / lift)[:, None]
    push[:, 2] = 0.0
    return np.asarray(push - followed(push, _DRAG_S))


def true_flight(motion: Motion, kind: int, seed: int, start: Start = "aloft", seconds: float = FLIGHT_S) -> Truth:
    """Fly a motion. The same seed flies the same way."""
    r = np.random.default_rng([seed, 101])
    t_s: Array = np.arange(0.0, int(seconds * TRUTH_HZ) + 1) * STEP_S
    tau, moving, height, takeoff_s = _own_time(t_s, start)
    path = motion(tau, r)
    C_bn = rotations(path.roll_rad * moving, path.pitch_rad * moving, path.yaw_rad)
    if kind == 2:
        accel = _thrown(C_bn) * moving[:, None]
        velocity = np.cumsum(accel, axis=0) * STEP_S
    else:
        nose = C_bn[:, 0, :].copy()
        if kind in _GROUND_TYPES:
            nose[:, 2] = 0.0
        velocity = nose * (path.speed_mps * moving)[:, None]
        accel = np.gradient(velocity, STEP_S, axis=0)
    return truth_of(kind, t_s, C_bn, accel, velocity, height, _throttle(kind, path, accel, moving, r), takeoff_s)


def truth_of(
    kind: int,
    t_s: Array,
    C_bn: Array,
    accel_n_mss: Array,
    velocity_n_mps: Array,
    height_m: Array,
    throttle: Array,
    takeoff_s: float,
) -> Truth:
    """The rest follows from attitude and acceleration."""
    force_n = accel_n_mss - np.array((0.0, 0.0, GRAVITY_MSS))
    force_b = np.einsum("nij,nj->ni", C_bn, force_n)
    rates = body_rates(C_bn, STEP_S)
    return Truth(kind, t_s, C_bn, rates, accel_n_mss, force_b, velocity_n_mps, height_m, throttle, takeoff_s)


def _throttle(kind: int, path: Path, accel_n: Array, moving: Array, r: np.random.Generator) -> Array:
    """Hover throttle times the load it carries, a slow wander, and what the motion swings it by."""
    load = np.linalg.norm(accel_n - np.array((0.0, 0.0, GRAVITY_MSS)), axis=1) / GRAVITY_MSS
    slow = 0.06 * np.sin(2.0 * np.pi * np.arange(len(load)) * STEP_S / r.uniform(20.0, 40.0) + r.uniform(0.0, 6.0))
    mean = 0.45 * load if kind == 2 else np.full_like(load, 0.55)
    return np.asarray(np.clip(moving * (mean + slow + path.bob), 0.0, 1.0))
