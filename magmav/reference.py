"""What a heading is scored against: a named attitude over time, from the vehicle or from a truth file.

The name travels with every number and picture made from it, because an autopilot's yaw usually follows the
very compass being judged, and an optical truth does not.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magmav.core.types import AttitudeReading

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

CSV_COLUMNS = ("boot_time_s", "roll_deg", "pitch_deg", "heading_true_deg")
GAP_S = 0.5
"""A straight line is wrong by at most acceleration dt^2 / 8: 2 degrees across half a second at 60 deg/s^2."""
_SLACK_S = 1e-6  # a stream at exactly the gap must not lose every second interval to rounding


class TruthError(Exception):
    """A truth file that cannot be used; the text names file, line and column."""


class Attitude(NamedTuple):
    """Attitude at asked times, rad, yaw true; NaN wherever ``valid`` is False. All (N,)."""

    roll_rad: Floats
    pitch_rad: Floats
    yaw_true_rad: Floats
    armed: Flags
    airborne: Flags
    valid: Flags


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """Attitude over the vehicle's boot time. Arrays are (N,), boot_s strictly rising, angles in radians.

    armed and airborne hold from their own time on; where a recording does not say, they are True, so that a
    bench recording is scored rather than thrown away. Stretches longer than gap_s are not bridged.
    """

    name: str
    boot_s: Floats
    roll_rad: Floats
    pitch_rad: Floats
    yaw_true_rad: Floats
    armed: Flags
    airborne: Flags
    gap_s: float = GAP_S
    phases_known: bool = False  # armed and airborne come from the vehicle

    def __post_init__(self) -> None:
        for field in ("boot_s", "roll_rad", "pitch_rad", "yaw_true_rad", "armed", "airborne"):
            kind = np.bool_ if field in ("armed", "airborne") else np.float64
            value: NDArray[Any] = np.array(getattr(self, field), dtype=kind)
            if value.shape != self.boot_s.shape or value.ndim != 1 or not np.isfinite(value).all():
                raise ValueError(f"{self.name}: {field}: want {len(self.boot_s)} finite values, one per time")
            value.flags.writeable = False
            object.__setattr__(self, field, value)
        if (np.diff(self.boot_s) <= 0.0).any():
            raise ValueError(f"{self.name}: boot_s: times must rise")

    @classmethod
    def from_attitude(
        cls, readings: Sequence[AttitudeReading], name: str = "ATTITUDE yaw", gap_s: float = GAP_S
    ) -> Self:
        """One vehicle's attitude messages of one kind, any order; of two with one boot time the first counts.

        One boot only: boot times that begin again would mix two flights, so cut at a reboot before calling.
        """
        kinds = {(r.system, r.source) for r in readings}
        if len(kinds) > 1:
            raise ValueError(f"readings: want one system and one source, got {sorted(kinds)}")
        table = np.array([(r.boot_ns, r.roll_rad, r.pitch_rad, r.yaw_rad) for r in readings]).reshape(-1, 4)
        boot_ns, roll, pitch, yaw = table.T
        return cls.from_columns(boot_ns, roll, pitch, yaw, name, gap_s)

    @classmethod
    def from_columns(
        cls, boot_ns: Floats, roll_rad: Floats, pitch_rad: Floats, yaw_rad: Floats, name: str, gap_s: float = GAP_S
    ) -> Self:
        """The same from columns, (N,) each."""
        times, first = np.unique(boot_ns, return_index=True)
        yes = np.ones(len(first), dtype=bool)
        return cls(name, times / 1e9, roll_rad[first], pitch_rad[first], yaw_rad[first], yes, yes, gap_s)

    @classmethod
    def from_csv(cls, path: str | Path, gap_s: float = GAP_S) -> Self:
        """A truth table with the columns CSV_COLUMNS (others are ignored); TruthError names what is wrong."""
        path = Path(path)
        table = np.array(_read_table(path)).reshape(-1, 4)
        boot_s = table[:, 0]
        roll, pitch, yaw = np.radians(table[:, 1:]).T
        yes = np.ones(len(boot_s), dtype=bool)
        return cls(f"file {path.name}", boot_s, roll, pitch, yaw, yes, yes, gap_s)

    def with_flags(self, boot_s: ArrayLike, armed: ArrayLike, airborne: ArrayLike) -> Self:
        """The same with the flight's phases: at each time of boot_s (M,) both flags begin to hold.

        Before the first of those times the first flags hold.
        """
        times = np.asarray(boot_s, dtype=np.float64)
        if times.ndim != 1 or len(times) == 0 or (np.diff(times) < 0.0).any():
            raise ValueError("boot_s: want at least one time, rising")
        at = np.maximum(np.searchsorted(times, self.boot_s, side="right") - 1, 0)
        flags = [np.asarray(f, dtype=bool) for f in (armed, airborne)]
        for flag, name in zip(flags, ("armed", "airborne"), strict=True):
            if flag.shape != times.shape:
                raise ValueError(f"{name}: want {len(times)} flags, one per time")
        return replace(self, armed=flags[0][at], airborne=flags[1][at], phases_known=True)

    def interpolate(self, boot_s: ArrayLike) -> Attitude:
        """Attitude at boot_s (N,), each angle the short way round; invalid outside the series and in gaps."""
        asked = np.asarray(boot_s, dtype=np.float64)
        if asked.ndim != 1:
            raise ValueError(f"boot_s: want shape (N,), got {asked.shape}")
        count = len(self.boot_s)
        if count == 0:
            nothing, no = np.full(len(asked), np.nan), np.zeros(len(asked), dtype=bool)
            return Attitude(nothing, nothing, nothing, no, no, no)
        left = np.clip(np.searchsorted(self.boot_s, asked, side="right") - 1, 0, count - 1)
        right = np.minimum(left + 1, count - 1)
        gap = self.boot_s[right] - self.boot_s[left]
        past = asked - self.boot_s[left]
        valid = (past == 0.0) | ((past > 0.0) & (past < gap) & (gap <= self.gap_s + _SLACK_S))
        share = np.where(valid, past, 0.0) / np.where(gap > 0.0, gap, 1.0)

        def between(angle_rad: Floats) -> Floats:
            here = angle_rad[left]
            out = shortest_rad(here + share * shortest_rad(angle_rad[right] - here))
            return np.where(valid, out, np.nan)

        angles = (between(self.roll_rad), between(self.pitch_rad), between(self.yaw_true_rad))
        return Attitude(*angles, self.armed[left] & valid, self.airborne[left] & valid, valid)


def shortest_rad(angle_rad: ArrayLike) -> Floats:
    """The same angles in [-pi, pi)."""
    return np.asarray((np.asarray(angle_rad) + math.pi) % (2.0 * math.pi) - math.pi, dtype=np.float64)


def _read_table(path: Path) -> list[tuple[float, ...]]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            return _parse(path, file)
    except OSError as error:
        raise TruthError(f"{path}: cannot read: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise TruthError(f"{path}: not a CSV text file: {error}") from error


def _parse(path: Path, file: Iterable[str]) -> list[tuple[float, ...]]:
    lines = csv.reader(file)
    header = [name.strip() for name in next(lines, [])]
    missing = [name for name in CSV_COLUMNS if name not in header]
    if missing:
        raise TruthError(f"{path}, line 1: no column {missing[0]}; want {', '.join(CSV_COLUMNS)}")
    places = [header.index(name) for name in CSV_COLUMNS]
    out: list[tuple[float, ...]] = []
    for cells in lines:
        if not any(cell.strip() for cell in cells):
            continue
        values = []
        for name, place in zip(CSV_COLUMNS, places, strict=True):
            cell = cells[place] if place < len(cells) else ""
            try:
                value = float(cell)
            except ValueError:
                value = math.nan
            if not math.isfinite(value):
                raise TruthError(f"{path}, line {lines.line_num}, column {name}: not a number: {cell!r}")
            values.append(value)
        if out and values[0] <= out[-1][0]:
            raise TruthError(f"{path}, line {lines.line_num}, column {CSV_COLUMNS[0]}: times must rise")
        out.append(tuple(values))
    if not out:
        raise TruthError(f"{path}: a header and no rows")
    return out
