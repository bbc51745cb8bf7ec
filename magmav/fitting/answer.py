"""What one compass's fit says: the ``fit`` part of its entry, and the entry's own numbers as of after the flight."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magmav.comparison import Columns, Tape, first_half, scored
from magmav.core import gate
from magmav.core.after_flight import AfterFlight, after_flight
from magmav.core.correction import covariance_of_field, field_of, iron_of_offsets
from magmav.core.deviation import deviation_card
from magmav.core.excitation import Excitation
from magmav.core.heading import heading_sigma
from magmav.core.types import AxisState, Estimate, Sample, State, Vec3, Verdict, vec3
from magmav.fitting import cut, mounting, parameters
from magmav.fitting.series import coverage, rounded, series
from magmav.fitting.tape import Currents
from magmav.reference import Reference
from magmav.score import Calibration, HeadingScore, Window, magnetic_heading_rad
from magmav.settings import Settings
from magmav.vehicle import Boot, Vehicle, limits

if TYPE_CHECKING:
    from magmav.fitting import FitOptions

Floats = NDArray[np.float64]
Result = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Told:
    """What the recording says of a vehicle beside its Samples."""

    system: int
    autopilot: int
    boot: Vehicle | Boot
    reference: Reference | None
    currents: Currents | None
    settings: Settings


def answer(entry: Result, tape: Tape, told: Told, options: FitOptions) -> None:
    """Put the fit of one compass into its entry; None where nothing was learnt."""
    compass = entry["compass"]
    heard = tape.heard
    columns = Columns.of(heard)
    keep, cuts = cut.before_the_fit(columns, told.boot.phase)
    samples = _taught([h.sample for h in heard], keep)
    known = after_flight(samples)
    if known is None:
        return
    misfit = field_misfit(columns, known, samples)
    later, more = cut.near_ground(columns.boot_s, np.hypot(*misfit.T), keep, told.boot.phase)
    if more:
        keep, cuts = later, cut.merged(cuts, more)
        samples = _taught(samples, keep)
        known = after_flight(samples) or known
    columns = replace(columns, learn=keep)
    entry["fit"] = _fit(compass, columns, samples, known, tape, told, cuts, options, entry)


def _taught(samples: list[Sample], keep: NDArray[np.bool_]) -> list[Sample]:
    return [s if s.learn == bool(k) else replace(s, learn=bool(k)) for s, k in zip(samples, keep, strict=True)]


def field_misfit(c: Columns, known: AfterFlight, samples: list[Sample]) -> Floats:
    """(N, 2) mG: level and downward field of the corrected samples less what they should be. No heading is in it."""
    e, matrix = known.answer, samples[-1].shaping.matrix
    corrected = (c.sensor_b_mg - known.iron_of(samples)) @ (e.soft_iron_b @ matrix).T
    return misfit(c, corrected, e)


def misfit(c: Columns, corrected_b_mg: Floats, e: Estimate) -> Floats:
    """(N, 2) mG: level and downward part of these fields (N, 3) less the world model's, or the estimate's own."""
    level_mg, down_mg = field_of(e, c.expected)
    cr, sr, cp, sp = np.cos(c.roll_rad), np.sin(c.roll_rad), np.cos(c.pitch_rad), np.sin(c.pitch_rad)
    x, y, z = corrected_b_mg.T
    ahead, right = cp * x + sp * (sr * y + cr * z), cr * y - sr * z
    down = -sp * x + cp * (sr * y + cr * z)
    return np.column_stack([np.hypot(ahead, right) - level_mg, down - down_mg])


def _rms(values: Floats) -> float | None:
    return None if len(values) == 0 else round(float(np.sqrt(np.mean(values**2))), 3)


def _heading(score: HeadingScore | None) -> Result | None:
    return None if score is None else {"rms_deg": score.rms_deg, "p95_deg": score.p95_deg, "n": score.n}


def judged(
    columns: Columns, samples: list[Sample], known: AfterFlight, tape: Tape, told: Told, apart: float
) -> tuple[Verdict, Vec3]:
    """The gate's word on the answer, and its sigma."""
    e, last, c = known.answer, samples[-1], tape.heard[-1].circumstances
    sigma = gate.floored(e)
    horizontal, down = field_of(e, c.expected)
    covariance = covariance_of_field(last, e)
    corrected = (columns.sensor_b_mg - e.hard_iron_b_mg)[columns.learn] @ (e.soft_iron_b @ last.shaping.matrix).T
    roll, pitch = columns.roll_rad[columns.learn], columns.pitch_rad[columns.learn]
    seen = Excitation()
    for field, heading in zip(corrected, magnetic_heading_rad(corrected, roll, pitch), strict=True):
        seen.see(field, float(heading) % math.tau)
    off = misfit(replace(columns, roll_rad=roll, pitch_rad=pitch), corrected, e)
    level = float(np.mean(off[:, 0])) + horizontal if len(off) else 0.0
    stood = [t for t in known.boot_ns if known.boot_ns[-1] - t <= told.settings.gate.steady_s * 1e9]
    first = known.estimates[-len(stood)].hard_iron_b_mg
    states = gate.axis_states(e.own_sigma_mg, sigma, told.settings.gate.axis_sigma_mg)
    written = [True, True, states[2] is not AxisState.NOT_OBSERVED]
    evidence = gate.Evidence(
        estimate=e,
        expected=c.expected,
        sigma_mg=sigma,
        offsets_heading_sigma_rad=heading_sigma(covariance, horizontal, down, 0.0, 0.0, 0.0),
        field_mg=float(np.mean(np.linalg.norm(corrected, axis=1))) if len(corrected) else 0.0,
        level_mg=level,
        apart=apart,
        left_mg=0.0,
        steady=bool((np.abs(e.hard_iron_b_mg - first) <= 2.0 * sigma + 3.0)[written].all()),
        sectors=seen.sectors,
        frozen_s=c.frozen_s if last.learn else 0.0,
        has_attitude=last.tilt_from == "ATTITUDE",
        relative=c.relative,
        assumed=c.assumed,
        parameters_changed=c.parameters_changed,
        grounded=c.grounded,
        axes=last.axes,
    )
    verdict = gate.judge(evidence, limits(told.settings), State.LEARNING)
    reason = told.boot.calibrations.refuses(last.compass) or told.boot.causes.refuses(last.compass)
    if reason is not None:
        verdict = Verdict(State.REFUSED, verdict.axes, (reason, *verdict.reasons))
    return verdict, sigma


def _fit(
    compass: int,
    columns: Columns,
    samples: list[Sample],
    known: AfterFlight,
    tape: Tape,
    told: Told,
    cuts: list[cut.Span],
    options: FitOptions,
    entry: Result,
) -> Result:
    e, held, last = known.answer, told.boot.calibrations, samples[-1]
    matrix, expected = last.shaping.matrix, tape.heard[-1].circumstances.expected
    verdict, sigma = judged(columns, samples, known, tape, told, 0.0)
    iron = iron_of_offsets(last, e, expected)
    stored, relative = held.offsets(compass), not held.known(compass)
    write = tuple(a is not AxisState.NOT_OBSERVED for a in verdict.axes)
    new = parameters.offsets(held, told.system, compass, iron, sigma, (write[0], write[1], write[2]))
    if verdict.state is State.REFUSED:
        new = parameters.NOTHING
    base = np.zeros(3) if stored is None else stored
    offsets_mg = vec3(np.where(write, -iron, base), "offsets")
    down = columns.down_mg(e.horizontal_mg)
    half = first_half(columns)
    split_s = float(columns.boot_s[min(half, len(columns.boot_s) - 1)])
    first = after_flight(samples[:half])
    end_s = min((s.from_s for s in cuts if s.code in ("TUMBLE", "CRASHED")), default=math.inf)
    ways = {"before": Calibration(-base, matrix, down), "after": Calibration(-offsets_mg, matrix, down)}
    ways["path"] = Calibration(known.iron_of(samples), e.soft_iron_b @ matrix, down)
    scores, name = scored(columns, ways, told.reference, Window(crash_s=end_s))
    held_out: Result | None = None
    residuals: Result = {"before": None, "after": None, "held_out_before": None, "held_out_after": None}
    taught = columns.learn
    later = taught & (columns.boot_s >= split_s)
    before_b = (columns.sensor_b_mg + base) @ matrix.T
    after_b = (columns.sensor_b_mg + offsets_mg) @ matrix.T
    residuals["before"] = _rms(misfit(columns, before_b, e)[taught])
    residuals["after"] = _rms(misfit(columns, after_b, e)[taught])
    if first is not None:
        iron_half = iron_of_offsets(last, first.answer, expected)
        half_b = (columns.sensor_b_mg - iron_half) @ matrix.T
        residuals["held_out_before"] = _rms(misfit(columns, before_b, first.answer)[later])
        residuals["held_out_after"] = _rms(misfit(columns, half_b, first.answer)[later])
        ways = {"before": Calibration(-base, matrix, down), "after": Calibration(iron_half, matrix, down)}
        got, _ = scored(columns, ways, told.reference, Window(split_s, crash_s=end_s))
        if got:
            how = f"fitted on what was flown before {split_s:.1f} s, scored on what came after"
            held_out = {"before": _heading(got.get("before")), "after": _heading(got.get("after")), "how": how}
    known_field = expected is not None
    model_mg = np.full(len(columns.boot_s), expected.total_mg if expected is not None and known_field else np.nan)
    ampere = None if told.currents is None else told.currents.at(columns.boot_s)
    causes = told.boot.causes.of(compass)
    return {
        "state": verdict.state.name,
        "reasons": [{"code": r.name, "text": r.text} for r in verdict.reasons],
        "causes": [c.as_json() for c in causes],
        "advice": [],
        "device_id": held.device_id(compass) or None,
        "relative": relative,
        "span_s": [float(columns.boot_s[taught][0]), float(columns.boot_s[taught][-1])],
        "cut": [s.as_json() for s in cuts],
        "old_offsets_mg": None if stored is None else rounded(stored, 3),
        "new_offsets_mg": None if relative else rounded(offsets_mg, 3),
        "change_mg": rounded(offsets_mg - base, 3),
        "sigma_mg": rounded(sigma, 3),
        "axes": [a.value for a in verdict.axes],
        "hard_iron_mg": rounded(e.hard_iron_b_mg, 3),
        "soft_iron": None,
        "motor": None,
        "scale": None,
        "parameters": {
            "autopilot": {3: "ardupilot", 12: "px4"}.get(told.autopilot),
            "old": dict(new.old),
            "new": dict(new.new),
            "changed": new.changed,
        },
        "residual_mg": residuals,
        "heading": None
        if name is None
        else {
            "reference": name,
            "before": _heading(scores.get("before")),
            "after": _heading(scores.get("after")),
            "path": _heading(scores.get("path")),
            "uncalibrated": _heading(scores.get("uncalibrated")),
            "held_out": held_out,
        },
        "mounting": mounting.describe(causes, held, compass),
        "odd_one_out": any(c.code == "COMPASS_BAD" for c in causes),
        "deviation": _card(e, sigma, matrix, base, offsets_mg),
        "coverage": coverage(after_b[taught]),
        "series": series(
            columns, None if stored is None else before_b, after_b, known, told.reference, ampere, model_mg
        ),
    }


def _card(e: Estimate, sigma_mg: Vec3, matrix: Floats, stored: Floats, new: Vec3) -> list[Result]:
    floors = np.maximum(sigma_mg**2 - np.diag(e.covariance_mg2), 0.0)
    rows = deviation_card(e, e.covariance_mg2 + np.diag(floors), matrix, stored, new)
    out = []
    for d in rows:
        row: Result = {"heading_deg": round(math.degrees(d.heading_rad), 1)}
        for name, error in (("before", d.before), ("after", d.after)):
            row[f"{name}_deg"] = None if error is None else round(math.degrees(error.error_rad), 3) + 0.0
        row["sigma_deg"] = None if d.after is None else round(math.degrees(d.after.sigma_rad), 3)
        out.append(row)
    return out
