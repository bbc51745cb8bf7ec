"""Guidance of the two fixed-wing airframes: bank, climb and speed wanted, to stick positions."""

from __future__ import annotations

import math
from collections.abc import Generator
from typing import NamedTuple

from magmav_sim.airframe import FRAME_S, GRAVITY_MSS, Controls, State
from magmav_sim.patterns import AnyPattern, Climb, Land, Loiter, Straight, STurns, Takeoff


class Demand(NamedTuple):
    """Bank, rad; climb, m/s, or the height to hold when ``height_m`` is given."""

    bank_rad: float
    climb_mps: float
    height_m: float | None
    power: bool = True


Flying = Generator[Demand, State, None]


_BANK_RATE_RADS = math.radians(25)


class Tuning(NamedTuple):
    """What differs between the planes. Gains are stick per rad and per rad/s."""

    speed_mps: float
    slowest_mps: float
    roll: float
    roll_damp: float
    pitch: float
    pitch_damp: float
    pitch_sum: float
    yaw_damp: float
    cruise_throttle: float
    pitch_level_rad: float
    engine: bool


TUNINGS = {
    "c172x": Tuning(50.0, 32.0, 0.8, 0.25, 2.0, 0.8, 0.8, 0.3, 0.65, 0.03, True),
    "minisgs": Tuning(14.0, 10.0, 0.5, 0.10, 0.8, 0.25, 0.3, 0.6, 0.0, -0.2, False),
}


class PlanePilot:
    """Follows demands: bank by aileron, climb (a glider: speed) by pitch, speed by throttle."""

    def __init__(self, model: str) -> None:
        self._tune = TUNINGS[model]
        self._pitch_sum = 0.0
        self._roll_sum = 0.0
        self._bank = 0.0
        self._path_sum = 0.0
        self._power = self._tune.cruise_throttle

    def fly(self, pattern: AnyPattern, state: State, height_m: float) -> Generator[Controls, State, None]:
        """Stick positions of one pattern, frame by frame; ``height_m`` is the height to hold."""
        demands = fly_plane(pattern, state, height_m)
        demand = next(demands, None)
        while demand is not None:
            state = yield self.steer(state, demand)
            try:
                demand = demands.send(state)
            except StopIteration:
                return

    def steer(self, state: State, demand: Demand) -> Controls:
        """Stick positions for one frame."""
        tune = self._tune
        climb = demand.climb_mps
        if demand.height_m is not None:
            climb = _limit(0.3 * (demand.height_m - state.height_m), 3.0)
        slow = tune.speed_mps - state.airspeed_mps
        if tune.engine:
            miss = climb + state.vd_mps
            self._path_sum = _limit(self._path_sum + 0.004 * miss * FRAME_S, 0.15)
            pitch = tune.pitch_level_rad + self._path_sum + (climb + 0.5 * miss) / tune.speed_mps
            if state.airspeed_mps < tune.slowest_mps:
                pitch -= 0.02 * (tune.slowest_mps - state.airspeed_mps)
            wanted = tune.cruise_throttle + 0.06 * slow + 0.04 * climb if demand.power else 0.0
            self._power += 0.5 * FRAME_S * (_between(wanted, 0.0, 1.0) - self._power)
        else:
            self._path_sum = _limit(self._path_sum - 0.01 * slow * FRAME_S, 0.3)
            pitch = tune.pitch_level_rad + self._path_sum - 0.03 * slow if demand.power else -0.10
        pitch = _limit(pitch, 0.30)

        g_turn = GRAVITY_MSS * math.tan(_limit(state.roll_rad, 1.0)) / max(state.airspeed_mps, 5.0)
        q_turn = g_turn * math.sin(state.roll_rad)
        r_turn = g_turn * math.cos(state.roll_rad)
        pitch_miss = pitch - state.pitch_rad
        self._pitch_sum = _limit(self._pitch_sum + pitch_miss * FRAME_S, 0.5)
        up = tune.pitch * pitch_miss + tune.pitch_sum * self._pitch_sum + tune.pitch_damp * (q_turn - state.q_rads)
        self._bank += _limit(demand.bank_rad - self._bank, _BANK_RATE_RADS * FRAME_S)
        roll_miss = self._bank - state.roll_rad
        self._roll_sum = _limit(self._roll_sum + 0.3 * roll_miss * FRAME_S, 0.15)
        aileron = tune.roll * roll_miss + self._roll_sum - tune.roll_damp * state.p_rads
        rudder = -tune.yaw_damp * (r_turn - state.r_rads)
        return Controls(_limit(aileron, 0.8), -_limit(up, 0.8), _limit(rudder, 0.5), self._power)


def _limit(value: float, most: float) -> float:
    return max(-most, min(most, value))


def _between(value: float, least: float, most: float) -> float:
    return max(least, min(most, value))


# ---------------------------------------------------------------- patterns


def fly_plane(pattern: AnyPattern, state: State, height_m: float) -> Flying:
    """Demands of one pattern; ``height_m`` is the height to hold where the pattern does not change it."""
    if isinstance(pattern, Takeoff):
        yield from _straight(5.0, height_m)
    elif isinstance(pattern, Straight):
        yield from _straight(pattern.seconds, height_m)
    elif isinstance(pattern, Loiter):
        yield from _turn(math.radians(pattern.bank_deg), pattern.turns * math.tau, height_m, state)
    elif isinstance(pattern, STurns):
        for i in range(pattern.count):
            bank = math.radians(pattern.bank_deg) * (1 if i % 2 == 0 else -1)
            state = yield from _turn(bank, math.radians(pattern.sweep_deg), height_m, state)
    elif isinstance(pattern, Climb):
        yield from _climb(pattern, state)
    elif isinstance(pattern, Land):
        yield from _land(pattern, state)
    else:
        raise ValueError(f"pattern: a plane cannot fly {type(pattern).__name__}")


def _straight(seconds: float, height_m: float) -> Flying:
    for _ in range(round(seconds / FRAME_S)):
        yield Demand(0.0, 0.0, height_m)


def _turn(bank: float, sweep_rad: float, height_m: float, state: State) -> Generator[Demand, State, State]:
    turned, before = 0.0, state.heading_rad
    while turned < sweep_rad:
        state = yield Demand(bank, 0.0, height_m)
        turned += math.copysign(1, bank) * math.remainder(state.heading_rad - before, math.tau)
        before = state.heading_rad
    return state


def _climb(pattern: Climb, state: State) -> Flying:
    goal = state.height_m + pattern.by_m
    climb = math.copysign(pattern.rate_mps, pattern.by_m)
    while (goal - state.height_m) * climb > 0:
        state = yield Demand(math.radians(pattern.bank_deg), climb, None)


def _land(pattern: Land, state: State) -> Flying:
    while True:  # the ground ends it
        sink = min(pattern.sink_mps, max(0.6, 0.15 * state.height_m))
        state = yield Demand(0.0, -sink, None, power=state.height_m > 8)
