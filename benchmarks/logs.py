"""How fast logs are read and fitted, against pymavlink's readers and MAVProxy's magfit on the same files.

    python benchmarks/logs.py [FILE.bin] [--tlog FILE.tlog] [--damage N]     readers
    python benchmarks/logs.py --hour [MINUTES]     whole `magmav fit` of a written hour, one compass and three,
                                                   and of a .bin of it (AT-14d: 60 s)
    python benchmarks/logs.py --magfit             all compasses of FILE.bin in one run, against one magfit each

Both sides give every column of the same messages as numbers; ours in this process, theirs (GPL) in a process of its
own that times itself, best of three each, its start not counted. Seconds are processor time everywhere, so that what
else runs counts little; the ratios stand on any machine. --damage reads N copies of the .bin with flipped bits and
N / 10 cut short, and tells how that ended. Files that are not given: log171.bin and copter-fig8.tlog of the real
recordings (MAGMAV_DATA or ../shared/data).
"""

from __future__ import annotations

import argparse
import os
import random
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from rich.console import Console

from magmav.logs import LogError
from magmav.logs.columns import STRINGS
from magmav.logs.dataflash import read_binary
from magmav.logs.dataflash_readings import DataflashRecording
from magmav.logs.tlog import read_tlog
from magmav.mavlink.decode import Decoder
from magmav.recording import open_recording

_DATA = Path(os.environ.get("MAGMAV_DATA", Path(__file__).parents[2] / "shared" / "data"))
_NEEDED = ("MAG", "MAG2", "MAG3", "IMU", "ATT", "GPS", "POS", "CURR", "BAT", "CTUN", "PARM", "EV", "ARM", "MSG", "STAT")
_ROUNDS = 3
Reader = Callable[[Path], tuple[float, int]]
_THEIRS = """
import sys, time
from pymavlink import DFReader
began = time.process_time()
log = DFReader.DFReader_binary(sys.argv[1])
names, values = sys.argv[2].split(","), 0
while (m := log.recv_match(type=names)) is not None:
    values += len([getattr(m, label) for label in m.get_fieldnames()])
print(time.process_time() - began, values)
"""
_THEIR_TLOG = """
import os, sys, time
os.environ["MAVLINK20"], os.environ["MAVLINK_DIALECT"] = "1", "ardupilotmega"
from pymavlink import mavutil
began = time.process_time()
log = mavutil.mavlink_connection(sys.argv[1])
names, values = sys.argv[2].split(","), 0
while (m := log.recv_match(type=names)) is not None:
    values += len([getattr(m, label) for label in m.get_fieldnames()])
print(time.process_time() - began, values)
"""


def ours_of_tlog(path: Path) -> tuple[float, int]:
    """Seconds, and how many values, a list of numbers being one."""
    began = time.process_time()
    values = 0
    for table in read_tlog(path, Decoder().wanted).by_name.values():
        for label in table.fields.dtype.names or ():
            values += len(np.array(table.fields[label]))
    return time.process_time() - began, values


def theirs_of_tlog(path: Path) -> tuple[float, int]:
    """The same for pymavlink's reader."""
    return timed(_THEIR_TLOG, path, tuple(sorted(Decoder().wanted)))


def timed(program: str, path: Path, names: tuple[str, ...]) -> tuple[float, int]:
    """What a program of theirs says of itself: seconds and values."""
    command = [sys.executable, "-c", program, str(path), ",".join(names)]
    seconds, values = subprocess.run(command, capture_output=True, check=True, text=True).stdout.split()[-2:]
    return float(seconds), int(values)


def ours(path: Path) -> tuple[float, int]:
    """Seconds, and how many values."""
    began = time.process_time()
    tables = read_binary(np.fromfile(path, dtype=np.uint8), str(path))
    values = 0
    for table in (t for name in _NEEDED for t in tables.of(name)):
        for label, letter in table.letters.items():
            values += len(table.texts(label) if letter in STRINGS else table.values(label))
    return time.process_time() - began, values


def theirs(path: Path) -> tuple[float, int]:
    """The same for pymavlink's reader."""
    return timed(_THEIRS, path, _NEEDED)


def as_readings(path: Path) -> tuple[float, int]:
    """Seconds from the closed file to the last reading, and how many."""
    began = time.process_time()
    count = sum(1 for _ in open_recording(path).readings())
    return time.process_time() - began, count


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
            began = time.process_time()
            try:
                times = [t for t, _ in DataflashRecording(hurt).readings()]
                ends["readings in order" if times == sorted(times) else "TIME TURNED BACK"] += 1
            except LogError:
                ends["LogError"] += 1
            slowest = max(slowest, time.process_time() - began)
    console.print(f"damage: {dict(ends)}, slowest {slowest:.2f} s")


def readers(path: Path, sides: tuple[Reader, Reader], what: str, console: Console) -> None:
    """One format."""
    (our_s, our_n), (their_s, their_n) = (min(side(path) for _ in range(_ROUNDS)) for side in sides)
    reading_s, count = min(as_readings(path) for _ in range(_ROUNDS))
    console.print(f"{path.name}, {path.stat().st_size / 1e6:.1f} MB, {what}")
    console.print(f"columns    {our_s * 1e3:8.1f} ms  {our_n} values")
    console.print(f"pymavlink  {their_s * 1e3:8.1f} ms  {their_n} values")
    console.print(f"ratio      {their_s / our_s:8.1f}")
    console.print(f"readings   {reading_s * 1e3:8.1f} ms  {count} readings, {count / reading_s:.0f} a second\n")


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("file", nargs="?", type=Path, default=_DATA / "logs" / "log171.bin")
    parser.add_argument("--tlog", type=Path, default=_DATA / "sitl" / "copter-fig8.tlog")
    parser.add_argument("--damage", type=int, default=0, metavar="N")
    parser.add_argument("--hour", type=float, nargs="?", const=60.0, metavar="MINUTES")
    parser.add_argument("--magfit", action="store_true")
    asked = parser.parse_args()
    console = Console()
    if asked.hour is not None:
        from logs_fit import hour

        hour(asked.hour, console)
        return
    for path in (asked.file,) if asked.magfit else (asked.file, asked.tlog):
        if not path.is_file():
            console.print(f"{path}: no such file; give a log, or set MAGMAV_DATA")
            raise SystemExit(3)
    if asked.magfit:
        from logs_fit import magfit

        raise SystemExit(magfit(asked.file, console))
    readers(asked.file, (ours, theirs), f"messages {', '.join(_NEEDED)}", console)
    readers(asked.tlog, (ours_of_tlog, theirs_of_tlog), f"messages {', '.join(sorted(Decoder().wanted))}", console)
    if asked.damage:
        damage(asked.file, asked.damage, console)


if __name__ == "__main__":
    main()
