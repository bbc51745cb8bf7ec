"""A recording gone through once, and everything of it that a fit needs kept."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from magmav.comparison import Columns, Tape
from magmav.core.channel import Circumstances
from magmav.core.types import CurrentReading, Reading, Record, Sample

Floats = NDArray[np.float64]


@dataclass(slots=True)
class Currents:
    """Battery current over boot time; each value holds until the next."""

    boot_s: list[float] = field(default_factory=list)
    ampere: list[float] = field(default_factory=list)

    def at(self, boot_s: Sequence[float] | Floats) -> Floats:
        """(N,) A; NaN before the first."""
        out = np.full(len(boot_s), np.nan)
        for i, t in enumerate(boot_s):
            place = bisect_right(self.boot_s, t)
            if place:
                out[i] = self.ampere[place - 1]
        return out


class Recorder:
    """Keeps the Samples of every compass and the battery's current while a recording is played (see vehicle.Tap)."""

    def __init__(self) -> None:
        self.tapes: dict[tuple[int, int], Tape] = {}
        self._currents: dict[tuple[int, int], Currents] = {}
        self._latest_s: dict[int, float] = {}
        self._boot: dict[int, int] = {}

    def tap(self, sample: Sample, circumstances: Circumstances, stretch: tuple[int, int]) -> None:
        """Take one sample."""
        self._latest_s[sample.system], self._boot[sample.system] = sample.boot_ns / 1e9, stretch[0]
        self.tapes.setdefault((sample.system, sample.compass), Tape()).add(sample, circumstances, stretch)

    def watch(self, reading: Reading, record: Record | None) -> None:
        """Take one reading; a current is of the moment of the last sample before it."""
        if isinstance(reading, CurrentReading) and reading.system in self._latest_s:
            series = self._currents.setdefault((reading.system, self._boot[reading.system]), Currents())
            series.boot_s.append(self._latest_s[reading.system])
            series.ampere.append(reading.ampere)

    def currents(self, system: int) -> Currents | None:
        """Of the boot with most of them; None where nobody said."""
        found = [c for (s, _), c in self._currents.items() if s == system]
        return max(found, key=lambda c: len(c.ampere), default=None)

    def close(self) -> None:
        """At the end of the recording."""
        for tape in self.tapes.values():
            tape.close()


def columns_of(tape: Tape) -> Columns:
    """The tape as arrays."""
    return Columns.of(tape.heard)
