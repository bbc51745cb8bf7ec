"""Records on disk: one line per Record, JSON lines or CSV, and back.

Lines go straight to the final name, each in one unbuffered write: a run that is killed leaves every line
that was finished, and another program can follow the file while it grows. (A temporary name renamed at the
end would lose a three-hour run to one power cut.) Reading forgives a last line without newline, no more.

What is not known is null in JSON and empty in CSV, never 0 and never NaN.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np

from magmav.core.types import Record

Value = float | int | str | bool | list[str] | None
Row = dict[str, Value]

_AXES = "xyz"


class ViewError(Exception):
    """Something a view cannot read or write; the text names the file and what is wrong."""


class WrongName(ViewError, ValueError):
    """A file name asked for that is not of the kind that is written; nothing was read or written. A wrong argument."""


class Column(NamedTuple):
    """One column: its name, how its text is read back, and what it means."""

    name: str
    parse: Callable[[str], Value]
    meaning: str


def _flag(text: str) -> bool:
    return {"true": True, "false": False}[text]


COLUMNS: tuple[Column, ...] = (
    Column("t_s", float, "arrival time on the link's clock, s"),
    Column("boot_s", float, "the vehicle's own clock, s since it booted"),
    Column("system", int, "MAVLink system id"),
    Column("compass", int, "compass number, 1 to 3"),
    Column("device_id", int, "the compass's device id, when known"),
    *(Column(f"mag_{a}_mg", float, "the sensor's own field, body axes, mG") for a in _AXES),
    *(Column(f"offsets_{a}_mg", float, "offsets as ArduPilot would add them, mG") for a in _AXES),
    *(Column(f"sigma_{a}_mg", float, "one sigma of each offset, mG") for a in _AXES),
    Column("state", str, "NO_DATA, LEARNING, READY or REFUSED"),
    Column("axes", str.split, "OBSERVED, FROM_MODEL or NOT_OBSERVED for x, y, z"),
    Column("roll_deg", float, "tilt at the sample, degrees"),
    Column("pitch_deg", float, "tilt at the sample, degrees"),
    Column("heading_deg", float, "corrected heading, magnetic, 0 to 360"),
    Column("heading_true_deg", float, "corrected heading, true, 0 to 360"),
    Column("heading_sigma_deg", float, "one sigma of the corrected heading, degrees"),
    Column("stored_heading_deg", float, "heading with what the autopilot holds, magnetic, 0 to 360"),
    Column("stored_heading_true_deg", float, "the same, true, 0 to 360"),
    Column("corrected_norm_mg", float, "strength of the corrected field, mG"),
    Column("learnt", _flag, "true where this sample moved the estimate"),
    Column("relative", _flag, "stored offsets unknown: the offsets are a change of whatever is stored"),
    Column("age_s", float, "the field was measured this long before boot_s"),
    Column("reasons", str.split, "codes of the verdict's reasons"),
)

_HEADER = ",".join(c.name for c in COLUMNS)
_JSON_START = '{"t_s": '


def row(record: Record) -> Row:
    """The record as it is written: times to 1 us, mG and degrees to 1e-4; None where nothing is known."""
    verdict, heading, stored = record.verdict, record.heading, record.stored_heading
    known = record.estimate.samples > 0  # before that the offsets are where the estimator starts, not an answer
    true = heading.valid and heading.true_valid
    values: list[Value] = [
        round(record.t_ns / 1e9, 6),
        round(record.boot_ns / 1e9, 6),
        record.system,
        record.compass,
        record.device_id or None,
        *(_number(v) for v in record.mag_b_mg),
        *(_number(v, known) for v in record.offsets_mg),
        *(_number(v, known) for v in record.sigma_mg),
        verdict.state.name,
        [axis.value for axis in verdict.axes],
        _number(math.degrees(record.roll_rad)),
        _number(math.degrees(record.pitch_rad)),
        _compass_deg(heading.magnetic_rad, heading.valid),
        _compass_deg(heading.true_rad, true),
        _number(math.degrees(heading.sigma_rad), heading.valid),
        _compass_deg(stored.magnetic_rad, stored.valid),
        _compass_deg(stored.true_rad, stored.valid and stored.true_valid),
        _number(float(np.linalg.norm(record.corrected_b_mg)), known),
        record.learnt,
        record.relative,
        round(record.age_s, 6),
        [reason.name for reason in verdict.reasons],
    ]
    return dict(zip((c.name for c in COLUMNS), values, strict=True))


def _number(value: float, known: bool = True) -> float | None:
    return round(float(value), 4) + 0.0 if known and math.isfinite(value) else None  # + 0.0: no -0.0


def _compass_deg(angle_rad: float, known: bool) -> float | None:
    degrees = _number(math.degrees(angle_rad), known)
    return None if degrees is None else round(degrees % 360.0, 4) % 360.0


class RecordWriter:
    """Writes one line per record. The suffix chooses: .jsonl or .json for JSON lines, .csv for CSV.

    An earlier file of records under this name is replaced; any other file is left alone and refused, because
    the likeliest mistake is naming the truth table here.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.written = 0
        self._csv = _is_csv(self.path)
        try:
            _refuse_foreign(self.path)
            self._file = self.path.open("wb", buffering=0)
        except OSError as error:
            raise ViewError(f"{self.path}: cannot write records: {error.strerror}") from error
        self._end = 0
        if self._csv:
            try:
                self._line(_HEADER)
            except ViewError:
                self._file.close()
                raise

    def write(self, record: Record) -> None:
        """Append one record; ViewError when the disk refuses, with the torn line taken back."""
        if self._file.closed:
            raise ValueError(f"{self.path}: already closed")
        values = row(record)
        self._line(",".join(map(_text, values.values())) if self._csv else json.dumps(values, allow_nan=False))
        self.written += 1

    def close(self) -> None:
        """Safe to call twice."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _line(self, line: str) -> None:
        left = memoryview(line.encode() + b"\n")
        size = len(left)
        try:
            while left:
                left = left[self._file.write(left) or 0 :]
        except OSError as error:
            with suppress(OSError):  # a device cannot be cut; a file can
                self._file.truncate(self._end)
                self._file.seek(self._end)
            raise ViewError(f"{self.path}: cannot write records: {error.strerror}") from error
        self._end += size


def read_records(path: str | Path) -> Iterator[Row]:
    """Rows as ``row`` made them, one by one; ViewError naming file, line and column where they are not."""
    path = Path(path)
    is_csv = _is_csv(path)
    try:
        with path.open("rb") as file:
            for number, line in enumerate(file, start=1):
                if not line.endswith(b"\n"):
                    return  # the writer was killed in the middle of this one
                text = line.decode(errors="replace").rstrip("\r\n")
                if is_csv and number == 1:
                    if text != _HEADER:
                        raise ViewError(f"{path}, line 1: not the header of a records file")
                    continue
                yield _from_csv(text, path, number) if is_csv else _from_json(text, path, number)
    except OSError as error:
        raise ViewError(f"{path}: cannot read records: {error.strerror}") from error


def _from_csv(text: str, path: Path, number: int) -> Row:
    cells = text.split(",")
    if len(cells) != len(COLUMNS):
        raise ViewError(f"{path}, line {number}: {len(cells)} columns, want {len(COLUMNS)}")
    out: Row = {}
    for column, cell in zip(COLUMNS, cells, strict=True):
        lists = column.parse is str.split
        try:
            out[column.name] = None if cell == "" and not lists else column.parse(cell)
        except (ValueError, KeyError):
            raise ViewError(f"{path}, line {number}, column {column.name}: cannot read {cell!r}") from None
    return out


def _from_json(text: str, path: Path, number: int) -> Row:
    try:
        out: Any = json.loads(text)
    except ValueError:
        out = None
    if not isinstance(out, dict) or list(out) != [c.name for c in COLUMNS]:
        raise ViewError(f"{path}, line {number}: not a record")
    return out


def _text(value: Value) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    return " ".join(value) if isinstance(value, list) else str(value)


def _is_csv(path: Path) -> bool:
    if path.suffix.lower() not in (".csv", ".jsonl", ".json"):
        raise WrongName(f"{path}: records want a name ending in .jsonl, .json or .csv")
    return path.suffix.lower() == ".csv"


def _refuse_foreign(path: Path) -> None:
    if not path.is_file():
        return
    with path.open("rb") as file:
        head = file.read(len(_HEADER))
    start = (_HEADER if _is_csv(path) else _JSON_START).encode()
    if head and not head.startswith(start[: len(head)]):
        raise ViewError(f"{path}: exists and holds no records of ours, so it is not overwritten; name another file")
