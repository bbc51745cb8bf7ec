"""One compass of one recording: its Samples, what was left out, and the answer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magmav.boot import Boot
from magmav.comparison import Columns, Tape, first_half
from magmav.core.after_flight import AfterFlight, after_flight
from magmav.core.correction import field_of, iron_of_offsets
from magmav.core.field import ExpectedField
from magmav.core.types import Estimate, Sample, Vec3
from magmav.fitting import cut
from magmav.fitting.tape import Currents, settled_after
from magmav.reference import Reference
from magmav.settings import Settings
from magmav.vehicle import Vehicle

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Told:
    """What the recording says of a vehicle beside its Samples. parameters : as last heard, whatever their names."""

    system: int
    autopilot: int
    boot: Vehicle | Boot
    reference: Reference | None
    currents: Currents | None
    parameters: dict[str, float]
    moved_s: tuple[float, ...]  # when a compass parameter came to another value
    settings: Settings


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One compass, N samples. columns.learn says what the fit rests on.

    ampere : (N,) battery current, NaN where not known.  half : index of the first sample that is held out.
    raw_b_mg, iron_b_mg : (N, 3) mG, the sensor's own field with its motor term, and the hard iron at each sample.
    """

    compass: int
    tape: Tape
    told: Told
    columns: Columns
    samples: Sequence[Sample]
    cuts: Sequence[cut.Span]
    known: AfterFlight
    half: int
    ampere: Floats
    raw_b_mg: Floats
    iron_b_mg: Floats

    @property
    def estimate(self) -> Estimate:
        """The answer."""
        return self.known.answer

    @property
    def expected(self) -> ExpectedField | None:
        """The world model's field at the end."""
        return self.columns.expected

    @property
    def matrix(self) -> Floats:
        """What the autopilot multiplies with."""
        return self.samples[-1].shaping.matrix

    @property
    def shaped_b_mg(self) -> Floats:
        """(N, 3): as the autopilot shapes it, its offsets not applied."""
        return self.columns.sensor_b_mg @ self.matrix.T

    @property
    def split_s(self) -> float:
        """Where the second half begins."""
        return float(self.columns.boot_s[min(self.half, len(self.columns.boot_s) - 1)])

    @property
    def end_s(self) -> float:
        """Where an accident begins; infinite where none does."""
        return min((s.from_s for s in self.cuts if s.code in ("TUMBLE", "CRASHED")), default=math.inf)

    @property
    def later(self) -> Flags:
        """(N,): taught, and of the second half."""
        return self.columns.learn & (self.columns.boot_s >= self.split_s)

    def iron_to_store(self, e: Estimate) -> Vec3:
        """What offsets alone should take away."""
        return iron_of_offsets(self.samples[-1], e, self.expected)

    def misfit(self, corrected_b_mg: Floats, e: Estimate) -> Floats:
        """(N, 2) mG: level and downward part of (N, 3) less the world model's, or the estimate's own. No heading."""
        return misfit(self.columns, corrected_b_mg, e)


def solve(compass: int, tape: Tape, told: Told) -> Case | None:
    """The answer on what is fit to teach; None where nothing was learnt."""
    columns, heard = Columns.of(tape.heard), [h.sample for h in tape.heard]
    by_hand = np.array([s.by_hand for s in heard], dtype=bool)
    flown = bool((columns.learn & ~by_hand).any())
    settling = settled_after(columns.boot_s, told.moved_s, told.settings.learn.settle_s)
    keep, cuts = cut.before_the_fit(columns, told.boot.phase, by_hand & flown, settling)
    columns = replace(columns, learn=keep)
    samples, half = _taught(heard, keep), first_half(columns)
    known = after_flight(samples, until_ns=samples[half - 1].boot_ns)
    if known is None:
        return None
    iron_b_mg = known.iron_of(samples)
    off = misfit(columns, _along(columns, known, iron_b_mg, samples[-1]), known.answer)
    later, more = cut.near_ground(columns.boot_s, np.hypot(*off.T), keep, told.boot.phase)
    if more:
        columns, cuts = replace(columns, learn=later), cut.merged(cuts, more)
        samples, half = _taught(samples, later), first_half(columns)
        known = after_flight(samples, until_ns=samples[half - 1].boot_ns) or known
        iron_b_mg = known.iron_of(samples)
    unknown = np.full(len(columns.boot_s), np.nan)
    ampere = unknown if told.currents is None else told.currents.at(columns.boot_s)
    raw_b_mg = np.array([s.mag_b_mg for s in samples])
    return Case(compass, tape, told, columns, samples, cuts, known, half, ampere, raw_b_mg, iron_b_mg)


def _taught(samples: Sequence[Sample], keep: Flags) -> list[Sample]:
    return [s if s.learn == bool(k) else replace(s, learn=bool(k)) for s, k in zip(samples, keep, strict=True)]


def _along(c: Columns, known: AfterFlight, iron_b_mg: Floats, last: Sample) -> Floats:
    matrix = known.answer.soft_iron_b @ last.shaping.matrix
    return np.asarray((c.sensor_b_mg - iron_b_mg) @ matrix.T)


def misfit(c: Columns, corrected_b_mg: Floats, e: Estimate) -> Floats:
    """See Case.misfit."""
    level_mg, down_mg = field_of(e, c.expected)
    cr, sr, cp, sp = np.cos(c.roll_rad), np.sin(c.roll_rad), np.cos(c.pitch_rad), np.sin(c.pitch_rad)
    x, y, z = corrected_b_mg.T
    ahead, right = cp * x + sp * (sr * y + cr * z), cr * y - sr * z
    down = -sp * x + cp * (sr * y + cr * z)
    if c.axes == 2:
        down = np.full(len(down), down_mg)
    return np.column_stack([np.hypot(ahead, right) - level_mg, down - down_mg])
