"""Turns the crank: packets in, readings through the pipeline, records to whoever watches, packets out.

Live, replayed and simulated data run this same loop; a recorded link simply has no companion on it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Protocol

from magmav.core.types import Reading, Record
from magmav.link import Link, Packet
from magmav.mavlink.codec import Codec, Message, Outgoing
from magmav.mavlink.decode import Decoder
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
        self.decoder = Decoder()
        self.codec = Codec(self.decoder.wanted if companion is None else None)
        self.heard: Counter[str] = Counter()
        self.watchers = tuple(watchers)
        self.now_ns = 0
        self._route = ""

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
            if not self.link.datagrams and packet.route != self._route:
                self.codec.forget(self._route)  # the stream was reopened: half a frame of its former life is lost
                self._route = packet.route
            for message in self.codec.decode(packet.data, packet.route, whole=self.link.datagrams):
                self._message(message, packet)
        if self.companion is not None:
            self._send(self.companion.poll(packet.t_ns))

    def _message(self, message: Message, packet: Packet) -> None:
        self.heard[message.get_type()] += 1
        for reading in self.decoder.readings(message):
            record = self.pipeline.step(reading, packet.t_ns)
            if record is not None and self.companion is not None:
                self.companion.on_record(record, packet.t_ns)
            for watch in self.watchers:
                watch(reading, record)
        if self.companion is not None:
            self._send(self.companion.on_message(message, packet.route, packet.t_ns))

    def _send(self, outgoing: Sequence[Outgoing]) -> None:
        if self.companion is None:
            return
        system, component = self.companion.identity()
        for message, route in outgoing:
            self.link.send(self.codec.encode(message, system, component), route)

    def counts(self) -> dict[str, dict[str, int]]:
        """Everything that was counted on the way, by storey."""
        out = {
            "link": dict(self.link.counts),
            "codec": dict(self.codec.counts),
            "decode": dict(self.decoder.counts),
        }
        for system, vehicle in self.pipeline.vehicles.items():
            out[f"vehicle {system}"] = dict(vehicle.assembler.counts + vehicle.counts)
        return {storey: {k: v for k, v in numbers.items() if v} for storey, numbers in out.items()}
