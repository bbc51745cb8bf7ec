"""How good the estimators are, how honest, and how far from what theory allows, on flights whose truth is known.

    make estimators        or        estimators.py [--seeds A:B] [--scenarios LIST] [--estimators LIST] ...

Every estimator of the project gets the same Samples, made by magmav's own pipeline from what an autopilot would send,
with all its errors; estimator_bench says which. Beside them stand methods of other people (--peers; some in virtual
environments of their own, made on demand under a cache directory) and the posterior Cramer-Rao bound of each flight.
Tables go to standard output or --markdown, every single run to --json.

Seeds 0 to 999 are for tuning, 1000 and up for judging. Same arguments, same figures (but the microseconds).
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from estimator_bench.bound import Bound, bound
from estimator_bench.peer_runs import NAMES, OWN, Ready, filter_headings, peer_scores, ready
from estimator_bench.pins import Pin, pin_table, pins
from estimator_bench.running import run, tape
from estimator_bench.scenarios import SCENARIOS, chosen
from estimator_bench.score import NOTHING_DEG, Scored, nearest, score
from estimator_bench.tables import Results
from estimator_bench.telemetry import fly
from rich.console import Console

from magmav.core.estimators import ESTIMATORS

JUDGING = 1000


@dataclass(frozen=True, slots=True)
class Task:
    """One flight to be judged."""

    scenario: str
    seed: int
    estimators: tuple[str, ...]
    bound: bool
    peers: Ready
    bias_mg: float | None = None  # sigma per axis instead of the scenario's own


@dataclass(frozen=True, slots=True)
class Judged:
    """What became of it. headings: attitude filter -> which calibration it was given -> RMS error, degrees."""

    task: Task
    scored: list[Scored]
    bound: Bound | None
    headings: dict[str, dict[str, float]]


def judged(task: Task) -> Judged:
    """Fly, and run every method over it."""
    scenario = SCENARIOS[task.scenario]
    if task.bias_mg is not None:
        scenario = replace(scenario, compass=replace(scenario.compass, bias_mg=task.bias_mg, bias_length_mg=None))
    flight = fly(scenario, task.seed)
    heard = tape(flight)
    runs = [run(name, heard) for name in task.estimators]
    scored = [score(flight, heard, one) for one in runs]
    scored += peer_scores(flight, heard, task.peers)
    irons = {"none": np.zeros(3)}
    for one in runs[:1]:
        tick = nearest(one.ticks, 60.0)
        irons[f"{one.name} @60"] = -np.array(tick.offsets_mg)
    irons["the truth"] = flight.iron_at(120.0)
    headings = filter_headings(flight, irons, task.peers)
    return Judged(task, scored, bound(flight) if task.bound else None, headings)


def seeds(text: str) -> range:
    """A:B, B left out; or how many of the judging seeds. ValueError otherwise."""
    first, colon, last = text.partition(":")
    out = range(int(first), int(last)) if colon else range(JUDGING, JUDGING + int(first))
    if not out or out.start < 0:
        raise ValueError(f"seeds: want A:B with A < B, or how many, got {text!r}")
    return out


def names(text: str) -> tuple[str, ...]:
    """Estimators by name. ValueError naming one that does not exist."""
    out = tuple(ESTIMATORS) if text == "all" else tuple(n for n in text.split(",") if n)
    for name in out:
        if name not in ESTIMATORS:
            raise ValueError(f"no estimator called {name!r}; there are {', '.join(ESTIMATORS)}")
    return out


def peer_names(text: str) -> tuple[str, ...]:
    """Peers by name; own: those that need no environment. ValueError naming one that does not exist."""
    groups = {"all": NAMES, "own": OWN, "none": ()}
    out = [n for part in text.split(",") for n in groups.get(part, (part,))]
    for name in out:
        if name not in NAMES:
            raise ValueError(f"no peer called {name!r}; choose all, own, none or some of {', '.join(NAMES)}")
    return tuple(dict.fromkeys(out))


def milligauss(text: str) -> float:
    """A size. ValueError otherwise."""
    value = float(text)
    if not 0.0 <= value <= 2000.0:
        raise ValueError(f"bias: want 0 to 2000 mG, got {text}")
    return value


def measured(tasks: Sequence[Task], jobs: int, console: Console) -> list[Judged]:
    """All tasks, in the order given, whoever finishes first."""
    done: dict[tuple[str, int], Judged] = {}

    def keep(one: Judged) -> None:
        done[one.task.scenario, one.task.seed] = one
        console.print(f"{len(done)} of {len(tasks)}: {one.task.scenario}, seed {one.task.seed}")

    if jobs == 1:
        for task in tasks:
            keep(judged(task))
    else:
        with ProcessPoolExecutor(jobs) as pool:
            for future in as_completed([pool.submit(judged, task) for task in tasks]):
                keep(future.result())
    return [done[task.scenario, task.seed] for task in tasks]


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    p = argparse.ArgumentParser(prog="estimators.py", description=(__doc__ or "").partition("\n")[0])
    p.add_argument("--seeds", type=seeds, default=seeds("6"), help="A:B, or how many of the judging seeds (default 6)")
    p.add_argument("--scenarios", type=chosen, default=chosen("all"), help="names, or all, reference, new")
    p.add_argument("--estimators", type=names, default=names("all"), help="names, or all")
    p.add_argument("--peers", type=peer_names, default=peer_names("all"), help="names, or all, own, none")
    p.add_argument("--bias", type=milligauss, metavar="MG", help="hard iron of this sigma per axis in all scenarios")
    p.add_argument("--no-bound", action="store_true", help="leave the Cramer-Rao bound out (2 s a flight)")
    p.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes (default: one a core)")
    p.add_argument("--markdown", type=Path, help="write the tables here instead of to standard output")
    p.add_argument("--json", type=Path, help="write every single run here")
    return p.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print."""
    a = _arguments(argv)
    console = Console(stderr=True, highlight=False)
    able = ready(a.peers, partial(console.print, soft_wrap=True))
    tasks = [Task(s.name, seed, a.estimators, not a.no_bound, able, a.bias) for s in a.scenarios for seed in a.seeds]
    got = measured(tasks, max(a.jobs, 1), console)
    bounds = {(j.task.scenario, j.task.seed): j.bound for j in got if j.bound is not None}
    headings = {(j.task.scenario, j.task.seed): j.headings for j in got if j.headings}
    results = Results([s for j in got for s in j.scored], bounds, headings)
    facts: dict[str, Any] = {"seeds": [a.seeds.start, a.seeds.stop], "judging": a.seeds.start >= JUDGING}
    facts["bias_mg"] = a.bias
    facts["pins"] = [asdict(pin) for pin in pins(able.pythons.get("magyc"))] if set(able.names) & set(OWN) else []
    facts["missing"] = list(able.missing)
    kind = "judging" if facts["judging"] else "TUNING"
    notes = [
        f"{len(a.seeds)} {kind} seeds ({a.seeds.start} to {a.seeds.stop - 1}), {len(a.scenarios)} scenarios, 180 s."
    ]
    notes += [f"Hard iron of {a.bias:g} mG per axis (sigma) in all scenarios."] if a.bias is not None else []
    notes += [f"{NOTHING_DEG:.2f} degrees, the RMS of any heading at all, stands where a method gave no answer."]
    notes += [f"Left out: {why}." for why in able.missing]
    text = results.markdown(notes, lambda name: name in ESTIMATORS)
    if facts["pins"]:
        text += "\n" + pin_table([Pin(**pin) for pin in facts["pins"]])
    if a.markdown is None:
        print(text)
    else:
        a.markdown.write_text(text, encoding="utf-8")
    if a.json is not None:
        a.json.write_text(json.dumps(results.document(facts), indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
