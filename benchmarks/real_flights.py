"""The estimators on real recordings: held-out heading, READY, and real magnets, against the project's targets.

    python benchmarks/real_flights.py                                      everything, adaptive and kalman
    python benchmarks/real_flights.py --only flights,ready --files thor75  a part of it
    python benchmarks/real_flights.py --estimators adaptive --only magnets --markdown real.md --json real.json

Recordings are looked for in MAGMAV_DATA (default ../shared/data): every .tlog, .bin and .ulg in it that flew and has
an attitude to be judged by, and the BROAD recordings with their optical truth. Exit 3 where there is none. What misses
its target is listed at the end and printed bold; that does not change the exit code.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import real_bench  # noqa: F401 (before numpy: it sets how many threads that takes)
from real_bench import tables
from real_bench.held_out import LEARN_FOR_S, LEAST_REST_S, HeldOut, Judge, held_out
from real_bench.magnets import MAGNETS, UNDISTURBED, WAYS, MagnetRow, trials
from real_bench.magnets import judge as judge_magnet
from real_bench.ready import Ready, ready
from real_bench.running import run
from real_bench.tapes import DATA, load, recordings

from magmav.core.estimators import ESTIMATORS

PARTS = ("flights", "ready", "magnets")


def say(text: str) -> None:
    """Progress, with the processor time so far."""
    print(f"{time.process_time():7.1f} s  {text}", file=sys.stderr, flush=True)


def flights(names: list[str], files: list[str], parts: list[str]) -> tuple[list[HeldOut], list[Ready]]:
    """Every flown recording: rows of the held-out scores and of READY."""
    kept: list[HeldOut] = []
    judged: list[Ready] = []
    for path in recordings():
        if path.stem.startswith("broad") or not _asked(path.stem, files):
            continue
        for tape in load(path):
            if tape.reference is None or not tape.flew:
                say(f"{path.name}: {'no reference' if tape.flew else 'nothing flew'}, left out")
                continue
            judges = {c: Judge(tape, c) for c in tape.logs}
            times = {c: _times(j) for c, j in judges.items()}
            for name in names:
                moments = run(tape, name)
                say(f"{path.name}: {name}")
                for compass, judge in judges.items():
                    if "flights" in parts:
                        kept += [held_out(judge, name, moments[compass], s) for s in times[compass]]
                    if "ready" in parts:
                        judged.append(ready(judge, name, moments[compass]))
    return sorted(kept, key=lambda r: (r.file, r.compass)), sorted(judged, key=lambda r: (r.file, r.compass))


def _times(judge: Judge) -> list[float]:
    """Those of LEARN_FOR_S that leave something to judge by, each something else."""
    out: list[float] = []
    rest = 0.0
    for s in LEARN_FOR_S:
        left = judge.rest_s(s)
        if left >= LEAST_REST_S and left != rest:
            out.append(s)
        rest = left
    return out


def magnets(names: list[str], files: list[str]) -> list[MagnetRow]:
    """Every recording with an optical truth, with its own tilt and with the optical one."""
    asked = tuple(n for n in (UNDISTURBED, *MAGNETS) if _asked(n, files))
    rows = []
    for trial in trials(names=asked):
        for way in WAYS:
            for name in names:
                rows.append(judge_magnet(trial, way, name, name))
                say(f"{trial.name}: {way}, {name}")
    return rows


def _asked(stem: str, files: list[str]) -> bool:
    return not files or any(f in stem for f in files)


def missed(kept: list[HeldOut], judged: list[Ready], rows: list[MagnetRow]) -> list[str]:
    """Targets that were not met, a line each."""
    out = [
        f"{r.estimator}: {r.file} compass {r.compass}, S = {r.learn_for_s:.0f}: {tables.num(r.full_deg)} degrees, "
        f"want {tables.held_out_target(r.file, r.compass, r.learn_for_s)}"
        for r in kept
        if tables.held_out_late(r)
    ]
    for j in judged:
        out += [f"{j.estimator}: {j.file} compass {j.compass}: {why}" for why in tables.ready_missed(j)]
    for m in rows:
        out += [f"{m.estimator}: {m.file}, {m.way}: {why}" for why in tables.magnet_missed(m)]
    return out


def main() -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--estimators", default="adaptive,kalman", metavar="A,B")
    parser.add_argument("--only", default=",".join(PARTS), metavar="PART,PART", help=", ".join(PARTS))
    parser.add_argument("--files", default="", metavar="A,B", help="only recordings with one of these in their name")
    parser.add_argument("--markdown", type=Path)
    parser.add_argument("--json", type=Path)
    o = parser.parse_args()
    names, parts = o.estimators.split(","), o.only.split(",")
    files = [f for f in o.files.split(",") if f]
    for given, known in ((names, ESTIMATORS), (parts, PARTS)):
        for word in given:
            if word not in known:
                parser.error(f"no {word!r}; choose {', '.join(known)}")
    if not recordings():
        print(f"{DATA}: no recordings; set MAGMAV_DATA", file=sys.stderr)
        return 3
    kept, judged = flights(names, files, parts) if {"flights", "ready"} & set(parts) else ([], [])
    rows = magnets(names, files) if "magnets" in parts else []
    late = missed(kept, judged, rows)
    text = []
    if kept:
        text.append("Held-out heading RMS in degrees, full model / offsets only (sigma claimed); r: the best offset\n")
        text.append(tables.held_out_table(kept) + "\n")
    if judged:
        text.append(tables.ready_table(judged) + "\n")
    if rows:
        text.append(tables.magnet_table(rows) + "\n")
    text.append("Targets missed:\n\n" + ("\n".join(f"- {line}" for line in late) or "- none"))
    page = "\n".join(text)
    print(page)
    if o.markdown is not None:
        o.markdown.write_text(page + "\n", encoding="utf-8")
    if o.json is not None:
        document: dict[str, Any] = {
            "flights": [asdict(r) for r in kept],
            "ready": [asdict(r) for r in judged],
            "magnets": [asdict(r) for r in rows],
            "missed": late,
        }
        o.json.write_text(json.dumps(document) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
