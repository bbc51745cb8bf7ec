"""How good and how honest: numbers of one estimator on one flight, and of many flights together.

The error is the RMS over all level headings of the heading error that the remaining calibration error causes: what the
calibration costs later, whatever is flown then. ``full`` uses all the estimator says (hard and soft iron, motor), and
``offsets`` only what an upload of offsets would store. Both at the flight's mean throttle.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from estimator_bench.motions import Array
from estimator_bench.running import TICK_S, Heard, Run, Tick
from estimator_bench.scenarios import STEP_AT_S
from estimator_bench.telemetry import Flight
from magmav.core.correction import corrected_field
from magmav.core.types import vec3

CHECKPOINTS_S = (30.0, 60.0, 178.0)
HEADINGS_RAD = np.arange(24) * (2.0 * np.pi / 24)
WRONG_DEG = 3.0
NEVER = math.inf


@dataclass(frozen=True, slots=True)
class Moment:
    """One tick of one run. Degrees and mG; the error is 180 / sqrt 3 (any heading) while nothing is known."""

    t_s: float
    full_deg: float
    offsets_deg: float
    iron_mg: tuple[float, float, float]  # error of the hard iron at mean throttle
    sigma_mg: tuple[float, float, float]
    heading_sigma_deg: float
    ready: bool
    known: bool


@dataclass(frozen=True, slots=True)
class Scored:
    """One run. Errors are at CHECKPOINTS_S; times s of flight, inf for never."""

    name: str
    scenario: str
    seed: int
    full_deg: tuple[float, ...]
    offsets_deg: tuple[float, ...]
    iron_mg: tuple[tuple[float, float, float], ...]
    nees: tuple[float, ...]
    ratios: tuple[float, ...]  # error/sigma per axis, at all checkpoints
    to_one_degree_s: float
    again_s: float | None  # after the step of the iron, to one degree again
    ready_s: float  # after take-off
    ready_seconds: float
    ready_wrong: float  # more than WRONG_DEG off
    ready_beyond: float  # beyond three claimed sigma of heading
    us_per_sample: float
    us_first_20s: float


NOTHING_DEG = 180.0 / math.sqrt(3.0)


def level_field(flight: Flight) -> Array:
    """The Earth's field in level body axes at HEADINGS_RAD (magnetic), (24, 3) mG."""
    north, east, down = flight.errors.field_n_mg
    h = math.hypot(north, east)
    return np.stack((h * np.cos(HEADINGS_RAD), -h * np.sin(HEADINGS_RAD), np.full(24, down)), 1)


def sensed(flight: Flight, t_s: float) -> Array:
    """What the sensor gives at those headings at a time of flight, at mean throttle, (24, 3) mG, no noise."""
    return np.asarray(level_field(flight) @ (np.eye(3) + flight.errors.soft).T + flight.iron_at(t_s))


def heading_rms_deg(corrected_b_mg: Array) -> float:
    """RMS heading error of level fields (24, 3) corrected somehow."""
    got = np.arctan2(-corrected_b_mg[:, 1], corrected_b_mg[:, 0])
    off = np.remainder(got - HEADINGS_RAD + np.pi, 2.0 * np.pi) - np.pi
    return math.degrees(float(np.sqrt(np.mean(off**2))))


def typical(flight: Flight, heard: list[Heard]) -> Heard:
    """The sample whose throttle was nearest to the mean: it stands for the flight wherever the motors matter."""
    truth = flight.truth
    t_s = np.array([h.t_s for h in heard])
    throttle = np.interp(t_s, truth.t_s, truth.throttle)
    throttle[~np.array([h.sample.learn for h in heard])] = 1e3
    return heard[int(np.argmin(np.abs(throttle - flight.mean_throttle)))]


def moment(flight: Flight, tick: Tick, like: Heard) -> Moment:
    """One tick against the truth."""
    h = float(np.hypot(*flight.errors.field_n_mg[:2]))
    sigma = tick.sigma_mg
    claimed = math.degrees(min(math.hypot(sigma[0], sigma[1]) / math.sqrt(2.0) / h, math.pi))
    if tick.estimate is None:
        return Moment(tick.t_s, NOTHING_DEG, NOTHING_DEG, (0.0, 0.0, 0.0), sigma, claimed, tick.ready, False)
    raw = sensed(flight, tick.t_s)
    level = [
        corrected_field(
            replace(like.sample, mag_b_mg=vec3(m, "field"), roll_rad=0.0, pitch_rad=0.0),
            tick.estimate,
            like.circumstances.expected,
        )
        for m in raw
    ]
    offsets = raw + np.array(tick.offsets_mg)
    # What the full model says the offset at mean throttle is: where it puts a sensor that feels no field.
    nothing = corrected_field(
        replace(like.sample, mag_b_mg=vec3(flight.iron_at(tick.t_s), "field"), roll_rad=0.0, pitch_rad=0.0),
        tick.estimate,
        like.circumstances.expected,
    )
    x, y, z = nothing.tolist()
    return Moment(
        tick.t_s,
        heading_rms_deg(np.array(level)),
        heading_rms_deg(offsets),
        (x, y, z),
        sigma,
        claimed,
        tick.ready,
        True,
    )


def score(flight: Flight, heard: list[Heard], run: Run) -> Scored:
    """One run against the truth."""
    like = typical(flight, heard)
    moments = [moment(flight, tick, like) for tick in run.ticks]
    at = [nearest(moments, t) for t in CHECKPOINTS_S]
    nees, ratios = [], []
    for one, tick in ((nearest(moments, t), nearest(run.ticks, t)) for t in CHECKPOINTS_S):
        if not one.known or tick.estimate is None:
            continue
        error = np.array(one.iron_mg)
        sigma = np.array(one.sigma_mg)
        own = np.asarray(tick.estimate.covariance_mg2)
        published = own + np.diag(np.maximum(sigma**2 - np.diag(own), 0.0))
        nees.append(float(error @ np.linalg.solve(published, error)))
        ratios += (error / sigma).tolist()
    step = flight.scenario.compass.step_mg > 0.0
    before = [m for m in moments if m.t_s < STEP_AT_S] if step else moments
    after = [m for m in moments if m.t_s >= STEP_AT_S]
    ready = [m for m in moments if m.ready]
    lasts = [b.t_s - a.t_s for a, b in pairwise(moments)] + [TICK_S]

    def seconds(beyond: Callable[[Moment], bool]) -> float:
        return sum(dt_s for m, dt_s in zip(moments, lasts, strict=True) if m.ready and beyond(m))

    return Scored(
        name=run.name,
        scenario=flight.scenario.name,
        seed=flight.seed,
        full_deg=tuple(m.full_deg for m in at),
        offsets_deg=tuple(m.offsets_deg for m in at),
        iron_mg=tuple(m.iron_mg for m in at),
        nees=tuple(nees),
        ratios=tuple(ratios),
        to_one_degree_s=settled(before),
        again_s=settled(after) - STEP_AT_S if step else None,
        ready_s=ready[0].t_s - flight.truth.takeoff_s if ready else NEVER,
        ready_seconds=seconds(lambda m: True),
        ready_wrong=seconds(lambda m: m.full_deg > WRONG_DEG),
        ready_beyond=seconds(lambda m: m.full_deg > 3.0 * m.heading_sigma_deg),
        us_per_sample=run.us_per_sample,
        us_first_20s=run.us_first_20s,
    )


class Answer(NamedTuple):
    """What a method without a covariance says: corrected = matrix @ (sensor - hard iron)."""

    hard_iron_mg: Array
    matrix: Array


def score_answers(flight: Flight, name: str, answers: list[tuple[float, Answer | None]]) -> Scored:
    """A method that was asked at some times, CHECKPOINTS_S among them; it claims nothing and is never ready."""
    nobody = (math.nan,) * 3
    moments = []
    for t_s, a in answers:
        if a is None:
            moments.append(Moment(t_s, NOTHING_DEG, NOTHING_DEG, nobody, nobody, math.nan, False, False))
            continue
        raw = sensed(flight, t_s)
        x, y, z = (a.hard_iron_mg - flight.iron_at(t_s)).tolist()
        full = heading_rms_deg((raw - a.hard_iron_mg) @ a.matrix.T)
        moments.append(
            Moment(t_s, full, heading_rms_deg(raw - a.hard_iron_mg), (x, y, z), nobody, math.nan, False, True)
        )
    at = [nearest(moments, t) for t in CHECKPOINTS_S]
    step, often = flight.scenario.compass.step_mg > 0.0, len(answers) > len(CHECKPOINTS_S)
    before = [m for m in moments if m.t_s < STEP_AT_S] if step else moments
    after = [m for m in moments if m.t_s >= STEP_AT_S]
    return Scored(
        name=name,
        scenario=flight.scenario.name,
        seed=flight.seed,
        full_deg=tuple(m.full_deg for m in at),
        offsets_deg=tuple(m.offsets_deg for m in at),
        iron_mg=tuple(m.iron_mg for m in at),
        nees=(),
        ratios=(),
        to_one_degree_s=settled(before) if often else math.nan,
        again_s=settled(after) - STEP_AT_S if step and often else None,
        ready_s=NEVER,
        ready_seconds=0.0,
        ready_wrong=0.0,
        ready_beyond=0.0,
        us_per_sample=math.nan,
        us_first_20s=math.nan,
    )


def nearest(ticks: list[Any], t_s: float) -> Any:
    """The last tick at or before a time (a little slack: telemetry is not on the second)."""
    return max((k for k in ticks if k.t_s <= t_s + 0.5), key=lambda k: k.t_s, default=ticks[0])


def settled(moments: list[Moment]) -> float:
    """When the error went under one degree for good; inf for never."""
    out = NEVER
    for m in reversed(moments):
        if m.full_deg >= 1.0:
            break
        out = m.t_s
    return out


# ---------------------------------------------------------------- many flights


def rms(values: list[float]) -> float:
    """Root mean square; nan of nothing."""
    return float(np.sqrt(np.mean(np.square(values)))) if values else math.nan


@dataclass(frozen=True, slots=True)
class Summary:
    """One estimator in one scenario over all seeds. Errors are RMS over seeds at CHECKPOINTS_S."""

    name: str
    scenario: str
    flights: int
    full_deg: tuple[float, ...]
    offsets_deg: tuple[float, ...]
    iron_xy_mg: float  # at the last checkpoint, RMS over axes
    iron_z_mg: float
    nees: float
    ratio: float  # error/sigma, RMS over axes, checkpoints and seeds
    to_one_degree_s: float  # median
    again_s: float | None  # median
    ready_within_60s: float  # share of flights
    ready_s: float  # median
    ready_seconds: float
    wrong_share: float  # of ready seconds
    beyond_share: float
    us_per_sample: float
    us_first_20s: float


def summed(scored: list[Scored]) -> Summary:
    """All runs of one estimator in one scenario."""
    first = scored[0]
    count = range(len(CHECKPOINTS_S))
    seconds = sum(s.ready_seconds for s in scored)
    again = [s.again_s for s in scored if s.again_s is not None]
    return Summary(
        name=first.name,
        scenario=first.scenario,
        flights=len(scored),
        full_deg=tuple(rms([s.full_deg[i] for s in scored]) for i in count),
        offsets_deg=tuple(rms([s.offsets_deg[i] for s in scored]) for i in count),
        iron_xy_mg=rms([v for s in scored for v in s.iron_mg[-1][:2]]),
        iron_z_mg=rms([s.iron_mg[-1][2] for s in scored]),
        nees=float(np.mean([v for s in scored for v in s.nees] or [math.nan])),
        ratio=rms([v for s in scored for v in s.ratios]),
        to_one_degree_s=median(s.to_one_degree_s for s in scored),
        again_s=median(again) if again else None,
        ready_within_60s=float(np.mean([s.ready_s <= 60.0 for s in scored])),
        ready_s=median(s.ready_s for s in scored),
        ready_seconds=seconds,
        wrong_share=sum(s.ready_wrong for s in scored) / max(seconds, 1),
        beyond_share=sum(s.ready_beyond for s in scored) / max(seconds, 1),
        us_per_sample=float(np.mean([s.us_per_sample for s in scored])),
        us_first_20s=float(np.mean([s.us_first_20s for s in scored])),
    )


def plain(value: Any) -> Any:
    """For JSON: what is not finite is null."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    return [plain(v) for v in value] if isinstance(value, (list, tuple)) else value


def as_dict(one: Scored | Summary) -> dict[str, Any]:
    """For JSON."""
    out: dict[str, Any] = plain(asdict(one))
    return out
