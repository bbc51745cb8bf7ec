"""DataFlash readings: units, sources and times over fifteen years of log formats, and what a pipeline makes of them."""

from __future__ import annotations

import math
import os
import struct
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
from dataflash_writer import ARM, ATT, BAT, CTUN, EV, GPS, IMU, MAG, MSG, PARM, Log, Message, flight

from magmav.core.rotation import euler_rates, wrap_pi
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
    Record,
    ThrottleReading,
    TimeReading,
    VehicleReading,
)
from magmav.geomag import world_magnetic_model
from magmav.logs.dataflash_readings import DataflashRecording
from magmav.pipeline import Pipeline
from magmav.settings import Settings, with_value

LOGS = Path(os.environ.get("MAGMAV_DATA", Path(__file__).parents[2] / "shared" / "data")) / "logs"

R = TypeVar("R")


class Told:
    """A log's readings. ``of(kind)`` are those of one kind, in order."""

    def __init__(self, log: Log, folder: Path) -> None:
        path = folder / "told.bin"
        path.write_bytes(log.binary())
        self.recording = DataflashRecording(path)
        self.all = list(self.recording.readings())

    def of(self, kind: type[R]) -> list[R]:
        return [r for _, r in self.all if isinstance(r, kind)]


def moved(message: Message, **changes: Any) -> Message:
    return Message(**{f: getattr(message, f) for f in message.__dataclass_fields__} | changes)


def test_a_modern_copter_log_says_all_there_is(tmp_path: Path) -> None:
    told = Told(flight(3.0), tmp_path)
    mag = told.of(MagReading)
    assert {(m.compass, m.source, m.system) for m in mag} == {(1, "MAG", 7), (2, "MAG", 7)}
    assert mag[0].field_b_mg.tolist() == [200.0, 0.0, 430.0] and not mag[0].field_b_mg.flags.writeable
    assert mag[0].boot_ns == 5_001_200_000
    inertial = told.of(InertialReading)
    assert len(inertial) == 150  # the first of two IMUs
    assert inertial[0].force_b_mss == pytest.approx([0.0, 0.0, -9.80665], rel=1e-6)
    assert told.of(AttitudeReading)[9].yaw_rad == pytest.approx(0.4 * 0.9, abs=1e-4)
    assert {(p.source, p.lat_deg, p.lon_deg, p.alt_m) for p in told.of(PositionReading)} == {("POS", 47.4, 8.55, 500.0)}
    motion = told.of(MotionReading)[0]
    assert (motion.north_mps, motion.east_mps, motion.height_m) == pytest.approx((0.0, 3.0, 30.0), abs=1e-6)
    assert {c.ampere for c in told.of(CurrentReading)} == {12.5}
    assert {round(t.share, 6) for t in told.of(ThrottleReading)} == {0.45}
    assert {(v.autopilot, v.kind, v.component) for v in told.of(VehicleReading)} == {(3, 2, 1)}
    assert {p.name: p.value for p in told.of(ParamReading)}["COMPASS_OFS2_Y"] == 10.0
    assert not told.recording.counts


def test_parameters_come_before_other_readings_and_time_never_turns_back(tmp_path: Path) -> None:
    told = Told(flight(2.0), tmp_path)
    kinds = [type(r) for _, r in told.all]
    first = told.all[0][0]
    assert all(k is ParamReading for k in kinds[: kinds.count(ParamReading)])
    times = [t for t, _ in told.all]
    assert times == sorted(times) and first == 5_000_000_000


OLD_MAG = Message(1, "MAG", "IhhhhhhhhhB", "TimeMS,MagX,MagY,MagZ,OfsX,OfsY,OfsZ,MOfsX,MOfsY,MOfsZ,Health")
OLD_GPS = Message(
    2, "GPS", "BIHBcLLeeEefI", "Status,TimeMS,Week,NSats,HDop,Lat,Lng,RelAlt,Alt,Spd,GCrs,VZ,T"
)  # fmt: skip
OLD_CURR = Message(3, "CURR", "IhhhHfh", "TimeMS,Throttle,Volt,Curr,Vcc,CurrTot,Volt2")
OLD_CTUN = Message(4, "CTUN", "Ihhhff", "TimeMS,ThrIn,AngBst,ThrOut,DAlt,Alt")
OLD_PARM = Message(5, "PARM", "Nf", "Name,Value")
OLD_MSG, OLD_EV = Message(6, "MSG", "Z", "Message"), Message(7, "EV", "B", "Id")


def old_log() -> Log:
    """Copter 3.2 and 3.3: milliseconds, a message per compass, no units, PARM and EV without a time."""
    log = Log()
    log.add(OLD_PARM, "COMPASS_OFS_X", -97.5)
    log.add(OLD_MSG, "APM:Copter V3.3-dev (ae3192b8)")
    log.add(OLD_MSG, "Frame: HEXA")
    for k in range(40):
        ms = 11_000 + 100 * k
        for n, name in enumerate(("MAG", "MAG2", "MAG3")):
            log.add(moved(OLD_MAG, number=10 + n, name=name), ms, 100 * (n + 1), k, -500, *(0,) * 6, 1)
        log.add(OLD_CTUN, ms + 1, 500, 0, 450, 0.0, 12.0)
        log.add(OLD_CURR, ms + 2, 450, 1600, 2118, 5000, 1.0, 0)
        log.add(OLD_GPS, 3, 604_091_400 + 100 * k, 1871, 9, 1.5, -35.36, 149.16, 99.0, 590.0, 2.0, 180.0, 0.0, ms + 3)
        if k in (10, 30):
            log.add(OLD_EV, 10 if k == 10 else 11)
            log.add(OLD_PARM, "COMPASS_OFS_X", float(k))
    return log


def test_an_old_copter_log_says_the_same_in_its_own_way(tmp_path: Path) -> None:
    told = Told(old_log(), tmp_path)
    assert {(m.compass, m.source, m.field_b_mg[0]) for m in told.of(MagReading)} == {
        (1, "MAG", 100.0),
        (2, "MAG2", 200.0),
        (3, "MAG3", 300.0),
    }
    assert {c.ampere for c in told.of(CurrentReading)} == {21.18}  # hundredths, without a unit
    assert {t.share for t in told.of(ThrottleReading)} == {0.45}  # thousandths
    assert {m.height_m for m in told.of(MotionReading)} == {12.0}  # its own height before the one above home
    assert {v.kind for v in told.of(VehicleReading)} == {13}
    armed = [(t, r.armed) for t, r in told.all if isinstance(r, VehicleReading)]
    changes = [b[0] for a, b in pairwise(armed) if a[1] != b[1]]
    assert armed[0][1] is False and changes == [12_003_000_000, 14_003_000_000]  # the records before the events
    params = [(t, r.value) for t, r in told.all if isinstance(r, ParamReading)]
    assert params == [(11_000_000_000, -97.5), (12_003_000_000, 10.0), (14_003_000_000, 30.0)]


def test_gps_time_becomes_unix_time_by_the_leap_seconds_of_its_day(tmp_path: Path) -> None:
    old = Told(old_log(), tmp_path)
    first = old.of(TimeReading)[0]
    begin = datetime(1980, 1, 6, tzinfo=UTC)
    gps_s = 1871 * 604_800 + 604_091.4
    assert first.unix_ns / 1e9 == pytest.approx(begin.timestamp() + gps_s - 17, abs=1e-6)
    assert first.unix_ns - first.boot_ns == old.recording.unix_offset_ns
    new = Told(flight(1.0), tmp_path).of(TimeReading)[0]
    assert new.unix_ns / 1e9 == pytest.approx(begin.timestamp() + 2300 * 604_800 + 86_400 - 18, abs=1e-6)


def test_what_is_no_measurement_gives_no_reading_and_is_counted(tmp_path: Path) -> None:
    log = flight(1.0)
    at = 7_000_000
    log.add(MAG, at, 0, 0, 0, 0, *(0,) * 6, 1, at)
    log.add(MAG, at + 1, 0, 1, 2, 3, *(0,) * 6, 0, at)
    log.add(MAG, at + 2, 3, 1, 2, 3, *(0,) * 6, 1, at)
    log.add(IMU, at + 3, 0, math.nan, 0.0, 0.0, 0.0, 0.0, -9.8)
    log.add(IMU, at + 4, 0, 1e5, 0.0, 0.0, 0.0, 0.0, -9.8)
    log.add(BAT, at + 5, 0, 15.0, math.nan)
    log.add(PARM, at + 6, "lower case", 1.0, 0.0)
    log.add(PARM, at + 7, "COMPASS_OFS_X", math.nan, 0.0)
    told = Told(log, tmp_path)
    want = {
        "MAG: no compass (all zero)": 1,
        "MAG: not healthy": 1,
        "MAG: instance over 3": 1,
        "IMU: not a number": 2,  # read for the attitude's rates, and for itself
        "IMU: beyond belief": 2,
        "BAT: not a number": 1,
        "PARM: not believable": 2,
    }
    assert told.recording.counts == want
    assert max(r.boot_ns for r in told.of(MagReading)) < at * 1000
    assert {p.value for p in told.of(ParamReading) if p.name == "COMPASS_OFS_X"} == {10.0}


def test_a_signalling_nan_is_no_number_and_no_noise(tmp_path: Path) -> None:
    log = flight(1.0)
    raw = bytearray(log.binary())
    place = raw.rindex(IMU.body((5_981_000, 0, 0.0, 0.0, 0.4, 0.0, 0.0, -9.80665)))
    raw[place + 12 : place + 16] = struct.pack("<I", 0x7F800001)
    path = tmp_path / "nan.bin"
    path.write_bytes(raw)
    recording = DataflashRecording(path)
    assert recording.counts == {"IMU: not a number": 2}
    assert sum(isinstance(r, InertialReading) for _, r in recording.readings()) == 49


def test_an_angle_beyond_half_a_turn_is_the_same_angle_within(tmp_path: Path) -> None:
    log = flight(1.0)
    log.add(ATT, 5_950_000, 0.0, -181.05, 0.0, -2.23, 0.0, 270.0)
    last = Told(log, tmp_path).of(AttitudeReading)[-1]
    assert (last.roll_rad, last.pitch_rad, last.yaw_rad) == pytest.approx(
        (math.radians(178.95), math.radians(-2.23), -math.pi / 2), abs=1e-9
    )


def test_heading_from_the_body_rates_follows_what_happens_between_attitudes(tmp_path: Path) -> None:
    """A yaw that shakes at 10 Hz under a 10 Hz attitude: snapshots of the gyro meet one phase, means all of them."""

    def rate_rads(t: float) -> float:
        return 0.3 + 1.5 * math.sin(2 * math.pi * 10.0 * t)

    log = Log([(MSG, (1_000_000, "ArduCopter V4.5.1"))])
    truth, snapshots = [], []
    for k in range(1000):
        t, us = k / 100, 1_000_000 + k * 10_000
        log.add(IMU, us, 0, 0.0, 0.0, rate_rads(t), 0.0, 0.0, -9.8)
        if k % 10 == 3:
            log.add(ATT, us, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            truth.append(0.3 * t - 1.5 * (math.cos(2 * math.pi * 10.0 * t) - 1.0) / (2 * math.pi * 10.0))
            snapshots.append(rate_rads(t))
    told = Told(log, tmp_path).of(AttitudeReading)
    rates = [euler_rates(r.roll_rad, r.pitch_rad, r.rate_b_rads)[2] for r in told]
    kept = len(rates)
    assert kept >= 98  # the outermost have gyro on one side only

    def wander(r: list[float]) -> float:
        heading = np.cumsum([0.0, *(0.05 * (a + b) for a, b in pairwise(r))])
        error = heading - np.array(truth[:kept])
        return float(np.std(error))

    assert wander(snapshots[:kept]) > 1.0
    assert wander(rates) < 0.01


def test_one_attitude_source_serves_the_whole_file(tmp_path: Path) -> None:
    filter_ = Message(90, "XKF1", "QBccCff", "TimeUS,C,Roll,Pitch,Yaw,VN,VE", "s#ddhnn", "F-BBB00")
    log = flight(2.0)
    for k in range(20):
        for core in (0, 1):
            log.add(filter_, 5_001_000 + k * 100_000, core, 1.0 + core, 2.0, 3.0, 0.0, 0.0)
    assert {a.source for a in Told(log, tmp_path).of(AttitudeReading)} == {"ATT"}
    log.rows = [row for row in log.rows if row[0].name != "ATT"]
    told = Told(log, tmp_path).of(AttitudeReading)
    assert {(a.source, round(math.degrees(a.roll_rad), 6)) for a in told} == {("XKF1", 1.0)}


@pytest.mark.parametrize(
    ("said", "params", "throttle", "kind", "share"),
    [
        ("ArduCopter V4.5.1 (1)", {"FRAME_CLASS": 5.0}, 0.4, 13, 0.4),
        ("ArduCopter V4.5.1 (1)", {"FRAME_CLASS": 6.0}, 0.4, 4, 0.4),
        ("ArduPlane V4.5.1 (1)", {}, 40.0, 1, 0.4),
        ("ArduPlane V4.5.1 (1)", {"Q_ENABLE": 1.0}, 40.0, 22, 0.4),
        ("ArduRover V4.5.1 (1)", {"FRAME_CLASS": 2.0}, -40.0, 11, 0.4),
        ("APM:Copter V3.3", {}, 0.4, 2, 0.4),
        ("no name", {}, 0.4, 0, 0.4),
    ],
)
def test_the_firmware_and_the_frame_say_what_it_is(
    tmp_path: Path, said: str, params: dict[str, float], throttle: float, kind: int, share: float
) -> None:
    log = Log([(MSG, (1000, said)), *((PARM, (1000, n, v, 0.0)) for n, v in params.items())])
    for k in range(10):
        log.add(CTUN, 2000 + 100_000 * k, 0.0, throttle)
    told = Told(log, tmp_path)
    assert {v.kind for v in told.of(VehicleReading)} == {kind}
    assert {round(t.share, 6) for t in told.of(ThrottleReading)} == {share}


def armed_at(log: Log, folder: Path) -> list[tuple[float, bool]]:
    """(boot time in s, armed) of the first heartbeat and of every one that changed it."""
    beats = [(t / 1e9, r.armed) for t, r in Told(log, folder).all if isinstance(r, VehicleReading)]
    return [beats[0], *(b for a, b in pairwise(beats) if a[1] != b[1])]


def test_arming_is_what_the_log_says_or_else_what_the_throttle_shows(tmp_path: Path) -> None:
    def base() -> Log:
        log = Log([(MSG, (0, "ArduCopter V4.5.1 (1)"))])
        for k in range(101):
            log.add(CTUN, k * 100_000, 0.0, 0.4 if 20 <= k <= 80 else 0.0)
        return log

    assert armed_at(base(), tmp_path) == [(0.0, False), (2.0, True), (8.0, False)]
    only_armed = base()
    only_armed.add(PARM, 10_000_000, "LOG_DISARMED", 0.0, 0.0)
    assert armed_at(only_armed, tmp_path) == [(0.0, True)]
    events = base()
    for us, event in ((3_000_000, 10), (3_500_000, 15), (4_000_000, 28), (6_000_000, 18), (7_000_000, 11)):
        events.add(EV, us, event)
    events.rows.sort(key=lambda row: row[1][0])
    assert armed_at(events, tmp_path) == [(0.0, False), (3.0, True), (7.0, False)]
    landed = [(t / 1e9, r.state) for t, r in Told(events, tmp_path).all if isinstance(r, LandedReading)]
    assert landed == [(4.0, Landed.IN_AIR), (6.0, Landed.ON_GROUND)]
    events.rows.insert(60, (ARM, (5_000_000, 0, 0)))  # ARM outdoes EV; what first disarms was armed
    assert armed_at(events, tmp_path) == [(0.0, True), (5.0, False)]


def test_a_reboot_inside_the_file_starts_anew_with_its_own_parameters(tmp_path: Path) -> None:
    first, second = flight(6.0, start_s=30.0, offset_mg=10.0), flight(6.0, start_s=3.0, offset_mg=-55.0)
    told = Told(Log(first.rows + second.rows), tmp_path)
    times = [t for t, _ in told.all]
    assert times == sorted(times)
    boots = [r.boot_ns for r in told.of(MagReading)]
    assert sum(b < a for a, b in pairwise(boots)) == 1
    pipeline = Pipeline(Settings(), world_magnetic_model, told.recording.unix_offset_ns)
    held = []
    for t, reading in told.all:
        pipeline.step(reading, t)
        offsets = pipeline.vehicles[7].calibrations.offsets(1)
        held.append(None if offsets is None else float(offsets[0]))
    vehicle = pipeline.vehicles[7]
    assert vehicle.assembler.reboots == 1
    assert vehicle.phase.armed and held[-1] == -55.0
    assert 10.0 in held


def test_one_compass_in_two_messages_is_one_compass(tmp_path: Path) -> None:
    log = flight(2.0)
    twin = moved(OLD_MAG, number=91, name="MAG2")
    for k in range(20):
        log.add(twin, 5001 + 100 * k, 1, 2, 3, *(0,) * 6, 1)
    log.rows.sort(key=lambda row: row[1][0] * (1000 if row[0] is twin else 1))
    told = Told(log, tmp_path)
    assert {m.source for m in told.of(MagReading) if m.compass == 2} == {"MAG", "MAG2"}
    pipeline = Pipeline(Settings(), world_magnetic_model)
    records = [r for t, reading in told.all if (r := pipeline.step(reading, t)) is not None and r.compass == 2]
    assert len({r.stored_b_mg[2] for r in records}) == 1


def test_a_few_wild_times_are_damage_and_no_reboot(tmp_path: Path) -> None:
    log = flight(4.0)
    for place, us in ((200, 3), (300, 2**63), (400, 900_000_000), (500, 2)):
        message, values = log.rows[place]
        log.rows[place] = (message, (us, *values[1:]))
    told = Told(log, tmp_path)
    assert told.recording.counts["time fits nowhere"] == 4
    assert all(5.0 <= t / 1e9 < 9.1 for t, _ in told.all)


def test_progress_is_told_and_a_recording_closes_twice(tmp_path: Path) -> None:
    path = tmp_path / "p.bin"
    path.write_bytes(flight(1.0).binary())
    said: list[tuple[int, int]] = []
    recording = DataflashRecording(path, lambda done, total: said.append((done, total)))
    count = sum(1 for _ in recording.readings())
    assert said[-1] == (count, count) and recording.heard["IMU"] == 100
    recording.close()
    recording.close()
    assert list(recording.readings()) == []


@pytest.mark.flights
def test_a_real_flight_teaches_the_compass_that_was_never_calibrated() -> None:
    """log171: the hard iron of compass 3 as an attitude-aided fit of the same file has it, and better than before."""
    path = LOGS / "log171.bin"
    if not path.exists():
        pytest.skip(f"real recordings not found at {LOGS}; set MAGMAV_DATA")
    recording = DataflashRecording(path)
    # The others' fit is one of offsets alone, as kalman's is; adaptive also finds soft iron and what the motors do.
    pipeline = Pipeline(
        with_value(Settings(), "learn", "estimator", "kalman"), world_magnetic_model, recording.unix_offset_ns
    )
    records: list[Record] = []
    yaw: list[tuple[float, float]] = []
    compasses = set()
    for t, reading in recording.readings():
        if isinstance(reading, MagReading):
            compasses.add(reading.compass)
            if reading.compass != 3:
                continue  # each is learnt by itself, and this test is about one
        record = pipeline.step(reading, t)
        if isinstance(reading, AttitudeReading):
            yaw.append((reading.boot_ns / 1e9, reading.yaw_rad))
        if record is not None:
            records.append(record)
    vehicle = pipeline.vehicles[1]
    assert not recording.counts
    assert compasses == {1, 2, 3}
    assert vehicle.phase.takeoff_ns is not None and 83e9 < vehicle.phase.takeoff_ns < 95e9
    assert vehicle.phase.crash_ns is not None and 235e9 < vehicle.phase.crash_ns < 245e9
    assert np.abs(records[-1].estimate.hard_iron_b_mg - (480.0, 103.0, 617.0)).max() < 40.0
    times, unwrapped = np.array(yaw)[:, 0], np.unwrap(np.array(yaw)[:, 1])

    def rms_deg(which: str) -> float:
        flown = [r for r in records if 120e9 < r.boot_ns < 235e9 and getattr(r, which).true_valid]
        errors = [
            wrap_pi(getattr(r, which).true_rad - float(np.interp(r.boot_ns / 1e9, times, unwrapped))) for r in flown
        ]
        assert len(errors) > 800
        return math.degrees(math.sqrt(np.mean(np.square(errors))))

    assert rms_deg("heading") < 0.6 * rms_deg("stored_heading")


def test_the_writer_writes_what_a_vehicle_writes() -> None:
    """GPS as ArduPilot 4.5 lays it out: 48 bytes of values behind the header."""
    assert GPS.size == 3 + struct.calcsize("<QBBIHBhiiifff")
