"""ULog files by hand, after the file format's specification and not after any reader."""

import struct
from pathlib import Path

import numpy as np

_CODES = {"uint64_t": "Q", "float": "f", "double": "d", "int32_t": "i", "uint32_t": "I", "uint8_t": "B", "bool": "?"}

TOPICS = {
    "sensor_mag": "uint64_t timestamp;uint64_t timestamp_sample;uint32_t device_id;float x;float y;float z;",
    "sensor_mag_old": "uint64_t timestamp;float x;float y;float z;float scaling;",
    "vehicle_magnetometer": "uint64_t timestamp;uint64_t timestamp_sample;uint32_t device_id;float[3] magnetometer_ga;",
    "vehicle_magnetometer_old": "uint64_t timestamp;float[3] magnetometer_ga;",
    "magnetometer_bias_estimate": "uint64_t timestamp;float[4] bias_x;float[4] bias_y;float[4] bias_z;bool[4] valid;",
    "sensor_combined": "uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2;",
    "sensor_combined_old": "uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2;"
    "int32_t magnetometer_timestamp_relative;float[3] magnetometer_ga;",
    "vehicle_attitude": "uint64_t timestamp;uint64_t timestamp_sample;float[4] q;",
    "vehicle_attitude_old": "uint64_t timestamp;float rollspeed;float pitchspeed;float yawspeed;float[4] q;",
    "vehicle_angular_velocity": "uint64_t timestamp;uint64_t timestamp_sample;float[3] xyz;",
    "vehicle_global_position": "uint64_t timestamp;double lat;double lon;float alt;",
    "sensor_gps": "uint64_t timestamp;uint64_t time_utc_usec;double latitude_deg;double longitude_deg;"
    "double altitude_msl_m;uint8_t fix_type;",
    "vehicle_gps_position": "uint64_t timestamp;uint64_t time_utc_usec;int32_t lat;int32_t lon;int32_t alt;"
    "int32_t timestamp_time_relative;uint8_t fix_type;",
    "vehicle_local_position": "uint64_t timestamp;float vx;float vy;float z;bool v_xy_valid;bool z_valid;",
    "battery_status": "uint64_t timestamp;float current_a;",
    "actuator_controls_0": "uint64_t timestamp;float[8] control;",
    "vehicle_thrust_setpoint": "uint64_t timestamp;float[3] xyz;",
    "vehicle_status": "uint64_t timestamp;uint8_t arming_state;uint8_t system_type;uint8_t vehicle_type;",
    "vehicle_land_detected": "uint64_t timestamp;bool landed;",
}
"""Name to fields; a name that ends in _old is an older release's form of the topic."""


class Ulog:
    """One file in the making; rows may come in any order of topics, their times are the caller's."""

    def __init__(self, start_us: int = 5_000_000, topics: dict[str, str] | None = None) -> None:
        self._start_us = start_us
        self._formats = TOPICS if topics is None else topics
        self._head: list[bytes] = [_message(b"B", bytes(40))]
        self._known: dict[tuple[str, int], int] = {}
        self._data: list[bytes] = []
        self.params: dict[str, float] = {}

    def row(self, topic: str, *values: object, instance: int = 0) -> None:
        """One message; vectors may be given as such."""
        key = (topic, instance)
        name = topic.removesuffix("_old")
        if key not in self._known:
            self._known[key] = len(self._known) + 7
            self._head.append(_message(b"F", f"{name}:{self._formats[topic]}".encode()))
            subscribe = struct.pack("<BH", instance, self._known[key]) + name.encode()
            self._data.append(_message(b"A", subscribe))
        flat = [v for value in values for v in np.ravel(value).tolist()]
        self._data.append(_message(b"D", struct.pack("<H", self._known[key]) + struct.pack(self._code(topic), *flat)))

    def _code(self, topic: str) -> str:
        out = "<"
        for field in self._formats[topic].rstrip(";").split(";"):
            kind = field.split(" ")[0]
            base, _, size = kind.partition("[")
            out += _CODES[base] * int(size.rstrip("]") or 1) if size else _CODES[base]
        return out

    def change(self, name: str, value: float) -> None:
        """A parameter that moved, at the time of the row before."""
        self._data.append(_parameter(name, value))

    def dropout(self, ms: int) -> None:
        """What the logger could not keep up with."""
        self._data.append(_message(b"O", struct.pack("<H", ms)))

    def sync(self) -> None:
        """The mark by which a reader finds its way again."""
        self._data.append(_message(b"S", bytes.fromhex("2f731320250cbb12")))

    def raw(self, data: bytes) -> None:
        """Bytes as they are."""
        self._data.append(data)

    def bytes(self) -> bytes:
        """The whole file."""
        params = [_parameter(name, value) for name, value in self.params.items()]
        start = bytes.fromhex("554c6f67011235") + b"\x01" + struct.pack("<Q", self._start_us)
        return start + b"".join([*self._head, *params, *self._data])

    def write(self, path: Path) -> Path:
        """The whole file, on disk."""
        path.write_bytes(self.bytes())
        return path


def _message(kind: bytes, payload: bytes) -> bytes:
    return struct.pack("<H", len(payload)) + kind + payload


def _parameter(name: str, value: float) -> bytes:
    kind, code = ("int32_t", "i") if isinstance(value, int) else ("float", "f")
    key = f"{kind} {name}".encode()
    return _message(b"P", bytes([len(key)]) + key + struct.pack("<" + code, value))
