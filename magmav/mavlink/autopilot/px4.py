"""PX4's compass calibration: its parameters, its order of correction, and the way back.

    c1 = raw + power * COMP   gauss, the sensor's own axes; power is throttle while armed, or battery current in kA
    c2 = c1 - OFF             subtracted
    c3 = S c2                 S = [[XSCALE, XODIAG, YODIAG], [XODIAG, YSCALE, ZODIAG], [YODIAG, ZODIAG, ZSCALE]]
    used = R c3               into body axes
(autopilots.md section 4.2, read in PX4's sensor_calibration/Magnetometer.hpp.) In body axes that is the same as
R S R^T (R raw - R OFF) + R S COMP power, so OFS = -1000 R OFF and the matrix R S R^T are what ArduPilot would hold.

R is the board's mounting for an internal compass (CAL_MAGn_ROT -1), the compass's own for an external one. The small
turn SENS_BOARD_X_OFF and its kin comes on top: always for an internal compass, for an external one since the releases
that know CAL_MAGn_XODIAG.

The number n in a name says nothing: a sensor uses the slot whose CAL_MAGn_ID is its device id. Which streams are
corrected: ``sensor_mag`` is the sensor's own, in its own axes; ``vehicle_magnetometer`` and the field in the
``sensor_combined`` of old logs went through all of the above. What comes by MAVLink does not say which device it is
from, and may have EKF2's bias taken off as well (section 4.1), as a logged ``vehicle_magnetometer less bias`` has
PX4's other estimate: these are left as they came, and results are changes only.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from magmav.core.orientation import CUSTOM, PX4, body_from_sensor, rotation
from magmav.core.types import IDENTITY3, NO_SHAPING, ZERO3, Mat3, ParamReading, Shaping, Vec3, mat3, vec3
from magmav.mavlink.autopilot.stored import invertible, only_offsets_moved

SLOTS = (0, 1, 2, 3)
RAW = "sensor_mag"
CORRECTED = frozenset({"vehicle_magnetometer", "sensor_combined"})
_AXES = ("X", "Y", "Z")
_MG_PER_GAUSS = 1000.0
_BY_THROTTLE, _BY_CURRENT, _BY_SECOND_CURRENT = 1, 2, 3
_INSIDE = frozenset({2, 4})  # bus types that never leave the board: SPI, and simulation
_OURS = re.compile(r"CAL_MAG\d_\w+|CAL_MAG_\w+|SENS_BOARD_\w+")
_COMMON = ("SENS_BOARD_ROT", "SENS_BOARD_X_OFF", "SENS_BOARD_Y_OFF", "SENS_BOARD_Z_OFF", "CAL_MAG_COMP_TYP")


def slot_of(device_id: int, held: Mapping[str, float]) -> int | None:
    """The n whose CAL_MAGn_ID is this device, or None."""
    return next((n for n in SLOTS if device_id and held.get(f"CAL_MAG{n}_ID") == device_id), None)


def is_internal(device_id: int, held: Mapping[str, float]) -> bool:
    """Does this compass sit on the board? By its slot; without one, by its bus (an I2C one is taken for external)."""
    n = slot_of(device_id, held)
    mounting = None if n is None else held.get(f"CAL_MAG{n}_ROT")
    return device_id & 7 in _INSIDE if mounting is None else mounting < 0


def _triple(held: Mapping[str, float], n: int, what: str, default: float) -> Vec3:
    return vec3([held.get(f"CAL_MAG{n}_{a}{what}", default) for a in _AXES], what)


class _Parts(NamedTuple):
    """One compass's correction, in body axes."""

    rotation: Mat3
    offset_mg: Vec3
    shaping: Shaping


class Px4Calibrations:
    """What one PX4 vehicle holds for its compasses, see StoredCalibrations.

    An offset that moves starts no new epoch, once it was known: it is undone exactly, but for a change under 10 mG that
    PX4 takes up on restart only. While disarmed it is no change worth telling of either: after every landing PX4 moves
    them by itself (SENS_MAG_AUTOCAL).
    """

    def __init__(self) -> None:
        self._held: dict[str, float] = {}
        self._from: dict[int, tuple[int, str]] = {}  # device id and message of each compass
        self._epoch: dict[int, int] = {}
        self._changed: set[int] = set()
        self._expected: dict[str, set[float]] = {}
        self._armed = False
        self._throttle: float | None = None
        self._ampere: float | None = None
        self._parts: dict[int, _Parts] = {}

    def param(self, r: ParamReading) -> tuple[int, ...]:
        """Take one parameter; the compasses whose correction it changed."""
        was = self._held.get(r.name)
        if was == r.value or _OURS.fullmatch(r.name) is None:
            return ()
        before = {c: self._correction(c) for c in self._from}
        self._held[r.name] = r.value
        self._parts.clear()
        changed = tuple(c for c in self._from if self._correction(c) != before[c])
        if r.value in self._expected.get(r.name, ()):
            return changed
        for c in changed:
            moved = only_offsets_moved(before[c], self._correction(c))
            self._epoch[c] = self.epoch(c) + (not moved)
            if was is not None and (self._armed or not moved):
                self._changed.add(c)
        return changed

    def _correction(self, compass: int) -> tuple[object, ...]:
        """All that decides how this compass's readings are taken back to the sensor, offsets first; equal means alike.

        The offsets are None where not all of them are known, and () where the readings do not have them in.
        """
        device, source = self._from[compass]
        n = slot_of(device, self._held)
        parts = self._parts_of(compass)
        motor = () if n is None else tuple(_triple(self._held, n, "COMP", 0.0))
        offsets = tuple(parts.offset_mg) if source in CORRECTED else ()
        known = offsets if self.known(compass) else None
        by = self._held.get("CAL_MAG_COMP_TYP", 0.0)
        rest = (parts.rotation.tobytes(), parts.shaping.matrix.tobytes(), by, motor if by else ())
        return (known, *rest, None if known else offsets)

    def sensor(self, compass: int, device_id: int, source: str) -> None:
        """This compass's readings come from this device, through this message. Another device is another epoch."""
        was = self._from.get(compass)
        if was == (device_id, source):
            return
        self._from[compass] = (device_id, source)
        self._parts.pop(compass, None)
        if was is not None:
            self._epoch[compass] = self.epoch(compass) + 1

    def armed(self, armed: bool) -> None:
        """Take the arm state: throttle is not compensated while disarmed."""
        if armed != self._armed:
            self._armed = armed
            self._parts.clear()

    def throttle(self, share: float) -> None:
        """Take the throttle, 0 to 1."""
        self._throttle = share
        if self._held.get("CAL_MAG_COMP_TYP") == _BY_THROTTLE:
            self._parts.clear()

    def current(self, ampere: float) -> None:
        """Take the current of the battery that CAL_MAG_COMP_TYP names."""
        self._ampere = ampere
        if self._held.get("CAL_MAG_COMP_TYP") in (_BY_CURRENT, _BY_SECOND_CURRENT):
            self._parts.clear()

    def expect(self, names: Iterable[str], values: Iterable[float]) -> None:
        """These coming values are our own doing: undone exactly, nothing need be learnt again."""
        for name, value in zip(names, values, strict=True):
            self._expected.setdefault(name, set()).add(value)

    def known(self, compass: int) -> bool:
        """True when the compass's device is known and a slot holds offsets for it, so that results are absolute."""
        return self.offsets(compass) is not None

    def assumed(self, compass: int) -> bool:
        """True when scale, matrix or motor terms (or what drives the motor term) are PX4's defaults.

        Releases without off-diagonal terms, or without motor terms, have no such parameters: then nothing is assumed.
        """
        n = self._slot(compass)
        if n is None:
            return True
        heard = {w: [f"CAL_MAG{n}_{a}{w}" in self._held for a in _AXES] for w in ("SCALE", "ODIAG", "COMP")}
        partly = any(any(h) and not all(h) for h in heard.values())
        return partly or not all(heard["SCALE"]) or self._power() is None

    def epoch(self, compass: int) -> int:
        """Number of the stretch of data over which this compass was corrected in one way."""
        return self._epoch.get(compass, 0)

    def changed(self, compass: int) -> bool:
        """True when somebody changed the correction in flight after it was known."""
        return compass in self._changed

    def device_id(self, compass: int) -> int:
        """Device id of the sensor itself, 0 when its messages do not say."""
        return self._from.get(compass, (0, ""))[0]

    def offsets(self, compass: int) -> Vec3 | None:
        """-1000 R OFF: the stored offsets as ArduPilot would add them, mG, body axes, or None."""
        n = self._slot(compass)
        if n is None or any(f"CAL_MAG{n}_{a}OFF" not in self._held for a in _AXES):
            return None
        return self._parts_of(compass).offset_mg

    def stored(self, compass: int) -> dict[str, float]:
        """Every value heard for this compass, in PX4's own names and units (gauss, subtracted, sensor axes)."""
        n = self._slot(compass)
        if n is None:
            return {}
        of_slot = sorted(name for name in self._held if name.startswith(f"CAL_MAG{n}_"))
        return {name: self._held[name] for name in (*of_slot, *_COMMON) if name in self._held}

    def value(self, name: str) -> float | None:
        """One value as heard."""
        return self._held.get(name)

    def _slot(self, compass: int) -> int | None:
        device, source = self._from.get(compass, (0, ""))
        return slot_of(device, self._held) if source == RAW or source in CORRECTED else None

    def _power(self) -> float | None:
        by = self._held.get("CAL_MAG_COMP_TYP", 0.0)
        if by == _BY_THROTTLE:
            return self._throttle if self._armed else 0.0
        if by in (_BY_CURRENT, _BY_SECOND_CURRENT):
            return None if self._ampere is None else self._ampere / 1000.0
        return 0.0

    def _parts_of(self, compass: int) -> _Parts:
        if compass not in self._parts:
            self._parts[compass] = self._make_parts(compass)
        return self._parts[compass]

    def _make_parts(self, compass: int) -> _Parts:
        held, n = self._held, self._slot(compass)
        device, source = self._from.get(compass, (0, ""))
        if n is None:
            turned = source == RAW and is_internal(device, held)
            return _Parts(self._board() if turned else IDENTITY3, ZERO3, NO_SHAPING)
        r = self._mounting(n)
        dx, dy, dz = _triple(held, n, "SCALE", 1.0)
        ox, oy, oz = _triple(held, n, "ODIAG", 0.0)
        matrix = mat3(r @ np.array([[dx, ox, oy], [ox, dy, oz], [oy, oz, dz]]) @ r.T, "compass matrix")
        power = self._power() or 0.0
        motor = matrix @ r @ _triple(held, n, "COMP", 0.0) * (_MG_PER_GAUSS * power)
        plain = not motor.any() and (dx, dy, dz, ox, oy, oz) == (1.0, 1.0, 1.0, 0.0, 0.0, 0.0)
        offset = vec3(-_MG_PER_GAUSS * (r @ _triple(held, n, "OFF", 0.0)), "offsets")
        return _Parts(r, offset, NO_SHAPING if plain else Shaping(matrix, vec3(motor, "motor term")))

    def _board(self) -> Mat3:
        return mat3(self._level() @ self._numbered(self._held.get("SENS_BOARD_ROT", 0.0)), "board rotation")

    def _level(self) -> Mat3:
        x, y, z = (self._held.get(f"SENS_BOARD_{a}_OFF", 0.0) for a in _AXES)
        return body_from_sensor(x, y, z)

    @staticmethod
    def _numbered(number: float) -> Mat3:
        """PX4 takes a number it does not know for no rotation at all."""
        return rotation(int(number), PX4) if number in PX4 else IDENTITY3

    def _mounting(self, n: int) -> Mat3:
        number = self._held.get(f"CAL_MAG{n}_ROT", -1.0)
        if number < 0:
            return self._board()
        angles = [self._held.get(f"CAL_MAG{n}_{a}", 0.0) for a in ("ROLL", "PITCH", "YAW")]
        own = body_from_sensor(*angles) if number == CUSTOM else self._numbered(number)
        return mat3(self._level() @ own, "mounting") if f"CAL_MAG{n}_XODIAG" in self._held else own

    def shaping(self, compass: int) -> Shaping:
        """R S R^T, and R S COMP power in mG: what PX4 does after its offsets, in body axes."""
        return self._parts_of(compass).shaping

    def undoable(self, compass: int) -> bool:
        """False where what is stored throws a direction away, or is larger than any field."""
        parts = self._parts_of(compass)
        return invertible(parts.offset_mg, parts.shaping)

    def undo(self, compass: int, sent_mg: Vec3, source: str = "") -> Vec3:
        """The sensor's own field, mG, body axes, from the field as sent (``sensor_mag``: in the sensor's axes).

        ValueError for a singular stored matrix.
        """
        rotate, offset, shaping = self._parts_of(compass)
        if source == RAW:
            return vec3(rotate @ sent_mg, "field")
        if source not in CORRECTED:
            return sent_mg
        try:
            inner = np.linalg.solve(shaping.matrix, sent_mg - shaping.motor_b_mg)
        except np.linalg.LinAlgError:
            raise ValueError(
                f"compass {compass}: stored CAL_MAG scale matrix is singular and cannot be undone"
            ) from None
        return vec3(inner - offset, "field")

    def corrected(self, compass: int, sent_mg: Vec3, source: str = "") -> Vec3:
        """The field as PX4 uses it, mG, body axes."""
        if source != RAW:
            return sent_mg
        rotate, offset, shaping = self._parts_of(compass)
        return vec3(shaping.matrix @ (rotate @ sent_mg + offset) + shaping.motor_b_mg, "field")
