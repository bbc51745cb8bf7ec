"""What is known of a flight afterwards, smoothed, against what the adaptive estimator knew at the time.

    after_flight.py [--seeds A:B] [--scenarios LIST]      flights whose truth is known: error of the iron along the path
    after_flight.py --recordings FILE ...                 heading RMS over the whole flight against the recording's yaw

Seeds 0 to 999 are for tuning, 1000 and up for judging. Tables go to standard output.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from estimator_bench.running import tape
from estimator_bench.scenarios import STEP_AT_S, Scenario, chosen
from estimator_bench.telemetry import BOOT_S, Flight, fly
from numpy.typing import NDArray
from real_bench.tapes import load

from magmav.core.after_flight import AfterFlight, after_flight
from magmav.core.estimators.adaptive import AdaptiveEstimator
from magmav.core.types import Estimate, Sample
from magmav.score import Calibration, Window, score_freeze

Array = NDArray[np.float64]
_EARLY_S, _BEGIN_S, _NEAR_S = 25.0, 5.0, 5.0
_LATE_S = 0.02  # of a reading, so that one at the step itself still shows the old iron


def live(samples: Sequence[Sample]) -> Iterator[tuple[int, Estimate]]:
    """What was believed once a second."""
    estimator, due_ns = AdaptiveEstimator(), 0
    for s in samples:
        estimator.step(s)
        if s.boot_ns >= due_ns:
            due_ns = s.boot_ns + 1_000_000_000
            e = estimator.estimate(None)
            if e is not None:
                yield s.boot_ns, e


def errors(flight: Flight, moments: Iterator[tuple[int, Estimate]]) -> Array:
    """(N, 7): seconds of flight, error of the iron and its sigma, mG."""
    rows = []
    for boot_ns, e in moments:
        t_s = boot_ns / 1e9 - BOOT_S
        if t_s >= flight.truth.takeoff_s + _BEGIN_S:
            error = e.hard_iron_b_mg - flight.iron_at(t_s - _LATE_S)
            rows.append((t_s, *error, *np.sqrt(np.diag(e.covariance_mg2))))
    return np.array(rows)


def spans(scenario: Scenario, takeoff_s: float) -> dict[str, tuple[float, float]]:
    """What is looked at apart."""
    begin = takeoff_s + _BEGIN_S
    out = {"whole": (begin, 1e9), "first 25 s": (begin, begin + _EARLY_S)}
    if scenario.compass.step_mg:
        out["5 s before step"] = (STEP_AT_S - _NEAR_S, STEP_AT_S)
        out["5 s after step"] = (STEP_AT_S + 1e-6, STEP_AT_S + _NEAR_S)
    return out


def flights(scenarios: Sequence[Scenario], seeds: range) -> None:
    """A line per scenario and span."""
    print("| scenario | span | live xy | z | error/sigma | smoothed xy | z | error/sigma |")
    print("|---|---|---|---|---|---|---|---|")
    for scenario in scenarios:
        at_the_time, afterwards, placed, takeoff_s = [], [], [], 0.0
        for seed in seeds:
            flight = fly(scenario, seed)
            samples = [h.sample for h in tape(flight)]
            got = after_flight(samples)
            assert got is not None
            takeoff_s = flight.truth.takeoff_s
            at_the_time.append(errors(flight, live(samples)))
            afterwards.append(errors(flight, zip(got.boot_ns.tolist(), got.estimates, strict=True)))
            placed.append([round(t / 1e9 - BOOT_S, 2) for t in got.changes_ns])
        for name, (begin, end) in spans(scenario, takeoff_s).items():
            cells = []
            for rows in (np.concatenate(at_the_time), np.concatenate(afterwards)):
                e = rows[(rows[:, 0] >= begin) & (rows[:, 0] < end)]
                xy, z = (float(np.sqrt(np.mean(e[:, c] ** 2))) for c in ((1, 2), (3,)))
                cells.append(f"{xy:.2f} | {z:.2f} | {np.sqrt(np.mean((e[:, 1:4] / e[:, 4:]) ** 2)):.2f}")
            print(f"| {scenario.name} | {name} | {cells[0]} | {cells[1]} |", flush=True)
        if any(placed):
            print(f"\nchanges of {scenario.name} placed at, s: {placed}\n", flush=True)


def recording(path: Path) -> None:
    """A line per compass: heading RMS, degrees, over the whole flight, with the iron of each moment."""
    for tape_ in load(path):
        for compass, log in tape_.logs.items():
            heard = list(tape_.heard(compass))
            samples = [h.sample for h in heard if h.stretch == heard[-1].stretch]
            got = after_flight(samples)
            if got is None or tape_.reference is None:
                continue
            known = list(live(samples))
            then = AfterFlight(np.array([t for t, _ in known], dtype=np.int64), tuple(e for _, e in known), ())
            declination = np.array(log.declination_rad)
            unknown = ~np.isfinite(declination)
            if unknown.all():
                declination, unknown = np.zeros(len(declination)), np.zeros(len(declination), dtype=bool)
            measured_ns = np.round(1e9 * (np.array(log.boot_s) - np.array(log.age_s))).astype(np.int64)
            matrix = tape_.boot.calibrations.shaping(compass).matrix
            crash_ns = tape_.boot.phase.crash_ns
            scored = score_freeze(
                measured_ns / 1e9,
                np.array(log.sensor_b_mg).reshape(-1, 3),
                {
                    name: Calibration(one.iron_b_mg(measured_ns), got.answer.soft_iron_b @ matrix, log.down_mg)
                    for name, one in (("live", then), ("smoothed", got))
                },
                np.where(unknown, 0.0, declination),
                tape_.reference,
                Window(crash_s=np.inf if crash_ns is None else crash_ns / 1e9),
                {"declination not known": unknown},
            )
            changes = [round(t / 1e9, 1) for t in got.changes_ns]
            row = [f"{scored[name].rms_deg:.2f}" for name in ("uncalibrated", "live", "smoothed")]
            print(f"| {path.name} | {compass} | {' | '.join(row)} | {scored['live'].n} | {changes} |", flush=True)


def main(argv: Sequence[str] | None = None) -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="0:6", metavar="A:B")
    parser.add_argument("--scenarios", default="figure8,survey,drift,step,takeoff", metavar="LIST")
    parser.add_argument("--recordings", nargs="+", type=Path, metavar="FILE")
    o = parser.parse_args(argv)
    if o.recordings:
        print("| recording | compass | uncalibrated | live | smoothed | samples | changes, s |")
        print("|---|---|---|---|---|---|---|")
        for path in o.recordings:
            recording(path)
        return 0
    low, high = (int(x) for x in o.seeds.split(":"))
    flights(chosen(o.scenarios), range(low, high))
    return 0


if __name__ == "__main__":
    sys.exit(main())
