"""The topics of a ULog as PX4 1.14 names and types them, with the fields this simulation knows.

A ULog describes itself, so a topic may be shorter than PX4's own; what is there has PX4's name, type and unit.
"""

from __future__ import annotations

STRUCT = {
    "int8_t": "b", "uint8_t": "B", "bool": "?", "int16_t": "h", "uint16_t": "H", "int32_t": "i", "uint32_t": "I",
    "int64_t": "q", "uint64_t": "Q", "float": "f", "double": "d",
}  # fmt: skip
"""ULog type to the letter of Python's struct."""

_STAMPS = "uint64_t timestamp;uint64_t timestamp_sample;"

TOPICS = {
    "sensor_mag": _STAMPS + "uint32_t device_id;float x;float y;float z;float temperature;uint32_t error_count;",
    "vehicle_magnetometer": _STAMPS + "uint32_t device_id;float[3] magnetometer_ga;uint8_t calibration_count;",
    "sensor_combined": "uint64_t timestamp;float[3] gyro_rad;uint32_t gyro_integral_dt;"
    "int32_t accelerometer_timestamp_relative;float[3] accelerometer_m_s2;uint32_t accelerometer_integral_dt;"
    "uint8_t accelerometer_clipping;uint8_t gyro_clipping;uint8_t accel_calibration_count;"
    "uint8_t gyro_calibration_count;",
    "vehicle_angular_velocity": _STAMPS + "float[3] xyz;float[3] xyz_derivative;",
    "vehicle_attitude": _STAMPS + "float[4] q;float[4] delta_q_reset;uint8_t quat_reset_counter;",
    "vehicle_local_position": _STAMPS + "uint64_t ref_timestamp;double ref_lat;double ref_lon;"
    "float x;float y;float z;float vx;float vy;float vz;float heading;float ref_alt;float eph;float epv;"
    "bool xy_valid;bool z_valid;bool v_xy_valid;bool v_z_valid;bool xy_global;bool z_global;",
    "vehicle_global_position": _STAMPS + "double lat;double lon;float alt;float alt_ellipsoid;float eph;float epv;"
    "bool dead_reckoning;",
    "vehicle_gps_position": _STAMPS + "uint64_t time_utc_usec;double latitude_deg;double longitude_deg;"
    "double altitude_msl_m;double altitude_ellipsoid_m;uint32_t device_id;float s_variance_m_s;float eph;float epv;"
    "float hdop;float vdop;float vel_m_s;float vel_n_m_s;float vel_e_m_s;float vel_d_m_s;float cog_rad;"
    "int32_t timestamp_time_relative;uint8_t fix_type;bool vel_ned_valid;uint8_t satellites_used;",
    "battery_status": "uint64_t timestamp;float voltage_v;float voltage_filtered_v;float current_a;"
    "float current_filtered_a;float discharged_mah;float remaining;uint8_t cell_count;bool connected;uint8_t id;"
    "uint8_t warning;",
    "vehicle_thrust_setpoint": _STAMPS + "float[3] xyz;",
    "vehicle_status": "uint64_t timestamp;uint64_t armed_time;uint64_t takeoff_time;uint8_t arming_state;"
    "uint8_t nav_state;uint8_t hil_state;uint8_t vehicle_type;bool failsafe;uint8_t system_type;uint8_t system_id;"
    "uint8_t component_id;bool pre_flight_checks_pass;",
    "vehicle_land_detected": "uint64_t timestamp;bool freefall;bool ground_contact;bool maybe_landed;bool landed;"
    "bool in_ground_effect;",
}


def layout(fields: str) -> tuple[str, int]:
    """Letters for Python's struct, one per number, and the padding that C puts behind them, bytes.

    fields : as in TOPICS, widest types first, so that only the end needs padding (which a ULog names and leaves out).
    """
    letters, size, widest = "", 0, 1
    for field in fields.rstrip(";").split(";"):
        kind, _, many = field.partition(" ")[0].partition("[")
        count = int(many.rstrip("]")) if many else 1
        width = {"b": 1, "B": 1, "?": 1, "h": 2, "H": 2, "i": 4, "I": 4, "f": 4}.get(STRUCT[kind], 8)
        if size % width:
            raise ValueError(f"field {field!r}: wider than those before it")
        letters, size, widest = letters + STRUCT[kind] * count, size + width * count, max(widest, width)
    return letters, -size % widest
