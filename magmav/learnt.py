"""What each flight taught, remembered; and in its shadow: what would have been, had it been applied.

Nothing here is ever written to a vehicle.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from magmav.appraisal import card
from magmav.core.types import Change, Record, State
from magmav.mavlink.uid import key, may_be_same
from magmav.store import Learnt
from magmav.vehicle import Vehicle

Result = dict[str, Any]
_KNOWN = ("OBSERVED", "FROM_MODEL")
_APPLIED_MG = 0.5  # stored offsets this close to what was learnt are what was learnt


def learnt_of_entry(entry: Mapping[str, Any]) -> list[Learnt]:
    """One row for each compass that a fit says something about. entry : of ``magmav fit``."""
    file, out = entry["file"], []
    began_s = file.get("began_unix_s")
    for vehicle in entry["vehicles"]:
        for compass in vehicle["compasses"]:
            fit = compass.get("fit")
            if fit is None:
                continue
            heading = fit.get("heading")
            scores = None
            if heading is not None:
                rms = {f"{n}_rms_deg": (heading.get(n) or {}).get("rms_deg") for n in ("before", "after")}
                scores = {"reference": heading["reference"], **rms}
            changed = fit["parameters"]["changed"]
            out.append(
                Learnt(
                    unix_ns=None if began_s is None else round(began_s * 1e9),
                    system=vehicle["system"],
                    compass=compass["compass"],
                    device_id=fit["device_id"] or 0,
                    vehicle=key(vehicle["system"], ""),  # a log does not hold the vehicle's own number
                    source="fit",
                    origin=file["sha256"],
                    name=file["path"],
                    state=fit["state"],
                    reasons=tuple(r["code"] for r in fit["reasons"]),
                    axes=tuple(fit["axes"]),
                    old_offsets_mg=_tuple(fit["old_offsets_mg"]),
                    new_offsets_mg=_tuple(fit["new_offsets_mg"]),
                    change_mg=_tuple(fit["change_mg"]),
                    sigma_mg=tuple(fit["sigma_mg"]),
                    old={name: v for name, v in fit["parameters"]["old"].items() if name in changed and v is not None},
                    new=dict(changed),
                    card=tuple((d["heading_deg"], d["before_deg"], d["after_deg"]) for d in fit["deviation"]),
                    heading=scores,
                )
            )
    return out


def learnt_live(
    record: Record, flown: Vehicle, change: Change | None, vehicle: str, began_unix_ns: int
) -> Learnt | None:
    """What a flight that just ended taught of one compass; None where nothing was learnt.

    change : what a write would do now, None where none is possible.  vehicle : the vehicle's key in the store.
    """
    if record.verdict.state is State.NO_DATA or record.estimate.samples == 0:
        return None
    stored, offsets = flown.calibrations.offsets(record.compass), record.offsets_mg
    step = offsets if stored is None else offsets - stored
    return Learnt(
        unix_ns=began_unix_ns,
        system=record.system,
        compass=record.compass,
        device_id=record.device_id,
        vehicle=vehicle,
        source="live",
        origin=str(began_unix_ns),
        name="",
        state=record.verdict.state.name,
        reasons=tuple(r.name for r in record.verdict.reasons),
        axes=tuple(a.name for a in record.verdict.axes),
        old_offsets_mg=None if stored is None else _numbers(stored),
        new_offsets_mg=None if record.relative else _numbers(offsets),
        change_mg=_numbers(step),
        sigma_mg=_numbers(record.sigma_mg),
        old={} if change is None else dict(zip(change.names, change.old, strict=True)),
        new={} if change is None else dict(zip(change.names, change.new, strict=True)),
        card=tuple((row["heading_deg"], row["before_deg"], row["after_deg"]) for row in card(record, flown)),
    )


def shadows(rows: Sequence[Learnt]) -> list[Result]:
    """Entries for ``magmav history``, the newest first: what was learnt, and what applying it would have changed.

    rows : in the order of time, see Store.learnt.
    """
    return [_entry(row, _next_of(row, rows[i + 1 :])) for i, row in enumerate(rows)][::-1]


def _entry(row: Learnt, following: Learnt | None) -> Result:
    return {
        "id": row.id,
        "unix_s": None if row.unix_ns is None else row.unix_ns / 1e9,
        "system": row.system,
        "vehicle": row.vehicle,
        "compass": row.compass,
        "device_id": row.device_id or None,
        "source": row.source,
        "recording": row.name or None,
        "state": row.state,
        "reasons": list(row.reasons),
        "axes": list(row.axes),
        "offsets_mg": None if row.new_offsets_mg is None else list(row.new_offsets_mg),
        "sigma_mg": list(row.sigma_mg),
        "heading": row.heading,
        "would_have_changed": {
            "offsets_mg": None if row.change_mg is None else list(row.change_mg),
            "parameters": {name: {"old": row.old.get(name), "new": value} for name, value in row.new.items()},
            "level_heading_error_deg": _worst(row),
            "next_flight": _shadow(row, following),
        },
    }


def _worst(row: Learnt) -> Result | None:
    """The largest heading error of a level vehicle, as stored and with what was learnt; None where neither is known."""
    out: Result = {}
    for name, column in (("before", 1), ("after", 2)):
        found = [abs(d[column] or 0.0) for d in row.card if d[column] is not None]
        out[name] = round(max(found), 2) if found else None
    return None if out["before"] is None and out["after"] is None else out


def _next_of(row: Learnt, later: Sequence[Learnt]) -> Learnt | None:
    """The next flight of the same compass that the same source tells of and that can judge: READY, and absolute."""
    if row.unix_ns is None or row.new_offsets_mg is None or not row.device_id:
        return None
    for other in later:
        same = (other.system, other.device_id, other.source) == (row.system, row.device_id, row.source)
        judges = other.state == State.READY.name and other.new_offsets_mg is not None
        later_ns = -1 if other.unix_ns is None else other.unix_ns
        if same and judges and later_ns > row.unix_ns and may_be_same(row.vehicle, other.vehicle):
            return other
    return None


def _shadow(row: Learnt, following: Learnt | None) -> Result | None:
    """By how much the next flight found these offsets off, beside those it flew with. Axes unknown to either: null."""
    if following is None or row.new_offsets_mg is None or following.new_offsets_mg is None:
        return None
    held = following.old_offsets_mg
    known = [a in _KNOWN and b in _KNOWN for a, b in zip(row.axes, following.axes, strict=True)]
    off = [a - b for a, b in zip(row.new_offsets_mg, following.new_offsets_mg, strict=True)]
    flown = None if held is None else [a - b for a, b in zip(held, following.new_offsets_mg, strict=True)]
    applied = None if held is None else all(
        abs(a - b) <= _APPLIED_MG for a, b, k in zip(held, row.new_offsets_mg, known, strict=True) if k
    )  # fmt: skip
    sigma = [math.hypot(a, b) for a, b in zip(row.sigma_mg, following.sigma_mg, strict=True)]
    return {
        "id": following.id,
        "unix_s": None if following.unix_ns is None else following.unix_ns / 1e9,
        "was_applied": applied,
        "applied_off_mg": _where(off, known),
        "stored_off_mg": None if flown is None else _where(flown, known),
        "sigma_mg": _where(sigma, known),
    }


def _where(values: Sequence[float], known: Sequence[bool]) -> list[float | None]:
    return [round(v, 3) if k else None for v, k in zip(values, known, strict=True)]


def _numbers(vector: Any) -> tuple[float, ...]:
    return tuple(round(float(v), 3) for v in np.asarray(vector))


def _tuple(values: Sequence[float] | None) -> tuple[float, ...] | None:
    return None if values is None else tuple(values)
