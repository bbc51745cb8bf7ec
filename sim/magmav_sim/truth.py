"""What was true, written beside a flight: ``truth.csv`` along the way, ``truth.json`` at the end."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import TracebackType

from magmav_sim.vehicle import Simulation, Truth

_EVERY_NS = 50_000_000
_COLUMNS = (
    "boot_time_s",
    "roll_deg",
    "pitch_deg",
    "heading_true_deg",
    "height_m",
    "current_a",
    "armed",
    "elapsed_s",
)


class TruthLog:
    """Writes into a directory (made when missing): truth.csv at 20 Hz of simulated time, truth.json on
    closing.

    Columns: boot_time_s, roll_deg, pitch_deg, heading_true_deg, height_m, current_a, armed, elapsed_s,
    then x, y, z of each compass's hard iron in mG, body axes. boot_time_s starts again at a reboot,
    elapsed_s does not. Raises OSError where the directory cannot be written.
    """

    def __init__(self, directory: Path, simulation: Simulation) -> None:
        directory.mkdir(parents=True, exist_ok=True)
        self._simulation = simulation
        self._json = directory / "truth.json"
        self._next_ns = 0
        self._first = simulation.truth
        self._csv = open(directory / "truth.csv", "w", encoding="utf-8", newline="\n")  # noqa: SIM115
        iron = [f"iron{n}_{axis}_mg" for n in range(1, len(self._first.hard_iron_b_mg) + 1) for axis in "xyz"]
        self._csv.write(",".join([*_COLUMNS, *iron]) + "\n")

    def sample(self) -> None:
        """Write a row when the next is due."""
        if self._simulation.elapsed_ns < self._next_ns:
            return
        self._next_ns += _EVERY_NS
        t = self._simulation.truth
        angles = (math.degrees(a) for a in (t.roll_rad, t.pitch_rad, t.heading_rad))
        row = [f"{t.boot_s:.3f}", *(f"{a:.4f}" for a in angles), f"{t.height_m:.3f}", f"{t.ampere:.2f}"]
        row += [str(int(t.armed)), f"{t.elapsed_s:.3f}"]
        row += [f"{v:.2f}" for iron in t.hard_iron_b_mg for v in iron]
        self._csv.write(",".join(row) + "\n")

    def close(self) -> None:
        """Write truth.json and close. Safe to call twice."""
        if self._csv.closed:
            return
        self._csv.close()
        self._json.write_text(json.dumps(summary(self._simulation, self._first), indent=1) + "\n", encoding="utf-8")

    def __enter__(self) -> TruthLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def summary(sim: Simulation, first: Truth) -> dict[str, object]:
    """What was flown and what was true: truth.json. ``first`` is the truth at the start."""
    scenario = sim.scenario
    now = sim.truth
    return {
        "scenario": scenario.name,
        "seed": sim.seed,
        "date": scenario.date.isoformat(),
        "place": {k: getattr(scenario.place, k) for k in ("lat_deg", "lon_deg", "alt_m")},
        "field_ned_mg": list(sim.world.field_ned_mg),
        "declination_deg": math.degrees(sim.world.declination_rad),
        "compasses": [
            {
                "compass": n,
                "device_id": spec.device_id,
                "hard_iron_mg": list(before),
                "offsets_mg": [-v for v in before],
                "hard_iron_end_mg": list(after),
                "soft": [list(row) for row in spec.soft],
                "motor_mg_per_a": list(spec.motor_mg_per_a),
            }
            for n, (spec, before, after) in enumerate(
                zip(scenario.compasses, first.hard_iron_b_mg, now.hard_iron_b_mg, strict=True),
                start=1,
            )
        ],
        "events": sim.autopilot.events,
        "elapsed_s": now.elapsed_s,
    }
