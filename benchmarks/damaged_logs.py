"""AT-14b: logs cut short and logs with wrong bits, in every format: a result or a clear refusal, never a traceback.

    python benchmarks/damaged_logs.py [CUTS]

CUTS random truncations (100) and ten times as many files with flipped bits, of each of .tlog, .bin, .log and .ulg,
through the readers alone; a fifth of CUTS of either through `magmav replay --json` and `magmav fit --json`, each in a
process of its own. Exit 1 where one of them broke its word: an error that is neither LogError nor LinkError, readings
out of order or not finite, a traceback, an exit code that is none of 0, 1 and 3, or no end in time.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import msgspec
import numpy as np
from magmav_sim import Simulation, load_scenario
from magmav_sim.recorder import Recorder, unattended

from magmav.core.types import MagReading
from magmav.link import LinkError
from magmav.logs import LogError
from magmav.recording import open_recording

KINDS = ("tlog", "bin", "log", "ulg")
COMMANDS = ("replay", "fit")
FINE_CODES = (0, 1, 3)
_LONG_S = 240
_BITS = (1, 1, 3, 30, 300)


def flown(folder: Path, seconds: float) -> dict[str, bytes]:
    """One simulated flight in every format."""
    scenario = unattended(load_scenario("figure8"))
    sim = Simulation(msgspec.structs.replace(scenario, compasses=scenario.compasses[:1]))
    with Recorder(sim, [folder / f"flight.{kind}" for kind in KINDS]):
        sim.advance(seconds)
    return {kind: (folder / f"flight.{kind}").read_bytes() for kind in KINDS}


def cut(data: bytes, rng: random.Random) -> bytes:
    """The front of it."""
    return data[: rng.randrange(len(data))]


def flipped(data: bytes, rng: random.Random) -> bytes:
    """With some wrong bits, one of them within the first kilobyte now and then: that is where a format is told."""
    out = bytearray(data)
    for _ in range(rng.choice(_BITS)):
        out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    if rng.random() < 0.3:
        out[rng.randrange(min(1024, len(out)))] ^= 1 << rng.randrange(8)
    return bytes(out)


@contextmanager
def in_time(seconds: int) -> Iterator[None]:
    """TimeoutError where it takes longer."""

    def late(*_: Any) -> None:
        raise TimeoutError(f"no end within {seconds} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def read(path: Path) -> str:
    """How reading it ended: "read", "refused", or what went wrong, in words that begin with "BROKEN"."""
    try:
        with in_time(_LONG_S):
            before_ns = -(1 << 62)
            for t_ns, reading in open_recording(path).readings():
                if t_ns < before_ns:
                    return "BROKEN: time turned back"
                before_ns = t_ns
                if isinstance(reading, MagReading) and not np.isfinite(reading.field_b_mg).all():
                    return "BROKEN: a field that is no number"
            return "read"
    except (LogError, LinkError) as error:
        return "refused" if path.name in str(error) else f"BROKEN: refused without its name: {error}"
    except Exception as error:  # what this bench is for
        return f"BROKEN: {type(error).__name__}: {error}"


def commanded(command: str, path: Path) -> str:
    """How a whole command ended, in a process of its own: "result", "refused", or "BROKEN" and why."""
    words = [sys.executable, "-m", "magmav.cli", command, str(path), "--json"]
    if command == "fit":
        words += ["--out", str(path.parent / "out")]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=_LONG_S)
    except subprocess.TimeoutExpired:
        return f"BROKEN: no end within {_LONG_S} s"
    return judged(done.returncode, done.stdout, done.stderr)


def judged(code: int, out: str, err: str) -> str:
    """What an exit code and what was printed amount to."""
    if "Traceback" in err or code not in FINE_CODES:
        return f"BROKEN: exit code {code}: {err.strip()[-300:]}"
    if code == 0:
        json.loads(out)
        return "result"
    return "refused" if err.strip() or out.strip() else f"BROKEN: exit code {code} and not a word"


def main() -> int:
    """Break, read and tell."""
    cuts = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    worst = 0
    with tempfile.TemporaryDirectory(prefix="magmav-damaged-") as place:
        folder = Path(place)
        for kind, whole in flown(folder, 75.0).items():
            rng, path = random.Random(kind), folder / f"harmed.{kind}"
            for name, harm, many in (("cut", cut, cuts), ("flipped", flipped, 10 * cuts)):
                ends: Counter[str] = Counter()
                for one in range(many):
                    path.write_bytes(harm(whole, rng))
                    ends[read(path)] += 1
                    if one < cuts // 5:
                        for command in COMMANDS:
                            ends[f"{command}: {commanded(command, path)}"] += 1
                sys.stdout.write(f".{kind} {name}: {dict(sorted(ends.items()))}\n")
                sys.stdout.flush()
                worst += sum(n for end, n in ends.items() if "BROKEN" in end)
    sys.stdout.write(f"broken: {worst}\n")
    return 1 if worst else 0


if __name__ == "__main__":
    sys.exit(main())
