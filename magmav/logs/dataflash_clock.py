"""When each record of a DataFlash log was written: boot time, and which boot where one file holds several.

Times stand in TimeUS, or TimeMS in logs up to 2015. There GPS.TimeMS is the GPS time of week, and T the boot time. A
record without a time (PARM, EV and MSG of old logs) was written when the record before it was.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magmav.logs.columns import Ints, Table, Tables, whole

_BACK_NS = 2_000_000_000  # further back than any message is written late: a reboot
_FEW = 5  # so few records in a row whose times fit nowhere are damage, not a boot
_PAUSE_NS = 1_000_000_000  # between two boots in one file, as nobody knows how long it was
_MOST_US = 10**14  # three years since boot: no boot time


class Moments(NamedTuple):
    """When and where records were written. All (n,): place in the file, number of the boot, boot time."""

    at: Ints
    boot: Ints
    ns: Ints

    def only(self, chosen: NDArray[np.bool_] | Ints) -> Moments:
        """Some of them."""
        return Moments(self.at[chosen], self.boot[chosen], self.ns[chosen])


class Clock:
    """Boot time of every record. counts : records whose own time fits nowhere, dropped.

    shift_ns : per boot, what takes boot time to one time that never goes back. It is 0 for the first boot.
    """

    def __init__(self, tables: Iterable[Table], counts: Counter[str]) -> None:
        timed = [(t.at, ns) for t in tables if (ns := _own_times(t)) is not None]
        at = np.concatenate([a for a, _ in timed]) if timed else np.zeros(0, dtype=np.int64)
        ns = np.concatenate([n for _, n in timed]) if timed else np.zeros(0, dtype=np.int64)
        order = np.argsort(at, kind="stable")
        at, ns = at[order], ns[order]
        boot = np.full(len(ns), -1, dtype=np.int64)
        boot[ns >= 0] = _boots(ns[ns >= 0])
        good = boot >= 0
        counts["time fits nowhere"] += int((~good).sum())
        self._all_at, self._all_boot = at, boot
        self._known = Moments(at[good], boot[good], ns[good])
        self.boots = int(boot.max(initial=-1)) + 1
        self.first_ns = [int(ns[boot == b].min()) for b in range(self.boots)]
        self.last_ns = [int(ns[boot == b].max()) for b in range(self.boots)]
        self.shift_ns = [0] * self.boots
        for b in range(1, self.boots):
            before = self.last_ns[b - 1] + self.shift_ns[b - 1]
            self.shift_ns[b] = before + _PAUSE_NS - self.first_ns[b]

    def moments(self, table: Table) -> tuple[Moments, NDArray[np.bool_]]:
        """When the records of a table were written, and (n,) which of those times can be used."""
        own = _own_times(table)
        if own is not None:
            boot = self._all_boot[np.searchsorted(self._all_at, table.at)]
            return Moments(table.at, boot, own), boot >= 0
        if not len(self._known.at):
            none = np.zeros(len(table), dtype=np.int64)
            return Moments(table.at, none, none), np.zeros(len(table), dtype=bool)
        before = np.maximum(np.searchsorted(self._known.at, table.at) - 1, 0)
        return Moments(table.at, self._known.boot[before], self._known.ns[before]), np.ones(len(table), dtype=bool)


def clock_of(tables: Tables, counts: Counter[str]) -> Clock:
    """The clock of a log."""
    return Clock((t for of_name in tables.by_name.values() for t in of_name), counts)


def _own_times(table: Table) -> Ints | None:
    """(n,) boot time in ns as the records themselves say it, -1 where that is no boot time; None for none."""
    if table.name.startswith("GPS") and "T" in table and "TimeUS" not in table:
        label, to_us = "T", 1000
    elif "TimeUS" in table:
        label, to_us = "TimeUS", 1
    elif "TimeMS" in table and not table.name.startswith("GPS"):
        label, to_us = "TimeMS", 1000
    else:
        return None
    us = whole(table.values(label))
    sane = (us >= 0) & (us < _MOST_US // to_us)
    return np.where(sane, us * (to_us * 1000), -1)


def _boots(ns: Ints) -> Ints:
    """(n,) number of the boot of each record, -1 where its time fits neither before nor after.

    ns : in the order of the file. Times within two seconds of the one before form a run. Long runs are believed: one
    that begins before the last had ended is a new boot. A few records that agree with neither neighbour are damage.
    """
    steps = np.diff(ns)
    edges = np.concatenate(([0], np.flatnonzero(np.abs(steps) > _BACK_NS) + 1, [len(ns)]))
    runs = [(a, b) for a, b in itertools.pairwise(edges.tolist()) if b > a]
    few = _FEW if any(b - a >= _FEW for a, b in runs) else 1
    out = np.full(len(ns), -1, dtype=np.int64)
    boot, latest = 0, None
    waiting: list[tuple[int, int]] = []
    for a, b in runs:
        if b - a < few:
            waiting.append((a, b))
            continue
        first = int(ns[a])
        if latest is not None and first < latest - _BACK_NS:
            boot += 1
            waiting.clear()
        for early, late in waiting:
            if (latest is None or ns[early] >= latest - _BACK_NS) and ns[late - 1] <= first + _BACK_NS:
                out[early:late] = boot
        waiting.clear()
        out[a:b] = boot
        latest = int(ns[b - 1])
    return out
