"""A recording through the pipeline once, kept so that any estimator can be stepped over it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from magmav.appraisal import CompassLog
from magmav.boot import Boot
from magmav.core.channel import Circumstances
from magmav.core.types import CurrentReading, MagReading, Reading, Record, Sample, ThrottleReading, Vec3
from magmav.geomag import world_magnetic_model
from magmav.logs import Recording
from magmav.pipeline import Pipeline
from magmav.recording import Keeper, open_recording, play
from magmav.reference import Reference
from magmav.settings import Settings
from magmav.vehicle import Vehicle

DATA = Path(os.environ.get("MAGMAV_DATA", Path(__file__).parents[3] / "shared" / "data"))


class Heard(NamedTuple):
    """One Sample, its circumstances, the number of boots and parameter changes before it, the field as sent."""

    sample: Sample
    circumstances: Circumstances
    stretch: tuple[int, int]
    used_b_mg: Vec3


Event = Heard | CurrentReading | ThrottleReading


@dataclass(frozen=True, slots=True, eq=False)
class Tape:
    """One vehicle's last boot that taught something.

    logs : by compass, what a replay scores.  started_s : boot time of take-off, or of the first data where nothing
    flies.  settings : those the Samples were made with.
    """

    name: str
    system: int
    events: list[Event]
    logs: dict[int, CompassLog]
    boot: Vehicle | Boot
    reference: Reference | None
    settings: Settings

    @property
    def started_s(self) -> float:
        """Boot time, s; inf where it never started."""
        started = self.boot.started_ns()
        return float("inf") if started is None else started / 1e9

    @property
    def flew(self) -> bool:
        """Did a vehicle take off in this?"""
        return self.boot.phase.flyer and self.boot.phase.takeoff_ns is not None

    def heard(self, compass: int) -> Iterator[Heard]:
        """The Samples of one compass."""
        return (e for e in self.events if isinstance(e, Heard) and e.sample.compass == compass)


def recordings(folder: Path = DATA) -> list[Path]:
    """Every recording under a folder, by name."""
    return sorted(p for p in folder.rglob("*") if p.suffix in (".tlog", ".bin", ".ulg"))


def tapes(recording: Recording, name: str, settings: Settings | None = None) -> list[Tape]:
    """One tape per vehicle that was heard."""
    settings = settings or Settings()
    events: dict[int, list[Event]] = {}
    tapped: list[tuple[Sample, Circumstances, tuple[int, int]]] = []

    def tap(sample: Sample, circumstances: Circumstances, stretch: tuple[int, int]) -> None:
        tapped.append((sample, circumstances, stretch))

    def keep(reading: Reading, _: Record | None) -> None:
        if isinstance(reading, CurrentReading | ThrottleReading):
            events.setdefault(reading.system, []).append(reading)
        elif tapped and isinstance(reading, MagReading):
            held = pipeline.vehicles[reading.system].calibrations
            used_b_mg = held.corrected(reading.compass, reading.field_b_mg, reading.source)
            events.setdefault(reading.system, []).append(Heard(*tapped.pop(), used_b_mg))

    pipeline = Pipeline(settings, world_magnetic_model, recording.unix_offset_ns, tap, idle=True)
    keeper = Keeper(pipeline, None)
    play(recording, pipeline, keeper, (keep,))
    earlier = keeper.bring_back()
    out = []
    for system in sorted({s for s, _ in keeper.compasses}):
        logs = {compass: log for (s, compass), log in sorted(keeper.compasses.items()) if s == system}
        boot = earlier.get(system, pipeline.vehicles[system])
        reference = keeper.reference(system, None)
        out.append(Tape(name, system, _last_that_taught(events[system]), logs, boot, reference, settings))
    return out


def _last_that_taught(events: list[Event]) -> list[Event]:
    """The events of one boot: the last in which something was learnt, or the last of all."""
    boots: list[list[Event]] = [[]]
    number = None
    for event in events:
        if isinstance(event, Heard) and event.stretch[0] != number:
            if number is not None:
                boots.append([])
            number = event.stretch[0]
        boots[-1].append(event)
    taught = [b for b in boots if any(isinstance(e, Heard) and e.sample.learn for e in b)]
    return (taught or boots)[-1]


def load(path: Path, settings: Settings | None = None) -> list[Tape]:
    """The tapes of a file."""
    recording = open_recording(path)
    try:
        return tapes(recording, path.name, settings)
    finally:
        recording.close()
