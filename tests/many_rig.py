"""A folder of small .tlog files, made by hand: several flights of two vehicles, and files that are no good."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from memory_flight import STORED, flight

DAY_S = 86_400
FIRST_S = 1_795_341_600  # 2026-11-22T10:00:00Z
IRON = np.array([310.0, -140.0, 220.0])


def tlog(frames: list[tuple[int, bytes]], began_s: float) -> bytes:
    """As a ground station writes it: before every packet its UNIX time in microseconds, eight bytes, big-endian."""
    first = frames[0][0]
    out = []
    for ms, data in frames:
        stamp = (int(began_s * 1e6) + (ms - first) * 1000).to_bytes(8, "big")
        while data:
            size = data[1] + (12 if data[0] == 0xFD else 8)
            out.append(stamp + data[:size])
            data = data[size:]
    return b"".join(out)


def flown(day: int, *, system: int = 1, seed: int = 0, iron_mg: np.ndarray = IRON, device: float = 97539.0) -> bytes:
    """One flight of 18 s."""
    told = STORED | {"COMPASS_DEV_ID": device}
    frames = flight(system, 18.0, seed=seed, iron_mg=iron_mg, told=told)
    return tlog(frames, FIRST_S + day * DAY_S)


def folder_of_logs(folder: Path) -> Path:
    """Three flights of vehicle 1, whose y iron changes by -60 mG after the second; one of vehicle 2; and damage."""
    deep = folder / "2026" / "deep"
    deep.mkdir(parents=True)
    (folder / "b.tlog").write_bytes(flown(0, seed=1))
    (deep / "a.TLOG").write_bytes(flown(1, seed=2))
    (folder / "e.tlog").write_bytes(flown(1, system=2, seed=5, device=131874.0))
    (deep / "copy of b.tlog").write_bytes((folder / "b.tlog").read_bytes())
    whole = flown(2, seed=6, iron_mg=IRON - np.array([0.0, 60.0, 0.0]))
    (folder / "torn.tlog").write_bytes(whole[: len(whole) * 4 // 5 + 3])
    (folder / "noise.bin").write_bytes(np.random.default_rng(7).bytes(3000))
    (folder / "empty.ulg").write_bytes(b"")
    (folder / "notes.log").write_text("the weather was good\n")
    (folder / "readme.txt").write_text("no log\n")
    return folder


GOOD, BAD = ("2026/deep/a.TLOG", "b.tlog", "e.tlog", "torn.tlog"), ("empty.ulg", "noise.bin", "notes.log")
