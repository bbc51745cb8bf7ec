"""Is a vehicle being turned in somebody's hands? What stands parked, on steel perhaps, never looks so.

It does once it has been tilted by 20 degrees from where it rested, and until it rests again: a second without tilting
by more than 3 degrees. While it is tilted so far, turning alone counts as well. Turning flat on the ground does not,
nor does an attitude that jumps while the gyro says nothing, as one does when an autopilot finds its level.
"""

from __future__ import annotations

import math

import numpy as np

from magmav.core.types import Sample, Vec3

_TAKEN_UP = math.cos(math.radians(20.0))
_MOVED = math.cos(math.radians(3.0))
_TURNED_RAD = math.radians(10.0)  # by the gyro, since it rested
_TURNING_RADS = math.radians(6.0)
_RESTS_NS = 1_000_000_000
_BLIND_NS = 3_000_000_000  # silence after which nobody knows what happened in between


class Handling:
    """Watches the tilt of one disarmed vehicle. Times are boot times."""

    def __init__(self) -> None:
        self.handled = False
        self._rest_b: Vec3 | None = None  # the earth's down as it lay, (3,) unit vector in body axes
        self._near_b: Vec3 | None = None  # and where it last began to be still
        self._still_ns = 0
        self._heard_ns = 0
        self._turned_rad = 0.0

    def see(self, s: Sample) -> bool:
        """Take one sample's tilt and rates; is it being handled?"""
        cp = math.cos(s.pitch_rad)
        down_b = np.array((-math.sin(s.pitch_rad), math.sin(s.roll_rad) * cp, math.cos(s.roll_rad) * cp))
        if self._rest_b is None or self._near_b is None or s.boot_ns - self._heard_ns > _BLIND_NS:
            self._rest_b, self.handled = down_b, False
            self._near_b, self._still_ns, self._turned_rad = down_b, s.boot_ns, 0.0
            self._heard_ns = s.boot_ns
        rate_rads = math.hypot(*s.rate_b_rads)
        self._turned_rad += rate_rads * max(s.boot_ns - self._heard_ns, 0) / 1e9
        self._heard_ns = s.boot_ns
        away = bool(down_b @ self._rest_b < _TAKEN_UP)
        turning = away and rate_rads > _TURNING_RADS
        if turning or down_b @ self._near_b < _MOVED:
            self._near_b, self._still_ns = down_b, s.boot_ns
        if s.boot_ns - self._still_ns >= _RESTS_NS:
            self._rest_b, self._turned_rad, self.handled = down_b, 0.0, False
        elif away and self._turned_rad > _TURNED_RAD:
            self.handled = True
        return self.handled
