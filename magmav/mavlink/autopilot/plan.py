"""From a hard iron to the change of stored offsets that takes it away, whatever the autopilot calls them."""

from __future__ import annotations

import numpy as np

from magmav.core.types import Change, Vec3
from magmav.mavlink.autopilot.stored import StoredCalibrations


def plan_change(
    held: StoredCalibrations,
    system: int,
    compass: int,
    hard_iron_b_mg: Vec3,
    sigma_mg: Vec3,
    write: tuple[bool, bool, bool],
) -> Change | None:
    """The change of stored offsets that this hard iron asks for, on the axes in ``write`` (body) only.

    None while stored offsets or device id are not known, where it is not clear which parameters are this compass's
    (S6), or when nothing would be written. Offsets are -b whatever scale, matrix and motor terms are: those act after.
    """
    old = held.offsets(compass)
    device_id = held.device_id(compass)
    if old is None or not held.known(compass) or not any(write) or not device_id or held.refuses(compass) is not None:
        return None
    wish = held.wish(compass, np.where(write, -hard_iron_b_mg, old), write)
    step = wish.left_b_mg - old
    matrix = held.shaping(compass).matrix
    shift = matrix @ step
    sigma = np.abs(matrix) @ np.where(write, sigma_mg, 0.0)
    return Change(
        system=system,
        compass=compass,
        device_name=wish.device_name,
        device_id=device_id,
        names=wish.names,
        old=wish.old,
        new=wish.new,
        shift_b_mg=(float(shift[0]), float(shift[1]), float(shift[2])),
        shift_sigma_mg=(float(sigma[0]), float(sigma[1]), float(sigma[2])),
        step_mg=tuple(abs(n - o) * held.unit_mg for o, n in zip(wish.old, wish.new, strict=True)),
    )
