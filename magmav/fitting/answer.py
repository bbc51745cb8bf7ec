"""What one compass's fit says: the ``fit`` part of its entry, and the entry's own numbers as of after the flight."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magmav.core.causes import Cause, Causes
from magmav.core.causes_fit import IRON
from magmav.core.deviation import deviation_card
from magmav.core.types import ZERO3, AxisState, State, Vec3, Verdict, vec3
from magmav.fitting import held_out, mounting, parameters, why
from magmav.fitting.case import Case
from magmav.fitting.series import coverage, rounded, series
from magmav.fitting.terms import Terms, mean_power, terms, unearned
from magmav.fitting.verdict import judged

if TYPE_CHECKING:
    from magmav.fitting import FitOptions

Floats = NDArray[np.float64]
Result = dict[str, Any]
_AUTOPILOTS = {3: "ardupilot", 12: "px4"}
_FLOOR_MG = np.array([1.5, 1.5, 5.5])  # as the estimator's own
_NO_WORSE = 1.25  # the reference itself follows some compass


def answer(
    entry: Result, case: Case, found: tuple[Cause, ...], finder: Causes, options: FitOptions
) -> dict[str, NDArray[Any]]:
    """Put the fit of one compass into its entry, and what the entry says of it as of after the flight.

    What it rests on as arrays, (N,) or (N, 3): see ``magmav.library.fit``.
    """
    held, compass = case.told.boot.calibrations, case.compass
    verdict, sigma = judged(case, finder)
    b = why.batch(case)
    t = terms(case, b, options.soft_iron, options.scale, options.motor)
    e, stored, relative = case.estimate, held.offsets(compass), not held.known(compass)
    iron, hard_iron = case.iron_to_store(e), _at_rest(case, b)
    if t.shapes and b is not None:
        whole = _one_set(case, b, t)
        t = _still_earned(case, t, iron, whole[0])
        iron, sigma = whole if t.shapes else (iron, sigma)
    write = tuple(a is not AxisState.NOT_OBSERVED or t.shapes for a in verdict.axes)
    base = ZERO3 if stored is None else stored
    offsets_mg = vec3(np.where(write, -iron, base), "offsets")
    before, after = held_out.calibration(case, base), held_out.calibration(case, offsets_mg, t)
    first = case.known.foretold
    half = None if first is None else np.where(write, -case.iron_to_store(first), base)
    heading = held_out.headings(case, before, after, half)
    deviation = _card(case, sigma, base, offsets_mg, t)
    causes = list(found)
    wrong = None
    if stored is not None and verdict.state is not State.REFUSED and not relative:
        wrong = _stored_wrong(case, base, offsets_mg, sigma, deviation, heading)
    if wrong is not None:
        causes.insert(0, wrong)
    new, closure = _parameters(case, verdict, iron, sigma, (write[0], write[1], write[2]), t, after)
    taught = case.columns.learn
    before_b, after_b = held_out.corrected(case, before), held_out.corrected(case, after)
    model = np.full(len(taught), np.nan if case.expected is None else case.expected.total_mg)
    ampere = case.ampere if np.isfinite(case.ampere).any() else None
    entry["fit"] = {
        "state": verdict.state.name,
        "reasons": [{"code": r.name, "text": r.text} for r in verdict.reasons],
        "causes": [c.as_json() for c in causes],
        "advice": why.advice(causes, b, relative, verdict.state is State.READY),
        "device_id": held.device_id(compass) or None,
        "relative": relative,
        "span_s": [round(float(case.columns.boot_s[taught][i]), 3) for i in (0, -1)],
        "cut": [s.as_json() for s in case.cuts],
        "old_offsets_mg": None if stored is None else rounded(stored, 3),
        "new_offsets_mg": None if relative else rounded(offsets_mg, 3),
        "change_mg": rounded(offsets_mg - base, 3),
        "sigma_mg": rounded(sigma, 3),
        "axes": [a.value for a in verdict.axes],
        "hard_iron_mg": rounded(hard_iron, 3),
        "hard_iron_at": "zero power" if b is not None and b.power_counts() else "average power",
        "soft_iron": t.soft,
        "motor": t.motor,
        "scale": t.scale,
        "changes_s": [round(ns / 1e9, 3) for ns in case.known.changes_ns],
        "parameters": {
            "autopilot": _AUTOPILOTS.get(case.told.autopilot),
            "old": dict(new.old),
            "new": dict(new.new),
            "changed": new.changed if verdict.state is State.READY else {},
            "closure_mg": closure,
        },
        "residual_mg": held_out.residuals(case, before, after, half),
        "heading": heading,
        "mounting": mounting.describe(causes, held, compass, case.told.parameters),
        "odd_one_out": any(c.code == "COMPASS_BAD" for c in causes),
        "deviation": deviation,
        "coverage": coverage(after_b[taught]),
        "series": series(
            case.columns, None if stored is None else before_b, after_b, case.known, case.told.reference, ampere, model
        ),
    }
    _rewrite(entry, verdict, offsets_mg, hard_iron, sigma, heading, relative)
    return {
        "boot_s": case.columns.boot_s,
        "sensor_b_mg": case.raw_b_mg,
        "before_b_mg": before_b,
        "after_b_mg": after_b,
        "hard_iron_b_mg": case.iron_b_mg,
        "roll_rad": case.columns.roll_rad,
        "pitch_rad": case.columns.pitch_rad,
        "taught": taught,
        "throttle": case.columns.throttle,
        "ampere": case.ampere,
    }


def _one_set(case: Case, b: why.Batch, t: Terms) -> tuple[Vec3, Vec3]:
    """Iron and its sigma from the fit that the other terms are from: it belongs to its matrix and its motor term."""
    f = b.whole
    left = f.iron_b_mg if t.of else f.iron_b_mg + f.power_b_mg * mean_power(case, b.power)
    sigma = np.hypot(np.sqrt(np.diag(f.covariance[IRON, IRON])), _FLOOR_MG)
    return vec3(np.linalg.solve(case.matrix, left), "hard iron"), vec3(sigma, "sigma")


def _still_earned(case: Case, t: Terms, alone: Vec3, together: Vec3) -> Terms:
    """Terms that make the heading worse than offsets alone have earned nothing."""
    one, other = held_out.calibration(case, -alone), held_out.calibration(case, -together, t)
    got = held_out.headings(case, one, other, None)
    if got is None or not got["before"]["n"] or got["after"]["rms_deg"] <= _NO_WORSE * got["before"]["rms_deg"]:
        return t
    figures = f"{got['after']['rms_deg']:.1f} degrees RMS instead of {got['before']['rms_deg']:.1f}"
    return unearned(t, f"heading against {got['reference']} gets worse with it: {figures}")


def _at_rest(case: Case, b: why.Batch | None) -> Vec3:
    """The hard iron at zero power where the flight shows what power does, else at average power."""
    e = case.estimate
    if b is None or not b.power_counts():
        return e.hard_iron_b_mg
    drawn = np.linalg.solve(case.matrix, b.whole.power_b_mg) * mean_power(case, b.power)
    return vec3(e.hard_iron_b_mg - drawn, "hard iron")


def _parameters(
    case: Case, verdict: Verdict, iron_b_mg: Vec3, sigma_mg: Vec3, write: tuple[bool, bool, bool], t: Terms, after: Any
) -> tuple[parameters.NewParameters, float | None]:
    """Old and new values, and by how much they miss the predicted field (AT-16b), mG."""
    held, c, compass = case.told.boot.calibrations, case.columns, case.compass
    if verdict.state is State.REFUSED:
        return parameters.NOTHING, None
    new = parameters.offsets(held, case.told.system, compass, iron_b_mg, sigma_mg, write)
    if new is parameters.NOTHING:
        return new, None
    if t.shapes:
        more = parameters.shaped(case, t)
        if more is None:
            return parameters.NOTHING, None
        new = parameters.both(new, more)
    values = {**held.stored(compass), **new.new}
    autopilot, device = case.told.autopilot, held.device_id(compass)
    made = parameters.as_the_autopilot_would(autopilot, compass, device, values, case.raw_b_mg, case.ampere, c.throttle)
    return new, round(float(np.abs(made - held_out.corrected(case, after))[c.learn].max()), 4)


def _stored_wrong(
    case: Case, base: Vec3, offsets_mg: Vec3, sigma: Vec3, deviation: list[Result], heading: Result | None
) -> Cause | None:
    worst = [abs(row["before_deg"]) for row in deviation if row["before_deg"] is not None]
    scores = [None, None]
    if heading is not None:
        scores = [heading[k]["rms_deg"] if heading[k] else None for k in ("before", "after")]
    name = None if heading is None else heading["reference"]
    return why.stored_wrong(base, offsets_mg - base, sigma, max(worst, default=0.0), scores[0], scores[1], name)


def _card(case: Case, sigma_mg: Vec3, stored: Vec3, new: Vec3, t: Terms) -> list[Result]:
    e = case.estimate
    floors = np.maximum(sigma_mg**2 - np.diag(e.covariance_mg2), 0.0)
    out = []
    for d in deviation_card(e, e.covariance_mg2 + np.diag(floors), case.matrix, stored, new):
        row: Result = {"heading_deg": round(math.degrees(d.heading_rad), 1)}
        for name, error in (("before", d.before), ("after", d.full if t.shapes else d.after)):
            row[f"{name}_deg"] = None if error is None else round(math.degrees(error.error_rad), 3) + 0.0
        row["sigma_deg"] = None if d.after is None else round(math.degrees(d.after.sigma_rad), 3)
        out.append(row)
    return out


def _rewrite(
    entry: Result, verdict: Verdict, offsets_mg: Vec3, hard_iron: Vec3, sigma: Vec3, heading: Result | None, rel: bool
) -> None:
    """The entry says what is known after the flight, by the names that a replay uses."""
    fit = entry["fit"]
    numbers = rounded(offsets_mg, 3)
    entry["offsets_mg"], entry["offsets_change_mg"] = (None, numbers) if rel else (numbers, None)
    entry["hard_iron_mg"] = None if rel else rounded(hard_iron, 3)
    entry["sigma_mg"], entry["axes"] = rounded(sigma, 3), list(fit["axes"])
    entry["state"], entry["reasons"], entry["causes"] = fit["state"], fit["reasons"], fit["causes"]
    entry["deviation_card"] = None  # fit["deviation"] has it
    for key, way in (("heading", "full"), ("heading_offsets_only", "after")):
        was = entry.get(key) or {}
        score = None if heading is None else heading[way]
        if heading is None or score is None:
            entry[key] = None
            continue
        plain, before = heading["uncalibrated"] or {}, heading["before"] or {}
        entry[key] = score | {
            "reference": heading["reference"],
            "uncalibrated_rms_deg": plain.get("rms_deg"),
            "stored_rms_deg": before.get("rms_deg") if fit["old_offsets_mg"] is not None else None,
            "sigma_deg": was.get("sigma_deg"),
            "excluded": heading["excluded"],
        }
