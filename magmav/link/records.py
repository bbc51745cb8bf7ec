"""Records of a tlog: 8 bytes of big-endian microseconds since 1970, then one MAVLink frame.

Nothing in a record proves it, so trust comes from company: a header is believed when the record behind it
is believable too, or when its time goes on within a second of the last one believed. Damage costs the record
it hit, not the file. The two lowest bits of a time may hold a link number (MAVProxy's habit); that is below
what matters here.
"""

from __future__ import annotations

import re
import struct

from magmav.link.frames import LONGEST, SIGNED, V1, V2

SECOND_US = 1_000_000
DAY_US = 86_400_000_000
YEAR_2000_US = 946_684_800_000_000
YEAR_2100_US = 4_102_444_800_000_000
# Time, magic, payload length, incompatibility flags (in a version 1 frame: sequence number).
HEAD = struct.Struct(">QBBB")
STAMP = 8
LONGEST_RECORD = STAMP + LONGEST
RUN = 4  # records in a row that agree among themselves before a clock is believed to have been set

# A time between 2000 and 2100 has these two bytes in front; the search runs at C speed on them.
_START = re.compile(rb"\x00[\x03-\x0e].{6}[\xfd\xfe]", re.DOTALL)


def record_size(magic: int, length: int, flags: int) -> int:
    """Bytes of a record with this header, time included; 0 when no record has such a header."""
    if magic == V1:
        return STAMP + 8 + length
    if magic == V2 and not flags & ~SIGNED:
        return STAMP + 12 + length + (13 if flags else 0)
    return 0


def plausible(stamp_us: int, near_us: int | None) -> bool:
    """A time of this century, and within a day of ``near_us`` when that is known."""
    if not YEAR_2000_US <= stamp_us < YEAR_2100_US:
        return False
    return near_us is None or abs(stamp_us - near_us) <= DAY_US


def run_length(data: bytes, at: int, *, last: bool) -> int:
    """How many believable records stand in a row at ``at``, each within a day of the one before; at most RUN.

    The end of the file, or a header cut short by it, counts as a believable record behind the last whole one.
    """
    near_us: int | None = None
    for count in range(RUN):
        if at + HEAD.size > len(data):
            return count + 1 if last and count and at <= len(data) else count
        stamp_us, magic, length, flags = HEAD.unpack_from(data, at)
        size = record_size(magic, length, flags)
        if size == 0 or not plausible(stamp_us, near_us):
            return count
        near_us, at = stamp_us, at + size
    return RUN


def find_record(data: bytes, start: int, stop: int, near_us: int | None, *, last: bool) -> int:
    """First place in start..stop-1 where a whole, believable record begins; -1 when there is none.

    Within a second of the last known time it needs no company: by chance 64 bits say so once in 10^13 places, and a
    frame between two pieces of garbage has none. Near it, one believable record behind it is enough; a foreign time
    needs RUN in a row.
    """
    at = start
    while found := _START.search(data, at, min(stop + STAMP, len(data))):
        at = found.start()
        if at + HEAD.size <= len(data):
            stamp_us, magic, length, flags = HEAD.unpack_from(data, at)
            size = record_size(magic, length, flags)
            if near_us is not None and abs(stamp_us - near_us) <= SECOND_US:
                wanted = 1
            else:
                wanted = 2 if plausible(stamp_us, near_us) else RUN
            if 0 < size <= len(data) - at and run_length(data, at, last=last) >= wanted:
                return at
        at += 1
    return -1
