"""What is in each message ArduPilot sends: units, casts and invalid values as 4.5 has them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

if TYPE_CHECKING:
    from magmav_sim.autopilot import Autopilot

_G = 9.80665


def i16(value: float) -> int:
    """C's cast: towards zero. (The cast of a value beyond int16 is undefined in C; here it wraps.)"""
    return (int(value) + 32768) % 65536 - 32768


def _inertial(a: Autopilot, compass: int) -> tuple[int, ...]:
    s, bias = a.state, a.gyro_bias_rads
    field = a.published_mg[compass - 1] if compass <= len(a.published_mg) else (0.0, 0.0, 0.0)
    return (
        i16((s.force_x_mss + a.jitter()) * 1000 / _G),
        i16((s.force_y_mss + a.jitter()) * 1000 / _G),
        i16((s.force_z_mss + a.jitter()) * 1000 / _G),
        i16((s.p_rads + bias[0]) * 1000),
        i16((s.q_rads + bias[1]) * 1000),
        i16((s.r_rads + bias[2]) * 1000),
        i16(field[0]),
        i16(field[1]),
        i16(field[2]),
    )


def _scaled(kind: Any, compass: int) -> Callable[[Autopilot], Any]:
    def build(a: Autopilot) -> Any:
        if compass > max(a.imus, len(a.published_mg)):
            return None
        return kind(a.boot_ms, *_inertial(a, compass), 3500)

    return build


def _heartbeat(a: Autopilot) -> Any:
    mode = 0x59 if a.kind == dialect.MAV_TYPE_QUADROTOR else 0x51
    status = dialect.MAV_STATE_ACTIVE if a.armed else dialect.MAV_STATE_STANDBY
    return dialect.MAVLink_heartbeat_message(
        a.kind, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA, mode | (0x80 if a.armed else 0), a.mode, status, 3
    )


def _attitude(a: Autopilot) -> Any:
    s, b = a.state, a.gyro_bias_rads
    return dialect.MAVLink_attitude_message(
        a.boot_ms, a.roll_rad, a.pitch_rad, math.remainder(a.yaw_rad, math.tau),
        s.p_rads + b[0], s.q_rads + b[1], s.r_rads + b[2],
    )  # fmt: skip


def _quaternion(a: Autopilot) -> Any:
    s, b = a.state, a.gyro_bias_rads
    (sr, cr), (sp, cp), (sy, cy) = ((math.sin(x / 2), math.cos(x / 2)) for x in (a.roll_rad, a.pitch_rad, a.yaw_rad))
    return dialect.MAVLink_attitude_quaternion_message(
        a.boot_ms,
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        s.p_rads + b[0],
        s.q_rads + b[1],
        s.r_rads + b[2],
    )


def _position(a: Autopilot) -> Any:
    s, home = a.state, a.home
    lat, lon = home.at(s.north_m, s.east_m)
    heading = round(math.degrees(a.yaw_rad % math.tau) * 100) % 36000
    return dialect.MAVLink_global_position_int_message(
        a.boot_ms, round(lat * 1e7), round(lon * 1e7), round((home.alt_m + s.height_m) * 1000),
        round(s.height_m * 1000), i16(s.vn_mps * 100), i16(s.ve_mps * 100), i16(s.vd_mps * 100), heading,
    )  # fmt: skip


def _gps(a: Autopilot) -> Any:
    s, home = a.state, a.home
    lat, lon = home.at(s.north_m, s.east_m)
    speed = math.hypot(s.vn_mps, s.ve_mps)
    course = round(math.degrees(math.atan2(s.ve_mps, s.vn_mps) % math.tau) * 100) % 36000
    fix_us = a.boot_ms // 200 * 200_000  # the receiver gives five fixes a second
    return dialect.MAVLink_gps_raw_int_message(
        fix_us, 3, round(lat * 1e7), round(lon * 1e7), round((home.alt_m + s.height_m) * 1000),
        80, 120, round(speed * 100), course, 14,
    )  # fmt: skip


def _hud(a: Autopilot) -> Any:
    s = a.state
    return dialect.MAVLink_vfr_hud_message(
        s.airspeed_mps, math.hypot(s.vn_mps, s.ve_mps), int(math.degrees(a.yaw_rad % math.tau)) % 360,
        round(a.throttle * 100), a.home.alt_m + s.height_m, -s.vd_mps,
    )  # fmt: skip


def _battery(a: Autopilot) -> Any:
    return dialect.MAVLink_battery_status_message(
        0, 0, 1, 32767, [round(a.battery.volt * 1000)] + [65535] * 9, round(a.battery.measured_ampere * 100),
        round(a.battery.used_mah), -1, max(0, 100 - round(a.battery.used_mah / 52)),
    )  # fmt: skip


def _sys_status(a: Autopilot) -> Any:
    seen = 0x2F if any(any(f) for f in a.published_mg) else 0x2B  # bit 2: 3D magnetometer
    return dialect.MAVLink_sys_status_message(
        0x2F, 0x2F, seen, 230, round(a.battery.volt * 1000), round(a.battery.measured_ampere * 100),
        max(0, 100 - round(a.battery.used_mah / 52)), 0, 0, 0, 0, 0, 0,
    )  # fmt: skip


def _extended(a: Autopilot) -> Any:
    return dialect.MAVLink_extended_sys_state_message(0, a.landed_state)


def _system_time(a: Autopilot) -> Any:
    return dialect.MAVLink_system_time_message(a.unix_ns // 1000, a.boot_ms)


def _raw_imu(a: Autopilot) -> Any:
    return dialect.MAVLink_raw_imu_message(a.boot_ns // 1000, *_inertial(a, 1), 0, 3500)


def highres_of_a_bad_build(a: Autopilot) -> Any:
    """HIGHRES_IMU as later ArduPilots first had it: mG times 1000 in the name of gauss (autopilots.md 1.2)."""
    s, bias = a.state, a.gyro_bias_rads
    return dialect.MAVLink_highres_imu_message(
        a.boot_ns // 1000, s.force_x_mss + a.jitter(), s.force_y_mss + a.jitter(), s.force_z_mss + a.jitter(),
        s.p_rads + bias[0], s.q_rads + bias[1], s.r_rads + bias[2], *(v * 1e3 for v in a.published_mg[0]),
        1013.25, 0.0, a.home.alt_m + s.height_m, 35.0, 0b1111111111111, 0,
    )  # fmt: skip


def _version(a: Autopilot) -> Any:
    capabilities = 0x0001 | 0x0002 | 0x2000  # mission float, parameters as C casts, MAVLink 2
    # send_autopilot_version leaves uid at zero and says who the board is in uid2.
    return dialect.MAVLink_autopilot_version_message(
        capabilities, 0x040507FF, 0, 0, 0, bytes(8), bytes(8), bytes(8), 0, 0, 0, uid2(a)
    )


def uid2(a: Autopilot) -> bytes:
    """The board's number in 12 of 18 bytes."""
    return a.uid.to_bytes(12, "little") + bytes(6)


BUILDERS: dict[str, Callable[[Autopilot], Any]] = {
    "HEARTBEAT": _heartbeat,
    "SYS_STATUS": _sys_status,
    "SYSTEM_TIME": _system_time,
    "RAW_IMU": _raw_imu,
    "SCALED_IMU": _scaled(dialect.MAVLink_scaled_imu_message, 1),
    "SCALED_IMU2": _scaled(dialect.MAVLink_scaled_imu2_message, 2),
    "SCALED_IMU3": _scaled(dialect.MAVLink_scaled_imu3_message, 3),
    "ATTITUDE": _attitude,
    "ATTITUDE_QUATERNION": _quaternion,
    "GLOBAL_POSITION_INT": _position,
    "GPS_RAW_INT": _gps,
    "VFR_HUD": _hud,
    "BATTERY_STATUS": _battery,
    "EXTENDED_SYS_STATE": _extended,
    "AUTOPILOT_VERSION": _version,
}
"""Message name to the function that builds it; None where the vehicle has nothing to say."""
