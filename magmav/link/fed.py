"""A link inside another program: that program pushes what it hears, and takes away what is to be sent.

For a host that owns the real link and lets nobody else read it, such as MAVProxy. The host pushes from its own
thread; whoever turns the crank reads ``packets`` in another. Nothing here blocks the host.
"""

from __future__ import annotations

import queue
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator

from magmav.link import Packet

_MOST_WAITING = 4096  # packets each way; a reader that hangs must not eat the host's memory


class FedLink:
    """Packets are whole frames, as datagrams are. Routes are the host's names for its own links.

    A packet that waited longer than late_s is dropped: the time of a packet is when it was pushed, and arm
    state as old as that must not look fresh (S1).
    counts : "received", "late", "dropped" (nobody read), "sent", "dropped sends" (nobody took them away).
    """

    datagrams = True

    def __init__(
        self,
        name: str,
        *,
        tick_s: float = 0.05,
        late_s: float = 0.5,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        unix_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        if not tick_s > 0:
            raise ValueError(f"tick_s: want a positive time, got {tick_s!r}")
        if not late_s > 0:
            raise ValueError(f"late_s: want a positive time, got {late_s!r}")
        self.name = name
        self.counts: Counter[str] = Counter()
        self.unix_offset_ns = unix_ns() - clock_ns()
        self._clock_ns = clock_ns
        self._tick_s = tick_s
        self._late_ns = round(late_s * 1e9)
        self._in: queue.Queue[Packet | None] = queue.Queue(_MOST_WAITING)
        self._out: deque[tuple[bytes, str]] = deque()
        self._closed = False

    # ------------------------------------------------------------ the host's side

    def push(self, data: bytes, route: str) -> None:
        """One frame the host heard on one of its links. ValueError without a route: nothing could be trusted."""
        if not route:
            raise ValueError("route: want the name of the host's link, got ''")
        if self._closed or not data:
            return
        try:
            self._in.put_nowait(Packet(self._clock_ns(), bytes(data), route))
        except queue.Full:
            self.counts["dropped"] += 1

    @property
    def closed(self) -> bool:
        """No packets come any more."""
        return self._closed

    def take(self) -> list[tuple[bytes, str]]:
        """Frames to be sent since the last call, each with its route; an empty route means every link."""
        out = []
        while self._out:
            out.append(self._out.popleft())
        return out

    # ------------------------------------------------------------ the reader's side

    def packets(self) -> Iterator[Packet]:
        """What was pushed, in order, and a quiet tick when nothing was for tick_s. Time never goes back."""
        last_ns = 0
        while not self._closed:
            try:
                packet = self._in.get(timeout=self._tick_s)
            except queue.Empty:
                last_ns = max(last_ns, self._clock_ns())
                yield Packet(last_ns, b"", "")
                continue
            if packet is None:
                break
            if self._clock_ns() - packet.t_ns > self._late_ns:
                self.counts["late"] += 1
                last_ns = max(last_ns, packet.t_ns)
                yield Packet(last_ns, b"", "")  # who waits for a time must see it pass
                continue
            self.counts["received"] += 1
            # A tick may have been given just after this one was pushed.
            last_ns = max(last_ns, packet.t_ns)
            yield packet._replace(t_ns=last_ns)

    def send(self, data: bytes, route: str = "") -> None:
        """Hand one frame to the host, which takes it away at its next turn."""
        if len(self._out) >= _MOST_WAITING:
            self.counts["dropped sends"] += 1
        elif data:
            self._out.append((bytes(data), route))
            self.counts["sent"] += 1

    def close(self) -> None:
        """End the packets. What was sent before can still be taken away, and last words still be sent."""
        self._closed = True
        try:
            self._in.put_nowait(None)
        except queue.Full:
            return  # then the reader is awake anyhow
