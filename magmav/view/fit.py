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
        notes: list[str] = []
        cards: list[tuple[str, list[dict[str, Any]]]] = []
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
                if fit["deviation"]:
                    several = len(log["vehicles"]) > 1
                    cards.append((f"system {vehicle['system']}, {who}" if several else who, fit["deviation"]))
        parts += [table, *notes, *([_deviation(cards)] if cards else [])]
    return Group(*parts)


def _deviation(cards: list[tuple[str, list[dict[str, Any]]]]) -> Table:
    """The deviation card: eight headings, and what each compass shows there more than it should, before and after."""
    out = Table(
        title="Deviation, level: shown minus true, deg, as stored -> with the new offsets", title_justify="left"
    )
    out.add_column("magnetic heading", justify="right")
    for who, _ in cards:
        out.add_column(who, justify="right")
    for rows in zip(*(rows for _, rows in cards), strict=True):
        shown = [f"{_signed(r['before_deg'])} -> {_signed(r['after_deg'])} ± {_plain(r['sigma_deg'])}" for r in rows]
        out.add_row(f"{rows[0]['heading_deg']:.0f}", *shown)
    return out


def _signed(value: float | None) -> str:
    return "-" if value is None else f"{round(value, 1) + 0.0:+.1f}"  # + 0.0: no minus before nothing


def _plain(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def _three(values: list[float | None] | None) -> str:
    if values is None:
        return "-"
    return ", ".join("-" if v is None else f"{v:.0f}" for v in values)


def _turn(scores: dict[str, Any] | None) -> str:
    if scores is None:
        return "-"
    shown = [scores[k]["rms_deg"] if scores.get(k) else None for k in ("before", "after")]
    return " -> ".join("-" if v is None else f"{v:.1f}" for v in shown)
