"""DataFlash logs as text (.log), as Mission Planner and the old command line wrote them, to the same columns.

One record a line: its name, then its values with the letter's power of ten already applied, separated by commas. FMT
lines announce the columns as in the binary form. Lines that are no record (greetings, a line cut short) are counted.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magmav.logs import LogError
from magmav.logs.columns import LETTERS, STRINGS, WHOLE, Definition, Ints, Table, Tables, define
from magmav.logs.dataflash import with_units

_FMT = define(128, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")


def read_text(data: bytes, where: str) -> Tables:
    """The log as tables; ``at`` is the number of the line.

    data : the whole file.  where : its name, for LogError, which is raised when no message is defined in it.
    """
    counts: Counter[str] = Counter()
    lines: dict[str, list[int]] = {}
    text = data.decode("utf-8-sig", "replace").splitlines()
    for number, line in enumerate(text):
        lines.setdefault(line[: line.find(",")], []).append(number)
    defined = _definitions([(n, text[n]) for n in lines.get("FMT", [])], counts)
    if not defined:
        raise LogError(
            f"{where}: no message is defined in it (no FMT line); give a whole .log or the .bin it came from"
        )
    heard: Counter[str] = Counter()
    tables: list[tuple[Definition, Table]] = []
    for name in dict.fromkeys(d.name for _, d in defined):
        of_name = [(n, d) for n, d in defined if d.name == name]
        numbers = np.array(lines.pop(name, []), dtype=np.int64)
        heard[name] += len(numbers)
        # Lines stand under the latest definition before them, or the first there is.
        edges = [0, *np.searchsorted(numbers, [n for n, _ in of_name[1:]]).tolist(), len(numbers)]
        for (_, definition), a, b in zip(of_name, edges[:-1], edges[1:], strict=True):
            table = _table(definition, numbers[a:b], text, counts)
            if table is not None:
                tables.append((definition, table))
    counts["lines of a message never defined"] += sum(len(n) for name, n in lines.items() if name)
    return Tables(with_units(tables), +counts, +heard)


def _definitions(lines: list[tuple[int, str]], counts: Counter[str]) -> list[tuple[int, Definition]]:
    """(from which line on, definition), each once; FMT itself first."""
    out: list[tuple[int, Definition]] = []
    newest: dict[str, Definition] = {}
    for number, line in lines:
        parts = [p.strip() for p in line.split(",", 5)]
        try:
            kind, size = int(parts[1]), int(parts[2])
            definition = define(kind, size, *parts[3:6]) if len(parts) == 6 else None
        except (IndexError, ValueError):
            definition = None
        if definition is None or not definition.name or any(c not in LETTERS for c in definition.letters):
            counts["FMT: not believable"] += 1
        elif definition.name != "FMT" and newest.get(definition.name) != definition:
            newest[definition.name] = definition
            out.append((number, definition))
    return [(0, _FMT), *out] if out else []


def _table(definition: Definition, numbers: Ints, text: list[str], counts: Counter[str]) -> Table | None:
    """The lines as columns; None when there is none of the right length."""
    want = len(definition.labels)
    rows = [text[n].split(",", want) for n in numbers.tolist()]
    right = np.array([len(r) == want + 1 for r in rows], dtype=bool)
    counts[f"{definition.name}: line cut short"] += int((~right).sum())
    if not want or not right.any():
        return None
    cells = [r for r, fine in zip(rows, right.tolist(), strict=True) if fine]
    letters = dict(zip(definition.labels, definition.letters, strict=True))
    place = {label: i + 1 for i, label in enumerate(definition.labels)}

    def stored(label: str) -> NDArray[Any]:
        column = [r[place[label]] for r in cells]
        if letters[label] in STRINGS:
            return np.array([c.strip() for c in column], dtype=object)
        return _numbers(column, letters[label] in WHOLE)

    return Table(definition.name, letters, numbers[right], stored, scaled=True)


def _numbers(column: list[str], are_whole: bool) -> NDArray[Any]:
    """The cells as numbers, NaN for what is none. int64 where all are whole, so that no microsecond is lost."""
    try:
        return np.array(list(map(int if are_whole else float, column)), dtype=np.int64 if are_whole else np.float64)
    except (ValueError, OverflowError):
        return np.array([_number(c) for c in column])


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")
