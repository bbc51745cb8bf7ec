"""Is the compass mounted as the autopilot believes? What the causes found, as an orientation to set."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from magmav.core.causes import Cause
from magmav.core.orientation import ARDUPILOT, MAVLINK, PX4, rotation
from magmav.mavlink.autopilot.stored import StoredCalibrations

_ARDUPILOT_NAMES = {1: "COMPASS_ORIENT", 2: "COMPASS_ORIENT2", 3: "COMPASS_ORIENT3"}


def describe(
    causes: Sequence[Cause], held: StoredCalibrations, compass: int, parameters: Mapping[str, float]
) -> dict[str, Any]:
    """stored_orientation, and found: None, or rotation (a name, or None where no right angle fits), angle, text.

    Where the stored orientation is known, ``set`` says which parameter should hold which number instead.
    """
    name, table = orientation_parameter(held, compass)
    value = parameters.get(name)
    known = table.get(int(value)) if value is not None and value >= 0 else None
    stored = None if value is None else {"name": name, "value": value, "means": None if known is None else known.name}
    found = next((c for c in causes if c.code.startswith("MOUNTED")), None)
    if found is None:
        return {"stored_orientation": stored, "found": None}
    turned = found.figure.get("orientation")
    out: dict[str, Any] = {
        "rotation": turned,
        "angle_deg": round(float(found.figure["turn_deg"]), 2),
        "sigma_deg": round(float(found.figure["sigma_deg"]), 2),
        "text": found.text,
        "set": None,
    }
    if turned is not None and known is not None and value is not None:
        out["set"] = _set(name, table, int(value), str(turned))
    return {"stored_orientation": stored, "found": out}


def orientation_parameter(held: StoredCalibrations, compass: int) -> tuple[str, Mapping[int, Any]]:
    """Which parameter holds a compass's orientation, and what its numbers mean."""
    offset = held.names(compass)[0]
    if offset.startswith("CAL_MAG"):
        return f"{offset[: len('CAL_MAG0_')]}ROT", PX4
    if offset.startswith("COMPASS_"):
        number = offset[len("COMPASS_OFS")]
        return _ARDUPILOT_NAMES[1 if number == "_" else int(number)], ARDUPILOT
    return f"{offset[: len('COMPASS1')]}_ORIENT", ARDUPILOT


def _set(name: str, table: Mapping[int, Any], stored: int, turned: str) -> dict[str, Any] | None:
    """The number that takes the sensor's axes to where they truly are: the turn comes on top of what is set."""
    turn = next(rotation(n) for n, o in MAVLINK.items() if o.name == turned)
    wanted = turn @ rotation(stored, table)
    for number, o in table.items():
        if np.allclose(rotation(number, table), wanted, atol=math.radians(1.0)):
            return {"name": name, "value": number, "means": o.name}
    return None
