"""Is the vehicle flying, since when and until when? What stands on steel and concrete teaches nothing about a compass.

The altitude rule is for vehicles that fly. Rovers, boats, and anything that never says what it is, learn wherever
they are (users.md N1, N11). What flies also learns while somebody turns it in his hands, disarmed and before its first
flight: afterwards it is being carried away, past whatever steel there is, and flight has taught better.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from magmav.core.handling import Handling
from magmav.core.types import Landed, LandedReading, MotionReading, PositionReading, Sample, VehicleReading

# MAV_TYPE of what flies: fixed wing, multirotors, helicopters, airships, flapping wing, VTOLs, parafoil, dodecarotor.
_FLYERS = frozenset({1, 2, 3, 4, 7, 8, 13, 14, 15, 16, 19, 20, 21, 22, 23, 24, 25, 28, 29, 35, 43})
_FIXED_WING = 1
_ALOFT_M = 5.0
_ON_GROUND = Landed.ON_GROUND  # asked at every attitude, and an enumeration is slow to look into
_FAST_MPS = 8.0
_BLIND_S = 10.0  # armed this long with neither height nor landed state known counts as flying
_WHO_S = 3.0  # heartbeats come once a second: after this long without one nobody will say what it is
_FAIR_RAD = math.radians(90.0)
_CRASH_UPRIGHT = math.cos(math.radians(100.0))  # of body down along earth down
_CRASH_S = 1.0
_DOWN_M, _DOWN_MPS, _DOWN_S = 2.0, 1.5, 3.0  # low and slow this long is a landing, where nobody says so


@dataclass(slots=True)
class Flight:
    """One flight from arming to disarming, boot times; None where it did not happen or was not seen.

    The first arming of a recording that begins armed is its first heartbeat. A second take-off without disarming in
    between is a flight of its own with the same arming.
    """

    armed_ns: int
    takeoff_ns: int | None = None
    landed_ns: int | None = None
    disarmed_ns: int | None = None
    crash_ns: int | None = None

    def as_seconds(self) -> dict[str, float | None]:
        """For a result: armed_s, takeoff_s, landed_s, disarmed_s, crash_s."""
        times = {name: getattr(self, f"{name}_ns") for name in ("armed", "takeoff", "landed", "disarmed", "crash")}
        return {f"{name}_s": None if ns is None else round(ns / 1e9, 3) for name, ns in times.items()}


class Phase:
    """One vehicle's phase of flight. Times are boot times."""

    def __init__(self) -> None:
        self.kind: int | None = None
        self.armed = False
        self.takeoff_ns: int | None = None
        self._first_ns: int | None = None
        self.flights: list[Flight] = []
        self._low_since_ns: int | None = None
        self._landed: Landed | None = None
        self._armed_ns: int | None = None
        self._alt_m: float | None = None
        self._alt_armed_m: float | None = None
        self._height_m: float | None = None
        self._speed_mps = 0.0
        self._over_since_ns: int | None = None
        self._handling: Handling | None = None

    @property
    def flyer(self) -> bool:
        """True for a vehicle that is known to fly."""
        return self.kind in _FLYERS

    def vehicle(self, r: VehicleReading, boot_ns: int) -> None:
        """Take a heartbeat."""
        self.kind = r.kind
        if r.armed and not self.armed:
            self._armed_ns, self._alt_armed_m = boot_ns, self._alt_m
            self.flights.append(Flight(boot_ns))
        elif self.armed and not r.armed:
            self._down(boot_ns)
            self.flights[-1].disarmed_ns = boot_ns
        self.armed = r.armed

    def landed(self, r: LandedReading) -> None:
        """Take a landed state."""
        self._landed = r.state

    def position(self, r: PositionReading) -> None:
        """Take a position. Only one message's altitudes are compared with each other."""
        if r.source != "GLOBAL_POSITION_INT":
            return
        self._alt_m = r.alt_m
        if self.armed and self._alt_armed_m is None:
            self._alt_armed_m = r.alt_m

    def moving(self, r: MotionReading) -> None:
        """Take speed and height above home."""
        self._speed_mps = math.hypot(r.north_mps, r.east_mps)
        self._height_m = r.height_m

    def aloft(self, boot_ns: int) -> bool:
        """Armed, in the air and at least 5 m up. Also remembers the first moment it was so."""
        up = self.armed and self._landed is not _ON_GROUND and self._high(boot_ns)
        if not self.flyer:
            return up
        if up:
            if self.takeoff_ns is None:
                self.takeoff_ns = boot_ns
            self._up(boot_ns)
        elif self.armed and self._stands(boot_ns):
            self._down(boot_ns)
        return up

    def aloft_at(self, boot_ns: Sequence[int]) -> list[bool]:
        """``aloft`` at each of these rising times, at least one, between which nothing else was heard."""
        first = self.aloft(boot_ns[0])
        in_time = self._low_since_ns is not None or (self._height_m is None and self._landed is None)
        if self.armed and in_time:  # time alone may change it
            return [first, *map(self.aloft, boot_ns[1:])]
        return [first] * len(boot_ns)

    def _up(self, boot_ns: int) -> None:
        """In the air: a take-off, unless this flight has had its own."""
        now, self._low_since_ns = self.flights[-1], None
        if now.landed_ns is not None:
            now = Flight(now.armed_ns)
            self.flights.append(now)
        if now.takeoff_ns is None:
            now.takeoff_ns = boot_ns

    def _down(self, boot_ns: int) -> None:
        """On the ground: a landing, if there was a take-off."""
        now = self.flights[-1]
        if now.takeoff_ns is not None and now.landed_ns is None:
            now.landed_ns = boot_ns

    def _stands(self, boot_ns: int) -> bool:
        """On the ground as the autopilot says; where it does not say, low and slow for some seconds."""
        if self._landed is not None:
            return self._landed is Landed.ON_GROUND
        low = self._height_m is not None and self._height_m < _DOWN_M and self._speed_mps < _DOWN_MPS
        if not low:
            self._low_since_ns = None
        elif self._low_since_ns is None:
            self._low_since_ns = boot_ns
        return self._low_since_ns is not None and boot_ns - self._low_since_ns >= _DOWN_S * 1e9

    def _high(self, boot_ns: int) -> bool:
        height_m = self._height_m
        if self._alt_m is not None and self._alt_armed_m is not None:
            climbed_m = self._alt_m - self._alt_armed_m
            height_m = climbed_m if height_m is None else max(height_m, climbed_m)
        if height_m is not None:
            return height_m >= _ALOFT_M or (self.kind == _FIXED_WING and self._speed_mps >= 2 * _FAST_MPS)
        if self._landed is not None:
            return self._landed is Landed.IN_AIR
        return self._armed_ns is not None and boot_ns - self._armed_ns > _BLIND_S * 1e9

    def tilt(self, roll_rad: float, pitch_rad: float, boot_ns: int) -> None:
        """Watch for a crash: a vehicle that hovers or cruises upright lying on its back for a second."""
        upright = abs(roll_rad) < _FAIR_RAD and abs(pitch_rad) < _FAIR_RAD  # nearly always, and cheap to tell
        if (
            upright
            or math.cos(roll_rad) * math.cos(pitch_rad) > _CRASH_UPRIGHT
            or not (self.armed and self.flyer and self.kind != _FIXED_WING)
        ):
            self._over_since_ns = None
        elif self._over_since_ns is None:
            self._over_since_ns = boot_ns
        elif self.flights[-1].crash_ns is None and boot_ns - self._over_since_ns > _CRASH_S * 1e9:
            self.flights[-1].crash_ns = self._over_since_ns

    def handled(self, s: Sample) -> bool:
        """Is a vehicle that flies, and has not yet, being turned by hand? To be asked for every sample."""
        if self.armed or not self.flyer or self.takeoff_ns is not None:
            self._handling = None
            return False
        if self._handling is None:
            self._handling = Handling()
        return self._handling.see(s)

    @property
    def crash_ns(self) -> int | None:
        """Of the last flight; an earlier crash was mended and flown again."""
        return self.flights[-1].crash_ns if self.flights else None

    @property
    def unflown(self) -> bool:
        """A vehicle that flies and has not yet."""
        return self.flyer and self.takeoff_ns is None

    def learnable(self, boot_ns: int, on_ground: bool) -> bool:
        """Does time at this boot time teach? ``on_ground`` is the operator saying that it always does."""
        aloft = self.aloft(boot_ns)
        if self.kind is None:
            self._first_ns = boot_ns if self._first_ns is None else self._first_ns
            if boot_ns - self._first_ns < _WHO_S * 1e9:
                return on_ground  # it may yet say that it flies, and stand on steel now
        if self.flights and self.flights[-1].crash_ns is not None:
            return False
        return aloft or on_ground or not self.flyer
