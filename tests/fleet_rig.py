"""Vehicles in memory with routes of their own, and the service that serves them: who was told what, frame by frame."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from memory_flight import STORED, earth_model
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.fleet import Fleet, serve
from magmav.link import Packet
from magmav.live import Session
from magmav.mavlink.signing import Signing
from magmav.settings import Settings
from magmav.store import Store

UNIX_OFFSET_NS = 1_795_000_000 * 10**9
S = 10**9


class Exchange:
    """A link with many peers, as a socket has: who has sent something is one. What is sent is kept by route."""

    name, datagrams, unix_offset_ns = "exchange", True, UNIX_OFFSET_NS

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.routes: tuple[str, ...] = ()
        self.sent: dict[str, list[Any]] = defaultdict(list)
        self.raw: dict[str, list[bytes]] = defaultdict(list)
        self._parser = dialect.MAVLink(None)

    def packets(self) -> Iterator[Packet]:
        return iter(())

    def send(self, data: bytes, route: str = "") -> None:
        for at in self.routes if route == "" else (route,):
            assert at in self.routes, at
            self.raw[at].append(data)
            self.sent[at] += self._parser.parse_buffer(data) or []

    def close(self) -> None:
        pass


class Craft:
    """One vehicle as it talks: heartbeat, landed state, IMU, and answers to parameter reads and interval wishes."""

    def __init__(self, system: int, route: str, *, key: bytes | None = None, component: int = 1, seed: int = 0) -> None:
        self.system, self.route = system, route
        self.mav = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
        if key is not None:
            self.mav.signing.secret_key, self.mav.signing.sign_outgoing = key, True
            self.mav.signing.timestamp = (UNIX_OFFSET_NS - 1_420_070_400 * S) // 10_000
        self.armed = False
        self.params = dict(STORED) | {"COMPASS_DEV_ID": 97539.0 + system}
        self.field = np.array((210.0, -35.0, 390.0))
        self.heard: list[Any] = []
        self.random = np.random.default_rng(seed)
        self.talks = True

    def pack(self, message: Any) -> bytes:
        frame = bytes(message.pack(self.mav))
        self.mav.seq = (self.mav.seq + 1) & 0xFF
        return frame

    def heartbeat(self, armed: bool | None = None) -> bytes:
        base = 128 if (self.armed if armed is None else armed) else 0
        return self.pack(dialect.MAVLink_heartbeat_message(2, 3, base | 1, 0, 4, 3))

    def imu(self, ms: int) -> bytes:
        x, y, z = (int(v) for v in self.field + self.random.normal(0.0, 3.0, 3))
        return self.pack(dialect.MAVLink_raw_imu_message(ms * 1000, 0, 0, -1000, 0, 0, 0, x, y, z))

    def param(self, name: str, value: float) -> bytes:
        return self.pack(dialect.MAVLink_param_value_message(name.encode(), value, 9, 900, 65535))

    def talk(self, ms: int) -> list[bytes]:
        """What it says in this tenth of a second, unasked."""
        if not self.talks:
            return []
        out = []
        if ms % 1000 == 0:
            out += [self.heartbeat(), self.pack(dialect.MAVLink_extended_sys_state_message(0, 1))]
        return [*out, self.imu(ms)]

    def answer(self, message: Any) -> list[bytes]:
        """To what is meant for it."""
        if getattr(message, "target_system", None) != self.system or not self.talks:
            return []
        if message.get_type() == "PARAM_REQUEST_READ" and message.param_id in self.params:
            return [self.param(message.param_id, self.params[message.param_id])]
        if message.get_type() == "PARAM_SET" and message.param_id in self.params:
            self.params[message.param_id] = message.param_value
            return [self.param(message.param_id, message.param_value)]
        if message.get_type() == "COMMAND_LONG":
            return [self.pack(dialect.MAVLink_command_ack_message(message.command, 0, 0, 0, 0, 0))]
        return []


class Airspace:
    """The service on an Exchange, and the craft that talk to it, a tenth of a second at a time."""

    def __init__(
        self,
        folder: Path,
        *craft: Craft,
        single: bool = False,
        settings: Settings | None = None,
        signer: Signing | None = None,
    ) -> None:
        self.link = Exchange()
        self.store = Store(folder / "magmav.sqlite").open()
        self.craft = craft
        self.records: list[Any] = []
        watch = (lambda reading, record: None if record is None else self.records.append(record),)
        chosen = settings or Settings()
        if single:
            self.session = Session.on(self.link, chosen, earth_model, self.store, watch, signer=signer)
            self.service = self.session.service
        else:
            self.service = serve(self.link, chosen, earth_model, self.store, watch, signer=signer)
        self.ms = 0
        self._read: Counter[str] = Counter()

    @property
    def fleet(self) -> Fleet:
        assert isinstance(self.service.companion, Fleet)
        return self.service.companion

    def push(self, data: bytes, route: str) -> None:
        """One packet from somewhere."""
        self.link.routes = tuple(dict.fromkeys((*self.link.routes, route)))
        self.service.turn(Packet(self.now_ns, data, route))

    @property
    def now_ns(self) -> int:
        return 5 * S + self.ms * 1_000_000

    def run(self, seconds: float) -> None:
        """Everybody talks; what is sent reaches who is at that route, and is answered."""
        for _ in range(round(seconds * 10)):
            for c in self.craft:
                for frame in c.talk(self.ms):
                    self.push(frame, c.route)
            for _ in range(4):
                self._answer()
            self.ms += 100
            self.service.turn(Packet(self.now_ns, b"", ""))

    def _answer(self) -> None:
        for route in {c.route for c in self.craft}:
            sent = self.link.sent[route]
            new = sent[self._read[route] :]
            self._read[route] = len(sent)
            for c in self.craft:
                if c.route == route:
                    c.heard += new
                    for frame in [f for m in new for f in c.answer(m)]:
                        self.push(frame, route)


def ground(message: Any, system: int = 255, component: int = 190) -> bytes:
    """A ground station says this."""
    return bytes(message.pack(dialect.MAVLink(None, srcSystem=system, srcComponent=component)))
