"""What is in each message PX4 sends where that differs from ArduPilot (autopilots.md 4.1)."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav_sim.messages import BUILDERS as ARDUPILOTS
from magmav_sim.messages import i16, uid2

if TYPE_CHECKING:
    from magmav_sim.px4 import Px4

_G = 9.80665
_INERTIAL, _MAG, _OTHER = 0b111111, 0b111000000, 0b1111000000000
_AUTO, _MANUAL = 0x04 | 0x08 | 0x10 | 0x01, 0x40 | 0x10 | 0x01  # base_mode: auto, guided, stabilised, custom


def _heartbeat(a: Px4) -> Any:
    status = dialect.MAV_STATE_ACTIVE if a.armed else dialect.MAV_STATE_STANDBY
    base = _AUTO if a.mode >> 16 & 0xFF == a.MAIN_AUTO else _MANUAL
    return dialect.MAVLink_heartbeat_message(
        a.kind, dialect.MAV_AUTOPILOT_PX4, base | (0x80 if a.armed else 0), a.mode, status, 3
    )


def _scaled(kind: Any, compass: int) -> Callable[[Px4], Any]:
    """Accelerometer and gyro calibrated in body axes, the field as the sensor gives it in its own."""

    def build(a: Px4) -> Any:
        if compass > max(a.imus, len(a.raw_mg)):
            return None
        s, bias = a.state, a.gyro_bias_rads
        field = (a.raw_mg[compass - 1] if compass <= len(a.raw_mg) else None) or (0.0, 0.0, 0.0)
        return kind(
            a.boot_ms,
            *(i16((f + a.jitter()) * 1000 / _G) for f in (s.force_x_mss, s.force_y_mss, s.force_z_mss)),
            *(i16((w + b) * 1000) for w, b in zip((s.p_rads, s.q_rads, s.r_rads), bias, strict=True)),
            *(i16(value) for value in field),
            3500,
        )

    return build


def _highres(a: Px4) -> Any:
    """Everything corrected and less what the filter has learnt; the field is marked only when it is new."""
    s = a.state
    fresh, a.shown_reads = a.reads != a.shown_reads, a.reads
    gauss = (v / 1e3 for v in a.trusted_mg)
    return dialect.MAVLink_highres_imu_message(
        a.boot_ns // 1000, s.force_x_mss + a.jitter(), s.force_y_mss + a.jitter(), s.force_z_mss + a.jitter(),
        s.p_rads, s.q_rads, s.r_rads, *gauss, 1013.25, 0.0, a.home.alt_m + s.height_m, 35.0,
        _INERTIAL | _OTHER | (_MAG if fresh and any(a.trusted_mg) else 0), 0,
    )  # fmt: skip


def _attitude(a: Px4) -> Any:
    """As ArduPilot's, with the gyro's bias taken away."""
    message, s = ARDUPILOTS["ATTITUDE"](a), a.state
    message.rollspeed, message.pitchspeed, message.yawspeed = s.p_rads, s.q_rads, s.r_rads
    return message


def _quaternion(a: Px4) -> Any:
    message, s = ARDUPILOTS["ATTITUDE_QUATERNION"](a), a.state
    message.rollspeed, message.pitchspeed, message.yawspeed = s.p_rads, s.q_rads, s.r_rads
    return message


def _version(a: Px4) -> Any:
    # float missions, integer missions and commands, MAVLink 2; that parameters go by bytes is said by newer ones only
    capabilities = 0x0001 | 0x0004 | 0x0008 | 0x2000 | (0x0010 if a.newer else 0x0002)
    return dialect.MAVLink_autopilot_version_message(
        capabilities, 0x010E00FF, 0, 0, 0, bytes(8), bytes(8), bytes(8), 0, 0, a.uid, uid2(a)
    )


def _reports(a: Px4) -> Any:
    """One for each compass that has a slot, after its parameters were looked at anew: gauss, sensor axes, to be
    subtracted."""
    return [
        dialect.MAVLink_mag_cal_report_message(
            compass, 0, dialect.MAG_CAL_SUCCESS, 1, 0.0, *offset, *diagonal, *off_diagonal, 0.0, rotation, rotation, 1.0
        )
        for compass, offset, diagonal, off_diagonal, rotation in a.reports()
    ]


_SHARED = (
    "SYS_STATUS", "SYSTEM_TIME", "GLOBAL_POSITION_INT", "GPS_RAW_INT", "VFR_HUD", "BATTERY_STATUS",
    "EXTENDED_SYS_STATE",
)  # fmt: skip
BUILDERS: dict[str, Callable[[Any], Any]] = {
    "HEARTBEAT": _heartbeat,
    **{name: ARDUPILOTS[name] for name in _SHARED},
    "SCALED_IMU": _scaled(dialect.MAVLink_scaled_imu_message, 1),
    "SCALED_IMU2": _scaled(dialect.MAVLink_scaled_imu2_message, 2),
    "SCALED_IMU3": _scaled(dialect.MAVLink_scaled_imu3_message, 3),
    "HIGHRES_IMU": _highres,
    "ATTITUDE": _attitude,
    "ATTITUDE_QUATERNION": _quaternion,
    "AUTOPILOT_VERSION": _version,
    "MAG_CAL_REPORT": _reports,
}
"""Message name to the function that builds it, or several of it. There is no RAW_IMU."""
