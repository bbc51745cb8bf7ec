"""A flight as bytes: what a scripted ArduPilot vehicle would send, made from honest_flight's truth."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping

import numpy as np
from honest_flight import MOTIONS, body_rates, field_in_body
from pymavlink.dialects.v20 import ardupilotmega as dialect
from synthetic_flight import EARTH_MG, HARD_IRON_MG

from magmav.core.types import EarthField, Record
from magmav.link import Packet
from magmav.link.memory import MemoryLink, SetClock, memory_pair
from magmav.mavlink.codec import Codec
from magmav.pipeline import Pipeline
from magmav.service import Service
from magmav.settings import Settings

HZ = 25
STORED = {"COMPASS_DEV_ID": 97539.0, "COMPASS_MOTCT": 0.0, "COMPASS_SCALE": 0.0} | {
    f"COMPASS_{group}_{axis}": float(group == "DIA") for group in ("OFS", "DIA", "ODI", "MOT") for axis in "XYZ"
}
Frame = tuple[int, bytes]  # boot time in ms, and what was sent then


class Frames:
    """A link that yields these frames a millisecond apart and ends."""

    name, datagrams, unix_offset_ns = "frames", True, 1_790_000_000 * 10**9

    def __init__(self, frames):
        self.frames, self.counts = list(frames), Counter()

    def packets(self):
        for i, (_, data) in enumerate(self.frames):
            yield Packet(5 * 10**9 + i * 10**6, data, "memory")

    def close(self):
        pass


def earth_model(lat_deg: float, lon_deg: float, alt_m: float, unix_ns: int) -> EarthField:
    """The field the flights are made in, everywhere and always."""
    return EarthField(*EARTH_MG)


class Teller:
    """Speaks as one vehicle."""

    def __init__(self, system: int = 1, component: int = 1) -> None:
        self.identity = (system, component)
        self._codec = Codec()

    def __call__(self, message: object) -> bytes:
        return self._codec.encode(message, *self.identity)

    def heartbeat(self, armed: bool = True, kind: int = 2) -> bytes:
        return self(dialect.MAVLink_heartbeat_message(kind, 3, 128 * armed, 0, 4, 3))

    def param(self, name: str, value: float) -> bytes:
        return self(dialect.MAVLink_param_value_message(name.encode(), value, 9, 900, 65535))

    def params(self, values: Mapping[str, float] = STORED) -> bytes:
        return b"".join(self.param(n, v) for n, v in values.items())

    def height(self, ms: int, metres: float) -> bytes:
        up = int(metres * 1000)
        return self(
            dialect.MAVLink_global_position_int_message(ms, 473977000, 85456000, 488_000 + up, up, 0, 0, 0, 65535)
        )

    def attitude(self, ms: int, roll: float, pitch: float, yaw: float, rate: np.ndarray) -> bytes:
        return self(dialect.MAVLink_attitude_message(ms, roll, pitch, float(np.angle(np.exp(1j * yaw))), *rate))

    def imu(self, ms: int, mag: np.ndarray, number: int = 1) -> bytes:
        x, y, z = (int(v) for v in mag)
        if number == 1:
            return self(dialect.MAVLink_raw_imu_message(ms * 1000, 0, 0, -1000, 0, 0, 0, x, y, z))
        return self(dialect.MAVLink_scaled_imu2_message(ms, 0, 0, -1000, 0, 0, 0, x, y, z))


def flight(
    system: int = 1,
    seconds: float = 40.0,
    motion: str = "figure eight",
    seed: int = 0,
    iron_mg: np.ndarray = HARD_IRON_MG,
    offsets_mg: np.ndarray | None = None,
    told: Mapping[str, float] | None = STORED,
    from_ms: int = 10_000,
    height_m: float = 30.0,
    yaw: np.ndarray | None = None,
) -> list[Frame]:
    """Frames of a flight at 25 Hz; offsets_mg (N, 3) or (3,) are what the autopilot adds; yaw replaces the told yaw."""
    r = np.random.default_rng(seed)
    n = int(seconds * HZ)
    m = MOTIONS[motion](np.arange(n) / HZ, r)
    sensor = np.trunc(field_in_body(m) + iron_mg + r.normal(0.0, 3.0, (n, 3)))
    sent = sensor if offsets_mg is None else sensor + offsets_mg
    rates = body_rates(m, 1 / HZ)
    tell, out = Teller(system), []
    shown = m.yaw_rad if yaw is None else yaw
    for i in range(n):
        ms = from_ms + i * 1000 // HZ
        if i % HZ == 0:
            out.append((ms, tell.heartbeat() + tell.height(ms, height_m)))
        if i == 0 and told is not None:
            out.append((ms, tell.params(told)))
        out.append((ms, tell.attitude(ms, m.roll_rad[i], m.pitch_rad[i], float(shown[i]), rates[i])))
        out.append((ms, tell.imu(ms, sent[i])))
    return out


class Bench:
    """The service at one end of a memory link, on a clock that is set."""

    def __init__(self, settings: Settings | None = None, *, datagrams: bool = True) -> None:
        self.clock = SetClock(5 * 10**9)
        here: MemoryLink
        here, self.there = memory_pair(self.clock, datagrams=datagrams, unix_offset_ns=1_790_000_000 * 10**9)
        self.pipeline = Pipeline(settings or Settings(), earth_model, here.unix_offset_ns)
        self.records: list[Record] = []
        self.service = Service(here, self.pipeline, watchers=(self._watch,))
        self._packets = here.packets()

    def _watch(self, reading: object, record: Record | None) -> None:
        if record is not None:
            self.records.append(record)

    def play(self, frames: Iterable[Frame | bytes]) -> list[Record]:
        """Send, take in, and give back the records that came of it."""
        before = len(self.records)
        for frame in frames:
            self.there.send(frame if isinstance(frame, bytes) else frame[1])
            self.clock.advance(0.001)
            self.service.turn(self._next())
        return self.records[before:]

    def _next(self) -> Packet:
        return next(self._packets)

    def of(self, system: int, compass: int = 1) -> list[Record]:
        return [r for r in self.records if (r.system, r.compass) == (system, compass)]


def together(*flights: list[Frame]) -> Iterator[Frame]:
    """Several vehicles on one link, in order of time."""
    yield from sorted((f for one in flights for f in one), key=lambda f: f[0])
