"""The whole companion on a simulated vehicle, in process and without a clock: what it knew, and every byte it sent."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from magmav_sim import Simulation, parse_scenario
from magmav_sim.link import ROUTE, SimulatedLink
from magmav_sim.scenario_file import load_scenario
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.core.types import AxisState, Record, State
from magmav.geomag import world_magnetic_model
from magmav.link import Link, Packet
from magmav.link.damage import Lossy
from magmav.live import Session
from magmav.settings import Settings
from magmav.store import Store

LEVEL = """
seed = {seed}
airframe = "F450"
date = 2026-11-22T10:00:00Z
place = {{ lat_deg = 47.3977, lon_deg = 8.5456, alt_m = 488.0 }}
heading_deg = 30.0
wind = {{ speed_mps = 3.0, from_deg = 250.0, turbulence_mps = 1.0 }}
stay = true

[[compass]]
device_id = 97539
hard_iron_mg = [180.0, -120.0, 240.0]
noise_mg = 4.0
delay_ms = 20.0

[[flight]]
pattern = [
    {{ kind = "takeoff", height_m = 12.0, climb_mps = 3.0 }},
    {{ kind = "yaw", turns = 1.5, rate_dps = 36.0 }},
    {{ kind = "figure8", laps = 1, half_length_m = 12.0, speed_mps = 4.5 }},
    {{ kind = "land", sink_mps = 2.0 }},
]
"""
"""One short flight that teaches all three axes, then on the ground for ever."""


IRON_MG = np.array((180.0, -120.0, 240.0))


def staying(seed: int = 31) -> Simulation:
    """The vehicle of LEVEL."""
    return Simulation(parse_scenario(LEVEL.format(seed=seed).encode(), "staying.toml"))


class Sent(NamedTuple):
    """One frame that left us: link time, bytes, and whether the vehicle truly was armed then."""

    t_ns: int
    data: bytes
    armed: bool


class SpyLink:
    """A link that remembers what was sent through it."""

    def __init__(self, link: Link, simulation: Simulation) -> None:
        self.name, self.datagrams = link.name, link.datagrams
        self.unix_offset_ns, self.counts = link.unix_offset_ns, link.counts
        self.sent: list[Sent] = []
        self._link, self._simulation = link, simulation

    def packets(self) -> Iterator[Packet]:
        return self._link.packets()

    def send(self, data: bytes, route: str = "") -> None:
        armed = self._simulation.autopilot.armed
        self.sent.append(Sent(self._simulation.elapsed_ns, bytes(data), armed))
        self._link.send(data, route)

    def close(self) -> None:
        self._link.close()


class Flight:
    """One vehicle, one companion. ``records`` is everything that was known, in order."""

    def __init__(
        self,
        simulation: Simulation,
        folder: Path,
        *,
        settings: Settings | None = None,
        weather: dict[str, float] | None = None,
        weather_seed: int = 1,
    ) -> None:
        self.sim = simulation
        base = SimulatedLink(simulation)
        self.link = SpyLink(base if weather is None else Lossy(base, weather_seed, **weather), simulation)
        self.store = Store(folder / "flight.sqlite").open()
        self.records: list[Record] = []
        self.heard: list[tuple[int, Any]] = []  # what we sent, as the operator's parser reads it
        watchers = (lambda reading, record: None if record is None else self.records.append(record),)
        self.session = Session.on(self.link, settings or Settings(), world_magnetic_model, self.store, watchers)
        self.companion, self.service = self.session.companion, self.session.service
        self._packets = self.link.packets()
        self._operator = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
        self._reader = dialect.MAVLink(None)
        self._read = 0

    def fly(self, until: Callable[[], bool] = lambda: False, seconds: float = 1e9) -> bool:
        """Turn the crank until the condition holds (True), the time is up or the flight is over (False)."""
        end_ns = self.sim.elapsed_ns + round(seconds * 1e9)
        for packet in self._packets:
            self.service.turn(packet)
            if not packet.data and until():
                return True
            if not packet.data and self.sim.elapsed_ns >= end_ns:
                return False
        return False

    def land(self) -> None:
        """Fly to the end of the (only) flight and let the vehicle rest for three seconds."""
        assert self.fly(lambda: self.sim.autopilot.armed, 60.0)
        assert self.fly(lambda: not self.sim.autopilot.armed, 300.0)
        self.fly(seconds=3.0)

    def end(self) -> None:
        """Leave as the service does, and close the store."""
        self.service._send(self.companion.leave(self.service.now_ns))
        self.store.close()

    def operator(self, message: Any) -> None:
        """A ground station's message reaches us over the vehicle's link."""
        data = bytes(message.pack(self._operator))
        self.service.turn(Packet(self.service.now_ns, data, ROUTE))

    def set(self, name: str, value: float, component: int = 191) -> None:
        """PARAM_SET of one of our own parameters."""
        self.operator(dialect.MAVLink_param_set_message(1, component, name.encode(), value, 9))

    def said(self) -> list[Any]:
        """Our messages since the last call."""
        new, self._read = self.link.sent[self._read :], len(self.link.sent)
        return [m for s in new for m in (self._reader.parse_buffer(s.data) or [])]

    def last(self, compass: int = 1) -> Record:
        """What was known last of a compass."""
        return next(r for r in reversed(self.records) if r.compass == compass)

    def value(self, name: str) -> float:
        """A parameter as the vehicle holds it."""
        return float(self.sim.autopilot.parameters[name])


def scenario(name: str, seed: int | None = None) -> Simulation:
    """A scenario of config/."""
    return Simulation(load_scenario(name), seed)


def error_mg(sim: Simulation, record: Record) -> np.ndarray:
    """(3,) mG, estimate minus the hard iron that really is there now."""
    return record.estimate.hard_iron_b_mg - np.array(sim.truth.hard_iron_b_mg[record.compass - 1])


def observed(record: Record) -> np.ndarray:
    """(3,) bool, the axes that motion showed."""
    return np.array([a is AxisState.OBSERVED for a in record.verdict.axes])


def ready(record: Record) -> bool:
    """Whether it would have been written."""
    return record.verdict.state is State.READY
