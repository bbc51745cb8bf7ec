"""The whole path in one place: a reading in, a Record out.

Live, replay and simulation run this and nothing else. It has no clock and no link of its own.

    reading -> vehicle: clock, phase of flight, stored calibration
            -> assemble: Sample -> estimator: Estimate -> heading, gate -> Record
"""

from __future__ import annotations

from magmav.core.estimators import ESTIMATORS
from magmav.core.motion_run import MotionRun
from magmav.core.published import Publisher
from magmav.core.types import FieldModel, Reading, Record
from magmav.settings import Settings
from magmav.vehicle import Tap, Vehicle


class Pipeline:
    """Every vehicle on a link. ``unix_offset_ns`` takes arrival time to UNIX time, for the field model's date.

    tap : sees every Sample before it is learnt from, see vehicle.Tap.  idle : that is all, see Vehicle.
    """

    def __init__(
        self, settings: Settings, model: FieldModel, unix_offset_ns: int = 0, tap: Tap | None = None, idle: bool = False
    ) -> None:
        self.settings, self._model = settings, model
        self._tap, self.idle, self._unix_offset_ns = tap, idle, unix_offset_ns
        self.vehicles: dict[int, Vehicle] = {}
        self._own: dict[int, Settings] = {}
        # Their libraries take seconds to load: now, not at the first sample.
        ESTIMATORS[settings.learn.estimator]()
        Publisher(settings.heading.smooth, settings.heading.lag)

    def apply(self, settings: Settings, system: int | None = None) -> None:
        """Settings changed in flight, of one vehicle or of all: what is learnt stays."""
        if system is None:
            self.settings, self._own = settings, {}
        else:
            self._own[system] = settings
        for vehicle in (v for v in self.vehicles.values() if system in (None, v.system)):
            vehicle.apply(settings)

    def forget(self, system: int) -> None:
        """What was learnt of this vehicle no longer counts: it is gone, or was heard from somewhere else."""
        self.vehicles.pop(system, None)

    def step(self, reading: Reading, t_ns: int) -> Record | None:
        """Take one reading that arrived at t_ns; a Record when it was a fresh magnetometer value."""
        who, unix_ns = reading.system, t_ns + self._unix_offset_ns
        return (self.vehicles.get(who) or self._met(who)).step(reading, t_ns, unix_ns)

    def run(self, run: MotionRun) -> bool:
        """Take many attitudes at once, see Vehicle.run."""
        return (self.vehicles.get(run.system) or self._met(run.system)).run(run)

    def _met(self, system: int) -> Vehicle:
        held = self._own.get(system, self.settings)
        return self.vehicles.setdefault(system, Vehicle(system, held, self._model, self._tap, self.idle))
