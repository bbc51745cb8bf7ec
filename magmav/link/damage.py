"""Bad weather around any link: loss, repetition, disorder, flipped bits and delay, the same for the same seed."""

from __future__ import annotations

import math
import random
from collections import Counter, deque
from collections.abc import Iterator
from typing import NamedTuple

from magmav.link import Link, Packet


class _Parcel(NamedTuple):
    data: bytes
    route: str


class _Weather:
    """What happens to the packets of one direction. Each packet takes the same draws whatever the rates."""

    def __init__(self, seed: str, rates: dict[str, float], counts: Counter[str]) -> None:
        self._rng = random.Random(seed)
        self._rates = rates
        self._counts = counts
        self._held: _Parcel | None = None

    def through(self, parcel: _Parcel) -> list[_Parcel]:
        """What comes out when this goes in, in order."""
        lost, twice, late, hurt = (
            self._happens(what, self._rng.random()) for what in ("drop", "duplicate", "reorder", "flip")
        )
        bit = self._rng.randrange(max(1, 8 * len(parcel.data)))
        if lost:
            return self.calm()
        if hurt:
            parcel = parcel._replace(data=_flipped(parcel.data, bit))
        if late and self._held is None:
            self._held = parcel
            return [parcel] if twice else []
        return [parcel, *([parcel] if twice else []), *self.calm()]

    def calm(self) -> list[_Parcel]:
        """What was held back and may come out now."""
        held, self._held = self._held, None
        return [] if held is None else [held]

    def _happens(self, what: str, drawn: float) -> bool:
        happens = drawn < self._rates[what]
        if happens:
            self._counts[f"weather: {what}"] += 1
        return happens


class _Way:
    """Packets under way in one direction, each for the same time, so none overtakes another."""

    def __init__(self, latency_ns: int) -> None:
        self._latency_ns = latency_ns
        self._queue: deque[tuple[int, _Parcel]] = deque()

    def enter(self, parcels: list[_Parcel], now_ns: int) -> None:
        """These set out now."""
        self._queue.extend((now_ns + self._latency_ns, parcel) for parcel in parcels)

    def arrived(self, now_ns: int) -> list[_Parcel]:
        """What has come to its end by now, in order."""
        out = []
        while self._queue and self._queue[0][0] <= now_ns:
            out.append(self._queue.popleft()[1])
        return out

    def rest(self) -> list[_Parcel]:
        """What is still under way when the link ends."""
        out = [parcel for _, parcel in self._queue]
        self._queue.clear()
        return out


class Lossy:
    """A link in bad weather, both ways. Rates are probabilities per packet, drawn from the seed alone.

    drop : lost.  duplicate : comes twice.  reorder : comes after the next one, at the latest with the next
    quiet tick.  flip : one bit of it is wrong.  latency_s : so much later, each way, to the next packet or quiet
    tick of the link.  Quiet ticks are never touched; time never goes back.
    counts (the link's own): "weather: drop", "weather: duplicate", "weather: reorder", "weather: flip".
    """

    def __init__(
        self,
        link: Link,
        seed: int,
        drop: float = 0.0,
        duplicate: float = 0.0,
        reorder: float = 0.0,
        flip: float = 0.0,
        latency_s: float = 0.0,
    ) -> None:
        rates = {"drop": drop, "duplicate": duplicate, "reorder": reorder, "flip": flip}
        for what, rate in rates.items():
            if not 0.0 <= rate <= 1.0:
                raise ValueError(f"{what}: want a probability 0..1, got {rate!r}")
        if not 0.0 <= latency_s < math.inf:
            raise ValueError(f"latency_s: want seconds, 0 or more, got {latency_s!r}")
        self.name = link.name
        self.datagrams = link.datagrams
        self.unix_offset_ns = link.unix_offset_ns
        self.counts: Counter[str] = link.counts
        self._link = link
        self._inward = _Weather(f"{seed} in", rates, link.counts)
        self._outward = _Weather(f"{seed} out", rates, link.counts)
        self._now_ns = 0
        self._in, self._out = _Way(round(latency_s * 1e9)), _Way(round(latency_s * 1e9))

    def packets(self) -> Iterator[Packet]:
        """What survives, at the time it comes out."""
        for packet in self._link.packets():
            self._now_ns = packet.t_ns
            self.unix_offset_ns = self._link.unix_offset_ns
            if packet.data:
                self._in.enter(self._inward.through(_Parcel(packet.data, packet.route)), packet.t_ns)
            else:
                self._in.enter(self._inward.calm(), packet.t_ns)
                self._out.enter(self._outward.calm(), packet.t_ns)
            self._deliver()
            out = self._in.arrived(packet.t_ns)
            for data, route in out:
                yield Packet(packet.t_ns, data, route)
            if not out:
                yield Packet(packet.t_ns, b"", "")
        for data, route in (*self._in.rest(), *self._inward.calm()):
            yield Packet(self._now_ns, data, route)

    def send(self, data: bytes, route: str = "") -> None:
        """Send what survives, when it is due."""
        self._out.enter(self._outward.through(_Parcel(data, route)), self._now_ns)
        self._deliver()

    def _deliver(self) -> None:
        for parcel in self._out.arrived(self._now_ns):
            self._link.send(*parcel)

    def close(self) -> None:
        """Close the link."""
        self._link.close()


def _flipped(data: bytes, bit: int) -> bytes:
    out = bytearray(data)
    if out:
        out[bit // 8] ^= 1 << bit % 8
    return bytes(out)
