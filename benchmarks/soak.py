"""Many seeds: do the claimed sigmas tell the truth, and does an upload in bad weather end well?

`make soak`, at most about ten minutes on two cores. The table goes to standard output, progress to standard error.

    soak.py [FLIGHTS] [UPLOADS]    seeds per scenario (default 30) and uploads (default 200)

Errors are against the simulator's truth at the end of the flight (for offsets, what is in error is the hard iron).
error/sigma pooled should have an rms of 0.7 to 1.2 on every axis that is called observed (design, rule 9).
"""

from __future__ import annotations

import math
import sys
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from magmav_sim import SimulatedLink, Simulation, load_scenario, parse_scenario
from rich.console import Console
from rich.progress import track
from rich.table import Table

from magmav.core.types import AxisState, Reading, Record, State
from magmav.geomag import world_magnetic_model
from magmav.link.damage import Lossy
from magmav.live import Session
from magmav.mavlink.autopilot.ardupilot import plan_change
from magmav.mavlink.change import code_needed
from magmav.settings import Settings
from magmav.store import Store

SCENARIOS = ("hover_yaw", "figure8", "survey", "loiter")
_BOUND_S = 480.0  # for the flights; the uploads take a minute or two
_WEATHER = {"drop": 0.3, "duplicate": 0.1, "reorder": 0.1}
_ON_THE_GROUND = b"""
seed = 1
airframe = "F450"
date = 2026-11-22T10:00:00Z
place = { lat_deg = 47.3977, lon_deg = 8.5456, alt_m = 488.0 }
stay = true
[[compass]]
device_id = 97539
hard_iron_mg = [180.0, -120.0, 240.0]
noise_mg = 4.0
"""
_NAMES = ("COMPASS_OFS_X", "COMPASS_OFS_Y", "COMPASS_OFS_Z")


@dataclass(frozen=True, slots=True)
class Answer:
    """What one flight taught about one compass: at the end, and when it first would have been written."""

    scenario: str
    seed: int
    ready: bool
    error_mg: tuple[float, ...]
    sigma_mg: tuple[float, ...]
    observed: tuple[bool, ...]
    first_ready_s: float  # since the start, nan when it never was
    first_error_mg: tuple[float, ...]
    first_sigma_mg: tuple[float, ...]


def fly(task: tuple[str, int]) -> list[Answer]:
    """One flight from take-off to landing, and what was known then."""
    name, seed = task
    simulation = Simulation(load_scenario(name), seed)
    last: dict[int, Record] = {}
    first: dict[int, Record] = {}

    def watch(reading: Reading, record: Record | None) -> None:
        if record is not None:
            last[record.compass] = record
            if record.verdict.state is State.READY:
                first.setdefault(record.compass, record)

    with TemporaryDirectory() as folder, Store(Path(folder) / "soak.sqlite") as store:
        link = SimulatedLink(simulation)
        session = Session.on(link, Settings(), world_magnetic_model, store, [watch])
        session.service.run()
    iron = [np.array(v) for v in simulation.truth.hard_iron_b_mg]
    nothing = (math.nan,) * 3
    out = []
    for compass, r in last.items():
        early = first.get(compass)
        out.append(
            Answer(
                name,
                seed,
                r.verdict.state is State.READY,
                tuple(r.estimate.hard_iron_b_mg - iron[compass - 1]),
                tuple(r.sigma_mg),
                tuple(a is AxisState.OBSERVED for a in r.verdict.axes),
                math.nan if early is None else early.t_ns / 1e9,
                nothing if early is None else tuple(early.estimate.hard_iron_b_mg - iron[compass - 1]),
                nothing if early is None else tuple(early.sigma_mg),
            )
        )
    return out


def upload(seed: int) -> tuple[str, bool, float]:
    """One write with 30 % loss both ways: its result, whether the vehicle holds what the result says, seconds."""
    simulation = Simulation(parse_scenario(_ON_THE_GROUND, "ground.toml"), seed)
    link = Lossy(SimulatedLink(simulation, until_s=300.0), seed, **_WEATHER)
    with TemporaryDirectory() as folder, Store(Path(folder) / "soak.sqlite") as store:
        session = Session.on(link, Settings(), world_magnetic_model, store)
        companion, begun_s, change = session.companion, math.nan, None
        for packet in link.packets():
            session.service.turn(packet)
            flown = companion.flown()
            if change is None and flown is not None and companion.settled and simulation.elapsed_ns > 10e9:
                iron, sigma = np.array((180.0, -120.0, 240.0)), np.array((2.0, 2.0, 5.0))
                change = plan_change(flown.calibrations, 1, 1, iron, sigma, (True, True, True))
                if change is not None:
                    begun_s = simulation.elapsed_ns / 1e9
                    companion.start(change, code_needed(change), packet.t_ns)
            if companion.ended is not None:
                break
    held = tuple(float(simulation.autopilot.parameters[n]) for n in _NAMES)
    if change is None:
        return "stored offsets not heard in 300 s", held == (0.0, 0.0, 0.0), math.nan
    if companion.ended is None or companion.ended.result is None:
        return "no end in 300 s", False, math.nan
    result = companion.ended.result.name
    if result == "REFUSED":
        result += " " + "+".join(r.name for r in companion.ended.reasons)
    true = {"ALL_NEW": held == change.new, "WRITTEN_UNPROVEN": held == change.new}.get(result, held == change.old)
    return result, true or result == "PENDING_RESTORE", simulation.elapsed_ns / 1e9 - begun_s


def honesty(answers: list[Answer]) -> Table:
    """One row per scenario and one for all."""
    table = Table(title="Simulated flights: hard iron against truth")
    heads = ("scenario", "answers", "READY", "first READY s", "err/sigma x", "y", "z", "at first READY x", "y", "z")
    for head in (*heads, "worst READY err mG x", "y", "z", "worst err/sigma"):
        table.add_column(head, justify="left" if head == "scenario" else "right")
    for name in (*SCENARIOS, "all"):
        mine = [a for a in answers if name in (a.scenario, "all")]
        ready = [a for a in mine if a.ready]
        if not mine:
            continue
        cells = [name, f"{len(mine)}", f"{100 * len(ready) / len(mine):.0f} %"]
        cells.append(f"{np.nanmedian([a.first_ready_s for a in mine]):.0f}" if ready else "-")
        cells += _ratios(np.array([a.error_mg for a in mine]), np.array([a.sigma_mg for a in mine]), mine)
        early = [a for a in mine if math.isfinite(a.first_ready_s)]
        cells += _ratios(np.array([a.first_error_mg for a in early]), np.array([a.first_sigma_mg for a in early]), [])
        errors = np.abs(np.array([a.error_mg for a in ready])).reshape(-1, 3)
        sigmas = np.array([a.sigma_mg for a in ready]).reshape(-1, 3)
        cells += [f"{errors[:, axis].max():.1f}" if len(errors) else "-" for axis in range(3)]
        cells.append(f"{(errors / sigmas).max():.1f}" if len(errors) else "-")
        table.add_row(*cells)
    return table


def _ratios(error: np.ndarray, sigma: np.ndarray, answers: list[Answer]) -> list[str]:
    """Pooled rms of error over sigma per axis, over observed axes where answers are given."""
    if not len(error):
        return ["-"] * 3
    seen = np.array([a.observed for a in answers]) if answers else np.ones(error.shape, dtype=bool)
    ratio = (error / sigma) ** 2
    return [f"{math.sqrt(ratio[seen[:, i], i].mean()):.2f}" if seen[:, i].any() else "-" for i in range(3)]


def uploads(ends: list[tuple[str, bool, float]]) -> Table:
    """How the writes ended."""
    weather = ", ".join(f"{100 * rate:.0f} % {what}" for what, rate in _WEATHER.items())
    table = Table(title=f"Uploads both ways in bad weather ({weather})")
    for head in ("result", "times", "vehicle holds what it says", "median s", "longest s"):
        table.add_column(head, justify="left" if head == "result" else "right")
    for result, times in Counter(r for r, _, _ in ends).most_common():
        mine = [(true, s) for r, true, s in ends if r == result]
        seconds = [s for _, s in mine]
        held = f"{sum(true for true, _ in mine)} of {times}"
        table.add_row(result, f"{times}", held, f"{np.median(seconds):.1f}", f"{max(seconds):.1f}")
    return table


def main(argv: list[str]) -> int:
    """Run it all within the bound, print both tables; 1 when an upload left something else than it said."""
    flights, writes = (int(v) for v in (*argv, *("30", "200")[len(argv) :]))
    begun, progress = time.monotonic(), Console(stderr=True)
    tasks = [(name, 1000 + seed) for seed in range(flights) for name in SCENARIOS]
    with ProcessPoolExecutor() as pool:
        answers: list[Answer] = []
        ends: list[tuple[str, bool, float]] = []
        for some in track(pool.map(fly, tasks), "flights", len(tasks), console=progress):
            answers += some
            if time.monotonic() - begun > _BOUND_S:
                progress.print(f"time is up after {len(answers)} answers of {len(tasks)} flights")
                pool.shutdown(cancel_futures=True)
                break
    with ProcessPoolExecutor() as pool:
        for end in track(pool.map(upload, range(writes)), "uploads", writes, console=progress):
            ends.append(end)
    out = Console(width=170)
    out.print(honesty(answers))
    out.print(uploads(ends))
    out.print(f"{time.monotonic() - begun:.0f} s")
    return 0 if all(true for _, true, _ in ends) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
