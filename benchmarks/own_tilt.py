"""How wrong the tilt of gyro and accelerometer is where no ATTITUDE comes, and how wrong it claims to be.

    python benchmarks/own_tilt.py          simulated flights against their truth, hand-held ones against optics

Degrees RMS about a level axis, for each of core.motion's OWN_TILTS that follow the accelerometer. The hand-held
recordings (BROAD) are looked for in MAGMAV_DATA (default ../shared/data) and left out where they are not.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import numpy as np
from estimator_bench.scenarios import SCENARIOS
from estimator_bench.telemetry import BOOT_S, fly
from numpy.typing import NDArray
from real_bench.magnets import MAGNETS, UNDISTURBED
from real_bench.optical import read
from real_bench.tapes import DATA

from magmav.core.motion import Motion
from magmav.core.types import InertialReading, Reading
from magmav.recording import open_recording

Floats = NDArray[np.float64]
FLIGHTS, SEEDS = ("imu_gps", "imu_only", "figure8", "loiter_fw"), (0, 1)


def simulated(name: str, seed: int) -> Iterator[tuple[InertialReading, Floats]]:
    """Readings and true down in body axes, (3,)."""
    flight = fly(SCENARIOS[name], seed)
    for _, reading in flight.readings:
        if isinstance(reading, InertialReading):
            i = round((reading.boot_ns / 1e9 - BOOT_S) * 200)
            yield reading, flight.truth.C_bn[min(i, len(flight.truth.C_bn) - 1)][:, 2]


def optical(name: str) -> Iterator[tuple[Reading, Floats | None]]:
    """The same of a recording; None where the optics saw nothing."""
    path = DATA / "flights" / f"{name}_imu.tlog"
    moved = read(path, DATA / "flights" / f"{name}_truth.csv")
    at = {round(t * 1e9): i for i, t in enumerate(moved.boot_s) if moved.valid[i]}
    recording = open_recording(path)
    for _, reading in recording.readings():
        if isinstance(reading, InertialReading):
            i = at.get(reading.boot_ns)
            yield reading, None if i is None else moved.body_from_room[i][:, 2]
    recording.close()


def judged(own: str, told: Iterable[tuple[Reading, Floats | None]]) -> tuple[float, float]:
    """RMS error and RMS claim, degrees."""
    motion, errors, claims = Motion(own), [], []
    for reading, down_b in told:
        assert isinstance(reading, InertialReading)
        motion.inertial(reading)
        state = motion.at(reading.boot_ns)
        if state is not None and down_b is not None:
            errors.append(np.cross(state.body_from_own[:, 2], down_b))
            claims.append(state.own_tilt_rad)
    per_axis = math.sqrt(float(np.mean(np.sum(np.square(errors), axis=1))) / 2.0)
    return math.degrees(per_axis), math.degrees(math.sqrt(float(np.mean(np.square(claims)))))


def main() -> None:
    """Print the table."""
    print("| flight | own tilt | error | claimed |\n|---|---|---:|---:|")
    for own in ("marg_gn", "complementary"):
        for name in FLIGHTS:
            for seed in SEEDS:
                error, claim = judged(own, simulated(name, seed))
                print(f"| {name}, seed {seed} | {own} | {error:.1f} | {claim:.1f} |")
        for name in (UNDISTURBED, *MAGNETS):
            if (DATA / "flights" / f"{name}_imu.tlog").is_file():
                error, claim = judged(own, optical(name))
                print(f"| {name} | {own} | {error:.1f} | {claim:.1f} |")


if __name__ == "__main__":
    main()
