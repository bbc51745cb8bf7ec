"""Columns of one message, with their times, in plain units; what is damaged is dropped and counted here."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magmav.core.motion_run import AttitudeColumns
from magmav.core.types import Reading
from magmav.logs.columns import WHOLE, Floats, Ints, Table, Tables
from magmav.logs.dataflash_clock import Clock, Moments

_NONE = np.zeros(0, dtype=np.int64)


class Pick(NamedTuple):
    """One wanted column.

    labels : its names over the years, the first found is taken.  otherwise : multiplier where the log states none;
    whole : the same where it is stored as an integer.  per : from base unit to ours.  most : larger is damage.
    missing : value where the column is missing; None refuses the table.
    """

    labels: tuple[str, ...]
    otherwise: float = 1.0
    whole: float | None = None
    per: float = 1.0
    most: float = 1e9
    missing: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """when : n moments, in the order of time.  values : (n, k), a column per Pick."""

    when: Moments
    values: Floats

    def __len__(self) -> int:
        return len(self.when.ns)


class Stream(NamedTuple):
    """Readings of one kind: make(i) is the one of the i-th moment. Of equal times the lower rank goes first.

    attitudes : makes columns of them, of attitudes.  inertial : whether they are of accelerometer and gyro.
    """

    when: Moments
    make: Callable[[int], Reading]
    rank: int = 2
    attitudes: Callable[[], AttitudeColumns] | None = None
    inertial: bool = False


class Log(NamedTuple):
    """Everything the readings are made from."""

    tables: Tables
    clock: Clock
    counts: Counter[str]

    def series(self, name: str, picks: Sequence[Pick], instance: int | None = None) -> Series:
        """The picked columns of every record of this message (of this instance), damage dropped and counted."""
        parts = [p for t in self.tables.of(name) if (p := self._part(t, picks, instance)) is not None]
        if not parts:
            return Series(Moments(_NONE, _NONE, _NONE), np.zeros((0, len(picks))))
        at, boot, ns = (np.concatenate([getattr(p.when, f) for p in parts]) for f in Moments._fields)
        values = np.concatenate([p.values for p in parts])
        order = np.lexsort((at, ns, boot))
        return Series(Moments(at, boot, ns).only(order), values[order])

    def _part(self, table: Table, picks: Sequence[Pick], instance: int | None) -> Series | None:
        columns = []
        for pick in picks:
            label = next((name for name in pick.labels if name in table), None)
            if label is None and pick.missing is None:
                self.counts[f"{table.name}: without {pick.labels[0]}"] += len(table)
                return None
            if label is None:
                columns.append(np.full(len(table), pick.missing))
                continue
            scale = pick.whole if pick.whole is not None and table.letters[label] in WHOLE else pick.otherwise
            columns.append(table.base(label, scale, pick.per))
        values = np.stack(columns, axis=1)
        when, good = self.clock.moments(table)
        if instance is not None:
            good = good & (table.instance() == instance)
        number = np.isfinite(values).all(axis=1)
        within = (np.abs(values) <= np.array([p.most for p in picks])).all(axis=1)
        self.counts[f"{table.name}: not a number"] += int((good & ~number).sum())
        self.counts[f"{table.name}: beyond belief"] += int((good & number & ~within).sum())
        good = good & number & within
        return Series(when.only(good), values[good])


def chosen(series: Series, good: NDArray[np.bool_] | Ints) -> Series:
    """Some rows of a series."""
    return Series(series.when.only(good), series.values[good])


def triples(values: Floats) -> list[Floats]:
    """Rows of an (n, 3) array as read-only vectors (3,), checked to be finite by whoever made them."""
    held = np.ascontiguousarray(values, dtype=np.float64)
    held.flags.writeable = False
    return list(held)
