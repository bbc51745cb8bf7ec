"""ArduPilot's binary DataFlash log (.bin) to columns, without a loop over records (AP_Logger/LogStructure.h).

Each record is 0xA3 0x95, the number of its message, then the values its FMT record announced. Nothing closes a record
and nothing checks it, so trust comes from company: a record is believed when another begins where it ends. What stands
between believed records is skipped and counted. After damage the next header that leads on is where reading resumes.
"""

from __future__ import annotations

import re
from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magmav.logs import LogError
from magmav.logs.columns import (
    HEADER,
    Definition,
    Ints,
    Table,
    Tables,
    clean,
    define,
    instance_label,
    multipliers,
    whole,
)

Bytes = NDArray[np.uint8]

SYNC = b"\xa3\x95"
_FMT, _FMT_SIZE = 128, 89
_FORMAT = define(_FMT, _FMT_SIZE, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")
_CHUNK = 1 << 24
_NAME = re.compile(r"[A-Za-z0-9_]{1,4}\Z")


def read_binary(data: Bytes, where: str) -> Tables:
    """The log as tables.

    data : (n,) uint8, the whole file.  where : the file's name, for the text of LogError, which is raised when no
    message is defined in it.
    """
    counts: Counter[str] = Counter()
    starts = _headers(data)
    numbers = data[starts + 2]
    defined = _definitions(data, starts[numbers == _FMT], counts)
    if not defined:
        raise LogError(
            f"{where}: no message is defined in it (no FMT record); this is no DataFlash log or only the middle of "
            "one: fetch the whole log from the vehicle again"
        )
    which = _meaning(starts, numbers, defined)
    sizes = np.array([d.size for _, d in defined] + [0], dtype=np.int64)[which]
    keep = _walk(starts, sizes, len(data))
    _count_skipped(starts, which, sizes, keep, len(data), len(defined), counts)
    heard: Counter[str] = Counter()
    order = np.argsort(which[keep], kind="stable")
    places, meant = starts[keep][order], which[keep][order]
    edges = np.searchsorted(meant, np.arange(len(defined) + 1))
    tables: list[tuple[Definition, Table]] = []
    for i, (_, definition) in enumerate(defined):
        at = places[edges[i] : edges[i + 1]]
        layout = definition.layout
        heard[definition.name] += len(at)
        if layout is None:
            counts[f"{definition.name}: its definition contradicts itself"] += len(at)
        elif len(at):
            tables.append((definition, _table(data, definition, layout, at)))
    return Tables(with_units(tables), +counts, +heard)


def with_units(tables: list[tuple[Definition, Table]]) -> dict[str, list[Table]]:
    """The tables by name, with what FMTU and MULT say of their columns."""
    power_of: dict[str, float] = {}
    said: dict[int, tuple[str, str]] = {}
    for definition, table in tables:
        if definition.name == "MULT" and "Mult" in table and ("Id" in table or table.has_text("Id")):
            ids = table.texts("Id") if table.has_text("Id") else [chr(i & 0xFF) for i in whole(table.values("Id"))]
            power_of |= zip(ids, table.base("Mult").tolist(), strict=True)
        elif definition.name == "FMTU" and "FmtType" in table and all(map(table.has_text, ("UnitIds", "MultIds"))):
            pairs = zip(table.texts("UnitIds"), table.texts("MultIds"), strict=True)
            said |= zip(whole(table.values("FmtType")).tolist(), pairs, strict=True)
    out: dict[str, list[Table]] = {}
    for definition, table in tables:
        if definition.number in said:
            units, mults = said[definition.number]
            known = multipliers(definition, mults, power_of)
            marked = instance_label(definition, units)
            table = Table(table.name, table.letters, table.at, table.stored, table.scaled, known, marked)
        out.setdefault(definition.name, []).append(table)
    return out


def _headers(data: Bytes) -> Ints:
    """Where 0xA3 0x95 stands with a byte behind it, whether or not a record begins there."""
    found = []
    for begin in range(0, max(len(data) - 2, 0), _CHUNK):
        piece = data[begin : begin + _CHUNK + 2]
        found.append(np.flatnonzero((piece[:-2] == SYNC[0]) & (piece[1:-1] == SYNC[1])) + begin)
    return np.concatenate(found) if found else np.zeros(0, dtype=np.int64)


def _table(data: Bytes, definition: Definition, layout: np.dtype[Any], at: Ints) -> Table:
    """The records at these places; their bytes are copied out when a column is first asked for."""
    held: list[NDArray[Any]] = []

    def stored(label: str) -> NDArray[Any]:
        if not held:
            held.append(_rows(data, at, definition.size).view(layout)[:, 0])
        return held[0][label]

    return Table(definition.name, dict(zip(definition.labels, definition.letters, strict=True)), at, stored)


def _rows(data: Bytes, at: Ints, size: int) -> Bytes:
    """(n, size) the bytes of n records."""
    windows: Bytes = np.lib.stride_tricks.sliding_window_view(data, size)
    return np.ascontiguousarray(windows[at])


def _definitions(data: Bytes, at: Ints, counts: Counter[str]) -> list[tuple[int, Definition]]:
    """(from which byte on, definition) in the order of the file, each once; FMT itself first."""
    out: list[tuple[int, Definition]] = []
    newest: dict[int, Definition] = {}
    layout = _FORMAT.layout
    assert layout is not None
    at = at[at + _FMT_SIZE <= len(data)]
    for place, raw in zip(at.tolist(), _rows(data, at, _FMT_SIZE).view(layout)[:, 0] if len(at) else (), strict=True):
        name, number = clean(raw["Name"]), int(raw["Type"])
        if number == _FMT or not _NAME.match(name) or raw["Length"] < HEADER:
            continue  # FMT itself, or its three bytes by chance inside another record
        definition = define(number, int(raw["Length"]), name, clean(raw["Format"]), clean(raw["Columns"]))
        if newest.get(definition.number) == definition:
            continue
        if definition.layout is None and definition.number in newest:
            counts["FMT: not believable"] += 1
            continue
        if definition.number in newest:
            counts["FMT: message defined anew"] += 1
        newest[definition.number] = definition
        out.append((place, definition))
    return [(0, _FORMAT), *out] if out else []


def _meaning(starts: Ints, numbers: Bytes, defined: list[tuple[int, Definition]]) -> Ints:
    """(n,) which definition each header falls under: the latest before it, or the first of its number; len(defined)
    where the number was never defined."""
    first = np.full(256, len(defined), dtype=np.int64)
    for i, (_, definition) in reversed(list(enumerate(defined))):
        first[definition.number] = i
    which = first[numbers]
    for i, (place, definition) in enumerate(defined):
        if first[definition.number] != i:
            which[(numbers == definition.number) & (starts > place)] = i
    return which


def _walk(starts: Ints, sizes: Ints, end: int) -> NDArray[np.bool_]:
    """(n,) which headers begin a record. sizes : of the record each would begin, 0 where not known.

    Where every record is followed by the next there is nothing to decide; only the breaks are looked at one by one.
    """
    stops = starts + sizes
    follows = np.append(starts[1:], end) == stops
    keep = np.ones(len(starts), dtype=bool)
    free = 0  # headers before this byte lie inside a record already believed
    for i in np.flatnonzero(~follows).tolist():
        if starts[i] < free or sizes[i] == 0 or stops[i] > end:
            keep[i] = False
            continue
        beyond = int(np.searchsorted(starts, stops[i]))
        inside = slice(i + 1, beyond)
        leads_on = stops[i] == end or (beyond < len(starts) and starts[beyond] == stops[i])
        if not leads_on and follows[inside].any():
            keep[i] = False  # bytes of it are missing: a header inside leads on where this one does not
            continue
        keep[inside] = False
        free = int(stops[i])
    return keep


def _count_skipped(
    starts: Ints,
    which: Ints,
    sizes: Ints,
    keep: NDArray[np.bool_],
    end: int,
    unknown: int,
    counts: Counter[str],
) -> None:
    used = int(sizes[keep].sum())
    counts["bytes skipped"] += end - used
    last = int((starts + sizes)[keep].max(initial=0))
    tail = starts[(starts >= last) & (sizes > 0)]
    counts["last record cut short"] += len(tail) > 0
    strange = ~keep & (which == unknown)
    if strange.any():
        # Inside other records such bytes are chance; outside they are records whose definition is missing.
        spans = np.cumsum(keep) - 1
        stops = np.concatenate(([0], (starts + sizes)[keep]))
        counts["records of a message never defined"] += int((strange & (starts >= stops[spans + 1])).sum())
