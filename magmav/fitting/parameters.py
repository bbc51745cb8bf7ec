"""A fit as parameters in the autopilot's own names, and as the files that ground stations load.

Mission Planner and MAVProxy read lines of NAME,VALUE (.param, .parm). QGroundControl reads its own .params: comment
lines, then vehicle id, component id, name, value and MAV_PARAM_TYPE with tabs between. It leaves out, with a message,
what has another type on the vehicle, and takes no file of another system id (its ParameterManager.cc); so what the
autopilot holds as a whole number is written as one. A file holds only what changes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magmav.core.types import ParamReading, Vec3, vec3
from magmav.fitting.case import Case
from magmav.fitting.terms import Terms
from magmav.mavlink.autopilot.ardupilot import Calibrations
from magmav.mavlink.autopilot.plan import plan_change
from magmav.mavlink.autopilot.px4 import Px4Calibrations
from magmav.mavlink.autopilot.px4_names import MG_PER_GAUSS
from magmav.mavlink.autopilot.stored import StoredCalibrations
from magmav.mavlink.float32 import float32, same

ARDUPILOT, PX4 = 3, 12  # MAV_AUTOPILOT
_REAL32 = 9  # MAV_PARAM_TYPE_REAL32
_WHOLE = {"COMPASS_MOTCT": 2, "CAL_MAG_COMP_TYP": 6}  # of what is ever written: MAV_PARAM_TYPE_INT8 and _INT32
_AUTOPILOT = 1  # its component
_MOTCT = "COMPASS_MOTCT"
_LEAST_SCALE, _MOST_SCALE = 1.0 / 1.5, 1.5  # ArduPilot leaves out a scale beyond

Floats = NDArray[np.float64]


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


def shaped(case: Case, t: Terms) -> NewParameters | None:
    """Matrix and motor terms beside the offsets; None where this autopilot cannot hold them."""
    held = case.told.boot.calibrations
    x = held.names(case.compass)[0]
    a, bend = case.matrix, t.bend
    level = bend @ a
    level = 0.5 * (level + level.T)  # what it turns by is no soft iron, and cannot be stored
    return _ardupilot(held, x, level, t) if x.startswith("COMPASS") else _px4(held, case.compass, x, level, t)


def _ardupilot(held: StoredCalibrations, x: str, matrix: Floats, t: Terms) -> NewParameters | None:
    """DIA, ODI and SCALE multiply, MOT is added last (autopilots.md section 2.1)."""
    name = {w: [x.replace("OFS", w)[:-1] + axis for axis in "XYZ"] for w in ("DIA", "ODI", "MOT")}
    scale = x.replace("OFS", "SCALE")[: -len("_X")]
    held_scale = held.value(scale) or 0.0
    factor = held_scale if _LEAST_SCALE <= held_scale <= _MOST_SCALE else 1.0
    new: dict[str, float] = {}
    if np.any(t.bend != np.eye(3)):
        if t.scale is not None and t.scale["earned"]:
            wanted = factor * float(t.scale["factor"])
            if not _LEAST_SCALE <= wanted <= _MOST_SCALE:
                return None
            new[scale] = factor = float32(wanted)
        inner = matrix / factor
        new |= dict(zip(name["DIA"], np.diag(inner).tolist(), strict=True))
        new |= dict(zip(name["ODI"], (inner[0, 1], inner[0, 2], inner[1, 2]), strict=True))
    mode, of = held.value(_MOTCT) or 0.0, {"throttle": 1.0, "current": 2.0}.get(t.of or "")
    old = np.array([held.value(n) or 0.0 for n in name["MOT"]])
    if of is not None:
        if mode not in (0.0, of):
            return None
        kept = old if mode == of else np.zeros(3)
        new |= dict(zip(name["MOT"], (t.bend @ (kept - t.per_unit_mg)).tolist(), strict=True))
        new[_MOTCT] = of
    elif mode and old.any():
        new |= dict(zip(name["MOT"], (t.bend @ old).tolist(), strict=True))
    return _of(held, new)


def _px4(held: StoredCalibrations, compass: int, x: str, matrix: Floats, t: Terms) -> NewParameters | None:
    """SCALE and ODIAG multiply in the sensor's axes; COMP is added first, in gauss (autopilots.md section 4.2)."""
    stem = x[: len("CAL_MAG0_")]
    turn = np.column_stack([held.undo(compass, vec3(e, "axis"), "sensor_mag") for e in np.eye(3)])
    new: dict[str, float] = {}
    if np.any(t.bend != np.eye(3)):
        inner = turn.T @ matrix @ turn
        new |= dict(zip([f"{stem}{a}SCALE" for a in "XYZ"], np.diag(inner).tolist(), strict=True))
        if held.value(f"{stem}XODIAG") is None:
            return None  # a release that has no such parameter
        new |= dict(zip([f"{stem}{a}ODIAG" for a in "XYZ"], (inner[0, 1], inner[0, 2], inner[1, 2]), strict=True))
    if t.of is not None:
        kind, unit = {"throttle": (1.0, 1.0), "current": (2.0, 1000.0)}[t.of]
        mode = held.value("CAL_MAG_COMP_TYP")
        if mode is None or mode not in (0.0, kind):
            return None
        names = [f"{stem}{a}COMP" for a in "XYZ"]
        old = np.array([held.value(n) or 0.0 for n in names]) if mode == kind else np.zeros(3)
        added = turn.T @ np.linalg.solve(held.shaping(compass).matrix, t.per_unit_mg) * unit / MG_PER_GAUSS
        new |= dict(zip(names, (old - added).tolist(), strict=True))
        new["CAL_MAG_COMP_TYP"] = kind
    return _of(held, new)


def _of(held: StoredCalibrations, new: Mapping[str, float]) -> NewParameters:
    old = {n: None if (v := held.value(n)) is None else float32(v) for n in new}
    return NewParameters(old, {n: float32(v) for n, v in new.items()})


def both(one: NewParameters, other: NewParameters) -> NewParameters:
    """All of them."""
    return NewParameters({**one.old, **other.old}, {**one.new, **other.new})


def as_the_autopilot_would(
    autopilot: int, compass: int, device_id: int, values: Mapping[str, float], sensor_b_mg: Floats,
    ampere: Floats, throttle: Floats,
) -> Floats:  # fmt: skip
    """(N, 3) mG corrected with these stored values, by the rules of this MAV_AUTOPILOT; power (N,), 0 where unknown."""
    held: StoredCalibrations = Px4Calibrations() if autopilot == PX4 else Calibrations()
    for name, value in values.items():
        held.param(ParamReading(1, 1, name, value, 65535, 0))
    held.sensor(compass, device_id, "sensor_mag" if autopilot == PX4 else "RAW_IMU")
    held.armed(True)
    held.throttle(0.0)
    held.current(0.0)
    offsets, shaping = held.offsets(compass), held.shaping(compass)
    base = np.zeros(3) if offsets is None else offsets
    held.throttle(1.0)
    held.current(1.0)
    per_unit = held.shaping(compass).motor_b_mg
    current = held.value("COMPASS_MOTCT") == 2.0 or held.value("CAL_MAG_COMP_TYP") in (2.0, 3.0)
    power = np.nan_to_num(ampere if current else throttle)
    return np.asarray((sensor_b_mg + base) @ shaping.matrix.T + power[:, None] * per_unit)


def number(name: str, value: float) -> str:
    """The shortest decimal number that is this 32-bit float; no point in it where the parameter is a whole number."""
    return str(int(value)) if name in _WHOLE else str(np.float32(value))


def as_param(changed: Mapping[str, float]) -> str:
    """Lines of NAME,VALUE."""
    return "".join(f"{name},{number(name, value)}\n" for name, value in changed.items())


def as_qgc(changed: Mapping[str, float], system: int, comments: Iterable[str] = ()) -> str:
    """QGroundControl's own format. A comment stays one line, whatever a file is called."""
    said = ("".join(c if c.isprintable() else "?" for c in comment) for comment in comments)
    head = [f"# Onboard parameters for Vehicle {system}", "#", *(f"# {c}" for c in said), "#"]
    head.append("# Vehicle-Id Component-Id Name Value Type")
    rows = [
        f"{system}\t{_AUTOPILOT}\t{name}\t{number(name, value)}\t{_WHOLE.get(name, _REAL32)}"
        for name, value in changed.items()
    ]
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
