"""What the estimators cost: microseconds a sample, state in bytes, and an hour's recording through the whole program.

    python benchmarks/estimator_cost.py                      adaptive and kalman, one hour of flight
    python benchmarks/estimator_cost.py --minutes 5          a shorter recording, scaled to the hour
    python benchmarks/estimator_cost.py --estimators adaptive --json cost.json

Every figure is processor time (user and system) of this process or of the child that is measured, so waiting for
others does not count; sharing caches and clock speed with them does, so for a figure to quote the machine should do
nothing else. The ratios to pymavlink's own parse of the same messages, taken in turn, stand on any machine.

The hour: RAW_IMU at 10 Hz, ATTITUDE at 50 Hz, HEARTBEAT, GLOBAL_POSITION_INT and VFR_HUD at 1 Hz, a closed-form
figure eight, written as a tlog; `magmav replay --json` of it in a process of its own, from its start to its end.
"""

from __future__ import annotations

import argparse
import json
import pickle
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from io import BytesIO
from pathlib import Path
from statistics import median
from typing import Any

import estimator_bench  # noqa: F401 (before numpy: it sets how many threads that takes)
import numpy as np
from estimator_bench import motions
from estimator_bench.flights import body_rates, rotations, true_flight
from estimator_bench.running import Heard, tape
from estimator_bench.scenarios import chosen
from estimator_bench.telemetry import SITES, UNIX_AT_BOOT_NS, angles, sent
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.core.estimators import ESTIMATORS, Estimator
from magmav.geomag import world_magnetic_model

SCENARIOS = "figure8,survey,soft5,rough10"
EARLY_S, ASK_S = 20.0, 0.2  # the channel asks for an estimate this often
LATE_US, EARLY_US, STATE_BYTES, HOUR_S = 120.0, 250.0, 50_000, 15.0
_ROUNDS = 3
_BOOT_US = 10_000_000
_IRON_MG = np.array((120.0, -80.0, 200.0))


@dataclass(frozen=True, slots=True)
class Cost:
    """One estimator on one simulated flight: microseconds a sample; bytes of its state at its largest."""

    estimator: str
    scenario: str
    samples: int
    early_us: float
    late_us: float
    early_asked_us: float  # with the estimates the channel asks for
    late_asked_us: float
    pickled_bytes: int
    numpy_bytes: int


@dataclass(frozen=True, slots=True)
class Hour:
    """One estimator on one hour: seconds of processor time, whole process."""

    estimator: str
    messages: int
    replay_s: float
    parse_s: float

    @property
    def ratio(self) -> float:
        """To pymavlink's bare parse."""
        return self.replay_s / self.parse_s


class _Arrays(pickle.Pickler):
    """Counts the bytes of all arrays it meets."""

    def __init__(self) -> None:
        self.out = BytesIO()
        self.arrays = 0
        super().__init__(self.out, protocol=pickle.HIGHEST_PROTOCOL)

    def reducer_override(self, obj: Any) -> Any:
        """Look, and let the usual way go on."""
        if isinstance(obj, np.ndarray):
            self.arrays += obj.nbytes
        return NotImplemented


def state_bytes(estimator: Estimator) -> tuple[int, int]:
    """Pickled, and in arrays alone."""
    pickler = _Arrays()
    pickler.dump(estimator)
    return len(pickler.out.getvalue()), pickler.arrays


def stepped(name: str, heard: list[Heard], ask: bool) -> tuple[float, float]:
    """Microseconds a sample before and after the first EARLY_S of flight."""
    split = next(i for i, h in enumerate(heard) if h.t_s - heard[0].t_s >= EARLY_S)
    estimator = ESTIMATORS[name]()
    estimator.estimate(None)
    out = []
    for part in (heard[:split], heard[split:]):
        due = -1.0
        begun = time.process_time()
        for h in part:
            estimator.step(h.sample)
            if ask and h.t_s >= due:
                estimator.estimate(h.circumstances.expected)
                due = h.t_s + ASK_S
        out.append(1e6 * (time.process_time() - begun) / len(part))
    return out[0], out[1]


def cost(name: str, scenario: str, heard: list[Heard]) -> Cost:
    """One estimator on one flight; the best of some rounds."""
    bare = [stepped(name, heard, ask=False) for _ in range(_ROUNDS)]
    asked = [stepped(name, heard, ask=True) for _ in range(_ROUNDS)]
    estimator = ESTIMATORS[name]()
    sizes = []
    for i, h in enumerate(heard):
        estimator.step(h.sample)
        if i % 50 == 0 or i == len(heard) - 1 or i < 5:
            sizes.append(state_bytes(estimator))
    early_us, late_us = (min(r[k] for r in bare) for k in (0, 1))
    early_asked_us, late_asked_us = (min(r[k] for r in asked) for k in (0, 1))
    pickled, arrays = (max(s[k] for s in sizes) for k in (0, 1))
    return Cost(name, scenario, len(heard), early_us, late_us, early_asked_us, late_asked_us, pickled, arrays)


# ---------------------------------------------------------------- the hour


def packets(seconds: float) -> Iterator[tuple[int, bytes]]:
    """(UNIX time in us, frame) of a figure eight, with everything a replay asks for."""
    mav = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    lat, lon, alt = SITES["Zurich"]
    r = np.random.default_rng(4)
    step_s = 0.02
    tau = np.arange(0.0, seconds, step_s)
    path = motions.figure8(tau, r)
    body = rotations(path.roll_rad, path.pitch_rad, path.yaw_rad)
    rates = body_rates(body, step_s)
    earth = world_magnetic_model(lat, lon, alt, UNIX_AT_BOOT_NS)
    if earth is None:
        raise ValueError("the world magnetic model does not reach that date")
    field = body @ np.array(earth) + _IRON_MG + r.normal(0.0, 4.0, (len(tau), 3))
    force = -1000.0 * body[:, :, 2]  # mg, no acceleration

    def stamped(us: int, message: Any) -> tuple[int, bytes]:
        return UNIX_AT_BOOT_NS // 1000 + us, bytes(message.pack(mav))

    for name in ("OFS_X", "OFS_Y", "OFS_Z", "DEV_ID", "ORIENT", "EXTERNAL", "MOTCT", "SCALE"):
        value = 97539.0 if name == "DEV_ID" else 0.0
        yield stamped(_BOOT_US, dialect.MAVLink_param_value_message(f"COMPASS_{name}".encode(), value, 9, 900, 65535))
    for i in range(len(tau)):
        us = _BOOT_US + round(1e6 * tau[i])
        ms = us // 1000
        if i % 50 == 0:
            yield stamped(us, dialect.MAVLink_heartbeat_message(2, 3, 128, 4, 4, 3))
            place = (round(lat * 1e7), round(lon * 1e7), round((alt + 30.0) * 1e3), 30_000)
            yield stamped(us, dialect.MAVLink_global_position_int_message(ms, *place, 0, 0, 0, 0))
            yield stamped(us, dialect.MAVLink_vfr_hud_message(0.0, 0.0, 0, 45, alt, 0.0))
        roll, pitch, yaw = angles(body[i])
        yield stamped(us, dialect.MAVLink_attitude_message(ms, roll, pitch, yaw, *rates[i].tolist()))
        if i % 5 == 0:
            whole = np.round(np.concatenate((force[i], 1000.0 * rates[i], field[i]))).astype(int).tolist()
            yield stamped(us, dialect.MAVLink_raw_imu_message(us, *whole))


def written(path: Path, seconds: float) -> list[bytes]:
    """The tlog; and its frames."""
    frames = []
    with path.open("wb") as file:
        for us, frame in packets(seconds):
            file.write(us.to_bytes(8, "big") + frame)
            frames.append(frame)
    return frames


def parsed_s(frames: list[bytes]) -> float:
    """Processor time of pymavlink's own parser over all frames, in s."""
    mav: Any = dialect.MAVLink(None)
    mav.robust_parsing = True
    begun = time.process_time()
    count = sum(len(mav.parse_buffer(frame) or ()) for frame in frames)
    spent = time.process_time() - begun
    if count != len(frames):
        raise RuntimeError(f"pymavlink read {count} of {len(frames)} messages")
    return spent


def replayed_s(path: Path, estimator: str, folder: Path) -> float:
    """Processor time of a replay's whole process, s."""
    config = folder / f"{estimator}.toml"
    config.write_text(f'[learn]\nestimator = "{estimator}"\n', encoding="utf-8")
    command = [sys.executable, "-m", "magmav.cli", "replay", str(path), "--config", str(config), "--json"]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    (vehicle,) = json.loads(done.stdout)["vehicles"]
    (compass,) = vehicle["compasses"]
    if not compass["samples_learnt"] > 0.9 * compass["samples"]:
        raise RuntimeError(f"{estimator}: learnt only {compass['samples_learnt']} of {compass['samples']} samples")
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def hours(names: list[str], minutes: float) -> list[Hour]:
    """Every estimator over one recording; of a shorter one all but the start of the process is scaled to the hour."""
    scale = 60.0 / minutes
    out = []
    with tempfile.TemporaryDirectory(prefix="magmav-cost-") as place:
        folder = Path(place)
        frames = written(folder / "hour.tlog", 60.0 * minutes)
        written(folder / "start.tlog", 6.0)
        for name in names:
            before = parsed_s(frames)
            spent = replayed_s(folder / "hour.tlog", name, folder)
            parse = 0.5 * (before + parsed_s(frames))
            start = 0.0 if scale == 1.0 else replayed_s(folder / "start.tlog", name, folder)
            out.append(Hour(name, round(scale * len(frames)), start + scale * (spent - start), scale * parse))
            print(f"hour: {name}", file=sys.stderr, flush=True)
    return out


# ---------------------------------------------------------------- what is printed


def line(cells: list[str]) -> str:
    """A line of a Markdown table."""
    return "| " + " | ".join(cells) + " |"


def tables(costs: list[Cost], some: list[Hour]) -> str:
    """Both tables and what misses its target."""
    head = ["estimator", "flight", "samples", "us, first 20 s", "us, later", "with estimates: first 20 s", "later"]
    out = [line([*head, "state, pickled", "in arrays"]), line(["---", "---"] + ["--:"] * 7)]
    for c in costs:
        numbers = [f"{v:.0f}" for v in (c.early_us, c.late_us, c.early_asked_us, c.late_asked_us)]
        cells = [c.estimator, c.scenario, f"{c.samples}", *numbers, f"{c.pickled_bytes}", f"{c.numpy_bytes}"]
        out.append(line(cells))
    if some:
        out += ["", line(["estimator", "messages in the hour", "replay s", "pymavlink parse s", "ratio"])]
        out.append(line(["---"] + ["--:"] * 4))
        out += [
            line([h.estimator, f"{h.messages}", f"{h.replay_s:.1f}", f"{h.parse_s:.1f}", f"{h.ratio:.2f}"])
            for h in some
        ]
    late = missed(costs, some)
    return "\n".join([*out, "", "Targets missed:", "", *([f"- {one}" for one in late] or ["- none"])])


def missed(costs: list[Cost], some: list[Hour]) -> list[str]:
    """What the project demands of its adaptive estimator and this is not. Times are medians over the flights."""
    out = []
    mine = [c for c in costs if c.estimator == "adaptive"]
    if mine:
        early, later = median(c.early_asked_us for c in mine), median(c.late_asked_us for c in mine)
        if early > EARLY_US:
            out.append(f"{early:.0f} us a sample in the first {EARLY_S:.0f} s, want {EARLY_US:.0f}")
        if later > LATE_US:
            out.append(f"{later:.0f} us a sample later, want {LATE_US:.0f}")
        most = max(c.pickled_bytes for c in mine)
        if most >= STATE_BYTES:
            out.append(f"state of {most} bytes, want under {STATE_BYTES}")
    for h in some:
        if h.estimator == "adaptive" and h.replay_s >= HOUR_S:
            out.append(f"an hour in {h.replay_s:.1f} s, want under {HOUR_S:.0f} ({h.ratio:.2f} bare parses)")
    return out


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--estimators", default="adaptive,kalman", metavar="A,B")
    parser.add_argument("--scenarios", default=SCENARIOS, metavar="A,B", help=f"default {SCENARIOS}")
    parser.add_argument("--minutes", type=float, default=60.0, help="of the recording for the hour; 0: none")
    parser.add_argument("--json", type=Path)
    o = parser.parse_args()
    names = o.estimators.split(",")
    for name in names:
        if name not in ESTIMATORS:
            parser.error(f"no {name!r}; choose {', '.join(ESTIMATORS)}")
    if o.minutes < 0.0:
        parser.error(f"--minutes: want 0 or more, got {o.minutes:g}")
    costs = []
    for scenario in chosen(o.scenarios):
        heard = tape(sent(scenario, 0, true_flight(scenario.motion, scenario.kind, 0, scenario.start)))
        for name in names:
            costs.append(cost(name, scenario.name, heard))
            print(f"{scenario.name}: {name}", file=sys.stderr, flush=True)
    some = hours(names, o.minutes) if o.minutes else []
    print(tables(costs, some))
    if o.json is not None:
        document = {
            "samples": [asdict(c) for c in costs],
            "hour": [asdict(h) | {"ratio": h.ratio} for h in some],
            "missed": missed(costs, some),
        }
        o.json.write_text(json.dumps(document) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
