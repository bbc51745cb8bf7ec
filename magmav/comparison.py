"""Every estimator on one recording, side by side: fitted on the first half, scored on the second, and in-sample.

The recording goes through the pipeline once; the Samples it leads to are kept and given to each method in turn, so all
methods see the same values, the same tilt and the same moments that teach. Scores of one column are made on the
same samples. Beside the adaptive estimator stands what is known afterwards (core.after_flight).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from magmav.boot import Boot
from magmav.channels import new_channel
from magmav.core import gate
from magmav.core.after_flight import after_flight
from magmav.core.channel import Circumstances
from magmav.core.correction import iron_at_throttle
from magmav.core.dip import dip_from_model
from magmav.core.estimators import ESTIMATORS, Estimator
from magmav.core.field import ExpectedField
from magmav.core.two_axis import down_from_dip
from magmav.core.types import Estimate, FieldModel, Sample, Vec3
from magmav.logs import Recording
from magmav.pipeline import Pipeline
from magmav.recording import Keeper, NothingToLearnFrom, play
from magmav.reference import Reference
from magmav.score import Calibration, HeadingScore, Window, score_freeze
from magmav.settings import Settings
from magmav.vehicle import Vehicle

Floats = NDArray[np.float64]
Result = dict[str, Any]

SMOOTHED = "smoothed"
METHODS = [n for name in ESTIMATORS for n in ((name, SMOOTHED) if name == "adaptive" else (name,))]


class Heard(NamedTuple):
    """One Sample and what the vehicle contributed to its verdict."""

    sample: Sample
    circumstances: Circumstances


@dataclass(slots=True)
class Tape:
    """The Samples of one compass, of the last stretch corrected in one way that taught something."""

    heard: list[Heard] = field(default_factory=list)
    learnt: int = 0
    _stretch: tuple[int, int] | None = None
    _before: list[Heard] = field(default_factory=list)
    _before_learnt: int = 0

    def add(self, sample: Sample, circumstances: Circumstances, stretch: tuple[int, int]) -> None:
        """Take one; another stretch begins anew."""
        if stretch != self._stretch:
            if self.learnt:
                self._before, self._before_learnt = self.heard, self.learnt
            self.heard, self.learnt, self._stretch = [], 0, stretch
        self.heard.append(Heard(sample, circumstances))
        self.learnt += sample.learn

    def close(self) -> None:
        """At the end of the recording: where the last stretch taught nothing, the one before it counts."""
        if not self.learnt and self._before_learnt:
            self.heard, self.learnt = self._before, self._before_learnt


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """A tape as arrays, (N,) or (N, 3); sensor_b_mg has the motor term taken out."""

    boot_s: Floats
    sensor_b_mg: Floats
    roll_rad: Floats
    pitch_rad: Floats
    learn: NDArray[np.bool_]
    axes: int
    expected: ExpectedField | None  # at the end
    declination_rad: Floats  # NaN where no position was known
    throttle: Floats  # NaN where nobody says

    @classmethod
    def of(cls, heard: Sequence[Heard]) -> Columns:
        """The columns of a tape."""
        samples = [h.sample for h in heard]
        sensor = np.array([s.mag_b_mg for s in samples])
        motor = np.array([s.shaping.motor_b_mg for s in samples])
        if motor.any():
            matrix = np.array([s.shaping.matrix for s in samples])
            sensor = sensor + np.linalg.solve(matrix, motor[:, :, None])[:, :, 0]
        expected = [h.circumstances.expected for h in heard]
        return cls(
            np.array([s.boot_ns / 1e9 - s.age_s for s in samples]),
            sensor,
            np.array([s.roll_rad for s in samples]),
            np.array([s.pitch_rad for s in samples]),
            np.array([s.learn for s in samples], dtype=bool),
            samples[-1].axes,
            expected[-1],
            np.array([math.nan if e is None else e.declination_rad for e in expected]),
            np.array([math.nan if s.throttle is None else s.throttle for s in samples]),
        )

    def down_mg(self, radius_mg: float) -> float | None:
        """Of a two-axis compass: the downward field its third axis is reckoned from, as the service does it."""
        if self.axes == 3 or self.expected is None or self.expected.horizontal_mg <= 0.0 or radius_mg <= 0.0:
            return None
        return down_from_dip(radius_mg, dip_from_model(self.expected))


class _Timed:
    """An estimator that keeps its own bill. Satisfies Estimator."""

    def __init__(self, inner: Estimator, clock: Callable[[], float]) -> None:
        self.inner = inner
        self._clock = clock
        self.spent_s = 0.0

    def step(self, sample: Sample) -> None:
        """Pass on, and note how long it took."""
        begun = self._clock()
        self.inner.step(sample)
        self.spent_s += self._clock() - begun

    def estimate(self, expected: ExpectedField | None) -> Estimate | None:
        """Pass on."""
        return self.inner.estimate(expected)


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What one method made of a tape: after the first half, at the end, its cost, and the gate's word on it.

    state : None where it is known only afterwards, and no gate was asked.  path_b_mg : (N, 3) hard iron at each sample.
    """

    name: str
    half: Estimate | None
    whole: Estimate | None
    us_per_sample: float
    state: str | None
    reasons: tuple[str, ...]
    refusal: str | None
    weak: str | None = None
    has_sigma: bool = True
    path_b_mg: Floats | None = None


def try_smoothed(heard: Sequence[Heard], half: int, clock: Callable[[], float]) -> Outcome:
    """A tape with all of it known at once, and with its first half alone."""
    samples = [h.sample for h in heard]
    first, begun = after_flight(samples[:half]), clock()
    whole = after_flight(samples)
    us, half_answer = 1e6 * (clock() - begun) / len(heard), None if first is None else first.answer
    if whole is None:
        return Outcome(SMOOTHED, half_answer, None, us, None, (), "too little data")
    return Outcome(SMOOTHED, half_answer, whole.answer, us, None, (), None, path_b_mg=whole.iron_of(samples))


def try_estimator(
    name: str, heard: Sequence[Heard], half: int, settings: Settings, clock: Callable[[], float]
) -> Outcome:
    """One method over one tape. ``half``: index of the first sample that is not of the first half."""
    made: list[_Timed] = []

    def make() -> Estimator:
        made.append(_Timed(ESTIMATORS[name](), clock))
        return made[-1]

    channel = new_channel(settings, name, make)
    first: Estimate | None = None
    for index, (sample, circumstances) in enumerate(heard):
        if index == half:
            first = made[-1].estimate(circumstances.expected)
        channel.learn(sample, circumstances)
    timed = made[-1]
    whole = timed.estimate(heard[-1].circumstances.expected)
    why, why_weak = getattr(timed.inner, "why_not", None), getattr(timed.inner, "why_weak", None)
    return Outcome(
        name=name,
        half=first,
        whole=whole,
        us_per_sample=1e6 * timed.spent_s / len(heard),
        state=channel.verdict.state.name,
        reasons=tuple(r.name for r in channel.verdict.reasons),
        weak=None if whole is None or why_weak is None else why_weak(),
        refusal=None if whole is not None else (None if why is None else why()) or "too little data",
        has_sigma=bool(getattr(timed.inner, "has_sigma", True)),
    )


def compare(
    recording: Recording,
    settings: Settings,
    model: FieldModel,
    *,
    clock: Callable[[], float],
    source: str | None = None,
    reference_csvs: Sequence[Path] = (),
    reference_name: str | None = None,
    only: Sequence[str] = (),
    progress: Callable[[str], None] = lambda text: None,
    tapes: dict[tuple[int, int], Columns] | None = None,
) -> Result:
    """The document that ``magmav compare --json`` prints.

    clock : seconds, for the cost per sample.  only : names of METHODS; all when empty.
    reference_csvs : truth, one file per boot of the vehicle.  reference_name : what to call it in the result.
    tapes : filled with the points each compass was fitted to, for pictures.
    Raises ValueError for an unknown name, NothingToLearnFrom when no compass was heard, TruthError for a bad
    reference file.
    """
    names = list(only) or METHODS
    unknown = [n for n in names if n not in METHODS]
    if unknown:
        raise ValueError(f"no estimator called {unknown[0]!r}; there are {', '.join(METHODS)}")
    source = recording.name if source is None else source
    truths = [Reference.from_csv(path) for path in reference_csvs]
    if reference_name is not None:
        truths = [replace(truth, name=reference_name) for truth in truths]
    kept: dict[tuple[int, int], Tape] = {}

    def tap(sample: Sample, circumstances: Circumstances, stretch: tuple[int, int]) -> None:
        kept.setdefault((sample.system, sample.compass), Tape()).add(sample, circumstances, stretch)

    pipeline = Pipeline(settings, model, recording.unix_offset_ns, tap, idle=True)
    keeper = Keeper(pipeline, None)
    progress(f"{source}: reading")
    play(recording, pipeline, keeper)
    earlier = keeper.bring_back()
    if not kept:
        found = ", ".join(f"{n} {k}" for k, n in recording.heard.most_common(6)) or "no message at all"
        raise NothingToLearnFrom(f"{source}: no magnetometer data with a known tilt in it (found {found})")
    vehicles: dict[int, Result] = {}
    for (system, compass), tape in sorted(kept.items()):
        tape.close()
        vehicle = pipeline.vehicles[system]
        boot: Vehicle | Boot = earlier.get(system, vehicle)
        entry = vehicles.setdefault(
            system, {"system": system, "autopilot": vehicle.autopilot, "flights": [], "compasses": []}
        )
        entry["flights"] = [flight.as_seconds() for flight in boot.phase.flights]
        columns = Columns.of(tape.heard)
        if tapes is not None:
            tapes[system, compass] = columns
        boots = vehicle.assembler.reboots - (system in earlier)  # before the one that is judged
        reference = keeper.reference(system, truths[min(boots, len(truths) - 1)] if truths else None)
        settings_of = (settings, clock)
        outcomes: list[Outcome] = []
        half = first_half(columns)
        for name in names:
            progress(f"{source}: compass {compass}, {name}")
            if name == SMOOTHED:
                outcomes.append(try_smoothed(tape.heard, half, clock))
            else:
                outcomes.append(try_estimator(name, tape.heard, half, *settings_of))
        entry["compasses"].append(_compass(compass, tape, columns, half, outcomes, boot, reference))
    return {"source": source, "vehicles": list(vehicles.values())}


def first_half(columns: Columns) -> int:
    """Index of the first sample after half of the time that taught."""
    taught = np.flatnonzero(columns.learn)
    if len(taught) == 0:
        return len(columns.learn) // 2
    middle = 0.5 * (columns.boot_s[taught[0]] + columns.boot_s[taught[-1]])
    return int(np.searchsorted(columns.boot_s, middle, side="right"))


def _compass(
    compass: int,
    tape: Tape,
    columns: Columns,
    half: int,
    outcomes: Sequence[Outcome],
    boot: Vehicle | Boot,
    reference: Reference | None,
) -> Result:
    matrix = tape.heard[-1].sample.shaping.matrix
    stored = boot.calibrations.offsets(compass)
    split_s = float(columns.boot_s[min(half, len(columns.boot_s) - 1)])
    crash_ns = boot.phase.crash_ns
    crash_s = math.inf if crash_ns is None else crash_ns / 1e9
    second, name = scored(
        columns, _calibrations(outcomes, "half", columns, matrix, stored), reference, Window(split_s, crash_s=crash_s)
    )
    whole, _ = scored(
        columns, _calibrations(outcomes, "whole", columns, matrix, stored), reference, Window(crash_s=crash_s)
    )
    taught = columns.learn.nonzero()[0]
    rows = [_row(o, columns, matrix, second.get(o.name), whole.get(o.name)) for o in outcomes]
    return {
        "compass": compass,
        "device_id": boot.calibrations.device_id(compass) or None,
        "samples": len(columns.boot_s),
        "samples_learnt": tape.learnt,
        "learnt_from_s": float(columns.boot_s[taught[0]]) if len(taught) else None,
        "learnt_to_s": float(columns.boot_s[taught[-1]]) if len(taught) else None,
        "split_s": split_s,
        "reference": name,
        "uncalibrated": _both(second.get("uncalibrated"), whole.get("uncalibrated")),
        "stored": None
        if stored is None
        else {"offsets_mg": stored.tolist(), **_both(second.get("stored"), whole.get("stored"))},
        "estimators": rows,
    }  # fmt: skip


def _calibrations(
    outcomes: Iterable[Outcome], which: str, columns: Columns, matrix: Floats, stored: Vec3 | None
) -> dict[str, Calibration]:
    bare = _bare(columns)
    out = {} if stored is None else {"stored": Calibration(-stored, matrix, bare.down_mg)}
    for o in outcomes:
        e: Estimate | None = getattr(o, which)
        if e is not None:
            down = columns.down_mg(e.horizontal_mg)
            iron = iron_at_throttle(e, matrix, columns.throttle)
            out[o.name] = Calibration(iron, e.soft_iron_b @ matrix, down)
    return out


def _bare(columns: Columns) -> Calibration:
    """No calibration at all."""
    return Calibration(down_mg=None if columns.expected is None else columns.down_mg(columns.expected.horizontal_mg))


def scored(
    columns: Columns, calibrations: dict[str, Calibration], reference: Reference | None, window: Window
) -> tuple[dict[str, HeadingScore], str | None]:
    """Scores by name, and the reference's name; nothing where there is no reference."""
    if reference is None:
        return {}, None
    no_dip = columns.axes == 2 and columns.expected is None
    declination = columns.declination_rad
    unknown = ~np.isfinite(declination)
    if unknown.all():
        reference = replace(reference, name=f"{reference.name}, taken as magnetic (declination not known)")
        declination, unknown = np.zeros(len(declination)), np.zeros(len(declination), dtype=bool)
    got = score_freeze(
        columns.boot_s,
        columns.sensor_b_mg,
        calibrations,
        np.where(unknown, 0.0, declination),
        reference,
        window,
        {"declination not known": unknown, "no heading": np.full(len(unknown), no_dip)},
        _bare(columns),
    )
    return got, reference.name


def _row(
    o: Outcome, columns: Columns, matrix: Floats, second: HeadingScore | None, whole: HeadingScore | None
) -> Result:
    """One line of the table."""
    e = o.whole
    row: Result = {"name": o.name, "state": o.state, "reasons": list(o.reasons), "refusal": o.refusal}
    row |= {"us_per_sample": round(o.us_per_sample, 2), "samples": 0 if e is None else e.samples}
    row |= dict.fromkeys(("offsets_mg", "sigma_mg", "soft_iron", "residual_mg", "length_rms_mg"))
    row["half_offsets_mg"] = None if o.half is None else _said(-o.half.hard_iron_b_mg, o.half)
    row["weak"] = o.weak
    row |= _both(second, whole)
    if e is None:
        return row
    iron = iron_at_throttle(e, matrix, columns.throttle[columns.learn])
    corrected = (columns.sensor_b_mg[columns.learn] - iron) @ (e.soft_iron_b @ matrix).T
    length = np.linalg.norm(corrected, axis=1)
    row["offsets_mg"] = _said(-e.hard_iron_b_mg, e)
    row["sigma_mg"] = _said(gate.floored(e), e) if o.has_sigma else None
    row["soft_iron"] = None if np.array_equal(e.soft_iron_b, np.eye(3)) else e.soft_iron_b.round(4).tolist()
    row["residual_mg"] = round(e.residual_mg, 2)
    row["length_rms_mg"] = round(float(length.std()), 2) if len(length) and all(e.says_b) else None
    return row


def _said(vector: Vec3, e: Estimate) -> list[float | None]:
    """The numbers of the axes the method says anything about."""
    return [round(float(v), 2) if says else None for v, says in zip(vector, e.says_b, strict=True)]


def _both(second: HeadingScore | None, whole: HeadingScore | None) -> Result:
    def entry(score: HeadingScore | None) -> Result | None:
        return None if score is None else {k: v for k, v in asdict(score).items() if k != "reference"}

    return {"second_half": entry(second), "in_sample": entry(whole)}
