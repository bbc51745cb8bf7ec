"""An estimator over a tape: Channel, gate and cause finder as the service has them, every belief kept.

This is what Vehicle does with a Sample, without headings and records: the same beliefs at the same moments (five times
a second), the same verdicts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from magmav.channels import limits, new_channel
from magmav.core import gate
from magmav.core.causes import Causes
from magmav.core.channel import Channel
from magmav.core.correction import iron_of_offsets
from magmav.core.estimators import ESTIMATORS, Estimator
from magmav.core.types import ZERO3, AxisState, CurrentReading, Estimate, State, ThrottleReading, Vec3
from real_bench.tapes import Heard, Tape

Make = Callable[[], Estimator]


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """What was believed of one compass from a boot time on, s. flown_s : seconds in the air until then."""

    boot_s: float
    flown_s: float
    flying: bool
    estimate: Estimate
    sigma_mg: Vec3
    heading_sigma_rad: float  # at the tilt it had, tilt error included
    state: State
    reasons: tuple[str, ...]

    @property
    def known(self) -> bool:
        """Was there an answer at all?"""
        return self.estimate.samples > 0


def run(tape: Tape, make: Make | str) -> dict[int, list[Moment]]:
    """By compass, what an estimator believed over time. make : a name in ESTIMATORS, or something that makes one."""
    name, made = (make, ESTIMATORS[make]) if isinstance(make, str) else ("adaptive", make)
    channels: dict[int, Channel] = {}
    stretches: dict[int, tuple[int, int]] = {}
    flown: dict[int, float] = {}
    out: dict[int, list[Moment]] = {}
    last: dict[int, tuple[object, State]] = {}
    causes = Causes()
    for event in tape.events:
        if isinstance(event, ThrottleReading):
            causes.throttle(event.share)
            continue
        if isinstance(event, CurrentReading):
            causes.current(event.ampere)
            continue
        s, c, compass = event.sample, event.circumstances, event.sample.compass
        channel = channels.get(compass)
        if channel is None:
            channel = channels[compass] = new_channel(tape.settings, name, made)
        elif stretches[compass] != event.stretch:
            channel.restart()
            causes.restart(compass)
        stretches[compass] = event.stretch
        belief = channel.learn(s, c)
        causes.step(s, belief.estimate, c.expected, event.used_b_mg, c.grounded)
        flying = s.learn and s.boot_ns / 1e9 >= tape.started_s  # what is turned by hand before that teaches too
        flown[compass] = flown.get(compass, 0.0) + (min(s.dt_s, 1.0) if flying else 0.0)
        state, reasons = channel.verdict.state, tuple(r.name for r in channel.verdict.reasons)
        refused = causes.refuses(compass)
        if refused is not None and state is not State.NO_DATA:
            state, reasons = State.REFUSED, (refused.name, *reasons)
        if last.get(compass) != (belief, state):
            last[compass] = (belief, state)
            boot_s = s.boot_ns / 1e9
            moment = Moment(
                boot_s,
                flown[compass],
                flying,
                belief.estimate,
                belief.sigma_mg,
                belief.heading_sigma_rad,
                state,
                reasons,
            )
            out.setdefault(compass, []).append(moment)
    return out


def before(moments: list[Moment], boot_s: float) -> Moment | None:
    """The last belief at or before a boot time, with an answer; None where there was none."""
    got = None
    for m in moments:
        if m.boot_s > boot_s:
            break
        got = m
    return got if got is not None and got.known else None


def offsets_to_store(tape: Tape, compass: int, e: Estimate) -> Vec3:
    """What a replay frozen at this estimate calls the compass's offsets at its end, (3,) mG, to be added."""
    end = next(h for h in reversed(tape.events) if isinstance(h, Heard) and h.sample.compass == compass)
    offsets = -iron_of_offsets(end.sample, e, end.circumstances.expected)
    sigma = gate.floored(e)
    axes = gate.axis_states(e.own_sigma_mg, sigma, limits(tape.settings).axis_sigma_mg)
    stored = tape.boot.calibrations.offsets(compass)
    unknown = [axis is AxisState.NOT_OBSERVED for axis in axes]
    return np.where(unknown, ZERO3 if stored is None else stored, offsets)
