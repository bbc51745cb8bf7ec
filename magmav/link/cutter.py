"""A tlog's bytes to packets whose time never goes back and never leaps because of a damaged byte."""

from __future__ import annotations

from collections import Counter

from magmav.link import Packet
from magmav.link.frames import V1, V2
from magmav.link.records import (
    HEAD,
    LONGEST_RECORD,
    RUN,
    SECOND_US,
    STAMP,
    find_record,
    plausible,
    record_size,
)

_MINUTE_US = 60 * SECOND_US
_TICKS = 5  # quiet ticks at most in one gap: enough for every timeout to be met, however long the gap
# Bytes in sight that any decision below needs, except at the end of the file.
AHEAD = 2 * RUN * LONGEST_RECORD


class RecordCutter:
    """Fed with pieces of a file, gives packets. Knows no file and no clock.

    Every batch has one unix_offset_ns: packet time plus it is the UNIX time of the record. It is 0 until
    the recorder's clock was set (by GPS, by hand); from there time goes on without a leap.
    counts : "records", "garbage bytes", "resync", "truncated", "damaged time", "clock set".
    """

    def __init__(self, counts: Counter[str], route: str) -> None:
        self._unix_offset_ns = 0
        self._counts = counts
        self._route = route
        self._data = b""
        self._last = False
        self._at = 0  # the current record while on the chain, else where the search goes on
        self._end = 0
        self._stamp_us: int | None = None  # last believed time
        self._lost = True
        self._skipped = 0  # bytes since the chain broke

    def feed(self, data: bytes, *, last: bool) -> None:
        """More of the file; ``last``: nothing follows."""
        self._data = self._data[self._at :] + data
        self._end -= self._at
        self._at = 0
        self._last = last

    def cut(self) -> tuple[int, list[Packet]]:
        """unix_offset_ns and the next batch of packets; no packets: more bytes are wanted, or none left."""
        out: list[Packet] = []
        offset_ns = self._unix_offset_ns
        while self._search() if self._lost else self._walk(out):
            if self._unix_offset_ns != offset_ns:
                if out:
                    break
                offset_ns = self._unix_offset_ns
        return offset_ns, out

    def _walk(self, out: list[Packet]) -> bool:
        """Follow the chain of records. False when more bytes are wanted, True to be called again."""
        data, at, end, offset_ns = self._data, self._at, self._end, self._unix_offset_ns
        stamp_us = self._stamp_us or 0
        unpack, add, route = HEAD.unpack_from, out.append, self._route
        safe = len(data) - (HEAD.size if self._last else AHEAD)
        known = len(out)
        odd = False
        while end <= safe:
            then_us, magic, length, flags = unpack(data, end)
            if magic == V2 and flags == 0:
                size = length + 20
            elif magic == V1:
                size = length + 16
            else:
                size = record_size(magic, length, flags)
            if size == 0 or not 0 <= then_us - stamp_us <= SECOND_US:
                odd = True
                break
            add(Packet(stamp_us * 1000 - offset_ns, data[at + STAMP : end], route))
            at, end, stamp_us = end, end + size, then_us
        self._counts["records"] += len(out) - known
        self._at, self._end, self._stamp_us = at, end, stamp_us
        if odd:
            self._oddity(out, then_us, size)
            return True
        if self._last:
            self._break(out)
        return self._last

    def _oddity(self, out: list[Packet], then_us: int, size: int) -> None:
        """The header behind the current record is no header, or its time is not the next one."""
        data, end, now_us = self._data, self._end, self._stamp_us or 0
        after = end + size
        behind_us = HEAD.unpack_from(data, after)[0] if after + HEAD.size <= len(data) else None
        returns = behind_us is not None and now_us - SECOND_US <= behind_us and plausible(behind_us, now_us)
        if size == 0:
            self._break(out)
        elif plausible(then_us, now_us):
            if then_us < now_us - SECOND_US:  # set back, if the one behind says so too
                off_us = _MINUTE_US if behind_us is None else abs(behind_us - then_us)
                damaged = off_us >= min(_MINUTE_US, abs((behind_us or 0) - now_us))
            else:  # a silence, unless the one behind comes before
                damaged = plausible(behind_us or 0, now_us) and (behind_us or 0) < then_us - SECOND_US
            self._next(out, end, None if damaged else then_us)
        elif (returns and record_size(*data[after + STAMP : after + HEAD.size])) or (after == len(data) and self._last):
            self._next(out, end, None)
        else:
            self._break(out)  # a clock set by more than a day is found from there

    def _break(self, out: list[Packet]) -> None:
        """Nothing believable is behind the current record: one of the two is damaged, or the file ends."""
        data, at, end = self._data, self._at, self._end
        if not (self._last and end == len(data)):
            found = find_record(data, at + 1, min(end, len(data)), self._stamp_us, last=self._last)
            if found >= 0:  # a good record within this one: its length was a lie
                self._begin(found)
                return
        if end <= len(data):
            self._emit(out)
            self._at = end
        self._lost = True

    def _search(self) -> bool:
        """Look for the next record. False when there is none in sight."""
        data, at = self._data, self._at
        stop = len(data) if self._last else len(data) - AHEAD
        found = find_record(data, at, stop, self._stamp_us, last=self._last)
        if found >= 0:
            self._begin(found)
            return True
        if stop > at:
            rest = data[at:stop]
            if self._last and len(rest) < LONGEST_RECORD and _begins_a_record(rest, self._stamp_us):
                self._counts["truncated"] += 1
            else:
                self._skipped += len(rest)
            self._at = stop
        if self._last and self._skipped:
            self._counts["garbage bytes"] += self._skipped
            self._skipped = 0
        return False

    def _begin(self, found: int) -> None:
        """Take up the chain at ``found``; what lies between is damage."""
        data = self._data
        self._skipped += found - self._at
        if self._skipped:
            self._counts["garbage bytes"] += self._skipped
            self._counts["resync"] += 1
        self._skipped = 0
        stamp_us, magic, length, flags = HEAD.unpack_from(data, found)
        self._lost = False
        self._take(found, found + record_size(magic, length, flags), stamp_us)

    def _next(self, out: list[Packet], at: int, stamp_us: int | None) -> None:
        """Deliver the current record and go on to the one at ``at``; None: its time is damaged."""
        self._emit(out)
        _, magic, length, flags = HEAD.unpack_from(self._data, at)
        if stamp_us is None:
            self._counts["damaged time"] += 1
        before_ns = self._now_ns()
        self._take(at, at + record_size(magic, length, flags), stamp_us)
        gap_s = (self._now_ns() - before_ns - 1) // 1_000_000_000
        out.extend(Packet(before_ns + i * 1_000_000_000, b"", "") for i in range(1, min(gap_s, _TICKS) + 1))

    def _take(self, at: int, end: int, stamp_us: int | None) -> None:
        """Make the record at..end the current one. Time goes on from the last record, whatever the stamp."""
        was_us = self._stamp_us
        self._at, self._end = at, end
        if was_us is None:
            self._stamp_us = stamp_us
        elif stamp_us is not None and not -SECOND_US <= stamp_us - was_us < 0:
            if stamp_us < was_us or not plausible(stamp_us, was_us):
                self._counts["clock set"] += 1
                self._unix_offset_ns += (stamp_us - was_us) * 1000
            self._stamp_us = stamp_us

    def _emit(self, out: list[Packet]) -> None:
        self._counts["records"] += 1
        out.append(Packet(self._now_ns(), self._data[self._at + STAMP : self._end], self._route))

    def _now_ns(self) -> int:
        return (self._stamp_us or 0) * 1000 - self._unix_offset_ns


def _begins_a_record(rest: bytes, near_us: int | None) -> bool:
    """Could these last bytes of a file be the front of a record?"""
    if len(rest) <= STAMP:
        return True
    return plausible(int.from_bytes(rest[:STAMP], "big"), near_us) and rest[STAMP] in (V1, V2)
