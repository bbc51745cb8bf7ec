"""A fit as parameters in the autopilot's own names, and as the files that ground stations load.

Mission Planner and MAVProxy read lines of NAME,VALUE (.param, .parm). QGroundControl reads its own .params: comment
lines, then vehicle id, component id, name, value and type with tabs between (type 9: 32-bit float). A file holds only
what changes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from magmav.core.types import Vec3
from magmav.mavlink.autopilot.plan import plan_change
from magmav.mavlink.autopilot.stored import StoredCalibrations
from magmav.mavlink.float32 import float32, same

ARDUPILOT, PX4 = 3, 12  # MAV_AUTOPILOT
_REAL32 = 9  # MAV_PARAM_TYPE_REAL32
_AUTOPILOT = 1  # its component


@dataclass(frozen=True, slots=True)
class NewParameters:
    """Old and new values by name, exact 32-bit floats; old is None where it was not heard."""

    old: Mapping[str, float | None]
    new: Mapping[str, float]

    @property
    def changed(self) -> dict[str, float]:
        """What a file holds."""
        return {n: v for n, v in self.new.items() if (o := self.old.get(n)) is None or not same(v, o)}


NOTHING = NewParameters({}, {})


def offsets(
    held: StoredCalibrations, system: int, compass: int, iron_b_mg: Vec3, sigma_mg: Vec3, write: tuple[bool, bool, bool]
) -> NewParameters:
    """The offsets that take this iron away on the axes in ``write``; nothing where what is stored is not known."""
    change = plan_change(held, system, compass, iron_b_mg, sigma_mg, write)
    if change is None:
        return NOTHING
    return NewParameters(
        dict(zip(change.names, map(float32, change.old), strict=True)),
        dict(zip(change.names, map(float32, change.new), strict=True)),
    )


def number(value: float) -> str:
    """The shortest decimal number that is this 32-bit float."""
    return str(np.float32(value))


def as_param(changed: Mapping[str, float]) -> str:
    """Lines of NAME,VALUE."""
    return "".join(f"{name},{number(value)}\n" for name, value in changed.items())


def as_qgc(changed: Mapping[str, float], system: int, comments: Iterable[str] = ()) -> str:
    """QGroundControl's own format."""
    head = ["# Onboard parameters", "#", *(f"# {c}" for c in comments), "# Vehicle-Id Component-Id Name Value Type"]
    rows = [f"{system}\t{_AUTOPILOT}\t{name}\t{number(value)}\t{_REAL32}" for name, value in changed.items()]
    return "\n".join([*head, *rows]) + "\n"


def file_of(entry: Mapping[str, Any], suffix: str) -> str:
    """The text of a parameter file with every change of one log's entry.

    suffix : ".params" for QGroundControl, anything else NAME,VALUE. ValueError where two vehicles of the log change.
    """
    changes = {
        vehicle["system"]: {
            name: value
            for compass in vehicle["compasses"]
            if compass["fit"] is not None
            for name, value in compass["fit"]["parameters"]["changed"].items()
        }
        for vehicle in entry["vehicles"]
    }
    found = {system: changed for system, changed in changes.items() if changed}
    if len(found) > 1:
        raise ValueError(f"{entry['source']}: vehicles {sorted(found)} both change; one file is for one vehicle")
    system, changed = next(iter(found.items()), (1, {}))
    if suffix == ".params":
        return as_qgc(changed, system, [f"magmav fit of {entry['source']}"])
    return as_param(changed)
