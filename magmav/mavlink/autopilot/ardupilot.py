"""ArduPilot's compass calibration: its parameters, its order of correction, and the way back.

    b1 = sensor + OFS         added, mG, body axes
    b2 = b1 * SCALE           only where 1/1.5 <= SCALE <= 1.5
    b3 = M b2                 only where DIA is not (0, 0, 0);  M = [[DX, OX, OY], [OX, DY, OZ], [OY, OZ, DZ]]
    sent = b3 + MOT * x       x throttle (MOTCT 1) or battery ampere (MOTCT 2)
(autopilots.md section 2.1, read in AP_Compass_Backend.cpp 4.5.1 and observed in SITL.) Compass 1, 2, 3 is the place in
the order of priority, which is the order of RAW_IMU, SCALED_IMU2 and SCALED_IMU3 (section 1.1): it is the device in
COMPASS_PRIOn_ID, and its parameters are those whose COMPASS_DEV_IDn is that device. After a boot that is the same n.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

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
    shut,
    vec3,
)
from magmav.mavlink.autopilot.allowed import COMPASSES
from magmav.mavlink.autopilot.ardupilot_names import (
    AXES,
    CLASSIC,
    MOTCT,
    NUMBERED,
    ArduPilot,
    Scheme,
    priority_name,
    scheme_of,
)
from magmav.mavlink.autopilot.plan import plan_change as plan_change
from magmav.mavlink.autopilot.stored import Standing, Wish, invertible, only_offsets_moved, standing_of

_LEAST_SCALE, _MOST_SCALE = 1.0 / 1.5, 1.5
_BY_THROTTLE, _BY_CURRENT = 1, 2


def offset_names(compass: int) -> tuple[str, str, str]:
    """COMPASS_OFS_X and its kin for this compass."""
    return CLASSIC.offsets(compass)


def wanted_names(compasses: Iterable[int]) -> tuple[str, ...]:
    """Everything that must be read from a vehicle for these compasses."""
    return ArduPilot().names(compasses)


_PRIORITIES = {priority_name(c): c for c in COMPASSES}
_OURS = frozenset(
    name
    for scheme in (CLASSIC, NUMBERED)
    for c in COMPASSES
    for name in (*scheme.offsets(c), scheme.device(c), *scheme.shaping(c), priority_name(c))
)


class Calibrations:
    """What one ArduPilot vehicle holds for its compasses, as far as it has been heard, and how to undo it.

    ``epoch(compass)`` grows whenever data before and after must not be mixed: another device, a value that was not
    known before, another scale, matrix or motor term. Offsets that were known before and after are no such thing: both
    are undone exactly, and the sensor's own field knows neither. The others are not, though they are undone as exactly:
    an estimate of soft iron or of a share of throttle is one relative to them, and a wrong matrix that is put right has
    spoilt what was learnt with it.
    """

    unit_mg = 1.0

    def __init__(self) -> None:
        self._held: dict[str, float] = {}
        self._priority: dict[int, float] = {}  # as first heard: a change of it takes effect with the next boot only
        self._moved = False  # somebody changed the order since
        self._epoch = dict.fromkeys(COMPASSES, 0)
        self._changed = dict.fromkeys(COMPASSES, False)
        self._expected: dict[str, set[float]] = {}
        self._throttle: float | None = None
        self._ampere: float | None = None
        self._parts: dict[int, tuple[Vec3, Shaping]] = {}
        self._standing: dict[int, Standing] = {}  # asked for every sample, changed by few messages
        self._offsets: dict[int, Vec3 | None] = {}
        self._slots: dict[int, tuple[Scheme, int, bool]] = {}

    def param(self, r: ParamReading) -> tuple[int, ...]:
        """Take one parameter; the compasses whose correction it changed."""
        was = self._held.get(r.name)
        if r.name not in _OURS or was == r.value:
            return ()
        before = {c: (self._device(c), self._correction(c)) for c in COMPASSES}
        self._held[r.name] = r.value
        if r.name in _PRIORITIES:
            self._moved = self._moved or was is not None
            self._priority.setdefault(_PRIORITIES[r.name], r.value)
        self._slots.clear()
        self._forget_answers()
        changed = []
        for c in COMPASSES:
            device, correction = before[c]
            swapped = device is not None and self._device(c) != device
            now = self._correction(c)
            if not swapped and now == correction:
                continue
            changed.append(c)
            if r.value not in self._expected.get(r.name, ()):
                self._epoch[c] += swapped or not only_offsets_moved(correction, now)
                self._changed[c] = self._changed[c] or was is not None
        return tuple(changed)

    def report(self, r: CalibrationReading) -> tuple[int, ...]:
        """ArduPilot reports a calibration that is running, not the one it applies."""
        return ()

    def _slot(self, compass: int) -> tuple[Scheme, int, bool]:
        """How this compass's parameters are called, the number in their names, and whether that is clear (AT-6a).

        The number is that of the compass itself where nothing else was heard.
        """
        if compass not in self._slots:
            self._slots[compass] = self._find_slot(compass)
        return self._slots[compass]

    def _find_slot(self, compass: int) -> tuple[Scheme, int, bool]:
        if compass not in COMPASSES:
            raise ValueError(f"compass: want 1, 2 or 3, got {compass}")
        scheme = scheme_of(self._held)
        other = CLASSIC if scheme.numbered else NUMBERED
        one_scheme = not any(n in self._held for c in COMPASSES for n in other.offsets(c))
        devices = {c: self._held[scheme.device(c)] for c in COMPASSES if scheme.device(c) in self._held}
        wanted = self._priority.get(compass, 0.0)
        if not wanted:
            found = [compass]
            unlisted = compass in self._priority and any(self._priority.values())
        else:
            found = [c for c, device in devices.items() if device == wanted]
            unlisted = not found and len(devices) == len(COMPASSES)
        number = found[0] if len(found) == 1 else compass
        device = devices.get(number, 0.0)
        twice = bool(device) and sum(d == device for d in devices.values()) > 1
        return scheme, number, one_scheme and not unlisted and not twice and not self._moved

    def _device(self, compass: int) -> float | None:
        scheme, n, _ = self._slot(compass)
        return self._held.get(scheme.device(n))

    def _correction(self, compass: int) -> tuple[object, ...]:
        """All that decides how this compass's stream was corrected, offsets first; equal means undone alike."""
        scheme, n, _ = self._slot(compass)
        get = self._held.get
        offset, mode = self.offsets(compass), get(MOTCT, 0.0)
        motor = tuple(get(scheme.name(n, "MOT", a), 0.0) for a in AXES) if mode else ()
        return (None if offset is None else tuple(offset), self._matrix(compass).tobytes(), mode, motor)

    def sensor(self, compass: int, device_id: int, source: str) -> bool:
        """ArduPilot's compasses are known by their number, and all messages carry the same."""
        return True

    def standing(self, compass: int) -> Standing:
        """All that is answered of this compass, kept until something changes it."""
        if compass not in self._standing:
            self._standing[compass] = standing_of(self, compass)
        return self._standing[compass]

    def armed(self, armed: bool) -> None:
        """Armed or not, ArduPilot corrects alike."""

    def throttle(self, share: float) -> None:
        """Take the throttle, 0 to 1."""
        news = self._throttle is None or self._held.get(MOTCT) == _BY_THROTTLE
        self._throttle = share
        if news:
            self._forget_answers()

    def current(self, ampere: float) -> None:
        """Take the battery current."""
        news = self._ampere is None or self._held.get(MOTCT) == _BY_CURRENT
        self._ampere = ampere
        if news:
            self._forget_answers()

    def _forget_answers(self) -> None:
        self._parts.clear()
        self._standing.clear()
        self._offsets.clear()

    def expect(self, names: Iterable[str], values: Iterable[float]) -> None:
        """These coming values are our own doing: undone exactly, nothing need be learnt again."""
        for name, value in zip(names, values, strict=True):
            self._expected.setdefault(name, set()).add(value)

    def known(self, compass: int) -> bool:
        """True when stored offsets and device id were heard, so that results are absolute."""
        return all(name in self._held for name in self.names(compass))

    def assumed(self, compass: int) -> bool:
        """True when scale, matrix or motor terms (or what drives the motor term) are the autopilot's defaults."""
        scheme, n, _ = self._slot(compass)
        names = scheme.shaping(n)
        mode = self._held.get(MOTCT)
        if mode == 0.0:
            names = names[:7]
        driver = {_BY_THROTTLE: self._throttle, _BY_CURRENT: self._ampere}
        return any(name not in self._held for name in names) or (mode in driver and driver[int(mode)] is None)

    def epoch(self, compass: int) -> int:
        """Number of the stretch of data over which this compass was corrected in one way."""
        return self._epoch[compass]

    def changed(self, compass: int) -> bool:
        """True when somebody changed the correction after it was known."""
        return self._changed[compass]

    def device_id(self, compass: int) -> int:
        """Device id, 0 when not known."""
        return int(self._device(compass) or 0)

    def refuses(self, compass: int) -> Reason | None:
        """MAPPING_UNCLEAR where device ids, priorities or naming schemes contradict each other (AT-6b, AT-6c)."""
        return None if self._slot(compass)[2] else Reason.MAPPING_UNCLEAR

    def names(self, compass: int) -> tuple[str, str, str, str]:
        """Offsets X, Y, Z and device id, as this vehicle calls them."""
        scheme, n, _ = self._slot(compass)
        return (*scheme.offsets(n), scheme.device(n))

    def wish(self, compass: int, offsets_b_mg: Vec3, write: tuple[bool, bool, bool]) -> Wish:
        """Offsets as they are: mG, body axes, added."""
        x, y, z, device = self.names(compass)
        old = self.offsets(compass)
        assert old is not None  # nobody plans what is not known
        new = offsets_b_mg.astype(np.float32).astype(np.float64)
        chosen = [i for i in range(3) if write[i]]
        names = tuple((x, y, z)[i] for i in chosen)
        was, now = (tuple(float(values[i]) for i in chosen) for values in (old, new))
        return Wish(device, names, was, now, vec3(new, "offsets"))

    def offsets(self, compass: int) -> Vec3 | None:
        """Stored offsets, mG, or None."""
        if compass not in self._offsets:
            held = [self._held.get(name) for name in self.names(compass)[:3]]
            self._offsets[compass] = None if None in held else vec3(held, "offsets")
        return self._offsets[compass]

    def stored(self, compass: int) -> dict[str, float]:
        """Every value heard for this compass, in the autopilot's own names and units."""
        scheme, n, _ = self._slot(compass)
        names = (*self.names(compass), *scheme.shaping(n), priority_name(compass))
        return {name: self._held[name] for name in names if name in self._held}

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
        get, (scheme, n, _) = self._held.get, self._slot(compass)
        factor = get(scheme.name(n, "SCALE"), 0.0)
        factor = factor if _LEAST_SCALE <= factor <= _MOST_SCALE else 1.0
        dx, dy, dz = [get(scheme.name(n, "DIA", a), 1.0) for a in AXES]
        ox, oy, oz = [get(scheme.name(n, "ODI", a), 0.0) for a in AXES]
        if (dx, dy, dz) == (0.0, 0.0, 0.0):
            dx, dy, dz, ox, oy, oz = 1.0, 1.0, 1.0, 0.0, 0.0, 0.0
        if (factor, dx, dy, dz, ox, oy, oz) == (1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0):
            return IDENTITY3
        return mat3(factor * np.array([[dx, ox, oy], [ox, dy, oz], [oy, oz, dz]]), "compass matrix")

    def _motor(self, compass: int) -> Vec3:
        mode = self._held.get(MOTCT, 0.0)
        driver = self._throttle if mode == _BY_THROTTLE else self._ampere if mode == _BY_CURRENT else None
        if driver is None:
            return ZERO3
        scheme, n, _ = self._slot(compass)
        return vec3([self._held.get(scheme.name(n, "MOT", a), 0.0) * driver for a in AXES], "motor term")

    def shaping(self, compass: int) -> Shaping:
        """Matrix (scale included) and motor term the autopilot applies after its offsets."""
        return self._parts_of(compass)[1]

    def undoable(self, compass: int) -> bool:
        """False where what is stored throws a direction away, as a matrix does while only some of its zeros are heard,
        or is larger than the stream could carry."""
        return invertible(*self._parts_of(compass))

    def undo(self, compass: int, sent_b_mg: Vec3, source: str = "") -> Vec3:
        """The sensor's own field, mG, body axes, from the field as sent. ValueError for a singular stored matrix."""
        offset, shaping = self._parts_of(compass)
        if shaping is NO_SHAPING:
            return shut(sent_b_mg - offset)
        try:
            inner = np.linalg.solve(shaping.matrix, sent_b_mg - shaping.motor_b_mg)
        except np.linalg.LinAlgError:
            raise ValueError(f"compass {compass}: stored DIA/ODI matrix is singular and cannot be undone") from None
        return vec3(inner - offset, "field")

    def corrected(self, compass: int, sent_b_mg: Vec3, source: str = "") -> Vec3:
        """The field as the autopilot uses it: all of ArduPilot's messages carry that."""
        return sent_b_mg
