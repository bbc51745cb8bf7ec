"""How wrong a tilt of gyro and accelerometer may be: from how far the two disagree."""

from __future__ import annotations

import math

from magmav.core.types import Vec3

_UNKNOWN_RAD = math.radians(5.0)  # before anything was seen
_FLOOR_RAD = math.radians(0.5)
_APART_TO_ERROR = 2.0
_MEMORY_S = 12.0
_BIAS_RADS = math.radians(0.5)  # of the gyro: it carries the tilt away while nobody trusts the accelerometer
_LOST_RAD = math.radians(30.0)


class TiltDoubt:
    """Acceleration misleads a tilt that follows the accelerometer slowly; where nothing accelerates, the two agree.

    What they disagree by, averaged over the time in which the tilt follows, is about half of the tilt's error, in
    simulated flights as in hand-held recordings with optical truth; benchmarks/own_tilt.py prints error and claim.
    """

    def __init__(self, tau_s: float, per_turning_s: float) -> None:
        """tau_s : in which the tilt follows.  per_turning_s : error per rate of turning, of gyro scale and timing."""
        self._tau_s, self._per_turning_s = tau_s, per_turning_s
        self._x = self._y = 0.0
        self._square = (_UNKNOWN_RAD / _APART_TO_ERROR) ** 2
        self._turning2 = 0.0
        self._alone_s = 0.0  # what the gyro's bias has had to turn the tilt

    def step(self, apart_rad: tuple[float, float], trust: float, rate_b_rads: Vec3, dt_s: float) -> None:
        """Take by what the accelerometer disagrees, along two level axes that do not turn, and the trust put in it.

        trust : 0 to 1; the tilt follows so much slower.  rate_b_rads (3,) : how fast the vehicle turns.
        """
        apart_rad = trust * apart_rad[0], trust * apart_rad[1]
        self._alone_s += dt_s * (1.0 - trust) - self._alone_s * (1.0 - math.exp(-trust * dt_s / self._tau_s))
        follow = 1.0 - math.exp(-dt_s / self._tau_s)
        self._x += follow * (apart_rad[0] - self._x)
        self._y += follow * (apart_rad[1] - self._y)
        weight = 1.0 - math.exp(-dt_s / _MEMORY_S)
        self._square += weight * (0.5 * (self._x**2 + self._y**2) - self._square)
        self._turning2 += weight * (float(rate_b_rads @ rate_b_rads) - self._turning2)

    @property
    def sigma_rad(self) -> float:
        """About each level axis."""
        seen2 = _APART_TO_ERROR**2 * self._square + self._per_turning_s**2 * self._turning2
        return math.sqrt(_FLOOR_RAD**2 + seen2 + min(_BIAS_RADS * self._alone_s, _LOST_RAD) ** 2)
