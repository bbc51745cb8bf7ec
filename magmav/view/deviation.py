"""The deviation card as a table, made from the same list that is the JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich import box
from rich.console import RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

Json = Mapping[str, Any]

_COLUMNS = {"before": "as stored", "after": "new offsets", "full": "full model"}


def card_view(card: Sequence[Json]) -> RenderableType:
    """A row a heading; empty text where there is no card."""
    if not card:
        return Text()
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, title="Deviation, level: shown minus true", title_justify="left")
    table.add_column("magnetic heading")
    for name in _COLUMNS.values():
        table.add_column(f"{name}, deg", justify="right")
    for row in card:
        head = f"{row['heading']:<2} {row['heading_deg']:3.0f}"
        table.add_row(Text(head), *(Text(_error(row, name)) for name in _COLUMNS))
    return Padding(table, (0, 0, 0, 2))


def _error(row: Json, name: str) -> str:
    error, sigma = row.get(f"{name}_deg"), row.get(f"{name}_sigma_deg")
    if error is None or sigma is None:
        return "no heading"
    return f"{round(error, 1) + 0.0:+.1f} ± {sigma:.1f}"  # + 0.0: no minus before nothing
