"""A recording gone through once, and everything of it that a fit needs kept."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from magmav.comparison import Tape
from magmav.core.channel import Circumstances
from magmav.core.types import CurrentReading, ParamReading, Reading, Record, Sample

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
        self._parameters: dict[int, dict[str, float]] = {}
        self._moved_s: dict[int, list[float]] = {}

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
        elif isinstance(reading, ParamReading):
            held = self._parameters.setdefault(reading.system, {})
            if held.get(reading.name, reading.value) != reading.value and "MAG" in reading.name.replace(
                "COMPASS", "MAG"
            ):
                self._moved_s.setdefault(reading.system, []).append(self._latest_s.get(reading.system, -math.inf))
            held[reading.name] = reading.value

    def parameters(self, system: int) -> dict[str, float]:
        """Every parameter as last heard."""
        return dict(self._parameters.get(system, {}))

    def moved_s(self, system: int) -> tuple[float, ...]:
        """Boot times at which a compass parameter came to another value."""
        return tuple(self._moved_s.get(system, ()))

    def currents(self, system: int) -> Currents | None:
        """Of the boot with most of them; None where nobody said."""
        found = [c for (s, _), c in self._currents.items() if s == system]
        return max(found, key=lambda c: len(c.ampere), default=None)

    def close(self) -> None:
        """At the end of the recording."""
        for tape in self.tapes.values():
            tape.close()


def settled_after(boot_s: Floats, moved_s: Sequence[float], settle_s: float) -> NDArray[np.bool_]:
    """(N,): within so many seconds of one of these moments."""
    out = np.zeros(len(boot_s), dtype=bool)
    for t in moved_s:
        out |= (boot_s >= t) & (boot_s <= t + 3.0 * settle_s)
    return out
