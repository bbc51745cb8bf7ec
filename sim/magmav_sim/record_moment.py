"""What one frame of 10 ms gives to a recording."""

from __future__ import annotations

import math
from typing import NamedTuple

from magmav_sim.autopilot import Autopilot
from magmav_sim.faults import Vector

_FRAMES_PER_S = 100


class Inertial(NamedTuple):
    """One IMU, body axes: rad/s with the gyro's bias, m/s^2 (level and still is -g on z) with noise."""

    rate_rads: Vector
    force_mss: Vector


class Moment(NamedTuple):
    """The vehicle at the end of one frame. tick counts frames since boot; sent are the MAVLink frames of this one;
    fresh: compasses and battery were read in it; inertial has one entry for each IMU."""

    tick: int
    boot_us: int
    autopilot: Autopilot
    sent: list[bytes]
    fresh: bool
    inertial: list[Inertial]

    def due(self, hertz: int) -> bool:
        """Whether something that comes so often comes now."""
        return self.tick % (_FRAMES_PER_S // hertz) == 0

    @property
    def position(self) -> tuple[float, float, float]:
        """Latitude and longitude, deg, and metres above sea level."""
        s, home = self.autopilot.state, self.autopilot.home
        lat_deg, lon_deg = home.at(s.north_m, s.east_m)
        return lat_deg, lon_deg, home.alt_m + s.height_m

    @property
    def over_ground(self) -> tuple[float, float]:
        """Speed, m/s, and course, rad from -pi to pi."""
        s = self.autopilot.state
        return math.hypot(s.vn_mps, s.ve_mps), math.atan2(s.ve_mps, s.vn_mps)
