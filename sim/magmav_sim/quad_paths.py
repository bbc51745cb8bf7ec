"""What the quadrotor flies: each pattern as demands frame by frame."""

from __future__ import annotations

import math
from collections.abc import Generator
from itertools import pairwise
from typing import NamedTuple

from magmav_sim.airframe import FRAME_S, State
from magmav_sim.patterns import AnyPattern, Bob, FigureEight, Hover, Land, Survey, Takeoff, Yaw

MOST_TURN_RADS = math.radians(40)
_LEAD_IN_S = 2.0


class Demand(NamedTuple):
    """Where to be, how fast to be moving there, and where to point. m from home, m/s, rad true."""

    north_m: float
    east_m: float
    height_m: float
    vn_mps: float
    ve_mps: float
    climb_mps: float
    heading_rad: float


Flying = Generator[Demand, State, None]


def wrap(angle_rad: float) -> float:
    """The same direction within half a turn of zero."""
    return math.remainder(angle_rad, math.tau)


def limit(value: float, most: float) -> float:
    """Within plus or minus ``most``."""
    return max(-most, min(most, value))


def fly_quad(pattern: AnyPattern, state: State, height_m: float) -> Flying:
    """Demands of one pattern from where the vehicle is; ``height_m`` is the height to hold."""
    if isinstance(pattern, Takeoff):
        yield from _takeoff(pattern, state)
    elif isinstance(pattern, Hover):
        yield from _hold(state, height_m, pattern.seconds)
    elif isinstance(pattern, Yaw):
        yield from _yaw(pattern, state, height_m)
    elif isinstance(pattern, FigureEight):
        yield from _figure_eight(pattern, state, height_m)
    elif isinstance(pattern, Survey):
        yield from _survey(pattern, state, height_m)
    elif isinstance(pattern, Bob):
        yield from _bob(pattern, state, height_m)
    elif isinstance(pattern, Land):
        yield from _land(pattern, state)
    else:
        raise ValueError(f"pattern: a quadrotor cannot fly {type(pattern).__name__}")


def _hold(state: State, height_m: float, seconds: float) -> Flying:
    still = Demand(state.north_m, state.east_m, height_m, 0, 0, 0, state.heading_rad)
    for _ in range(round(seconds / FRAME_S)):
        yield still


def _takeoff(pattern: Takeoff, state: State) -> Flying:
    north, east, heading, height = state.north_m, state.east_m, state.heading_rad, state.height_m
    while height < pattern.height_m:
        climb = min(pattern.climb_mps, math.sqrt(2 * 0.8 * (pattern.height_m - height)) + 0.05)
        height = min(pattern.height_m, height + climb * FRAME_S)
        state = yield Demand(north, east, height, 0, 0, climb, heading)
    for _ in range(round(_LEAD_IN_S / FRAME_S)):
        yield Demand(north, east, pattern.height_m, 0, 0, 0, heading)


def _land(pattern: Land, state: State) -> Flying:
    north, east, heading, height = state.north_m, state.east_m, state.heading_rad, state.height_m
    while True:  # the ground ends it
        sink = min(pattern.sink_mps, max(0.4, 0.25 * state.height_m))
        height -= sink * FRAME_S
        state = yield Demand(north, east, height, 0, 0, -sink, heading)


def _bob(pattern: Bob, state: State, height_m: float) -> Flying:
    north, east, heading = state.north_m, state.east_m, state.heading_rad
    turn = math.tau / pattern.period_s
    for i in range(round(pattern.cycles * pattern.period_s / FRAME_S)):
        phase = turn * i * FRAME_S
        height = height_m + 0.5 * pattern.height_m * (1 - math.cos(phase))
        climb = 0.5 * pattern.height_m * turn * math.sin(phase)
        yield Demand(north, east, height, 0, 0, climb, heading)


def _yaw(pattern: Yaw, state: State, height_m: float) -> Flying:
    north, east, start = state.north_m, state.east_m, state.heading_rad
    rate = math.copysign(math.radians(pattern.rate_dps), pattern.turns)
    frames = round(abs(pattern.turns) * math.tau / abs(rate) / FRAME_S)
    for i in range(frames):
        yield Demand(north, east, height_m, 0, 0, 0, start + rate * (i + 1) * FRAME_S)
    for _ in range(round(_LEAD_IN_S / FRAME_S)):
        yield Demand(north, east, height_m, 0, 0, 0, start + rate * frames * FRAME_S)


def _figure_eight(pattern: FigureEight, state: State, height_m: float) -> Flying:
    half = pattern.half_length_m
    cos, sin = math.cos(state.heading_rad), math.sin(state.heading_rad)
    n0, e0, s, speed = state.north_m, state.east_m, 0.0, 0.0

    def at(s: float) -> tuple[float, float, float, float]:
        along, across = half * math.sin(s), 0.5 * half * math.sin(2 * s)
        d_along, d_across = half * math.cos(s), half * math.cos(2 * s)
        return (
            n0 + cos * along - sin * across,
            e0 + sin * along + cos * across,
            cos * d_along - sin * d_across,
            sin * d_along + cos * d_across,
        )

    yield from _point(state, height_m, math.atan2(at(0.0)[3], at(0.0)[2]))
    while s < pattern.laps * math.tau:
        north, east, dn, de = at(s)
        slope = math.hypot(dn, de)
        brake = math.sqrt(2 * (pattern.laps * math.tau - s) * slope + 0.01)
        speed = min(pattern.speed_mps, speed + 1.0 * FRAME_S, brake)
        s += speed * FRAME_S / slope
        yield Demand(north, east, height_m, speed * dn / slope, speed * de / slope, 0, math.atan2(de, dn))
    yield from _brake(n0, e0, height_m, math.atan2(at(0.0)[3], at(0.0)[2]))


def _survey(pattern: Survey, state: State, height_m: float) -> Flying:
    course = math.radians(pattern.heading_deg)
    cos, sin = math.cos(course), math.sin(course)
    n0, e0 = state.north_m, state.east_m

    def corner(along: float, across: float) -> tuple[float, float]:
        return n0 + cos * along - sin * across, e0 + sin * along + cos * across

    corners, at_far_end = [], False
    for lane in range(pattern.lanes):
        across = lane * pattern.spacing_m
        corners.append(corner(pattern.length_m if at_far_end else 0.0, across))
        at_far_end = not at_far_end
        corners.append(corner(pattern.length_m if at_far_end else 0.0, across))
    for (n1, e1), (n2, e2) in pairwise(corners):
        heading = math.atan2(e2 - e1, n2 - n1)
        state = yield from _point(state._replace(north_m=n1, east_m=e1), height_m, heading)
        yield from _leg((n1, e1), (n2, e2), height_m, pattern.speed_mps, heading)
    yield from _brake(*corners[-1], height_m, heading)


def _leg(
    start: tuple[float, float], end: tuple[float, float], height_m: float, speed_mps: float, heading: float
) -> Flying:
    length = math.hypot(end[0] - start[0], end[1] - start[1])
    un, ue = (end[0] - start[0]) / length, (end[1] - start[1]) / length
    gone, speed = 0.0, 0.0
    while gone < length - 0.01:
        brake = math.sqrt(2 * 1.2 * (length - gone) + 0.01)
        speed = min(speed_mps, speed + 1.2 * FRAME_S, brake)
        gone += speed * FRAME_S
        yield Demand(start[0] + un * gone, start[1] + ue * gone, height_m, speed * un, speed * ue, 0, heading)


def _point(state: State, height_m: float, heading_rad: float) -> Generator[Demand, State, State]:
    """Turn on the spot at no more than the turn rate; returns the state then."""
    north, east, at = state.north_m, state.east_m, state.heading_rad
    while abs(wrap(heading_rad - at)) > 1e-6:
        at += limit(wrap(heading_rad - at), 0.8 * MOST_TURN_RADS * FRAME_S)
        state = yield Demand(north, east, height_m, 0, 0, 0, at)
    for _ in range(round(0.5 * _LEAD_IN_S / FRAME_S)):
        state = yield Demand(north, east, height_m, 0, 0, 0, heading_rad)
    return state


def _brake(north_m: float, east_m: float, height_m: float, heading_rad: float) -> Flying:
    for _ in range(round(2 * _LEAD_IN_S / FRAME_S)):
        yield Demand(north_m, east_m, height_m, 0, 0, 0, heading_rad)
