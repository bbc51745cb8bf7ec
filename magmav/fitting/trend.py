"""Offsets of one compass from flight to flight: what they do, and after which flight they changed.

Counts in a trend: what the verdict calls READY, with a date, with absolute offsets, of an axis that was observed or
taken from the field model. The rest is in the table and says why it does not count.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

Result = dict[str, Any]
AXES = ("x", "y", "z")
SIGMAS, DRIFT_SIGMAS = 2.0, 3.0
RULE = (
    "A change is claimed on an axis when a flight's offset is off the mean of the flights since the last change by "
    "more than two sigmas of the flight and two of the steadiest of those flights together; it came after the last "
    "of them. A drift is claimed when the slope since the last change is beyond three of its sigmas, from three "
    "flights on. Flights count that are READY, dated by the recording, and not relative; axes that were observed or "
    "taken from the field model. Offsets are as ArduPilot adds them, mG, body axes."
)
_KNOWN = ("OBSERVED", "FROM_MODEL")


def rows_of(entry: Mapping[str, Any]) -> list[Result]:
    """One row for each compass of a log's entry."""
    file = entry["file"]
    out = []
    for vehicle in entry["vehicles"]:
        for compass in vehicle["compasses"]:
            fit = compass.get("fit") or {}
            heading = fit.get("heading") or {}
            before, after = heading.get("before") or {}, heading.get("after") or {}
            held_out = heading.get("held_out") or {}
            row = {
                "date": _date(file.get("began_unix_s")),
                "path": file["path"],
                "sha256": file["sha256"],
                "kind": file["kind"],
                "system": vehicle["system"],
                "autopilot": vehicle["autopilot"],
                "compass": compass["compass"],
                "device_id": fit.get("device_id") or compass.get("device_id"),
                "flights": len(vehicle.get("flights") or []),
                "state": fit.get("state") or "NO_DATA",
                "reasons": [r["code"] for r in fit.get("reasons") or []],
                "causes": [c["code"] for c in fit.get("causes") or []],
                "relative": fit.get("relative", True),
                **{k: fit.get(k) for k in ("old_offsets_mg", "new_offsets_mg", "change_mg", "sigma_mg", "axes")},
                "heading_reference": heading.get("reference"),
                "heading_before_rms_deg": before.get("rms_deg"),
                "heading_after_rms_deg": after.get("rms_deg"),
                "heading_held_out_rms_deg": (held_out.get("after") or {}).get("rms_deg"),
                "heading_n": after.get("n"),
            }
            out.append(row | {"counts": why_not(row) is None, "why_not": why_not(row)})
    return out


def why_not(row: Mapping[str, Any]) -> str | None:
    """Why a row is not part of a trend; None where it is."""
    if row["state"] != "READY":
        return f"the verdict is {row['state']}"
    if row["date"] is None:
        return "the recording does not know its date"
    if row["relative"] or row["new_offsets_mg"] is None:
        return "stored offsets are not in the recording: a relative change only"
    return None


def table(rows: Iterable[Result]) -> list[Result]:
    """Vehicles by system id, their compasses by device id, with logs in the order of time, trend and changes.

    A device id that is not known is told apart by the compass's number instead. Nothing depends on the rows' order.
    """
    vehicles: dict[int, dict[tuple[Any, ...], list[Result]]] = {}
    for row in sorted(rows, key=_order):
        device = row["device_id"]
        key = (0, device) if device is not None else (1, row["compass"])
        vehicles.setdefault(row["system"], {}).setdefault(key, []).append(row)
    out = []
    for system, compasses in sorted(vehicles.items()):
        listed = []
        for _, logs in sorted(compasses.items()):
            listed.append(
                {
                    "device_id": logs[0]["device_id"],
                    "compass": sorted({row["compass"] for row in logs}),
                    "autopilot": sorted({row["autopilot"] for row in logs}),
                    "logs": logs,
                    **trend([row for row in logs if row["counts"]]),
                }
            )
        out.append({"system": system, "compasses": listed})
    return out


def trend(rows: Sequence[Mapping[str, Any]]) -> Result:
    """{"changes": [...], "drift": {axis: ...}} of one compass's rows, in the order of time. See RULE."""
    changes: list[Result] = []
    drift: Result = {}
    for i, axis in enumerate(AXES):
        points = [
            (number, row, float(row["new_offsets_mg"][i]), float(row["sigma_mg"][i]))
            for number, row in enumerate(rows)
            if row["axes"][i] in _KNOWN and row["sigma_mg"][i] > 0.0
        ]
        since: list[tuple[int, Mapping[str, Any], float, float]] = []
        for point in points:
            if since:
                mean, steadiest = _mean(since), min(s for *_, s in since)
                limit = SIGMAS * (point[3] + steadiest)
                if abs(point[2] - mean) > limit:
                    changes.append(_change(axis, since[-1][1], point[1], mean, point[2], limit))
                    since = []
            since.append(point)
        drift[axis] = _drift(since)
    changes.sort(key=lambda c: (c["found_in"]["date"], c["found_in"]["sha256"], c["axis"]))
    return {"changes": changes, "drift": drift}


def _change(
    axis: str, after: Mapping[str, Any], found: Mapping[str, Any], before_mg: float, now_mg: float, limit_mg: float
) -> Result:
    place = ("date", "path", "sha256")
    return {
        "axis": axis,
        "after": {k: after[k] for k in place},
        "found_in": {k: found[k] for k in place},
        "from_mg": round(before_mg, 3),
        "to_mg": round(now_mg, 3),
        "by_mg": round(now_mg - before_mg, 3),
        "limit_mg": round(limit_mg, 3),
    }


def _mean(points: Sequence[tuple[int, Any, float, float]]) -> float:
    weights = [1.0 / s**2 for *_, s in points]
    return math.fsum(w * x for w, (_, _, x, _) in zip(weights, points, strict=True)) / math.fsum(weights)


def _drift(points: Sequence[tuple[int, Any, float, float]]) -> Result | None:
    """Weighted straight line over the number of the flight; None below three flights."""
    if len(points) < 3:
        return None
    weights = [1.0 / s**2 for *_, s in points]
    total = math.fsum(weights)
    middle = math.fsum(w * n for w, (n, *_) in zip(weights, points, strict=True)) / total
    spread = math.fsum(w * (n - middle) ** 2 for w, (n, *_) in zip(weights, points, strict=True))
    slope = math.fsum(w * (n - middle) * x for w, (n, _, x, _) in zip(weights, points, strict=True)) / spread
    sigma = spread**-0.5
    return {
        "mg_per_flight": round(slope, 4),
        "sigma_mg_per_flight": round(sigma, 4),
        "flights": len(points),
        "claimed": abs(slope) > DRIFT_SIGMAS * sigma,
    }


def _date(unix_s: float | None) -> str | None:
    """UTC, to the second."""
    return None if unix_s is None else datetime.fromtimestamp(unix_s, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def _order(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """By date, those without one last; then by content and name, so that the order of arguments counts for nothing."""
    return row["date"] is None, row["date"] or "", row["sha256"], row["path"], row["system"], row["compass"]
