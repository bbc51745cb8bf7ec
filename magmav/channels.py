"""Channels as the settings want them: one for every compass of a vehicle."""

from __future__ import annotations

import math
from collections.abc import Callable

from magmav.core import gate
from magmav.core.channel import Channel, Circumstances, Finding
from magmav.core.correction import stored_heading
from magmav.core.estimators import ESTIMATORS, Estimator, Idle
from magmav.core.heading import UNKNOWN
from magmav.core.types import Sample, Vec3
from magmav.settings import Settings


class IdleChannel(Channel):
    """Learns nothing: it finds that nothing is known, and why. That changes with the circumstances and nothing else."""

    def step(self, s: Sample, sent_b_mg: Vec3, c: Circumstances) -> Finding:
        """Judge by one sample, and the same value as the autopilot sent it; it stays the corrected one."""
        belief = self._believe(s, c)
        return Finding(
            belief.estimate,
            belief.offsets_mg,
            belief.sigma_mg,
            corrected_b_mg=sent_b_mg,
            heading=UNKNOWN,
            stored_heading=stored_heading(s, sent_b_mg, c.expected),
            verdict=self.verdict,
            coverage=0.0,
        )


def new_channel(settings: Settings, name: str | None = None, make: Callable[[], Estimator] | None = None) -> Channel:
    """One compass's channel.

    name : of the estimator, instead of that in the settings.  make : makes it, instead of ESTIMATORS.
    """
    return Channel(make or ESTIMATORS[name or settings.learn.estimator], limits(settings), settings.gate.steady_s)


def idle_channel(settings: Settings) -> Channel:
    """One that learns nothing."""
    return IdleChannel(Idle, limits(settings), settings.gate.steady_s)


def limits(settings: Settings) -> gate.Limits:
    """The gate's lines, in its own units."""
    g = settings.gate
    heading_rad = math.radians(g.heading_sigma_deg)
    return gate.Limits(g.axis_sigma_mg, heading_rad, g.residual_mg, g.field_share, g.change_s, g.samples)
