"""How many bytes we may put on the wire: one bucket for everything we say on our own."""

from __future__ import annotations

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.mavlink.codec import Message

_SIGNATURE = 13
_HOLD_S = 10  # the promise: any ten seconds hold at most ten times the rate


class Budget:
    """A token bucket over real encoded frame sizes.

    bps : bytes per second (500 by default, users.md AT-9c). Any ten seconds see at most 10 * bps bytes of
    what ``take`` let through; what is ``force``d (heartbeat, critical text, echo of a SET) is paid back by
    the rest. Whoever sends for a machine that knows no budget (presence, intervals, fetch, upload) forces
    it too.
    """

    def __init__(self, bps: float = 500.0, *, signed: bool = False) -> None:
        self._extra = _SIGNATURE if signed else 0
        self._tokens = 0.0
        self._then_ns: int | None = None
        self._mav = dialect.MAVLink(None)
        self.rate(bps)

    def rate(self, bps: float) -> None:
        """Another rate from now on; a debt stays."""
        if not bps >= 100:
            raise ValueError(f"bps: want at least 100 bytes per second, got {bps!r}")
        self.bps = bps
        self._most = max(bps / 2, 100.0)
        self._per_ns = (bps - self._most / _HOLD_S) / 1e9
        self._tokens = min(self._tokens, self._most)

    @property
    def reserve(self) -> float:
        """Bytes that what can wait (a list, a file) leaves for headings and texts. A message always fits beside."""
        return min(100.0, 0.4 * self._most)

    @property
    def largest(self) -> int:
        """The longest frame, without signature, that ``take`` ever lets through beside the reserve."""
        return int(self._most - self.reserve) - self._extra

    def take(self, message: Message, now_ns: int, reserve: float = 0.0) -> bool:
        """May this be sent now? Counts it if so. ``reserve``: bytes to leave for what matters more."""
        if not self.has(message, now_ns, reserve):
            return False
        self._tokens -= self.size(message)
        return True

    def has(self, message: Message, now_ns: int, reserve: float = 0.0) -> bool:
        """Would ``take`` say yes? Counts nothing."""
        self._fill(now_ns)
        return self._tokens - self.size(message) >= reserve

    def force(self, message: Message, now_ns: int) -> None:
        """Count a message that is sent in any case."""
        self._fill(now_ns)
        self._tokens -= self.size(message)

    def debt(self, now_ns: int) -> float:
        """Bytes sent ahead of the rate; 0 when there are none."""
        self._fill(now_ns)
        return max(0.0, -self._tokens)

    def size(self, message: Message) -> int:
        """Bytes of the encoded frame, trailing zeros of the payload cut as MAVLink 2 does."""
        return len(message.pack(self._mav)) + self._extra

    def _fill(self, now_ns: int) -> None:
        if self._then_ns is not None and now_ns > self._then_ns:
            self._tokens = min(self._most, self._tokens + (now_ns - self._then_ns) * self._per_ns)
        self._then_ns = now_ns
