"""How time passes for every hypothesis at once: (K, n) states, (K, n, n) covariances, changed in place.

alpha grows by what the gyro's bias puts into the own frame about the vertical; tilt error and disturbance fade; iron,
field and the rest stay, give or take a slow walk.
"""

from __future__ import annotations

import math

from magmav.core.estimators.adaptive import layout as at
from magmav.core.estimators.adaptive.layout import Array
from magmav.core.estimators.adaptive.tuning import Tuning


def advance(
    x: Array,
    p: Array,
    dt_s: float,
    down_dt_b: Array,
    turn_rad2: float,
    tilt_rad: float,
    walk_mg: Array,
    disturbance_mg: Array,
    n: Tuning,
) -> None:
    """Carry all hypotheses over dt_s.

    down_dt_b : (3,) integral of the down direction in body axes over the step, s: what a gyro bias turns alpha by.
    turn_rad2 : variance of the turn the gyro reported.  walk_mg, disturbance_mg : (K,) of each hypothesis.
    """
    x[:, at.ALPHA] += x[:, at.G] @ down_dt_b
    p[:, at.ALPHA, :] += down_dt_b @ p[:, at.G, :]
    p[:, :, at.ALPHA] += p[:, :, at.G] @ down_dt_b
    tilt, short = math.exp(-dt_s / n.tilt_tau_s), math.exp(-dt_s / n.disturbance_tau_s)
    for part, fade in ((at.E, tilt), (at.D, short)):
        x[:, part] *= fade
        p[:, part, :] *= fade
        p[:, :, part] *= fade
    diagonal = p.reshape(len(p), -1)[:, :: at.SIZE + 1]
    diagonal[:, at.ALPHA] += turn_rad2
    diagonal[:, at.B] += (walk_mg**2 * dt_s)[:, None]
    diagonal[:, at.E] += (1.0 - tilt * tilt) * tilt_rad**2
    diagonal[:, at.D] += ((1.0 - short * short) * disturbance_mg**2)[:, None]
