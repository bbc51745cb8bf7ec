"""What one vehicle stores, kept by the rules of each autopilot until its heartbeat says which one it is."""

from __future__ import annotations

from magmav.core.types import CalibrationReading, ParamReading
from magmav.mavlink.autopilot.ardupilot import Calibrations
from magmav.mavlink.autopilot.px4 import Px4Calibrations
from magmav.mavlink.autopilot.stored import StoredCalibrations

_ARDUPILOT, _PX4 = 3, 12  # MAV_AUTOPILOT


class Books:
    """One of each kind: parameters may be heard before the heartbeat that says whose they are."""

    def __init__(self) -> None:
        self._books: dict[int, StoredCalibrations] = {_ARDUPILOT: Calibrations(), _PX4: Px4Calibrations()}

    def of(self, autopilot: int) -> StoredCalibrations:
        """By the rules of this MAV_AUTOPILOT; ArduPilot's where it is another, or not known."""
        return self._books.get(autopilot, self._books[_ARDUPILOT])

    def take(self, r: ParamReading | CalibrationReading, autopilot: int) -> tuple[int, ...]:
        """Tell all of them; the compasses whose correction changed, as this autopilot's sees it."""
        changed = {
            kind: book.param(r) if isinstance(r, ParamReading) else book.report(r) for kind, book in self._books.items()
        }
        return changed.get(autopilot, changed[_ARDUPILOT])
