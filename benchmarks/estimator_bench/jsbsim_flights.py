"""Flights of the simulator's JSBSim airframes, as truth arrays. Only the motion is taken: errors are ours."""

from __future__ import annotations

from typing import Any

import numpy as np
from magmav_sim import Simulation, parse_scenario

from estimator_bench.flights import FLIGHT_S, STEP_S, TRUTH_HZ, Truth, rotations, truth_of
from estimator_bench.motions import GRAVITY_MSS, PLANE, QUAD, Array

_FRAME_S = 0.01
_GROUND_S = 3.0  # kept of the time before take-off
_HEAD = """
seed = {seed}
airframe = "{airframe}"
date = 2026-05-30T10:00:00Z
place = {{ lat_deg = 47.38, lon_deg = 8.54, alt_m = 408.0 }}
heading_deg = {heading}
wind = {{ speed_mps = 3.0, from_deg = 250.0, turbulence_mps = 0.8 }}
[[compass]]
device_id = 97539
hard_iron_mg = [10.0, 0.0, 0.0]
[autopilot]
parameters = {{ COMPASS_OFS_X = -10.0 }}
[[flight]]
ground_s = 1.0
pattern = [
"""
_UP = '{ kind = "takeoff", height_m = 20.0, climb_mps = 2.5 }'
_TURNS = (
    '{ kind = "yaw", turns = 1.5, rate_dps = 30.0 }',
    '{ kind = "hover", seconds = 8.0 }',
    '{ kind = "yaw", turns = -1.5, rate_dps = 25.0 }',
)
_LOITER = (
    '{ kind = "takeoff", height_m = 120.0 }',
    '{ kind = "loiter", turns = 3.0, bank_deg = 30.0 }',
    '{ kind = "straight", seconds = 8.0 }',
    '{ kind = "loiter", turns = 6.0, bank_deg = -30.0 }',
)
FLIGHTS = {
    "hover_yaw": ("F450", (_UP, *_TURNS * 5)),
    "figure8": ("F450", (_UP, '{ kind = "figure8", laps = 12, half_length_m = 15.0, speed_mps = 5.0 }')),
    "survey": ("F450", (_UP, '{ kind = "survey", lanes = 24, length_m = 40.0, spacing_m = 8.0, speed_mps = 5.0 }')),
    "loiter": ("c172x", _LOITER),
}


def jsbsim_flight(name: str, seed: int) -> Truth:
    """One of FLIGHTS, from just before take-off, FLIGHT_S long. ValueError where it was shorter."""
    airframe, legs = FLIGHTS[name]
    text = _HEAD.format(seed=seed, airframe=airframe, heading=float(seed * 37 % 360))
    text += ",\n".join((*legs, '{ kind = "land", sink_mps = 2.0 }')) + "\n]\n"
    simulation = Simulation(parse_scenario(text.encode(), f"{name}.toml"))
    states: list[Any] = []
    began: float | None = None
    while not simulation.finished and len(states) < round((FLIGHT_S + 30.0) / _FRAME_S):
        simulation.advance(_FRAME_S)
        state = simulation.autopilot.state
        if began is None and state.height_m > 0.1:
            began = len(states) * _FRAME_S
        states.append(state)
    t_s: Array = np.arange(0.0, int(FLIGHT_S * TRUTH_HZ) + 1) * STEP_S
    first_s = max((began or 0.0) - _GROUND_S, 0.0)
    at_s = np.arange(len(states)) * _FRAME_S - first_s
    if at_s[-1] < FLIGHT_S:
        raise ValueError(f"{name}: seed {seed} landed after {at_s[-1]:.0f} s, want {FLIGHT_S:.0f} s")
    table = np.array(states)
    table[:, 2] = np.unwrap(table[:, 2])

    def column(i: int) -> Array:
        return np.asarray(np.interp(t_s, at_s, table[:, i]))

    C_bn = rotations(column(0), column(1), column(2))
    force_b = np.stack([column(i) for i in (6, 7, 8)], 1)
    accel = np.einsum("nji,nj->ni", C_bn, force_b) + np.array((0.0, 0.0, GRAVITY_MSS))
    velocity = np.stack([column(i) for i in (12, 13, 14)], 1)
    kind = QUAD if airframe == "F450" else PLANE
    takeoff_s = (began or 0.0) - first_s
    return truth_of(kind, t_s, C_bn, accel, velocity, np.maximum(column(11), 0.0), column(16), takeoff_s)
