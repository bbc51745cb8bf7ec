"""Our own parameters, for any ground station: list, read, set.

All are REAL32: ground stations disagree on how a companion's integers travel (autopilots.md 6.3), floats are
safe. All begin with MMAG_: a packet for us that an autopilot cannot forward is carried out by the autopilot
itself, so a name it also has must never be used. Names, order and count never change after construction.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.mavlink.budget import Budget
from magmav.mavlink.codec import Message, Outgoing
from magmav.mavlink.entry import Entry
from magmav.mavlink.float32 import float32
from magmav.mavlink.presence import Presence

_SECOND = 1_000_000_000
TRIGGER_QUIET_NS = 30 * _SECOND
GROUND_GONE_NS = 60 * _SECOND
_MOST_ROUTES = 16
_LEAST = 1e-30  # a number below is an integer's bits, sent as if these parameters were integers
_MOST_DEBT_S = 2.0  # a SET is echoed at once unless somebody floods us
_MISSING = dialect.MAV_PARAM_ERROR_DOES_NOT_EXIST
_RANGE = dialect.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE
_DENIED = dialect.MAV_PARAM_ERROR_PERMISSION_DENIED
_READ_ONLY = dialect.MAV_PARAM_ERROR_READ_ONLY


class ParamServer:
    """Answers for (our system, our component or 0); silent about everybody else's names (S13).

    denied : is told the name and the time of a SET that came over another route than it may.
    counts : "other route" (such SETs), "requests dropped" (more routes at once than a server serves).
    """

    def __init__(
        self,
        entries: Sequence[Entry],
        presence: Presence,
        budget: Budget,
        values_per_s: float = 50.0,
        denied: Callable[[str, int], None] = lambda name, now_ns: None,
    ) -> None:
        self._index = {entry.name: index for index, entry in enumerate(entries)}
        for name in self._index:
            if not (name.startswith("MMAG_") and 6 <= len(name) <= 16 and name.isascii()):
                raise ValueError(f"entries: {name!r} must begin with MMAG_ and have at most 16 characters")
        if len(self._index) != len(entries):
            raise ValueError("entries: a name is there twice")
        if not 0 < values_per_s <= 1000:
            raise ValueError(f"values_per_s: want above 0 to 1000, got {values_per_s!r}")
        self.counts: Counter[str] = Counter()
        self._entries = tuple(entries)
        self._denied = denied
        self._presence = presence
        self._budget = budget
        self._period_ns = round(_SECOND / values_per_s)
        self._asked: dict[tuple[int, str], None] = {}  # single values wanted, in order: (index, route)
        self._list_at = len(entries)  # next index of the running list
        self._next_ns = 0
        self._ground_ns: dict[tuple[int, int, str], int] = {}
        self._triggered: dict[str, tuple[float, int]] = {}

    def on_message(self, message: Message, route: str, now_ns: int) -> list[Outgoing]:
        """Take requests; a SET is answered here and now, everything else is paced by poll."""
        kind = message.get_type()
        if kind == "HEARTBEAT":
            self._ground(message, route, now_ns)
        elif kind in ("PARAM_REQUEST_LIST", "PARAM_REQUEST_READ", "PARAM_SET") and self._for_us(message):
            if kind == "PARAM_SET":
                return self._set(message, route, now_ns)
            if kind == "PARAM_REQUEST_READ":
                return self._read(message, route, now_ns)
            self._start_list()
        return []

    def poll(self, now_ns: int) -> list[Outgoing]:
        """The values that are due, single ones first."""
        out: list[Outgoing] = []
        self._next_ns = max(self._next_ns, now_ns - 10 * self._period_ns)  # no credit for a long pause
        while now_ns >= self._next_ns:
            single = next(iter(self._asked), None)
            if single is None and self._list_at >= len(self._entries):
                break
            index, route = (self._list_at, "") if single is None else single
            message = self._value(index)
            if not self._budget.take(message, now_ns, self._budget.reserve, route):
                break
            if single is None:
                self._list_at += 1
            else:
                del self._asked[single]
            out.append(Outgoing(message, route))
            self._next_ns += self._period_ns
        return out

    def _for_us(self, message: Message) -> bool:
        ours = message.target_component in (0, self._presence.component)
        return ours and not self._presence.ambiguous and message.target_system == self._presence.system

    def _start_list(self) -> None:
        """A running list goes on to its end, for all; who missed the start asks by index."""
        if self._list_at >= len(self._entries):
            self._list_at = 0

    def _ground(self, message: Message, route: str, now_ns: int) -> None:
        """A ground station that is new gets all values unasked, once."""
        if message.type != dialect.MAV_TYPE_GCS:
            return
        who = message.get_srcSystem(), message.get_srcComponent(), route
        heard_ns = self._ground_ns.get(who)
        if heard_ns is None and len(self._ground_ns) >= 32:
            self._ground_ns = {k: t for k, t in self._ground_ns.items() if now_ns - t < GROUND_GONE_NS}
            if len(self._ground_ns) >= 32:
                return
        self._ground_ns[who] = now_ns
        if heard_ns is None:
            self._start_list()

    def _read(self, message: Message, route: str, now_ns: int) -> list[Outgoing]:
        by_index = message.param_index >= 0
        index = message.param_index if by_index else self._index.get(message.param_id, -1)
        if 0 <= index < len(self._entries):
            if len(self._asked) < _MOST_ROUTES * len(self._entries):
                self._asked[index, route] = None
            else:
                self.counts["requests dropped"] += 1
            return []
        if message.target_component == 0:
            return []
        return self._error(message, route, message.param_index, _MISSING, now_ns)

    def _set(self, message: Message, route: str, now_ns: int) -> list[Outgoing]:
        index = self._index.get(message.param_id)
        exactly_us = message.target_component == self._presence.component
        if index is None:
            return self._error(message, route, -1, _MISSING, now_ns) if exactly_us else []
        entry, value = self._entries[index], float(message.param_value)
        error = None
        if entry.set is None:
            error = _READ_ONLY
        elif not math.isfinite(value) or 0.0 < abs(value) < _LEAST:
            error = _RANGE
        elif (entry.trigger or entry.pinned) and not self._may(route):
            error = _DENIED
            self.counts["other route"] += 1
            self._denied(entry.name, now_ns)
        elif entry.trigger:
            error = None if exactly_us else _DENIED
            if exactly_us and not self._is_repeat(entry.name, value, now_ns):
                if entry.set(value, now_ns):
                    self._triggered[entry.name] = value, now_ns
                else:
                    error = _RANGE
        elif entry.set(value, now_ns):
            self._triggered.clear()  # a new setting makes the same trigger a new wish
        else:
            error = _RANGE
        if self._budget.debt(now_ns) > _MOST_DEBT_S * self._budget.bps:
            self._asked[index, ""] = None
            return []
        answer = self._value(index, None if error is not None else value)
        self._budget.force(answer, now_ns)
        out = [Outgoing(answer)]
        return out if error is None else out + self._error(message, route, index, error, now_ns)

    def _may(self, route: str) -> bool:
        """What moves a write comes the way the vehicle's own facts come; before there is a vehicle nothing moves."""
        autopilot = self._presence.autopilot
        return autopilot is None or route == autopilot.route

    def _is_repeat(self, name: str, value: float, now_ns: int) -> bool:
        last = self._triggered.get(name)
        return last is not None and last[0] == value and now_ns - last[1] < TRIGGER_QUIET_NS

    def _error(self, message: Message, route: str, index: int, error: int, now_ns: int) -> list[Outgoing]:
        sender = message.get_srcSystem(), message.get_srcComponent()
        name = message.param_id.encode("ascii", "replace")[:16]
        answer = dialect.MAVLink_param_error_message(*sender, name, index, error)
        if self._budget.debt(now_ns) > _MOST_DEBT_S * self._budget.bps:
            return []
        self._budget.force(answer, now_ns, route)
        return [Outgoing(answer, route)]

    def _value(self, index: int, value: float | None = None) -> Message:
        entry = self._entries[index]
        shown = float32(entry.get() if value is None else value)
        return dialect.MAVLink_param_value_message(
            entry.name.encode("ascii"), shown, dialect.MAV_PARAM_TYPE_REAL32, len(self._entries), index
        )
