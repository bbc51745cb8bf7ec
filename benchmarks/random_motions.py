"""Is what would be written as right as it claims, whatever the vehicle does? Random motions, and what came of each.

    python benchmarks/random_motions.py --count 500 --seed 5000

Every flight draws one of the bench's motions or a wild one (sines of random size and rate in roll, pitch and yaw, from
standing nearly still to tumbling, within an arc or all the way round), how long it lasts, a site, iron, noise, lateness
and the link's rate and loss. Its samples go through the service's own path to the estimator and the gate. Accepted is
what the gate calls READY at any time; every axis that would then be written is held against the truth, once a second.
"""

from __future__ import annotations

import argparse
import functools
import json
import math
import sys
from collections import Counter, defaultdict
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import estimator_bench  # noqa: F401  before numpy, which it holds to one thread
import numpy as np
from estimator_bench import motions as m
from estimator_bench.flights import true_flight
from estimator_bench.running import tape
from estimator_bench.scenarios import Compass, Link, Scenario
from estimator_bench.telemetry import sent

from magmav.channels import limits
from magmav.core.channel import Channel
from magmav.core.estimators import ESTIMATORS
from magmav.core.types import AxisState, State
from magmav.settings import Settings

SIGMAS, MOST_MG = 3.0, 30.0


def wild(tau: m.Array, r: np.random.Generator) -> m.Path:
    """Any smooth motion: each angle the sum of two sines, its size between almost nothing and very much."""

    def angle(least_deg: float, most_deg: float, slowest: float, fastest: float) -> m.Array:
        size = np.radians(np.exp(r.uniform(math.log(least_deg), math.log(most_deg))))
        rates, phases = r.uniform(slowest, fastest, 2), r.uniform(0.0, 2.0 * np.pi, 2)
        return np.asarray(size * (np.sin(rates[0] * tau + phases[0]) + 0.5 * np.sin(rates[1] * tau + phases[1])))

    roll, pitch = angle(0.3, 60.0, 0.1, 1.2), angle(0.3, 45.0, 0.1, 1.2)
    yaw = r.uniform(0.0, 2.0 * np.pi) + angle(5.0, 400.0, 0.05, 0.5)
    return m.Path(roll, pitch, yaw, np.full_like(tau, r.uniform(0.0, 15.0)), 0.1 * np.sin(1.1 * tau))


MOTIONS: dict[str, tuple[m.Motion, int]] = {
    "wild copter": (wild, m.QUAD),
    "wild plane": (wild, m.PLANE),
    "hover_yaw": (m.hover_yaw, m.QUAD),
    "figure8": (m.figure8, m.QUAD),
    "survey": (m.survey, m.QUAD),
    "loiter_fw": (m.loiter_fw, m.PLANE),
    "aggressive": (m.aggressive, m.QUAD),
    "cruise": (m.cruise, m.PLANE),
    "hover_only": (m.hover_only, m.QUAD),
    "tailsitter": (m.tailsitter, m.TAILSITTER),
    "aerobatics": (m.aerobatics, m.PLANE),
    "boat": (m.boat, m.BOAT),
    "rover": (m.rover, m.ROVER),
}
_WILD_SHARE = 0.5


@dataclass(frozen=True, slots=True)
class Outcome:
    """One flight. worst: of all axes at all times it was READY, the largest error in its own sigmas, and in mG.

    axes : axes that would be written at the last READY; outside : how many of them were beyond SIGMAS then.
    """

    seed: int
    motion: str
    seconds: float
    first_ready_s: float | None
    axes: int
    outside: int
    last_mg: float
    worst_sigmas: float
    worst_mg: float
    reasons: tuple[str, ...]

    @property
    def accepted(self) -> bool:
        """Was it ever READY?"""
        return self.first_ready_s is not None


def drawn(seed: int, longest_s: float = 180.0) -> tuple[Scenario, float]:
    """The scenario of a seed, and how long its flight lasts, s."""
    r = np.random.default_rng([seed, 7])
    names = list(MOTIONS)
    name = names[r.integers(2)] if r.random() < _WILD_SHARE else names[2 + r.integers(len(names) - 2)]
    motion, kind = MOTIONS[name]
    compass = Compass(
        bias_mg=float(r.choice([70.0, 250.0])), noise_mg=float(r.uniform(1.0, 6.0)), late_s=float(r.uniform(0.0, 0.06))
    )
    hz = float(r.choice([10.0, 25.0]))
    link = Link(imu_hz=hz, attitude_hz=hz, gps=bool(r.random() < 0.8), loss=float(r.choice([0.0, 0.1])))
    return Scenario(name, motion, kind, compass=compass, link=link), float(r.uniform(min(40.0, longest_s), longest_s))


def judge(seed: int, estimator: str | None = None, longest_s: float = 180.0) -> Outcome:
    """Fly one seed and hold what would be written against the truth. estimator : None is the service's own."""
    scenario, seconds = drawn(seed, longest_s)
    settings = Settings()
    truth = true_flight(scenario.motion, scenario.kind, seed, scenario.start, seconds)
    flight = sent(scenario, seed, truth)
    make = ESTIMATORS[estimator or settings.learn.estimator]
    channel = Channel(make, limits(settings), settings.gate.steady_s)
    first: float | None = None
    axes = outside = 0
    last_mg = worst_sigmas = worst_mg = 0.0
    due = 0.0
    for heard in tape(flight, settings):
        finding = channel.step(heard.sample, heard.sample.mag_b_mg, heard.circumstances)
        if heard.t_s < due or finding.verdict.state is not State.READY:
            continue
        due = heard.t_s + 1.0
        first = heard.t_s if first is None else first
        written = [i for i in range(3) if finding.verdict.axes[i] is not AxisState.NOT_OBSERVED]
        error = np.abs(finding.offsets_mg + flight.iron_at(heard.t_s))[written]
        share = error / finding.sigma_mg[written]
        axes, outside, last_mg = len(written), int((share > SIGMAS).sum()), float(error.max(initial=0.0))
        worst_sigmas, worst_mg = max(worst_sigmas, float(share.max(initial=0.0))), max(worst_mg, last_mg)
    reasons = tuple(reason.name for reason in channel.verdict.reasons)
    return Outcome(seed, scenario.name, seconds, first, axes, outside, last_mg, worst_sigmas, worst_mg, reasons)


def summary(outcomes: Iterable[Outcome]) -> str:
    """A table by motion, the line that counts, and every flight that broke it."""
    by: dict[str, list[Outcome]] = defaultdict(list)
    for one in outcomes:
        by[one.motion].append(one)
    everything = [one for ones in by.values() for one in ones]
    head = (
        "motion",
        "flights",
        "accepted",
        "axes",
        f"beyond {SIGMAS:g} sigma",
        f"over {MOST_MG:g} mG",
        "never accepted",
    )
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for name, ones in [*((n, by[n]) for n in MOTIONS if n in by), ("all", everything)]:
        taken = [one for one in ones if one.accepted]
        axes, outside = sum(one.axes for one in taken), sum(one.outside for one in taken)
        over = sum(one.worst_mg > MOST_MG for one in taken)
        row = (name, len(ones), len(taken), axes, outside, over, len(ones) - len(taken))
        lines.append(f"| {' | '.join(map(str, row))} |")
    inside = 100.0 * (1.0 - outside / max(axes, 1))
    lines.append(f"\nWithin {SIGMAS:g} sigma at the last READY: {inside:.2f} % of {axes} axes.")
    for one in sorted(everything, key=lambda one: one.seed):
        if one.outside or one.worst_mg > MOST_MG:
            lines.append(
                f"seed {one.seed}, {one.motion}: worst {one.worst_mg:.1f} mG, {one.worst_sigmas:.1f} sigma; "
                f"{one.last_mg:.1f} mG at the end"
            )
    why = Counter(reason for one in everything if not one.accepted for reason in one.reasons)
    lines.append("Never accepted, at the end: " + (", ".join(f"{n} {k}" for k, n in why.most_common(6)) or "none"))
    return "\n".join(lines)


def main(argv: list[str] | None = None) -> int:
    """Fly, judge, print. Exit 1 where the line of the acceptance test AT-2b is broken."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("--count", type=int, default=500)
    ask.add_argument("--seed", type=int, default=5000, help="of the first flight")
    ask.add_argument("--estimator", default=None, choices=tuple(ESTIMATORS))
    ask.add_argument("--longest", type=float, default=180.0, help="seconds of flight at most")
    ask.add_argument("--jobs", type=int, default=2)
    ask.add_argument("--json", type=Path, help="one line per flight, too")
    o = ask.parse_args(argv)
    outcomes: list[Outcome] = []
    run = functools.partial(judge, estimator=o.estimator, longest_s=o.longest)
    with ProcessPoolExecutor(o.jobs) as pool:
        for one in pool.map(run, range(o.seed, o.seed + o.count)):
            outcomes.append(one)
            if sys.stderr.isatty():
                print(f"\r{len(outcomes)} of {o.count}", end="", file=sys.stderr, flush=True)
    if o.json is not None:
        o.json.write_text("".join(json.dumps(asdict(one)) + "\n" for one in outcomes))
    print(summary(outcomes))
    axes, outside = sum(one.axes for one in outcomes), sum(one.outside for one in outcomes)
    return int(outside > 0.01 * axes or any(one.worst_mg > MOST_MG for one in outcomes))


if __name__ == "__main__":
    sys.exit(main())
