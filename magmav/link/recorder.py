"""A tee around any link: what came and what went, as a tlog any ground station can read."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Protocol

from magmav.link import Link, LinkError, Packet, routes_of, whole_frames
from magmav.link.frames import V2, cut

_FLUSH_NS = 1_000_000_000
_FLUSH_BYTES = 1 << 16
_MOST_EARLY = 256  # sends kept until the link first tells the time
_SETUP_SIGNING = (256).to_bytes(3, "little")  # the message that carries a signing key (S17)
_MOST_ROUTES = 64  # unfinished frames kept, one for each route


class ByteSink(Protocol):
    """What a recording is written to: write gives the number of bytes taken, as io.RawIOBase has it."""

    def write(self, data: bytes, /) -> int | None: ...
    def flush(self) -> None: ...


class TlogRecorder:
    """Passes everything through and appends every whole frame, both ways, to a tlog.

    A path is appended to, never overwritten, and closed with the link; a file object stays the caller's.
    A frame sent carries the time of the last packet. Written at least every second of link time. When the
    disk is full recording stops ("recording stopped") and the link goes on.
    counts (the link's own): "recorded", "unrecorded bytes" that formed no frame, "keys not recorded" (SETUP_SIGNING),
    "recording stopped".
    """

    def __init__(self, link: Link, target: str | Path | ByteSink) -> None:
        self.name = link.name
        self.datagrams = link.datagrams
        self.unix_offset_ns = link.unix_offset_ns
        self.counts: Counter[str] = link.counts
        self._link = link
        self._own: _Closable | None = None
        self._sink: ByteSink | None
        if isinstance(target, str | Path):
            self._sink = self._own = _append_to(target)
        else:
            self._sink = target
        self._rest: dict[str, bytes] = {}
        self._waiting = bytearray()
        self._early: list[bytes] = []
        self._now_ns: int | None = None
        self._flushed_ns = 0
        self._closed = False
        self._writing = False

    def packets(self) -> Iterator[Packet]:
        """The link's packets, unchanged, each recorded before it is handed on."""
        try:
            for packet in self._link.packets():
                self.unix_offset_ns = self._link.unix_offset_ns
                self._tell(packet.t_ns)
                if packet.data:
                    self._record(packet.data, packet.route, whole=self.whole(packet.route))
                yield packet
        finally:
            self._write()  # the reader may have stopped half way, and may come back

    @property
    def routes(self) -> tuple[str, ...]:
        """The link's."""
        return routes_of(self._link)

    def whole(self, route: str) -> bool:
        """As the link says."""
        return whole_frames(self._link, route)

    def send(self, data: bytes, route: str = "") -> None:
        """Send, and record what was handed over (a link cannot know what arrived)."""
        self._link.send(data, route)
        if self._now_ns is not None:
            self._record(data, "", whole=True)
        elif len(self._early) < _MOST_EARLY:
            self._early.append(data)

    def close(self) -> None:
        """Close the link, write what waits. A signal amid a write leaves the end to the writer."""
        self._closed = True
        self._link.close()
        if not self._writing:
            self._finish()

    def _tell(self, t_ns: int) -> None:
        """The link says what time it is."""
        if self._now_ns is None:
            self._now_ns = self._flushed_ns = t_ns
            for data in self._early:
                self._record(data, "", whole=True)
            self._early.clear()
        self._now_ns = t_ns
        if self._waiting and (t_ns - self._flushed_ns >= _FLUSH_NS or len(self._waiting) >= _FLUSH_BYTES):
            self._flushed_ns = t_ns
            self._write()

    def _record(self, data: bytes, route: str, *, whole: bool) -> None:
        if self._sink is None or self._now_ns is None:
            return
        found = cut(data if whole else self._rest.pop(route, b"") + data, whole=whole)
        if found.rest:
            if len(self._rest) >= _MOST_ROUTES:
                self._rest.pop(next(iter(self._rest)))
            self._rest[route] = found.rest
        if found.garbage:
            self.counts["unrecorded bytes"] += found.garbage
        # The two lowest bits of a tlog's time are read as a link number by others: ours is 0.
        stamp = (((self._now_ns + self.unix_offset_ns) // 1000) & ~3).to_bytes(8, "big")
        for frame in found.frames:
            if frame[0] == V2 and frame[7:10] == _SETUP_SIGNING:
                self.counts["keys not recorded"] += 1
                continue
            self._waiting += stamp + frame
            self.counts["recorded"] += 1

    def _write(self) -> None:
        """Hand what waits to the file. Raw writes may take less than offered."""
        if self._sink is None:
            return
        data, self._waiting = bytes(self._waiting), bytearray()
        self._writing = True
        try:
            while data:
                taken = self._sink.write(data)
                if taken == 0:
                    raise OSError("nothing taken")
                data = data[len(data) if taken is None else taken :]
            self._sink.flush()
        except (OSError, ValueError):  # ValueError: the caller closed its own file
            self.counts["recording stopped"] += 1
            self._let_go()
        self._writing = False
        if self._closed:
            self._let_go()

    def _finish(self) -> None:
        self._write()
        self._let_go()

    def _let_go(self) -> None:
        self._sink = None
        if self._own is not None:
            with suppress(OSError):
                self._own.close()
            self._own = None


class _Closable(ByteSink, Protocol):
    def close(self) -> None: ...


def _append_to(path: str | Path) -> _Closable:
    try:
        # Unbuffered: the recorder gathers by itself, and a signal handler may then close it safely.
        return Path(path).open("ab", buffering=0)
    except (OSError, ValueError) as error:
        cause = error.strerror if isinstance(error, OSError) else str(error)
        raise LinkError(f"{path}: cannot record there: {cause}; choose another file") from error
