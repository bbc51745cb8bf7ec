"""Several links as one: what comes over any of them, in order of arrival, each route told apart by its link.

One thread and one clock for all. A link that has nothing to say is looked after often enough to reconnect and to
forget its silent peers, and never holds up one that has.
"""

from __future__ import annotations

import select
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress

from magmav.link import Link, LinkError, Packet, routes_of, whole_frames
from magmav.link.open import open_link

_TICK_S = 0.001  # a link of many waits no longer than this by itself; the waiting is done here, for all
_WAIT_MS = 20.0
_LOOK_NS = 20_000_000  # each link is looked after this often, however busy the others are


class ManyLinks:
    """Links behind one door. Route R of the n-th link (from 0) is ``n>R``.

    An empty route sends to every peer of every link. Ends when all of them have ended. counts : of all together.
    """

    datagrams = False

    def __init__(self, links: Sequence[Link]) -> None:
        if not links:
            raise ValueError("links: want at least one")
        self.links = tuple(links)
        self.name = ", ".join(link.name for link in links)
        self.unix_offset_ns = links[0].unix_offset_ns
        self.counts: Counter[str] = Counter()
        for link in links:
            self.counts.update(link.counts)
            link.counts = self.counts
        self._closed = False

    @property
    def warning(self) -> str:
        """What the links warn of, in one text."""
        return "; ".join(filter(None, (getattr(link, "warning", "") for link in self.links)))

    @property
    def routes(self) -> tuple[str, ...]:
        """Whom send() with an empty route reaches, as far as the links tell."""
        return tuple(_joined(n, r) for n, link in enumerate(self.links) for r in routes_of(link))

    def whole(self, route: str) -> bool:
        """Whether packets of this route hold whole frames."""
        link, rest = self._parted(route)
        return link is not None and whole_frames(link, rest)

    def packets(self) -> Iterator[Packet]:
        """Packets of all links, and a quiet tick when nothing came from any."""
        open_ones = {n: link.packets() for n, link in enumerate(self.links)}
        now_ns = looked_ns = 0
        while open_ones and not self._closed:
            quiet, ready = True, self._ready(open_ones)
            if not ready or now_ns - looked_ns >= _LOOK_NS:
                ready, looked_ns = list(open_ones), now_ns
            for n in ready:
                packet = next(open_ones[n], None)
                if packet is None:
                    del open_ones[n]
                    continue
                now_ns = max(now_ns, packet.t_ns)
                if packet.data:
                    quiet = False
                    yield Packet(now_ns, packet.data, _joined(n, packet.route))
            if quiet and open_ones and not self._closed:
                yield Packet(now_ns, b"", "")

    def send(self, data: bytes, route: str = "") -> None:
        """To one route, or to every peer of every link."""
        if not route:
            for each in self.links:
                each.send(data)
            return
        link, rest = self._parted(route)
        if link is None:
            self.counts["not sent"] += 1
        else:
            link.send(data, rest)

    def close(self) -> None:
        """Close all."""
        self._closed = True
        for each in self.links:
            each.close()

    def _ready(self, open_ones: dict[int, Iterator[Packet]]) -> list[int]:
        """Links with something to read, after a wait; all, where one cannot tell."""
        waiting, of = select.poll(), {}
        for n in open_ones:
            fileno: Callable[[], int] | None = getattr(self.links[n], "fileno", None)
            fd = -1 if fileno is None else fileno()
            if fileno is None:
                return list(open_ones)
            if fd >= 0:
                waiting.register(fd, select.POLLIN)
                of[fd] = n
        return [of[fd] for fd, _ in waiting.poll(_WAIT_MS)]

    def _parted(self, route: str) -> tuple[Link | None, str]:
        number, _, rest = route.partition(">")
        known = number.isascii() and number.isdecimal() and int(number) < len(self.links)
        return (self.links[int(number)], rest) if known else (None, rest)


def _joined(n: int, route: str) -> str:
    return f"{n}>{route}"


def open_links(texts: Sequence[str], open_one: Callable[..., Link] = open_link) -> Link:
    """One link for one text, several as one for several. LinkError as open_link's; nothing stays open then."""
    if len(texts) == 1:
        return open_one(texts[0])
    links: list[Link] = []
    try:
        for text in texts:
            links.append(open_one(text, tick_s=_TICK_S))
    except LinkError:
        for link in links:
            with suppress(OSError):
                link.close()
        raise
    return ManyLinks(links)
