"""The battery: what flows, and what the battery monitor says flows."""

from __future__ import annotations

import numpy as np

_HOVER_AMPERE, _HOVER_LOAD = 17.0, 0.689
_PLANE_AMPERE = 35.0
_ELECTRONICS_AMPERE, _IDLE_AMPERE = 0.5, 0.8
_MONITOR_SIGMA_AMPERE = 0.2
_BLOCK = 1024


class Battery:
    """ampere is true, measured_ampere is noisy; used_mah since the start."""

    def __init__(self, *, quad: bool, seed: int) -> None:
        self._quad = quad
        self._rng = np.random.default_rng([seed, 6])
        self._noise: list[float] = []
        self.ampere = self.measured_ampere = self.used_mah = 0.0
        self.volt = 16.4

    def flow(self, load: float, armed: bool) -> float:
        """Current for a motor load (the sum of throttles squared), A."""
        self.ampere = _ELECTRONICS_AMPERE
        if self._quad:
            self.ampere += (_IDLE_AMPERE if armed else 0.0) + _HOVER_AMPERE * load / _HOVER_LOAD
        else:
            self.ampere += _PLANE_AMPERE * load
        return self.ampere

    def read(self, since_s: float) -> None:
        """Let the monitor measure, ``since_s`` after the last time."""
        if not self._noise:
            self._noise = (self._rng.standard_normal(_BLOCK) * _MONITOR_SIGMA_AMPERE).tolist()
        self.measured_ampere = max(0.0, self.ampere + self._noise.pop())
        self.used_mah += self.ampere * since_s / 3.6
        self.volt = 16.4 - 0.015 * self.ampere - 0.0004 * self.used_mah
