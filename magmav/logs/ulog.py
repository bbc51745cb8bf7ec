"""PX4's ULog as readings: the uORB topics of every release since 1.5, under the names each gave its fields.

Units of PX4 (gauss, degrees or 1e-7 degrees, metres or millimetres) end here; its axes are ours: body forward, right,
down, earth north, east, down, quaternions from body to earth. One kind of field stays as logged: sensor_mag in the
sensor's own axes (mavlink/autopilot/px4 turns it, because only the parameters say how).
"""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magmav.core.rotation import euler_from_quaternion
from magmav.core.types import (
    AttitudeReading,
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
    VehicleReading,
    vec3,
)
from magmav.logs import LogError, Progress
from magmav.logs.ulog_compass import compasses
from magmav.logs.ulog_file import Topic, UlogFile

_PX4 = 12  # MAV_AUTOPILOT
_COMPONENT = 1
_ECHO = 65535
_ARMED = 2  # vehicle_status.arming_state, in every release
_STANDBY, _ACTIVE = 3, 4  # MAV_STATE
_KIND_OF = {1: 2, 2: 1, 3: 10, 4: 7}  # vehicle_status.vehicle_type to MAV_TYPE: quadrotor, fixed wing, rover, airship
_FIX_3D = 3
_RATE_NEAR_US = 200_000  # a body rate further from an attitude does not belong to it
_2010_US, _2096_US = 1_262_304_000_000_000, 4_000_000_000_000_000
_MOST_RADS, _MOST_MSS, _MOST_MG = 100.0, 1e4, 1e5  # as in mavlink.decode: what is beyond is damage
_MAGNETOMETERS = ("sensor_mag", "vehicle_magnetometer", "sensor_combined")
_WANTED = (
    *_MAGNETOMETERS,
    "vehicle_attitude",
    "vehicle_angular_velocity",
    "vehicle_global_position",
    "vehicle_gps_position",
    "sensor_gps",
    "vehicle_local_position",
    "battery_status",
    "actuator_controls_0",
    "vehicle_thrust_setpoint",
    "vehicle_status",
    "vehicle_land_detected",
    "magnetometer_bias_estimate",
)
Timed = tuple[int, Reading]


class UlogRecording:
    """One .ulg file. Read whole when opened; ``progress`` is told of bytes.

    heard : messages of the topics that are read.  LogError: not a ULog, broken, or without a magnetometer.
    """

    def __init__(self, path: str | Path, progress: Progress | None = None) -> None:
        self.name = f"ulog:{path}"
        file = UlogFile(Path(path), _WANTED, progress)
        self.counts: Counter[str] = file.counts
        self.heard: Counter[str] = Counter({name: sum(map(len, topics)) for name, topics in file.topics.items()})
        self._file: UlogFile | None = file
        self._compasses = compasses(file.topics, file.parameters, self.counts)
        if not self._compasses:
            found = ", ".join(f"{n} {name}" for name, n in self.heard.most_common(6)) or "nothing that is read here"
            raise LogError(
                f"{path}: no magnetometer in it (found {found}); "
                "log sensor_mag or vehicle_magnetometer (SDLOG_PROFILE 1 and 8 do)"
            )
        self.system = _system(file)
        times = [(t.unix_ns - t.boot_ns) for _, t in self._times() if isinstance(t, TimeReading)]
        self.unix_offset_ns = int(np.median(times)) if times else 0

    def readings(self) -> Iterator[Timed]:
        """(t_ns, reading) in the order of time; t_ns is the vehicle's boot clock. Once through."""
        file = self._file
        if file is None:
            return
        streams: list[Iterable[Timed]] = [self._params(file), self._vehicle(file)]
        streams += [self._times(), self._landed(file), self._attitude(file), self._inertial(file)]
        streams += [self._positions(file), self._motion(file), self._battery(file), self._throttle(file)]
        streams += [self._mags(n) for n in self._compasses]
        # Equal times come out in the order of the streams: parameters first, what they correct last.
        yield from heapq.merge(*streams, key=lambda timed: timed[0])
        self.close()

    def in_runs(self) -> Iterator[tuple[int, Reading]]:
        """The same: nothing is read in runs here."""
        return self.readings()

    def close(self) -> None:
        """Let go of what was read. Safe to call twice."""
        self._file = None

    def _start_ns(self, file: UlogFile) -> int:
        firsts = [int(t.t_us[0]) for topics in file.topics.values() for t in topics]
        firsts += [int(c.t_us[0]) for c in self._compasses.values()]
        return 1000 * max(0, min([file.start_us, *firsts]))

    def _params(self, file: UlogFile) -> Iterator[Timed]:
        start_ns = self._start_ns(file)
        for name, value in file.parameters.items():
            yield start_ns, ParamReading(self.system, _COMPONENT, name, value, _ECHO, 0)
        latest = start_ns
        for t_us, name, value in file.changes:
            latest = max(latest, 1000 * t_us)
            yield latest, ParamReading(self.system, _COMPONENT, name, value, _ECHO, 0)

    def _vehicle(self, file: UlogFile) -> Iterator[Timed]:
        """Who it is at once, armed as the log goes on: it may begin in flight, but no earlier than it begins."""
        status = _one(file, "vehicle_status")
        kind = int(file.parameters.get("MAV_TYPE", 0))
        types = None if status is None else status.first("system_type")
        if types is not None and types.any():
            kind = int(types[types != 0][0])
        broad = None if status is None else status.first("vehicle_type")
        if kind == 0 and broad is not None:
            kind = _KIND_OF.get(int(broad[0]), 0)
        yield self._start_ns(file), VehicleReading(self.system, _COMPONENT, _PX4, kind, False, _STANDBY)
        states = None if status is None else status.first("arming_state")
        if status is None or states is None:
            return
        for t_ns, armed in zip(_ns(status), (states == _ARMED).tolist(), strict=True):
            yield t_ns, VehicleReading(self.system, _COMPONENT, _PX4, kind, armed, _ACTIVE if armed else _STANDBY)

    def _mags(self, number: int) -> Iterator[Timed]:
        c = self._compasses[number]
        good = self._usable(c.source, c.field_mg, _MOST_MG) & c.field_mg.any(axis=1)
        for t_ns, field in zip((1000 * c.t_us[good]).tolist(), c.field_mg[good], strict=True):
            yield t_ns, MagReading(self.system, number, c.source, t_ns, vec3(field, "field"), c.device_id)

    def _attitude(self, file: UlogFile) -> Iterator[Timed]:
        topic = _one(file, "vehicle_attitude")
        if topic is None or any(f"q[{i}]" not in topic for i in range(4)):
            return
        rates = _rates(file, topic)
        if rates is None:
            self.counts["vehicle_attitude: no body rates anywhere"] += len(topic)
            return
        q = np.column_stack([topic.column(f"q[{i}]").astype(np.float64) for i in range(4)])
        good = self._usable("vehicle_attitude", np.hstack([q, rates]), _MOST_RADS)
        for t_ns, wxyz, rate in zip(_ns(topic.rows(good)), q[good].tolist(), rates[good], strict=True):
            angles = euler_from_quaternion(*wxyz)
            if angles is None:
                self.counts["vehicle_attitude: not a rotation"] += 1
                continue
            yield t_ns, AttitudeReading(self.system, "vehicle_attitude", t_ns, *angles, vec3(rate, "rate"))

    def _inertial(self, file: UlogFile) -> Iterator[Timed]:
        topic = _one(file, "sensor_combined")
        force = None if topic is None else topic.vectors("accelerometer_m_s2")
        rate = None if topic is None else topic.vectors("gyro_rad")
        if topic is None or force is None or rate is None:
            return
        good = self._usable("sensor_combined", force, _MOST_MSS) & self._usable("sensor_combined", rate, _MOST_RADS)
        for t_ns, f, r in zip(_ns(topic.rows(good)), force[good], rate[good], strict=True):
            yield t_ns, InertialReading(self.system, "sensor_combined", t_ns, vec3(f, "force"), vec3(r, "rate"))

    def _positions(self, file: UlogFile) -> Iterator[Timed]:
        found = [t for n in ("vehicle_global_position", "vehicle_gps_position", "sensor_gps") if (t := _one(file, n))]
        return heapq.merge(*(self._position(t) for t in found), key=lambda timed: timed[0])

    def _position(self, topic: Topic) -> Iterator[Timed]:
        lat, lon = topic.first("latitude_deg", "lat"), topic.first("longitude_deg", "lon")
        alt = topic.first("altitude_msl_m", "alt")
        if lat is None or lon is None or alt is None:
            return
        whole = lat.dtype.kind in "iu"  # GPS up to 1.14: 1e-7 degrees and millimetres
        rows = np.column_stack([lat / 1e7, lon / 1e7, alt / 1e3] if whole else [lat, lon, alt])
        good = self._usable(topic.name, rows, 1e5) & (abs(rows[:, 0]) <= 90.0) & (abs(rows[:, 1]) <= 180.0)
        good &= rows[:, :2].any(axis=1)
        fix, valid = topic.first("fix_type"), topic.first("lat_lon_valid")
        good &= True if fix is None else fix >= _FIX_3D
        good &= True if valid is None else valid != 0
        for t_ns, row in zip(_ns(topic.rows(good)), rows[good].tolist(), strict=True):
            yield t_ns, PositionReading(self.system, topic.name, t_ns, *row)

    def _times(self) -> Iterator[Timed]:
        """UNIX time as the GPS tells it; the receiver's own delay is taken off where the log knows it."""
        file = self._file
        topic = None if file is None else _one(file, "vehicle_gps_position") or _one(file, "sensor_gps")
        utc = None if topic is None else topic.first("time_utc_usec")
        if topic is None or utc is None:
            return
        late = topic.first("timestamp_time_relative")
        for i in np.flatnonzero((utc > _2010_US) & (utc < _2096_US)).tolist():
            boot_us = int(topic.t_us[i]) + (0 if late is None or abs(int(late[i])) > 1_000_000 else int(late[i]))
            t_ns = 1000 * int(topic.t_us[i])
            yield t_ns, TimeReading(self.system, 1000 * boot_us, 1000 * int(utc[i]))

    def _motion(self, file: UlogFile) -> Iterator[Timed]:
        topic = _one(file, "vehicle_local_position")
        if topic is None or any(f not in topic for f in ("vx", "vy", "z")):
            return
        rows = np.column_stack([topic.column(f).astype(np.float64) for f in ("vx", "vy", "z")])
        good = self._usable(topic.name, rows, 1e5)
        for flag in ("v_xy_valid", "z_valid"):
            good &= topic.column(flag) != 0 if flag in topic else True
        for t_ns, (north, east, down) in zip(_ns(topic.rows(good)), rows[good].tolist(), strict=True):
            yield t_ns, MotionReading(self.system, t_ns, north, east, -down)

    def _battery(self, file: UlogFile) -> Iterator[Timed]:
        """The battery that CAL_MAG_COMP_TYP compensates by, else the first."""
        topic = _one(file, "battery_status", 1 if file.parameters.get("CAL_MAG_COMP_TYP") == 3 else 0)
        ampere = None if topic is None else topic.first("current_a")
        if topic is None or ampere is None:
            return
        good = np.isfinite(ampere) & (ampere >= 0) & (ampere < 1e4)
        for t_ns, a in zip(_ns(topic.rows(good)), ampere[good].tolist(), strict=True):
            yield t_ns, CurrentReading(self.system, "battery_status", float(a))

    def _throttle(self, file: UlogFile) -> Iterator[Timed]:
        topic, thrust = _one(file, "actuator_controls_0"), None
        if topic is not None:
            thrust = topic.first("control[3]")
        elif (topic := _one(file, "vehicle_thrust_setpoint")) is not None:
            vectors = topic.vectors("xyz")
            thrust = None if vectors is None else np.linalg.norm(vectors, axis=1)
        if topic is None or thrust is None:
            return
        good = np.isfinite(thrust) & (thrust >= 0) & (thrust <= 1.001)
        for t_ns, share in zip(_ns(topic.rows(good)), thrust[good].tolist(), strict=True):
            yield t_ns, ThrottleReading(self.system, min(float(share), 1.0))

    def _landed(self, file: UlogFile) -> Iterator[Timed]:
        topic = _one(file, "vehicle_land_detected")
        landed = None if topic is None else topic.first("landed")
        if topic is None or landed is None:
            return
        for t_ns, down in zip(_ns(topic), (landed != 0).tolist(), strict=True):
            yield t_ns, LandedReading(self.system, Landed.ON_GROUND if down else Landed.IN_AIR)

    def _usable(self, name: str, rows: NDArray[Any], most: float) -> NDArray[np.bool_]:
        """Rows of finite numbers no larger than ``most``; the others are counted."""
        good: NDArray[np.bool_] = np.isfinite(rows).all(axis=1) & (np.abs(np.nan_to_num(rows)) <= most).all(axis=1)
        if not good.all():
            self.counts[f"{name}: not a number, or beyond belief"] += int((~good).sum())
        return good


def _one(file: UlogFile, name: str, instance: int = 0) -> Topic | None:
    """This instance of a topic, else its first, or None."""
    topics = file.topics.get(name, [])
    return next((t for t in topics if t.instance == instance), topics[0] if topics else None)


def _ns(topic: Topic) -> list[int]:
    out: list[int] = (1000 * topic.t_us).tolist()
    return out


def _system(file: UlogFile) -> int:
    said = file.parameters.get("MAV_SYS_ID", 1)
    return int(said) if 1 <= said <= 255 and math.floor(said) == said else 1


def _rates(file: UlogFile, attitude: Topic) -> NDArray[np.float64] | None:
    """Body rates (n, 3) at the attitude's times: its own in old logs, else a rate topic's, NaN where none is near."""
    if all(f in attitude for f in ("rollspeed", "pitchspeed", "yawspeed")):
        names = ("rollspeed", "pitchspeed", "yawspeed")
        return np.column_stack([attitude.column(f).astype(np.float64) for f in names])
    for name, field in (("vehicle_angular_velocity", "xyz"), ("sensor_combined", "gyro_rad")):
        topic = _one(file, name)
        rates = None if topic is None else topic.vectors(field)
        if topic is not None and rates is not None:
            columns = [np.interp(attitude.t_us, topic.t_us, rates[:, i]) for i in range(3)]
            after = np.searchsorted(topic.t_us, attitude.t_us)
            either = [topic.t_us[np.clip(i, 0, len(topic) - 1)] for i in (after - 1, after)]
            away_us = np.minimum(*(np.abs(t - attitude.t_us) for t in either))
            return np.where((away_us < _RATE_NEAR_US)[:, None], np.column_stack(columns), np.nan)
    return None
