"""A PX4 ULog of a vehicle that in truth is ours: PX4's topics, units, frames and signs, after the file format's page
(docs.px4.io, "ULog File Format", version 1).

The compasses are logged as read, before any correction, and the stored calibration stands beside them as PX4 would
hold it. Times are microseconds since boot.
"""

from __future__ import annotations

import math
import struct
from typing import BinaryIO

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav_sim.parameters import INT32
from magmav_sim.px4 import Px4
from magmav_sim.px4_calibration import px4_parameters
from magmav_sim.record_moment import Moment
from magmav_sim.ulog_layout import TOPICS, layout

_MAGIC = b"ULog\x01\x12\x35"
_VERSION = 1
_SYNC = bytes((0x2F, 0x73, 0x13, 0x20, 0x25, 0x0C, 0xBB, 0x12))
_RELEASE = 0x010E00FF  # 1.14.0, released
_DISARMED, _ARMED = 1, 2
_NAV_MANUAL, _NAV_MISSION = 0, 3
_HALF_READ_US = 45_000  # from the middle of the ten samples a compass averages to the last of them
_INFO = ord("6")
_QUAD, _PLANE = 4001, 2100  # SYS_AUTOSTART of a generic airframe


class ULogWriter:
    """Writes one boot of a vehicle."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._us = 0
        self._begun = self._landed = False
        self._armed = False
        self._since_us = {"armed": 0, "takeoff": 0}
        self._structs: dict[str, struct.Struct] = {}
        self._numbers: dict[tuple[str, int], int] = {}
        self._held: dict[str, int | float] = {}
        self._events = 0

    def write(self, m: Moment) -> None:
        """Log what is due."""
        self._us = m.boot_us
        if not self._begun:
            self._begin(m)
        self._happenings(m)
        if m.fresh:
            self._slow(m)
        if m.due(50):
            self._fast(m)
        if m.due(10):
            self._place(m)
        if m.due(5):
            self._fix(m)
        if m.due(2):
            self._message("S", _SYNC)

    # ------------------------------------------------------------ the file

    def _message(self, kind: str, body: bytes) -> None:
        self._file.write(struct.pack("<HB", len(body), ord(kind)) + body)

    def _keyed(self, kind: str, type_and_name: str, value: bytes) -> None:
        key = type_and_name.encode()
        self._message(kind, bytes((len(key),)) + key + value)

    def _data(self, topic: str, *values: float, instance: int = 0) -> None:
        number = struct.pack("<H", self._numbers[topic, instance])
        self._message("D", number + self._structs[topic].pack(self._us, *values))

    def _say(self, text: str) -> None:
        self._message("L", struct.pack("<BQ", _INFO, self._us) + text.encode())

    def _parameters(self, m: Moment) -> None:
        """Those that changed since they were last logged; at first all."""
        a = m.autopilot
        wanted: dict[str, int | float] = native(a) if isinstance(a, Px4) else {
            "MAV_SYS_ID": a.system, "MAV_COMP_ID": a.component, "MAV_TYPE": a.kind,
            "SYS_AUTOSTART": _QUAD if a.quad else _PLANE, "SENS_BOARD_ROT": 0, "SENS_MAG_AUTOCAL": 0,
            "SENS_MAG_MODE": 0, "SDLOG_MODE": 2, **px4_parameters(a.parameters, len(a.raw_mg)),
        }  # fmt: skip
        for name, value in sorted(wanted.items()):
            if self._held.get(name) != value:
                whole = isinstance(value, int)
                kind = "int32_t" if whole else "float"
                self._keyed("P", f"{kind} {name}", struct.pack("<i" if whole else "<f", value))
        self._held = wanted

    def _begin(self, m: Moment) -> None:
        self._begun = True
        self._file.write(_MAGIC + struct.pack("<BQ", _VERSION, m.boot_us))
        self._message("B", bytes(8 + 8 + 3 * 8))
        for topic, fields in TOPICS.items():
            letters, padding = layout(fields)
            self._structs[topic] = struct.Struct("<" + letters)
            tail = f"uint8_t[{padding}] _padding0;" if padding else ""
            self._message("F", f"{topic}:{fields}{tail}".encode())
        for name, text in (("sys_name", "PX4"), ("ver_hw", "MAGMAV_SIM"), ("ver_sw", "magmav-sim")):
            self._keyed("I", f"char[{len(text)}] {name}", text.encode())
        self._keyed("I", "uint32_t ver_sw_release", struct.pack("<I", _RELEASE))
        self._keyed("I", "int32_t time_ref_utc", struct.pack("<i", 0))
        self._parameters(m)
        self._events = len(m.autopilot.events)
        for topic in TOPICS:
            several = len(m.autopilot.raw_mg) if "mag" in topic else 1
            for instance in range(several):
                self._numbers[topic, instance] = number = len(self._numbers)
                self._message("A", struct.pack("<BH", instance, number) + topic.encode())

    # ------------------------------------------------------------ the topics

    def _happenings(self, m: Moment) -> None:
        a = m.autopilot
        if len(a.events) != self._events:
            self._events = len(a.events)
            self._parameters(m)
        landed = a.landed_state == dialect.MAV_LANDED_STATE_ON_GROUND
        news = (a.armed, landed) != (self._armed, self._landed)
        if a.armed != self._armed:
            self._since_us["armed"] = self._us if a.armed else 0
            self._say("[commander] Armed by external command" if a.armed else "[commander] Disarmed by landing")
        if landed != self._landed:
            self._since_us["takeoff"] = 0 if landed else self._us
            if a.armed:
                self._say("[commander] Landing detected" if landed else "[commander] Takeoff detected")
        self._armed, self._landed = a.armed, landed
        if news or m.due(1):
            self._data(
                "vehicle_status", self._since_us["armed"], self._since_us["takeoff"], _ARMED if a.armed else _DISARMED,
                _NAV_MANUAL if landed else _NAV_MISSION, 0, 1 if a.quad else 2, False, a.kind, a.system, a.component,
                True,
            )  # fmt: skip
            self._data("vehicle_land_detected", False, landed, landed, landed, False)

    def _slow(self, m: Moment) -> None:
        """Compasses, battery and thrust, right after they were read."""
        a, battery = m.autopilot, m.autopilot.battery
        left = max(0.0, 1 - battery.used_mah / 5200)
        current = battery.measured_ampere
        self._data(
            "battery_status", battery.volt, battery.volt, current, current, battery.used_mah, left, 4, True, 1, 0
        )
        thrust = (0.0, 0.0, -a.throttle) if a.quad else (a.throttle, 0.0, 0.0)
        self._data("vehicle_thrust_setpoint", self._us, *thrust)
        sampled_us = max(0, self._us - _HALF_READ_US)
        for i, (raw, field) in enumerate(zip(a.raw_mg, a.published_mg, strict=True)):
            if raw is None:
                continue
            device = a.detected[i] & 0xFFFFFFFF
            self._data("sensor_mag", sampled_us, device, *(v / 1e3 for v in raw), 25.0, 0, instance=i)
            self._data("vehicle_magnetometer", sampled_us, device, *(v / 1e3 for v in field), 1, instance=i)

    def _fast(self, m: Moment) -> None:
        a, imu = m.autopilot, m.inertial[0]
        self._data("sensor_combined", *imu.rate_rads, 20_000, 0, *imu.force_mss, 20_000, 0, 0, 1, 1)
        self._data("vehicle_angular_velocity", self._us, *imu.rate_rads, 0.0, 0.0, 0.0)
        (sr, cr), (sp, cp), (sy, cy) = (
            (math.sin(x / 2), math.cos(x / 2)) for x in (a.roll_rad, a.pitch_rad, a.yaw_rad)
        )
        q = (
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        )
        self._data("vehicle_attitude", self._us, *q, 1.0, 0.0, 0.0, 0.0, 0)

    def _place(self, m: Moment) -> None:
        a, s = m.autopilot, m.autopilot.state
        lat, lon, alt = m.position
        self._data(
            "vehicle_local_position", self._us, 0, a.home.lat_deg, a.home.lon_deg, s.north_m, s.east_m, -s.height_m,
            s.vn_mps, s.ve_mps, s.vd_mps, math.remainder(a.yaw_rad, math.tau), a.home.alt_m, 0.5, 0.5,
            *[True] * 6,
        )  # fmt: skip
        self._data("vehicle_global_position", self._us, lat, lon, alt, alt, 0.5, 0.5, False)

    def _fix(self, m: Moment) -> None:
        s = m.autopilot.state
        speed, course = m.over_ground
        lat, lon, alt = m.position
        self._data(
            "vehicle_gps_position", self._us, m.autopilot.unix_ns // 1000, lat, lon, alt, alt, 0, 0.3, 0.6, 0.9, 0.8,
            1.2, speed, s.vn_mps, s.ve_mps, s.vd_mps, course, 0, 3, True, 14,
        )  # fmt: skip


def native(a: Px4) -> dict[str, int | float]:
    """PX4's own parameters, int where they are int32."""
    table = a.parameters
    return {n: int(table[n]) if table.kind(n) == INT32 else table[n] for n in table.names}
