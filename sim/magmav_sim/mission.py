"""What happens to the vehicle, frame by frame: ground, arm, take-off, patterns, landing, disarm, ground
again."""

from __future__ import annotations

import math
from collections.abc import Generator

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav_sim.airframe import FRAME_S, GRAVITY_MSS, Airframe, State
from magmav_sim.autopilot import Autopilot
from magmav_sim.ground import launch, parked, settle
from magmav_sim.patterns import Climb, Land, Takeoff
from magmav_sim.plane import TUNINGS, PlanePilot
from magmav_sim.quad import QuadPilot
from magmav_sim.scenario import Flight, Scenario
from magmav_sim.wind import Wind

_READY_S = 2.0  # between arming and take-off, and between landing and disarming
_RETRY_S = 5.0
_LIFT_MPS = 0.05

Frames = Generator[State, None, None]


class Mission:
    """``step`` gives the true state of the next frame. busy: a flight is under way; finished: nothing is
    left."""

    def __init__(self, scenario: Scenario, autopilot: Autopilot, seed: int) -> None:
        self._scenario = scenario
        self._a = autopilot
        wind = scenario.wind
        self._rng = np.random.default_rng([seed, 5])
        self._wind = Wind(wind.speed_mps, math.radians(wind.from_deg), wind.turbulence_mps, FRAME_S, seed)
        self.state = parked(0.0, 0.0, math.radians(scenario.heading_deg))
        self.busy = self.finished = False
        self._waiting = self._called = False
        self._frames = self._life()

    def step(self) -> State:
        """The state one frame later."""
        return next(self._frames)

    def call(self) -> bool:
        """MISSION_START: start the flight that waits for it. False when none does or arming is refused."""
        if not self._waiting or not self._a.arm():
            return False
        self._called = True
        return True

    def _life(self) -> Frames:
        for number, flight in enumerate(self._scenario.flights, start=1):
            called = yield from self._before(flight)
            if not called:
                break
            self._a.note("flight", number=number)
            yield from self._fly(flight)
        yield from self._stand(self._scenario.end_ground_s)
        self.finished = not self._scenario.stay
        while True:
            yield self.state

    def _stand(self, seconds: float) -> Frames:
        for _ in range(round(seconds / FRAME_S)):
            yield self.state

    def _before(self, flight: Flight) -> Generator[State, None, bool]:
        """On the ground until armed for this flight; False when that took too long."""
        if flight.start == "auto":
            yield from self._stand(flight.ground_s)
            left_s = flight.wait_s
            while not self._a.arm():
                if left_s <= 0:
                    return False
                left_s -= _RETRY_S
                yield from self._stand(_RETRY_S)
        else:
            self._waiting, self._called, left = True, False, round(flight.wait_s / FRAME_S)
            while not self._called and left > 0:
                left -= 1
                yield self.state
            self._waiting = False
            if not self._called:
                return False
        self.busy = True
        yield from self._stand(_READY_S)
        return True

    def _fly(self, flight: Flight) -> Frames:
        a, scenario = self._a, self._scenario
        a.mode = a.flying_mode
        a.landed_state = dialect.MAV_LANDED_STATE_TAKEOFF
        a.note("takeoff")
        first = flight.pattern[0]
        height = first.height_m if isinstance(first, Takeoff) else self.state.height_m
        if not a.quad:
            tune = TUNINGS[scenario.airframe]
            for state in launch(self.state, height, tune.speed_mps, tune.pitch_level_rad):
                self.state = state
                yield state
        yield from self._airborne(flight, height)
        a.note("touchdown")
        for state in settle(self.state):
            self.state = state
            yield state
        self.state = parked(self.state.north_m, self.state.east_m, self.state.heading_rad)
        a.landed_state = dialect.MAV_LANDED_STATE_ON_GROUND
        yield from self._stand(_READY_S)
        a.disarm()
        a.mode = a.resting_mode
        self.busy = False

    def _airborne(self, flight: Flight, height_m: float) -> Frames:
        """JSBSim under guidance, until the wheels touch. Lift-off is where it stood, whatever JSBSim fell
        meanwhile."""
        a, model = self._a, self._scenario.airframe
        air = Airframe(model, a.home, self.state)
        pilot = QuadPilot(self._scenario.autopilot.velocity_noise_mps, self._rng) if a.quad else PlanePilot(model)
        stood, shift = self.state, None if a.quad else (0.0, 0.0, 0.0)
        for leg in flight.pattern:
            a.note("pattern", kind=type(leg).__struct_config__.tag)
            if isinstance(leg, Land):
                a.landed_state = dialect.MAV_LANDED_STATE_LANDING
            elif not isinstance(leg, Takeoff):
                a.landed_state = dialect.MAV_LANDED_STATE_IN_AIR
            sticks = pilot.fly(leg, self.state, height_m)
            stick = next(sticks, None)
            while stick is not None:
                state = air.step(stick, self._wind.step())
                if shift is None and -state.vd_mps > _LIFT_MPS:
                    shift = (stood.north_m - state.north_m, stood.east_m - state.east_m, -state.height_m)
                state = _held(stood, state) if shift is None else _shifted(state, shift)
                self.state = state
                yield state
                if shift is not None and state.height_m < 0:
                    return
                try:
                    stick = sticks.send(state)
                except StopIteration:
                    break
            if isinstance(leg, Climb):
                height_m = self.state.height_m


def _shifted(state: State, shift: tuple[float, float, float]) -> State:
    return state._replace(
        north_m=state.north_m + shift[0], east_m=state.east_m + shift[1], height_m=state.height_m + shift[2]
    )


def _held(stood: State, state: State) -> State:
    """Motors spin up, the ground still carries: attitude is free, place is not."""
    sp, cp = math.sin(state.pitch_rad), math.cos(state.pitch_rad)
    sr, cr = math.sin(state.roll_rad), math.cos(state.roll_rad)
    return state._replace(
        force_x_mss=GRAVITY_MSS * sp, force_y_mss=-GRAVITY_MSS * sr * cp, force_z_mss=-GRAVITY_MSS * cr * cp,
        north_m=stood.north_m, east_m=stood.east_m, height_m=0.0, vn_mps=0.0, ve_mps=0.0, vd_mps=0.0,
    )  # fmt: skip
