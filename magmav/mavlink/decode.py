"""MAVLink messages to readings: the one place where wire integers become mG, rad/s, rad and m/s^2 in body axes.

Past this file there is no count, no centidegree, no None and no NaN: what a message does not know gives no reading.
Only what an autopilot says is read; a gimbal's ATTITUDE or a companion's PARAM_VALUE is not the vehicle's.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable

from magmav.core.rotation import euler_from_quaternion
from magmav.core.types import (
    AttitudeReading,
    CalibrationReading,
    CurrentReading,
    InertialReading,
    Landed,
    LandedReading,
    MagReading,
    MotionReading,
    ParamReading,
    PositionReading,
    Reading,
    ThrottleReading,
    TimeReading,
    Vec3,
    VehicleReading,
    vec3,
)
from magmav.mavlink.codec import Message
from magmav.mavlink.values import bytewise, cast, says_bytewise

G = 9.80665
MS, US = 1_000_000, 1_000
_PX4, _NO_AUTOPILOT = 12, 8  # MAV_AUTOPILOT_PX4, MAV_AUTOPILOT_INVALID
_ONLY_PX4 = ("CAL_", "SENS_")  # names that tell whose they are before a heartbeat does
EPOCH_US = 10**14  # three years since boot: such a time is UNIX time, not a boot clock
# No gyro measures over 70 rad/s and no attitude lies beyond a turn: what does is damage, and would poison a filter.
MOST_RADS, MOST_RAD, _MOST_MSS, _MOST_MG = 100.0, 6.3, 1e4, 1e5
_MOST_GAUSS = 10.0  # a length beyond it, twenty times the Earth's field, is in another unit
END_OF_SCALE = 32767  # of 16 bits: 33 gauss, or another unit
COMPASS_OF = {"RAW_IMU": 1, "SCALED_IMU": 1, "SCALED_IMU2": 2, "SCALED_IMU3": 3}


class Decoder:
    """Readings of every vehicle on a link. ``counts`` says what was left out and why."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._autopilot: dict[int, int] = {}  # system -> component of its autopilot
        self._kind: dict[int, int] = {}  # system -> MAV_AUTOPILOT
        self._bytewise: dict[int, bool] = {}  # system -> how it encodes parameters, where it says so
        self._how: dict[str, Callable[[Message, int], list[Reading]]] = {
            "RAW_IMU": self._imu,
            "SCALED_IMU": self._imu,
            "SCALED_IMU2": self._imu,
            "SCALED_IMU3": self._imu,
            "HIGHRES_IMU": self._highres,
            "ATTITUDE": self._attitude,
            "ATTITUDE_QUATERNION": self._quaternion,
            "GLOBAL_POSITION_INT": self._global_position,
            "GPS_RAW_INT": self._gps,
            "BATTERY_STATUS": self._battery,
            "SYS_STATUS": self._battery,
            "VFR_HUD": self._hud,
            "SYSTEM_TIME": self._time,
            "HEARTBEAT": self._heartbeat,
            "EXTENDED_SYS_STATE": self._landed,
            "PARAM_VALUE": self._param,
            "AUTOPILOT_VERSION": self._version,
            "MAG_CAL_REPORT": self._report,
        }

    @property
    def wanted(self) -> frozenset[str]:
        """Names of the messages that are read."""
        return frozenset(self._how)

    def forget(self, system: int) -> None:
        """Its autopilot may be another component, or another autopilot, from now on."""
        for told in (self._autopilot, self._kind, self._bytewise):
            told.pop(system, None)

    def readings(self, message: Message) -> list[Reading]:
        """What this message says, or an empty list, counted, when it says nothing usable."""
        kind = message.get_type()
        how = self._how.get(kind)
        if how is None:
            return []
        system = message.get_srcSystem()
        if kind != "HEARTBEAT" and not self.believes(system, message.get_srcComponent()):
            return []
        try:
            return how(message, system)
        except OverflowError:
            self.counts[f"{kind}: beyond belief"] += 1
            return []
        except ValueError:
            self.counts[f"{kind}: not a number"] += 1
            return []

    def believes(self, system: int, component: int) -> bool:
        """Whether this component speaks for its vehicle, as far as its heartbeats told; counted where it does not."""
        if self._autopilot.get(system, component) == component:
            return True
        self.counts["not from the autopilot"] += 1
        return False

    def source_of(self, kind: str, system: int) -> str:
        """What a compass in RAW_IMU or SCALED_IMU is called.

        The same message, but PX4 sends the sensor's own field in the sensor's own axes (autopilots.md 4.1).
        """
        return f"{kind} raw" if self._kind.get(system) == _PX4 else kind

    def _imu(self, m: Message, system: int) -> list[Reading]:
        kind = m.get_type()
        if kind == "RAW_IMU":
            if m.time_usec > EPOCH_US:
                self.counts["RAW_IMU: time is not since boot"] += 1
                return []
            boot_ns = m.time_usec * US
        else:
            boot_ns = m.time_boot_ms * MS
        out: list[Reading] = []
        if (m.xacc, m.yacc, m.zacc) != (0, 0, 0):
            force = vec3((m.xacc * G / 1e3, m.yacc * G / 1e3, m.zacc * G / 1e3), "acceleration")
            rate = vec3((m.xgyro / 1e3, m.ygyro / 1e3, m.zgyro / 1e3), "rate")
            out.append(InertialReading(system, kind, boot_ns, force, rate))
        if (m.xmag, m.ymag, m.zmag) == (0, 0, 0):
            self.counts[f"{kind}: no compass (all zero)"] += 1
        elif max(abs(m.xmag), abs(m.ymag), abs(m.zmag)) >= END_OF_SCALE:
            self.counts[f"{kind}: field at the end of its scale"] += 1
        else:
            field = vec3((m.xmag, m.ymag, m.zmag), "field")
            out.append(MagReading(system, COMPASS_OF[kind], self.source_of(kind, system), boot_ns, field))
        return out

    def _highres(self, m: Message, system: int) -> list[Reading]:
        if m.time_usec > EPOCH_US or m.id > 2:
            self.counts["HIGHRES_IMU: time is not since boot, or instance over 3"] += 1
            return []
        boot_ns = m.time_usec * US
        out: list[Reading] = []
        if m.fields_updated & 0b111111 == 0b111111:
            force, rate = (
                vec3((m.xacc, m.yacc, m.zacc), "acceleration"),
                vec3((m.xgyro, m.ygyro, m.zgyro), "rate"),
            )
            out.append(InertialReading(system, "HIGHRES_IMU", boot_ns, force, rate))
        gauss = vec3((m.xmag, m.ymag, m.zmag), "field")
        if m.fields_updated & 0b111000000 != 0b111000000 or not gauss.any():
            return out
        # Some ArduPilot builds send mG times 1000 and call it gauss: a million times too much (autopilots.md 1.2).
        length = math.hypot(*gauss)
        scale = 1e3 if length <= _MOST_GAUSS else 1.0 if length <= _MOST_GAUSS * 1e3 else 1e-3
        if scale < 1e3:
            self.counts[f"HIGHRES_IMU: field {1e3 / scale:.0f} times too large, put right"] += 1
        x, y, z = (gauss * scale).tolist()
        out.append(MagReading(system, m.id + 1, "HIGHRES_IMU", boot_ns, _within(_MOST_MG, (x, y, z), "field")))
        return out

    def _attitude(self, m: Message, system: int) -> list[Reading]:
        rate = _within(MOST_RADS, (m.rollspeed, m.pitchspeed, m.yawspeed), "rate")
        roll, pitch, yaw = angles = m.roll, m.pitch, m.yaw
        _bounded(MOST_RAD, angles, "attitude")
        return [AttitudeReading(system, "ATTITUDE", m.time_boot_ms * MS, roll, pitch, yaw, rate)]

    def _quaternion(self, m: Message, system: int) -> list[Reading]:
        rate = _within(MOST_RADS, (m.rollspeed, m.pitchspeed, m.yawspeed), "rate")
        angles = euler_from_quaternion(m.q1, m.q2, m.q3, m.q4)
        if angles is None:
            self.counts["ATTITUDE_QUATERNION: not a rotation"] += 1
            return []
        return [AttitudeReading(system, "ATTITUDE_QUATERNION", m.time_boot_ms * MS, *angles, rate)]

    def _place(self, m: Message, system: int, boot_ns: int) -> list[Reading]:
        lat, lon = m.lat / 1e7, m.lon / 1e7
        if (m.lat, m.lon) == (0, 0) or not (abs(lat) <= 90.0 and abs(lon) <= 180.0):
            self.counts[f"{m.get_type()}: no position"] += 1
            return []
        return [PositionReading(system, m.get_type(), boot_ns, lat, lon, m.alt / 1e3)]

    def _global_position(self, m: Message, system: int) -> list[Reading]:
        boot_ns = m.time_boot_ms * MS
        motion = MotionReading(system, boot_ns, m.vx / 100.0, m.vy / 100.0, m.relative_alt / 1e3)
        return [*self._place(m, system, boot_ns), motion]

    def _gps(self, m: Message, system: int) -> list[Reading]:
        return self._place(m, system, m.time_usec * US) if m.fix_type >= 3 else []

    def _battery(self, m: Message, system: int) -> list[Reading]:
        # BATTERY_STATUS 0 and SYS_STATUS speak of the same, first battery, in units of 10 mA.
        if m.current_battery < 0 or (m.get_type() == "BATTERY_STATUS" and m.id != 0):
            return []
        return [CurrentReading(system, m.get_type(), m.current_battery / 100.0)]

    def _hud(self, m: Message, system: int) -> list[Reading]:
        return [ThrottleReading(system, m.throttle / 100.0)] if m.throttle <= 100 else []

    def _time(self, m: Message, system: int) -> list[Reading]:
        # Before 2010 no field model and no GPS week is meant: the vehicle does not know the date yet.
        if m.time_unix_usec < 1_262_304_000_000_000 or m.time_unix_usec > 4_000_000_000_000_000:
            return []
        return [TimeReading(system, m.time_boot_ms * MS, m.time_unix_usec * US)]

    def _heartbeat(self, m: Message, system: int) -> list[Reading]:
        component = m.get_srcComponent()
        if m.autopilot == _NO_AUTOPILOT or system == 0:
            return []
        if self._autopilot.setdefault(system, component) != component:
            self.counts["second autopilot component"] += 1
            return []
        self._kind[system] = m.autopilot
        armed = bool(m.base_mode & 128)
        return [VehicleReading(system, component, m.autopilot, m.type, armed, m.system_status)]

    def _landed(self, m: Message, system: int) -> list[Reading]:
        if m.landed_state not in Landed._value2member_map_:
            return []
        return [LandedReading(system, Landed(m.landed_state))]

    def _param(self, m: Message, system: int) -> list[Reading]:
        if m.param_id == "_HASH_CHECK":  # of PX4's parameters, and none itself
            return []
        value = bytewise(m) if self._by_bytes(system, m.param_id) else cast(m)
        if value is None:
            self.counts["PARAM_VALUE: not a number"] += 1
            return []
        return [ParamReading(system, m.get_srcComponent(), m.param_id, value, m.param_index, m.param_count)]

    def _by_bytes(self, system: int, name: str) -> bool:
        """Is an integer sent as its bytes? As the vehicle says; else by its autopilot; else by whose name it is."""
        if system in self._bytewise:
            return self._bytewise[system]
        kind = self._kind.get(system)
        return name.startswith(_ONLY_PX4) if kind is None else kind == _PX4

    def _version(self, m: Message, system: int) -> list[Reading]:
        says = says_bytewise(m.capabilities)
        if says is not None:
            self._bytewise[system] = says
        return []

    def _report(self, m: Message, system: int) -> list[Reading]:
        """On PX4 what it applies; on ArduPilot the end of a calibration that runs, which is for others to watch."""
        values = (
            (m.ofs_x, m.ofs_y, m.ofs_z), (m.diag_x, m.diag_y, m.diag_z, m.offdiag_x, m.offdiag_y, m.offdiag_z)
        )  # fmt: skip
        if self._kind.get(system) != _PX4 or m.compass_id > 2:
            return []
        if not all(map(math.isfinite, (*values[0], *values[1]))):
            raise ValueError("calibration")
        return [CalibrationReading(system, m.compass_id + 1, *values)]


def _within(most: float, value: tuple[float, float, float], name: str) -> Vec3:
    """The vector (3,); ValueError when it is not finite, OverflowError when an entry is larger than ``most``."""
    _bounded(most, value, name)
    return vec3(value, name)


def _bounded(most: float, value: tuple[float, float, float], name: str) -> None:
    """ValueError for a number that is not finite, OverflowError for one larger than ``most``."""
    x, y, z = value
    if -most <= x <= most and -most <= y <= most and -most <= z <= most:
        return
    if all(map(math.isfinite, value)):
        raise OverflowError(name)
    raise ValueError(name)
