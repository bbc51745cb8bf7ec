"""Attitudes of a DataFlash log that follow each other, with the accelerometer and gyro between them, as runs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from magmav.core.motion_run import MotionRun, previous, run_ends
from magmav.core.types import Reading
from magmav.logs.columns import Ints
from magmav.logs.dataflash_series import Stream


class Order(NamedTuple):
    """In which order readings are played: of each (N,) its time, its stream and its row there."""

    t_ns: Ints
    stream: Ints
    row: Ints


class Runs:
    """Where runs begin in an Order.

    ends : (N,) past the last reading of the run that begins at a place, 0 where none does.
    """

    def __init__(self, streams: Sequence[Stream], order: Order) -> None:
        self._order, self._makers = order, [s.make for s in streams]
        self.ends: Ints = np.zeros(len(order.row), dtype=np.int64)
        which = next((i for i, s in enumerate(streams) if s.attitudes is not None and len(s.when.ns)), None)
        made = None if which is None else streams[which].attitudes
        if which is None or made is None:
            return
        self._columns, self._system = made(), self._makers[which](0).system
        is_attitude = order.stream == which
        inertial_ns = np.full(len(order.row), -1, dtype=np.int64)
        for i, stream in enumerate(streams):
            if stream.inertial:
                inertial_ns[order.stream == i] = stream.when.ns[order.row[order.stream == i]]
        self.ends = run_ends(self._columns, np.where(is_attitude, order.row, -1), inertial_ns)
        self._inertial_ns = inertial_ns
        self._attitudes_before = np.concatenate(([0], np.cumsum(is_attitude)))
        self._inertial_before = previous(np.append(inertial_ns >= 0, False))

    def at(self, place: int) -> MotionRun:
        """The run that begins here."""
        end, row = int(self.ends[place]), int(self._order.row[place])
        row_less = row - int(self._attitudes_before[place])
        ns, before_inertial, last = (-1, -1), -1, int(self._inertial_before[end])
        if last > place:  # a run begins with an attitude
            earlier = int(self._inertial_before[last])
            ns = int(self._inertial_ns[last]), int(self._inertial_ns[earlier]) if earlier > place else -1
            before_inertial = row_less + int(self._attitudes_before[last]) - 1
        until, times = row_less + int(self._attitudes_before[end]), self._columns.boot_ns
        again = partial(self._one_by_one, place, end)
        ends = times[row], times[until - 1]
        return MotionRun(self._system, self._columns, row, until, *ends, again, ns, before_inertial)

    def _one_by_one(self, begin: int, end: int) -> Iterator[tuple[int, Reading]]:
        for t, which, row in zip(*(column[begin:end].tolist() for column in self._order), strict=True):
            yield t, self._makers[which](row)
