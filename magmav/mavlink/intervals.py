"""Ask the autopilot for the messages we live on, at the rate we need, and give them back when we leave.

The answer (COMMAND_ACK) does not say which message it is about, so requests go out one at a time. Even so a doubled
or late answer can be taken for that of the next request. So a refusal is no last word: what does not come is asked for
once more, with nothing else asked for five seconds before, and only that answer stands. ArduPilot applies an interval
to the channel the command came in on, so a new route or a reboot starts everything over.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.mavlink.codec import Message, Outgoing
from magmav.mavlink.presence import Autopilot, Presence

_SECOND = 1_000_000_000
ACK_NS = _SECOND
TRIES = 4
WINDOW_NS = 5 * _SECOND
FIRST_PAUSE_NS = 10 * _SECOND
LAST_PAUSE_NS = 80 * _SECOND
_IDS = {kind.msgname: number for number, kind in dialect.mavlink_map.items()}
_REFUSED = (dialect.MAV_RESULT_DENIED, dialect.MAV_RESULT_UNSUPPORTED)


@dataclass(slots=True)
class _Stream:
    interval_us: int
    hz: float
    count: int = 0
    rate_hz: float = math.nan  # over the last window
    tries: int = 0  # of the first request
    next_ns: int = 0  # no request before
    asked_ns: int = -FIRST_PAUSE_NS  # the last request
    pause_ns: int = FIRST_PAUSE_NS
    refusals: int = 0  # the second one was given to a request that stood alone
    came: bool = False
    changed: bool = False  # we sent at least one request

    @property
    def refused(self) -> bool:
        return self.refusals > 1


class Intervals:
    """wanted : message name -> Hz. ``rates`` tells what really comes, over the last five seconds.

    room : whether something may be asked now; it is asked when something is due.
    """

    def __init__(
        self, wanted: Mapping[str, float], presence: Presence, room: Callable[[int], bool] = lambda now_ns: True
    ) -> None:
        self._wanted = _checked(wanted)
        self._presence = presence
        self._room = room
        self._key: tuple[int, int, str, int] | None = None
        self.restart()

    def restart(self) -> None:
        """Forget answers and rates, and request everything again: the vehicle rebooted or moved."""
        self._streams = {name: _Stream(round(1e6 / hz), hz) for name, hz in self._wanted.items()}
        self._queue = deque(self._streams)
        self._waiting = ""
        self._sent_ns = 0
        self._window_ns: int | None = None

    def want(self, wanted: Mapping[str, float]) -> None:
        """Other rates from now on: what changed is asked for again, what is wanted no more is given back.

        Each message at most once in ten seconds: whoever changes his mind faster must not drum on the vehicle.
        """
        self._wanted = _checked(wanted)
        for name in {**self._streams, **self._wanted}:
            stream = self._streams.setdefault(name, _Stream(0, 0.0))
            hz = self._wanted.get(name, 0.0)
            if hz == stream.hz:
                continue
            stream.hz, stream.interval_us = hz, round(1e6 / hz) if hz else 0
            stream.tries, stream.next_ns = 0, stream.asked_ns + FIRST_PAUSE_NS
            stream.pause_ns = FIRST_PAUSE_NS
            if name in self._queue:
                self._queue.remove(name)
            if (hz or stream.changed) and not stream.refused:
                self._queue.append(name)

    @property
    def rates(self) -> dict[str, float]:
        """Hz per wanted message over the last whole window, NaN before there was one."""
        return {name: stream.rate_hz for name, stream in self._streams.items() if stream.hz}

    @property
    def refused(self) -> frozenset[str]:
        """Messages the autopilot said twice it does not have."""
        return frozenset(name for name, stream in self._streams.items() if stream.refused)

    def on_message(self, message: Message, route: str, now_ns: int) -> list[Outgoing]:
        """Count what comes; an acknowledgement frees the way for the next request."""
        autopilot = self._presence.autopilot
        sender = message.get_srcSystem(), message.get_srcComponent(), route
        if autopilot is None or sender != autopilot.pin:
            return []
        kind = message.get_type()
        if kind in self._streams:
            self._streams[kind].count += 1
            self._streams[kind].came = True
        elif kind == "COMMAND_ACK" and self._waiting and self._is_ours(message):
            stream = self._streams[self._waiting]
            stream.refusals = stream.refusals + 1 if message.result in _REFUSED else 0
            self._waiting = ""
        return self.poll(now_ns)

    def poll(self, now_ns: int) -> list[Outgoing]:
        """At most one request."""
        autopilot = self._presence.autopilot
        if autopilot is None:
            return []
        key = (*autopilot.pin, self._presence.boots)
        if key != self._key:
            if self._key is not None:
                self.restart()
            self._key = key
        self._measure(now_ns)
        if self._waiting:
            alone = self._streams[self._waiting].refusals > 0
            if now_ns - self._sent_ns < (WINDOW_NS if alone else ACK_NS):
                return []
            if self._streams[self._waiting].tries < TRIES:
                self._queue.appendleft(self._waiting)
            self._waiting = ""
        name = next((n for n in self._queue if self._may_ask(self._streams[n], now_ns)), None)
        if name is None or not self._room(now_ns):
            return []
        self._queue.remove(name)
        return [self._request(autopilot, name, now_ns)]

    def restore(self) -> list[Outgoing]:
        """Default intervals again for everything we changed (S14); for the way out."""
        autopilot = self._presence.autopilot
        if autopilot is None:
            return []
        changed = [n for n, stream in self._streams.items() if stream.changed and (stream.came or not stream.refusals)]
        for name in changed:
            self._streams[name].changed = False
        return [_command(autopilot, name, 0) for name in changed]

    def _may_ask(self, stream: _Stream, now_ns: int) -> bool:
        if stream.refusals and now_ns - self._sent_ns < WINDOW_NS:
            return False
        return stream.tries > 0 or now_ns >= stream.next_ns

    def _request(self, autopilot: Autopilot, name: str, now_ns: int) -> Outgoing:
        stream = self._streams[name]
        stream.tries += 1
        stream.asked_ns = now_ns
        stream.changed = stream.hz > 0.0
        stream.next_ns = max(stream.next_ns, now_ns + FIRST_PAUSE_NS)
        self._waiting, self._sent_ns = name, now_ns
        return _command(autopilot, name, stream.interval_us)

    def _measure(self, now_ns: int) -> None:
        """Every five seconds: what is under half its rate is asked for again, ever more rarely."""
        if self._window_ns is None:
            self._window_ns = now_ns
        span_ns = now_ns - self._window_ns
        if span_ns < WINDOW_NS:
            return
        for name, stream in self._streams.items():
            stream.rate_hz = stream.count * _SECOND / span_ns
            stream.count = 0
            if stream.rate_hz >= stream.hz / 2:  # also what is wanted no more
                stream.pause_ns = FIRST_PAUSE_NS
                continue
            asking = name == self._waiting or name in self._queue
            if stream.refused or asking or stream.tries == 0 or now_ns < stream.next_ns:
                continue
            stream.tries = TRIES  # no quick repeats any more
            self._queue.append(name)
            stream.next_ns = now_ns + stream.pause_ns
            stream.pause_ns = min(2 * stream.pause_ns, LAST_PAUSE_NS)
        self._window_ns = now_ns

    def _is_ours(self, ack: Message) -> bool:
        ours = ack.command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL
        to_us = ack.target_system in (0, self._presence.system)
        return ours and to_us and ack.target_component in (0, self._presence.component)


def _checked(wanted: Mapping[str, float]) -> dict[str, float]:
    for name, hz in wanted.items():
        if name not in _IDS:
            raise ValueError(f"wanted: no message is called {name!r}")
        if not (math.isfinite(hz) and hz > 0):
            raise ValueError(f"wanted: {name} wants a rate above 0 Hz, got {hz!r}")
    return dict(wanted)


def _command(autopilot: Autopilot, name: str, interval_us: int) -> Outgoing:
    message = dialect.MAVLink_command_long_message(
        autopilot.system,
        autopilot.component,
        dialect.MAV_CMD_SET_MESSAGE_INTERVAL,
        0,
        _IDS[name],
        interval_us,
        *(0,) * 5,
    )
    return Outgoing(message, autopilot.route)
