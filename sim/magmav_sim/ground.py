"""Motion where JSBSim is not asked: standing, the launch of a plane, and coming to rest after touch-down.

Rates and specific force are those of the motion itself, so that a gyro integrated through a launch or a
landing still gives the attitude.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from magmav_sim.airframe import FRAME_S, GRAVITY_MSS, State

PARKED_ROLL_RAD = math.radians(0.8)
PARKED_PITCH_RAD = math.radians(-0.6)
_SETTLE_TAU_S = 0.25
_LAUNCH_ACCELERATION_MSS = 3.0
_ROLL_OUT_MSS = 3.0


def parked(north_m: float, east_m: float, heading_rad: float) -> State:
    """Standing still on ground that is not quite level."""
    return _posed(PARKED_ROLL_RAD, PARKED_PITCH_RAD, heading_rad, (0, 0), (north_m, east_m, 0), (0, 0, 0), (0, 0, 0))


def settle(touch: State) -> Iterator[State]:
    """From touch-down to rest: speed rolls out, attitude goes to the parked one."""
    north, east = touch.north_m, touch.east_m
    speed = math.hypot(touch.vn_mps, touch.ve_mps)
    course = math.atan2(touch.ve_mps, touch.vn_mps)
    cos, sin = math.cos(course), math.sin(course)
    roll, pitch = touch.roll_rad, touch.pitch_rad
    left, height = 4 * _SETTLE_TAU_S + speed / _ROLL_OUT_MSS, max(touch.height_m, 0.0)
    while left > 0:
        left -= FRAME_S
        slower = max(0.0, speed - _ROLL_OUT_MSS * FRAME_S)
        decel = (slower - speed) / FRAME_S
        speed = slower
        north, east = north + cos * speed * FRAME_S, east + sin * speed * FRAME_S
        height *= math.exp(-FRAME_S / _SETTLE_TAU_S)
        roll_rate = (PARKED_ROLL_RAD - roll) / _SETTLE_TAU_S
        pitch_rate = (PARKED_PITCH_RAD - pitch) / _SETTLE_TAU_S
        roll, pitch = roll + roll_rate * FRAME_S, pitch + pitch_rate * FRAME_S
        yield _posed(
            roll, pitch, touch.heading_rad, (roll_rate, pitch_rate), (north, east, height),
            (cos * speed, sin * speed, 0), (cos * decel, sin * decel, 0),
        )  # fmt: skip


def launch(start: State, height_m: float, speed_mps: float, end_pitch_rad: float) -> Iterator[State]:
    """A plane drawn along its heading and up to a height, ending level at flying speed."""
    cos, sin = math.cos(start.heading_rad), math.sin(start.heading_rad)
    rolling = 0.6 * speed_mps / _LAUNCH_ACCELERATION_MSS
    rising = max(6.0, height_m / (0.12 * speed_mps))
    total = rolling + rising
    gone, t, before = 0.0, 0.0, (start.roll_rad, start.pitch_rad)
    while t < total:
        t += FRAME_S
        along = speed_mps * _smooth(t / total)
        pull = speed_mps * _smooth_rate(t / total) / total
        u = max(0.0, (t - rolling) / rising)
        climb = height_m * _smooth_rate(u) / rising
        lift = height_m * (60 * u - 180 * u * u + 120 * u**3) / rising**2 if 0 < u < 1 else 0.0
        gone += along * FRAME_S
        share = _smooth(min(1.0, t / rolling))
        roll = PARKED_ROLL_RAD * (1 - share)
        pitch = PARKED_PITCH_RAD * (1 - share) + math.atan2(climb, max(along, 1.0)) + end_pitch_rad * share
        rates = ((roll - before[0]) / FRAME_S, (pitch - before[1]) / FRAME_S)
        before = (roll, pitch)
        yield _posed(
            roll, pitch, start.heading_rad, rates,
            (start.north_m + cos * gone, start.east_m + sin * gone, height_m * _smooth(u)),
            (cos * along, sin * along, -climb), (cos * pull, sin * pull, -lift),
        )  # fmt: skip


def _smooth(u: float) -> float:
    """0 to 1 with no speed and no acceleration at either end."""
    u = max(0.0, min(1.0, u))
    return u**3 * (10 - 15 * u + 6 * u * u)


def _smooth_rate(u: float) -> float:
    return 30 * u * u * (1 - u) ** 2 if 0 < u < 1 else 0.0


def _posed(
    roll: float,
    pitch: float,
    heading: float,
    euler_rates: tuple[float, float],
    position: tuple[float, float, float],
    velocity_ned: tuple[float, float, float],
    acceleration_ned: tuple[float, float, float],
) -> State:
    """A state from a pose and how it changes; heading does not."""
    sr, cr, sp, cp = math.sin(roll), math.cos(roll), math.sin(pitch), math.cos(pitch)
    sh, ch = math.sin(heading), math.cos(heading)
    an, ae, ad = acceleration_ned[0], acceleration_ned[1], acceleration_ned[2] - GRAVITY_MSS
    roll_rate, pitch_rate = euler_rates
    return State(
        roll, pitch, heading, roll_rate, cr * pitch_rate, -sr * pitch_rate,
        cp * ch * an + cp * sh * ae - sp * ad,
        (sr * sp * ch - cr * sh) * an + (sr * sp * sh + cr * ch) * ae + sr * cp * ad,
        (cr * sp * ch + sr * sh) * an + (cr * sp * sh - sr * ch) * ae + cr * cp * ad,
        *position, *velocity_ned, math.hypot(velocity_ned[0], velocity_ned[1]), 0.0, 0.0,
    )  # fmt: skip
