"""What a verdict asks of time: fit for a while, not for a moment, and not worse than it lately was."""

from __future__ import annotations

import math

STOOD_NS = 1_000_000_000
WORSE, WORSE_MG = 1.5, 1.0  # real magnets: 57 mG taken off at once was noticed late, and doubled the residual at once
_FORGET_S = 60.0  # by then the worse fit is the usual one, and what it rests on says itself how sure it is


class Stood:
    """Has something been so for a second? Beliefs that pass a line for a moment, on their way, have not."""

    def __init__(self) -> None:
        self._since_ns: int | None = None

    def step(self, boot_ns: int, so: bool) -> bool:
        """Take what is so now. A clock that goes back begins anew."""
        if not so:
            self._since_ns = None
            return False
        if self._since_ns is None or boot_ns < self._since_ns:
            self._since_ns = boot_ns
        return boot_ns - self._since_ns >= STOOD_NS


class Worsening:
    """Do readings fit worse than they lately did? Then something has changed, found or not.

    The least residual of late is remembered, and forgotten over a minute.
    """

    def __init__(self) -> None:
        self._least_mg, self._boot_ns = math.inf, 0

    def step(self, boot_ns: int, residual_mg: float) -> bool:
        """Take a residual, RMS, mG; is it half as much again, and a milligauss, over what it was?"""
        dt_s, self._boot_ns = max(boot_ns - self._boot_ns, 0) / 1e9, boot_ns
        if residual_mg < self._least_mg:
            self._least_mg = residual_mg
        else:
            self._least_mg += min(dt_s / _FORGET_S, 1.0) * (residual_mg - self._least_mg)
        return residual_mg > WORSE * self._least_mg + WORSE_MG
