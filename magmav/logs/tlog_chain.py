"""Where the records of a tlog lie, found for whole runs at a time; exactly as link.cutter finds them one by one.

A record's length stands in its header, so records form a chain. Every place that looks like a header is found at
once; where each of a run ends at the next, and times go on, the run is taken in one step. Wherever that is not so,
link.cutter decides, with the very same code.
"""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magmav.link import Packet
from magmav.link.cutter import RecordCutter
from magmav.link.frames import SIGNED, V1, V2
from magmav.link.records import HEAD, STAMP, record_size

Ints = NDArray[np.int64]

_SECOND_US = 1_000_000
_BLOCK = 1 << 24  # bytes looked at in one go, so that memory does not grow with the file


class Records(NamedTuple):
    """Frames of a tlog in the order of the file: data[begin:end] and the time of each, as a Packet's; (N,) each."""

    begin: Ints
    end: Ints
    t_ns: Ints


class _Headers(NamedTuple):
    """Places that look like a record: where, where it ends, its time; which continues it, and how far a run goes on."""

    at: Ints
    end: Ints
    stamp_us: Ints
    following: Ints  # index of the record that begins at its end, and is next in time; -1: none
    run: Ints  # index of the last of the run it stands in


class _Chain(RecordCutter):
    """The cutter over a whole file; keeps places instead of packets."""

    def __init__(self, data: bytes, counts: Counter[str]) -> None:
        super().__init__(counts, "")
        self._headers = _headers(np.frombuffer(data, dtype=np.uint8))
        self._pieces: list[tuple[Ints, Ints, Ints]] = []
        self.feed(data, last=True)

    def records(self) -> Records:
        """All of them."""
        while self.cut()[1]:  # it stops wherever the clock was set, to say so
            pass
        if not self._pieces:
            none = np.zeros(0, dtype=np.int64)
            return Records(none, none, none)
        begin, end, t_ns = (np.concatenate(column) for column in zip(*self._pieces, strict=True))
        return Records(begin, end, t_ns)

    def _walk(self, out: list[Packet]) -> bool:
        """As the cutter's own, by runs."""
        data, safe = self._data, len(self._data) - HEAD.size
        while True:
            self._leap()
            if self._end > safe:
                break
            then_us, magic, length, flags = HEAD.unpack_from(data, self._end)
            size = record_size(magic, length, flags)
            if size == 0 or not 0 <= then_us - (self._stamp_us or 0) <= _SECOND_US:
                self._oddity(out, then_us, size)
                return True
            self._emit(out)
            self._at, self._end, self._stamp_us = self._end, self._end + size, then_us
        self._break(out)
        return True

    def _leap(self) -> None:
        """Take all that follows without doubt; the current record is the last of it afterwards."""
        h = self._headers
        one = int(np.searchsorted(h.at, self._at))
        if one == len(h.at) or h.at[one] != self._at or h.stamp_us[one] != self._stamp_us:
            return
        taken = []
        while True:
            last = int(h.run[one])
            if last > one:
                taken.append(np.arange(one, last))
            one = int(h.following[last])
            if one < 0:
                break
            taken.append(np.array([last]))
        if taken:
            self._add(np.concatenate(taken))
            self._at, self._end, self._stamp_us = int(h.at[last]), int(h.end[last]), int(h.stamp_us[last])

    def _add(self, which: Ints) -> None:
        h = self._headers
        self._counts["records"] += len(which)
        t_ns = h.stamp_us[which] * 1000 - self._unix_offset_ns
        self._pieces.append((h.at[which] + STAMP, h.end[which], t_ns))

    def _emit(self, out: list[Packet]) -> None:
        self._counts["records"] += 1
        place = (self._at + STAMP, self._end, self._now_ns())
        begin, end, t_ns = (np.array([v], dtype=np.int64) for v in place)
        self._pieces.append((begin, end, t_ns))


def records(data: bytes, counts: Counter[str]) -> Records:
    """The records of a whole tlog; ``counts`` as RecordCutter's."""
    return _Chain(data, counts).records()


def _headers(data: NDArray[np.uint8]) -> _Headers:
    last = len(data) - HEAD.size + 1  # a header must be whole
    found = [_places(data, begin, min(begin + _BLOCK, last)) for begin in range(0, max(last, 0), _BLOCK)]
    at = np.concatenate(found) if found else np.zeros(0, dtype=np.int64)
    if len(at) == 0:
        return _Headers(at, at, at, at, at)
    stamp_us = np.ndarray((len(data) - 7,), dtype=">u8", buffer=data.data, strides=(1,))[at].astype(np.int64)
    magic, length, flags = (data[at + STAMP + i] for i in range(3))
    size = np.where(magic == V1, STAMP + 8, STAMP + 12 + np.where(flags == SIGNED, 13, 0)) + length.astype(np.int64)
    fits = (magic == V1) | (flags <= SIGNED)  # else no record has such a header
    end = at + size
    following = np.full(len(at), -1, dtype=np.int64)
    behind = np.arange(1, len(at) + 1)
    apart = np.append(at[1:], -1) != end
    behind[apart] = np.searchsorted(at, end[apart])
    there = np.flatnonzero((behind < len(at)) & fits)
    there = there[(at[behind[there]] == end[there]) & fits[behind[there]]]
    ahead_us = stamp_us[behind[there]] - stamp_us[there]
    there = there[(ahead_us >= 0) & (ahead_us <= _SECOND_US)]
    following[there] = behind[there]
    index = np.arange(len(at))
    stops = np.flatnonzero(following != index + 1)  # never empty: the last has no other behind it
    return _Headers(at, end, stamp_us, following, stops[np.searchsorted(stops, index)])


def _places(data: NDArray[np.uint8], begin: int, stop: int) -> Ints:
    """Where two bytes of a time of this century stand eight bytes before a magic byte, begin <= place < stop."""
    magic = data[begin + STAMP : stop + STAMP]
    near = np.flatnonzero((magic == V1) | (magic == V2)) + begin
    second = data[near + 1]
    out: Ints = near[(data[near] == 0) & (second >= 0x03) & (second <= 0x0E)]
    return out
