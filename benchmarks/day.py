"""A day on the wire, accelerated: does anything grow, drift or tire in 24 hours? Part of `make soak`.

    day.py [HOURS] [SEED] [FIGURE]    default 24, 1 and docs/day.png

The whole service (Session.on) serves one scripted ArduPilot that flies ten minutes in each hour and asks for an
upload after each landing. Meanwhile, at random times: the link is gone for 2 to 90 s and comes back over the same or
another route; the vehicle reboots, on the ground and in flight; a ground station storms the parameters. The vehicle
sends what it is asked to send (SET_MESSAGE_INTERVAL) and forgets it at a reboot and on a new route, as ArduPilot does.

The table goes to standard output, the figure to the file, progress to standard error. 1 when a bound is broken.
"""

from __future__ import annotations

import gc
import math
import os
import random
import signal
import sys
import time
from array import array
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parent))

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from fuzz_wire import packed
from pymavlink.dialects.v20 import ardupilotmega as dialect
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from soak_rig import MS, Crew, S

from magmav.link import Packet
from magmav.mavlink.codec import Outgoing
from magmav.settings import Settings, Wire
from magmav.store import Store

HOUR = 3600
IMU_HZ, ATTITUDE_HZ, SLOW_HZ = 2.0, 2.0, 0.5  # a day is long; the companion asks for 20, 20 and 2 by itself
_EARTH_MG = (210.0, 10.0, 427.0)
_SAMPLE_S = 300.0
_GROUND = (255, 190)
_SETTLED_AFTER_H = 2.0  # tables are warm by then; growth is counted from here
_MOST_BPS = 500.0
_TICK_NS = 100 * MS
_LATCHED_NS = 10 * S  # between the first autopilot heard and the latch we keep quiet, by design
_STORED = {f"COMPASS_{group}_{axis}": float(group == "DIA") for group in ("DIA", "ODI", "MOT") for axis in "XYZ"}
_STORED |= {"COMPASS_MOTCT": 0.0, "COMPASS_SCALE": 0.0}
_BUILT = {27: "RAW_IMU", 30: "ATTITUDE", 33: "GLOBAL_POSITION_INT"}


@dataclass(slots=True)
class Log:
    """What was measured: heartbeat times, then one entry of the others for every five minutes."""

    beats_ns: array[int] = field(default_factory=lambda: array("q"))  # one block, however many: blocks are counted
    hours: list[float] = field(default_factory=list)
    rss_mb: list[float] = field(default_factory=list)
    blocks: list[int] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)  # of processor time for each simulated second
    sent_bps: list[float] = field(default_factory=list)
    streams_back_s: list[tuple[float, float]] = field(default_factory=list)  # hour, seconds after the link was back
    never_back: int = 0  # times it took over a minute, or for ever
    rates_hz: list[float] = field(default_factory=list)  # RAW_IMU, over calm stretches only
    events: Counter[str] = field(default_factory=Counter)
    results: Counter[str] = field(default_factory=Counter)
    requests: int = 0


class SlowCrew(Crew):
    """Quiet ticks ten times a second (a real link gives twenty) instead of fifty: a day is long."""

    def poll(self, now_ns: int) -> list[Outgoing]:
        return super().poll(now_ns) if now_ns % _TICK_NS == 0 else []


class Day:
    """The vehicle's day, and the service that lives through it."""

    def __init__(self, seed: int, store: Store) -> None:
        wire = Wire(imu_hz=IMU_HZ, attitude_hz=ATTITUDE_HZ, slow_hz=SLOW_HZ)
        self.crew = SlowCrew(seed, store, Settings(wire=wire))
        self.crew.on_sent = self._sent
        self.log = Log()
        self.dice = random.Random(f"day {seed}")
        self.iron_mg = [60.0, -45.0, 80.0]
        v = self.crew.vehicle
        v.streams = False  # we send them ourselves, with a clock that starts anew
        v.on_interval = self._interval
        v.params |= _STORED
        v.applied |= _STORED
        self.begun_ns = self.boot_ns = v.now_ns
        self.flying_since_ns: int | None = None
        self._streams: dict[int, list[int]] = {}  # message: interval, next
        self._silent_until_ns = 0
        self._back_ns: int | None = v.now_ns  # the link came back, the streams have not yet
        self._calm_ns = v.now_ns
        self._told = 0
        self._wanted = {27: IMU_HZ, 30: ATTITUDE_HZ, 33: SLOW_HZ}
        self._every(0.1, self._talk)

    @property
    def hour(self) -> float:
        """Since the beginning."""
        return (self.crew.vehicle.now_ns - self.begun_ns) / S / HOUR

    def after(self, seconds: float, what: Callable[[], None]) -> None:
        """Do it then."""
        self.crew.vehicle.at.append((self.crew.vehicle.now_ns + round(seconds * S), what))

    def _every(self, seconds: float, what: Callable[[], None]) -> None:
        def again() -> None:
            self.after(seconds, again)
            what()

        again()

    # ------------------------------------------------------------ the vehicle

    def _talk(self) -> None:
        v = self.crew.vehicle
        for number, (interval_ns, next_ns) in list(self._streams.items()):
            if v.now_ns >= next_ns:
                self._streams[number][1] = next_ns + interval_ns
                v.say(self._message(number))
                self._told += number == 27

    def _message(self, number: int) -> Any:
        now_ns, flying = self.crew.vehicle.now_ns, self.flying_since_ns
        t = 0.0 if flying is None else (now_ns - flying) / S
        roll, pitch, yaw = 0.35 * math.sin(0.7 * t), 0.3 * math.sin(0.45 * t), math.remainder(0.25 * t, math.tau)
        boot_ms = (now_ns - self.boot_ns) // MS
        if number == 30:
            rates = (0.245 * math.cos(0.7 * t), 0.135 * math.cos(0.45 * t), 0.25) if flying else (0.0, 0.0, 0.0)
            return dialect.MAVLink_attitude_message(boot_ms, roll, pitch, yaw, *rates)
        if number == 33:
            up = 30_000 if flying else 0
            return dialect.MAVLink_global_position_int_message(
                boot_ms, 473977000, 85456000, 488_000 + up, up, 0, 0, 0, 0
            )
        offsets = [self.crew.vehicle.applied[f"COMPASS_OFS_{axis}"] for axis in "XYZ"]
        field_mg = _in_body(roll, pitch, yaw)
        mag = [
            math.trunc(f - i + o + self.dice.gauss(0.0, 3.0))
            for f, i, o in zip(field_mg, self.iron_mg, offsets, strict=True)
        ]
        still = 2 if flying is None else 60
        return dialect.MAVLink_raw_imu_message(boot_ms * 1000, 0, 0, -1000, still, 0, 0, *mag)

    def fly(self) -> None:
        """Arm and go up; ten minutes later land, disarm, and ask for an upload."""
        v = self.crew.vehicle
        self.log.events["flights"] += 1
        self.iron_mg = [i + self.dice.uniform(-25.0, 25.0) for i in self.iron_mg]
        v.armed, v.landed_state, self.flying_since_ns = True, 2, v.now_ns
        self.after(600.0, self._land)

    def _land(self) -> None:
        v = self.crew.vehicle
        v.armed, v.landed_state, self.flying_since_ns = False, 1, None
        ask = {"param_id": b"MMAG_UPLOAD", "param_value": 1.0, "param_type": 9}
        self.after(15.0, lambda: self.ground("PARAM_SET", v.route, **ask))
        self.after(70.0, lambda: self.log.results.update([f"{self.crew.session.companion.result:g}"]))

    def reboot(self) -> None:
        """The clock begins anew, what was asked for is forgotten, five seconds of nothing."""
        self.log.events["reboots"] += 1
        self.gone(5.0, reboot=True)

    def gone(self, seconds: float, *, reboot: bool = False, elsewhere: bool = False) -> None:
        """Nothing gets through for so long."""
        v = self.crew.vehicle
        v.loss = 1.0
        self._given_up()
        self._calm_ns = v.now_ns + round(seconds * S) + 60 * S

        def back() -> None:
            v.loss = 0.0
            if reboot:
                self.boot_ns = v.now_ns - 3 * S
            if elsewhere:
                v.route = f"udp:{self.dice.randrange(1000, 60000)}"
            if reboot or elsewhere:
                self._streams.clear()
                self._back_ns = v.now_ns

        self.after(seconds, back)

    def reconnect(self) -> None:
        """The link is gone for a while, and perhaps comes back over another route."""
        self.log.events["reconnects"] += 1
        self.gone(self.dice.uniform(2.0, 90.0), elsewhere=self.dice.random() < 0.5)

    # ------------------------------------------------------------ the ground station

    def ground(self, name: str, over: str = "udp:14550", **fields: Any) -> None:
        """One message of the ground station to our component; what starts a write has to come over the vehicle's route.

        That is what a router, or a vehicle that forwards, makes of it (design, rule 11).
        """
        crew = self.crew
        target = {} if name in ("HEARTBEAT",) else {"target_system": 1, "target_component": 191}
        frame = packed(name, target | fields, _GROUND)
        crew.vehicle.receive(crew.take(Packet(crew.vehicle.now_ns, frame, over)))

    def storm(self) -> None:
        """Twenty seconds of lists, reads and sets, as a ground station with a broken loop sends them."""
        self.log.events["parameter storms"] += 1
        kind = {"type": 6, "autopilot": 8, "base_mode": 0, "custom_mode": 0, "system_status": 4, "mavlink_version": 3}
        self.ground("HEARTBEAT", **kind)
        for number in range(400):
            self.after(0.05 * number, self._storm_one)

    def _storm_one(self) -> None:
        dice = self.dice
        if dice.random() < 0.1:
            self.ground("PARAM_REQUEST_LIST")
        elif dice.random() < 0.6:
            self.ground("PARAM_REQUEST_READ", param_id=b"", param_index=dice.randrange(40))
        else:
            value = dice.choice((1.0, 2.0, math.nan, 99.0))
            self.ground("PARAM_SET", param_id=b"MMAG_HDG_RATE", param_value=value, param_type=9)

    # ------------------------------------------------------------ what is measured

    def _sent(self, message: Any, now_ns: int) -> None:
        kind = message.get_type()
        if kind == "HEARTBEAT" and now_ns - self.begun_ns > _LATCHED_NS:
            self.log.beats_ns.append(now_ns)
        elif kind == "COMMAND_LONG" and message.command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL:
            self.log.requests += 1

    def _interval(self, number: int, interval_us: float) -> bool:
        """The vehicle obeys a request that got there."""
        v = self.crew.vehicle
        known = number in _BUILT
        if known and interval_us > 0:
            self._streams[number] = [round(interval_us * 1000), v.now_ns]
        if self._back_ns is not None and set(self._streams) == set(_BUILT):
            self.log.streams_back_s.append((self.hour, (v.now_ns - self._back_ns) / S))
            self._back_ns = None
        return known

    def _given_up(self) -> None:
        """Streams that were not back after a minute."""
        back_ns, self._back_ns = self._back_ns, None
        self.log.never_back += back_ns is not None and self.crew.vehicle.now_ns - back_ns > 60 * S

    def run(self, hours: float, tick: Callable[[float], None]) -> None:
        """Let it all happen."""
        self._plan(hours)
        try:
            self._lives(hours, tick)
        finally:
            self._given_up()

    def _lives(self, hours: float, tick: Callable[[float], None]) -> None:
        log, crew = self.log, self.crew
        cpu_s, sent = time.process_time(), 0
        while self.hour < hours:
            told, from_ns = self._told, crew.vehicle.now_ns
            left_s = _SAMPLE_S
            while left_s > 0:
                crew.run(10.0)
                left_s -= 10.0
            tick(_SAMPLE_S)
            gc.collect()
            log.hours.append(self.hour)
            log.rss_mb.append(rss_mb())
            log.blocks.append(sys.getallocatedblocks())
            log.cpu_ms.append(1e3 * (time.process_time() - cpu_s) / _SAMPLE_S)
            log.sent_bps.append((crew.bytes_out - sent) / _SAMPLE_S)
            if from_ns > self._calm_ns:
                log.rates_hz.append((self._told - told) / _SAMPLE_S)
            cpu_s, sent = time.process_time(), crew.bytes_out

    def _plan(self, hours: float) -> None:
        """All that will happen, drawn beforehand."""
        last_s = hours * HOUR
        for hour in range(math.ceil(hours)):
            self.after(hour * HOUR + 900.0, self.fly)
        for what, pause_s in ((self.reconnect, 1500.0), (self.reboot, 4000.0), (self.storm, 1200.0)):
            at_s = self.dice.expovariate(1 / pause_s)
            while at_s < last_s:
                self.after(at_s, what)
                at_s += 120.0 + self.dice.expovariate(1 / pause_s)


def _in_body(roll: float, pitch: float, yaw: float) -> tuple[float, float, float]:
    """The Earth's field in body axes, mG."""
    n, e, d = _EARTH_MG
    x, y = n * math.cos(yaw) + e * math.sin(yaw), -n * math.sin(yaw) + e * math.cos(yaw)
    x, z = x * math.cos(pitch) - d * math.sin(pitch), x * math.sin(pitch) + d * math.cos(pitch)
    return x, y * math.cos(roll) + z * math.sin(roll), -y * math.sin(roll) + z * math.cos(roll)


def rss_mb() -> float:
    """What the process holds now; 0 where there is no /proc."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    except OSError:
        return 0.0


# ---------------------------------------------------------------- what came of it


@dataclass(frozen=True, slots=True)
class Row:
    """One number with its bound."""

    what: str
    value: str
    bound: str
    kept: bool


def rows(log: Log, hours: float) -> list[Row]:
    """Everything that is stated, and whether it is within its bound."""
    gaps_ms = [(b - a) / MS for a, b in zip(log.beats_ns, log.beats_ns[1:], strict=False)]
    span_s = (log.beats_ns[-1] - log.beats_ns[0]) / S
    drift_ms = 1e3 * (span_s - (len(log.beats_ns) - 1))
    warm = next((i for i, h in enumerate(log.hours) if h >= min(_SETTLED_AFTER_H, hours / 2)), 0)
    blocks, rss, cpu = log.blocks[warm:], log.rss_mb[warm:], log.cpu_ms[warm:]
    third = max(1, len(blocks) // 3)

    def grown(values: list[float] | list[int]) -> float:
        """The last third's mean over the first third's, as a share."""
        return sum(values[-third:]) / sum(values[:third]) - 1.0

    back = sorted(s for _, s in log.streams_back_s)
    rate_hz = sum(log.rates_hz) / len(log.rates_hz) if log.rates_hz else math.nan
    events = ", ".join(f"{n} {what}" for what, n in log.events.items())
    results = ", ".join(f"{n} x {what}" for what, n in log.results.most_common())
    return [
        Row("what happened", events, "", True),
        Row("MMAG_RESULT a minute after each landing", results, "", True),
        Row("heartbeats sent", f"{len(log.beats_ns)}", f"{span_s:.0f} +- 1", abs(len(log.beats_ns) - 1 - span_s) <= 1),
        Row("drift of the heartbeat", f"{drift_ms:+.0f} ms", "within 100 (a tick)", abs(drift_ms) <= 100.0),
        Row("pause between two", f"{min(gaps_ms):.0f} to {max(gaps_ms):.0f} ms", "900 to 1100", _within(gaps_ms)),
        Row("interval requests", f"{log.requests}", "", True),
        Row("RAW_IMU in calm stretches", f"{rate_hz:.2f} Hz", f"{IMU_HZ:g} +- 5 %", abs(rate_hz / IMU_HZ - 1) < 0.05),
        Row(
            "streams back after a new route or a reboot",
            f"median {back[len(back) // 2]:.1f} s, longest {back[-1]:.1f} s, {log.never_back} not in a minute"
            if back
            else "never",
            "longest under 60 s",
            bool(back) and back[-1] < 60.0 and log.never_back == 0,
        ),
        Row("own downlink", f"{max(log.sent_bps):.0f} B/s at most", "500 over 5 min", max(log.sent_bps) <= _MOST_BPS),
        Row("memory, RSS", f"{rss[0]:.1f} to {rss[-1]:.1f} MB, {100 * grown(rss):+.1f} %", "+5 %", grown(rss) < 0.05),
        Row(
            "memory, blocks", f"{blocks[0]} to {blocks[-1]}, {100 * grown(blocks):+.1f} %", "+2 %", grown(blocks) < 0.02
        ),
        Row("processor time a simulated second", f"{min(cpu):.1f} to {max(cpu):.1f} ms", "", True),
    ]


def _within(gaps_ms: list[float]) -> bool:
    return min(gaps_ms) >= 900.0 and max(gaps_ms) <= 1100.0


def draw(log: Log, path: Path) -> None:
    """Memory, the heartbeat's phase, the streams' return, the cost: over the hours."""
    figure, axes = plt.subplots(4, 1, figsize=(9, 9), sharex=True, constrained_layout=True)
    axes[0].plot(log.hours, [b / 1e3 for b in log.blocks], color="#1f5fa8")
    axes[0].set_ylabel("Python blocks, 1000")
    axes[0].set_ylim(0, None)
    other = axes[0].twinx()
    other.plot(log.hours, log.rss_mb, color="#c0562b")
    other.set_ylabel("RSS, MB", color="#c0562b")
    other.set_ylim(0, None)
    first = log.beats_ns[0]
    phase = [(t - first) / MS - 1000.0 * i for i, t in enumerate(log.beats_ns)]
    axes[1].plot([(t - first) / S / HOUR for t in log.beats_ns], phase, color="#1f5fa8", linewidth=0.6)
    axes[1].set_ylabel("heartbeat late, ms")
    axes[1].set_ylim(-150, 150)
    axes[2].plot(*zip(*log.streams_back_s, strict=True), "o", markersize=3, color="#1f5fa8")
    axes[2].set_ylabel("streams back after, s")
    axes[2].set_ylim(0, None)
    axes[3].plot(log.hours, log.cpu_ms, color="#1f5fa8")
    axes[3].set_ylabel("cpu, ms a simulated s")
    axes[3].set_ylim(0, None)
    axes[3].set_xlabel("simulated hours")
    for one in axes:
        one.grid(alpha=0.3)
    figure.savefig(path, dpi=100)


def main(argv: list[str]) -> int:
    """Live through it, print the table, draw the figure; 1 when a bound is broken."""
    hours, seed, path = (*argv, *("24", "1", str(Path(__file__).parents[1] / "docs" / "day.png"))[len(argv) :])
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # cut short, it tells what it has
    begun = time.process_time()
    with TemporaryDirectory() as folder, Store(Path(folder) / "day.sqlite") as store:
        day = Day(int(seed), store)
        with Progress(console=Console(stderr=True)) as progress:
            task = progress.add_task(f"{hours} h", total=float(hours) * HOUR)
            with suppress(KeyboardInterrupt):
                day.run(float(hours), lambda s: progress.advance(task, s))
    draw(day.log, Path(path))
    stated = rows(day.log, day.log.hours[-1])
    table = Table(
        title=f"{day.log.hours[-1]:.1f} simulated hours in {time.process_time() - begun:.0f} s of processor time"
    )
    for head in ("what", "measured", "bound", "kept"):
        table.add_column(head)
    for row in stated:
        table.add_row(row.what, row.value, row.bound, "" if not row.bound else "yes" if row.kept else "NO")
    Console(width=150).print(table)
    return 0 if all(row.kept for row in stated) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
