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

    ends : past the last reading of the run that begins at a place, 0 where none does.
    """

    def __init__(self, streams: Sequence[Stream], order: Order) -> None:
        self._order, self._makers = order, [s.make for s in streams]
        self.ends: list[int] = [0] * len(order.row)
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
        self.ends = run_ends(self._columns, np.where(is_attitude, order.row, -1), inertial_ns).tolist()
        self._row: list[int] = order.row.tolist()
        self._inertial_ns: list[int] = inertial_ns.tolist()
        self._attitudes_before: list[int] = np.concatenate(([0], np.cumsum(is_attitude))).tolist()
        self._inertial_before: list[int] = previous(np.append(inertial_ns >= 0, False)).tolist()

    def at(self, place: int) -> MotionRun | None:
        """The run that begins here."""
        end = self.ends[place]
        if end <= place:
            return None
        many, row = self._attitudes_before, self._row[place]
        ns, before_inertial, last = (-1, -1), -1, self._inertial_before[end]
        if last > place:  # a run begins with an attitude
            earlier = self._inertial_before[last]
            ns = self._inertial_ns[last], self._inertial_ns[earlier] if earlier > place else -1
            before_inertial = row + many[last] - many[place] - 1
        until = row + many[end] - many[place]
        again = partial(self._one_by_one, place, end)
        times = self._columns.boot_ns
        ends = times[row], times[until - 1]
        return MotionRun(self._system, self._columns, row, until, *ends, again, ns, before_inertial)

    def _one_by_one(self, begin: int, end: int) -> Iterator[tuple[int, Reading]]:
        for t, which, row in zip(*(column[begin:end].tolist() for column in self._order), strict=True):
            yield t, self._makers[which](row)
