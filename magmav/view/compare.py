"""The comparison of all estimators as a table: one per compass, made from the dict that is the JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

Json = Mapping[str, Any]
_NONE = "-"
_STATES = {"NO_DATA": "no data", "LEARNING": "learning", "READY": "ready", "REFUSED": "refused"}
_FOOT = """offset: to be added, mG, body axes; - where a method says nothing of an axis.  fit: its own RMS residual, mG.
second half: fitted on the first half of the time that taught, heading RMS on the rest, deg; p95: of its size.
in-sample: fitted and scored on everything.  us: microseconds a sample.
smoothed: after the flight, all of it solved at once; in-sample with the iron of each moment, no gate asked."""


def compare_view(result: Json) -> RenderableType:
    """Every compass of the recording: all methods, and the reference the headings were compared with."""
    parts: list[RenderableType] = [Text(str(result["source"]), style="bold")]
    for vehicle in result["vehicles"]:
        for compass in vehicle["compasses"]:
            parts += [Text(), _title(vehicle, compass), _table(compass)]
            parts += [Text(f"  {line}", style="dim") for line in _why(compass["estimators"])]
    return Group(*parts, Text(), Text(_FOOT, style="dim"))


def _title(vehicle: Json, compass: Json) -> Text:
    against = compass["reference"] or "nothing: no attitude in it, no reference given"
    span = ""
    if compass["learnt_from_s"] is not None:
        span = (
            f", {compass['learnt_from_s']:.0f} to {compass['learnt_to_s']:.0f} s, split at {compass['split_s']:.0f} s"
        )
    text = f"System {vehicle['system']}, compass {compass['compass']}: {compass['samples_learnt']} samples taught{span}"
    return Text(f"{text}\nheading against {against}")


def _table(compass: Json) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    table.add_column("method", no_wrap=True, min_width=13)
    for name in ("offset x", "y", "z", "sigma x", "y", "z", "fit", "second half", "p95", "in-sample", "us"):
        table.add_column(name, justify="right")
    table.add_column("gate")
    blank = (_NONE,) * 3
    table.add_row("uncalibrated", "0", "0", "0", *blank, _NONE, *_headings(compass["uncalibrated"]), _NONE, _NONE)
    stored = compass["stored"]
    if stored is not None:
        offsets = (_number(v, 0) for v in stored["offsets_mg"])
        table.add_row("as stored", *offsets, *blank, _NONE, *_headings(stored), _NONE, _NONE)
    for row in compass["estimators"]:
        table.add_row(
            row["name"],
            *(_number(v, 1) for v in row["offsets_mg"] or (None,) * 3),
            *(_number(v, 1) for v in row["sigma_mg"] or (None,) * 3),
            _number(row["residual_mg"], 1),
            *_headings(row),
            _number(row["us_per_sample"], 0),
            Text(_STATES.get(row["state"], _NONE) if row["refusal"] is None else "no answer"),
        )
    return table


def _headings(row: Json) -> tuple[str, str, str]:
    second, whole = row["second_half"] or {}, row["in_sample"] or {}
    return _number(second.get("rms_deg"), 2), _number(second.get("p95_deg"), 1), _number(whole.get("rms_deg"), 2)


def _number(value: float | None, digits: int) -> str:
    return _NONE if value is None else f"{value:.{digits}f}"


def _why(rows: Sequence[Json]) -> list[str]:
    """Why a method gave nothing, or is not ready; methods with one reason on one line."""
    said: dict[str, list[str]] = {}
    for row in rows:
        if row["refusal"] is not None:
            said.setdefault(f"no answer: {row['refusal']}", []).append(row["name"])
            continue
        if row["weak"] is not None:
            said.setdefault(f"weak: {row['weak']}", []).append(row["name"])
        if row["state"] not in (None, "READY"):
            said.setdefault(", ".join(row["reasons"]), []).append(row["name"])
    return [f"{', '.join(names)}: {why}" for why, names in said.items()]
