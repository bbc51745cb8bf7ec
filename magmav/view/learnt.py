"""What every flight taught, and what applying it would have changed, as a table for people."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

Json = Mapping[str, Any]
_NOTE = "Nothing of this was written by magmav unless the table of writes says so."


def learnt_view(entries: Iterable[Json]) -> RenderableType:
    """A row for each flight and compass, the newest first. See learnt.shadows for the entries."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, title="What flights taught", title_justify="left")
    names = ("when (UTC)", "system", "compass", "device", "from", "verdict", "offsets mG, sigma", "had it been applied")
    for name in names:
        table.add_column(name, overflow="fold")
    count = 0
    for entry in entries:
        count += 1
        changes = entry["would_have_changed"]
        offsets = entry["offsets_mg"]
        shown = "a relative change" if offsets is None else _three(offsets)
        cells = (
            _when(entry["unix_s"]),
            *(_word(entry[k]) for k in ("system", "compass", "device_id")),
            entry["recording"] or entry["source"],
            entry["state"],
            f"{shown} (sigma {_three(entry['sigma_mg'])})",
            "\n".join(said(changes)),
        )
        table.add_row(*map(_line, cells))
    return Group(table, _line(_NOTE)) if count else _line("no flight was remembered")


def said(changes: Json) -> list[str]:
    """What would have changed, in words."""
    out = []
    if changes["offsets_mg"] is not None:
        out.append(f"offsets moved by {_three(changes['offsets_mg'], '+.0f')} mG")
    error = changes["level_heading_error_deg"]
    if error is not None:
        before, after = (_number(error[k]) for k in ("before", "after"))
        out.append(f"largest heading error when level: {before} -> {after} deg")
    later = changes["next_flight"]
    if later is not None:
        off, held = _three(later["applied_off_mg"], "+.0f"), later["stored_off_mg"]
        sigma = _three(later["sigma_mg"], ".0f")
        if later["was_applied"]:
            out.append(f"it was in place in the next flight, which found it off by {off} mG (sigma {sigma})")
        else:
            flown = "" if held is None else f"; what was flown with was off by {_three(held, '+.0f')}"
            out.append(f"the next flight found it off by {off} mG (sigma {sigma}){flown}")
    return out


def _when(unix_s: float | None) -> str:
    return "not known" if unix_s is None else datetime.fromtimestamp(unix_s, UTC).strftime("%Y-%m-%d %H:%M:%S")


def _three(values: Sequence[float | None], form: str = ".0f") -> str:
    return ", ".join("-" if v is None else format(v, form) for v in values)


def _number(value: float | None) -> str:
    return "not known" if value is None else f"{value:.1f}"


def _word(value: Any) -> str:
    return "not known" if value is None else str(value)


def _line(text: str) -> Text:
    """Names come from files: no markup and no escape codes."""
    return Text("".join(c if c.isprintable() or c == "\n" else "?" for c in text))
