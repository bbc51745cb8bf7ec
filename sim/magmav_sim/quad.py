"""Guidance of the quadrotor: demands to stick positions, from the true state."""

from __future__ import annotations

import math
from collections.abc import Generator

import numpy as np

from magmav_sim.airframe import FRAME_S, GRAVITY_MSS, Controls, State
from magmav_sim.patterns import AnyPattern
from magmav_sim.quad_paths import MOST_TURN_RADS, Demand, fly_quad, limit, wrap

_HOVER_THROTTLE = 0.415
_RATE_AT_FULL_STICK_RADS = 0.75
_MOST_TILT_RAD = math.radians(25)


_NOISE_TAU_S = 1.0
_BLOCK = 4096


class QuadPilot:
    """Follows demands: position and velocity to tilt, attitude to stick.

    velocity_noise_mps : sigma of the slow error of the velocity it believes, per horizontal axis.
    """

    def __init__(self, velocity_noise_mps: float, rng: np.random.Generator) -> None:
        self._heave = 0.0
        self._rng = rng
        self._noise: list[list[float]] = []
        self._keep = math.exp(-FRAME_S / _NOISE_TAU_S)
        self._push = velocity_noise_mps * math.sqrt(1 - self._keep**2)
        self._error = (0.0, 0.0)

    def _wander(self) -> tuple[float, float]:
        """Error of the velocity that the loop believes, m/s north and east: why a real hover tilts."""
        if not self._noise:
            self._noise = (self._rng.standard_normal((_BLOCK, 2)) * self._push).tolist()
        a, b = self._noise.pop()
        self._error = (self._keep * self._error[0] + a, self._keep * self._error[1] + b)
        return self._error

    def fly(self, pattern: AnyPattern, state: State, height_m: float) -> Generator[Controls, State, None]:
        """Stick positions of one pattern, frame by frame; ``height_m`` is the height to hold."""
        demands = fly_quad(pattern, state, height_m)
        demand = next(demands, None)
        while demand is not None:
            state = yield self.steer(state, demand)
            try:
                demand = demands.send(state)
            except StopIteration:
                return

    def steer(self, state: State, demand: Demand) -> Controls:
        """Stick positions for one frame."""
        want_n = demand.vn_mps + 0.6 * (demand.north_m - state.north_m)
        want_e = demand.ve_mps + 0.6 * (demand.east_m - state.east_m)
        off_n, off_e = self._wander()
        a_n, a_e = 1.2 * (want_n - state.vn_mps - off_n), 1.2 * (want_e - state.ve_mps - off_e)
        cos, sin = math.cos(state.heading_rad), math.sin(state.heading_rad)
        forward, right = cos * a_n + sin * a_e, cos * a_e - sin * a_n
        pitch = limit(-math.atan2(forward, GRAVITY_MSS), _MOST_TILT_RAD)
        roll = limit(math.atan2(right, GRAVITY_MSS), _MOST_TILT_RAD)

        climb = demand.climb_mps + limit(0.8 * (demand.height_m - state.height_m), 2.0)
        miss = climb + state.vd_mps
        self._heave = limit(self._heave + 0.05 * miss * FRAME_S, 0.1)
        lift = max(0.7, math.cos(state.roll_rad) * math.cos(state.pitch_rad))
        throttle = (_HOVER_THROTTLE + 0.10 * miss + self._heave) / math.sqrt(lift)

        # Euler rates wanted, turned into body rates, so that a turn at a bank neither climbs nor dips
        # the nose.
        roll_rate = 4.0 * (roll - state.roll_rad)
        pitch_rate = 4.0 * (pitch - state.pitch_rad)
        yaw_rate = limit(2.0 * wrap(demand.heading_rad - state.heading_rad), MOST_TURN_RADS)
        cp, sp = math.cos(state.roll_rad), math.sin(state.roll_rad)
        ct, st = math.cos(state.pitch_rad), math.sin(state.pitch_rad)
        p = roll_rate - yaw_rate * st
        q = pitch_rate * cp + yaw_rate * ct * sp
        r = yaw_rate * ct * cp - pitch_rate * sp
        return Controls(_stick(p), _stick(q), _stick(r), min(0.9, max(0.1, throttle)))


def _stick(rate_rads: float) -> float:
    return limit(rate_rads / _RATE_AT_FULL_STICK_RADS, 1.0)
