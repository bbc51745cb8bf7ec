"""Wind at the vehicle: a steady part and coloured gusts, seeded, so that a flight repeats bit for bit.

Gusts are first-order shaped noise per axis (the longitudinal Dryden form); JSBSim's own turbulence is not
used because its generator also feeds other models of the same process.
"""

from __future__ import annotations

import math

import numpy as np

_BLOCK = 4096
_HORIZONTAL_TAU_S = 3.0
_VERTICAL_TAU_S = 1.0


class Wind:
    """Steps a wind vector, m/s, north-east-down, towards where it blows.

    from_rad : where the steady wind comes from, true.  sigma_mps : gust standard deviation of each horizontal
    component; vertical gusts have half of it.
    """

    def __init__(self, speed_mps: float, from_rad: float, sigma_mps: float, dt_s: float, seed: int) -> None:
        self._steady = (-speed_mps * math.cos(from_rad), -speed_mps * math.sin(from_rad))
        self._rng = np.random.default_rng([seed, 1])
        self._keep_h = math.exp(-dt_s / _HORIZONTAL_TAU_S)
        self._keep_v = math.exp(-dt_s / _VERTICAL_TAU_S)
        self._push_h = sigma_mps * math.sqrt(1 - self._keep_h**2)
        self._push_v = 0.5 * sigma_mps * math.sqrt(1 - self._keep_v**2)
        self._gust = (0.0, 0.0, 0.0)
        self._noise: list[list[float]] = []

    def step(self) -> tuple[float, float, float]:
        """Wind one step later, m/s, north-east-down."""
        if not self._noise:
            self._noise = self._rng.standard_normal((_BLOCK, 3)).tolist()
        a, b, c = self._noise.pop()
        north, east, down = self._gust
        self._gust = (
            self._keep_h * north + self._push_h * a,
            self._keep_h * east + self._push_h * b,
            self._keep_v * down + self._push_v * c,
        )
        return self._steady[0] + self._gust[0], self._steady[1] + self._gust[1], self._gust[2]
