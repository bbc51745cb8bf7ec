"""Two links joined in memory, on a clock somebody sets: the live contract without sockets or waiting."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from magmav.link import Packet

_MOST_WAITING = 65_536  # packets; a reader that never reads must not eat the memory


@dataclass(slots=True)
class SetClock:
    """A clock that moves only when told to. Call it for the time in ns."""

    now_ns: int = 0

    def __call__(self) -> int:
        return self.now_ns

    def advance(self, seconds: float) -> None:
        """Move on. ValueError when asked to go back."""
        if seconds < 0:
            raise ValueError(f"seconds: time does not go back, got {seconds!r}")
        self.now_ns += round(seconds * 1e9)


class MemoryLink:
    """One end of a pair. What the other end sent comes out in order, one packet per send; else quiet ticks.

    A packet carries the time at which it is taken out, as a socket's would. route is the other end's name.
    """

    def __init__(self, name: str, clock_ns: Callable[[], int], *, datagrams: bool, unix_offset_ns: int) -> None:
        self.name = name
        self.datagrams = datagrams
        self.unix_offset_ns = unix_offset_ns
        self.counts: Counter[str] = Counter()
        self._clock_ns = clock_ns
        self._waiting: deque[bytes] = deque()
        self._other: MemoryLink | None = None
        self._closed = False

    def packets(self) -> Iterator[Packet]:
        """Packets and quiet ticks until this end is closed."""
        while not self._closed:
            if self._waiting and self._other is not None:
                yield Packet(self._clock_ns(), self._waiting.popleft(), self._other.name)
            else:
                yield Packet(self._clock_ns(), b"", "")

    @property
    def routes(self) -> tuple[str, ...]:
        """The other end."""
        return () if self._other is None else (self._other.name,)

    def send(self, data: bytes, route: str = "") -> None:
        """To the other end; counted as "not sent" when either is closed or the route is not the other end."""
        other = self._other
        if self._closed or other is None or other._closed or route not in ("", other.name):
            self.counts["not sent"] += 1
        elif len(other._waiting) >= _MOST_WAITING:
            self.counts["dropped sends"] += 1
        elif data:
            other._waiting.append(bytes(data))

    def close(self) -> None:
        """Stop; the other end goes on with quiet ticks."""
        self._closed = True


def memory_pair(
    clock_ns: Callable[[], int],
    *,
    names: tuple[str, str] = ("memory:a", "memory:b"),
    datagrams: bool = True,
    unix_offset_ns: int = 0,
) -> tuple[MemoryLink, MemoryLink]:
    """Two ends joined: what one sends the other yields, on one shared clock (a SetClock, or any callable)."""
    if names[0] == names[1]:
        raise ValueError(f"names: the two ends need different names, got {names!r}")
    here, there = (MemoryLink(name, clock_ns, datagrams=datagrams, unix_offset_ns=unix_offset_ns) for name in names)
    here._other, there._other = there, here
    return here, there
