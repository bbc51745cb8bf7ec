"""The whole path in one place: a reading in, a Record out.

Live, replay and simulation run this and nothing else. It has no clock and no link of its own.

    reading -> vehicle: clock, phase of flight, stored calibration
            -> assemble: Sample -> estimator: Estimate -> heading, gate -> Record
"""

from __future__ import annotations

from magmav.core.estimators import ESTIMATORS
from magmav.core.published import Publisher
from magmav.core.types import FieldModel, Reading, Record
from magmav.settings import Settings
from magmav.vehicle import Tap, Vehicle


class Pipeline:
    """Every vehicle on a link. ``unix_offset_ns`` takes arrival time to UNIX time, for the field model's date.

    tap : sees every Sample before it is learnt from, see vehicle.Tap.
    """

    def __init__(self, settings: Settings, model: FieldModel, unix_offset_ns: int = 0, tap: Tap | None = None) -> None:
        self.settings = settings
        self._tap = tap
        self._model = model
        self._unix_offset_ns = unix_offset_ns
        self.vehicles: dict[int, Vehicle] = {}
        # Their libraries take seconds to load: now, not at the first sample.
        ESTIMATORS[settings.learn.estimator]()
        Publisher(settings.heading.smooth, settings.heading.lag)

    def apply(self, settings: Settings) -> None:
        """Settings changed in flight: what is learnt stays."""
        self.settings = settings
        for vehicle in self.vehicles.values():
            vehicle.apply(settings)

    def step(self, reading: Reading, t_ns: int) -> Record | None:
        """Take one reading that arrived at t_ns; a Record when it was a fresh magnetometer value."""
        vehicle = self.vehicles.get(reading.system)
        if vehicle is None:
            vehicle = self.vehicles[reading.system] = Vehicle(reading.system, self.settings, self._model, self._tap)
        return vehicle.step(reading, t_ns, t_ns + self._unix_offset_ns)
