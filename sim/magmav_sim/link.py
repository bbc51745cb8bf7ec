"""The vehicle as a link, in process and without a clock of the world: the same run is the same bytes."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator

from magmav.link import Packet
from magmav_sim.vehicle import Simulation

ROUTE = "sim:vehicle"
SECOND_ROUTE = "sim:second"


class SimulatedLink:
    """A ``magmav.link.Link`` whose packets step the simulation by ``tick_s`` each.

    t_ns is simulated time since the start and goes on through reboots of the vehicle. Each frame is a
    packet of its own, and every tick ends with a quiet packet. Ends when the scenario does, or after
    ``until_s``.
    """

    def __init__(self, simulation: Simulation, tick_s: float = 0.02, until_s: float | None = None) -> None:
        if tick_s < 0.01:
            raise ValueError(f"tick_s: at least one frame of 0.01 s, got {tick_s}")
        self.name = f"sim:{simulation.scenario.name}"
        self.datagrams = True
        self.unix_offset_ns = round(simulation.scenario.date.timestamp() * 1e9)
        self.counts: Counter[str] = Counter()
        self.simulation = simulation
        self._tick_s = tick_s
        self._until_ns = math.inf if until_s is None else until_s * 1e9
        self._closed = False

    def packets(self) -> Iterator[Packet]:
        """Step and yield until the scenario ends, the time is up or the link is closed."""
        sim = self.simulation
        while not (self._closed or sim.finished or sim.elapsed_ns >= self._until_ns):
            for data in sim.advance(self._tick_s):
                self.counts["packets in"] += 1
                yield Packet(sim.elapsed_ns, data, ROUTE)
                if self._closed:
                    return
            for data in sim.second_route():
                self.counts["packets in"] += 1
                yield Packet(sim.elapsed_ns, data, SECOND_ROUTE)
            yield Packet(sim.elapsed_ns, b"", "")

    def send(self, data: bytes, route: str = "") -> None:
        """To the vehicle, which reacts in the next tick. A route that is not the vehicle's is counted;
        the second one takes everything and does nothing with it."""
        if route == SECOND_ROUTE:
            self.counts["packets to the second route"] += 1
            return
        if route not in ("", ROUTE):
            self.counts["unknown route"] += 1
            return
        self.counts["packets out"] += 1
        self.simulation.receive(data)

    def close(self) -> None:
        """End the iterator of packets."""
        self._closed = True
