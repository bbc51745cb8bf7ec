"""Which messages go out when, as the autopilot schedules them on one link."""

from __future__ import annotations

from collections.abc import Mapping

from magmav_sim.autopilot import Autopilot

_SHORTEST_US, _LONGEST_US = 1000, 60_000_000
_FASTEST_NS = 10_000_000  # one frame of the simulation; ArduPilot's own cap is 80 % of its loop rate
_MS = 1_000_000


class Streams:
    """Intervals per message, ns; HEARTBEAT always at 1 Hz after boot. Times are boot times."""

    def __init__(self, autopilot: Autopilot, rates_hz: Mapping[str, float]) -> None:
        self._groups = autopilot.groups
        self._defaults = {"HEARTBEAT": 1_000_000_000}
        for name, rate in {**autopilot.streams_hz, **rates_hz}.items():
            if name not in autopilot.builders:
                raise ValueError(f"rates_hz: no message {name!r}; there are {', '.join(autopilot.builders)}")
            self._defaults[name] = max(_FASTEST_NS, round(1e9 / rate))
        self.reset()

    def reset(self) -> None:
        """As after a boot."""
        self._intervals = dict(self._defaults)
        self._next: dict[str, int] = dict.fromkeys(self._intervals, 0)

    def set_interval(self, name: str, interval_us: float, now_ns: int) -> None:
        """SET_MESSAGE_INTERVAL: 0 the default, below 0 stop; whole milliseconds, 1 ms to 60 s, capped."""
        if interval_us < 0:
            self._intervals.pop(name, None)
        elif interval_us == 0:
            self._intervals.pop(name, None)
            if name in self._defaults:
                self._intervals[name] = self._defaults[name]
        else:
            whole_ms = int(max(_SHORTEST_US, min(_LONGEST_US, interval_us)) // 1000)
            self._intervals[name] = max(_FASTEST_NS, whole_ms * _MS)
        self._next[name] = now_ns

    def interval_us(self, name: str) -> int:
        """What MESSAGE_INTERVAL says: -1 where the message is off."""
        interval = self._intervals.get(name)
        return -1 if interval is None else interval // 1000

    def request(self, group: int, rate_hz: int, start: bool, now_ns: int) -> None:
        """REQUEST_DATA_STREAM; group 0 is all of them, unknown groups are ignored."""
        for number, names in self._groups.items():
            if group in (0, number):
                for name in names:
                    self.set_interval(name, 1e6 / rate_hz if start and rate_hz > 0 else -1, now_ns)

    def due(self, now_ns: int) -> list[str]:
        """Messages to send now."""
        out = []
        for name, interval in self._intervals.items():
            at = self._next[name]
            if at <= now_ns:
                out.append(name)
                self._next[name] = max(at + interval, now_ns - interval)
        return out
