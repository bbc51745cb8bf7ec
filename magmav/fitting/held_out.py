"""How good the answer is: heading and field, before and after, on what it was learnt from and on what it was not."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from magmav.comparison import scored
from magmav.fitting.case import Case
from magmav.fitting.terms import Terms, power_of
from magmav.score import Calibration, HeadingScore, Window

Floats = NDArray[np.float64]
Result = dict[str, Any]


def calibration(case: Case, offsets_mg: Floats, terms: Terms | None = None) -> Calibration:
    """What is corrected with these offsets, to be added, and what these terms change of the rest."""
    down = case.columns.down_mg(case.estimate.horizontal_mg)
    if terms is None or not terms.shapes:
        return Calibration(-offsets_mg, case.matrix, down)
    iron: Floats = -offsets_mg
    if terms.of:
        added = np.linalg.solve(case.matrix, terms.per_unit_mg)
        iron = iron + power_of(case, terms.of)[:, None] * added
    return Calibration(iron, terms.bend @ case.matrix, down)


def corrected(case: Case, c: Calibration) -> Floats:
    """(N, 3) mG."""
    return np.asarray((case.columns.sensor_b_mg - np.asarray(c.hard_iron_b_mg)) @ np.asarray(c.matrix).T)


def headings(case: Case, before: Calibration, after: Calibration, half_mg: Floats | None) -> Result | None:
    """Scores against the named reference; None where there is none.

    half_mg : the offsets (3,) that the first half alone would have stored; None where it knew nothing.
    """
    e, down = case.estimate, before.down_mg
    full = Calibration(case.iron_b_mg, e.soft_iron_b @ case.matrix, down)
    ways = {"before": before, "after": after, "full": full}
    got, name = scored(case.columns, ways, case.told.reference, Window(crash_s=case.end_s))
    if name is None:
        return None
    out: Result = {"reference": name}
    out |= {way: score_of(got.get(way)) for way in ("before", "after", "full", "uncalibrated")}
    out["excluded"] = got["after"].excluded
    out["held_out"] = None
    if half_mg is not None:
        ways = {"before": before, "after": calibration(case, half_mg)}
        got, _ = scored(case.columns, ways, case.told.reference, Window(case.split_s, crash_s=case.end_s))
        how = f"offsets fitted on what came before {case.split_s:.1f} s, scored on what came after"
        out["held_out"] = {w: score_of(got.get(w)) for w in ("before", "after", "uncalibrated")} | {"how": how}
    return out


def score_of(s: HeadingScore | None) -> Result | None:
    """For a result."""
    if s is None:
        return None
    names = ("rms_deg", "p95_deg", "bias_deg", "n", "from_s", "to_s")
    return {n: round(v, 4) if isinstance(v := getattr(s, n), float) else v for n in names}


def residuals(case: Case, before: Calibration, after: Calibration, half_mg: Floats | None) -> Result:
    """RMS of what is left of the field against the world model, mG, level and downward part; no heading is in it."""
    taught, later, e = case.columns.learn, case.later, case.estimate
    out: Result = {"before": _rms(case.misfit(corrected(case, before), e)[taught])}
    out["after"] = _rms(case.misfit(corrected(case, after), e)[taught])
    out |= {"held_out_before": None, "held_out_after": None}
    first = case.known.foretold
    if first is not None and half_mg is not None:
        half = calibration(case, half_mg)
        out["held_out_before"] = _rms(case.misfit(corrected(case, before), first)[later])
        out["held_out_after"] = _rms(case.misfit(corrected(case, half), first)[later])
    return out


def _rms(values: Floats) -> float | None:
    return None if len(values) == 0 else round(float(np.sqrt(np.mean(values**2))), 3)
