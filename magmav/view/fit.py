"""A fit as a table on a terminal."""

from __future__ import annotations

from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table


def fit_view(result: dict[str, Any]) -> RenderableType:
    """One table per log, one line per compass, and what to know of each below."""
    parts: list[RenderableType] = []
    for log in result["logs"]:
        table = Table(title=log["source"], title_justify="left")
        for name in (
            "system",
            "compass",
            "state",
            "offsets mG",
            "was",
            "sigma",
            "heading deg",
            "held out",
            "reference",
        ):
            table.add_column(name)
        notes = []
        for vehicle in log["vehicles"]:
            for entry in vehicle["compasses"]:
                fit = entry["fit"]
                row = [str(vehicle["system"]), str(entry["compass"])]
                if fit is None:
                    table.add_row(*row, entry["state"], *["-"] * 6)
                    continue
                heading = fit["heading"]
                change = fit["new_offsets_mg"] is None
                table.add_row(
                    *row,
                    fit["state"],
                    ("change " if change else "") + _three(fit["change_mg"] if change else fit["new_offsets_mg"]),
                    _three(fit["old_offsets_mg"]),
                    _three(fit["sigma_mg"]),
                    _turn(heading),
                    _turn(None if heading is None else heading["held_out"]),
                    "-" if heading is None else heading["reference"],
                )
                who = f"compass {entry['compass']}"
                notes += [f"{who}: {r['text']}" for r in fit["reasons"] + fit["causes"]]
                notes += [f"{who}: cut {c['from_s']:.1f} to {c['to_s']:.1f} s: {c['text']}" for c in fit["cut"]]
                notes += [f"{who}: {text}" for text in fit["advice"]]
        parts += [table, *notes]
    return Group(*parts)


def _three(values: list[float | None] | None) -> str:
    if values is None:
        return "-"
    return ", ".join("-" if v is None else f"{v:.0f}" for v in values)


def _turn(scores: dict[str, Any] | None) -> str:
    if scores is None:
        return "-"
    shown = [scores[k]["rms_deg"] if scores.get(k) else None for k in ("before", "after")]
    return " -> ".join("-" if v is None else f"{v:.1f}" for v in shown)
