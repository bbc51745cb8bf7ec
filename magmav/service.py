"""Turns the crank: packets in, readings through the pipeline, records to whoever watches, packets out.

Live, replayed and simulated data run this same loop; a recorded link simply has no companion on it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

from magmav.core.types import Reading, Record
from magmav.hearing import Hearing
from magmav.link import Link, Packet, routes_of, whole_frames
from magmav.mavlink.budget import copies_by_link
from magmav.mavlink.codec import Message, Outgoing
from magmav.mavlink.signing import Signing
from magmav.pipeline import Pipeline
from magmav.whereabouts import Whereabouts

Watcher = Callable[[Reading, Record | None], None]
"""Sees every reading, and the Record it led to if it was a fresh magnetometer value. Changes nothing."""


class Companion(Protocol):
    """Our component on the wire: takes messages and records, gives back what is to be sent."""

    def on_message(self, message: Message, route: str, now_ns: int) -> list[Outgoing]:
        """A message came."""
        ...

    def believes(self, message: Message, route: str) -> bool:
        """Whether what it says of a vehicle counts: asked after ``on_message``."""
        ...

    def on_record(self, record: Record, now_ns: int) -> None:
        """The pipeline knows something new."""
        ...

    def poll(self, now_ns: int) -> list[Outgoing]:
        """What is due now."""
        ...

    def reached(self, system: int, copies: Mapping[str, int]) -> None:
        """What this system says to everybody went out so often, by link."""
        ...

    def leave(self, now_ns: int) -> list[Outgoing]:
        """Last words: give back what was changed."""
        ...

    def identity(self) -> tuple[int, int]:
        """System and component we speak as, where a message does not say so itself."""
        ...


class Service:
    """One link, one pipeline, and on a live link one companion (or a Fleet of them).

    signer : signs what is sent; what it does not call good is not heard.
    counts of sending : "no route" (meant for one, and nobody knows where that is), "not for it" (another vehicle
    is there). Neither is sent.
    """

    def __init__(
        self,
        link: Link,
        pipeline: Pipeline,
        companion: Companion | None = None,
        watchers: Sequence[Watcher] = (),
        signer: Signing | None = None,
    ) -> None:
        self.link = link
        self.pipeline = pipeline
        self.companion = companion
        self.hearing = Hearing(everything=companion is not None, signer=signer)
        self.heard = self.hearing.heard
        self.watchers = tuple(watchers)
        self.now_ns = 0
        self._signer = signer
        self._where = Whereabouts()
        self._unsent: Counter[str] = Counter()

    def run(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Until the link ends or ``stop`` says so. What was borrowed from the vehicle is given back."""
        try:
            for packet in self.link.packets():
                self.turn(packet)
                if stop():
                    break
        finally:
            self.leave()

    def turn(self, packet: Packet) -> None:
        """One packet, or one quiet tick."""
        self.now_ns = packet.t_ns
        if self._signer is not None:
            self._signer.tick(packet.t_ns + self.link.unix_offset_ns)
        if packet.data:
            for message in self.hearing.messages(packet, whole_frames(self.link, packet.route)):
                self._message(message, packet)
        if self.companion is not None:
            self._send(self.companion.poll(packet.t_ns))

    def leave(self) -> None:
        """Last words."""
        if self.companion is not None:
            self._send(self.companion.leave(self.now_ns))
        if self._signer is not None:
            self._signer.leave()

    def _message(self, message: Message, packet: Packet) -> None:
        if self.companion is None:
            self._learn(message, packet.t_ns)
            return
        self._where.on_message(message, packet.route, packet.t_ns)
        answers = self.companion.on_message(message, packet.route, packet.t_ns)
        if self.companion.believes(message, packet.route):
            if self.hearing.moved(message, packet.route):
                self.pipeline.forget(message.get_srcSystem())
            self._learn(message, packet.t_ns)
        self._send(answers)

    def _learn(self, message: Message, t_ns: int) -> None:
        for reading in self.hearing.readings(message):
            record = hand_on(reading, t_ns, self.pipeline, self.watchers)
            if record is not None and self.companion is not None:
                self.companion.on_record(record, t_ns)

    def _send(self, outgoing: Sequence[Outgoing]) -> None:
        if self.companion is None:
            return
        for item in outgoing:
            sender = item.sender or self.companion.identity()
            ways = self._ways(item, sender[0])
            if not item.route and ways:
                reached = routes_of(self.link) if ways == ("",) else ways
                self.companion.reached(sender[0], copies_by_link(reached))
            if ways:
                frame = self.hearing.codec.encode(item.message, *sender)
                for route in ways:
                    self.link.send(frame, route)

    def _ways(self, item: Outgoing, system: int) -> Sequence[str]:
        """Where it goes: what is meant for one over one route, what is for all to all but other vehicles."""
        target = getattr(item.message, "target_system", 0)
        if item.route:
            if self._where.keeps_from(target or system, item.route):
                self._unsent["not for it"] += 1
                return ()
            return (item.route,)
        if target:
            self._unsent["no route"] += 1
            return ()
        strange = self._where.strange_to(system)
        if not strange:
            return ("",)
        return tuple(r for r in routes_of(self.link) if r not in strange)

    def counts(self) -> dict[str, dict[str, int]]:
        """Everything that was counted on the way, by storey."""
        source = {"link": dict(self.link.counts), **self.hearing.counts(), "not sent": dict(self._unsent)}
        if self._signer is not None:
            source["signing"] = dict(self._signer.counts)
        return all_counts(source, self.pipeline)


def hand_on(reading: Reading, t_ns: int, pipeline: Pipeline, watchers: Sequence[Watcher]) -> Record | None:
    """One reading through the pipeline, shown to everybody who watches."""
    record = pipeline.step(reading, t_ns)
    for watch in watchers:
        watch(reading, record)
    return record


def all_counts(source: Mapping[str, Mapping[str, int]], pipeline: Pipeline) -> dict[str, dict[str, int]]:
    """What was counted at the source and for each vehicle, without the zeros."""
    out = dict(source)
    for system, vehicle in pipeline.vehicles.items():
        out[f"vehicle {system}"] = vehicle.assembler.counts + vehicle.counts
    return {storey: {k: v for k, v in numbers.items() if v} for storey, numbers in out.items()}
