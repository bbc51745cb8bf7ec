"""How fast a DataFlash log is read: the messages a replay needs, against pymavlink's reader on the same file.

    python benchmarks/logs.py [FILE.bin] [--damage N]

Both give every column of the same messages as numbers; ours in this process, theirs (GPL) in a process of its own that
times itself, best of three each, its start not counted. --damage reads N copies with flipped bits and N / 10 cut short,
and tells how that ended. Without a file: logs/log171.bin of the real recordings (MAGMAV_DATA or ../shared/data).
"""

from __future__ import annotations

import argparse
import os
import random
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from rich.console import Console

from magmav.logs import LogError
from magmav.logs.columns import STRINGS
from magmav.logs.dataflash import read_binary
from magmav.logs.dataflash_readings import DataflashRecording

_DATA = Path(os.environ.get("MAGMAV_DATA", Path(__file__).parents[2] / "shared" / "data"))
_NEEDED = ("MAG", "MAG2", "MAG3", "IMU", "ATT", "GPS", "POS", "CURR", "BAT", "CTUN", "PARM", "EV", "ARM", "MSG", "STAT")
_ROUNDS = 3
_THEIRS = """
import sys, time
from pymavlink import DFReader
began = time.perf_counter()
log = DFReader.DFReader_binary(sys.argv[1])
names, values = sys.argv[2].split(","), 0
while (m := log.recv_match(type=names)) is not None:
    values += len([getattr(m, label) for label in m.get_fieldnames()])
print(time.perf_counter() - began, values)
"""


def ours(path: Path) -> tuple[float, int]:
    """Seconds, and how many values."""
    began = time.perf_counter()
    tables = read_binary(np.fromfile(path, dtype=np.uint8), str(path))
    values = 0
    for table in (t for name in _NEEDED for t in tables.of(name)):
        for label, letter in table.letters.items():
            values += len(table.texts(label) if letter in STRINGS else table.values(label))
    return time.perf_counter() - began, values


def theirs(path: Path) -> tuple[float, int]:
    """The same for pymavlink's reader."""
    command = [sys.executable, "-c", _THEIRS, str(path), ",".join(_NEEDED)]
    seconds, values = subprocess.run(command, capture_output=True, check=True, text=True).stdout.split()
    return float(seconds), int(values)


def as_readings(path: Path) -> tuple[float, int]:
    """Seconds from the closed file to the last reading, and how many."""
    began = time.perf_counter()
    count = sum(1 for _ in DataflashRecording(path).readings())
    return time.perf_counter() - began, count


def damage(path: Path, many: int, console: Console) -> None:
    """Flipped bits and cuts: how many ended in readings, in LogError, and how long the slowest took."""
    rng, whole = random.Random(171), path.read_bytes()
    ends: Counter[str] = Counter()
    slowest = 0.0
    with TemporaryDirectory() as folder:
        hurt = Path(folder) / "hurt.bin"
        for i in range(many + many // 10):
            copy = bytearray(whole)
            if i < many:
                for _ in range(rng.choice((1, 10, 1000))):
                    copy[rng.randrange(len(copy))] ^= 1 << rng.randrange(8)
            else:
                del copy[rng.randrange(len(copy)) :]
            hurt.write_bytes(copy)
            began = time.perf_counter()
            try:
                times = [t for t, _ in DataflashRecording(hurt).readings()]
                ends["readings in order" if times == sorted(times) else "TIME TURNED BACK"] += 1
            except LogError:
                ends["LogError"] += 1
            slowest = max(slowest, time.perf_counter() - began)
    console.print(f"damage: {dict(ends)}, slowest {slowest:.2f} s")


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("file", nargs="?", type=Path, default=_DATA / "logs" / "log171.bin")
    parser.add_argument("--damage", type=int, default=0, metavar="N")
    asked = parser.parse_args()
    console = Console()
    if not asked.file.is_file():
        console.print(f"{asked.file}: no such file; give a .bin log, or set MAGMAV_DATA")
        raise SystemExit(3)
    (our_s, our_n), (their_s, their_n) = (min(f(asked.file) for _ in range(_ROUNDS)) for f in (ours, theirs))
    reading_s, readings = min(as_readings(asked.file) for _ in range(_ROUNDS))
    console.print(f"{asked.file.name}, {asked.file.stat().st_size / 1e6:.1f} MB, messages {', '.join(_NEEDED)}")
    console.print(f"columns    {our_s * 1e3:8.1f} ms  {our_n} values")
    console.print(f"pymavlink  {their_s * 1e3:8.1f} ms  {their_n} values")
    console.print(f"ratio      {their_s / our_s:8.1f}")
    console.print(f"readings   {reading_s * 1e3:8.1f} ms  {readings} readings, {readings / reading_s:.0f} a second")
    if asked.damage:
        damage(asked.file, asked.damage, console)


if __name__ == "__main__":
    main()
