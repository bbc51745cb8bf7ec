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
corrected (section 4.1): ``sensor_mag`` of a log and SCALED_IMU, SCALED_IMU2, SCALED_IMU3 on a link are the sensor's
own, in its own axes; ``vehicle_magnetometer`` and the field in the ``sensor_combined`` of old logs went through all of
the above. HIGHRES_IMU has EKF2's bias taken off as well, so it shows what PX4 left over and not what it stores, as a
logged ``vehicle_magnetometer less bias`` has PX4's other estimate: these are left as they came, and results are changes
only. Where a compass is heard through both, HIGHRES_IMU is left alone.

No message of a link says which device it is from. Two things tell: MAG_CAL_REPORT gives the calibration PX4 applies to
the sensor of the same number as SCALED_IMUn (both count uORB instances), and only one slot may hold exactly those
values; or there is one slot in use and one compass heard. Else it is not known, and nothing is written (S6).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from magmav.core.orientation import CUSTOM, PX4, body_from_sensor, rotation
from magmav.core.types import (
    IDENTITY3,
    NO_SHAPING,
    ZERO3,
    CalibrationReading,
    Mat3,
    ParamReading,
    Reason,
    Shaping,
    Vec3,
    mat3,
    vec3,
)
from magmav.mavlink.autopilot.px4_names import AXES, COMMON, MG_PER_GAUSS, SLOTS, offsets_of, slot_names
from magmav.mavlink.autopilot.px4_slots import IDS, is_internal, only_one, slot_of, told_by, triple
from magmav.mavlink.autopilot.stored import Standing, Wish, invertible, only_offsets_moved, standing_of

LIVE = frozenset({"SCALED_IMU raw", "SCALED_IMU2 raw", "SCALED_IMU3 raw"})  # as Decoder names them where PX4 sends them
RAW = frozenset({"sensor_mag"}) | LIVE
CORRECTED = frozenset({"vehicle_magnetometer", "sensor_combined"})
_LESS_BIAS = "HIGHRES_IMU"
_BY_THROTTLE, _BY_CURRENT, _BY_SECOND_CURRENT = 1, 2, 3
_OURS = frozenset(name for n in SLOTS for name in slot_names(n)) | frozenset(COMMON)
_NO_PART = 1e-9  # of a sensor's axis in a body axis: rounding of a right angle


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

    unit_mg = MG_PER_GAUSS

    def __init__(self) -> None:
        self._held: dict[str, float] = {}
        self._from: dict[int, tuple[int, str]] = {}  # device id and message of each compass
        self._reports: dict[int, CalibrationReading] = {}
        self._epoch: dict[int, int] = {}
        self._changed: set[int] = set()
        self._expected: dict[str, set[float]] = {}
        self._armed = False
        self._throttle: float | None = None
        self._ampere: float | None = None
        self._parts: dict[int, _Parts] = {}
        self._standing: dict[int, Standing] = {}  # asked for every sample, changed by few messages

    def param(self, r: ParamReading) -> tuple[int, ...]:
        """Take one parameter; the compasses whose correction it changed."""
        was = self._held.get(r.name)
        if was == r.value or r.name not in _OURS:
            return ()
        before = {c: self._correction(c) for c in self._from}
        self._held[r.name] = r.value
        self._forget()
        if r.name in IDS and was is not None:
            self._release()
        moved_in = self._bind()
        changed = tuple(c for c in self._from if c in moved_in or self._correction(c) != before[c])
        if r.value in self._expected.get(r.name, ()):
            return changed
        for c in changed:
            moved = c not in moved_in and only_offsets_moved(before[c], self._correction(c))
            self._epoch[c] = self.epoch(c) + (not moved)
            if was is not None and (self._armed or not moved):
                self._changed.add(c)
        return changed

    def report(self, r: CalibrationReading) -> tuple[int, ...]:
        """What PX4 applies to a compass says which slot is its own; the compasses that come to another slot by it."""
        self._reports[r.compass] = r
        self._standing.clear()
        changed = self._bind()
        for c in changed:
            self._epoch[c] = self.epoch(c) + 1
        return changed

    def _release(self) -> None:
        """Another device in some slot: what was concluded from the old ones is void."""
        for compass, (_, source) in self._from.items():
            if source in LIVE:
                self._from[compass] = (0, source)
        self._parts.clear()

    def _bind(self) -> tuple[int, ...]:
        """Give every live compass the device it is seen to be, and return those that changed.

        What was concluded stays until something else can be: after a write, parameters are new before the report is.
        """
        changed = []
        live = [c for c, (_, source) in self._from.items() if source in LIVE]
        for compass in live:
            device, source = self._from[compass]
            report = self._reports.get(compass)
            found = None if report is None else told_by(report, self._held)
            if report is None:
                found = only_one(self._held) if len(live) == 1 else None
                if found is None and device:
                    found = 0  # there was one, there are more now
            if found is not None and found != device:
                self._from[compass] = (found, source)
                self._parts.pop(compass, None)
                changed.append(compass)
        return tuple(changed)

    def _correction(self, compass: int) -> tuple[object, ...]:
        """All that decides how this compass's readings are taken back to the sensor, offsets first; equal means alike.

        The offsets are None where not all of them are known, and () where the readings do not have them in.
        """
        device, source = self._from[compass]
        n = slot_of(device, self._held)
        parts = self._parts_of(compass)
        motor = () if n is None else tuple(triple(self._held, n, "COMP", 0.0))
        offsets = tuple(parts.offset_mg) if source in CORRECTED else ()
        known = offsets if self.known(compass) else None
        by = self._held.get("CAL_MAG_COMP_TYP", 0.0)
        rest = (parts.rotation.tobytes(), parts.shaping.matrix.tobytes(), by, motor if by else ())
        return (known, *rest, None if known else offsets)

    def sensor(self, compass: int, device_id: int, source: str) -> bool:
        """This compass's readings come from this device, through this message. Another device is another epoch."""
        was = self._from.get(compass)
        if was is not None and source in (was[1], _LESS_BIAS) and (was[1] in LIVE or was[0] == device_id):
            return source == was[1]
        before = {c: self._from[c] for c in self._from if c != compass}
        self._from[compass] = (device_id, source)
        self._forget()
        self._epoch[compass] = self.epoch(compass) + (was is not None)
        if source in LIVE:
            self._bind()
            for c in before:  # that there are two of them now may have unsettled the other
                self._epoch[c] = self.epoch(c) + (self._from[c] != before[c])
        return True

    def standing(self, compass: int) -> Standing:
        """All that is answered of this compass, kept until something changes it."""
        if compass not in self._standing:
            self._standing[compass] = standing_of(self, compass)
        return self._standing[compass]

    def armed(self, armed: bool) -> None:
        """Take the arm state: throttle is not compensated while disarmed."""
        if armed != self._armed:
            self._armed = armed
            self._forget()

    def throttle(self, share: float) -> None:
        """Take the throttle, 0 to 1."""
        self._throttle = share
        if self._held.get("CAL_MAG_COMP_TYP") == _BY_THROTTLE:
            self._forget()

    def current(self, ampere: float) -> None:
        """Take the current of the battery that CAL_MAG_COMP_TYP names."""
        self._ampere = ampere
        if self._held.get("CAL_MAG_COMP_TYP") in (_BY_CURRENT, _BY_SECOND_CURRENT):
            self._forget()

    def _forget(self) -> None:
        self._parts.clear()
        self._standing.clear()

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
        heard = {w: [f"CAL_MAG{n}_{a}{w}" in self._held for a in AXES] for w in ("SCALE", "ODIAG", "COMP")}
        partly = any(any(h) and not all(h) for h in heard.values())
        return partly or not all(heard["SCALE"]) or self._power() is None

    def epoch(self, compass: int) -> int:
        """Number of the stretch of data over which this compass was corrected in one way."""
        return self._epoch.get(compass, 0)

    def changed(self, compass: int) -> bool:
        """True when somebody changed the correction in flight after it was known."""
        return compass in self._changed

    def refuses(self, compass: int) -> Reason | None:
        """MAPPING_UNCLEAR where a compass of a link cannot be told from others, or one device is in two slots."""
        device, source = self._from.get(compass, (0, ""))
        nobodys = source in LIVE and not device and all(name in self._held for name in IDS)
        twice = bool(device) and sum(self._held.get(name) == device for name in IDS) > 1
        return Reason.MAPPING_UNCLEAR if nobodys or twice else None

    def names(self, compass: int) -> tuple[str, str, str, str]:
        """Offsets X, Y, Z and device id of this compass's slot; of slot 0 while that is not known."""
        n = self._slot(compass) or 0
        return (*offsets_of(n), f"CAL_MAG{n}_ID")

    def wish(self, compass: int, offsets_b_mg: Vec3, write: tuple[bool, bool, bool]) -> Wish:
        """OFF = -R^T offsets / 1000 (AT-18b), by names that the written body axes have a part in.

        ``left_b_mg`` is in body axes again. An axis of the sensor that the written ones do not touch keeps its value.
        """
        x, y, z, device = self.names(compass)
        r, body = self._parts_of(compass)[:2]
        old = np.array([self._held[name] for name in (x, y, z)])
        step = -(r.T @ np.where(write, offsets_b_mg - body, 0.0)) / MG_PER_GAUSS
        touched = abs(r.T @ np.diag(write)).sum(axis=1) > _NO_PART
        new = np.where(touched, old + step, old).astype(np.float32).astype(np.float64)
        chosen = [i for i in range(3) if touched[i]]
        names = tuple((x, y, z)[i] for i in chosen)
        was, now = (tuple(float(values[i]) for i in chosen) for values in (old, new))
        return Wish(device, names, was, now, vec3(-MG_PER_GAUSS * (r @ new), "offsets"))

    def device_id(self, compass: int) -> int:
        """Device id of the sensor itself, 0 when neither its messages nor anything else says."""
        return self._from.get(compass, (0, ""))[0]

    def offsets(self, compass: int) -> Vec3 | None:
        """-1000 R OFF: the stored offsets as ArduPilot would add them, mG, body axes, or None."""
        n = self._slot(compass)
        if n is None or any(f"CAL_MAG{n}_{a}OFF" not in self._held for a in AXES):
            return None
        return self._parts_of(compass).offset_mg

    def stored(self, compass: int) -> dict[str, float]:
        """Every value heard for this compass, in PX4's own names and units (gauss, subtracted, sensor axes)."""
        n = self._slot(compass)
        if n is None:
            return {}
        of_slot = sorted(name for name in self._held if name.startswith(f"CAL_MAG{n}_"))
        return {name: self._held[name] for name in (*of_slot, *COMMON) if name in self._held}

    def value(self, name: str) -> float | None:
        """One value as heard."""
        return self._held.get(name)

    def _slot(self, compass: int) -> int | None:
        device, source = self._from.get(compass, (0, ""))
        return slot_of(device, self._held) if source in RAW or source in CORRECTED else None

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
            turned = source in RAW and is_internal(device, held)
            return _Parts(self._board() if turned else IDENTITY3, ZERO3, NO_SHAPING)
        r = self._mounting(n)
        dx, dy, dz = triple(held, n, "SCALE", 1.0)
        ox, oy, oz = triple(held, n, "ODIAG", 0.0)
        matrix = mat3(r @ np.array([[dx, ox, oy], [ox, dy, oz], [oy, oz, dz]]) @ r.T, "compass matrix")
        power = self._power() or 0.0
        motor = matrix @ r @ triple(held, n, "COMP", 0.0) * (MG_PER_GAUSS * power)
        plain = not motor.any() and (dx, dy, dz, ox, oy, oz) == (1.0, 1.0, 1.0, 0.0, 0.0, 0.0)
        offset = vec3(-MG_PER_GAUSS * (r @ triple(held, n, "OFF", 0.0)), "offsets")
        return _Parts(r, offset, NO_SHAPING if plain else Shaping(matrix, vec3(motor, "motor term")))

    def _board(self) -> Mat3:
        return mat3(self._level() @ self._numbered(self._held.get("SENS_BOARD_ROT", 0.0)), "board rotation")

    def _level(self) -> Mat3:
        x, y, z = (self._held.get(f"SENS_BOARD_{a}_OFF", 0.0) for a in AXES)
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
        if source in RAW:
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
        if source not in RAW:
            return sent_mg
        rotate, offset, shaping = self._parts_of(compass)
        return vec3(shaping.matrix @ (rotate @ sent_mg + offset) + shaping.motor_b_mg, "field")
