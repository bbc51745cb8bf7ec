"""The change that a saved ``magmav replay --json`` asks for."""

from __future__ import annotations

from pathlib import Path

import msgspec

from magmav.core.types import AxisState, Change, ParamReading, State, vec3
from magmav.mavlink.autopilot.ardupilot import Calibrations
from magmav.mavlink.autopilot.plan import plan_change
from magmav.mavlink.autopilot.px4 import Px4Calibrations
from magmav.mavlink.autopilot.px4_slots import IDS
from magmav.mavlink.autopilot.stored import StoredCalibrations

_Three = tuple[float, float, float]


class SavedResultError(Exception):
    """A file that holds no result, or not the one asked for; the text names the file and what is missing."""


class NotReady(Exception):
    """A result that says itself that it must not be written; the text names the file and the reasons."""


class _Reason(msgspec.Struct):
    text: str


class _Compass(msgspec.Struct):
    compass: int
    state: str
    reasons: list[_Reason]
    hard_iron_mg: _Three | None = None
    sigma_mg: _Three | None = None
    axes: tuple[AxisState, AxisState, AxisState] = (AxisState.NOT_OBSERVED,) * 3
    stored: dict[str, float] = {}


class _Vehicle(msgspec.Struct):
    system: int
    compasses: list[_Compass]


class _Result(msgspec.Struct):
    vehicles: list[_Vehicle]


def change_from_result(path: Path, compass: int) -> Change:
    """Read the file and plan the change. Raises SavedResultError or NotReady."""
    try:
        result = msgspec.json.decode(path.read_bytes(), type=_Result)
    except OSError as error:
        raise SavedResultError(f"{path}: cannot be read: {error.strerror}") from None
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise SavedResultError(f"{path}: not what `magmav replay --json` prints: {error}") from None
    found = [(v, c) for v in result.vehicles for c in v.compasses if c.compass == compass]
    if len(found) != 1:
        raise SavedResultError(f"{path}: want one vehicle with compass {compass}, found {len(found)}")
    vehicle, entry = found[0]
    if entry.state != State.READY.name or entry.hard_iron_mg is None or entry.sigma_mg is None:
        why = "; ".join(r.text for r in entry.reasons) or entry.state
        raise NotReady(f"{path}: compass {compass} is not ready to be written: {why}")
    held = _held(vehicle.system, compass, entry.stored)
    x, y, z = (axis is not AxisState.NOT_OBSERVED for axis in entry.axes)
    iron, sigma = vec3(entry.hard_iron_mg, "hard_iron_mg"), vec3(entry.sigma_mg, "sigma_mg")
    change = plan_change(held, vehicle.system, compass, iron, sigma, (x, y, z))
    if change is None:
        raise NotReady(f"{path}: stored offsets or device id of compass {compass} are not in it")
    return change


def _held(system: int, compass: int, stored: dict[str, float]) -> StoredCalibrations:
    """What the vehicle stored, by the rules of the autopilot whose names these are."""
    devices = [int(stored[name]) for name in IDS if name in stored]
    held: StoredCalibrations = Px4Calibrations() if devices else Calibrations()
    for name, value in stored.items():
        held.param(ParamReading(system, 1, name, value, 65535, 0))
    if len(devices) == 1:
        held.sensor(compass, devices[0], "sensor_mag")
    return held
