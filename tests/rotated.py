"""The same flight seen by sensors that are mounted otherwise: what every estimator must not care about."""

from dataclasses import replace

import numpy as np
from synthetic_flight import turn

from magmav.core.types import Sample, vec3

MOUNTINGS = {"turned 90": turn(2, np.pi / 2), "askew": turn(0, 0.3) @ turn(1, -0.2) @ turn(2, 2.0)}


def remounted(samples: list[Sample], body_from_old: np.ndarray) -> list[Sample]:
    """Body axes turned by body_from_old, (3, 3): field, rates, tilt and turning all follow."""
    out, heading, before = [], 0.0, None
    for s in samples:
        heading = 0.0 if s.gap else heading + s.yaw_step_rad
        c = body_from_old @ turn(0, s.roll_rad) @ turn(1, s.pitch_rad) @ turn(2, heading)
        yaw = float(np.arctan2(c[0, 1], c[0, 0]))
        step = 0.0 if before is None or s.gap else float((yaw - before + np.pi) % (2 * np.pi) - np.pi)
        before = yaw
        out.append(
            replace(
                s,
                mag_b_mg=vec3(body_from_old @ s.mag_b_mg, "field"),
                rate_b_rads=vec3(body_from_old @ s.rate_b_rads, "rate"),
                roll_rad=float(np.arctan2(c[1, 2], c[2, 2])),
                pitch_rad=float(-np.arcsin(c[0, 2])),
                yaw_step_rad=step,
            )
        )
    return out
