"""From a link's bytes to readings, counted: the part of the path that live, replayed and simulated data share."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from magmav.core.types import Reading
from magmav.link import Link, Packet
from magmav.mavlink.codec import Codec, Message, Signer
from magmav.mavlink.decode import Decoder


class Hearing:
    """Messages of one link, packet by packet. ``heard`` counts them by name.

    everything : also messages that give no reading (a companion answers some of those).
    signer : where only what is signed is believed.
    """

    def __init__(self, everything: bool, signer: Signer | None = None) -> None:
        self.decoder = Decoder()
        self.codec = Codec(None if everything else self.decoder.wanted, signer)
        self.heard: Counter[str] = Counter()
        self._lives: dict[str, str] = {}  # stream -> route of its present life
        self._sources: dict[int, tuple[int, str]] = {}  # system -> component and stream its words came from

    def messages(self, packet: Packet, whole: bool) -> Iterator[Message]:
        """Every message in this packet. ``whole``: packets hold whole frames, see Link.datagrams."""
        if not whole and packet.route != self._lives.get(stream := same_end(packet.route)):
            # The stream was reopened: half a frame of its former life is lost.
            self.codec.forget(self._lives.get(stream, ""))
            self._lives[stream] = packet.route
        for message in self.codec.decode(packet.data, packet.route, whole=whole):
            self.heard[message.get_type()] += 1
            yield message

    def moved(self, message: Message, route: str) -> bool:
        """Whether this system is now believed from another component, or another end, than before.

        What was learnt rests on one source (design, rule 11). A stream that was reopened is the same source.
        """
        system, source = message.get_srcSystem(), (message.get_srcComponent(), same_end(route))
        before = self._sources.get(system)
        self._sources[system] = source
        if before in (None, source):
            return False
        self.decoder.forget(system)
        return True

    def readings(self, message: Message) -> list[Reading]:
        """What it says of the vehicle."""
        return self.decoder.readings(message)

    def counts(self) -> dict[str, dict[str, int]]:
        """What was left out on the way, by storey."""
        return {"codec": dict(self.codec.counts), "decode": dict(self.decoder.counts)}


def same_end(route: str) -> str:
    """A stream's route without the number of its life: the same device or address, opened again."""
    return route.partition("#")[0]


class LinkRecording:
    """A link that ends, as a recording: every reading at the time its packet arrived.

    Satisfies magmav.logs.Recording. Errors are the link's.
    """

    def __init__(self, link: Link) -> None:
        self.link = link
        self.name = link.name
        self.unix_offset_ns = link.unix_offset_ns
        self._hearing = Hearing(everything=False)
        self.heard = self._hearing.heard

    @property
    def counts(self) -> Counter[str]:
        """What was left out and why."""
        hearing = self._hearing
        return self.link.counts + hearing.codec.counts + hearing.decoder.counts

    def by_storey(self) -> dict[str, dict[str, int]]:
        """The same, apart for link, codec and decoder."""
        return {"link": dict(self.link.counts), **self._hearing.counts()}

    def readings(self) -> Iterator[tuple[int, Reading]]:
        """(t_ns, reading) in the order of arrival."""
        for packet in self.link.packets():
            if packet.data:
                for message in self._hearing.messages(packet, self.link.datagrams):
                    for reading in self._hearing.readings(message):
                        yield packet.t_ns, reading

    def in_runs(self) -> Iterator[tuple[int, Reading]]:
        """The same: nothing is read in runs here."""
        return self.readings()

    def close(self) -> None:
        """Let go of the link."""
        self.link.close()
