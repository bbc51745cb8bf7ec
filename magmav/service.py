"""Turns the crank: packets in, readings through the pipeline, records to whoever watches, packets out.

Live, replayed and simulated data run this same loop; a recorded link simply has no companion on it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

from magmav.core.types import Reading, Record
from magmav.hearing import Hearing
from magmav.link import Link, Packet
from magmav.mavlink.codec import Message, Outgoing
from magmav.pipeline import Pipeline

Watcher = Callable[[Reading, Record | None], None]
"""Sees every reading, and the Record it led to if it was a fresh magnetometer value. Changes nothing."""


class Companion(Protocol):
    """Our component on the wire: takes messages and records, gives back what is to be sent."""

    def on_message(self, message: Message, route: str, now_ns: int) -> list[Outgoing]:
        """A message came."""
        ...

    def on_record(self, record: Record, now_ns: int) -> None:
        """The pipeline knows something new."""
        ...

    def poll(self, now_ns: int) -> list[Outgoing]:
        """What is due now."""
        ...

    def leave(self, now_ns: int) -> list[Outgoing]:
        """Last words: give back what was changed."""
        ...

    def identity(self) -> tuple[int, int]:
        """System and component we speak as."""
        ...


class Service:
    """One link, one pipeline, and on a live link one companion."""

    def __init__(
        self,
        link: Link,
        pipeline: Pipeline,
        companion: Companion | None = None,
        watchers: Sequence[Watcher] = (),
    ) -> None:
        self.link = link
        self.pipeline = pipeline
        self.companion = companion
        self.hearing = Hearing(everything=companion is not None)
        self.heard = self.hearing.heard
        self.watchers = tuple(watchers)
        self.now_ns = 0

    def run(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Until the link ends or ``stop`` says so. What was borrowed from the vehicle is given back."""
        try:
            for packet in self.link.packets():
                self.turn(packet)
                if stop():
                    break
        finally:
            if self.companion is not None:
                self._send(self.companion.leave(self.now_ns))

    def turn(self, packet: Packet) -> None:
        """One packet, or one quiet tick."""
        self.now_ns = packet.t_ns
        if packet.data:
            for message in self.hearing.messages(packet, self.link.datagrams):
                self._message(message, packet)
        if self.companion is not None:
            self._send(self.companion.poll(packet.t_ns))

    def _message(self, message: Message, packet: Packet) -> None:
        for reading in self.hearing.readings(message):
            record = hand_on(reading, packet.t_ns, self.pipeline, self.watchers)
            if record is not None and self.companion is not None:
                self.companion.on_record(record, packet.t_ns)
        if self.companion is not None:
            self._send(self.companion.on_message(message, packet.route, packet.t_ns))

    def _send(self, outgoing: Sequence[Outgoing]) -> None:
        if self.companion is None:
            return
        system, component = self.companion.identity()
        for message, route in outgoing:
            self.link.send(self.hearing.codec.encode(message, system, component), route)

    def counts(self) -> dict[str, dict[str, int]]:
        """Everything that was counted on the way, by storey."""
        return all_counts({"link": dict(self.link.counts), **self.hearing.counts()}, self.pipeline)


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
