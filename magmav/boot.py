"""What stays of a vehicle's time before a reboot."""

from __future__ import annotations

from dataclasses import dataclass

from magmav.core.causes import Causes
from magmav.core.phase import Phase
from magmav.mavlink.autopilot.stored import StoredCalibrations


@dataclass(frozen=True, slots=True)
class Boot:
    """Enough to judge what was learnt then."""

    calibrations: StoredCalibrations
    phase: Phase
    began_ns: int | None
    causes: Causes

    def started_ns(self) -> int | None:
        """Boot time of take-off, or of the first data where nothing flew."""
        return self.began_ns
