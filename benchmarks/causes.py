"""How often the cause finder names what is wrong, and how often it names what is not, on simulated flights.

    python benchmarks/causes.py --flights 100               clean flights: the rate of false alarms
    python benchmarks/causes.py --flights 10 --fault all    each fault: found, and what else was named

A flight has a pattern, a site, wind, iron and noise drawn from its seed, two compasses, and the fault (on compass 1).
The pipeline is the service's own, with its default estimator unless another is asked for.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import sys
import tempfile
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
from magmav_sim import Simulation, parse_scenario
from magmav_sim.link import SimulatedLink

from magmav.core.estimators import ESTIMATORS
from magmav.geomag import world_magnetic_model
from magmav.live import Session
from magmav.settings import Settings, with_value
from magmav.store import Store

SITES = ((-0.18, -78.47), (47.4, 8.55), (-35.3, 149.1), (40.0, -105.3), (28.6, 77.2), (69.65, 18.96))
PATTERNS = {
    "hover turns": ('F450', '{kind="takeoff",height_m=12.0,climb_mps=3.0},{kind="yaw",turns=1.5,rate_dps=30.0},'
                    '{kind="hover",seconds=5.0},{kind="yaw",turns=-1.5,rate_dps=25.0},{kind="land",sink_mps=2.0}'),
    "figure eight": ('F450', '{kind="takeoff",height_m=12.0,climb_mps=3.0},{kind="yaw",turns=1.0,rate_dps=36.0},'
                     '{kind="figure8",laps=2,half_length_m=14.0,speed_mps=4.5},{kind="land",sink_mps=2.0}'),
    "survey": ('F450', '{kind="takeoff",height_m=12.0,climb_mps=3.0},{kind="survey",lanes=4,length_m=30.0,'
               'spacing_m=8.0,speed_mps=5.0,heading_deg=20.0},{kind="land",sink_mps=2.0}'),
    "bob": ('F450', '{kind="takeoff",height_m=12.0,climb_mps=3.0},{kind="yaw",turns=1.2,rate_dps=30.0},'
            '{kind="bob",cycles=5,height_m=6.0,period_s=4.0},{kind="figure8",laps=1,half_length_m=14.0,speed_mps=4.5},'
            '{kind="land",sink_mps=2.0}'),
    "loiter": ('c172x', '{kind="takeoff",height_m=100.0},{kind="loiter",turns=1.0,bank_deg=30.0},'
               '{kind="loiter",turns=1.0,bank_deg=-25.0},{kind="land",sink_mps=5.0}'),
}  # fmt: skip


def turned(yaw_deg: float = 0.0, pitch_deg: float = 0.0) -> list[list[float]]:
    """A sensor turned by a yaw or a pitch: what it makes of a field in body axes."""
    c, s = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    cp, sp = math.cos(math.radians(pitch_deg)), math.sin(math.radians(pitch_deg))
    return (np.array([[cp, 0, -sp], [0, 1, 0], [sp, 0, cp]]) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])).tolist()


FAULTS: dict[str, tuple[frozenset[str], dict[str, object]]] = {
    "none": (frozenset(), {}),
    "magnet": (frozenset({"MAGNET_NEARBY"}), {"hard_iron_mg": [900.0, -700.0, 400.0]}),
    "attached": (frozenset({"IRON_CHANGED"}), {"step": [-60.0, 45.0, 80.0]}),
    "current": (frozenset({"FOLLOWS_CURRENT"}), {"motor_mg_per_a": [2.0, -1.5, 2.5]}),
    "yaw 90": (frozenset({"MOUNTED_WRONG"}), {"soft": turned(90.0)}),
    "yaw 30": (frozenset({"MOUNTED_CROOKED"}), {"soft": turned(30.0)}),
    "pitch 12": (frozenset({"MOUNTED_CROOKED"}), {"soft": turned(0.0, 12.0)}),
    "scale 1.28": (frozenset({"SCALE_WRONG"}), {"soft": (1.28 * np.eye(3)).tolist()}),
    "gyro": (frozenset({"GYRO_BIAS"}), {"gyro_dps": 2.0}),
    "ground": (frozenset({"GROUND_DISTURBED"}), {"anomaly": [120.0, -180.0, 90.0]}),
}
CONSEQUENCES = {
    "yaw 90": {"COMPASS_BAD", "OTHER_COMPASS_BAD"}, "yaw 30": {"COMPASS_BAD", "OTHER_COMPASS_BAD"},
    "pitch 12": {"COMPASS_BAD", "OTHER_COMPASS_BAD"}, "ground": {"MAGNET_NEARBY"}, "magnet": {"SCALE_WRONG"},
    "attached": {"COMPASS_BAD", "OTHER_COMPASS_BAD"},
}  # fmt: skip


def scenario(seed: int, fault: str) -> tuple[str, str]:
    """A scenario file and the name of its pattern."""
    r = random.Random(seed)
    name = list(PATTERNS)[seed % len(PATTERNS)]
    airframe, pattern = PATTERNS[name]
    what = FAULTS[fault][1]
    lat, lon = SITES[seed // len(PATTERNS) % len(SITES)]
    parts = [
        f'seed = {seed}\nairframe = "{airframe}"\ndate = 2026-11-22T10:00:00Z\nheading_deg = {r.uniform(0, 359):.0f}.0',
        f"place = {{ lat_deg = {lat}, lon_deg = {lon}, alt_m = 400.0 }}",
        f"wind = {{ speed_mps = {r.uniform(1, 6):.1f}, from_deg = {r.uniform(0, 359):.0f}.0, turbulence_mps = 1.0 }}",
    ]
    if "anomaly" in what:
        parts.append(f"anomaly = {{ ned_mg = {what['anomaly']}, scale_m = 2.0 }}")
    for compass, device in ((1, 97539), (2, 131874)):
        of = what if compass == 1 else {}
        iron = of.get("hard_iron_mg", [round(r.gauss(0, 70), 1) for _ in range(3)])
        parts.append(f"[[compass]]\ndevice_id = {device}\nhard_iron_mg = {iron}\nnoise_mg = {r.uniform(3, 6):.1f}")
        parts.append(f"delay_ms = {r.uniform(0, 30):.0f}.0\nexternal = false")
        parts += [f"{key} = {of[key]}" for key in ("soft", "motor_mg_per_a") if key in of]
    parts.append(f"[autopilot]\ngyro_bias_dps = {what.get('gyro_dps', 0.05)}")
    if "step" in what:
        parts.append(f'[[fault]]\nkind = "iron_step"\ncompass = 1\nat_s = 45.0\nmg = {what["step"]}')
    parts.append(f"[[flight]]\npattern = [{pattern}]")
    return "\n".join(parts), name


def fly(fault: str, estimator: str, seed: int) -> dict[str, object]:
    """One flight: what was named of each compass at its end, and the gyro's true bias."""
    text, name = scenario(seed, fault)
    flown = parse_scenario(text.encode(), f"{fault}-{seed}.toml")
    simulation = Simulation(flown)
    for other in range(1, 100):  # the simulator draws the bias: one that is worth finding
        if fault != "gyro" or abs(math.degrees(simulation.autopilot.gyro_bias_rads[2])) > 0.8:
            break
        simulation = Simulation(flown, seed + 10_000 * other)
    link = SimulatedLink(simulation)
    settings = with_value(with_value(Settings(), "wire", "imu_hz", 10.0), "learn", "estimator", estimator)
    with tempfile.TemporaryDirectory() as folder, Store(Path(folder) / "s.sqlite") as store:
        session = Session.on(link, settings, world_magnetic_model, store)
        session.service.run()
    vehicle = next(iter(session.pipeline.vehicles.values()))
    named = {c: [cause.as_json() for cause in vehicle.causes.of(c)] for c in vehicle.channels}
    states = {c: channel.verdict.state.name for c, channel in vehicle.channels.items()}
    return {"fault": fault, "seed": seed, "pattern": name, "named": named, "states": states}


def main() -> int:
    """Fly, count, print a table (and every flight as JSON lines with --json)."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("--flights", type=int, default=10, help="flights per fault")
    ask.add_argument("--fault", default="none", choices=(*FAULTS, "all"))
    ask.add_argument("--seed", type=int, default=1000, help="of the first flight")
    ask.add_argument("--estimator", default=Settings().learn.estimator, choices=tuple(ESTIMATORS))
    ask.add_argument("--jobs", type=int, default=2)
    ask.add_argument("--json", action="store_true", help="one line per flight, too")
    o = ask.parse_args()
    chosen = [f for f in FAULTS if f != "none"] if o.fault == "all" else [o.fault]
    print("| fault | flights | found | flights with something else named | what |\n|---|---|---|---|---|")
    with ProcessPoolExecutor(o.jobs) as pool:
        for fault in chosen:
            found = wrong = 0
            others: Counter[str] = Counter()
            expected = FAULTS[fault][0]
            for got in pool.map(partial(fly, fault, o.estimator), range(o.seed, o.seed + o.flights)):
                if o.json:
                    print(json.dumps(got), file=sys.stderr, flush=True)
                codes = {c: {x["code"] for x in named} for c, named in got["named"].items()}  # type: ignore[attr-defined]
                found += expected <= codes.get(1, set())
                more = set().union(*codes.values()) - expected - CONSEQUENCES.get(fault, set())
                wrong += bool(more)
                others.update(more)
            told = ", ".join(f"{k} {n}" for k, n in others.most_common())
            print(f"| {fault} | {o.flights} | {found if expected else '-'} | {wrong} | {told} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
