"""One process and fifty vehicles: what each costs, and how long a message waits, against one vehicle. `make bench`.

    fleet_cost.py [SECONDS] [VEHICLES...]    default 30 s of flight, of 1, 10 and 50 vehicles

Each vehicle flies figures of eight with three compasses at 10 Hz, ATTITUDE at 10 Hz, and heartbeat, position and
landed state at 1 Hz, over a route of its own; the service serves them all (magmav.fleet.serve). The frames are made
beforehand. What is measured is processor time in Service.turn, packet by packet. Latency is from a packet's arrival
to the end of its turn in a queue with those times, the vehicles' phases spread at random: other work on the machine
does not count, waiting for other vehicles does.
"""

from __future__ import annotations

import os
import random
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import numpy as np
from honest_flight import MOTIONS, body_rates, field_in_body
from memory_flight import STORED, Teller, earth_model
from pymavlink.dialects.v20 import ardupilotmega as dialect
from rich.console import Console
from rich.progress import track
from rich.table import Table

from magmav.core.types import Reading, Record, State
from magmav.fleet import serve
from magmav.link import Packet
from magmav.settings import Settings, with_value
from magmav.store import Store

HZ = 10
_MS = 1_000_000
_IRON_MG = np.array(((60.0, -45.0, 80.0), (-120.0, 30.0, 40.0), (20.0, 90.0, -70.0)))
Frame = tuple[int, bytes, str]  # when it arrives, ns; what; over which route


class Peers:
    """A link with many peers; what is sent is counted."""

    name, datagrams, unix_offset_ns = "fleet", True, 1_790_000_000 * 10**9

    def __init__(self, routes: tuple[str, ...]) -> None:
        self.counts: Counter[str] = Counter()
        self.routes = routes

    def packets(self) -> Iterator[Packet]:
        """None: packets are handed to Service.turn one by one."""
        return iter(())

    def send(self, data: bytes, route: str = "") -> None:
        """Count."""
        self.counts["bytes out"] += len(data) * (1 if route else len(self.routes))

    def close(self) -> None:
        """Nothing to close."""


def stored() -> dict[str, float]:
    """What ArduPilot holds for three compasses."""
    held = dict(STORED)
    for name, value in STORED.items():
        for number in "23":
            for group in ("OFS", "DIA", "ODI", "MOT"):
                held[name.replace(f"_{group}_", f"_{group}{number}_")] = value
    for number, device in (("", 97539.0), ("2", 131874.0), ("3", 263178.0)):
        held |= {f"COMPASS_DEV_ID{number}": device, f"COMPASS_PRIO{number or 1}_ID": device}
    return held | {"COMPASS_SCALE2": 0.0, "COMPASS_SCALE3": 0.0}


def frames(system: int, seconds: float) -> list[Frame]:
    """What one vehicle sends: heartbeats and parameters first, then the flight."""
    dice, tell, route = random.Random(f"fleet {system}"), Teller(system), f"udp:{14000 + system}"
    r = np.random.default_rng(system)
    n = round(seconds * HZ)
    motion = MOTIONS["figure eight"](np.arange(n) / HZ, r)
    rates, field = body_rates(motion, 1 / HZ), field_in_body(motion)
    mag = np.trunc(field[:, None, :] + _IRON_MG + r.normal(0.0, 3.0, (n, 3, 3)))
    phase_ns, at_ns = dice.randrange(100 * _MS), 5 * 10**9
    out = [(at_ns + phase_ns + i * 10**9, tell.heartbeat(armed=False), route) for i in range(5)]
    values = stored().items()
    out += [(out[-1][0] + (i + 1) * 5 * _MS, tell.param(k, v), route) for i, (k, v) in enumerate(values)]
    start_ns = at_ns + phase_ns + 6 * 10**9
    for i in range(n):
        ms, now_ns = 10_000 + i * 1000 // HZ, start_ns + i * 10**9 // HZ
        said = [tell.attitude(ms, motion.roll_rad[i], motion.pitch_rad[i], float(motion.yaw_rad[i]), rates[i])]
        if i % HZ == 0:
            said += [tell.heartbeat(), tell.height(ms, 30.0), tell(dialect.MAVLink_extended_sys_state_message(0, 2))]
        a, b, c = (tuple(int(v) for v in row) for row in mag[i])
        said.append(tell(dialect.MAVLink_raw_imu_message(ms * 1000, 0, 0, -1000, 0, 0, 0, *a)))
        said.append(tell(dialect.MAVLink_scaled_imu2_message(ms, 0, 0, -1000, 0, 0, 0, *b)))
        said.append(tell(dialect.MAVLink_scaled_imu3_message(ms, 0, 0, -1000, 0, 0, 0, *c)))
        out += [(now_ns + k * _MS, data, route) for k, data in enumerate(said)]
    return out


@dataclass(frozen=True, slots=True)
class Cost:
    """One size of fleet. Latencies are of every packet of the flight, ms."""

    vehicles: int
    messages: int
    seconds: float
    cpu_s: float
    latency_ms: np.ndarray
    records: int
    ready: int
    rss_mb: float
    bytes_out: int


def measure(vehicles: int, seconds: float) -> Cost:
    """Hand over every packet in order of arrival, time each turn, and queue them."""
    systems = range(1, vehicles + 1)
    every = sorted(f for system in systems for f in frames(system, seconds))
    link = Peers(tuple(f"udp:{14000 + system}" for system in systems))
    last: dict[tuple[int, int], Record] = {}
    seen = 0

    def watch(reading: Reading, record: Record | None) -> None:
        nonlocal seen
        if record is not None:
            last[record.system, record.compass] = record
            seen += 1

    with TemporaryDirectory() as folder, Store(Path(folder) / "fleet.sqlite") as store:
        room = with_value(Settings(), "wire", "budget_bps", 500.0 * vehicles)  # as each would have alone
        service = serve(link, room, earth_model, store, [watch])
        from_ns = 5 * 10**9 + 6 * 10**9  # the flights; before that everybody says hello
        took_ns, arrived_ns = [], []
        for at_ns, data, route in track(every, f"{vehicles} vehicles", console=Console(stderr=True)):
            begun = time.thread_time_ns()
            service.turn(Packet(at_ns, data, route))
            if at_ns >= from_ns:
                took_ns.append(time.thread_time_ns() - begun)
                arrived_ns.append(at_ns)
        ready = sum(r.verdict.state is State.READY for r in last.values())
    free_ns, waits = 0, []
    for at_ns, took in zip(arrived_ns, took_ns, strict=True):
        free_ns = max(free_ns, at_ns) + took
        waits.append((free_ns - at_ns) / _MS)
    cpu_s, flown_s = sum(took_ns) / 1e9, (arrived_ns[-1] - arrived_ns[0]) / 1e9
    return Cost(
        vehicles, len(took_ns), flown_s, cpu_s, np.array(waits), seen, ready, _rss_mb(), link.counts["bytes out"]
    )


def _rss_mb() -> float:
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    except OSError:
        return 0.0


def main(argv: list[str]) -> int:
    """Measure each size, print the table."""
    seconds = float(argv[0]) if argv else 30.0
    sizes = [int(v) for v in argv[1:]] or [1, 10, 50]
    table = Table(title=f"One process, three compasses a vehicle at {HZ} Hz, {seconds:g} s of flight")
    heads = ("vehicles", "messages/s", "records/s", "share of a core", "us a message", "latency ms median", "99 %")
    for head in (*heads, "longest", "compasses READY", "sent B/s a vehicle", "RSS MB"):
        table.add_column(head, justify="right")
    measure(1, 3.0)  # libraries loaded, tables built
    for size in sizes:
        c = measure(size, seconds)
        low, high, most = np.percentile(c.latency_ms, (50, 99, 100))
        table.add_row(
            f"{c.vehicles}",
            f"{c.messages / c.seconds:.0f}",
            f"{c.records / c.seconds:.0f}",
            f"{100 * c.cpu_s / c.seconds:.1f} %",
            f"{1e6 * c.cpu_s / c.messages:.0f}",
            f"{low:.2f}",
            f"{high:.2f}",
            f"{most:.1f}",
            f"{c.ready} of {3 * c.vehicles}",
            f"{c.bytes_out / c.seconds / c.vehicles:.0f}",
            f"{c.rss_mb:.0f}",
        )
    Console(width=150).print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
