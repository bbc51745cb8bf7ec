"""Recordings that hold no MAVLink: ArduPilot DataFlash and PX4 ULog, as readings in boot time.

A recording is read once, front to back; its readings go into the same pipeline as those of a link. What a file says
of a quantity it does not know gives no reading, as in mavlink.decode.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, Protocol

from magmav.core.motion_run import MotionRun
from magmav.core.types import Reading

Progress = Callable[[int, int], None]
"""Called now and then with (done, in all), any unit, and once at the end."""


class LogError(Exception):
    """A recording that cannot be used; the text names the file, what is wrong with it, and what to do."""


HEAD = 1 << 16
"""So many bytes of a file's front are enough to tell what it is."""
_FMT_RECORD = re.compile(rb"\xa3\x95\x80..[A-Za-z][A-Za-z0-9_]{0,3}\0*[A-Za-z]", re.DOTALL)
_FMT_LINE = re.compile(rb"(?:\A(?:\xef\xbb\xbf)?|[\r\n])\s*FMT\s*,")
_MAVLINK = (0xFD, 0xFE)
_2000_US, _2100_US = 946_684_800_000_000, 4_102_444_800_000_000


def kind_of(head: bytes) -> str | None:
    """What a file is that begins so: "ulog", "dataflash" (binary), "text" (the same as lines), or None for neither.

    head : the first HEAD bytes. A log whose first bytes are lost, or that has a greeting or a byte order mark before
    its first line, is known by the first FMT further on. A .tlog is None, even where it carries a log in download.
    """
    if head.startswith(b"ULog"):
        return "ulog"
    if head.startswith(b"\xa3\x95"):
        return "dataflash"
    if len(head) > 8 and head[8] in _MAVLINK and _2000_US < int.from_bytes(head[:8], "big") < _2100_US:
        return None
    if _FMT_RECORD.search(head):
        return "dataflash"
    return "text" if _FMT_LINE.search(head) and b"\0" not in head.rstrip(b"\0") else None


@contextmanager
def open_log(path: Path, endings: str) -> Iterator[BinaryIO]:
    """The open file. LogError naming path, cause and cure where it cannot be opened or read.

    endings : what may be given instead of a directory, as ".bin or .log".
    """
    try:
        if path.is_dir():
            raise LogError(f"{path}: is a directory; give the {endings} file in it")
        if path.exists() and not path.is_file():
            raise LogError(f"{path}: is not a regular file; give a {endings} file")
        file = path.open("rb")
    except FileNotFoundError:
        raise LogError(f"{path}: no such file; check the path") from None
    except PermissionError:
        raise LogError(f"{path}: permission denied; make the file readable for this user") from None
    except (OSError, ValueError) as error:
        raise LogError(f"{path}: cannot be opened: {error}") from error
    with file:
        try:
            yield file
        except OSError as error:
            raise LogError(f"{path}: cannot be read: {error}; copy it again") from error


class Recording(Protocol):
    """One recorded file.

    heard : how many messages of each kind the file holds.
    unix_offset_ns : takes the times of ``readings`` to UNIX time where the file says so, else 0.
    """

    name: str
    heard: Counter[str]
    unix_offset_ns: int

    @property
    def counts(self) -> Counter[str]:
        """What was left out and why."""
        ...

    def readings(self) -> Iterator[tuple[int, Reading]]:
        """(t_ns, reading) in the order of time; t_ns is the vehicle's boot clock. Once through."""
        ...

    def in_runs(self) -> Iterator[tuple[int, Reading | MotionRun]]:
        """The same, with attitudes that follow each other as runs, where the file is read by columns. Instead of it."""
        ...

    def close(self) -> None:
        """Let go of the file. Safe to call twice."""
        ...
