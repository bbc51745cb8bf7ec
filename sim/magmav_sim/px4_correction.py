"""PX4's compass correction: body = R S (sensor + COMP power - OFF), gauss, OFF in sensor axes and subtracted.

(autopilots.md 4.2.) A sensor uses the slot whose CAL_MAGn_ID is its device id, whatever the order.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from magmav_sim.faults import Vector
from magmav_sim.mounting import MOST, rotation_matrix, turned
from magmav_sim.parameters import Parameters
from magmav_sim.px4_table import SLOTS

_CUSTOM, _BOARD = 100, -1
_MG = 1e3
_KILO = 1e3


class Px4Correction(NamedTuple):
    """The stored correction of one compass. rotation and scale (3, 3), the rest (3,) gauss, sensor axes."""

    rotation: np.ndarray
    scale: np.ndarray
    offset_g: np.ndarray
    comp: np.ndarray
    power_by: int  # CAL_MAG_COMP_TYP: 0 nothing, 1 throttle while armed, 2 and 3 current in kA

    def apply(self, sensor_mg: Vector, throttle: float, ampere: float) -> Vector:
        """The field PX4 publishes as vehicle_magnetometer, mG, body axes."""
        power = throttle if self.power_by == 1 else ampere / _KILO if self.power_by in (2, 3) else 0.0
        gauss = np.array(sensor_mg) / _MG + power * self.comp - self.offset_g
        x, y, z = (self.rotation @ (self.scale @ gauss) * _MG).tolist()
        return x, y, z

    def left_over_mg(self, hard_iron_b_mg: Vector, mounting: np.ndarray) -> np.ndarray:
        """(3,) mG, body axes: what of the sensor's hard iron the offsets do not take away; ``mounting`` is the true
        sensor-to-body rotation."""
        sensor_g = mounting.T @ np.array(hard_iron_b_mg) / _MG
        return np.asarray(self.rotation @ self.scale @ (sensor_g - self.offset_g) * _MG)

    def offset_for(self, bias_b_mg: np.ndarray) -> np.ndarray:
        """(3,) gauss: the offsets that take this bias of the published field away (BiasCorrectedSensorOffset)."""
        return np.asarray(self.offset_g + np.linalg.solve(self.scale, self.rotation.T @ bias_b_mg / _MG))


def slot_of(table: Parameters, device_id: int) -> int | None:
    """The slot that names this device; None: it is not calibrated."""
    slots = (n for n in range(SLOTS) if device_id and int(table[f"CAL_MAG{n}_ID"]) == device_id)
    return next(slots, None)


def triple(table: Parameters, slot: int, stem: str) -> np.ndarray:
    """(3,) CAL_MAGn_X.., _Y.., _Z.. of one stem."""
    return np.array([table[f"CAL_MAG{slot}_{axis}{stem}"] for axis in "XYZ"])


def stored(table: Parameters, device_id: int, *, external: bool) -> Px4Correction:
    """What the parameters say for a sensor."""
    slot = slot_of(table, device_id)
    by = int(table["CAL_MAG_COMP_TYP"])
    rotation = _rotation(table, slot, external=external)
    if slot is None:
        return Px4Correction(rotation, np.eye(3), np.zeros(3), np.zeros(3), by)
    scale = np.diag(triple(table, slot, "SCALE"))
    for value, (i, j) in zip(triple(table, slot, "ODIAG"), ((0, 1), (0, 2), (1, 2)), strict=True):
        scale[i, j] = scale[j, i] = value
    return Px4Correction(rotation, scale, triple(table, slot, "OFF"), triple(table, slot, "COMP"), by)


def _rotation(table: Parameters, slot: int | None, *, external: bool) -> np.ndarray:
    """CAL_MAGn_ROT, or the board's for an internal compass; the level adjustment on top of either."""
    number = _BOARD if slot is None else int(table[f"CAL_MAG{slot}_ROT"])
    if slot is None and external:
        number = 0
    level = np.array(turned(*(table[f"SENS_BOARD_{axis}_OFF"] for axis in "XYZ")))
    if number == _BOARD:
        return np.asarray(level @ _matrix(int(table["SENS_BOARD_ROT"])))
    if number == _CUSTOM:
        own = np.array(turned(*(table[f"CAL_MAG{slot}_{angle}"] for angle in ("ROLL", "PITCH", "YAW"))))
    else:
        own = _matrix(number)
    return np.asarray(level @ own)


def _matrix(number: int) -> np.ndarray:
    return np.array(rotation_matrix(number, "px4")) if 0 <= number <= MOST else np.eye(3)


def moved(new: np.ndarray, old: np.ndarray) -> float:
    """Length of the change, gauss."""
    return math.sqrt(math.fsum((new - old) ** 2))
