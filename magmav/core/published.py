"""The heading that is published: as measured, through the live Kalman filter, or a fixed lag late and smoother.

Smoothing takes out what is noise. What is left of iron and tilt error is no noise and turns with the vehicle, so the
sigma that is published stays that of the calibration.
"""

from __future__ import annotations

import math
from dataclasses import replace

from magmav.core.heading import UNKNOWN
from magmav.core.rotation import wrap_tau
from magmav.core.smoothing import FixedLagSmoother, HeadingFilter, Smoothed
from magmav.core.types import Estimate, Heading

SMOOTHINGS = ("off", "kalman", "fixed_lag")
_LEAST_NOISE_RAD = math.radians(0.1)
_OLDEST_S = 3.0
"""A heading later than this is not published: it would look like one of now (S12)."""


def noise_of_heading(e: Estimate, horizontal_mg: float) -> float:
    """One sigma of a single heading's noise, rad: that of the field over the horizontal field (seed-methods.md Y7)."""
    return max(e.residual_mg / max(horizontal_mg, 1.0), _LEAST_NOISE_RAD)


class Publisher:
    """One compass's headings in, the heading to publish out. ``lag``: samples, for "fixed_lag"."""

    def __init__(self, smoothing: str = "off", lag: int = 10) -> None:
        if smoothing not in SMOOTHINGS:
            raise ValueError(f"smoothing: want one of {', '.join(SMOOTHINGS)}, got {smoothing!r}")
        self.smoothing, self.lag = smoothing, lag
        self.restart()

    def restart(self) -> None:
        """Begin anew: what comes next is not the same story."""
        self._by: HeadingFilter | FixedLagSmoother | None = None
        if self.smoothing == "kalman":
            self._by = HeadingFilter()
        elif self.smoothing == "fixed_lag":
            self._by = FixedLagSmoother(self.lag)

    def step(self, boot_ns: int, heading: Heading, noise_rad: float) -> tuple[Heading, int]:
        """The heading to publish and the boot time it belongs to. Where there is none yet, it is not valid."""
        by = self._by
        if by is None:
            return heading, boot_ns
        if not heading.valid:
            self.restart()
            return UNKNOWN, boot_ns
        if isinstance(by, HeadingFilter):
            return self._as(by.step(boot_ns / 1e9, heading.magnetic_rad, noise_rad), heading)
        final = by.step(boot_ns / 1e9, heading.magnetic_rad, noise_rad)
        if not final or boot_ns / 1e9 - final[-1].boot_s > _OLDEST_S:
            return UNKNOWN, boot_ns
        return self._as(final[-1], heading)

    @staticmethod
    def _as(s: Smoothed, now: Heading) -> tuple[Heading, int]:
        true = wrap_tau(s.heading_rad + now.true_rad - now.magnetic_rad) if now.true_valid else 0.0
        return replace(now, magnetic_rad=s.heading_rad, true_rad=true), round(s.boot_s * 1e9)
