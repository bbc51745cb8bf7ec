"""Flights through magmav's own path, and estimators through a Channel, sample by sample.

The readings go through the Pipeline once (assembler, phase of flight, stored calibration, field model); the Samples it
makes are kept and given to each estimator in turn, as magmav compare does.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from estimator_bench.telemetry import BOOT_S, UNIX_AT_BOOT_NS, Flight
from magmav.channels import new_channel
from magmav.core.channel import Circumstances
from magmav.core.estimators import ESTIMATORS, Estimator
from magmav.core.field import ExpectedField
from magmav.core.types import Estimate, Sample, State
from magmav.geomag import world_magnetic_model
from magmav.pipeline import Pipeline
from magmav.settings import Settings

TICK_S = 0.2
"""The channel makes a new answer this often."""


@dataclass(frozen=True, slots=True, eq=False)
class Heard:
    """One Sample with its circumstances, and the time of flight at which it came, s."""

    t_s: float
    sample: Sample
    circumstances: Circumstances


@dataclass(frozen=True, slots=True, eq=False)
class Tick:
    """What was believed at a time of flight. None where nothing was."""

    t_s: float
    estimate: Estimate | None
    offsets_mg: tuple[float, float, float]
    sigma_mg: tuple[float, float, float]  # as the service publishes it, floors included
    ready: bool


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """One estimator on one flight. us_per_sample: processor time of its step(), and of the estimates asked for."""

    name: str
    ticks: list[Tick]
    us_per_sample: float
    us_first_20s: float


def tape(flight: Flight, settings: Settings | None = None) -> list[Heard]:
    """The Samples of a flight, in order."""
    out: list[Heard] = []

    def tap(sample: Sample, circumstances: Circumstances, stretch: tuple[int, int]) -> None:
        out.append(Heard(sample.boot_ns / 1e9 - BOOT_S, sample, circumstances))

    pipeline = Pipeline(settings or Settings(), world_magnetic_model, UNIX_AT_BOOT_NS, tap, idle=True)
    for t_ns, reading in flight.readings:
        pipeline.step(reading, t_ns)
    return out


class _Billed:
    """An estimator whose processor time is counted. Satisfies Estimator."""

    def __init__(self, inner: Estimator) -> None:
        self.inner = inner
        self.spent_s = 0.0

    def step(self, sample: Sample) -> None:
        """Pass on."""
        begun = time.process_time()
        self.inner.step(sample)
        self.spent_s += time.process_time() - begun

    def estimate(self, expected: ExpectedField | None) -> Estimate | None:
        """Pass on."""
        begun = time.process_time()
        out = self.inner.estimate(expected)
        self.spent_s += time.process_time() - begun
        return out


def run(
    name: str, heard: list[Heard], settings: Settings | None = None, make: Callable[[], Estimator] | None = None
) -> Run:
    """One estimator over a tape. make : used instead of the one of that name in ESTIMATORS."""
    settings = settings or Settings()
    made: list[_Billed] = []

    def billed() -> Estimator:
        made.append(_Billed((make or ESTIMATORS[name])()))
        return made[-1]

    channel = new_channel(settings, name, billed)
    ticks: list[Tick] = []
    due = TICK_S
    early_s, early_n = 0.0, 1
    for n, one in enumerate(heard):
        finding = channel.step(one.sample, one.sample.mag_b_mg, one.circumstances)
        if one.t_s < 20.0:
            early_s, early_n = made[-1].spent_s, n + 1
        if one.t_s >= due - 0.02:
            known = finding.estimate if finding.estimate.samples else None
            x, y, z = finding.offsets_mg.tolist()
            sx, sy, sz = finding.sigma_mg.tolist()
            ticks.append(Tick(one.t_s, known, (x, y, z), (sx, sy, sz), finding.verdict.state is State.READY))
            due = (int(one.t_s / TICK_S + 0.1) + 1) * TICK_S
    late_n = max(len(heard) - early_n, 1)
    late_us = 1e6 * (made[-1].spent_s - early_s) / late_n
    return Run(name, ticks, late_us, 1e6 * early_s / early_n)
