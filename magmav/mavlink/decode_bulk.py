"""The frequent messages of a recording to readings, their numbers made for all of them at once.

Reading for reading and count for count as decode.Decoder, whose constants and whose knowledge of the vehicles this
uses; ATTITUDE and the IMU messages are nearly all that a recording holds.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from magmav.core.motion_run import AttitudeColumns, attitude_columns
from magmav.core.types import AttitudeReading, InertialReading, MagReading, Reading
from magmav.mavlink.decode import COMPASS_OF, END_OF_SCALE, EPOCH_US, MOST_RAD, MOST_RADS, MS, US, Decoder, G

Floats = NDArray[np.float64]

_FINE, _BEYOND, _NO_NUMBER = 0, 1, 2
_WHY = {_BEYOND: "beyond belief", _NO_NUMBER: "not a number"}


class Bulk(Protocol):
    """All messages of one kind."""

    def readings(self, row: int, system: int, decoder: Decoder) -> list[Reading]:
        """What this one says, or an empty list, counted."""
        ...


def bulk(name: str, fields: NDArray[Any]) -> Bulk | None:
    """For a kind that is frequent; None for any other. fields : (N,) structured, names as MAVLink's."""
    if name == "ATTITUDE":
        return Attitudes(fields)
    return _Imus(name, fields) if name in COMPASS_OF else None


class Attitudes:
    """ATTITUDE. Satisfies Bulk."""

    def __init__(self, f: NDArray[Any]) -> None:
        self._rate = _frozen(f, ("rollspeed", "pitchspeed", "yawspeed"))
        angles = _frozen(f, ("roll", "pitch", "yaw"))
        of_rate = _judged(self._rate, MOST_RADS)
        self._fault: list[int] = np.where(of_rate != _FINE, of_rate, _judged(angles, MOST_RAD)).tolist()
        self._angles = angles.tolist()
        self._boot_ns: list[int] = (f["time_boot_ms"].astype(np.int64) * MS).tolist()

    def columns(self, sender: NDArray[np.int64]) -> AttitudeColumns:
        """All of them, for runs. sender : (N,) which vehicle's component sent each."""
        boot_ns, good = np.array(self._boot_ns, dtype=np.int64), np.array(self._fault) == _FINE
        return attitude_columns("ATTITUDE", boot_ns, np.array(self._angles).reshape(-1, 3), self._rate, good, sender)

    def readings(self, row: int, system: int, decoder: Decoder) -> list[Reading]:
        """One attitude, where it is one."""
        fault = self._fault[row]
        if fault:
            decoder.counts[f"ATTITUDE: {_WHY[fault]}"] += 1
            return []
        roll, pitch, yaw = self._angles[row]
        return [AttitudeReading(system, "ATTITUDE", self._boot_ns[row], roll, pitch, yaw, self._rate[row])]


class _Imus:
    def __init__(self, name: str, f: NDArray[Any]) -> None:
        self._name = name
        if name == "RAW_IMU":
            early = f["time_usec"] <= EPOCH_US
            boot_ns = np.where(early, f["time_usec"], 0).astype(np.int64) * US
        else:
            early = np.ones(len(f), dtype=bool)
            boot_ns = f["time_boot_ms"].astype(np.int64) * MS
        force, field = (_numbers(f, names) for names in (("xacc", "yacc", "zacc"), ("xmag", "ymag", "zmag")))
        self._early: list[bool] = early.tolist()
        self._boot_ns: list[int] = boot_ns.tolist()
        self._moved: list[bool] = _any(force).tolist()
        self._silent: list[bool] = (~_any(field)).tolist()
        self._full: list[bool] = (np.abs(field).max(axis=1, initial=0.0) >= END_OF_SCALE).tolist()
        self._force = _shut(force * G / 1e3)
        self._rate = _shut(_numbers(f, ("xgyro", "ygyro", "zgyro")) / 1e3)
        self._field = _shut(field)

    def readings(self, row: int, system: int, decoder: Decoder) -> list[Reading]:
        """Accelerometer with gyro, and the compass, as far as they are there."""
        name, boot_ns = self._name, self._boot_ns[row]
        if not self._early[row]:
            decoder.counts["RAW_IMU: time is not since boot"] += 1
            return []
        out: list[Reading] = []
        if self._moved[row]:
            out.append(InertialReading(system, name, boot_ns, self._force[row], self._rate[row]))
        if self._silent[row]:
            decoder.counts[f"{name}: no compass (all zero)"] += 1
        elif self._full[row]:
            decoder.counts[f"{name}: field at the end of its scale"] += 1
        else:
            source = decoder.source_of(name, system)
            out.append(MagReading(system, COMPASS_OF[name], source, boot_ns, self._field[row]))
        return out


def _numbers(f: NDArray[Any], names: tuple[str, str, str]) -> Floats:
    return np.stack([f[name].astype(np.float64) for name in names], axis=1)


def _any(values: Floats) -> NDArray[np.bool_]:
    """(N,) whether a row has a number that is not 0."""
    out: NDArray[np.bool_] = (values != 0.0).any(axis=1)
    return out


def _shut(values: Floats) -> Floats:
    """Read-only, and so is every row of it."""
    values.setflags(write=False)
    return values


def _frozen(f: NDArray[Any], names: tuple[str, str, str]) -> Floats:
    with np.errstate(invalid="ignore"):  # damage may spell a signalling NaN
        return _shut(_numbers(f, names))


def _judged(values: Floats, most: float) -> NDArray[np.int64]:
    """(N,) what is wrong with each row of (N, 3), if anything."""
    with np.errstate(invalid="ignore"):
        fine = (np.abs(values) <= most).all(axis=1)
    return np.where(fine, _FINE, np.where(np.isfinite(values).all(axis=1), _BEYOND, _NO_NUMBER))
