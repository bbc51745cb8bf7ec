"""What we say unasked: headings and texts, never more than the budget allows."""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.mavlink.budget import Budget
from magmav.mavlink.codec import Message, Outgoing

_SECOND = 1_000_000_000
STALE_NS = _SECOND
REPEAT_NS = 30 * _SECOND
_CHUNK = 50
_MOST_CHUNKS = 5
_MOST_WAITING = 20
_NAMES = {1: b"MMAG_HDG", 2: b"MMAG_HDG2", 3: b"MMAG_HDG3"}


@dataclass(slots=True)
class _Heading:
    degrees: float
    boot_ms: int
    given_ns: int
    sent: bool = False


class Announcer:
    """Sends headings as NAMED_VALUE_FLOAT and texts as STATUSTEXT, out of a shared Budget.

    counts : "texts", "repeats" (swallowed), "dropped" (the queue was full).
    """

    def __init__(self, budget: Budget, heading_hz: float = 2.0) -> None:
        self.counts: Counter[str] = Counter()
        self._budget = budget
        self.rate(heading_hz)
        self._headings: dict[int, _Heading] = {}
        self._due_ns: dict[int, int] = {}
        self._texts: deque[tuple[int, list[Message]]] = deque()
        self._said_ns: dict[tuple[int, str], int] = {}
        self._text_id = 0

    def rate(self, heading_hz: float) -> None:
        """How often each heading is sent; 0 for not at all."""
        if not 0 <= heading_hz <= 50:
            raise ValueError(f"heading_hz: want 0 (off) to 50 Hz, got {heading_hz!r}")
        self._period_ns = round(_SECOND / heading_hz) if heading_hz else 0

    def heading(self, compass: int, degrees: float, boot_ns: int, now_ns: int) -> None:
        """The newest corrected magnetic heading of a compass, degrees; NaN when it is not known.

        A value is sent once and only while fresh: what is stale is silent, never frozen (S12).
        """
        if compass not in _NAMES:
            raise ValueError(f"compass: want 1, 2 or 3, got {compass!r}")
        if not math.isfinite(degrees):
            self._headings.pop(compass, None)
            return
        boot_ms = (boot_ns // 1_000_000) & 0xFFFFFFFF
        held = self._headings.get(compass)
        if held is None or held.boot_ms != boot_ms:
            self._headings[compass] = _Heading(degrees % 360.0, boot_ms, now_ns)

    def say(self, severity: int, text: str, now_ns: int) -> None:
        """A text for the ground (severity MAV_SEVERITY, 0 worst). Not repeated within 30 s."""
        if not 0 <= severity <= 7:
            raise ValueError(f"severity: want 0 to 7, got {severity!r}")
        key = severity, text
        said_ns = self._said_ns.get(key)
        if said_ns is not None and now_ns - said_ns < REPEAT_NS:
            self.counts["repeats"] += 1
            return
        self._said_ns = {k: t for k, t in self._said_ns.items() if now_ns - t < REPEAT_NS}
        self._said_ns[key] = now_ns
        if len(self._texts) >= _MOST_WAITING:
            self._texts.remove(max(self._texts, key=lambda item: item[0]))
            self.counts["dropped"] += 1
        self._texts.append((severity, self._chunks(severity, text)))

    def poll(self, now_ns: int) -> list[Outgoing]:
        """Critical texts at once, then other texts in order, then headings, as far as the budget goes."""
        out: list[Outgoing] = []
        for item in [item for item in self._texts if item[0] <= dialect.MAV_SEVERITY_CRITICAL]:
            self._texts.remove(item)
            self.counts["texts"] += 1
            for message in item[1]:
                self._budget.force(message, now_ns)
                out.append(Outgoing(message))
        while self._texts:
            chunks = self._texts[0][1]
            while chunks and self._budget.take(chunks[0], now_ns):
                out.append(Outgoing(chunks.pop(0)))
            if chunks:
                break
            self._texts.popleft()
            self.counts["texts"] += 1
        for compass, held in self._headings.items():
            out += self._send_heading(compass, held, now_ns)
        return out

    def _send_heading(self, compass: int, held: _Heading, now_ns: int) -> list[Outgoing]:
        stale = now_ns - held.given_ns > STALE_NS
        due_ns = self._due_ns.get(compass, now_ns)
        if not self._period_ns or held.sent or stale or now_ns < due_ns:
            return []
        message = dialect.MAVLink_named_value_float_message(held.boot_ms, _NAMES[compass], held.degrees)
        share = self._budget.half()  # headings leave half for texts and parameters
        if not (self._budget.has(message, now_ns) and share.take(message, now_ns)):
            return []
        self._budget.take(message, now_ns)
        held.sent = True
        late = now_ns - due_ns > self._period_ns
        self._due_ns[compass] = (now_ns if late else due_ns) + self._period_ns
        return [Outgoing(message)]

    def _chunks(self, severity: int, text: str) -> list[Message]:
        """At most 50 bytes each. Several share an id; a zero byte in the last one says it is the last."""
        data = text.encode("ascii", "replace")[: _CHUNK * _MOST_CHUNKS - 1]
        if len(data) <= _CHUNK:
            return [dialect.MAVLink_statustext_message(severity, data)]
        self._text_id = self._text_id % 0xFFFF + 1
        starts = range(0, len(data) + 1, _CHUNK)
        return [
            dialect.MAVLink_statustext_message(severity, data[at : at + _CHUNK], self._text_id, number)
            for number, at in enumerate(starts)
        ]
