"""Every vehicle on the links of one process: a companion for each, as whom we speak to it and to nobody else.

A vehicle is whoever's autopilot is heard. What comes from it or is meant for it goes to its companion alone; what a
ground station says to all goes to the vehicles on that station's route, or to all where none is. Each companion pins
its own vehicle to one route, on whatever link that is. All share the budget of each link: they share the air.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence

import msgspec

from magmav.companion import MagCompanion
from magmav.core.types import FieldModel, Record
from magmav.link import Link
from magmav.mavlink.budget import Air, Budget
from magmav.mavlink.codec import Message, Outgoing
from magmav.mavlink.presence import Presence
from magmav.mavlink.signing import Signing
from magmav.pipeline import Pipeline
from magmav.service import Service, Watcher
from magmav.settings import Settings
from magmav.store import Store
from magmav.whereabouts import is_autopilot

_log = logging.getLogger("magmav")
_SECOND = 1_000_000_000
MOST = 64
POLL_NS = 20_000_000  # who hears nothing is looked after this often; who hears something, at once
GONE_NS = 600 * _SECOND  # a vehicle behind a hill comes back, and what was learnt of it is worth keeping till then
ROOM_NS = 60 * _SECOND  # silent this long, it makes room when there are MOST


class Fleet:
    """A MagCompanion per vehicle. Satisfies service.Companion.

    members : by system id.  counts : "too many vehicles", "forgotten".
    settings.vehicle.system : only this one, where it is not 0.
    """

    def __init__(
        self, settings: Settings, pipeline: Pipeline, store: Store, unix_offset_ns: int, *, keyed: bool = False
    ) -> None:
        self.members: dict[int, MagCompanion] = {}
        self.counts: Counter[str] = Counter()
        self._settings = settings
        self._pipeline = pipeline
        self._store = store
        self._unix_offset_ns = unix_offset_ns
        self._keyed = keyed
        self._heard_ns: dict[int, int] = {}
        self._polled_ns: dict[int, int] = {}
        self._air = Air(settings.wire.budget_bps)
        self._first = 0  # whose turn it is to have of the budget what is there
        self._looked_ns = 0
        wanted = settings.vehicle.system or None
        # Until somebody is heard: on a udpout link, or behind a router, nobody would speak first.
        self._herald = Presence(settings.vehicle.component, wanted)

    def identity(self) -> tuple[int, int]:
        """Whom we are before any vehicle was heard."""
        return self._herald.system, self._herald.component

    def on_message(self, message: Message, route: str, now_ns: int) -> list[Outgoing]:
        """To whom it concerns."""
        system = message.get_srcSystem()
        if system not in self.members and is_autopilot(message):
            self._welcome(message, now_ns)
        out: list[Outgoing] = []
        for number in self._concerned(message, route):
            member = self.members[number]
            out += _as(member, member.on_message(message, route, now_ns))
            self._polled_ns.pop(number, None)
        if self.believes(message, route):
            self._heard_ns[system] = now_ns
        return out

    def believes(self, message: Message, route: str) -> bool:
        """As the vehicle's own companion says."""
        member = self.members.get(message.get_srcSystem())
        return member is not None and member.believes(message, route)

    def on_record(self, record: Record, now_ns: int) -> None:
        """To the vehicle's own companion."""
        member = self.members.get(record.system)
        if member is not None:
            member.on_record(record, now_ns)

    def poll(self, now_ns: int) -> list[Outgoing]:
        """What is due for every vehicle."""
        if now_ns - self._looked_ns >= _SECOND:
            self._looked_ns = now_ns
            for system in [s for s, at in self._heard_ns.items() if now_ns - at > GONE_NS]:
                self._forget(system, now_ns)
        if not self.members:
            return self._herald.poll(now_ns)
        out: list[Outgoing] = []
        systems = list(self.members)
        self._first = (self._first + 1) % len(systems)
        for system in systems[self._first :] + systems[: self._first]:
            member = self.members[system]
            if now_ns - self._polled_ns.get(system, -POLL_NS) >= POLL_NS:
                self._polled_ns[system] = now_ns
                out += _as(member, member.poll(now_ns))
        return out

    def reached(self, system: int, copies: Mapping[str, int]) -> None:
        """To that vehicle's own companion."""
        if system in self.members:
            self.members[system].reached(system, copies)

    def leave(self, now_ns: int) -> list[Outgoing]:
        """Last words to each."""
        return [item for m in self.members.values() for item in _as(m, m.leave(now_ns))]

    # ------------------------------------------------------------ who is served

    def _welcome(self, message: Message, now_ns: int) -> None:
        system, vehicle = message.get_srcSystem(), self._settings.vehicle
        if vehicle.system not in (0, system) or message.get_srcComponent() == vehicle.component:
            return
        if len(self.members) >= MOST:
            oldest = min(self._heard_ns, key=lambda s: self._heard_ns[s])
            if now_ns - self._heard_ns[oldest] > ROOM_NS:
                self._forget(oldest, now_ns)
        if len(self.members) >= MOST:
            self.counts["too many vehicles"] += 1
            return
        own = msgspec.structs.replace(vehicle, system=system)
        self._heard_ns[system] = now_ns
        self.members[system] = MagCompanion(
            msgspec.structs.replace(self._settings, vehicle=own),
            self._pipeline,
            self._store,
            self._unix_offset_ns,
            keyed=self._keyed,
            budget=Budget(signed=self._keyed, air=self._air),
        )
        self._air.vehicles = len(self.members)
        _log.warning("vehicle %d is heard", system)

    def _forget(self, system: int, now_ns: int) -> None:
        """A vehicle that is gone. What it was asked for cannot be given back to it, what was learnt is kept."""
        member = self.members[system]
        if member.job is not None:
            return
        member.leave(now_ns)
        for table in (self.members, self._heard_ns, self._polled_ns):
            table.pop(system, None)
        self._pipeline.forget(system)
        self._air.vehicles = len(self.members)
        self.counts["forgotten"] += 1
        _log.warning("vehicle %d was silent for %d s and is forgotten", system, GONE_NS // _SECOND)

    def _concerned(self, message: Message, route: str) -> list[int]:
        """The vehicle it comes from and the one it is meant for; what is meant for all, on this route."""
        target = getattr(message, "target_system", 0)
        own = [s for s in dict.fromkeys((message.get_srcSystem(), target)) if s in self.members]
        if own or target:
            return own
        here = [s for s, m in self.members.items() if m.presence.autopilot and m.presence.autopilot.route == route]
        return here or list(self.members)


def _as(member: MagCompanion, out: Sequence[Outgoing]) -> list[Outgoing]:
    """Said by that vehicle's own component."""
    who = member.identity()
    return [item._replace(sender=who) for item in out]


def serve(
    link: Link,
    settings: Settings,
    model: FieldModel,
    store: Store,
    watchers: Sequence[Watcher] = (),
    *,
    signer: Signing | None = None,
) -> Service:
    """The long-running service on a link, or on many as one, for every vehicle there (its ``companion`` is a Fleet)."""
    pipeline = Pipeline(settings, model, link.unix_offset_ns)
    fleet = Fleet(settings, pipeline, store, link.unix_offset_ns, keyed=signer is not None)
    return Service(link, pipeline, fleet, watchers, signer)
