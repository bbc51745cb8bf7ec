"""A recorded .tlog as a link: the log's own times, as fast as the reader turns the crank."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

from magmav.link import LinkError, Packet
from magmav.link.cutter import RecordCutter

_CHUNK = 1 << 18
_FIRST_LOOK = 1 << 20
_OTHER_LOGS = ((b"\xa3\x95", "a DataFlash log (.bin)"), (b"ULog", "a PX4 ULog (.ulg)"))


class TlogLink:
    """One packet per record, in the file's own order and time; ends at the end of the file.

    progress : called with (bytes done, bytes in all) now and then, and at the end.
    Between records over 1 s apart come up to five quiet ticks, so that timeouts are met as they were live.
    Time never goes back; where the recorder's clock was set, unix_offset_ns changes instead (it is 0 before).
    LinkError: no such file, not readable, not a tlog. Damage inside is counted, see RecordCutter.
    """

    datagrams = True

    def __init__(self, path: str | Path, progress: Callable[[int, int], None] | None = None) -> None:
        self.name = f"tlog:{path}"
        self.unix_offset_ns = 0
        self.counts: Counter[str] = Counter()
        self._progress = progress
        self._closed = False
        self._done = 0
        self._cutter = RecordCutter(self.counts, "tlog")
        self._file, self._size = _open(Path(path))
        try:
            self._first = self._look(Path(path))
        except LinkError:
            self._file.close()
            raise

    def packets(self) -> Iterator[Packet]:
        """Packets, once through, until the end of the file or close(). LinkError when it cannot be read."""
        try:
            batch = self._first
            while not self._closed:
                self.unix_offset_ns, packets = batch
                for packet in packets:
                    yield packet
                    if self._closed:
                        return
                if not packets and not self._more(_CHUNK):
                    return
                batch = self._cutter.cut()
        finally:
            self.close()

    def send(self, data: bytes, route: str = "") -> None:
        """A recording hears nothing: counted, nothing else."""
        self.counts["not sent"] += 1

    def close(self) -> None:
        """Stop and let go of the file."""
        self._closed = True
        self._file.close()

    def _look(self, path: Path) -> tuple[int, list[Packet]]:
        """The first batch; LinkError when the file's front holds none."""
        head = self._read(_FIRST_LOOK)
        self._cutter.feed(head, last=self._done >= self._size)
        batch = self._cutter.cut()
        if batch[1]:
            return batch
        for front, what in _OTHER_LOGS:
            if head.startswith(front):
                raise LinkError(f"{path}: not a tlog: this is {what}; use a command that reads such logs")
        where = "in it" if self._done >= self._size else "in the first 1 MB"
        bare = head[:1] in (b"\xfd", b"\xfe")
        hint = " (MAVLink without times? a tlog has 8 bytes of time before each frame)" if bare else ""
        raise LinkError(
            f"{path}: not a tlog: no MAVLink record found {where}{hint}; "
            "give a .tlog as written by a ground station, or check that the copy is whole"
        )

    def _more(self, size: int) -> bool:
        """Feed the cutter; False at the end of the file."""
        if self._done >= self._size:
            return False
        self._cutter.feed(self._read(size), last=self._done >= self._size)
        return True

    def _read(self, size: int) -> bytes:
        try:
            data = self._file.read(min(size, self._size - self._done))
        except OSError as error:
            raise LinkError(f"{self.name}: cannot read on at byte {self._done}: {error.strerror}") from error
        # A file that has shrunk since it was opened simply ends here.
        self._done = self._done + len(data) if data else self._size
        if self._progress is not None:
            self._progress(self._done, self._size)
        return data


def _open(path: Path) -> tuple[BinaryIO, int]:
    """The open file and its size; LinkError naming path, cause and cure."""
    try:
        if path.is_dir():
            raise LinkError(f"{path}: is a directory; give the .tlog file in it")
        if path.exists() and not path.is_file():
            raise LinkError(f"{path}: is not a regular file; give a .tlog file")
        file = path.open("rb")
        size = os.fstat(file.fileno()).st_size
    except FileNotFoundError:
        raise LinkError(f"{path}: no such file; check the path") from None
    except PermissionError:
        raise LinkError(f"{path}: permission denied; make the file readable for this user") from None
    except (OSError, ValueError) as error:
        raise LinkError(f"{path}: cannot be opened: {error}") from error
    if size == 0:
        file.close()
        raise LinkError(f"{path}: is empty; the recording holds nothing, take another one")
    return file, size
