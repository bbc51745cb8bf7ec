"""Where MAVLink frames begin and end, judged by magic byte and length alone.

Checksums need the dialect, which a link does not know; the codec judges content. The sizes are MAVLink's:
version 1 is 6 bytes of header, payload, 2 of checksum; version 2 is 10, payload, 2, and 13 more when signed.
"""

from __future__ import annotations

import re
from typing import NamedTuple

V1, V2 = 0xFE, 0xFD
SIGNED = 0x01  # the one incompatibility flag there is; a receiver must refuse frames with any other
LONGEST = 10 + 255 + 2 + 13

_MAGIC = re.compile(rb"[\xfd\xfe]")


def frame_size(data: bytes, at: int) -> int:
    """Bytes the frame at ``at`` claims, or 0 where no frame can begin.

    A header cut short by the end of the data counts as longer than what is there: a stream waits for more.
    """
    left = len(data) - at
    if left <= 0 or data[at] not in (V1, V2):
        return 0
    if data[at] == V1:
        return 8 + data[at + 1] if left > 1 else LONGEST
    if left < 3:
        return LONGEST
    flags = data[at + 2]
    if flags & ~SIGNED:
        return 0
    return 12 + data[at + 1] + (13 if flags else 0)


class Cut(NamedTuple):
    """Whole frames, the unfinished one at the end (under LONGEST bytes), and how many bytes were neither."""

    frames: list[bytes]
    rest: bytes
    garbage: int


def cut(data: bytes, *, whole: bool) -> Cut:
    """Frames in ``data``. ``whole``: nothing follows, so what is unfinished is garbage and never a rest."""
    frames: list[bytes] = []
    at = garbage = 0
    while found := _MAGIC.search(data, at):
        start = found.start()
        garbage += start - at
        size = frame_size(data, start)
        if 0 < size <= len(data) - start:
            frames.append(data[start : start + size])
            at = start + size
        elif size and not whole:
            return Cut(frames, data[start:], garbage)
        else:
            garbage += 1
            at = start + 1
    return Cut(frames, b"", garbage + len(data) - at)
