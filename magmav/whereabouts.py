"""Which vehicles are heard over which routes, so that nothing is said to a vehicle it is not for."""

from __future__ import annotations

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.mavlink.codec import Message

HEARD_NS = 30_000_000_000  # as long as a socket remembers its peers
_MOST = 4096


def is_autopilot(message: Message) -> bool:
    """A heartbeat in which somebody claims to be a vehicle's autopilot."""
    if message.get_type() != "HEARTBEAT" or 0 in (message.get_srcSystem(), message.get_srcComponent()):
        return False
    return bool(message.autopilot != dialect.MAV_AUTOPILOT_INVALID and message.type != dialect.MAV_TYPE_GCS)


class Whereabouts:
    """Autopilots by route, from their heartbeats of the last 30 s."""

    def __init__(self) -> None:
        self._heard_ns: dict[tuple[str, int], int] = {}  # (route, system), oldest first

    def on_message(self, message: Message, route: str, now_ns: int) -> None:
        """Take note of an autopilot's heartbeat."""
        if not is_autopilot(message):
            return
        key = route, message.get_srcSystem()
        self._heard_ns.pop(key, None)
        self._heard_ns[key] = now_ns
        while len(self._heard_ns) > _MOST or now_ns - next(iter(self._heard_ns.values())) > HEARD_NS:
            del self._heard_ns[next(iter(self._heard_ns))]

    def systems(self, route: str) -> frozenset[int]:
        """The vehicles behind a route: several behind a router, none behind a ground station's."""
        return frozenset(system for at, system in self._heard_ns if at == route)

    def strange_to(self, system: int) -> frozenset[str]:
        """Routes behind which there are vehicles, but not this one."""
        return frozenset(at for at, _ in self._heard_ns) - {at for at, s in self._heard_ns if s == system}

    def keeps_from(self, system: int, route: str) -> bool:
        """A message for this system must not go there: it is a vehicle that is elsewhere, and others are there."""
        return any(s == system for _, s in self._heard_ns) and route in self.strange_to(system)
