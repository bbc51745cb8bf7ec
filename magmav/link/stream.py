"""A byte stream that may die and come back: what TCP and serial have in common.

Sending never waits. What does not fit is dropped in whole send() calls, because half a frame costs the
receiver two, and late is worse than never for commands that rest on a fresh heartbeat.
"""

from __future__ import annotations

import select
import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Protocol

from magmav.link import Packet
from magmav.link.reopen import Backoff

_CONNECT_NS = 5_000_000_000


class Port(Protocol):
    """An open device or connection. All methods return at once; OSError means it is gone."""

    fd: int

    def opened(self) -> bool:
        """False while the connection is still being made. Asked when fd can be written to."""
        ...

    def read(self) -> bytes:
        """What waits; empty for a false alarm."""
        ...

    def write(self, data: bytes, /) -> int:
        """Bytes taken."""
        ...

    def close(self) -> None: ...


class StreamLink:
    """Reads and writes a Port, and opens the next one with backoff when it dies, ticking all the while.

    Each life has its own route ("tcp:HOST:PORT", then "tcp:HOST:PORT#2", ...), so that nobody glues the front
    of an old frame to a new one, or takes the new other end for the old on trust.
    counts : "opened", "lost", "reopened", "open failed", "received", "sent", "dropped sends" (no room),
    "not sent" (no link, or an old route).
    """

    datagrams = False

    def __init__(
        self,
        name: str,
        port: Port,
        reopen: Callable[[], Port],
        *,
        tick_s: float = 0.05,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        retry_s: float = 0.5,
        longest_retry_s: float = 10.0,
        most_unsent: int = 4096,
    ) -> None:
        try:
            self._backoff = Backoff(retry_s, longest_retry_s)
            if not tick_s > 0:
                raise ValueError(f"tick_s: want a positive time, got {tick_s!r}")
        except ValueError:
            port.close()
            raise
        self.name = name
        self.counts: Counter[str] = Counter(opened=1)
        self.unix_offset_ns = time.time_ns() - clock_ns()
        self.route = name
        self._reopen = reopen
        self._tick_ms = tick_s * 1000
        self._clock_ns = clock_ns
        self._most_unsent = most_unsent
        self._unsent = bytearray()
        self._lives = 1
        self._port: Port | None = port
        self._connected = True
        self._since_ns = 0
        self._closed = False

    def packets(self) -> Iterator[Packet]:
        """Packets, and a quiet tick when nothing came for tick_s, whether the stream lives or not."""
        while not self._closed:
            data = self._turn()
            if self._closed and not data:
                return
            yield Packet(self._clock_ns(), data, self.route if data else "")

    def send(self, data: bytes, route: str = "") -> None:
        """Send all of it or, when there is no room or no link, none."""
        if not data or self._port is None or not self._connected or self._closed or route not in ("", self.route):
            self.counts["not sent"] += 1
        elif len(self._unsent) + len(data) > self._most_unsent:
            self.counts["dropped sends"] += 1
        else:
            self.counts["sent"] += 1
            self._unsent += data
            self._flush(self._port)

    @property
    def routes(self) -> tuple[str, ...]:
        """The one other end, while there is one."""
        return (self.route,) if self._connected else ()

    def fileno(self) -> int:
        """Readable when bytes wait; -1 while there is no connection."""
        return self._port.fd if self._port is not None and self._connected else -1

    def close(self) -> None:
        """Close; the packets end within a tick."""
        self._closed = True
        if self._port is not None:
            self._port.close()

    def _turn(self) -> bytes:
        """Wait for at most a tick, do what can be done; the bytes that came."""
        port = self._port
        if port is None:
            self._wait_and_open()
            return b""
        interest = select.POLLIN if self._connected else 0
        if self._unsent or not self._connected:
            interest |= select.POLLOUT
        try:
            waiting = select.poll()
            waiting.register(port.fd, interest)
            events = waiting.poll(self._tick_ms)
            if not self._connected:
                self._connect(port, bool(events))
                return b""
            seen = events[0][1] if events else 0
            if seen & select.POLLOUT:
                self._flush(port)
            if self._port is None or not seen & ~select.POLLOUT:
                return b""
            data = port.read()
        except (OSError, ValueError):  # ValueError: closed from a signal handler, its descriptor is -1
            self._lose()
            return b""
        if data:
            self.counts["received"] += 1
            self._backoff.alive()
        return data

    def _flush(self, port: Port) -> None:
        try:
            del self._unsent[: port.write(bytes(self._unsent))]
        except BlockingIOError:
            pass
        except OSError:
            self._lose()

    def _lose(self) -> None:
        if self._port is None or self._closed:
            return
        self._port.close()
        self._port = None
        self._unsent.clear()
        self.counts["lost" if self._connected else "open failed"] += 1
        self._connected = False
        self._backoff.failed(self._clock_ns())

    def _wait_and_open(self) -> None:
        now_ns = self._clock_ns()
        left_ns = self._backoff.left_ns(now_ns)
        if left_ns:
            select.poll().poll(min(self._tick_ms, left_ns / 1e6))
            return
        try:
            self._port = self._reopen()
        except OSError:
            self.counts["open failed"] += 1
            self._backoff.failed(now_ns)
            return
        self._since_ns = now_ns
        if self._closed:
            self._port.close()

    def _connect(self, port: Port, ready: bool) -> None:
        """Go on with an opening; OSError when it has failed or takes too long."""
        if ready and port.opened():
            self._connected = True
            self._lives += 1
            self.route = f"{self.name}#{self._lives}"
            self.counts["reopened"] += 1
        elif self._clock_ns() - self._since_ns > _CONNECT_NS:
            raise TimeoutError
