"""How wrong a tilt of gyro and accelerometer may be: from how far the two disagree."""

from __future__ import annotations

import math

from magmav.core.types import Vec3

_UNKNOWN_RAD = math.radians(5.0)  # before anything was seen
_FLOOR_RAD = math.radians(0.5)
_APART_TO_ERROR = 2.0
_MEMORY_S = 12.0


class TiltDoubt:
    """Acceleration misleads a tilt that follows the accelerometer slowly; where nothing accelerates, the two agree.

    What they disagree by, averaged over the time in which the tilt follows, is a share of the tilt's error. Measured
    against the true tilt of simulated flights (survey, loiter, figure eight, aggressive) the error was 1.4 to 2.6 times
    as large, against the optical tilt of four hand-held recordings 1.4 to 3, and more the faster they turned.
    """

    def __init__(self, tau_s: float, per_turning_s: float) -> None:
        """tau_s : in which the tilt follows.  per_turning_s : error per rate of turning, of gyro scale and timing."""
        self._tau_s, self._per_turning_s = tau_s, per_turning_s
        self._x = self._y = 0.0
        self._square = (_UNKNOWN_RAD / _APART_TO_ERROR) ** 2
        self._turning2 = 0.0

    def step(self, apart_rad: tuple[float, float], rate_b_rads: Vec3, dt_s: float) -> None:
        """Take by what the accelerometer disagrees, along two level axes that do not turn, times the trust put in it.

        rate_b_rads (3,) : how fast the vehicle turns.
        """
        follow = 1.0 - math.exp(-dt_s / self._tau_s)
        self._x += follow * (apart_rad[0] - self._x)
        self._y += follow * (apart_rad[1] - self._y)
        weight = 1.0 - math.exp(-dt_s / _MEMORY_S)
        self._square += weight * (0.5 * (self._x**2 + self._y**2) - self._square)
        self._turning2 += weight * (float(rate_b_rads @ rate_b_rads) - self._turning2)

    @property
    def sigma_rad(self) -> float:
        """About each level axis."""
        return math.sqrt(_FLOOR_RAD**2 + _APART_TO_ERROR**2 * self._square + self._per_turning_s**2 * self._turning2)
