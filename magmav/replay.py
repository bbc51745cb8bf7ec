"""A recording through the same pipeline: what the service would have known, and how good it was."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from magmav.core.types import ZERO3, AttitudeReading, FieldModel, Heading, Reading, Record, State
from magmav.link import Link
from magmav.pipeline import Pipeline
from magmav.reference import Reference
from magmav.score import Calibration, HeadingScore, Window, score_freeze, score_headings
from magmav.service import Service, Watcher
from magmav.settings import Settings
from magmav.vehicle import Vehicle

Result = dict[str, Any]


class NothingToLearnFrom(Exception):
    """A recording without the messages that are needed; the text says which and what was found instead."""


@dataclass(slots=True)
class _CompassLog:
    """One compass since the vehicle's last boot."""

    records: list[Record] = field(default_factory=list)
    shaped: list[np.ndarray[Any, Any]] = field(default_factory=list)  # sensor's field plus undone motor term
    declination_rad: list[float] = field(default_factory=list)


class Keeper:
    """Watches a run and keeps what a score needs."""

    def __init__(self, pipeline: Pipeline, learn_for_s: float | None) -> None:
        self._pipeline = pipeline
        self._learn_for_s = learn_for_s
        self.compasses: dict[tuple[int, int], _CompassLog] = {}
        self.attitudes: dict[int, list[AttitudeReading]] = {}
        self.flags: dict[int, list[tuple[bool, bool]]] = {}
        self._reboots: dict[int, int] = {}

    def __call__(self, reading: Reading, record: Record | None) -> None:
        """Take one reading and the Record it led to."""
        vehicle = self._pipeline.vehicles[reading.system]
        vehicle.learn_for_s = self._learn_for_s
        if vehicle.assembler.reboots != self._reboots.setdefault(reading.system, 0):
            self._forget(reading.system, vehicle.assembler.reboots)
        if isinstance(reading, AttitudeReading):
            self._attitude(reading, vehicle)
        elif record is not None:
            self._record(record, vehicle)

    def _attitude(self, r: AttitudeReading, vehicle: Vehicle) -> None:
        kept = self.attitudes.setdefault(r.system, [])
        if kept and (r.source != kept[0].source or r.boot_ns <= kept[-1].boot_ns):
            return
        kept.append(r)
        flags = (vehicle.phase.armed, vehicle.phase.aloft(r.boot_ns))
        self.flags.setdefault(r.system, []).append(flags if vehicle.phase.flyer else (True, True))

    def _record(self, record: Record, vehicle: Vehicle) -> None:
        log = self.compasses.setdefault((record.system, record.compass), _CompassLog())
        shaping = vehicle.calibrations.shaping(record.compass)
        motor = np.linalg.solve(shaping.matrix, shaping.motor_b_mg) if shaping.motor_b_mg.any() else ZERO3
        heading = record.stored_heading
        log.records.append(record)
        log.shaped.append(record.mag_b_mg + motor)
        log.declination_rad.append(heading.true_rad - heading.magnetic_rad if heading.true_valid else math.nan)

    def _forget(self, system: int, reboots: int) -> None:
        self._reboots[system] = reboots
        self.attitudes.pop(system, None)
        self.flags.pop(system, None)
        for key in [k for k in self.compasses if k[0] == system]:
            del self.compasses[key]

    def reference(self, system: int, truth: Reference | None) -> Reference | None:
        """The truth file, or else the vehicle's own attitude over time; with the vehicle's phases of flight."""
        kept = self.attitudes.get(system, [])
        reference = truth
        if reference is None and kept:
            reference = Reference.from_attitude(kept, f"{kept[0].source} yaw")
        flags = np.array(self.flags.get(system, []), dtype=bool)
        if reference is None or flags.all():
            return reference
        times = [r.boot_ns / 1e9 for r in kept]
        return reference.with_flags(times, flags[:, 0], flags[:, 1])


def replay(
    link: Link,
    settings: Settings,
    model: FieldModel,
    *,
    source: str,
    learn_for_s: float | None = None,
    reference_csv: Path | None = None,
    watchers: Sequence[Watcher] = (),
    references: dict[int, Reference] | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Result:
    """Run a recording to its end; the result is the JSON document that ``magmav replay --json`` prints.

    references : filled with what each system was scored against, for pictures.
    Raises NothingToLearnFrom when no compass was heard, TruthError for a bad reference file.
    """
    truth = None if reference_csv is None else Reference.from_csv(reference_csv)
    pipeline = Pipeline(settings, model, link.unix_offset_ns)
    keeper = Keeper(pipeline, learn_for_s)
    service = Service(link, pipeline, watchers=(keeper, *watchers))
    service.run(stop)
    if not keeper.compasses:
        found = ", ".join(f"{n} {k}" for k, n in service.heard.most_common(6)) or "no message at all"
        raise NothingToLearnFrom(
            f"{source}: no magnetometer data with a known tilt in it (found {found}); "
            "record RAW_IMU or SCALED_IMU together with ATTITUDE"
        )
    vehicles = []
    for system in sorted({s for s, _ in keeper.compasses}):
        vehicle = pipeline.vehicles[system]
        reference = keeper.reference(system, truth)
        if references is not None and reference is not None:
            references[system] = reference
        compasses = [
            describe(log, vehicle, reference, learn_for_s)
            for (s, _), log in sorted(keeper.compasses.items())
            if s == system
        ]
        vehicles.append({"system": system, "autopilot": vehicle.autopilot, "compasses": compasses})
    return {"source": source, "learn_for_s": learn_for_s, "vehicles": vehicles, "counts": service.counts()}


def describe(log: _CompassLog, vehicle: Vehicle, reference: Reference | None, learn_for_s: float | None) -> Result:
    """One compass's entry in the result. Numbers that are not known are None."""
    last = log.records[-1]
    compass, known = last.compass, last.estimate.samples > 0
    absolute = known and vehicle.calibrations.known(compass)
    numbers = [round(float(v), 3) for v in last.offsets_mg]
    own = [round(float(v), 3) for v in last.estimate.own_sigma_mg]
    score = scores(log, vehicle, reference, learn_for_s)
    return {
        "compass": compass,
        "device_id": last.device_id or None,
        "offsets_mg": numbers if absolute else None,
        "offsets_change_mg": numbers if known and not absolute else None,
        "relative": not vehicle.calibrations.known(compass),
        "stored": vehicle.calibrations.stored(compass),
        "hard_iron_mg": [-v + 0.0 for v in numbers] if absolute else None,
        "sigma_mg": [round(float(v), 3) for v in last.sigma_mg] if known else None,
        "sigma_by_motion_mg": own if known else None,
        "axes": [a.value for a in last.verdict.axes],
        "state": last.verdict.state.name,
        "reasons": [{"code": r.name, "text": r.text} for r in last.verdict.reasons],
        "heading": score,
        "heading_offsets_only": score,
        "field_residual_mg": round(last.estimate.residual_mg, 3) if known else None,
        "samples": len(log.records),
        "samples_learnt": sum(r.learnt for r in log.records),
    }


def scores(log: _CompassLog, vehicle: Vehicle, reference: Reference | None, learn_for_s: float | None) -> Result | None:
    """Heading errors against the reference, on the same samples for all; None where there is none to compare with."""
    declination = np.array(log.declination_rad)
    if reference is None:
        return None
    magnetic = not np.isfinite(declination).any()
    if magnetic:
        reference = replace(reference, name=f"{reference.name}, taken as magnetic (declination not known)")
    boot_s = np.array([r.boot_ns for r in log.records]) / 1e9
    started = vehicle.started_ns()
    if learn_for_s is None:
        got = _live(log, boot_s, reference, magnetic)
    else:
        begin = math.inf if started is None else started / 1e9 + learn_for_s
        crash = math.inf if vehicle.phase.crash_ns is None else vehicle.phase.crash_ns / 1e9
        matrix = vehicle.calibrations.shaping(log.records[-1].compass).matrix
        calibrations = {"frozen": Calibration(log.records[-1].estimate.hard_iron_b_mg, matrix)}
        stored = vehicle.calibrations.offsets(log.records[-1].compass)
        if stored is not None:
            calibrations["stored"] = Calibration(-stored, matrix)
        window = Window(from_s=begin, crash_s=crash)
        shaped = np.array(log.shaped)
        measured_s = boot_s - np.array([r.age_s for r in log.records])
        got = score_freeze(measured_s, shaped, calibrations, np.nan_to_num(declination), reference, window)
    main = got.get("frozen") or got["live"]
    sigma = [math.degrees(r.heading.sigma_rad) for r in log.records if r.heading.valid]
    return {
        "reference": main.reference,
        "rms_deg": main.rms_deg,
        "p95_deg": main.p95_deg,
        "bias_deg": main.bias_deg,
        "uncalibrated_rms_deg": got["uncalibrated"].rms_deg,
        "stored_rms_deg": got["stored"].rms_deg if "stored" in got else None,
        "sigma_deg": float(np.median(sigma)) if sigma else None,
        "n": main.n,
        "from_s": main.from_s,
        "to_s": main.to_s,
        "excluded": main.excluded,
    }


def _live(
    log: _CompassLog, boot_s: np.ndarray[Any, Any], reference: Reference, magnetic: bool
) -> dict[str, HeadingScore]:
    """What would have been published, sample by sample, against what the vehicle streams and the bare sensor."""

    def told(h: Heading) -> float:
        if magnetic:
            return h.magnetic_rad if h.valid else math.nan
        return h.true_rad if h.true_valid else math.nan

    live = [told(r.heading) for r in log.records]
    stored = [told(r.stored_heading) for r in log.records]
    started = [r.verdict.state is not State.NO_DATA for r in log.records]
    got = score_headings(boot_s, {"live": live, "stored": stored}, reference, leave_out={"no data": ~np.array(started)})
    bare = score_freeze(
        boot_s - np.array([r.age_s for r in log.records]),
        np.array(log.shaped),
        {},
        np.nan_to_num(np.array(log.declination_rad)),
        reference,
        leave_out={"no heading": ~np.isfinite(live)},
    )
    return got | bare
