"""Which of PX4's stored calibrations is a compass's: the slot whose CAL_MAGn_ID is its device id.

On a link no message says which device it is from. What does, see ``told_by`` and ``only_one``.
held : parameter name to value, as heard.
"""

from __future__ import annotations

from collections.abc import Mapping

from magmav.core.types import CalibrationReading, Vec3, vec3
from magmav.mavlink.autopilot.px4_names import AXES, SLOTS
from magmav.mavlink.float32 import float32

IDS = tuple(f"CAL_MAG{n}_ID" for n in SLOTS)
_INSIDE = frozenset({2, 4})  # bus types that never leave the board: SPI, and simulation


def slot_of(device_id: int, held: Mapping[str, float]) -> int | None:
    """The n whose CAL_MAGn_ID is this device, or None."""
    return next((n for n in SLOTS if device_id and held.get(f"CAL_MAG{n}_ID") == device_id), None)


def is_internal(device_id: int, held: Mapping[str, float]) -> bool:
    """Does this compass sit on the board? By its slot; without one, by its bus (an I2C one is taken for external)."""
    n = slot_of(device_id, held)
    mounting = None if n is None else held.get(f"CAL_MAG{n}_ROT")
    return device_id & 7 in _INSIDE if mounting is None else mounting < 0


def triple(held: Mapping[str, float], n: int, what: str, default: float) -> Vec3:
    return vec3([held.get(f"CAL_MAG{n}_{a}{what}", default) for a in AXES], what)


def told_by(r: CalibrationReading, held: Mapping[str, float]) -> int | None:
    """The device whose slot alone holds the offsets and the matrix PX4 says it applies; None where none or two do.

    MAG_CAL_REPORT counts compasses as SCALED_IMUn does, by uORB instance, and gives offsets in gauss
    (PX4 streams/MAG_CAL_REPORT.hpp, autopilots.md section 4.1).
    """
    said = tuple(map(float32, (*r.offsets, *r.matrix)))
    found = {held[name] for n, name in enumerate(IDS) if held.get(name) and _calibration(held, n) == said}
    return int(found.pop()) if len(found) == 1 else None


def _calibration(held: Mapping[str, float], n: int) -> tuple[float, ...]:
    parts = [triple(held, n, what, default) for what, default in (("OFF", 0.0), ("SCALE", 1.0), ("ODIAG", 0.0))]
    return tuple(float32(value) for part in parts for value in part)


def only_one(held: Mapping[str, float]) -> int | None:
    """The one device that any slot holds, once all slots were heard; or None. Says nothing where two compasses are."""
    devices = [held.get(name) for name in IDS]
    used = [int(device) for device in devices if device]
    return used[0] if None not in devices and len(used) == 1 else None
