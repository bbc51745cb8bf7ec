"""How many bytes we may put on the wire: one bucket for each link, for everything we say on our own.

What goes out over a link shares its air, whoever it is for and in whose name it is sent: all vehicles and all routes
(a radio with a router behind it, the peers of a socket) stay under the rate together, and what is said to everybody
counts once for each who gets it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.mavlink.codec import Message

_SIGNATURE = 13
_REQUEST = 40
_BURST = 1.5  # of what a bucket holds: copies, and what cannot wait, go out on top of it
_PATIENCE_NS = 5_000_000_000
_HOLD_S = 10  # the promise: any ten seconds hold at most ten times the rate


def link_of(route: str) -> str:
    """The link of a route: routes of several links in one are called ``link>route``."""
    link, several, _ = route.partition(">")
    return link if several else ""


@dataclass(slots=True)
class _Bucket:
    tokens: float = 0.0
    then_ns: int | None = None


class Air:
    """The buckets of all links, shared by everybody who sends over them.

    vehicles : that are served together, and take turns in what can wait.
    """

    def __init__(self, bps: float = 500.0) -> None:
        self.vehicles = 1
        self._buckets: dict[str, _Bucket] = {}
        self.rate(bps)

    def rate(self, bps: float) -> None:
        """Another rate from now on; a debt stays."""
        if not bps >= 100:
            raise ValueError(f"bps: want at least 100 bytes per second, got {bps!r}")
        self.bps = bps
        self.most = max(bps / 2, 100.0)
        self._per_ns = (bps - _BURST * self.most / _HOLD_S) / 1e9
        for bucket in self._buckets.values():
            bucket.tokens = min(bucket.tokens, self.most)
        if "half" in self.__dict__:
            self.half.rate(max(bps / 2, 100.0))

    @cached_property
    def half(self) -> Air:
        """Half of it for one purpose, so that something is left for others."""
        return Air(max(self.bps / 2, 100.0))

    def filled(self, link: str, now_ns: int) -> _Bucket:
        """The bucket of a link as it is now."""
        bucket = self._buckets.setdefault(link, _Bucket())
        if bucket.then_ns is not None and now_ns > bucket.then_ns:
            bucket.tokens = min(self.most, bucket.tokens + (now_ns - bucket.then_ns) * self._per_ns)
        bucket.then_ns = now_ns
        return bucket


class Budget:
    """A token bucket for each link, over real encoded frame sizes.

    bps : bytes per second of a link (500 by default, users.md AT-9c). Any ten seconds see at most 10 * bps bytes of
    what ``take`` let through; what is ``force``d (heartbeat, critical text, echo of a SET) is paid back by
    the rest. Whoever sends for a machine that knows no budget (presence, intervals, fetch, upload) forces
    it too. Without a route a message goes to everybody: ``reaches`` says over which links, and how often.
    air : shared with others; their rate then.
    """

    def __init__(self, bps: float = 500.0, *, signed: bool = False, air: Air | None = None) -> None:
        self._extra = _SIGNATURE if signed else 0
        self._air = Air(bps) if air is None else air
        self._reach: Mapping[str, int] = {"": 1}
        self._room_ns = 0
        self._mav = dialect.MAVLink(None)

    @property
    def bps(self) -> float:
        """Of a link."""
        return self._air.bps

    def rate(self, bps: float) -> None:
        """Another rate from now on; a debt stays."""
        self._air.rate(bps)

    def reaches(self, copies: Mapping[str, int]) -> None:
        """What is said to everybody goes out so often, by link."""
        self._reach = dict(copies) or {"": 1}

    def half(self) -> Budget:
        """Half of it for one purpose, shared with the others of that purpose."""
        out = Budget(air=self._air.half)
        out._extra, out._reach = self._extra, self._reach
        return out

    @property
    def reserve(self) -> float:
        """Bytes that what can wait (a list, a file) leaves for headings and texts. A message always fits beside."""
        return min(100.0, 0.4 * self._air.most)

    @property
    def largest(self) -> int:
        """The longest frame, without signature, that ``take`` ever lets through beside the reserve."""
        return int(self._air.most - self.reserve) - self._extra

    def take(self, message: Message, now_ns: int, reserve: float = 0.0, route: str = "") -> bool:
        """May this be sent now? Counts it if so. ``reserve``: bytes to leave for what matters more."""
        if not self.has(message, now_ns, reserve, route):
            return False
        self.force(message, now_ns, route)
        return True

    def has(self, message: Message, now_ns: int, reserve: float = 0.0, route: str = "") -> bool:
        """Would ``take`` say yes? Counts nothing. Room for one copy will do: for the others is waited afterwards."""
        wanted = min(self.size(message) + reserve, self._air.most)
        return all(self._air.filled(link, now_ns).tokens >= wanted for link in self._ways(route))

    def force(self, message: Message, now_ns: int, route: str = "") -> None:
        """Count a message that is sent in any case."""
        size = self.size(message)
        for link, copies in self._ways(route).items():
            self._air.filled(link, now_ns).tokens -= size * copies

    def room(self, now_ns: int) -> bool:
        """May something that can wait be asked of the vehicle now? Who hears no for five seconds may once all the same.

        Heartbeats of many vehicles can fill a link; each is then still read, slowly. A single vehicle is always asked:
        that is slow enough by itself, and others wait for it.
        """
        if self._air.vehicles <= 1:
            return True
        # As much as a value of a list needs: they take turns.
        wanted = self.reserve + _REQUEST
        rich = all(self._air.filled(link, now_ns).tokens >= wanted for link in self._reach)
        if rich or now_ns - self._room_ns >= _PATIENCE_NS:
            self._room_ns = now_ns
            return True
        return False

    def debt(self, now_ns: int) -> float:
        """Bytes sent ahead of the rate, on the link where they are most; 0 when there are none."""
        return max(0.0, *(-self._air.filled(link, now_ns).tokens for link in self._reach))

    def size(self, message: Message) -> int:
        """Bytes of the encoded frame, trailing zeros of the payload cut as MAVLink 2 does."""
        return len(message.pack(self._mav)) + self._extra

    def _ways(self, route: str) -> Mapping[str, int]:
        return {link_of(route): 1} if route else self._reach


def copies_by_link(routes: Iterable[str]) -> dict[str, int]:
    """How often each link carries what goes over these routes."""
    out: dict[str, int] = {}
    for route in routes:
        out[link_of(route)] = out.get(link_of(route), 0) + 1
    return out
