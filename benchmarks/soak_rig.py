"""The whole service on the scripted ArduPilot of the tests, with a witness on the wire: what the soaks share.

The witness parses our frames with pymavlink alone, so that nothing under test judges itself. It holds rule S1: no
PARAM_SET after a heartbeat that says armed was handed to us, nor with a last heartbeat older than 1.2 s.
"""

from __future__ import annotations

import random
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.core.types import Change, EarthField, UploadResult
from magmav.link import Packet
from magmav.live import Session
from magmav.mavlink.change import code_needed
from magmav.mavlink.codec import Outgoing
from magmav.settings import Settings
from magmav.store import Store

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from scripted_vehicle import MS, S, Vehicle, f32

NAMES = ("COMPASS_OFS_X", "COMPASS_OFS_Y", "COMPASS_OFS_Z")
Offsets = tuple[float, float, float]
_AGE_NS = 1200 * MS


def earth(lat_deg: float, lon_deg: float, alt_m: float, unix_ns: int) -> EarthField:
    """One field everywhere; nothing here depends on it."""
    return EarthField(210.0, 10.0, 427.0)


class Line:
    """The link under the service: what it sends is collected. The vehicle's clock is the only one."""

    name, datagrams, unix_offset_ns = "soak", True, 1_790_000_000 * S

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.routes: tuple[str, ...] = ()  # that were heard from, as a socket's peers: the last sixteen
        self.sent: list[tuple[bytes, str]] = []

    def packets(self) -> Iterator[Packet]:
        """None: packets are handed to Service.turn one by one."""
        return iter(())

    def send(self, data: bytes, route: str = "") -> None:
        """Collect."""
        self.sent.append((bytes(data), route))

    def close(self) -> None:
        """Nothing to close."""


class Witness:
    """Counts PARAM_SETs on the wire and those that break S1. Knows only frames and when we were handed them."""

    def __init__(self, vehicle: Vehicle) -> None:
        self.vehicle = vehicle
        self.sets = 0
        self.after_armed = 0  # the last heartbeat handed to us said armed
        self.stale = 0  # it was older than 1.2 s, or none had come
        self.foreign = 0  # of a parameter that is no offset (S5, S9)
        self.armed = False
        self.armed_heard = 0
        self._beat_ns: int | None = None
        self._mav = dialect.MAVLink(None)

    @property
    def broken(self) -> int:
        """PARAM_SETs that must not have been."""
        return self.after_armed + self.stale + self.foreign

    def hears(self, message: Any, now_ns: int) -> None:
        """What is handed to the service next."""
        if message.get_type() == "HEARTBEAT":
            self.armed, self._beat_ns = bool(message.base_mode & 128), now_ns
            self.armed_heard += self.armed

    def sees(self, frame: bytes, now_ns: int) -> Any:
        """What the service sent, parsed."""
        message = self._mav.decode(bytearray(frame))
        if message.get_type() == "PARAM_SET":
            self.sets += 1
            self.after_armed += self.armed
            self.stale += self._beat_ns is None or now_ns - self._beat_ns > _AGE_NS
            self.foreign += message.param_id not in NAMES
        return message


class Crew:
    """Vehicle, service, store and witness. ``run`` lets time go on; ``write`` carries one change to its end."""

    def __init__(self, seed: int, store: Store, settings: Settings | None = None) -> None:
        self.vehicle = Vehicle(seed)
        self.dice = random.Random(f"crew {seed}")
        self.store = store
        self.line = Line()
        self.session = Session.on(self.line, settings or Settings(), earth, store)
        self.witness = Witness(self.vehicle)
        self.until: Callable[[], bool] = lambda: False
        self.bytes_out = 0
        self.armed_meanwhile = 0  # messages handed over while a write ran and the last heartbeat said armed
        self.landed_armed = 0  # PARAM_SETs that reached the vehicle when it was armed already
        self.on_set: Callable[[], None] = lambda: None
        self.on_sent: Callable[[Any, int], None] = lambda message, now_ns: None
        self.vehicle.on_set = self._was_set

    # What Vehicle.run wants of a machine.

    @property
    def result(self) -> bool | None:
        return True if self.until() else None

    def on_message(self, message: Any, route: str, now_ns: int) -> list[Outgoing]:
        self.witness.hears(message, now_ns)
        self.armed_meanwhile += self.witness.armed and self.session.companion.job is not None
        return self.take(Packet(now_ns, bytes(message.get_msgbuf()), route))

    def poll(self, now_ns: int) -> list[Outgoing]:
        return self.take(Packet(now_ns, b"", ""))

    def take(self, packet: Packet) -> list[Outgoing]:
        """One packet into the service: what it sends, as the witness parsed it."""
        if packet.route and packet.route not in self.line.routes:
            self.line.routes = (*self.line.routes, packet.route)[-16:]
        self.session.service.turn(packet)
        sent, self.line.sent = self.line.sent, []
        self.bytes_out += sum(len(frame) for frame, _ in sent)
        out = [Outgoing(self.witness.sees(frame, packet.t_ns), route) for frame, route in sent]
        for item in out:
            self.on_sent(item.message, packet.t_ns)
        return out

    def _was_set(self, name: str) -> None:
        self.landed_armed += self.vehicle.armed
        self.on_set()

    # What a soak does.

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Let time go on; whether ``until`` came true."""
        self.until = until
        self.vehicle.run(self, seconds)
        self.vehicle.delivered.clear()  # the tests' records of every message would grow without end
        self.vehicle.sent.clear()
        self.vehicle.forget_sets()
        return until()

    def latch(self, seconds: float = 60.0) -> bool:
        """Wait until the service knows the vehicle."""
        return self.run(seconds, lambda: self.session.companion.presence.autopilot is not None)

    def held(self) -> Offsets:
        """What the vehicle truly stores."""
        x, y, z = (self.vehicle.params[name] for name in NAMES)
        return x, y, z

    def change(self, old: Offsets | None = None, most_mg: float = 140.0) -> Change:
        """A change of all three axes from what is stored, each by 20 mG to ``most_mg``."""
        old = old or self.held()
        # Towards the middle, so that a long run never nears COMPASS_OFFS_MAX.
        step = tuple(self.dice.uniform(20.0, most_mg) * (-1 if v > 0 else 1) for v in old)
        x, y, z = (f32(o + s) for o, s in zip(old, step, strict=True))
        shift = (x - old[0], y - old[1], z - old[2])
        return Change(1, 1, "COMPASS_DEV_ID", 97539, NAMES, old, (x, y, z), shift, (1.0,) * 3, tuple(map(abs, shift)))

    def write(self, change: Change, undoes: int | None = None, seconds: float = 200.0) -> UploadResult | None:
        """One write from start to end; None when it had no end in that time."""
        companion = self.session.companion
        companion.ended = None
        companion.start(change, code_needed(change), self.vehicle.now_ns, undoes)
        self.run(seconds, lambda: companion.ended is not None)
        return None if companion.ended is None else companion.ended.result
