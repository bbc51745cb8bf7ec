"""After the flight: the iron of every second with all of the flight known, the adaptive estimator run both ways.

One bank goes over the Samples, another goes over them from the end, and core.two_filter makes their beliefs of a moment
into one. Time turned round: a step or a gap belongs to the way between two samples, so it goes to the other end of it.
The own frame of a sample, its rates, and with them the compass's delay, stay as they are. Only the gyro's bias changes
sign: it turns the heading by so much a second, and the seconds run the other way.

Each side sees a sudden change of the iron only once it is past it. The change lies where the forward innovations stop
being small and, coming from the other end, the backward ones do. There both are told to let the iron go and are run
once more: the belief on either side then owes nothing to the other's iron, but everything else. A young belief is
easily surprised where nothing happened, so that a side that is surprised alone is heeded only in its later half.

What was turned by hand before the flight is another flight to the estimator, and is left out where anything flew.
"""

from __future__ import annotations

import copy
import math
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magmav.core.estimators.adaptive import AdaptiveEstimator
from magmav.core.estimators.adaptive import layout as at
from magmav.core.estimators.adaptive.bank import Bank
from magmav.core.estimators.adaptive.block import Block
from magmav.core.estimators.adaptive.change import ChangeWatch
from magmav.core.estimators.adaptive.layout import Array
from magmav.core.estimators.adaptive.process import advance
from magmav.core.estimators.adaptive.tuning import Tuning
from magmav.core.rotation import TAU
from magmav.core.stretch import backwards, flown, framed
from magmav.core.two_filter import noted, product
from magmav.core.types import Estimate, Sample

_EVERY_NS = 1_000_000_000
_MOMENTS = 600  # at most about so many: between them the iron is a straight line
_LATE_NS = 5_000_000_000  # a change is noticed within so long
_CLEAR = 25.0  # chi squared of three axes beyond which the two irons are two: once in 60 000
_SURE_RAD = math.radians(20.0)  # then the side that begins at the end looks for north on that side only
_LEAST_MG, _SHARE = 80.0, 1.5  # the iron is let go by at least so much, and so many times the change


@dataclass(frozen=True, slots=True, eq=False)
class AfterFlight:
    """What is known of the iron of every moment with the whole flight known.

    boot_ns : (N,) increasing, a second apart, or a 600th of the flight.  estimates : N of them; their hard
    iron is at the same throttle as the estimator's own.  changes_ns : the iron changed suddenly right after these.
    """

    boot_ns: NDArray[np.int64]
    estimates: tuple[Estimate, ...]
    changes_ns: tuple[int, ...]
    foretold: Estimate | None = None  # by the time asked for, with nothing of what came after

    @property
    def answer(self) -> Estimate:
        """Of the flight as a whole: the iron at its end, which is what the vehicle carries on.

        Where the iron stayed, every moment says the same to its sigma; where it moved, the end is what counts.
        """
        return self.estimates[-1]

    def iron_b_mg(self, boot_ns: NDArray[np.int64]) -> Array:
        """Hard iron at these times, (M,), as (M, 3) mG: between two moments in proportion, across a change not."""
        out = np.empty((len(boot_ns), 3))
        iron = np.array([e.hard_iron_b_mg for e in self.estimates])
        edges = np.array(self.changes_ns, dtype=np.int64)
        part_of = np.searchsorted(edges, self.boot_ns), np.searchsorted(edges, boot_ns)
        for part in np.unique(part_of[1]):
            mine, wanted = part_of[0] == part, part_of[1] == part
            for axis in range(3):
                out[wanted, axis] = np.interp(boot_ns[wanted], self.boot_ns[mine], iron[mine, axis])
        return out

    def iron_of(self, samples: Sequence[Sample]) -> Array:
        """Hard iron at the moment each of them was measured, (M, 3) mG."""
        return self.iron_b_mg(np.array([s.boot_ns - round(1e9 * s.age_s) for s in samples], dtype=np.int64))


def after_flight(
    samples: Sequence[Sample], tuning: Tuning | None = None, until_ns: int | None = None
) -> AfterFlight | None:
    """The iron along one stretch of one compass; None where nothing is known of it.

    samples : as the estimator was given them, in order of time; of one boot, undone with one set of stored values.
    until_ns : boot time of ``foretold``.
    """
    stretch = framed(flown(samples))
    if not stretch:
        return None
    run = _BothWays(stretch, tuning, until_ns=until_ns)
    foretold, changes = run.foretold, run.changes()
    if changes or run.startled:
        run = _BothWays(stretch, tuning, changes, run.middle_ns)
    known = [(t, e) for t, e in run.estimates() if e is not None]
    if not known:
        return None
    times = np.array([t for t, _ in known], dtype=np.int64)
    return AfterFlight(times, tuple(e for _, e in known), tuple(sorted(t for t in changes if t > times[0])), foretold)


# ---------------------------------------------------------------- one way


class _Watch(ChangeWatch):
    """May be deaf for a while."""

    deaf = False

    def step(
        self, white: Array, innovation_mg: Array, like: float, disturbance: float, nis: float, dt_s: float
    ) -> bool:
        """As ever, but nothing happened while deaf."""
        since_s = self.since_s + dt_s
        heard = super().step(white, innovation_mg, like, disturbance, nis, dt_s)
        if heard and self.deaf:
            self.since_s = since_s
        return heard and not self.deaf


class _Pass(AdaptiveEstimator):
    """The estimator, one way; it keeps what it met.

    deaf : within these boot times no change is noticed.  alpha_rad : about where it begins; None: anywhere.
    """

    def __init__(self, tuning: Tuning | None, deaf: tuple[float, float], alpha_rad: float | None = None) -> None:
        super().__init__(tuning, second=False)
        self._alpha_rad = alpha_rad
        self._change: _Watch = _Watch(self.tuning)
        self._deaf = deaf
        self.seen: dict[int, float] = {}  # square of the innovation by boot time, mG^2
        self.ends_ns: tuple[int, int] = (0, 0)  # of the last block
        self.changed: list[tuple[int, int]] = []  # ends of the blocks at which a change was noticed
        self._times_ns: list[int] = []

    def _prior(self, s: Sample, z: Array, down_b: Array) -> tuple[float, float, float, float]:
        self.field = super()._prior(s, z, down_b)
        return self.field

    def _begun(self, field: tuple[float, float, float, float], iron_mg: Array | None = None) -> Bank:
        return Bank.begun(field, self.tuning, iron_mg)  # either way's models must have their like always

    def _lose_heading(self, bank: Bank) -> None:
        super()._lose_heading(bank)
        bank.part(self.tuning)

    def _learn(self) -> None:
        self._times_ns = self._gathering.boots_ns
        self.ends_ns = min(self._times_ns), max(self._times_ns)
        if self._alpha_rad is not None and self._bank is not None and not self.seen:
            away = np.abs((self._bank.x[:, at.ALPHA] - self._alpha_rad + math.pi) % TAU - math.pi)
            self._bank.keep(np.flatnonzero(away < 1.51 * TAU / self.tuning.yaws))  # three directions
        super()._learn()

    def _update(self, bank: Bank, block: Block) -> None:
        before_s = self._change.since_s
        self._change.deaf = self._deaf[0] <= self.ends_ns[0] <= self._deaf[1]
        super()._update(bank, block)
        if self._change.since_s < before_s:
            self.changed.append(self.ends_ns)

    def _met(self, nu: Array) -> None:
        self.seen |= zip(self._times_ns, (nu * nu).sum(1).tolist(), strict=True)

    @property
    def bank(self) -> Bank | None:
        """What is believed."""
        return self._bank

    def settle(self) -> None:
        """Take in what has gathered."""
        if len(self._gathering):
            self._learn()

    def let_go(self, sigma_mg: float) -> None:
        """The iron is another one from here on."""
        self.settle()
        if self._bank is not None:
            self._bank.doubt_iron(sigma_mg)
            self._change = _Watch(self.tuning)
            self._change.since_s = 0.0

    def carried_to(self, s: Sample) -> tuple[Bank, bool] | None:
        """A copy of the bank at the moment of the next sample, not yet taken; and does its heading still count?"""
        if self._bank is None or s.body_from_own is None:
            return None
        n, waiting = self.tuning, self._gathering
        own_rad = None if s.tilt_from == "ATTITUDE" else s.own_tilt_rad
        bank, down_b = noted(self._bank), s.body_from_own[:, 2]
        turn_rad2 = waiting._turn_rad2 + ((1.0 if own_rad is None else 4.0) * n.turn_walk_rad) ** 2 * s.dt_s
        bank.x[:, at.ALPHA] += waiting._turned_rad
        advance(bank, waiting._dt_s + s.dt_s, waiting._down_s + s.dt_s * down_b, turn_rad2, own_rad, n)
        return bank, not (s.gap or self._lost)

    def says(self, bank: Bank) -> Estimate | None:
        """The estimate, had this been believed."""
        like = copy.copy(self)
        like._bank = bank
        return like.estimate(None)


# ---------------------------------------------------------------- both ways


class _BothWays:
    """A flight run forwards, then backwards over the same blocks.

    told : the iron changes right after these, by so many mG.  elder_ns : before it the forward side, after it the
    backward side notices nothing by itself; None: both do always.  until_ns : boot time of ``foretold``.
    """

    def __init__(
        self,
        samples: Sequence[Sample],
        tuning: Tuning | None,
        told: Mapping[int, float] | None = None,
        elder_ns: float | None = None,
        until_ns: int | None = None,
    ) -> None:
        self._until_ns = until_ns
        self.foretold: Estimate | None = None
        self._told = sorted((told or {}).items())
        self.forward = _Pass(tuning, (-math.inf, -math.inf if elder_ns is None else elder_ns))
        self.before: dict[int, Bank] = {}
        self.after: dict[int, tuple[Bank, bool]] = {}
        self._run_forward(samples)
        deaf = (math.inf if elder_ns is None else elder_ns, math.inf)
        self.backward = _Pass(tuning, deaf, self._direction())
        self.backward._way = -1.0
        if self.before:
            end_ns = max(self.before)
            self._run_backward([s for s in samples if s.boot_ns <= end_ns])

    def _run_forward(self, samples: Sequence[Sample]) -> None:
        one, told, due_ns = self.forward, list(self._told), 0
        for s in samples:
            while told and s.boot_ns > told[0][0]:
                one.settle()
                self._note()
                one.let_go(told.pop(0)[1])
                due_ns = 0
            if self._until_ns is not None and s.boot_ns > self._until_ns:
                self.foretold, self._until_ns = one.estimate(None), None
            blocks = len(one.seen)  # grows with each block
            one.step(s)
            if len(one.seen) > blocks and one.ends_ns[1] >= due_ns:
                self._note()
                due_ns = max(due_ns + _EVERY_NS, one.ends_ns[1] + _EVERY_NS // 2)
        if one.seen:
            self._note()

    def _direction(self) -> float | None:
        """Where magnetic north lies in the end, rad in the own frame, where that is known at all."""
        if self.forward.bank is None:
            return None
        mean, covariance = self.forward.bank.mixture()
        return float(mean[at.ALPHA]) if covariance[at.ALPHA, at.ALPHA] < _SURE_RAD**2 else None

    def _note(self) -> int:
        one = self.forward
        if one.bank is None or not one.seen:
            return 0
        at_ns = one.ends_ns[1]
        self.before.setdefault(at_ns, noted(one.bank))
        return at_ns

    def _run_backward(self, samples: Sequence[Sample]) -> None:
        one, told, due = self.backward, list(self._told), sorted(self.before)[:-1]
        for s in backwards(samples):
            while told and s.boot_ns <= told[-1][0]:
                one.let_go(told.pop()[1])
            if due and s.boot_ns == due[-1]:
                one.settle()
                carried = one.carried_to(s)
                if carried is not None:
                    self.after[due[-1]] = carried
                due.pop()
            one.step(s)

    def estimates(self) -> Iterator[tuple[int, Estimate | None]]:
        """Of each moment in turn, with all of the flight."""
        one, n = self.forward, self.forward.tuning
        begun = Bank.begun(self.backward.field, n) if self.after else None
        for at_ns in self._moments():
            bank = before = self.before[at_ns]
            if begun is not None and at_ns in self.after:
                after, heading = self.after[at_ns]
                bank = product(before, after, begun, n.temper, heading)
            yield at_ns, one.says(bank)

    def _moments(self) -> list[int]:
        """Of those noted some hundred, evenly; and those next to a change."""
        times = sorted(self.before)
        every = 1 + len(times) // _MOMENTS
        wanted = {*times[::every], *times[-1:]}
        for at_ns, _ in self._told:
            after = bisect_right(times, at_ns)
            wanted |= {*times[max(after - 1, 0) : after + 1]}
        return sorted(wanted)

    # ------------------------------------------------------------ sudden changes

    def changes(self) -> dict[int, float]:
        """Boot times right after which the iron changed, and how far to let it go, mG."""
        out: dict[int, float] = {}
        for from_ns, to_ns in self._windows():
            at_ns = self._place(from_ns, to_ns)
            jump_mg = None if at_ns is None else self._jump(at_ns)
            if at_ns is not None and jump_mg is not None:
                out[at_ns] = max(_LEAST_MG, _SHARE * jump_mg)
        return out

    @property
    def middle_ns(self) -> float:
        """Half of the flight is before it."""
        seen = self.forward.seen
        return 0.5 * (min(seen) + max(seen)) if seen else 0.0

    @property
    def startled(self) -> bool:
        """Did a side believe in a change while it knew less than the other?"""
        young = [to_ns for _, to_ns in self.forward.changed if to_ns < self.middle_ns]
        return bool(young or [from_ns for from_ns, _ in self.backward.changed if from_ns > self.middle_ns])

    def _windows(self) -> list[tuple[int, int]]:
        """Where to look: between the backward and the forward notice of one change, or where the elder noticed one."""
        alone = [from_ns for from_ns, _ in self.backward.changed]
        out = []
        for _, to_ns in self.forward.changed:
            partner = max((t for t in alone if 0 <= to_ns - t <= 2 * _LATE_NS), default=None)
            if partner is not None:
                alone.remove(partner)
                out.append((partner, to_ns))
            elif to_ns > self.middle_ns:
                out.append((to_ns - _LATE_NS, to_ns))
        return out + [(t, t + _LATE_NS) for t in alone if t < self.middle_ns]

    def _place(self, from_ns: int, to_ns: int) -> int | None:
        """The reading after which the forward bank is surprised, and before which the backward one."""
        here = [
            {t: square / usual for t, square in one.seen.items() if from_ns <= t <= to_ns}
            for one in (self.forward, self.backward)
            for usual in [float(np.median(list(one.seen.values()))) + 1e-9]
        ]
        fore, back = here

        def surprise(at_ns: int) -> float:
            return sum(v for t, v in fore.items() if t <= at_ns) + sum(v for t, v in back.items() if t > at_ns)

        return min(fore, key=surprise, default=None)

    def _jump(self, at_ns: int) -> float | None:
        """How far the iron before is from the iron after, mG; None where they may be the same."""
        early, late = (t for t in self.before if t <= at_ns), (t for t in self.after if t >= at_ns)
        first, then = max(early, default=None), min(late, default=None)
        if first is None or then is None:
            return None
        (x, p), (y, q) = self.before[first].mixture(), self.after[then][0].mixture()
        away = (y - x)[at.B]
        chi2 = float(away @ np.linalg.solve((p + q)[at.B, at.B], away))
        return math.hypot(*away.tolist()) if chi2 > _CLEAR else None
