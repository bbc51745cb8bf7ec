"""Who the vehicle is, over which route, and that we are here too.

Latching: the one autopilot heard during three seconds. More than one system and none was named: nobody, and
``ambiguous`` says whom (a new Presence with a target is the way out). A named system is latched as soon as
its component 1 is heard. Component 1 is preferred, because gimbals sometimes claim to be an autopilot.

Route: pinned to the first one the autopilot was heard on. It moves only after five seconds of silence there.

Our identity is (``system``, ``component``). Before any autopilot was heard it is the named system or 1, and
the heartbeat goes out nevertheless: on a ``udpout`` link or behind a router nobody would speak first. Between
the first autopilot and the latch we keep quiet, since a heartbeat from a guessed system would show up as a
second vehicle. The heartbeat comes from ``poll`` alone: when the worker stops, so does it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.mavlink.boot_clock import BootClock
from magmav.mavlink.codec import Message, Outgoing
from magmav.mavlink.manners import Manners

_SECOND = 1_000_000_000
LATCH_NS = 3 * _SECOND
ROUTE_SILENT_NS = 5 * _SECOND
CLAIM_NS = 10 * _SECOND
MOST_SEEN = 256
_SILENT_NS = 30 * _SECOND
_INVALID = dialect.MAV_AUTOPILOT_INVALID


@dataclass(frozen=True, slots=True)
class Autopilot:
    """An autopilot as its last heartbeat over its own route showed it."""

    system: int
    component: int
    kind: int  # MAV_AUTOPILOT
    vehicle: int  # MAV_TYPE
    armed: bool
    heartbeat_ns: int
    route: str

    @property
    def pin(self) -> tuple[int, int, str]:
        """What must not change while something is written to it."""
        return self.system, self.component, self.route


class Presence:
    """Latches one autopilot, pins its route, sends our heartbeat and polite answers.

    autopilot : None until latched.  ambiguous : the systems heard when none could be chosen.
    second_route : another route that claimed to be the same autopilot in the last 10 s, or "".
    clock : the autopilot's own, over its route.
    """

    def __init__(self, component: int = 191, target_system: int | None = None, manners: Manners | None = None) -> None:
        if not 1 <= component <= 255:
            raise ValueError(f"component: want 1 to 255, got {component}")
        if target_system is not None and not 1 <= target_system <= 255:
            raise ValueError(f"target_system: want 1 to 255, got {target_system}")
        self.component = component
        self.target_system = target_system
        self.autopilot: Autopilot | None = None
        self.ambiguous: tuple[int, ...] = ()
        self.second_route = ""
        self._manners = Manners() if manners is None else manners
        self._seen: dict[tuple[int, int], Autopilot] = {}
        self._first_ns: int | None = None
        self._route_ns = 0  # anything at all from the autopilot over its route
        self._claim_ns = 0
        self.clock = BootClock()
        self._next_heartbeat_ns: int | None = None

    @property
    def boots(self) -> int:
        """How often it was seen to reboot."""
        return self.clock.boots

    @property
    def system(self) -> int:
        """The system id we speak as."""
        if self.autopilot is not None:
            return self.autopilot.system
        if self.target_system is not None:
            return self.target_system
        systems = {system for system, _ in self._seen}
        return systems.pop() if len(systems) == 1 else 1

    def on_message(self, message: Message, route: str, now_ns: int) -> list[Outgoing]:
        """Take note of who speaks; answers only what politeness asks for."""
        sender = message.get_srcSystem(), message.get_srcComponent()
        if message.get_type() == "HEARTBEAT" and self._is_autopilot(message, sender):
            self._heartbeat(message, sender, route, now_ns)
        if self.autopilot is not None and sender == self.autopilot.pin[:2]:
            self._heard(message, route, now_ns)
        if self.autopilot is None:
            return []  # nobody yet: an answer would carry a made-up system id
        return self._manners.reply(message, route, self.system, self.component, now_ns)

    def believes(self, message: Message, route: str) -> bool:
        """Whether this is the word of a vehicle's own autopilot over the route it is pinned to (design, rule 11).

        A system that is not (yet) latched is believed from its lowest component, over the route that came from first.
        """
        sender = message.get_srcSystem(), message.get_srcComponent()
        held = self.autopilot
        if held is not None and sender[0] == held.system:
            return (*sender, route) == held.pin
        seen = self._seen.get(sender)
        if seen is None or seen.route != route:
            return False
        return sender[1] == 1 or sender == min(s for s in self._seen if s[0] == sender[0])

    def poll(self, now_ns: int) -> list[Outgoing]:
        """Latch when it is time; our heartbeat once a second."""
        self._latch(now_ns)
        if self.second_route and now_ns - self._claim_ns > CLAIM_NS:
            self.second_route = ""
        undecided = self.autopilot is None and self.target_system is None and bool(self._seen)
        if undecided or (self._next_heartbeat_ns is not None and now_ns < self._next_heartbeat_ns):
            return self._manners.poll(now_ns)
        late = self._next_heartbeat_ns is None or now_ns - self._next_heartbeat_ns > _SECOND
        self._next_heartbeat_ns = (now_ns if late else self._next_heartbeat_ns or now_ns) + _SECOND
        return [Outgoing(_our_heartbeat())]  # and an answer at the next poll, once this is counted

    def _is_autopilot(self, message: Message, sender: tuple[int, int]) -> bool:
        if message.autopilot == _INVALID or message.type == dialect.MAV_TYPE_GCS or 0 in sender:
            return False
        return sender[1] != self.component and self.target_system in (None, sender[0])

    def _room(self, sender: tuple[int, int], now_ns: int) -> bool:
        """However many claim to be an autopilot, few are remembered; a component 1 takes another's place."""
        if len(self._seen) < MOST_SEEN:
            return True
        held = None if self.autopilot is None else self.autopilot.pin[:2]
        others = [(a.heartbeat_ns, who) for who, a in self._seen.items() if who != held]
        silent = [who for heard_ns, who in others if now_ns - heard_ns > _SILENT_NS]
        lesser = [who for _, who in sorted(others) if who[1] != 1 and sender[1] == 1]
        for who in silent or lesser[:1]:
            del self._seen[who]
        return len(self._seen) < MOST_SEEN

    def _heartbeat(self, message: Message, sender: tuple[int, int], route: str, now_ns: int) -> None:
        armed = bool(message.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)
        fresh = Autopilot(*sender, message.autopilot, message.type, armed, now_ns, route)
        known = self._seen.get(sender)
        if known is None and not self._room(sender, now_ns):
            return
        if self._first_ns is None:
            self._first_ns = now_ns
        if known is None or known.route == route:
            self._seen[sender] = fresh
        elif now_ns - max(known.heartbeat_ns, self._route_ns_of(sender)) >= ROUTE_SILENT_NS:
            self._seen[sender] = fresh
            if self.autopilot is not None and self.autopilot.pin[:2] == sender:
                self.second_route = ""
        elif self.autopilot is None:
            self._claim(route, now_ns)
        if self.autopilot is None:
            self._latch(now_ns)
        elif self._better(sender):
            self.autopilot, self._route_ns = self._seen[sender], now_ns
            self.clock.forget()
        elif self.autopilot.pin[:2] == sender:
            self.autopilot = self._seen[sender]

    def _route_ns_of(self, sender: tuple[int, int]) -> int:
        mine = self.autopilot is not None and self.autopilot.pin[:2] == sender
        return self._route_ns if mine else 0

    def _better(self, sender: tuple[int, int]) -> bool:
        """Component 1 of the latched system takes over from a component that only looked like it."""
        held = self.autopilot
        return held is not None and held.system == sender[0] and sender[1] == 1 != held.component

    def _latch(self, now_ns: int) -> None:
        if self.autopilot is not None or self._first_ns is None or self.ambiguous:
            return
        named = self.target_system is not None and (self.target_system, 1) in self._seen
        if not named and now_ns - self._first_ns < LATCH_NS:
            return
        systems = {system for system, _ in self._seen}
        if len(systems) > 1:
            self.ambiguous = tuple(sorted(systems))
            return
        self.autopilot = replace(self._seen[min(self._seen)])
        self._route_ns = self.autopilot.heartbeat_ns
        self._next_heartbeat_ns = None

    def _heard(self, message: Message, route: str, now_ns: int) -> None:
        held = self.autopilot
        if held is None:
            return
        if route != held.route:
            self._claim(route, now_ns)
            return
        self._route_ns = now_ns
        self.clock.on_message(message, now_ns)

    def _claim(self, route: str, now_ns: int) -> None:
        self.second_route = route
        self._claim_ns = now_ns


def _our_heartbeat() -> Message:
    return dialect.MAVLink_heartbeat_message(
        dialect.MAV_TYPE_ONBOARD_CONTROLLER, _INVALID, 0, 0, dialect.MAV_STATE_ACTIVE, 3
    )
