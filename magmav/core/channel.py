"""One compass from Sample to answer: estimator, excitation, heading and gate, and the short memory they need."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from magmav.core import gate
from magmav.core.correction import (
    corrected_field,
    covariance_of_field,
    field_of,
    iron_of_offsets,
    published,
    stored_heading,
    turned_on,
)
from magmav.core.estimators import Estimator, Idle
from magmav.core.excitation import Excitation
from magmav.core.field import ExpectedField
from magmav.core.heading import UNKNOWN, heading_sigma, level_field, magnetic_heading
from magmav.core.steadiness import Stood, Worsening
from magmav.core.types import ZERO3, AxisState, Estimate, Heading, Mat3, Reason, Sample, State, Vec3, Verdict, vec3

_TILT_SIGMA_RAD = math.radians(0.7)  # of an autopilot's attitude in flight
_OWN_TILT_SIGMA_RAD = math.radians(2.0)  # of gyro and accelerometer alone, at least
_UPSET_S = 3.0  # after a sudden change no heading is published: its sigma is that of an answer on its way
_GUESS_RAD = math.radians(22.0)  # a heading less sure than this is not published: beyond it one sigma is no measure
_BELIEF_EVERY_NS = 200_000_000
_IDLE_EVERY_NS = 2_000_000_000  # where nothing is learnt only the circumstances change
_APART_S = 10.0  # a second opinion that doubts itself for a moment has not come to agree
_FIELD_WEIGHT = 0.04  # five times a second: a memory of five seconds


@dataclass(frozen=True, slots=True)
class Circumstances:
    """What the vehicle, rather than the compass, contributes to a verdict."""

    expected: ExpectedField | None
    relative: bool
    assumed: bool
    parameters_changed: bool
    grounded: bool
    frozen_s: float
    stored_b_mg: Vec3 | None = None  # the offsets a flying vehicle's autopilot holds, to be added


@dataclass(frozen=True, slots=True, eq=False)
class Finding:
    """What is known of one compass after one sample. offsets_mg are to be added by the autopilot (-hard iron)."""

    estimate: Estimate
    offsets_mg: Vec3
    sigma_mg: Vec3
    corrected_b_mg: Vec3
    heading: Heading
    stored_heading: Heading
    verdict: Verdict
    coverage: float


@dataclass(frozen=True, slots=True, eq=False)
class _Belief:
    """What the estimator said when it was last asked."""

    boot_ns: int
    estimate: Estimate
    offsets_mg: Vec3
    sigma_mg: Vec3
    heading_sigma_rad: float
    covariance_b_mg2: Mat3  # of the corrected field
    tilt_sigma_rad: float


_NO_ESTIMATE = Estimate(ZERO3, np.diag([1e6] * 3), vec3([1e3] * 3, "sigma"), 0.0, 0.0, 0.0, 1.0, 0, 1e9)


class Channel:
    """Learns one compass. ``hold`` keeps the answer as it is while samples go on being judged by it."""

    def __init__(
        self,
        make: Callable[[], Estimator],
        limits: gate.Limits,
        steady_s: float,
    ) -> None:
        self._make = make
        self.limits = limits
        self.steady_s = steady_s
        self.held = False
        self.restart()

    @property
    def keeps(self) -> bool:
        """On hold with an answer: the sensor's own iron does not change with what the autopilot stores."""
        return self.held and self._estimate is not None

    @property
    def estimate(self) -> Estimate:
        """What is believed; when nothing is, zero with a sigma as wide as the world."""
        return self._estimate or _NO_ESTIMATE

    def restart(self) -> None:
        """Begin again: what was learnt belongs to another stretch of data."""
        self.verdict = gate.NOTHING
        self._estimator = self._make()
        self._apart, self._apart_ns = 0.0, 0  # sigmas between two opinions, as they lately were
        self._tilt2 = 0.0  # mean square of sin(tilt) where it was learnt
        self._excitation = Excitation()
        self._estimate: Estimate | None = None
        self._past: deque[tuple[int, Vec3]] = deque()
        self._field_mg = self._level_mg = 0.0
        self._belief: _Belief | None = None
        self._resume = False
        self._stood, self._worsening = Stood(), Worsening()

    def step(self, s: Sample, sent_b_mg: Vec3, c: Circumstances) -> Finding:
        """Take one sample, and the same value as the autopilot sent it."""
        belief = self.learn(s, c)
        e = belief.estimate
        corrected = corrected_field(s, e, c.expected)
        now = UNKNOWN
        if self._estimate is not None and belief.heading_sigma_rad < _GUESS_RAD and e.changed_ago_s > _UPSET_S:
            then = published(
                s,
                corrected,
                e.horizontal_mg,
                belief.covariance_b_mg2,
                belief.heading_sigma_rad,
                belief.tilt_sigma_rad,
                c.expected,
            )
            now = turned_on(s, e.delay_s, then)
        return Finding(
            estimate=e,
            offsets_mg=belief.offsets_mg,
            sigma_mg=belief.sigma_mg,
            corrected_b_mg=corrected,
            heading=now,
            stored_heading=stored_heading(s, sent_b_mg, c.expected),
            verdict=self.verdict,
            coverage=self._excitation.coverage,
        )

    def learn(self, s: Sample, c: Circumstances) -> _Belief:
        """Take one sample without making a heading of it; what is believed after it."""
        if self.held:
            self._resume = True
        else:
            s = self._after_hold(s)
            self._estimator.step(s)
        belief = self._belief
        every_ns = _IDLE_EVERY_NS if isinstance(self._estimator, Idle) else _BELIEF_EVERY_NS
        if belief is None or not 0 <= s.boot_ns - belief.boot_ns < every_ns:
            belief = self._believe(s, c)
        return belief

    def _believe(self, s: Sample, c: Circumstances) -> _Belief:
        """Ask the estimator and judge its answer; a few times a second is often enough."""
        if not self.held and (s.learn or self._estimate is None):
            self._estimate = self._estimator.estimate(c.expected)
        e = self.estimate
        if s.learn and self._estimate is not None:
            self._follow(s, e, c.expected)
        sigma = gate.floored(e)
        horizontal, down = field_of(e, c.expected)
        covariance = covariance_of_field(s, e)
        tilt_sigma = _TILT_SIGMA_RAD if s.tilt_from == "ATTITUDE" else max(_OWN_TILT_SIGMA_RAD, s.own_tilt_rad)
        self._belief = _Belief(
            s.boot_ns,
            e,
            vec3(-iron_of_offsets(s, e, c.expected), "offsets"),
            sigma,
            heading_sigma(covariance, horizontal, down, s.roll_rad, s.pitch_rad, tilt_sigma),
            covariance,
            tilt_sigma,
        )
        self._judge(s, c, sigma, heading_sigma(covariance, horizontal, down, 0.0, 0.0, 0.0))
        return self._belief

    def _after_hold(self, s: Sample) -> Sample:
        if not self._resume:
            return s
        self._resume = False
        return replace(s, gap=True, yaw_step_rad=0.0)

    def _follow(self, s: Sample, e: Estimate, expected: ExpectedField | None) -> None:
        """Remember what has been seen, how strong the field is, and where the estimate was."""
        corrected = corrected_field(s, e, expected)
        self._excitation.see(corrected, magnetic_heading(corrected, s.roll_rad, s.pitch_rad))
        field_mg = math.hypot(*corrected.tolist())
        weight = _FIELD_WEIGHT if self._field_mg else 1.0
        self._field_mg += weight * (field_mg - self._field_mg)
        upright = math.cos(s.roll_rad) * math.cos(s.pitch_rad)
        self._tilt2 += weight * (1.0 - upright * upright - self._tilt2)
        since_s = max(s.boot_ns - self._apart_ns, 0) / 1e9
        self._apart, self._apart_ns = max(e.apart, self._apart * math.exp(-since_s / _APART_S)), s.boot_ns
        level_mg = math.hypot(*level_field(corrected, s.roll_rad, s.pitch_rad))
        self._level_mg += weight * (level_mg - self._level_mg)
        if not self._past or s.boot_ns - self._past[-1][0] >= 1_000_000_000:
            self._past.append((s.boot_ns, e.hard_iron_b_mg))
        while len(self._past) > 1 and s.boot_ns - self._past[1][0] >= self.steady_s * 1e9:
            self._past.popleft()

    def _steady(self, boot_ns: int, e: Estimate, sigma_mg: Vec3) -> bool:
        if not self._past or boot_ns - self._past[0][0] < self.steady_s * 1e9 * 0.9:
            return False
        states = gate.axis_states(e.own_sigma_mg, sigma_mg, self.limits.axis_sigma_mg)
        moved = np.abs(e.hard_iron_b_mg - self._past[0][1]) <= 2.0 * sigma_mg + 3.0
        x, y, z = moved.tolist()
        return bool(x and y and (z or states[2] is AxisState.NOT_OBSERVED))

    def _left(self, e: Estimate | None, c: Circumstances, sigma_mg: Vec3) -> float:
        """What the tilt would make, level, of a down axis that stays as it is stored, mG; 0 where it is written."""
        if e is None or c.stored_b_mg is None or sigma_mg[2] <= self.limits.axis_sigma_mg:
            return 0.0
        off = max(abs(float(c.stored_b_mg[2] + e.hard_iron_b_mg[2])) - float(sigma_mg[2]), 0.0)
        return math.sqrt(max(self._tilt2, 0.0)) * off

    def _judge(self, s: Sample, c: Circumstances, sigma_mg: Vec3, offsets_sd: float) -> None:
        e = self._estimate
        steady = self.held or (self.verdict.state is State.READY and not s.learn)
        evidence = gate.Evidence(
            estimate=e,
            expected=c.expected,
            sigma_mg=sigma_mg,
            offsets_heading_sigma_rad=offsets_sd,
            field_mg=self._field_mg,
            level_mg=self._level_mg,
            apart=self._apart,
            left_mg=self._left(e, c, sigma_mg),
            steady=steady or (e is not None and self._steady(s.boot_ns, e, sigma_mg)),
            worse=e is not None and self._worsening.step(s.boot_ns, e.residual_mg),
            sectors=self._excitation.sectors,
            frozen_s=c.frozen_s,
            has_attitude=s.tilt_from == "ATTITUDE",
            relative=c.relative,
            assumed=c.assumed,
            parameters_changed=c.parameters_changed,
            grounded=c.grounded,
            axes=s.axes,
        )
        verdict = gate.judge(evidence, self.limits, self.verdict.state)
        stood = self._stood.step(s.boot_ns, verdict.state is State.READY)
        if verdict.state is State.READY and not (stood or self.held):
            verdict = Verdict(State.LEARNING, verdict.axes, (Reason.STILL_MOVING, *verdict.reasons))
        self.verdict = verdict
