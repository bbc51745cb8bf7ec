"""The autopilot's own idea of its attitude: true tilt with a slow error, and a yaw that believes its
compass."""

from __future__ import annotations

import math

import numpy as np

from magmav_sim.airframe import FRAME_S, State
from magmav_sim.scenario import AutopilotSpec

_BLOCK = 4096
_YAW_TAU_S = 8.0
READ_S = 0.1


class Ahrs:
    """Attitude estimate, rad; gyro_bias_rads is what is left of the gyro's bias, constant over a run."""

    def __init__(self, spec: AutopilotSpec, seed: int) -> None:
        self._spec = spec
        self._rng = np.random.default_rng([seed, 3])
        bias = math.radians(spec.gyro_bias_dps) * self._rng.standard_normal(3)
        self.gyro_bias_rads: tuple[float, float, float] = (float(bias[0]), float(bias[1]), float(bias[2]))
        self._keep = math.exp(-FRAME_S / spec.tilt_tau_s)
        sigma = math.radians(spec.tilt_sigma_deg)
        self._push = sigma * math.sqrt(1 - self._keep**2)
        first = self._rng.standard_normal(2) * sigma
        self._error = (float(first[0]), float(first[1]))
        self._noise: list[list[float]] = []
        self.roll_rad = self.pitch_rad = self.yaw_rad = 0.0
        self._aligned = False

    def align(self) -> None:
        """As after a boot: the next compass reading sets the yaw."""
        self._aligned = False

    def step(self, state: State) -> None:
        """One frame of gyro."""
        if not self._noise:
            self._noise = (self._rng.standard_normal((_BLOCK, 2)) * self._push).tolist()
        a, b = self._noise.pop()
        self._error = (self._keep * self._error[0] + a, self._keep * self._error[1] + b)
        self.roll_rad = state.roll_rad + self._error[0]
        self.pitch_rad = state.pitch_rad + self._error[1]
        if self._spec.yaw == "truth":
            self.yaw_rad = state.heading_rad
            return
        q, r = state.q_rads + self.gyro_bias_rads[1], state.r_rads + self.gyro_bias_rads[2]
        turn = q * math.sin(self.roll_rad) + r * math.cos(self.roll_rad)
        self.yaw_rad += turn / math.cos(self.pitch_rad) * FRAME_S

    def pull(self, compass_heading_rad: float) -> None:
        """Believe a compass heading, true north, READ_S after the last one."""
        if self._spec.yaw == "truth":
            return
        miss = math.remainder(compass_heading_rad - self.yaw_rad, math.tau)
        self.yaw_rad += miss if not self._aligned else miss * READ_S / _YAW_TAU_S
        self._aligned = True
