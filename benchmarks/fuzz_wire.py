"""Mutated MAVLink into the whole service: nothing raises, nothing grows, nothing of the vehicle changes.

    fuzz_wire.py [BYTES] [SEED] [WORKERS]    default 10000000 bytes, 1 and every core. Part of `make soak`.

The service (Session.on) sits between a scripted ArduPilot, on route udp:1, and somebody who sends rubbish. Five turns,
each a fifth of the bytes:

    idle      nobody asks for anything; every kind of rubbish, also valid frames in the vehicle's own name and route
    armed     the vehicle is armed and uploads are asked for all the time; rubbish in the vehicle's name comes damaged
              over its route, and half of the time whole over others (whole over its own, it is the vehicle, rule 11)
    disarmed  the same with the vehicle disarmed, where uploads may be refused or carried out, but keep their word
    stream    as armed, but a byte stream: rubbish between, and in the middle of, the vehicle's own frames
    flood     whole frames for our component only: parameters, commands, files, pings, as fast as they come

One row each, of what there is when it is cut short (SIGTERM); 1 when anything raised, a PARAM_SET left us unasked, a
parameter of the vehicle changed, or memory grew.
"""

from __future__ import annotations

import gc
import math
import os
import random
import signal
import struct
import sys
import time
import traceback
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.synchronize import Event
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parent))

from fastcrc import crc16
from pymavlink.dialects.v20 import ardupilotmega as dialect
from rich.console import Console
from rich.progress import track
from rich.table import Table
from soak_rig import NAMES, Crew, S

from magmav.core.types import UploadResult
from magmav.link import Packet
from magmav.store import Store

TURNS = ("idle", "armed", "disarmed", "stream", "flood")
OWN_ROUTE = "udp:1"
_ROUTES = ("udp:2", "udp:3", "udp:4")
_VEHICLE, _GROUND, _US, _GIMBAL = (1, 1), (255, 190), (1, 191), (1, 154)
_HEARD = (
    "HEARTBEAT", "RAW_IMU", "SCALED_IMU2", "SCALED_IMU3", "SCALED_IMU", "HIGHRES_IMU", "ATTITUDE",
    "ATTITUDE_QUATERNION", "GLOBAL_POSITION_INT", "GPS_RAW_INT", "SYS_STATUS", "BATTERY_STATUS", "VFR_HUD",
    "SYSTEM_TIME", "EXTENDED_SYS_STATE", "PARAM_VALUE", "PARAM_ERROR", "COMMAND_ACK", "MAG_CAL_PROGRESS",
    "MAG_CAL_REPORT", "AUTOPILOT_VERSION", "STATUSTEXT",
)  # fmt: skip
_ASKED = (
    "PARAM_SET", "PARAM_REQUEST_READ", "PARAM_REQUEST_LIST", "COMMAND_LONG", "COMMAND_INT", "FILE_TRANSFER_PROTOCOL",
    "PING", "PARAM_EXT_SET", "PARAM_EXT_REQUEST_LIST", "SETUP_SIGNING",
)  # fmt: skip
_PARAMETERS = (
    b"MMAG_UPLOAD", b"MMAG_RESTORE", b"MMAG_CONFIRM", b"MMAG_LEARN", b"MMAG_GATE_SD", b"MMAG_HDG_RATE", b"MMAG_RESULT",
    b"MMAG_OFS_X", b"COMPASS_OFS_X", b"COMPASS_DEV_ID", b"COMPASS_LEARN", b"CAL_MAG0_XOFF", b"CAL_MAG0_ID", b"",
)  # fmt: skip
KINDS = {kind.msgname: kind for kind in dialect.mavlink_map.values()}
_INTS = {"int8_t": (1, True), "uint8_t": (1, False), "int16_t": (2, True), "uint16_t": (2, False), "int32_t": (4, True),
         "uint32_t": (4, False), "int64_t": (8, True), "uint64_t": (8, False), "char": (1, False)}  # fmt: skip
_FLOATS = (math.nan, math.inf, -math.inf, 0.0, -0.0, 1e38, -1e38, 1e-40, 1.0, 2.0, 3.0, -1.0, 4294967296.0)
_MOST_GROWTH = 0.02  # of all that Python holds, over the second half of a turn
DAMAGE = ("flips", "cut", "length", "crc", "spliced", "noise")


def packed(name: str, fields: dict[str, Any], identity: tuple[int, int], sequence: int = 0) -> bytes:
    """A whole MAVLink 2 frame."""
    mav = dialect.MAVLink(None, *identity)
    mav.seq = sequence & 0xFF
    return bytes(KINDS[name](**fields).pack(mav))


def damaged(frame: bytes, how: str, dice: random.Random) -> bytes:
    """The same frame as bad cables, bad code and bad people make it. Nowhere in it is the frame still whole."""
    data = bytearray(frame)
    while frame in data:
        data = _hurt(bytearray(frame), how, dice)
    return bytes(data)


def _hurt(data: bytearray, how: str, dice: random.Random) -> bytearray:
    if how == "flips":
        for _ in range(dice.randint(1, 8)):
            bit = dice.randrange(8 * len(data))
            data[bit // 8] ^= 1 << bit % 8
    elif how == "cut":
        del data[dice.randrange(len(data)) :]
    elif how == "length":
        data[1] = dice.randrange(256)
    elif how == "crc":
        data[-1 - dice.randrange(2)] ^= dice.randint(1, 255)
    elif how == "spliced":
        data = data[: dice.randrange(len(data))] + data[dice.randrange(1, len(data)) :]
    else:
        data = bytearray(dice.randbytes(len(data)))
    return data


class Mutator:
    """Makes frames, the same for the same seed."""

    def __init__(self, seed: int) -> None:
        self.dice = random.Random(f"fuzz {seed}")
        # Few enough that every table that is kept by sender is full before half of the bytes are through.
        self._strangers = [(self.dice.randrange(256), self.dice.randrange(256)) for _ in range(24)]
        self.claims = True  # whole frames in the vehicle's name, over another route
        self.made: Counter[str] = Counter()

    def values(self, name: str, target: tuple[int, int] | None) -> dict[str, Any]:
        """Any value that fits the field, the odd ones often; the target as wished, None for any."""
        kind, dice = KINDS[name], self.dice
        out: dict[str, Any] = {}
        for key, what in zip(kind.fieldnames, kind.fieldtypes, strict=True):
            size = kind.array_lengths[kind.ordered_fieldnames.index(key)]
            if target is not None and key in ("target_system", "target_component"):
                out[key] = target[key == "target_component"]
            elif what == "char":
                out[key] = dice.choice((dice.choice(_PARAMETERS), self._name(), dice.randbytes(16)))[: size or 1]
            else:
                many = [self._value(what) for _ in range(max(1, size))]
                out[key] = many if size else many[0]
        return out

    def _name(self) -> bytes:
        """A parameter that nobody has, and that looks like one of a compass."""
        letters = bytes(self.dice.choices(b"ABCXYZ_0123", k=6))
        return self.dice.choice((b"COMPASS_", b"COMPASS_OFS", b"CAL_MAG0_", b"MMAG_")) + letters

    def _value(self, what: str) -> float | int:
        dice = self.dice
        if what in ("float", "double"):
            return dice.choice(_FLOATS) if dice.random() < 0.6 else dice.uniform(-2000.0, 2000.0)
        size, signed = _INTS[what]
        low, high = (-(1 << 8 * size - 1), (1 << 8 * size - 1) - 1) if signed else (0, (1 << 8 * size) - 1)
        return dice.choice((0, 1, low, high, high - 1, dice.randint(low, high), dice.randint(0, 100)))

    def whole(self, names: tuple[str, ...], source: tuple[int, int], target: tuple[int, int] | None) -> bytes:
        """A frame with the right checksum and wild values. One in twenty says that it is signed, without truth."""
        name = self.dice.choice(names)
        fields = self.values(name, target)
        frame = packed(name, fields, source, self.dice.randrange(256))
        if self.dice.random() < 0.05:
            frame = signed(frame, name, self.dice)
        return frame

    def _target(self) -> tuple[int, int] | None:
        return self.dice.choice((_US, _US, _US, (1, 0), (0, 0), _VEHICLE, None))

    def _source(self) -> tuple[int, int]:
        dice = self.dice
        return dice.choice((_VEHICLE, _GROUND, _US, _GIMBAL, (0, 0), (2, 1), dice.choice(self._strangers)))

    def next(self, turn: str) -> tuple[bytes, str]:
        """A frame, and the route it comes over."""
        dice = self.dice
        if turn == "flood":
            self.made["for us, right checksum"] += 1
            return self.whole(_ASKED, dice.choice((_GROUND, _GIMBAL)), _US), dice.choice((OWN_ROUTE, *_ROUTES))
        names = dice.choice((_HEARD, _ASKED, tuple(KINDS)))
        source = self._source()
        frame = self.whole(names, source, self._target())
        route = dice.choice((OWN_ROUTE, *_ROUTES))
        hurt = dice.random() < 0.5
        if turn == "stream":
            route = OWN_ROUTE
        if turn != "idle" and source == _VEHICLE:
            hurt = hurt or route == OWN_ROUTE or not self.claims
        if not hurt:
            self.made["wild values, right checksum"] += 1
            return frame, route
        how = dice.choice(DAMAGE)
        self.made[how] += 1
        return damaged(frame, how, dice), route


def signed(frame: bytes, name: str, dice: random.Random) -> bytes:
    """The flag, a right checksum, and thirteen bytes of nonsense for a signature."""
    data = bytearray(frame[:-2])
    data[2] |= 1
    check = crc16.mcrf4xx(bytes(data[1:]) + bytes((KINDS[name].crc_extra,)))
    return bytes(data) + struct.pack("<H", check) + dice.randbytes(13)


@dataclass(slots=True)
class Turn:
    """What one turn did."""

    name: str
    bytes_in: int = 0
    frames: int = 0
    bytes_out: int = 0
    unasked_sets: int = 0
    changed: dict[str, float] = field(default_factory=dict)
    ends: Counter[str] = field(default_factory=Counter)
    raised: list[str] = field(default_factory=list)
    cut: bool = False
    blocks: list[int] = field(default_factory=list)  # that Python holds, after each tenth
    rss_mb: list[float] = field(default_factory=list)
    seconds: float = 0.0
    simulated_s: float = 0.0

    @property
    def growth(self) -> float:
        """Blocks at the end over those in the middle, where every table is warm, as a share; 0 of a turn cut short."""
        return self.blocks[-1] / self.blocks[len(self.blocks) // 2] - 1.0 if self.blocks and not self.cut else 0.0

    @property
    def wrong(self) -> bool:
        """Something happened that must not."""
        grew = self.growth > _MOST_GROWTH
        return bool(self.raised or self.unasked_sets or self.changed or self.ends["broken word"] or grew)


class Fuzz:
    """One turn: a fresh service, and so many bytes of rubbish."""

    def __init__(self, turn: str, seed: int, store: Store) -> None:
        self.turn = Turn(turn)
        self.mutator = Mutator(seed)
        self.crew = Crew(seed, store)
        self.crew.line.datagrams = turn != "stream"
        self._counted = 0  # PARAM_SETs that had left before
        self._old = self._new = self.crew.held()

    def begin(self) -> None:
        """Latch in peace, then arm where the turn wants it."""
        self.crew.latch()
        self.crew.run(8.0)
        v = self.crew.vehicle
        v.armed = self.turn.name in ("armed", "stream")
        self.crew.run(1.5)
        self._before = dict(v.params)
        self._begun_ns = v.now_ns

    def step(self) -> None:
        """20 ms of the vehicle, then a handful of rubbish."""
        crew, turn, dice = self.crew, self.turn, self.mutator.dice
        crew.run(0.02)
        self._ask()
        # Half a minute with somebody who claims to be the vehicle, for which every upload is refused, and one without.
        self.mutator.claims = crew.vehicle.now_ns // (30 * S) % 2 == 0
        for _ in range(dice.choice((0, 0, 0, 0, 1, 2, 12))):
            data, route = self.mutator.next(turn.name)
            if not data:
                continue
            turn.bytes_in += len(data)
            turn.frames += 1
            packet = Packet(crew.vehicle.now_ns, data, route)
            try:
                crew.vehicle.receive([o for o in crew.take(packet) if o.route in ("", OWN_ROUTE)])
            except Exception:  # any exception is what we are looking for
                turn.raised.append(f"{data.hex()} over {route}\n{traceback.format_exc()}")
        turn.bytes_out = crew.bytes_out
        self._judge()

    def _ask(self) -> None:
        """Uploads are asked for where the turn has them."""
        companion, turn = self.crew.session.companion, self.turn.name
        if turn not in ("armed", "disarmed", "stream") or companion.job is not None:
            return
        if companion.ended is not None:
            self._ended(companion.ended.result)
            companion.ended = None
        elif self.mutator.dice.random() < 0.02 and not self.crew.store.pending():
            change = self.crew.change()
            self._old, self._new = change.old, change.new
            companion.start(change, None, self.crew.vehicle.now_ns)

    def _ended(self, result: UploadResult | None) -> None:
        held, turn = self.crew.held(), self.turn
        turn.ends["no result" if result is None else result.name] += 1
        if result is UploadResult.ALL_NEW:
            self._old = self._new
        # While a write is pending its undo may be refused (a second route is claimed), and says so truly.
        if not self.crew.store.pending() and held != self._old:
            turn.ends["broken word"] += 1

    def _judge(self) -> None:
        """Armed, idle and flooded, nothing may be written at all; disarmed, only the three offsets."""
        turn, v, w = self.turn, self.crew.vehicle, self.crew.witness
        free = NAMES if turn.name == "disarmed" else ()
        turn.unasked_sets = w.broken if free else w.sets
        turn.changed |= {n: x for n, x in v.params.items() if x != self._before[n] and n not in free}

    def peace(self) -> None:
        """No more rubbish: what was pending is restored, and the vehicle holds one of the two sets."""
        crew, turn = self.crew, self.turn
        crew.vehicle.armed = False
        for _ in range(6):
            crew.run(40.0, lambda: crew.session.companion.job is None and not crew.session.companion.presence.ambiguous)
            if crew.session.companion.job is None and not crew.store.pending():
                break
            crew.run(40.0)
        if crew.held() not in (self._old, self._new):
            turn.ends["broken word"] += 1
        turn.simulated_s = (crew.vehicle.now_ns - self._begun_ns) / S


_stop: Event | None = None  # of this worker's pool


def begin_worker(stop: Event) -> None:
    """A worker ends its turn when it is told to, not when the whole group is signalled."""
    global _stop
    _stop = stop
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_IGN)


def _cut() -> bool:
    return _stop is not None and _stop.is_set()


def run(name: str, size: int, seed: int) -> Turn:
    """One turn of so many bytes, or of what there was time for."""
    if _cut():
        return Turn(name, cut=True)
    with TemporaryDirectory() as folder, Store(Path(folder) / "fuzz.sqlite") as store:
        fuzz = Fuzz(name, seed, store)
        fuzz.begin()
        begun, turn = time.process_time(), fuzz.turn
        mark = size / 10
        while turn.bytes_in < size:
            if _cut():
                turn.cut = True
                break
            fuzz.step()
            if turn.bytes_in >= mark * (len(turn.blocks) + 1):
                gc.collect()
                turn.blocks.append(sys.getallocatedblocks())
                turn.rss_mb.append(_rss_mb())
        turn.seconds = time.process_time() - begun
        fuzz.peace()
        return turn


def _rss_mb() -> float:
    """What the process holds now; 0 where there is no /proc."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    except OSError:
        return 0.0


def table(turns: list[Turn], short: bool = False) -> Table:
    """A row for each turn and one for all."""
    cut = ", cut short" if short else ""
    out = Table(title=f"{sum(t.bytes_in for t in turns)} bytes of mutated MAVLink{cut}")
    heads = ("turn", "bytes", "frames", "simulated s", "cpu s", "bytes answered", "raised", "forbidden PARAM_SETs")
    for head in (*heads, "vehicle parameters changed", "uploads asked for", "Python blocks at 10, 50, 100 %", "RSS MB"):
        out.add_column(head, justify="left" if head in ("turn", "uploads asked for") else "right")
    for t in turns:
        ends = ", ".join(f"{n} {what}" for what, n in t.ends.most_common() if n)
        shown = [0, len(t.blocks) // 2, -1]
        memory = ", ".join(f"{t.blocks[i]}" for i in shown) if t.blocks else "-"
        rss = ", ".join(f"{t.rss_mb[i]:.0f}" for i in shown) if t.rss_mb else "-"
        numbers = (f"{t.bytes_in}", f"{t.frames}", f"{t.simulated_s:.0f}", f"{t.seconds:.0f}", f"{t.bytes_out}")
        out.add_row(t.name, *numbers, f"{len(t.raised)}", f"{t.unasked_sets}", f"{len(t.changed)}", ends, memory, rss)
    return out


def main(argv: list[str]) -> int:
    """Run every turn, print the table; 1 when something happened that must not."""
    size, seed, workers = (int(v) for v in (*argv, *("10000000", "1", f"{os.cpu_count() or 1}")[len(argv) :]))
    # A process for each turn, so that the memory of each is its own.
    spawn = get_context("spawn")
    stop = spawn.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    with ProcessPoolExecutor(workers, spawn, begin_worker, (stop,), max_tasks_per_child=1) as pool:
        tasks = [pool.submit(run, name, size // len(TURNS), seed) for name in TURNS]
        done = track(as_completed(tasks), "turns", len(tasks), console=Console(stderr=True))
        turns = sorted((task.result() for task in done), key=lambda t: TURNS.index(t.name))
    turns = [turn for turn in turns if turn.frames or not turn.cut]
    out = Console(width=200)
    out.print(table(turns, stop.is_set()))
    for turn in turns:
        for text in turn.raised[:5]:
            out.print(f"{turn.name}: {text}", markup=False)
        if turn.changed:
            out.print(f"{turn.name}: changed {turn.changed}", markup=False)
    return 1 if any(t.wrong for t in turns) else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
