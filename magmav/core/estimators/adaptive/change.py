"""A sudden change of the iron: a payload dropped, a magnet attached. Seen in innovations that lean one way for long."""

from __future__ import annotations

import math

import numpy as np

from magmav.core.estimators.adaptive import layout as at
from magmav.core.estimators.adaptive.bank import Bank
from magmav.core.estimators.adaptive.layout import Array
from magmav.core.estimators.adaptive.tuning import Tuning

_LEAST_MG, _SHARE = 80.0, 1.5  # a change is taken to be at least so large, and so many times what was seen of it
_ALIKE_S = 20.0
_TURN_RAD = math.radians(2.0)


class ChangeWatch:
    """Mean of the whitened innovation over a second or two; white noise keeps it near zero."""

    def __init__(self, n: Tuning) -> None:
        self._n = n
        self._mean, self._innovation_mg = [0.0] * 3, [0.0] * 3
        self._alike = 0.0
        self._seen = 0.0  # samples behind the mean, as far as it remembers
        self.since_s = 1e9  # the last change

    def step(
        self, white: Array, innovation_mg: Array, like: float, disturbance: float, nis: float, dt_s: float
    ) -> bool:
        """Take the best hypothesis' innovation, whitened and plain, (k,), and |d|^2 / sigma^2 of its disturbance.

        nis : mean normalised square of single readings over the last second, per axis.

        like : correlation of neighbouring innovations; where they are alike anyway, fewer of them count.
        True when the iron must have changed.
        """
        n = self._n
        self.since_s += dt_s
        if dt_s <= 0.0:
            return False
        fade = math.exp(-dt_s / n.change_tau_s)
        for i, (one, one_mg) in enumerate(zip(white.tolist(), innovation_mg.tolist(), strict=True)):
            self._mean[i] += (1.0 - fade) * (one - self._mean[i])
            self._innovation_mg[i] += (1.0 - fade) * (one_mg - self._innovation_mg[i])
        self._alike += min(dt_s / _ALIKE_S, 0.1) * (like - self._alike)  # slowly: a change itself looks alike, too
        self._seen = min(self._seen + 1.0, (1.0 + fade) / (1.0 - fade))
        if self.since_s < n.change_hold_s or self._seen < 5.0:
            return False
        alike = min(max(self._alike, 0.0), 0.9)
        leaning = math.hypot(*self._mean) ** 2 * self._seen * (1.0 - alike) / (1.0 + alike)
        if leaning < n.change_chi2 and disturbance < n.change_disturbance and nis < n.change_nis:
            return False
        self.since_s = self._seen = 0.0
        self._mean = [0.0] * 3
        return True

    def open(self, bank: Bank) -> None:
        """Let the iron move: what is known of field, heading and soft iron stays, so it is soon found again."""
        seen = max(math.hypot(*self._innovation_mg), float(np.abs(bank.x[:, at.D]).max(initial=0.0)))
        bank.doubt_iron(max(_LEAST_MG, _SHARE * seen))
        np.einsum("kii->ki", bank.p)[:, at.ALPHA] += _TURN_RAD**2
