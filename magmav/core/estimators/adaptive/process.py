"""How time passes for every hypothesis at once: (K, n) states, (K, n, n) covariances, changed in place.

alpha grows by what the gyro's bias puts into the own frame about the vertical; tilt error and disturbance fade; iron,
field and the rest stay, give or take a slow walk.
"""

from __future__ import annotations

import math

import numpy as np

from magmav.core.estimators.adaptive import layout as at
from magmav.core.estimators.adaptive.bank import Bank
from magmav.core.estimators.adaptive.layout import Array
from magmav.core.estimators.adaptive.tuning import Tuning

_ONES = np.ones(at.SIZE)


def advance(bank: Bank, dt_s: float, down_s: Array, turn_rad2: float, own_tilt_rad: float | None, n: Tuning) -> None:
    """Carry all hypotheses over dt_s.

    down_s : (3,) integral of the down direction in body axes over the step, s: what a gyro bias turns alpha by.
    turn_rad2 : variance of the turn the gyro reported.  own_tilt_rad : sigma of the tilt
    where it is that of gyro and accelerometer alone, else None.
    """
    x, p = bank.x, bank.p
    x[:, at.ALPHA] += x[:, at.G] @ down_s
    turning = p[:, at.ALPHA] + down_s @ p[:, at.G]
    turning[:, at.ALPHA] += turning[:, at.G] @ down_s
    p[:, at.ALPHA] = p[:, :, at.ALPHA] = turning
    tilt_rad, tilt_tau_s = n.tilt_rad, n.tilt_tau_s
    if own_tilt_rad is not None:
        tilt_rad, tilt_tau_s = min(n.own_tilt_doubt * own_tilt_rad, n.own_tilt_most_rad), n.own_tilt_tau_s
    tilt, short = math.exp(-dt_s / tilt_tau_s), math.exp(-dt_s / n.disturbance_tau_s)
    fade = _ONES.copy()
    fade[at.E], fade[at.D] = tilt, short
    x *= fade
    p *= fade[:, None] * fade
    diagonal = np.einsum("kii->ki", p)
    diagonal[:, at.ALPHA] += turn_rad2
    diagonal[:, at.B] += (bank.walk_mg**2 * dt_s)[:, None]
    diagonal[:, at.E] += (1.0 - tilt * tilt) * tilt_rad**2
    diagonal[:, at.D] += ((1.0 - short * short) * bank.disturbance_mg**2)[:, None]
