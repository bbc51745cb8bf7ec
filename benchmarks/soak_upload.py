"""Uploads that nothing may spoil: AT-8a over many seeds, S1 over many timings of arming. Part of `make soak`.

    soak_upload.py [SEEDS] [TIMINGS] [WORKERS]    default 1000, 10000 and every core

The whole service (Session.on) writes to the scripted ArduPilot of the tests. AT-8a: 30 % of the messages lost each
way, 10 % doubled, each delayed by its own time of up to 2 s (and so out of order). S1: the vehicle arms, or falls
silent, at random times, half of them right at a write. A witness with pymavlink's own parser counts on the wire.
Tables go to standard output, progress to standard error; 1 when a rule was broken.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import Pool
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parent))

from rich.console import Console
from rich.progress import track
from rich.table import Table
from soak_rig import MS, NAMES, Crew, Offsets, S

from magmav.core.types import UploadResult
from magmav.settings import Attitude, Learn, Settings
from magmav.store import Store

TIMINGS_EACH = 10  # with one vehicle and one service, one after the other
_ALL_ARRIVED_S = 6.0  # a copy of a write that is still under way has arrived by then
_BANDS_S = (0.5, 1.0, 1.5, 2.0)
_LIGHT = Settings(attitude=Attitude(own="complementary"), learn=Learn(on=False))  # what is learnt matters not here
_T = TypeVar("_T")
_A = TypeVar("_A")


@dataclass(frozen=True, slots=True)
class Weathered:
    """One upload in bad weather. holds: NEW, OLD or MIXED when everything has arrived."""

    seed: int
    latency_s: float
    end: str
    holds: str
    later: str  # after a PENDING_RESTORE: what it holds when the restore is through
    broken: int
    sets: int
    seconds: float

    @property
    def wrong(self) -> bool:
        """A rule was broken: mixed for good, or not what it says, or a forbidden write."""
        said = {"ALL_NEW": "NEW", "ALL_OLD": "OLD", "REFUSED": "OLD"}.get(self.end)
        kept = self.later == "OLD" if said is None else self.holds == said
        return self.broken > 0 or not kept or self.end == "no end" or (self.end == "REFUSED" and self.sets > 0)


def _folder() -> str | None:
    """Memory where there is some: every record is forced to disk, and a disk's wait teaches nothing here."""
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None


def _holds(held: Offsets, old: Offsets, new: Offsets) -> str:
    return "NEW" if held == new else "OLD" if held == old else "MIXED"


def bad_weather(seed: int) -> Weathered:
    """AT-8a, one seed: its latency is between 5 ms and 2 s, with up to 0.3 s more or less for each message."""
    with TemporaryDirectory(dir=_folder()) as folder, Store(Path(folder) / "soak.sqlite") as store:
        crew = Crew(seed, store)
        vehicle, dice = crew.vehicle, crew.dice
        latency_s = dice.uniform(0.005, 2.0)
        vehicle.loss, vehicle.duplicate = 0.3, 0.1
        jitter = vehicle.random
        vehicle.delay_ns = lambda: round(min(2.0, max(0.005, latency_s + jitter.uniform(-0.3, 0.3))) * S)
        crew.latch()
        old, begun_ns = crew.held(), vehicle.now_ns
        change = crew.change()
        result = crew.write(change)
        seconds = (vehicle.now_ns - begun_ns) / S
        crew.run(_ALL_ARRIVED_S)
        holds = _holds(crew.held(), old, change.new)
        later = ""
        if result is UploadResult.PENDING_RESTORE:
            for _ in range(10):  # the service restores by itself, within half a minute of being allowed to
                crew.run(40.0)
                if not store.pending() and crew.session.companion.job is None:
                    break
            crew.run(_ALL_ARRIVED_S)
            later = _holds(crew.held(), old, change.new)
        end = "no end" if result is None else result.name
        w = crew.witness
        return Weathered(seed, latency_s, end, holds, later, w.broken, w.sets, seconds)


@dataclass(frozen=True, slots=True)
class Timing:
    """One write into which something comes. landed_armed: writes that crossed the arming on their way."""

    batch: int
    number: int
    spoil: str
    end: str
    sets: int
    after_armed: int
    stale: int
    foreign: int
    landed_armed: int
    undetected: bool  # a write landed on the armed vehicle, we heard of it, and it was called a success
    kept: bool  # the vehicle holds what the end says, and the old values after a restore
    said_armed: bool  # a heartbeat that says armed was handed to us while the write ran

    @property
    def wrong(self) -> bool:
        """S1, S3 or the word of the result was broken."""
        return bool(self.after_armed or self.stale or self.foreign) or self.undetected or not self.kept


def armings(batch: int) -> list[Timing]:
    """S1: several timings, one after the other, on one vehicle with one service and one store."""
    with TemporaryDirectory(dir=_folder()) as folder, Store(Path(folder) / "soak.sqlite") as store:
        crew = Crew(1_000_000 + batch, store, _LIGHT)
        crew.run(crew.dice.uniform(0.0, 1.0))
        crew.latch()
        return [_arming(crew, batch, number) for number in range(TIMINGS_EACH)]


def _arming(crew: Crew, batch: int, number: int) -> Timing:
    vehicle, dice, w = crew.vehicle, crew.dice, crew.witness
    _calm(crew)
    vehicle.loss = dice.choice((0.0, 0.0, 0.2))
    most_ms = dice.choice((5, 40, 400, 1500))
    vehicle.delay_ns = lambda: round(vehicle.random.uniform(2, most_ms) * MS)
    vehicle.applies = dice.random() < 0.7  # else the proof fails, and the way back is met too
    spoil = dice.choice(("arm", "arm", "arm and say", "mute", "flap"))
    if dice.random() < 0.5:
        _at(crew, dice.uniform(0.05, 6.0 if vehicle.applies else 16.0), spoil)
    else:
        _at_set(crew, dice.randint(1, 6), dice.choice((0.0, 0.02, dice.uniform(0.0, 1.2))), spoil)
    before = (w.sets, w.after_armed, w.stale, w.foreign, crew.landed_armed, crew.armed_meanwhile)
    old, change = crew.held(), crew.change()
    result = crew.write(change, seconds=150.0)
    slow_s = most_ms / 1000 + 0.1
    said_armed, landed = crew.armed_meanwhile > before[5], crew.landed_armed > before[4]
    success = result in (UploadResult.ALL_NEW, UploadResult.ALL_OLD)
    crew.run(slow_s)  # whatever is under way has arrived
    kept = _keeps_its_word(crew, result, old, change.new)
    counts = (w.sets - before[0], w.after_armed - before[1], w.stale - before[2], w.foreign - before[3])
    end = "no end" if result is None else result.name
    crossed = crew.landed_armed - before[4]
    return Timing(batch, number, spoil, end, *counts, crossed, landed and said_armed and success, kept, said_armed)


def _keeps_its_word(crew: Crew, result: UploadResult | None, old: Offsets, new: Offsets) -> bool:
    """What it holds is what was said; what is pending is the old set once the vehicle may be written to again."""
    if result is UploadResult.ALL_NEW:
        return crew.held() == new
    if result in (UploadResult.ALL_OLD, UploadResult.REFUSED):
        return crew.held() == old
    if result is not UploadResult.PENDING_RESTORE:
        return False
    begun = crew.session.companion.job is not None  # the service was quicker and restores already
    return _restored(crew, old) if crew.dice.random() < 0.25 or begun else _left(crew, old, new)


def _left(crew: Crew, old: Offsets, new: Offsets) -> bool:
    """Each value is the old or the new one, and it is on record. Then all is put back by hand for the next timing."""
    vehicle = crew.vehicle
    pairs = zip(crew.held(), old, new, strict=True)
    kept = bool(crew.store.pending()) and all(h in (o, n) for h, o, n in pairs)
    vehicle.params |= dict(zip(NAMES, old, strict=True))
    vehicle.applied |= dict(zip(NAMES, old, strict=True))
    for row in crew.store.pending():
        crew.store.dismiss(row.id)
    return kept


def _restored(crew: Crew, old: Offsets) -> bool:
    """The old set is there once the vehicle may be written to again, also when it arms into the restore."""
    companion = crew.session.companion
    if crew.dice.random() < 0.3:
        _at_set(crew, crew.dice.randint(1, 3), 0.0, "arm")
    else:
        _forget(crew)
    alone = crew.dice.random() < 0.15  # the service waits up to 30 s before it restores by itself
    for _ in range(3):
        _calm(crew, keep=True)
        if not alone and companion.job is None and crew.store.pending():
            row = crew.store.pending()[0]  # the newest: an undo that was cut short is one too
            crew.write(row.change, undoes=row.id)
        else:
            companion.ended = None
            crew.run(130.0, lambda: companion.ended is not None)
        crew.run(130.0, lambda: companion.job is None)
        if not crew.store.pending():
            break
        _forget(crew)
    return crew.held() == old


def _calm(crew: Crew, keep: bool = False) -> None:
    """Disarmed and talking, in good weather, until the last heartbeat says so too."""
    v = crew.vehicle
    v.armed, v.heartbeats, v.applies, v.loss = False, True, True, 0.0
    v.delay_ns = lambda: 5 * MS
    v.at.clear()
    if not keep:
        _forget(crew)
    crew.run(0.2)
    crew.run(5.0, lambda: not crew.witness.armed)


def _forget(crew: Crew) -> None:
    crew.on_set = lambda: None


def _at(crew: Crew, seconds: float, spoil: str) -> None:
    crew.vehicle.at.append((crew.vehicle.now_ns + round(seconds * S), lambda: _spoil(crew, spoil)))


def _at_set(crew: Crew, number: int, seconds: float, spoil: str) -> None:
    """When the vehicle gets its n-th PARAM_SET from now on, and so long after."""
    left = number

    def counted() -> None:
        nonlocal left
        left -= 1
        if left == 0:
            _at(crew, seconds, spoil) if seconds else _spoil(crew, spoil)

    crew.on_set = counted


def _spoil(crew: Crew, spoil: str) -> None:
    v = crew.vehicle
    if spoil == "mute":
        v.heartbeats = False
        return
    v.armed = True
    if spoil == "arm and say":
        v.say(v.heartbeat())
    if spoil == "flap":  # shorter than the pause between two heartbeats
        v.at.append((v.now_ns + 900 * MS, lambda: setattr(v, "armed", False)))
    else:
        v.at.append((v.now_ns + 20 * S, lambda: setattr(v, "armed", False)))


# ---------------------------------------------------------------- tables


def weather_table(ends: Sequence[Weathered]) -> Table:
    """AT-8a, a row for each band of latency."""
    table = Table(title=f"AT-8a: {len(ends)} seeds, 30 % lost each way, 10 % doubled, delays up to 2 s, out of order")
    heads = ("latency one way", "seeds", "ALL_NEW", "ALL_OLD", "refused, nothing sent", "PENDING_RESTORE", "then old")
    for head in (*heads, "mixed for good", "rule broken", "median s", "longest s"):
        table.add_column(head, justify="right")
    rows = [(f"{b - 0.5:.1f} to {b:.1f} s", [e for e in ends if b - 0.5 <= e.latency_s < b]) for b in _BANDS_S]
    for name, mine in [*rows, ("all", list(ends))]:
        if not mine:
            continue
        count = Counter(e.end for e in mine)
        cells = [f"{count[k]}" for k in ("ALL_NEW", "ALL_OLD", "REFUSED", "PENDING_RESTORE")]
        cells.append(f"{sum(e.later == 'OLD' for e in mine)}")
        cells.append(f"{sum((e.later or e.holds) == 'MIXED' for e in mine)}")
        cells.append(f"{sum(e.wrong for e in mine)}")
        seconds = sorted(e.seconds for e in mine)
        table.add_row(name, f"{len(mine)}", *cells, f"{seconds[len(mine) // 2]:.1f}", f"{seconds[-1]:.1f}")
    return table


def arming_table(timings: Sequence[Timing]) -> Table:
    """S1, a row for each way to spoil a write."""
    table = Table(title=f"S1: {len(timings)} randomised timings; PARAM_SETs counted on the wire")
    heads = ("what happens", "times", "ALL_NEW", "ALL_OLD", "REFUSED", "PENDING_RESTORE", "PARAM_SETs sent")
    for head in (*heads, "after armed heard", "heartbeat over 1.2 s", "other names", "crossed the arming", "wrong end"):
        table.add_column(head, justify="left" if head == "what happens" else "right")
    for name in (*sorted({t.spoil for t in timings}), "all"):
        mine = [t for t in timings if name in (t.spoil, "all")]
        count = Counter(t.end for t in mine)
        cells = [f"{count[k]}" for k in ("ALL_NEW", "ALL_OLD", "REFUSED", "PENDING_RESTORE")]
        sums = (sum(t.sets for t in mine), sum(t.after_armed for t in mine), sum(t.stale for t in mine))
        more = (sum(t.foreign for t in mine), sum(t.landed_armed for t in mine))
        bad = sum(t.undetected or not t.kept for t in mine)
        table.add_row(name, f"{len(mine)}", *cells, *(f"{n}" for n in (*sums, *more, bad)))
    return table


def _through(work: Callable[[_A], _T], tasks: Sequence[_A], what: str, workers: int) -> list[_T]:
    out: list[_T] = []
    with Pool(workers) as pool, suppress(KeyboardInterrupt):
        for one in track(pool.imap(work, tasks), what, len(tasks), console=Console(stderr=True)):
            out.append(one)
    return out


def main(argv: list[str]) -> int:
    """Run both, print both tables; 1 when a rule was broken."""
    seeds, timings, workers = (int(v) for v in (*argv, *("1000", "10000", f"{os.cpu_count() or 1}")[len(argv) :]))
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # cut short, it tells what it has
    out, begun = Console(width=170), time.monotonic()
    weather = _through(bad_weather, range(seeds), "AT-8a", workers)
    batches = range((timings + TIMINGS_EACH - 1) // TIMINGS_EACH)
    arms = [t for some in _through(armings, batches, "S1", workers) for t in some][:timings]
    if weather:
        out.print(weather_table(weather))
    if arms:
        out.print(arming_table(arms))
    wrong = [x for x in (*weather, *arms) if x.wrong]
    for x in wrong[:20]:
        out.print(f"WRONG: {x}")
    out.print(f"{len(wrong)} broken rules; {time.monotonic() - begun:.0f} s with {workers} processes")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
