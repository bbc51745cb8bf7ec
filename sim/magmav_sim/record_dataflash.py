"""An ArduPilot DataFlash log: every record 0xA3 0x95, a number, and the columns its FMT record names.

Laid out after ArduPilot 4.5 (LogStructure.h), at the rates a copter logs by default or faster. What is not simulated
(what the pilot or a controller wants, temperatures) holds what is, or a constant.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import BinaryIO

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav_sim.correction import stored_correction
from magmav_sim.dataflash_layout import LAYOUTS, MULTIPLIERS, SCALE, STRUCT, UNITS, Layout
from magmav_sim.parameters import Parameters
from magmav_sim.record_moment import Moment

Value = float | str
Encode = Callable[[Layout, tuple[Value, ...]], bytes]

_HEAD = b"\xa3\x95"
_GPS_EPOCH_S, _LEAP_S, _WEEK_S = 315_964_800, 18, 604_800
_ARMED, _DISARMED, _LAND_COMPLETE, _NOT_LANDED = 10, 11, 18, 28
_MODES = {True: {0: "STABILIZE", 3: "AUTO"}, False: {0: "MANUAL", 10: "AUTO"}}
_FIRMWARE = {True: "ArduCopter V4.5.7 (magmav-sim)", False: "ArduPlane V4.5.7 (magmav-sim)"}


def as_bytes(layout: Layout, values: tuple[Value, ...]) -> bytes:
    """One record of a .bin. Values come in the units of their columns; struct.error where one does not fit."""
    raw = [v.encode() if isinstance(v, str) else _whole(c, v) for c, v in zip(layout.format, values, strict=True)]
    return _HEAD + bytes((layout.number,)) + struct.pack("<" + "".join(STRUCT[c] for c in layout.format), *raw)


def as_text(layout: Layout, values: tuple[Value, ...]) -> bytes:
    """One line of a .log, with the very values the .bin would hold."""
    words = [layout.name]
    for letter, value in zip(layout.format, values, strict=True):
        if isinstance(value, str):
            words.append(value)
        elif letter in SCALE:
            words.append(f"{_whole(letter, value) / SCALE[letter]:.{len(str(SCALE[letter])) - 1}f}")
        elif letter == "f":
            words.append(str(np.float32(value)))
        else:
            words.append(str(_whole(letter, value)))
    return ", ".join(words).encode() + b"\n"


def _whole(letter: str, value: float) -> float:
    if letter in "fd":
        return float(value)
    whole = round(value * SCALE[letter]) if letter in SCALE else int(value)  # C's cast: towards zero
    return (whole + 32768) % 65536 - 32768 if letter == "h" else whole


def _centi(angle_rad: float) -> float:
    """An angle in degrees that fits an int16 of centidegrees."""
    return math.degrees(math.remainder(angle_rad, math.tau))


def _turn(angle_rad: float) -> float:
    """A heading in degrees, 0 to 359.99 when rounded to hundredths."""
    return round(math.degrees(angle_rad) * 100) % 36000 / 100


class DataFlashWriter:
    """Writes one boot of a vehicle. ``encode``: as_bytes for a .bin, as_text for a .log."""

    def __init__(self, file: BinaryIO, encode: Encode) -> None:
        self._file = file
        self._encode = encode
        self._layouts: dict[str, Layout] = {}
        self._us = 0
        self._armed = self._aloft = False
        self._mode = -1
        self._held: dict[str, float] = {}
        self._events = 0

    def write(self, m: Moment) -> None:
        """Log what is due."""
        self._us = m.boot_us
        if not self._layouts:
            self._begin(m)
        self._happenings(m)
        if m.fresh:
            self._slow(m)
        if m.due(50):
            for i, imu in enumerate(m.inertial):
                self._put("IMU", i, *imu.rate_rads, *imu.force_mss, 0, 0, 35.0, 1, 1, 1000, 1000)
        if m.due(25):
            a = m.autopilot
            roll, pitch, yaw = _centi(a.roll_rad), _centi(a.pitch_rad), _turn(a.yaw_rad)
            self._put("ATT", roll, roll, pitch, pitch, yaw, yaw, 0, 0, 3)
        if m.due(10):
            self._tuning(m)
        if m.due(5):
            self._place(m)
        if not m.autopilot.quad and m.due(1):
            aloft = self._aloft
            self._put("STAT", aloft, float(aloft), self._armed, 1, 0, not aloft, 0, 0)

    def _put(self, name: str, *values: Value) -> None:
        values = values if name == "FMT" else (self._us, *values)
        self._file.write(self._encode(self._layouts[name], values))

    def _begin(self, m: Moment) -> None:
        a = m.autopilot
        self._layouts = LAYOUTS[a.quad]
        for layout in self._layouts.values():
            size = len(_HEAD) + 1 + struct.calcsize("<" + "".join(STRUCT[c] for c in layout.format))
            self._put("FMT", layout.number, size, layout.name, layout.format, layout.columns)
        for letter, label in UNITS.items():
            self._put("UNIT", ord(letter), label)
        for letter, factor in MULTIPLIERS.items():
            self._put("MULT", ord(letter), factor)
        for layout in self._layouts.values():
            self._put("FMTU", layout.number, layout.units, layout.multipliers)
        self._put("MSG", _FIRMWARE[a.quad])
        self._parameters(a.parameters)
        self._put("MSG", "Frame: QUAD/X" if a.quad else "Frame: PLANE")
        # What happened before this boot is not news to it.
        self._events = len(a.events)

    def _parameters(self, table: Parameters) -> None:
        """Those that changed since they were last logged; at first all."""
        defaults = Parameters() if not self._held else None
        for name in table.names:
            if self._held.get(name) != table[name]:
                self._put("PARM", name, table[name], math.nan if defaults is None else defaults[name])
                self._held[name] = table[name]

    def _happenings(self, m: Moment) -> None:
        a = m.autopilot
        if len(a.events) != self._events:
            self._events = len(a.events)
            self._parameters(a.parameters)
        if a.mode != self._mode:
            self._mode = a.mode
            self._put("MODE", self._name_of_mode(a.mode, a.quad), a.mode & 0xFF, 0)
        if a.armed != self._armed:
            self._armed = a.armed
            self._put("EV", _ARMED if a.armed else _DISARMED)
            self._put("ARM", a.armed, int(a.parameters["ARMING_CHECK"]) & 0xFFFFFFFF, 0, 0)
        aloft = a.landed_state != dialect.MAV_LANDED_STATE_ON_GROUND
        if aloft != self._aloft:
            self._aloft = aloft
            if a.quad:
                self._put("EV", _NOT_LANDED if aloft else _LAND_COMPLETE)

    def _name_of_mode(self, mode: int, quad: bool) -> Value:
        """Text logs name the mode, binary ones give its number twice."""
        return _MODES[quad].get(mode, str(mode)) if self._encode is as_text else mode & 0xFF

    def _slow(self, m: Moment) -> None:
        """The 10 Hz task: compasses and battery, right after they were read."""
        a, battery = m.autopilot, m.autopilot.battery
        for i, (raw, field) in enumerate(zip(a.raw_mg, a.published_mg, strict=True)):
            held = stored_correction(a.parameters, i + 1)
            by = a.throttle if held.motor_by == 1 else battery.measured_ampere if held.motor_by == 2 else 0.0
            motor = (value * by for value in held.motor_mg)
            self._put("MAG", i, *field, *held.offsets_mg, *motor, raw is not None, m.boot_us)
        energy_wh = battery.used_mah * battery.volt / 1000
        left = max(0, 100 - round(battery.used_mah / 52))
        self._put(
            "BAT",
            0,
            battery.volt,
            battery.volt,
            battery.measured_ampere,
            battery.used_mah,
            energy_wh,
            25.0,
            0.015,
            left,
        )

    def _tuning(self, m: Moment) -> None:
        a, s = m.autopilot, m.autopilot.state
        roll, pitch, yaw = _centi(a.roll_rad), _centi(a.pitch_rad), _turn(a.yaw_rad)
        gx, gy, gz = (math.degrees(b) for b in a.gyro_bias_rads)
        moving = s.vn_mps, s.ve_mps, s.vd_mps, s.vd_mps, s.north_m, s.east_m, -s.height_m
        self._put("XKF1", 0, roll, pitch, yaw, *moving, gx, gy, gz, a.home.alt_m)
        pressure_pa = 101_325.0 * (1 - 2.25577e-5 * (a.home.alt_m + s.height_m)) ** 5.25588
        self._put("BARO", 0, s.height_m, pressure_pa, 25.0, -s.vd_mps, m.boot_us // 1000, 0.0, 25.0, 1)
        pwm = 1000 + round(1000 * a.throttle)
        if a.quad:
            self._put("RCOU", pwm, pwm, pwm, pwm, *[0] * 10)
            height, climb_cms = s.height_m, -100 * s.vd_mps
            self._put(
                "CTUN", a.throttle, 0.0, a.throttle, a.parameters["MOT_THST_HOVER"], height, height, height, 0.0, 0.0,
                0.0, climb_cms, climb_cms,
            )  # fmt: skip
        else:
            self._put("RCOU", 1500, 1500, pwm, 1500, *[0] * 10)
            percent = 100 * a.throttle  # a plane's ThO is in per cent, a copter's a share
            self._put("CTUN", roll, roll, pitch, pitch, percent, 0.0, percent, s.airspeed_mps, 0, 0.0, 1.0, 0)

    def _place(self, m: Moment) -> None:
        a, s = m.autopilot, m.autopilot.state
        lat, lon, alt = m.position
        speed, course = m.over_ground
        week, since = divmod(a.unix_ns // 1_000_000 - 1000 * (_GPS_EPOCH_S - _LEAP_S), 1000 * _WEEK_S)
        self._put("GPS", 0, 3, since, week, 14, 0.8, lat, lon, alt, speed, _turn(course), s.vd_mps, 0.0, 1)
        self._put("POS", lat, lon, alt, s.height_m, s.height_m)
