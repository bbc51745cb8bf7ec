"""A recording through the same pipeline: what the service would have known, and how good it was.

A .tlog holds a link's bytes and is heard as one; a DataFlash log or a ULog holds readings and skips that storey. From
the reading on everything is the path that flies.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from magmav.appraisal import CompassLog, describe
from magmav.boot import Boot
from magmav.core.correction import stored_heading
from magmav.core.motion_run import MotionRun
from magmav.core.phase import Phase
from magmav.core.types import AttitudeReading, FieldModel, MagReading, Reading, Record
from magmav.hearing import LinkRecording
from magmav.kept_attitudes import KeptAttitudes
from magmav.link.tlog import TlogLink
from magmav.logs import HEAD, LogError, Progress, Recording, kind_of
from magmav.pipeline import Pipeline
from magmav.reference import Reference
from magmav.service import Watcher, all_counts, hand_on
from magmav.settings import Settings
from magmav.tlog_recording import MOST_BYTES, TlogRecording
from magmav.vehicle import Tap, Vehicle

Result = dict[str, Any]


def open_recording(path: str | Path, progress: Progress | None = None) -> Recording:
    """A .tlog, .bin, .log or .ulg, told apart by what is in it, not by its name.

    LinkError or LogError naming the file, what is wrong with it, and what to do.
    """
    path = Path(path)
    kind = kind_of(_front(path))
    if kind == "ulog":
        from magmav.logs.ulog import UlogRecording

        return UlogRecording(path, progress)
    if kind is not None:
        from magmav.logs.dataflash_readings import DataflashRecording

        return DataflashRecording(path, progress)
    if path.is_file() and 0 < path.stat().st_size <= MOST_BYTES:
        return TlogRecording(path, progress)
    return LinkRecording(TlogLink(path, progress))


def _front(path: Path) -> bytes:
    """The file's first bytes, or none where TlogLink will say better what is wrong."""
    try:
        if path.is_dir():
            raise LogError(f"{path}: is a directory; give the .tlog, .bin, .log or .ulg file in it")
        if not path.is_file():
            return b""
        with path.open("rb") as file:
            return file.read(HEAD)
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from error


class NothingToLearnFrom(Exception):
    """A recording without the messages that are needed; the text says which and what was found instead."""


_Past = tuple[dict[tuple[int, int], CompassLog], KeptAttitudes, Boot | None]
"""One boot: per compass, the attitudes, and what the vehicle held."""


class Keeper:
    """Watches a run and keeps what a score needs."""

    def __init__(self, pipeline: Pipeline, learn_for_s: float | None) -> None:
        self._pipeline = pipeline
        self._learn_for_s = learn_for_s
        self.compasses: dict[tuple[int, int], CompassLog] = {}
        self._attitudes: dict[int, KeptAttitudes] = {}
        self._reboots: dict[int, int] = {}
        self._past: dict[int, _Past] = {}

    def __call__(self, reading: Reading, record: Record | None) -> None:
        """Take one reading and the Record it led to."""
        system = reading.system
        vehicle = self._pipeline.vehicles[system]
        vehicle.learn_for_s = self._learn_for_s
        if vehicle.assembler.reboots != self._reboots.get(system, 0):
            self._reboots[system] = vehicle.assembler.reboots
            self._put_away(system, vehicle.former)
        if isinstance(reading, AttitudeReading):
            self._attitude(reading, vehicle)
        elif isinstance(reading, MagReading) and (record is not None or vehicle.unjudged is not None):
            self._mag(reading, record, vehicle)

    def run(self, run: MotionRun) -> None:
        """Take many attitudes that went through the pipeline at once."""
        vehicle = self._pipeline.vehicles[run.system]
        vehicle.learn_for_s = self._learn_for_s
        kept = self._attitudes.setdefault(run.system, KeptAttitudes())
        if not kept.wants(run.attitudes.source, run.first_ns):
            for i in range(run.begin, run.end):
                self._attitude(run.attitudes.reading(i, run.system), vehicle)
            return
        phase = vehicle.phase
        aloft = phase.aloft_at(run.attitudes.boot_ns[run.begin : run.end])
        change = run.begin + aloft.index(aloft[-1])  # time alone takes it up once, never down
        for begin, end, up in ((run.begin, change, aloft[0]), (change, run.end, aloft[-1])):
            if begin < end:
                kept.add_rows(run.attitudes, begin, end, *_flags(phase, up))

    def _attitude(self, r: AttitudeReading, vehicle: Vehicle) -> None:
        kept = self._attitudes.setdefault(r.system, KeptAttitudes())
        if kept.wants(r.source, r.boot_ns):
            kept.add(r, *_flags(vehicle.phase, vehicle.phase.aloft(r.boot_ns)))

    def _mag(self, r: MagReading, record: Record | None, vehicle: Vehicle) -> None:
        key = r.system, r.compass
        log = self.compasses.get(key)
        if log is None:
            log = self.compasses[key] = CompassLog()
        if vehicle.unjudged is not None:
            sample, circumstances = vehicle.unjudged
            log.last = record or log.last
            sent_b_mg = vehicle.calibrations.corrected(r.compass, r.field_b_mg, r.source)
            log.see(sample, stored_heading(sample, sent_b_mg, circumstances.expected))
        elif record is not None:
            log.add(record, vehicle.calibrations.standing(r.compass).shaping)

    def _put_away(self, system: int, boot: Boot | None) -> None:
        """The vehicle rebooted: boot times begin again. A boot that taught something is kept until another one does."""
        logs = {key: self.compasses.pop(key) for key in [k for k in self.compasses if k[0] == system]}
        past = (logs, self._attitudes.pop(system, KeptAttitudes()), boot)
        if boot is not None and any(log.learnt for log in logs.values()):
            self._past[system] = past

    def bring_back(self) -> dict[int, Boot]:
        """At the end: where the last boot taught nothing, the last one that did. Systems it was done for."""
        out = {}
        for system, (logs, attitudes, boot) in self._past.items():
            if boot is None or any(log.learnt for key, log in self.compasses.items() if key[0] == system):
                continue
            for key in [k for k in self.compasses if k[0] == system]:
                del self.compasses[key]
            self.compasses |= logs
            self._attitudes[system], out[system] = attitudes, boot
        return out

    def reference(self, system: int, truth: Reference | None) -> Reference | None:
        """The truth file, or else the vehicle's own attitude over time; with the vehicle's phases of flight."""
        kept = self._attitudes.get(system, KeptAttitudes())
        table = kept.table()
        boot_ns, roll, pitch, yaw = table[:, :4].T
        flags = table[:, 4:] > 0.0
        reference = truth
        if reference is None and len(table):
            reference = Reference.from_columns(boot_ns, roll, pitch, yaw, f"{kept.source} yaw")
        if reference is None or flags.all():
            return reference
        return reference.with_flags(boot_ns / 1e9, flags[:, 0], flags[:, 1])


def _flags(phase: Phase, aloft: bool) -> tuple[bool, bool]:
    """Armed and airborne; both where it is not known to fly."""
    return (phase.armed, aloft and phase.crash_ns is None) if phase.flyer else (True, True)


def replay(
    recording: Recording,
    settings: Settings,
    model: FieldModel,
    *,
    source: str | None = None,
    learn_for_s: float | None = None,
    reference_csv: Path | None = None,
    watchers: Sequence[Watcher] = (),
    references: dict[int, Reference] | None = None,
    stop: Callable[[], bool] = lambda: False,
    tap: Tap | None = None,
    boots: dict[int, Vehicle | Boot] | None = None,
    idle: bool = False,
) -> Result:
    """Run a recording to its end; the result is the JSON document that ``magmav replay --json`` prints.

    references : filled with what each system was scored against, for pictures.  tap : see vehicle.Tap.
    boots : filled with each system's boot that the result is about.  idle : see Pipeline.
    Raises NothingToLearnFrom when no compass was heard, TruthError for a bad reference file.
    """
    truth = None if reference_csv is None else Reference.from_csv(reference_csv)
    source = recording.name if source is None else source
    pipeline = Pipeline(settings, model, recording.unix_offset_ns, tap, idle)
    keeper = Keeper(pipeline, learn_for_s)
    play(recording, pipeline, keeper, watchers, stop)
    earlier = keeper.bring_back()
    if not keeper.compasses:
        found = ", ".join(f"{n} {k}" for k, n in recording.heard.most_common(6)) or "no message at all"
        raise NothingToLearnFrom(
            f"{source}: no magnetometer data with a known tilt in it (found {found}); "
            "record RAW_IMU or SCALED_IMU together with ATTITUDE (.tlog), MAG with ATT and IMU (.bin), "
            "or sensor_mag with vehicle_attitude (.ulg)"
        )
    vehicles = []
    for system in sorted({s for s, _ in keeper.compasses}):
        vehicle = pipeline.vehicles[system]
        reference = keeper.reference(system, truth)
        if references is not None and reference is not None:
            references[system] = reference
        boot = earlier.get(system, vehicle)
        if boots is not None:
            boots[system] = boot
        compasses = [
            describe(log, boot, reference, learn_for_s, settings.heading.smooth)
            for (s, _), log in sorted(keeper.compasses.items())
            if s == system
        ]
        facts = {"system": system, "autopilot": vehicle.autopilot, "reboots": vehicle.assembler.reboots}
        flights = [flight.as_seconds() for flight in boot.phase.flights]
        vehicles.append(facts | {"flights": flights, "compasses": compasses})
    counts = all_counts(_storeys(recording), pipeline)
    return {"source": source, "learn_for_s": learn_for_s, "vehicles": vehicles, "counts": counts}


def play(
    recording: Recording,
    pipeline: Pipeline,
    keeper: Keeper,
    watchers: Sequence[Watcher] = (),
    stop: Callable[[], bool] = lambda: False,
) -> None:
    """Every reading through the pipeline, until the end or until ``stop`` says so.

    Where the recording can, attitudes go through the pipeline many at once. Watchers see them after that, one by one;
    those of an idle pipeline do not see them.
    """
    watching: tuple[Watcher, ...] = (keeper, *watchers)
    attitudes_seen_by = () if pipeline.idle else watchers
    for t_ns, reading in recording.in_runs():
        if not isinstance(reading, MotionRun):
            hand_on(reading, t_ns, pipeline, watching)
        elif pipeline.run(reading):
            keeper.run(reading)
            for watch in attitudes_seen_by:
                for _, one in reading.one_by_one():
                    watch(one, None)
        else:
            for one_ns, one in reading.one_by_one():
                hand_on(one, one_ns, pipeline, watching)
        if stop():
            return


def _storeys(recording: Recording) -> dict[str, dict[str, int]]:
    if isinstance(recording, LinkRecording | TlogRecording):
        return recording.by_storey()
    return {"log": dict(recording.counts)}
