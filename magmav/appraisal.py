"""How good a calibration was over a recording: its history as columns, its scores, its entry in the result."""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magmav.boot import Boot
from magmav.core.correction import iron_at_throttle
from magmav.core.deviation import deviation_card
from magmav.core.published import noise_of_heading
from magmav.core.rotation import level_from_body
from magmav.core.smoothing import smooth
from magmav.core.types import ZERO3, Heading, Record, Sample, Shaping, State, Vec3, vec3
from magmav.reference import Reference
from magmav.score import Calibration, HeadingScore, Window, score_freeze, score_headings
from magmav.vehicle import Vehicle

Result = dict[str, Any]
Floats = NDArray[np.float64]


def _column(first: int, width: int = 1) -> property:
    """(N,), or (N, width), of CompassLog's rows."""

    def get(log: CompassLog) -> Floats:
        rows = np.array(log.rows).reshape(-1, _WIDTH)
        return rows[:, first] if width == 1 else rows[:, first : first + width]

    return property(get)


_WIDTH = 18
_NOTHING = (0.0,) * 3 + (math.nan,) * 2  # neither offsets nor headings


@dataclass(slots=True)
class CompassLog:
    """One compass since the vehicle's last boot, a row of numbers a sample: an hour of flight takes a few megabytes.

    sensor_b_mg is the sensor's own field with the undone motor term, offsets_b_mg what was to be stored. Headings are
    NaN where none was published; published_rad is magnetic, as smoothed for the wire. throttle is NaN where nobody
    says.
    """

    last: Record | None = None
    learnt: int = 0
    rows: array[float] = field(default_factory=lambda: array("d"))
    down_mg: float | None = None  # of a two-axis compass: the Earth's downward field that stood in for its third
    _motor: tuple[Shaping, tuple[float, float, float]] | None = None

    boot_s = _column(0)
    age_s = _column(1)
    sensor_b_mg = _column(2, 3)
    offsets_b_mg = _column(5, 3)
    magnetic_rad = _column(8)
    true_rad = _column(9)
    stored_magnetic_rad = _column(10)
    stored_true_rad = _column(11)
    declination_rad = _column(12)
    sigma_rad = _column(13)
    noise_rad = _column(14)
    throttle = _column(15)
    published_s = _column(16)
    published_rad = _column(17)

    def __len__(self) -> int:
        return len(self.rows) // _WIDTH

    def add(self, record: Record, shaping: Shaping) -> None:
        """Append one record and what the autopilot did to its value after the offsets."""
        heading, stored = record.heading, record.stored_heading
        self.last = record
        if record.axes == 2 and heading.valid:
            down = level_from_body(record.roll_rad, record.pitch_rad)[2]
            self.down_mg = float(down @ record.corrected_b_mg)
        self.learnt += record.learnt
        magnetic = true = published = math.nan
        if record.verdict.state is not State.NO_DATA:
            magnetic, true = _angles(heading)
            published = _angles(record.published)[0]
        stored_magnetic, stored_true = _angles(stored)
        self.rows.extend((
            record.boot_ns / 1e9,
            record.age_s,
            *self._sensor(record.mag_b_mg, shaping),
            *record.offsets_mg.tolist(),
            magnetic,
            true,
            stored_magnetic,
            stored_true,
            stored_true - stored_magnetic,
            heading.sigma_rad if heading.valid else math.nan,
            noise_of_heading(record.estimate, record.estimate.horizontal_mg),
            math.nan if record.throttle is None else record.throttle,
            record.published_boot_ns / 1e9,
            published,
        ))  # fmt: skip

    def see(self, s: Sample, stored: Heading) -> None:
        """Append a sample that nobody judged, with the heading of the stream as the autopilot corrects it."""
        self.learnt += s.learn
        magnetic, true = _angles(stored)
        boot_s, sensor = s.boot_ns / 1e9, self._sensor(s.mag_b_mg, s.shaping)
        throttle = math.nan if s.throttle is None else s.throttle
        told = (boot_s, s.age_s, *sensor, *_NOTHING, magnetic, true, true - magnetic)
        self.rows.extend((*told, math.nan, math.nan, throttle, boot_s, math.nan))

    def _sensor(self, mag_b_mg: Vec3, shaping: Shaping) -> tuple[float, float, float]:
        """With the motor term undone, worked out once for each shaping."""
        if self._motor is None or self._motor[0] is not shaping:
            x, y, z = np.linalg.solve(shaping.matrix, shaping.motor_b_mg).tolist()
            self._motor = shaping, (x, y, z)
        (x, y, z), (a, b, c) = mag_b_mg.tolist(), self._motor[1]
        return x + a, y + b, z + c


def _angles(heading: Heading) -> tuple[float, float]:
    magnetic = heading.magnetic_rad if heading.valid else math.nan
    return magnetic, heading.true_rad if heading.true_valid else math.nan


def describe(
    log: CompassLog,
    vehicle: Vehicle | Boot,
    reference: Reference | None,
    learn_for_s: float | None,
    smoothing: str = "off",
) -> Result:
    """One compass's entry in the result. Numbers that are not known are None. ValueError for an empty log."""
    last = log.last
    if last is None:
        raise ValueError("log: nothing was recorded of this compass")
    compass, known = last.compass, last.estimate.samples > 0
    absolute = known and not last.relative
    numbers = [round(float(v), 3) for v in last.offsets_mg]
    own = [round(float(v), 3) for v in last.estimate.own_sigma_mg]
    full, offsets_only = scores(log, vehicle, reference, learn_for_s)
    return {
        "compass": compass,
        "device_id": last.device_id or None,
        "offsets_mg": numbers if absolute else None,
        "offsets_change_mg": numbers if known and not absolute else None,
        "relative": last.relative,
        "stored": vehicle.calibrations.stored(compass),
        "hard_iron_mg": _known(_at_rest(log, vehicle), last) if absolute else None,
        "sigma_mg": [round(float(v), 3) for v in last.sigma_mg] if known else None,
        "sigma_by_motion_mg": own if known else None,
        "axes": [a.value for a in last.verdict.axes],
        "state": last.verdict.state.name,
        "reasons": [{"code": r.name, "text": r.text} for r in last.verdict.reasons],
        "causes": [cause.as_json() for cause in vehicle.causes.of(compass)],
        "deviation_card": card(last, vehicle) if known else None,
        "heading": full,
        "heading_offsets_only": offsets_only,
        "heading_smoothed": smoothed_scores(log, reference) if smoothing != "off" else None,
        "delay_s": round(last.estimate.delay_s, 4) if known else None,
        "field_residual_mg": round(last.estimate.residual_mg, 3) if known else None,
        "samples": len(log),
        "samples_learnt": log.learnt,
    }


def card(last: Record, vehicle: Vehicle | Boot) -> list[Result]:
    """Eight headings, N to NW: heading error in degrees with its sigma, as stored, with new offsets, with the model."""
    e, held = last.estimate, vehicle.calibrations
    stored = held.offsets(last.compass)
    floors = np.maximum(last.sigma_mg**2 - np.diag(e.covariance_mg2), 0.0)
    card = deviation_card(
        e,
        e.covariance_mg2 + np.diag(floors),
        held.shaping(last.compass).matrix,
        ZERO3 if stored is None else stored,
        last.offsets_mg,
    )
    rows: list[Result] = []
    for d in card:
        row: Result = {"heading": d.name, "heading_deg": round(math.degrees(d.heading_rad), 1)}
        for name, error in (("before", d.before), ("after", d.after), ("full", d.full)):
            row[f"{name}_deg"] = None if error is None else round(math.degrees(error.error_rad), 3) + 0.0
            row[f"{name}_sigma_deg"] = None if error is None else round(math.degrees(error.sigma_rad), 3)
        rows.append(row)
    return rows


def _at_rest(log: CompassLog, vehicle: Vehicle | Boot) -> Vec3:
    """The hard iron with the motors off, as far as the throttle says; where nobody says, at the power flown."""
    if log.last is None or not np.isfinite(log.throttle).any():
        return ZERO3 if log.last is None else log.last.estimate.hard_iron_b_mg
    matrix = vehicle.calibrations.shaping(log.last.compass).matrix
    return vec3(iron_at_throttle(log.last.estimate, matrix, np.zeros(1))[0], "hard iron")


def _known(vector: Vec3, last: Record) -> list[float | None]:
    """The vector's numbers, for the axes the method says anything about: not the third of a two-axis compass."""
    return [round(float(v), 3) if says else None for v, says in zip(vector, last.estimate.says_b, strict=True)]


def scores(
    log: CompassLog, vehicle: Vehicle | Boot, reference: Reference | None, learn_for_s: float | None
) -> tuple[Result | None, Result | None]:
    """Heading errors against the reference with everything known, and with what an upload of offsets would give.

    All are made on the same samples. (None, None) where there is nothing to compare with. Without any position the
    declination is not known; then magnetic headings are compared, and the reference's name says so.
    """
    if reference is None or log.last is None:
        return None, None
    declination = log.declination_rad
    magnetic = not np.isfinite(declination).any()
    if magnetic:
        reference = replace(reference, name=f"{reference.name}, taken as magnetic (declination not known)")
        declination = np.zeros(len(log))
    unknown = ~np.isfinite(declination)
    measured_s = log.boot_s - log.age_s
    sensor, offsets = log.sensor_b_mg, log.offsets_b_mg
    matrix = vehicle.calibrations.shaping(log.last.compass).matrix
    window, left_out = Window(), {"declination not known": unknown}
    if learn_for_s is not None:
        window = _after(vehicle, learn_for_s)
        offsets = log.last.offsets_mg
    else:
        left_out["no heading"] = ~np.isfinite(log.magnetic_rad if magnetic else log.true_rad)
    down = log.down_mg
    if log.last.axes == 2 and down is None:
        left_out["no heading"] = np.ones(len(log), dtype=bool)  # without a dip two axes have none
    e = log.last.estimate
    calibrations = {
        "full": Calibration(iron_at_throttle(e, matrix, log.throttle), e.soft_iron_b @ matrix, down),
        "offsets": Calibration(-offsets, matrix, down),
    }
    stored = vehicle.calibrations.offsets(log.last.compass)
    if stored is not None:
        calibrations["stored"] = Calibration(-stored, matrix, down)
    bare = Calibration(down_mg=down)
    declination = np.where(unknown, 0.0, declination)
    got = score_freeze(measured_s, sensor, calibrations, declination, reference, window, left_out, bare)
    if learn_for_s is None:
        live = log.magnetic_rad if magnetic else log.true_rad
        stream = log.stored_magnetic_rad if magnetic else log.stored_true_rad
        got |= score_headings(log.boot_s, {"full": live, "stored": stream}, reference)
    return _entry(got["full"], got, log), _entry(got["offsets"], got, log)


def smoothed_scores(log: CompassLog, reference: Reference | None) -> Result | None:
    """The heading of every sample as measured, as smoothed for the wire, and smoothed after the flight (RTS).

    Samples before the declination is known do not count, unless it never is. None where there is nothing to compare
    with.
    """
    if reference is None:
        return None
    boot_s, measured, noise = log.boot_s, log.magnetic_rad, log.noise_rad
    declination = log.declination_rad
    if not np.isfinite(declination).any():  # then magnetic is compared with magnetic, as in scores()
        declination = np.zeros(len(log))
    known = np.isfinite(measured)
    after = np.full(len(boot_s), math.nan)
    after[known] = [s.heading_rad for s in smooth(boot_s[known], measured[known], noise[known])]
    late = score_headings(log.published_s, {"live": log.published_rad + declination}, reference)
    got = score_headings(boot_s, {"measured": measured + declination, "rts": after + declination}, reference) | late
    return {
        name: {"rms_deg": s.rms_deg, "p95_deg": s.p95_deg, "bias_deg": s.bias_deg, "n": s.n} for name, s in got.items()
    }


def _after(vehicle: Vehicle | Boot, learn_for_s: float) -> Window:
    """The rest of the flight once the calibration is frozen."""
    started, crash = vehicle.started_ns(), vehicle.phase.crash_ns
    begin = math.inf if started is None else started / 1e9 + learn_for_s
    return Window(from_s=begin, crash_s=math.inf if crash is None else crash / 1e9)


def _entry(main: HeadingScore, got: dict[str, HeadingScore], log: CompassLog) -> Result:
    sigma = log.sigma_rad
    sigma = sigma[np.isfinite(sigma)]
    return {
        "reference": main.reference,
        "rms_deg": main.rms_deg,
        "p95_deg": main.p95_deg,
        "bias_deg": main.bias_deg,
        "uncalibrated_rms_deg": got["uncalibrated"].rms_deg,
        "uncalibrated_bias_deg": got["uncalibrated"].bias_deg,
        "stored_rms_deg": got["stored"].rms_deg if "stored" in got else None,
        "stored_bias_deg": got["stored"].bias_deg if "stored" in got else None,
        "sigma_deg": math.degrees(float(np.median(sigma))) if len(sigma) else None,
        "n": main.n,
        "from_s": main.from_s,
        "to_s": main.to_s,
        "excluded": main.excluded,
    }
