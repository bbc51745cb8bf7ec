"""ArduPilot's compass calibration: its parameters, its order of correction, and the way back.

    b1 = sensor + OFS         added, mG, body axes
    b2 = b1 * SCALE           only where 1/1.5 <= SCALE <= 1.5
    b3 = M b2                 only where DIA is not (0, 0, 0);  M = [[DX, OX, OY], [OX, DY, OZ], [OY, OZ, DZ]]
    sent = b3 + MOT * x       x throttle (MOTCT 1) or battery ampere (MOTCT 2)
(autopilots.md section 2.1, read in AP_Compass_Backend.cpp 4.5.1 and observed in SITL.) The number in the name is the
place in the priority order, which is also the order of RAW_IMU, SCALED_IMU2 and SCALED_IMU3.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from magmav.core.types import (
    IDENTITY3,
    NO_SHAPING,
    ZERO3,
    Change,
    Mat3,
    ParamReading,
    Shaping,
    Vec3,
    mat3,
    vec3,
)
from magmav.mavlink.autopilot.stored import StoredCalibrations, invertible, only_offsets_moved

COMPASSES = (1, 2, 3)
_AXES = ("X", "Y", "Z")
_LEAST_SCALE, _MOST_SCALE = 1.0 / 1.5, 1.5
_BY_THROTTLE, _BY_CURRENT = 1, 2


def _suffix(compass: int) -> str:
    if compass not in COMPASSES:
        raise ValueError(f"compass: want 1, 2 or 3, got {compass}")
    return "" if compass == 1 else str(compass)


def offset_names(compass: int) -> tuple[str, str, str]:
    """COMPASS_OFS_X and its kin for this compass."""
    x, y, z = (f"COMPASS_OFS{_suffix(compass)}_{axis}" for axis in _AXES)
    return x, y, z


def device_name(compass: int) -> str:
    """The parameter that holds this compass's device id."""
    return f"COMPASS_DEV_ID{_suffix(compass)}"


def shaping_names(compass: int) -> tuple[str, ...]:
    """Scale, matrix and motor terms of this compass, in that order; then the one motor selector of all."""
    n = _suffix(compass)
    groups = ("DIA", "ODI", "MOT")
    return (f"COMPASS_SCALE{n}", *(f"COMPASS_{g}{n}_{a}" for g in groups for a in _AXES), "COMPASS_MOTCT")


def wanted_names(compasses: Iterable[int]) -> tuple[str, ...]:
    """Everything that must be read from the vehicle for these compasses."""
    names: list[str] = []
    for compass in compasses:
        names += [*offset_names(compass), device_name(compass), *shaping_names(compass)]
    return tuple(dict.fromkeys(names))


class Calibrations:
    """What one ArduPilot vehicle holds for its compasses, as far as it has been heard, and how to undo it.

    ``epoch(compass)`` grows whenever data before and after must not be mixed: another device, a value that was not
    known before, another scale, matrix or motor term. Offsets that were known before and after are no such thing: both
    are undone exactly, and the sensor's own field knows neither. The others are not, though they are undone as exactly:
    an estimate of soft iron or of a share of throttle is one relative to them, and a wrong matrix that is put right has
    spoilt what was learnt with it.
    """

    def __init__(self) -> None:
        self._held: dict[str, float] = {}
        self._epoch = dict.fromkeys(COMPASSES, 0)
        self._changed = dict.fromkeys(COMPASSES, False)
        self._expected: dict[str, set[float]] = {}
        self._throttle: float | None = None
        self._ampere: float | None = None
        self._parts: dict[int, tuple[Vec3, Shaping]] = {}
        self._answers: dict[tuple[str, int], bool] = {}  # asked for every sample, changed by few messages
        self._offsets: dict[int, Vec3 | None] = {}

    def param(self, r: ParamReading) -> tuple[int, ...]:
        """Take one parameter; the compasses whose correction it changed."""
        if not r.name.startswith("COMPASS_"):
            return ()
        before = {c: self._correction(c) for c in COMPASSES}
        was = self._held.get(r.name)
        self._held[r.name] = r.value
        if was == r.value:
            return ()
        self._forget_answers()
        swapped = tuple(c for c in COMPASSES if r.name == device_name(c) and was is not None)
        changed = swapped or tuple(c for c in COMPASSES if self._correction(c) != before[c])
        if r.value not in self._expected.get(r.name, ()):
            for c in changed:
                self._epoch[c] += not only_offsets_moved(before[c], self._correction(c))
                self._changed[c] = self._changed[c] or was is not None
        return changed

    def _correction(self, compass: int) -> tuple[object, ...]:
        """All that decides how this compass's stream was corrected, offsets first; equal means undone alike."""
        n, get = _suffix(compass), self._held.get
        offset, mode = self.offsets(compass), get("COMPASS_MOTCT", 0.0)
        motor = tuple(get(f"COMPASS_MOT{n}_{a}", 0.0) for a in _AXES) if mode else ()
        return (None if offset is None else tuple(offset), self._matrix(compass).tobytes(), mode, motor)

    def sensor(self, compass: int, device_id: int, source: str) -> None:
        """ArduPilot's compasses are known by their number."""

    def armed(self, armed: bool) -> None:
        """Armed or not, ArduPilot corrects alike."""

    def throttle(self, share: float) -> None:
        """Take the throttle, 0 to 1."""
        news = self._throttle is None or self._held.get("COMPASS_MOTCT") == _BY_THROTTLE
        self._throttle = share
        if news:
            self._forget_answers()

    def current(self, ampere: float) -> None:
        """Take the battery current."""
        news = self._ampere is None or self._held.get("COMPASS_MOTCT") == _BY_CURRENT
        self._ampere = ampere
        if news:
            self._forget_answers()

    def _forget_answers(self) -> None:
        self._parts.clear()
        self._answers.clear()
        self._offsets.clear()

    def _answer(self, question: str, compass: int, find: Callable[[int], bool]) -> bool:
        known = self._answers.get((question, compass))
        if known is None:
            known = self._answers[question, compass] = find(compass)
        return known

    def expect(self, names: Iterable[str], values: Iterable[float]) -> None:
        """These coming values are our own doing: undone exactly, nothing need be learnt again."""
        for name, value in zip(names, values, strict=True):
            self._expected.setdefault(name, set()).add(value)

    def known(self, compass: int) -> bool:
        """True when stored offsets and device id were heard, so that results are absolute."""
        return self._answer("known", compass, self._is_known)

    def _is_known(self, compass: int) -> bool:
        return all(n in self._held for n in (*offset_names(compass), device_name(compass)))

    def assumed(self, compass: int) -> bool:
        """True when scale, matrix or motor terms (or what drives the motor term) are the autopilot's defaults."""
        return self._answer("assumed", compass, self._is_assumed)

    def _is_assumed(self, compass: int) -> bool:
        names = shaping_names(compass)
        mode = self._held.get("COMPASS_MOTCT")
        if mode == 0.0:
            names = names[:7]
        driver = {_BY_THROTTLE: self._throttle, _BY_CURRENT: self._ampere}
        return any(n not in self._held for n in names) or (mode in driver and driver[int(mode)] is None)

    def epoch(self, compass: int) -> int:
        """Number of the stretch of data over which this compass was corrected in one way."""
        return self._epoch[compass]

    def changed(self, compass: int) -> bool:
        """True when somebody changed the correction after it was known."""
        return self._changed[compass]

    def device_id(self, compass: int) -> int:
        """Device id, 0 when not known."""
        return int(self._held.get(device_name(compass), 0))

    def offsets(self, compass: int) -> Vec3 | None:
        """Stored offsets, mG, or None."""
        if compass not in self._offsets:
            held = [self._held.get(n) for n in offset_names(compass)]
            self._offsets[compass] = None if None in held else vec3(held, "offsets")
        return self._offsets[compass]

    def stored(self, compass: int) -> dict[str, float]:
        """Every value heard for this compass, in the autopilot's own names and units."""
        names = (*offset_names(compass), device_name(compass), *shaping_names(compass))
        return {n: self._held[n] for n in names if n in self._held}

    def value(self, name: str) -> float | None:
        """One value as heard."""
        return self._held.get(name)

    def _parts_of(self, compass: int) -> tuple[Vec3, Shaping]:
        if compass not in self._parts:
            offset = self.offsets(compass)
            matrix, motor = self._matrix(compass), self._motor(compass)
            plain = matrix is IDENTITY3 and not motor.any()
            self._parts[compass] = (
                ZERO3 if offset is None else offset,
                NO_SHAPING if plain else Shaping(matrix, motor),
            )
        return self._parts[compass]

    def _matrix(self, compass: int) -> Mat3:
        get, n = self._held.get, _suffix(compass)
        scale = get(f"COMPASS_SCALE{n}", 0.0)
        scale = scale if _LEAST_SCALE <= scale <= _MOST_SCALE else 1.0
        dx, dy, dz = [get(f"COMPASS_DIA{n}_{a}", 1.0) for a in _AXES]
        ox, oy, oz = [get(f"COMPASS_ODI{n}_{a}", 0.0) for a in _AXES]
        if (dx, dy, dz) == (0.0, 0.0, 0.0):
            dx, dy, dz, ox, oy, oz = 1.0, 1.0, 1.0, 0.0, 0.0, 0.0
        if (scale, dx, dy, dz, ox, oy, oz) == (1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0):
            return IDENTITY3
        return mat3(scale * np.array([[dx, ox, oy], [ox, dy, oz], [oy, oz, dz]]), "compass matrix")

    def _motor(self, compass: int) -> Vec3:
        mode = self._held.get("COMPASS_MOTCT", 0.0)
        driver = self._throttle if mode == _BY_THROTTLE else self._ampere if mode == _BY_CURRENT else None
        if driver is None:
            return ZERO3
        n = _suffix(compass)
        return vec3([self._held.get(f"COMPASS_MOT{n}_{a}", 0.0) * driver for a in _AXES], "motor term")

    def shaping(self, compass: int) -> Shaping:
        """Matrix (scale included) and motor term the autopilot applies after its offsets."""
        return self._parts_of(compass)[1]

    def undoable(self, compass: int) -> bool:
        """False where what is stored throws a direction away, as a matrix does while only some of its zeros are heard,
        or is larger than the stream could carry."""
        return self._answer("undoable", compass, self._is_undoable)

    def _is_undoable(self, compass: int) -> bool:
        return invertible(*self._parts_of(compass))

    def undo(self, compass: int, sent_b_mg: Vec3, source: str = "") -> Vec3:
        """The sensor's own field, mG, body axes, from the field as sent. ValueError for a singular stored matrix."""
        offset, shaping = self._parts_of(compass)
        if shaping is NO_SHAPING:
            return vec3(sent_b_mg - offset, "field")
        try:
            inner = np.linalg.solve(shaping.matrix, sent_b_mg - shaping.motor_b_mg)
        except np.linalg.LinAlgError:
            raise ValueError(f"compass {compass}: stored DIA/ODI matrix is singular and cannot be undone") from None
        return vec3(inner - offset, "field")

    def corrected(self, compass: int, sent_b_mg: Vec3, source: str = "") -> Vec3:
        """The field as the autopilot uses it: all of ArduPilot's messages carry that."""
        return sent_b_mg


def plan_change(
    held: StoredCalibrations,
    system: int,
    compass: int,
    hard_iron_b_mg: Vec3,
    sigma_mg: Vec3,
    write: tuple[bool, bool, bool],
) -> Change | None:
    """The change of stored offsets that this hard iron asks for, on the axes in ``write`` only.

    None while stored offsets or device id are not known, or when nothing would be written.
    OFS = -b whatever scale, matrix and motor terms are: those act after the offsets.
    """
    old = held.offsets(compass)
    if old is None or not held.known(compass) or not any(write):
        return None
    new = np.where(write, -hard_iron_b_mg, old).astype(np.float32).astype(np.float64)
    step = new - old
    shift = held.shaping(compass).matrix @ step
    sigma = np.abs(held.shaping(compass).matrix) @ np.where(write, sigma_mg, 0.0)
    chosen = [i for i in range(3) if write[i]]
    return Change(
        system=system,
        compass=compass,
        device_name=device_name(compass),
        device_id=held.device_id(compass),
        names=tuple(offset_names(compass)[i] for i in chosen),
        old=tuple(float(old[i]) for i in chosen),
        new=tuple(float(new[i]) for i in chosen),
        shift_b_mg=(float(shift[0]), float(shift[1]), float(shift[2])),
        shift_sigma_mg=(float(sigma[0]), float(sigma[1]), float(sigma[2])),
        step_mg=tuple(abs(float(step[i])) for i in chosen),
    )
