"""The heading where no attitude comes: the own yaw, moved by the calibrated compass and held by the gyro."""

from __future__ import annotations

import math
from dataclasses import replace

from magmav.core.channel import Finding
from magmav.core.motion import Motion
from magmav.core.rotation import wrap_pi, wrap_tau
from magmav.core.types import Sample, State

_DOUBTED_S = 5.0  # after a sudden change the answer is still on its way: the gyro holds the own yaw
_WRONG_RAD = math.radians(25.0)  # own yaw so far off is wrong: it is moved slowly and may have begun so


def steadied(s: Sample, f: Finding, motion: Motion) -> Finding:
    """Compass 1 moves the own yaw while it is believed, and that yaw is its heading.

    Own tilt and turning never hear of the compass, so nothing learnt with them confirms itself.
    """
    if s.tilt_from != "OWN" or s.compass != 1 or s.axes != 3 or not f.heading.valid:
        return f
    if f.verdict.state is not State.REFUSED and f.estimate.changed_ago_s >= _DOUBTED_S:
        motion.field(f.corrected_b_mg, s.age_s + f.estimate.delay_s, f.heading.sigma_rad)
    yaw, was = motion.magnetic_yaw(s.boot_ns), f.heading
    if yaw is None or abs(wrap_pi(yaw - was.magnetic_rad)) > _WRONG_RAD:
        return f
    true = wrap_tau(was.true_rad + yaw - was.magnetic_rad) if was.true_valid else 0.0
    return replace(f, heading=replace(was, magnetic_rad=yaw, true_rad=true))
