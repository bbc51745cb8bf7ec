"""PX4's ULog: what each release calls its values, what they mean, and every way a file can be broken."""

import os
import random
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from synthetic_flight import HARD_IRON_MG, fly
from ulog_writer import Ulog

from magmav import world_magnetic_model
from magmav.core.types import (
    AttitudeReading,
    CurrentReading,
    EarthField,
    InertialReading,
    Landed,
    LandedReading,
    MagReading,
    MotionReading,
    ParamReading,
    PositionReading,
    State,
    ThrottleReading,
    TimeReading,
    VehicleReading,
)
from magmav.logs import LogError, ulog_file
from magmav.logs.ulog import UlogRecording
from magmav.pipeline import Pipeline
from magmav.settings import Settings

DATA = Path(os.environ.get("MAGMAV_DATA", Path(__file__).parents[2] / "shared" / "data")) / "logs"
MORE = int(os.environ.get("MAGMAV_ULOG_DAMAGE", "1"))
"""How many times as much damage is done as usual."""

DEVICE, SECOND, THIRD, FOURTH = 396809, 263202, 131618, 263178
UTC_US = 1_557_756_559_600_000
US = 1_000_000


def read(path):
    recording = UlogRecording(path)
    return list(recording.readings()), recording


def of(kind, readings):
    return [r for _, r in readings if isinstance(r, kind)]


def with_mag(log, n=3, at_us=6 * US):
    """A few values, so that the file is worth reading."""
    for i in range(n):
        t = at_us + i * 50_000
        log.row("sensor_mag", t + 4_000, t, DEVICE, 0.2, -0.1 - 0.001 * i, 0.4)
    return log


@pytest.fixture
def written(tmp_path):
    return lambda log: read(log.write(tmp_path / "a.ulg"))


# ---------------------------------------------------------------- what values mean


def test_values_of_a_new_release(written):
    log = with_mag(Ulog())
    log.params = {"MAV_SYS_ID": 7, "CAL_MAG0_ID": DEVICE, "CAL_MAG0_XOFF": 0.25, "MAV_TYPE": 2}
    t = 6 * US
    log.row("vehicle_angular_velocity", t, t - 1_000, (0.1, 0.2, 0.3))
    log.row("vehicle_angular_velocity", t + 100_000, t + 99_000, (0.3, 0.2, 0.1))
    half = np.sqrt(0.5)
    log.row("vehicle_attitude", t + 51_000, t + 49_000, (half, 0.0, 0.0, half))
    log.row("sensor_combined", t, (0.01, 0.02, 0.03), (0.1, 0.2, -9.8))
    log.row("vehicle_global_position", t, 47.3977, 8.5456, 488.5)
    log.row("sensor_gps", t, UTC_US, 47.4, 8.6, 490.25, 3)
    log.row("vehicle_local_position", t, 1.5, -2.5, -12.0, True, True)
    log.row("battery_status", t, 12.5)
    log.row("vehicle_thrust_setpoint", t, (0.0, 0.0, -0.6))
    log.row("vehicle_status", t, 2, 0, 1)
    log.row("vehicle_land_detected", t, False)
    got, recording = written(log)

    first_mag = of(MagReading, got)[0]
    assert (first_mag.system, first_mag.compass, first_mag.source) == (7, 1, "sensor_mag")
    assert (first_mag.boot_ns, first_mag.device_id) == (t * 1000, DEVICE)  # of the sample, not of the message
    assert first_mag.field_b_mg == pytest.approx((200.0, -100.0, 400.0), abs=1e-4)
    (attitude,) = of(AttitudeReading, got)
    assert (attitude.roll_rad, attitude.pitch_rad, attitude.yaw_rad) == pytest.approx((0, 0, np.pi / 2), abs=1e-6)
    assert attitude.boot_ns == (t + 49_000) * 1000
    assert attitude.rate_b_rads == pytest.approx((0.2, 0.2, 0.2), abs=1e-6)  # half way between two
    (inertial,) = of(InertialReading, got)
    assert inertial.force_b_mss == pytest.approx((0.1, 0.2, -9.8)) and inertial.rate_b_rads == pytest.approx(
        (0.01, 0.02, 0.03)
    )
    places = {r.source: (r.lat_deg, r.lon_deg, r.alt_m) for r in of(PositionReading, got)}
    assert places == {"vehicle_global_position": (47.3977, 8.5456, 488.5), "sensor_gps": (47.4, 8.6, 490.25)}
    (motion,) = of(MotionReading, got)
    assert (motion.north_mps, motion.east_mps, motion.height_m) == (1.5, -2.5, 12.0)
    assert [r.ampere for r in of(CurrentReading, got)] == [12.5]
    assert [r.share for r in of(ThrottleReading, got)] == [pytest.approx(0.6)]
    assert [(r.boot_ns, r.unix_ns) for r in of(TimeReading, got)] == [(t * 1000, UTC_US * 1000)]
    assert recording.unix_offset_ns == (UTC_US - t) * 1000
    start, flying = of(VehicleReading, got)
    assert (start.autopilot, start.kind, start.armed) == (12, 2, False)
    assert (flying.armed, flying.status, flying.kind) == (True, 4, 2)
    assert [r.state for r in of(LandedReading, got)] == [Landed.IN_AIR]
    assert {r.name: r.value for r in of(ParamReading, got)} == log.params
    assert {(r.component, r.index, r.count) for r in of(ParamReading, got)} == {(1, 65535, 0)}
    assert recording.heard["sensor_mag"] == 3


def test_values_of_an_old_release(written):
    log = Ulog()
    log.params = {"CAL_MAG_PRIME": DEVICE, "CAL_MAG0_ID": SECOND, "CAL_MAG1_ID": DEVICE}
    t = 6 * US
    for i in range(8):  # one value, four times, with its age
        at, since = t + 4_000 * i, -4_000 * (i % 4) - 1_000 + i % 2
        field = (0.2, -0.1, 0.4 + 0.01 * (i // 4))
        log.row("sensor_combined_old", at, (0.0, 0.0, 0.1), (0.0, 0.0, -9.8), since, field)
    log.row("sensor_combined_old", t + 32_000, (0.0, 0.0, 0.1), (0.0, 0.0, -9.8), 2**31 - 1, (0.0, 0.0, 0.0))
    log.row("vehicle_attitude_old", t, 0.1, 0.2, 0.3, (1.0, 0.0, 0.0, 0.0))
    log.row("vehicle_gps_position", t, UTC_US, 473_565_765, 85_189_121, 428_924, -20_000, 4)
    log.row("actuator_controls_0", t, (0.0, 0.0, 0.0, 0.4, 0.0, 0.0, 0.0, 0.0))
    log.row("vehicle_status", t, 1, 13, 0)
    got, _ = written(log)
    mags = of(MagReading, got)
    assert [m.boot_ns // 1000 for m in mags] == [t - 1_000, t + 16_000 - 1_000]
    assert [m.field_b_mg[2] for m in mags] == pytest.approx([400.0, 410.0], abs=1e-4)
    assert {(m.source, m.device_id) for m in mags} == {("sensor_combined", DEVICE)}
    assert of(AttitudeReading, got)[0].rate_b_rads == pytest.approx((0.1, 0.2, 0.3))
    (place,) = of(PositionReading, got)
    assert (place.lat_deg, place.lon_deg, place.alt_m) == pytest.approx((47.3565765, 8.5189121, 428.924))
    (utc,) = of(TimeReading, got)
    assert utc.boot_ns == (t - 20_000) * 1000
    assert [r.share for r in of(ThrottleReading, got)] == [pytest.approx(0.4)]
    assert [(r.kind, r.armed) for r in of(VehicleReading, got)] == [(13, False), (13, False)]
    assert len(of(InertialReading, got)) == 9


def test_what_is_not_known_gives_no_reading(written):
    log = with_mag(Ulog())
    t = 6 * US
    log.row("vehicle_global_position", t, 0.0, 0.0, 0.0)
    log.row("vehicle_global_position", t + 1, float("nan"), 8.5, 0.0)
    log.row("sensor_gps", t, 0, 47.4, 8.6, 490.25, 2)  # no 3-D fix, no date
    log.row("vehicle_local_position", t, 1.5, -2.5, -12.0, False, True)
    log.row("battery_status", t, -1.0)
    log.row("actuator_controls_0", t, (float("nan"),) * 8)
    log.row("vehicle_attitude_old", t, 0.1, 0.2, 0.3, (0.0, 0.0, 0.0, 0.0))
    log.row("sensor_combined", t, (0.0, 0.0, float("inf")), (0.0, 0.0, -9.8))
    log.row("sensor_mag", t + 200_000, t + 200_000, DEVICE, float("nan"), 0.1, 0.1)
    log.row("sensor_mag", t + 250_000, t + 250_000, DEVICE, 0.0, 0.0, 0.0)
    got, recording = written(log)
    assert {type(r) for _, r in got} == {MagReading, VehicleReading}
    assert len(of(MagReading, got)) == 3
    assert recording.unix_offset_ns == 0
    assert recording.counts["sensor_mag: not a number, or beyond belief"] == 1
    assert recording.counts["vehicle_attitude: not a rotation"] == 1


def test_attitudes_without_any_rate_nearby_are_left_out(written):
    log = with_mag(Ulog())
    log.row("vehicle_angular_velocity", 6 * US, 6 * US, (0.0, 0.0, 0.1))
    for at in (6 * US + 100_000, 7 * US):
        log.row("vehicle_attitude", at, at, (1.0, 0.0, 0.0, 0.0))
    got, _ = written(log)
    assert [a.boot_ns for a in of(AttitudeReading, got)] == [(6 * US + 100_000) * 1000]


def test_readings_come_in_the_order_of_time_parameters_first(written):
    log = with_mag(Ulog(start_us=7 * US), n=40)  # a log may hold samples from before it began
    log.params = {f"CAL_MAG{n}_ID": n for n in range(4)}
    log.row("vehicle_status", 6 * US + 500_000, 2, 2, 1)
    log.change("CAL_MAG0_XOFF", 0.5)
    got, _ = written(log)
    times = [t for t, _ in got]
    assert times == sorted(times) and times[0] == 6 * US * 1000
    kinds = [type(r) for _, r in got]
    assert kinds[:6] == [ParamReading] * 4 + [VehicleReading, MagReading]
    late = next(t for t, r in got if isinstance(r, ParamReading) and r.name == "CAL_MAG0_XOFF")
    assert 6 * US + 500_000 <= late / 1000 <= 8 * US
    assert all(t == r.boot_ns for t, r in got if hasattr(r, "boot_ns"))


# ---------------------------------------------------------------- which compass is which


def three(log, source="sensor_mag"):
    for i in range(30):
        for instance, device in enumerate((THIRD, DEVICE, SECOND, FOURTH)):
            t = 6 * US + i * 50_000
            field = (0.1 * (instance + 1), 0.001 * i, 0.3)
            fields = field if source == "sensor_mag" else (field,)
            log.row(source, t, t, device, *fields, instance=instance)
    return log


IDS = {"CAL_MAG0_ID": DEVICE, "CAL_MAG1_ID": SECOND, "CAL_MAG2_ID": THIRD, "CAL_MAG3_ID": FOURTH}


@pytest.mark.parametrize("source", ["sensor_mag", "vehicle_magnetometer"])
@pytest.mark.parametrize(
    ("params", "order"),
    [
        ({}, [THIRD, DEVICE, SECOND]),  # nothing said: as they come
        (IDS | {"CAL_MAG0_ROT": 0, "CAL_MAG1_ROT": -1, "CAL_MAG3_ROT": 6}, [DEVICE, FOURTH, THIRD]),  # external first
        (IDS | {f"CAL_MAG{n}_PRIO": p for n, p in enumerate((25, 100, 0, 75))}, [SECOND, FOURTH, DEVICE]),
        (IDS | {"CAL_MAG_PRIME": SECOND, "CAL_MAG0_EN": 0}, [SECOND, THIRD, FOURTH]),
    ],
)
def test_compasses_are_devices_in_px4s_order(written, source, params, order):
    log = three(Ulog(), source)
    log.params = params
    got, recording = written(log)
    assert {r.compass: r.device_id for r in of(MagReading, got)} == dict(enumerate(order, 1))
    assert recording.counts["compass beyond the third"] == 30


def test_a_device_that_takes_over_in_one_topic_is_another_compass(written):
    log = Ulog()
    for i in range(40):
        t = 6 * US + i * 50_000
        log.row("vehicle_magnetometer", t, t, DEVICE if i < 25 else SECOND, (0.2, 0.001 * i, 0.4))
    got, _ = written(log)
    by = {c: {r.device_id for r in of(MagReading, got) if r.compass == c} for c in (1, 2)}
    assert sorted(by.values(), key=min) == [{SECOND}, {DEVICE}]


def test_the_sensors_own_values_are_preferred_unless_they_are_rare(written):
    def both(every):
        log = Ulog()
        for i in range(60):
            t = 6 * US + i * 50_000
            log.row("vehicle_magnetometer", t, t, DEVICE, (0.2, 0.001 * i, 0.4))
            if i % every == 0:
                log.row("sensor_mag", t, t, DEVICE, 0.2, 0.001 * i, 0.4)
        return {r.source for r in of(MagReading, written(log)[0])}

    assert both(1) == {"sensor_mag"}
    assert both(10) == {"vehicle_magnetometer"}


def test_values_with_px4s_own_estimate_taken_off_are_called_so(written):
    log = Ulog()
    for i in range(30):
        t = 6 * US + i * 50_000
        log.row("vehicle_magnetometer", t, t, DEVICE, (0.2, 0.001 * i, 0.4))
        log.row("magnetometer_bias_estimate", t, (0.05, 0, 0, 0), (0.0,) * 4, (0.0,) * 4, (True, False, False, False))
    assert {r.source for r in of(MagReading, written(log)[0])} == {"vehicle_magnetometer less bias"}


def test_one_damaged_device_id_is_no_compass(written):
    log = with_mag(Ulog(), n=300)
    log.row("sensor_mag", 22 * US, 22 * US, 99, 0.2, 0.1, 0.4)
    got, recording = written(log)
    assert {r.device_id for r in of(MagReading, got)} == {DEVICE}
    assert recording.counts["sensor_mag: device id seen once or twice"] == 1


def test_old_sensor_mag_was_corrected_in_the_driver(written):
    log = Ulog()
    log.row("sensor_mag_old", 6 * US, 0.1, 0.2, 0.3, 1.0)
    log.row("vehicle_magnetometer_old", 6 * US, (0.2, 0.1, 0.4))
    log.row("vehicle_magnetometer_old", 6 * US + 50_000, (0.2, 0.1, 0.5))
    log.params = {"CAL_MAG0_ID": SECOND}
    got, recording = written(log)
    assert {(r.source, r.device_id) for r in of(MagReading, got)} == {("vehicle_magnetometer", SECOND)}
    assert recording.counts["sensor_mag: corrected in the driver, not used"] == 1


# ---------------------------------------------------------------- one flight, three ways of logging it

EARTH = EarthField(205.0, 14.0, 430.0)
OFFSET_G, SCALE = np.array([0.05, -0.12, 0.2]), np.array([1.1, 0.95, 1.02])
YAW_90 = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


def flown(source):
    """The flight of synthetic_flight, of a sensor mounted as number 2 that wants SCALE, with wrong offsets stored."""
    f = fly(seconds=40.0, rate_hz=15.0, noise_mg=3.0)
    log = Ulog()
    log.params = {
        "CAL_MAG0_ID": DEVICE,
        "CAL_MAG0_ROT": 2,
        "CAL_MAG_PRIME": DEVICE,
        "MAV_TYPE": 10,
        "SENS_BOARD_ROT": 0,
    }
    for i, axis in enumerate("XYZ"):
        log.params |= {f"CAL_MAG0_{axis}OFF": float(OFFSET_G[i]), f"CAL_MAG0_{axis}SCALE": float(SCALE[i])}
    noise = f.sensor_b_mg - f.true_b_mg - HARD_IRON_MG
    raw = ((f.true_b_mg @ YAW_90) / SCALE + (HARD_IRON_MG + noise) @ YAW_90) / 1000.0  # rows: R^T b
    used = ((raw - OFFSET_G) * SCALE) @ YAW_90.T
    for i, t_s in enumerate(f.boot_s):
        t = round(t_s * 1e6)
        r, p, y = f.roll_rad[i] / 2, f.pitch_rad[i] / 2, f.yaw_rad[i] / 2
        cr, sr, cp, sp, cy, sy = (*_cs(r), *_cs(p), *_cs(y))
        q = (cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy)
        q += (cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy)
        rate = _rate(f, i)
        log.row("vehicle_attitude_old", t, *rate, q)
        match source:
            case "sensor_mag":
                log.row(source, t + 3_000, t, DEVICE, *raw[i])
            case "vehicle_magnetometer":
                log.row(source, t + 3_000, t, DEVICE, used[i])
            case "sensor_combined":
                log.row("sensor_combined_old", t + 3_000, rate, (0.0, 0.0, -9.8), -3_000, used[i])
    return log


def _cs(angle):
    return np.cos(angle), np.sin(angle)


def _rate(f, i):
    lo, hi = max(i - 1, 0), min(i + 1, len(f.boot_s) - 1)
    dt = f.boot_s[hi] - f.boot_s[lo]
    dr, dp, dy = ((a[hi] - a[lo]) / dt for a in (f.roll_rad, f.pitch_rad, f.yaw_rad))
    (cr, sr), (cp, sp) = _cs(f.roll_rad[i]), _cs(f.pitch_rad[i])
    return dr - dy * sp, dp * cr + dy * sr * cp, -dp * sr + dy * cr * cp


def learnt(path):
    """Last record of compass 1 after a run of the whole recording."""
    recording = UlogRecording(path)
    pipeline = Pipeline(Settings(), lambda *_: EARTH, recording.unix_offset_ns)
    records = [record for t, r in recording.readings() if (record := pipeline.step(r, t)) is not None]
    return records


def test_three_ways_of_logging_one_flight_give_one_answer(tmp_path):
    answers = {}
    for source in ("sensor_mag", "vehicle_magnetometer", "sensor_combined"):
        records = learnt(flown(source).write(tmp_path / f"{source}.ulg"))
        last = records[-1]
        assert len(records) > 590 and not last.relative and last.device_id == DEVICE
        answers[source] = (last.estimate.hard_iron_b_mg, last.stored_b_mg, last.mag_b_mg)
    raw = answers["sensor_mag"]
    for iron, stored, mag in answers.values():
        assert mag == pytest.approx(raw[2], abs=0.01)  # float32 of the log
        assert stored == pytest.approx(raw[1], abs=0.01)
        assert iron == pytest.approx(raw[0], abs=0.05)
    assert raw[0] == pytest.approx(HARD_IRON_MG, abs=5.0)  # noise 3 mG, stored scale the right one


# ---------------------------------------------------------------- broken files


def test_dropouts_and_progress_are_told(tmp_path):
    log = with_mag(Ulog(), n=3000)
    log.dropout(120)
    log.dropout(7)
    told = []
    path = log.write(tmp_path / "a.ulg")
    recording = UlogRecording(path, lambda done, of_all: told.append((done, of_all)))
    assert (recording.counts["dropouts"], recording.counts["dropouts: milliseconds lost"]) == (2, 127)
    size = path.stat().st_size
    assert told[-1] == (size, size) and all(d <= a for d, a in told)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "too short"),
        (b"ULog", "too short"),
        (b"hello, this is no log at all", "Invalid"),
        (Ulog().bytes(), "no magnetometer"),
        (Ulog().bytes()[:16], "no magnetometer"),
    ],
)
def test_what_is_no_log_is_said(tmp_path, data, says):
    path = tmp_path / "b.ulg"
    path.write_bytes(data)
    with pytest.raises(LogError, match=says) as caught:
        UlogRecording(path)
    assert str(path) in str(caught.value)


def test_no_file_a_directory_and_a_future_format(tmp_path):
    with pytest.raises(LogError, match="no such file"):
        UlogRecording(tmp_path / "none.ulg")
    with pytest.raises(LogError, match="directory"):
        UlogRecording(tmp_path)
    data = bytearray(with_mag(Ulog()).bytes())
    data[16 + 3 + 8] |= 2  # an incompatible flag nobody knows
    (tmp_path / "c.ulg").write_bytes(data)
    with pytest.raises(LogError, match="newer"):
        UlogRecording(tmp_path / "c.ulg")


def test_once_through_and_closing_twice(tmp_path):
    recording = UlogRecording(with_mag(Ulog()).write(tmp_path / "a.ulg"))
    assert len(list(recording.readings())) == 4
    assert list(recording.readings()) == []
    recording.close()
    recording.close()
    assert recording.name.endswith("a.ulg")


def test_a_time_that_cannot_be_does_not_upset_the_others(written):
    log = Ulog()
    for i, t in enumerate((6 * US, 6 * US + 50_000, 2**60, 0, 6 * US + 200_000, 2**63 + 5, 6 * US + 300_000, 1 << 40)):
        log.row("vehicle_magnetometer_old", t, (0.2, 0.1, 0.4 + 0.01 * i))
    got, recording = written(log)
    assert [r.field_b_mg[2] for r in of(MagReading, got)] == pytest.approx([400, 410, 440, 460], abs=1e-4)
    assert recording.counts["vehicle_magnetometer: time beyond belief"] == 4


@pytest.mark.parametrize("depth", [3, 40])
def test_a_format_that_lies_about_its_size_costs_nothing(written, depth):
    """Nested arrays of 65535 would be 10^14 fields; a type within itself would never end."""
    names = [f"nest{i}" for i in range(depth)]
    formats = {n: f"{after}[65535] a;" for n, after in zip(names, [*names[1:], "uint8_t"], strict=True)}
    log = with_mag(Ulog())
    head = b""
    for n, fields in {**formats, "self": "self[2] a;uint64_t timestamp;"}.items():
        text = f"{n}:{fields}".encode()
        head += struct.pack("<H", len(text)) + b"F" + text
    for i, n in enumerate(("nest0", "self")):
        text = struct.pack("<BH", 0, 900 + i) + n.encode()
        log.raw(struct.pack("<H", len(text)) + b"A" + text)
    for text in (b"vehicle_status:uint8_t[65535] timestamp;uint64_t[9999999999] b;",):
        head += struct.pack("<H", len(text)) + b"F" + text
    log._head.append(head)
    got, _ = written(log)
    assert len(of(MagReading, got)) == 3


@pytest.mark.parametrize("filler", [b"\0", b"\xff"])
def test_a_file_that_was_never_finished_is_read_as_far_as_it_goes(tmp_path, capsys, filler):
    """Cards leave zeros or ones behind; the search through them must not take a step of 64 kB for each byte."""
    whole = survives(tmp_path / "w.ulg", small_log(), capsys)
    assert survives(tmp_path / "z.ulg", small_log() + 3_000_000 * filler, capsys) == whole


def test_the_search_through_damage_ends_whatever_the_size_of_the_file(tmp_path, monkeypatch):
    """Each step back may cost 64 kB read again; what is read again is bounded and not a multiple of the file."""
    read = []

    class Counting(ulog_file._Watched):
        def read(self, size=-1, /):
            data = super().read(size)
            read.append(len(data))
            return data

    monkeypatch.setattr(ulog_file, "_Watched", Counting)
    monkeypatch.setattr(ulog_file, "_MOST_AGAIN", 1 << 23)
    for size in (1_000_000, 8_000_000):
        read.clear()
        path = tmp_path / f"{size}.ulg"
        path.write_bytes(small_log() + size * b"\xff")
        recording = UlogRecording(path)
        assert recording.counts["gave up searching through damage"] == 1
        assert recording.heard["sensor_mag"] == 30
        # Once through in search of a sync mark, then what may be read again and one message more.
        assert sum(read) - 1.1 * (size + len(small_log())) < (1 << 23) + (1 << 17)
        assert len(read) < size / 200


def test_what_never_happened_is_not_counted(written):
    log = with_mag(Ulog())
    log.row("vehicle_attitude_old", 6 * US, 0.1, 0.2, 0.3, (1.0, 0.0, 0.0, 0.0))
    _, recording = written(log)
    assert recording.counts == {}


def small_log():
    log = Ulog()
    log.params = {"CAL_MAG0_ID": DEVICE, "CAL_MAG0_XOFF": 0.25, "SENS_BOARD_ROT": 0, "MAV_TYPE": 2}
    for i in range(30):
        t = 6 * US + i * 50_000
        with_mag(log, 1, t)
        log.row("vehicle_attitude_old", t, 0.1, 0.2, 0.3, (1.0, 0.0, 0.0, 0.0))
        log.row("vehicle_gps_position", t, UTC_US + i * 50_000, 473_565_765, 85_189_121, 428_924, 0, 4)
        log.row("vehicle_status", t, 2, 2, 1)
        if i % 10 == 5:
            log.sync()
            log.change("CAL_MAG0_XOFF", 0.25 + 0.01 * i)
    return log.bytes()


def survives(path, data, capsys):
    """Readings in the order of time, through a pipeline, or a LogError that names the file; nothing printed."""
    path.write_bytes(data)
    try:
        recording = UlogRecording(path)
        pipeline, latest, n = Pipeline(Settings(), lambda *_: EARTH), 0, 0
        for t, reading in recording.readings():
            assert t >= latest
            latest, n = t, n + 1
            pipeline.step(reading, t)
    except LogError as error:
        assert str(path) in str(error)
        n = 0
    assert capsys.readouterr() == ("", "")
    return n


def test_cut_anywhere(tmp_path, capsys):
    data = small_log()
    whole = survives(tmp_path / "t.ulg", data, capsys)
    ends = random.Random(1).sample(range(len(data)), 20 * MORE if len(data) > MORE * 20 else len(data))
    got = [survives(tmp_path / "t.ulg", data[:end], capsys) for end in sorted(ends)]
    assert got == sorted(got) and max(got) <= whole  # the more of the file, the more of the flight
    assert survives(tmp_path / "t.ulg", data[: len(data) // 2], capsys) > 50


def test_flipped_anywhere(tmp_path, capsys):
    data = small_log()
    whole = survives(tmp_path / "f.ulg", data, capsys)
    chance = random.Random(2)
    kept = []
    for _ in range(50 * MORE):
        broken = bytearray(data)
        for _ in range(chance.choice((1, 1, 1, 8))):
            broken[chance.randrange(len(broken))] ^= 1 << chance.randrange(8)
        kept.append(survives(tmp_path / "f.ulg", bytes(broken), capsys))
    assert sorted(kept)[len(kept) // 2] > 0.5 * whole  # most damage costs little


# ---------------------------------------------------------------- real recordings

real = [
    pytest.mark.flights,
    pytest.mark.skipif(not DATA.is_dir(), reason="no real recordings: set MAGMAV_DATA"),
]


@pytest.mark.parametrize("name", ["esc_status_log.ulg", "px4_handheld.ulg"])
@pytest.mark.parametrize("seed", range(3 * MORE))
def test_real_files_cut_and_flipped(tmp_path, capsys, name, seed):
    if not DATA.is_dir():
        pytest.skip("no real recordings: set MAGMAV_DATA")
    chance = random.Random(seed)
    data = bytearray((DATA / name).read_bytes()[: 300_000 + chance.randrange(50_000)])
    for _ in range(5):
        data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    survives(tmp_path / name, bytes(data), capsys)


class TestReal:
    pytestmark = real

    def test_the_flight_finds_what_its_owner_had_stored(self):
        """A calibrated compass: what is learnt from 39 s in the air is what was stored, within its own doubt."""
        recording = UlogRecording(DATA / "esc_status_log.ulg")
        assert abs(recording.unix_offset_ns / 1e9 - 1_557_751_478.7) < 1.0
        pipeline = Pipeline(Settings(), world_magnetic_model, recording.unix_offset_ns)
        last = [x for t, r in recording.readings() if (x := pipeline.step(r, t)) is not None][-1]
        vehicle = pipeline.vehicles[1]
        stored = vehicle.calibrations.offsets(1)
        assert stored == pytest.approx((19.1235, 22.8025, 43.8297), abs=1e-3)  # -1000 * CAL_MAG0_*OFF, mounting none
        assert last.offsets_mg == pytest.approx(stored, abs=10.0)
        assert last.verdict.state is State.READY and not last.relative and last.device_id == DEVICE
        (flight,) = vehicle.phase.flights
        assert flight.takeoff_ns is not None and flight.landed_ns is not None

    def test_held_in_the_hand_it_never_flew(self):
        recording = UlogRecording(DATA / "px4_handheld.ulg")
        readings = list(recording.readings())
        assert (recording.counts["dropouts"], recording.heard["sensor_combined"]) == (4, 17070)
        assert recording.unix_offset_ns == 0  # no GPS
        mags = of(MagReading, readings)
        assert len(mags) > 4000 and {m.device_id for m in mags} == {262144}
        assert not any(r.armed for r in of(VehicleReading, readings))
        assert [r.value for r in of(ParamReading, readings) if r.name == "COM_AUTOS_PAR"][1:] == [0, 1, 0, 1]

    def test_the_columns_are_those_of_pyulogs_own_program(self, tmp_path):
        """ulog2csv in a process of its own, against our readings."""
        program = [sys.executable, "-c", "from pyulog.ulog2csv import main; main()"]
        words = [str(DATA / "esc_status_log.ulg"), "-m", "vehicle_magnetometer", "-o", str(tmp_path)]
        subprocess.run([*program, *words], check=True, capture_output=True, timeout=60)
        (csv,) = tmp_path.glob("*vehicle_magnetometer*.csv")
        table = np.loadtxt(csv, delimiter=",", skiprows=1)
        readings = of(MagReading, list(UlogRecording(DATA / "esc_status_log.ulg").readings()))
        assert [r.boot_ns // 1000 for r in readings] == table[:, 0].astype(np.int64).tolist()
        assert np.array([r.field_b_mg for r in readings]) == pytest.approx(1000.0 * table[:, 1:4], abs=1e-3)
