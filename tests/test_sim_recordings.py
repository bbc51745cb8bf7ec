"""The simulator's recordings: read by other people's readers, held against each other and against the truth."""

from __future__ import annotations

import csv
import json
import math
import struct
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from magmav_sim import Simulation, TruthLog, load_scenario, parse_scenario
from magmav_sim.__main__ import main
from magmav_sim.correction import stored_correction
from magmav_sim.dataflash_layout import LAYOUTS, MULTIPLIERS, SCALE, STRUCT, UNITS, Layout
from magmav_sim.parameters import Parameters, compass_name
from magmav_sim.px4_calibration import px4_parameters
from magmav_sim.record_dataflash import as_bytes, as_text
from magmav_sim.recorder import Recorder, unattended
from magmav_sim.ulog_layout import TOPICS, layout
from magmav_sim.world import rotation_matrix
from pyulog import ULog
from sim_rig import COMPASS, Ground, body_from_ned, simulation

from magmav.link.tlog import TlogLink
from magmav.mavlink.codec import Codec

# Compass 1 plain, compass 2 with everything ArduPilot can store, compass 3 turned by 90 degrees and scaled.
# The attitude is the true one, so that it can be held against the truth.
TOLD = """
seed = 3
airframe = "F450"
date = 2026-11-22T10:00:00Z
place = { lat_deg = 47.3977, lon_deg = 8.5456, alt_m = 488.0 }
heading_deg = 70.0
end_ground_s = 1.0

[[compass]]
device_id = 97539
hard_iron_mg = [100.0, -50.0, 200.0]

[[compass]]
device_id = 131874
external = false
hard_iron_mg = [-150.0, 90.0, -100.0]
motor_mg_per_a = [2.0, 1.0, -3.0]

[[compass]]
device_id = 590114
orient = 2
hard_iron_mg = [30.0, 40.0, -50.0]
noise_mg = 0.0

[autopilot]
yaw = "truth"
tilt_sigma_deg = 0.0
gyro_bias_dps = 0.0

[autopilot.parameters]
COMPASS_OFS_X = -100.25
COMPASS_OFS_Y = 50.5
COMPASS_OFS_Z = -200.75
COMPASS_OFS2_X = 150.0
COMPASS_OFS2_Y = -91.0
COMPASS_OFS2_Z = 102.5
COMPASS_DIA2_X = 1.05
COMPASS_DIA2_Y = 0.96
COMPASS_DIA2_Z = 1.01
COMPASS_ODI2_X = 0.03
COMPASS_ODI2_Y = -0.02
COMPASS_ODI2_Z = 0.04
COMPASS_SCALE2 = 1.1
COMPASS_MOT2_X = -2.0
COMPASS_MOT2_Y = -1.0
COMPASS_MOT2_Z = 3.0
COMPASS_MOTCT = 2
COMPASS_OFS3_X = -30.0
COMPASS_DIA3_X = 1.2

[[flight]]
ground_s = 2.0
pattern = [
    { kind = "takeoff", height_m = 4.0, climb_mps = 3.0 },
    { kind = "yaw", turns = 0.3, rate_dps = 40.0 },
    { kind = "land", sink_mps = 2.0 },
]
"""

READ = """
import json, sys
from pymavlink import DFReader
kind = DFReader.DFReader_text if sys.argv[1].endswith(".log") else DFReader.DFReader_binary
log = kind(sys.argv[1])
while (m := log.recv_msg()) is not None:
    values = [list(v) if isinstance(v, bytes) else v for v in (getattr(m, c) for c in m.get_fieldnames())]
    units = [m.fmt.get_unit(c) for c in m.get_fieldnames()] if m.get_type() == "MAG" else []
    print(json.dumps([m.get_type(), dict(zip(m.get_fieldnames(), values)), m._timestamp, units]))
"""


def dataflash(path: Path) -> list[tuple[str, dict[str, Any], float, list[str]]]:
    """Every message as pymavlink's reader gives it. It is GPL, so it runs in a process of its own."""
    done = subprocess.run([sys.executable, "-c", READ, str(path)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    return [tuple(json.loads(line)) for line in done.stdout.splitlines()]


def table(log: list[tuple[str, dict[str, Any], float, list[str]]], name: str, *columns: str) -> np.ndarray:
    return np.array([[m[c] for c in columns] for kind, m, *_ in log if kind == name], dtype=float)


def topic(log: ULog, name: str, *columns: str, instance: int = 0) -> np.ndarray:
    data = log.get_dataset(name, instance).data
    return np.column_stack([np.asarray(data[c], dtype=float) for c in columns])


def heard(path: Path) -> list[tuple[int, Any]]:
    """(t_ns, message), after making sure that every byte was a frame."""
    link, codec = TlogLink(path), Codec()
    out = [(p.t_ns, m) for p in link.packets() for m in codec.decode(p.data, p.route, whole=True)]
    assert set(codec.counts) <= {"messages", "garbage bytes"} and codec.counts["garbage bytes"] == 0
    assert not [k for k in link.counts if k != "records"]
    return out


def of(messages: list[tuple[int, Any]], name: str) -> list[Any]:
    return [m for _, m in messages if m.get_type() == name]


class Flown(NamedTuple):
    folder: Path
    sim: Simulation
    bin: list[tuple[str, dict[str, Any], float, list[str]]]
    ulg: ULog
    tlog: list[tuple[int, Any]]
    truth: np.ndarray  # boot s, roll, pitch, heading deg, height m, ampere


def fly(sim: Simulation, *paths: Path, truth: Path | None = None) -> Recorder:
    log = None if truth is None else TruthLog(truth, sim)
    with Recorder(sim, paths) as recorder:
        while not sim.finished:
            sim.advance(0.05)
            if log is not None:
                log.sample()
    if log is not None:
        log.close()
    return recorder


def told() -> Simulation:
    return Simulation(unattended(parse_scenario(TOLD.encode(), "told.toml")))


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    folder = tmp_path_factory.mktemp("flown")
    sim = told()
    fly(sim, *(folder / f"a.{kind}" for kind in ("tlog", "bin", "log", "ulg")), truth=folder)
    rows = list(csv.reader((folder / "truth.csv").read_text().splitlines()))[1:]
    truth = np.array([[float(v) for v in row[:6]] for row in rows])
    return Flown(folder, sim, dataflash(folder / "a.bin"), ULog(str(folder / "a.ulg")), heard(folder / "a.tlog"), truth)


# ---------------------------------------------------------------- each file by itself


def test_every_byte_of_the_bin_is_a_record_that_pymavlink_reads(flown: Flown) -> None:
    data, at, kinds = (flown.folder / "a.bin").read_bytes(), 0, Counter()
    sizes = {128: 89}
    while at < len(data):
        assert data[at : at + 2] == b"\xa3\x95"
        kind = data[at + 2]
        if kind == 128:
            sizes[data[at + 3]] = data[at + 4]
        kinds[kind] += 1
        at += sizes[kind]
    assert at == len(data)
    numbers = {layout.name: layout.number for layout in LAYOUTS[True].values()}
    assert Counter(numbers[name] for name, *_ in flown.bin) == kinds
    assert [f"{m['I']}" for name, m, *_ in flown.bin if name == "MAG"][:4] == ["0", "1", "2", "0"]
    units = next(units for name, _, _, units in flown.bin if name == "MAG")
    assert units[1:5] == ["instance", "mGauss", "mGauss", "mGauss"]


def test_times_in_the_bin_never_go_back_and_gps_gives_the_date(flown: Flown) -> None:
    times = [m["TimeUS"] for _, m, *_ in flown.bin if "TimeUS" in m]
    assert times == sorted(times)
    unix = [(t, m["TimeUS"]) for name, m, t, _ in flown.bin if name == "MAG"]
    start = flown.sim.scenario.date.timestamp()
    assert max(abs(t - (start + us / 1e6)) for t, us in unix) < 1e-3


def test_text_log_says_what_the_bin_says(flown: Flown) -> None:
    text = dataflash(flown.folder / "a.log")
    for name, columns in (
        ("MAG", ("TimeUS", "I", "MagX", "MagY", "MagZ", "OfsX", "MOX", "Health", "S")),
        ("ATT", ("TimeUS", "Roll", "Pitch", "Yaw")),
        ("IMU", ("TimeUS", "I", "GyrX", "AccX", "AccY", "AccZ")),
        ("GPS", ("TimeUS", "GMS", "GWk", "Lat", "Lng", "Alt", "HDop")),
        ("BAT", ("TimeUS", "Volt", "Curr")),
        ("EV", ("TimeUS", "Id")),
    ):
        np.testing.assert_allclose(table(text, name, *columns), table(flown.bin, name, *columns), rtol=1e-6, atol=1e-9)
    assert [m["Mode"] for name, m, *_ in text if name == "MODE"] == ["STABILIZE", "AUTO", "STABILIZE"]
    first = (flown.folder / "a.log").read_text().splitlines()[0]
    assert first == "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns"


def test_pyulog_reads_the_ulg_whole(flown: Flown) -> None:
    data, at, kinds = (flown.folder / "a.ulg").read_bytes(), 16, Counter()
    assert data[:8] == b"ULog\x01\x12\x35\x01"
    while at < len(data):
        size, kind = struct.unpack_from("<HB", data, at)
        kinds[chr(kind)] += 1
        at += 3 + size
    assert at == len(data)
    log = flown.ulg
    assert not log.file_corruption and log.dropouts == [] and log.changed_parameters == []
    assert sum(len(d.data["timestamp"]) for d in log.data_list) == kinds["D"]
    assert {d.name for d in log.data_list} == set(TOPICS)
    assert log.initial_parameters["MAV_TYPE"] == 2 and log.msg_info_dict["sys_name"] == "PX4"
    assert [m.message.split("] ")[1] for m in log.logged_messages] == [
        "Armed by external command", "Takeoff detected", "Landing detected", "Disarmed by landing",
    ]  # fmt: skip
    for d in log.data_list:
        assert (np.diff(d.data["timestamp"].astype(np.int64)) >= 0).all()


def test_tlog_is_what_a_ground_station_would_have_kept(flown: Flown) -> None:
    kinds = Counter(m.get_type() for _, m in flown.tlog)
    seconds = flown.sim.elapsed_ns / 1e9
    for name, hertz in (("RAW_IMU", 20), ("ATTITUDE", 20), ("GLOBAL_POSITION_INT", 5), ("HEARTBEAT", 1)):
        assert kinds[name] == pytest.approx(hertz * seconds, abs=2)
    named = [m.param_id for m in of(flown.tlog, "PARAM_VALUE")]
    assert named == flown.sim.autopilot.parameters.names
    start = flown.sim.scenario.date.timestamp()
    first = int.from_bytes((flown.folder / "a.tlog").read_bytes()[:8], "big") / 1e6
    assert first == pytest.approx(start, abs=0.02)
    for t_ns, m in flown.tlog:
        if m.get_type() == "RAW_IMU":
            assert (t_ns - flown.tlog[0][0]) // 1000 == pytest.approx(m.time_usec, abs=20_000)


# ---------------------------------------------------------------- against each other and the truth


def test_all_three_hold_one_field(flown: Flown) -> None:
    """vehicle_magnetometer is the field corrected; MAG and RAW_IMU are the same cast to whole mG."""
    for i in range(3):
        floats = topic(
            flown.ulg, "vehicle_magnetometer", "timestamp", *(f"magnetometer_ga[{k}]" for k in range(3)), instance=i
        )
        mag = table(flown.bin, "MAG", "TimeUS", "I", "MagX", "MagY", "MagZ", "S")
        mag = mag[mag[:, 1] == i]
        assert (mag[:, 0] == floats[:, 0]).all() and (mag[:, 5] == mag[:, 0]).all()
        off = mag[:, 2:5] - 1000 * floats[:, 1:]
        assert np.abs(off).max() < 1.0
        assert (np.abs(mag[:, 2:5]) <= np.abs(1000 * floats[:, 1:]) + 1e-3).all()  # towards zero, as C casts
        name = ("RAW_IMU", "SCALED_IMU2", "SCALED_IMU3")[i]
        for m in of(flown.tlog, name):
            us = m.time_usec if i == 0 else m.time_boot_ms * 1000
            row = np.searchsorted(mag[:, 0], us, side="right") - 1
            if row >= 0:
                assert (m.xmag, m.ymag, m.zmag) == tuple(mag[row, 2:5])


def test_raw_field_plus_stored_offsets_is_the_logged_field_where_nothing_else_is_stored(flown: Flown) -> None:
    raw = 1000 * topic(flown.ulg, "sensor_mag", "x", "y", "z")
    mag = table(flown.bin, "MAG", "I", "MagX", "MagY", "MagZ")
    parameters = {m["Name"]: m["Value"] for name, m, *_ in flown.bin if name == "PARM"}
    offsets = [parameters[f"COMPASS_OFS_{axis}"] for axis in "XYZ"]
    assert np.abs(raw + offsets - mag[mag[:, 0] == 0][:, 1:]).max() < 1.0
    px4 = [-1000 * flown.ulg.initial_parameters[f"CAL_MAG0_{axis}OFF"] for axis in "XYZ"]
    np.testing.assert_allclose(px4, offsets, atol=1e-4)
    logged = table(flown.bin, "MAG", "OfsX", "OfsY", "OfsZ")[0]
    np.testing.assert_array_equal(logged, np.trunc(offsets))


def test_px4s_formula_on_the_raw_field_gives_the_corrected_one(flown: Flown) -> None:
    """For every compass: matrix, scale, mounting and motor term included."""
    held = flown.ulg.initial_parameters
    ampere = topic(flown.ulg, "battery_status", "current_a")
    for i in range(3):
        assert held[f"CAL_MAG{i}_ID"] == (97539, 131874, 590114)[i]
        raw = topic(flown.ulg, "sensor_mag", "x", "y", "z", instance=i)
        wanted = topic(flown.ulg, "vehicle_magnetometer", *(f"magnetometer_ga[{k}]" for k in range(3)), instance=i)
        got = px4_formula(held, i, raw, ampere / 1000 if held["CAL_MAG_COMP_TYP"] == 2 else ampere)
        np.testing.assert_allclose(got, wanted, atol=2e-6)
    assert held["CAL_MAG0_PRIO"] > held["CAL_MAG1_PRIO"] > held["CAL_MAG2_PRIO"]  # the order of the compasses
    assert (held["CAL_MAG0_ROT"], held["CAL_MAG1_ROT"], held["CAL_MAG2_ROT"]) == (0, -1, 2)
    motor = table(flown.bin, "MAG", "I", "MOX")
    want = np.trunc(-2.0 * topic(flown.ulg, "battery_status", "current_a")[:, 0])
    assert np.abs(motor[motor[:, 0] == 1][:, 1] - want).max() <= 1.0 and np.abs(want).max() > 20


def px4_formula(held: dict[str, Any], i: int, raw: np.ndarray, power: np.ndarray) -> np.ndarray:
    """body = R S (raw + COMP power - OFF), gauss, row by row (autopilots.md 4.2)."""
    get = lambda stem: np.array([held[f"CAL_MAG{i}_{axis}{stem}"] for axis in "XYZ"])  # noqa: E731
    shape = np.diag(get("SCALE"))
    shape[0, 1], shape[0, 2], shape[1, 2] = get("ODIAG")
    shape[1, 0], shape[2, 0], shape[2, 1] = get("ODIAG")
    mounting = np.array(rotation_matrix(max(0, held[f"CAL_MAG{i}_ROT"])))
    return (raw + power * get("COMP") - get("OFF")) @ shape.T @ mounting.T


def test_parked_sensor_reads_the_rotated_earth_plus_its_iron(flown: Flown) -> None:
    """Compass 3 has no noise: in its own axes, from the truth alone."""
    t = flown.truth[0]
    body = body_from_ned(*np.radians(t[1:4])) @ flown.sim.world.field_ned_mg + (30.0, 40.0, -50.0)
    raw = 1000 * topic(flown.ulg, "sensor_mag", "x", "y", "z", instance=2)[3]
    np.testing.assert_allclose(raw, np.array(rotation_matrix(2)).T @ body, atol=1e-2)
    mean_age = topic(flown.ulg, "sensor_mag", "timestamp", "timestamp_sample")
    assert (mean_age[:, 0] - mean_age[:, 1] == 45_000).all()


def angles_apart(a: np.ndarray, b: np.ndarray) -> float:
    """Largest difference, degrees, turns taken out."""
    return float(np.abs((a - b + 180) % 360 - 180).max())


def at_equal_times(a: np.ndarray, b: np.ndarray, least: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows of both whose first column (microseconds, whole frames) is the same, without it."""
    times = set(a[:, 0]) & set(b[:, 0])
    assert len(times) >= least
    return (np.array([r[1:] for r in a if r[0] in times]), np.array([r[1:] for r in b if r[0] in times]))


def test_attitude_is_the_same_in_all_three_and_true(flown: Flown) -> None:
    att = table(flown.bin, "ATT", "TimeUS", "Roll", "Pitch", "Yaw")
    quat = topic(flown.ulg, "vehicle_attitude", "timestamp", "q[0]", "q[1]", "q[2]", "q[3]")
    w, x, y, z = quat[:, 1:].T
    np.testing.assert_allclose(w * w + x * x + y * y + z * z, 1.0, atol=1e-6)
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch, yaw = np.arcsin(2 * (w * y - z * x)), np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    ulg = np.column_stack([quat[:, 0], np.degrees(roll), np.degrees(pitch), np.degrees(yaw)])
    said = [(m.time_boot_ms * 1000, *np.degrees((m.roll, m.pitch, m.yaw))) for m in of(flown.tlog, "ATTITUDE")]
    truth = flown.truth[:, :4] * (1e6, 1, 1, 1)
    truth[:, 0] = truth[:, 0].round()
    assert angles_apart(*at_equal_times(att, ulg, 200)) <= 0.0051  # hundredths of a degree, rounded
    assert angles_apart(*at_equal_times(att, np.array(said), 40)) <= 0.0051
    assert angles_apart(*at_equal_times(ulg, truth, 100)) <= 2e-4  # the truth has four decimals
    assert np.ptp(ulg[:, 3]) > 80  # it did turn


def test_motion_is_the_same_in_all_three_and_true(flown: Flown) -> None:
    pos = table(flown.bin, "POS", "TimeUS", "Lat", "Lng", "Alt", "RelHomeAlt")
    ulg = topic(flown.ulg, "vehicle_global_position", "timestamp", "lat", "lon", "alt")
    said = np.array(
        [(m.time_boot_ms * 1000, m.lat / 1e7, m.lon / 1e7, m.alt / 1e3) for m in of(flown.tlog, "GLOBAL_POSITION_INT")]
    )
    resolution = np.array((1.01e-7, 1.01e-7, 2e-3))
    for other in (ulg, said):
        a, b = at_equal_times(pos[:, :4], other, 30 if other is ulg else 0)
        assert len(a) == 0 or (np.abs(a - b) <= resolution).all()
    height, truth = at_equal_times(pos[:, [0, 4]], (flown.truth * (1e6, 1, 1, 1, 1, 1))[:, [0, 4]].round(3), 30)
    assert np.abs(height - truth).max() < 2e-3
    gyro = table(flown.bin, "IMU", "TimeUS", "I", "GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ")
    names = [f"{stem}[{k}]" for stem in ("gyro_rad", "accelerometer_m_s2") for k in range(3)]
    np.testing.assert_array_equal(gyro[gyro[:, 1] == 0][:, 2:], topic(flown.ulg, "sensor_combined", *names))
    still = gyro[(gyro[:, 0] < 2e6) & (gyro[:, 1] == 1)]
    assert still[:, 7].mean() == pytest.approx(-9.80665, abs=0.03) and still[:, 7].std() == pytest.approx(
        0.05, abs=0.02
    )


def test_battery_is_the_same_in_all_three(flown: Flown) -> None:
    bat = table(flown.bin, "BAT", "TimeUS", "Curr", "Volt")
    np.testing.assert_array_equal(bat, topic(flown.ulg, "battery_status", "timestamp", "current_a", "voltage_v"))
    hundredths = {round(100 * c) for c in bat[:, 1]}
    assert {m.current_battery for m in of(flown.tlog, "BATTERY_STATUS")} <= hundredths | {0}


def test_arming_and_landing_have_one_time_in_all_three(flown: Flown) -> None:
    events = {e["what"]: round(1e6 * float(e["boot_s"])) for e in flown.sim.autopilot.events}  # type: ignore[arg-type]
    ev = {int(i): t for t, i in table(flown.bin, "EV", "TimeUS", "Id")}
    assert list(ev) == [10, 28, 18, 11]  # armed, not landed, land complete, disarmed
    frame = 10_001
    assert abs(ev[10] - events["arm"]) <= frame and abs(ev[11] - events["disarm"]) <= frame
    assert abs(ev[28] - events["takeoff"]) <= frame and ev[18] >= events["touchdown"]
    status = topic(flown.ulg, "vehicle_status", "timestamp", "arming_state")
    armed = status[status[:, 1] == 2][:, 0]
    assert (armed.min(), status[status[:, 0] > armed.max()][0, 0]) == (ev[10], ev[11])
    landed = topic(flown.ulg, "vehicle_land_detected", "timestamp", "landed")
    aloft = landed[landed[:, 1] == 0][:, 0]
    assert (aloft.min(), landed[landed[:, 0] > aloft.max()][0, 0]) == (ev[28], ev[18])
    beats = [bool(m.base_mode & 128) for m in of(flown.tlog, "HEARTBEAT")]
    assert abs(sum(beats) - (ev[11] - ev[10]) / 1e6) <= 1


def test_the_date_is_one(flown: Flown) -> None:
    gps = table(flown.bin, "GPS", "TimeUS", "GWk", "GMS")
    utc = topic(flown.ulg, "vehicle_gps_position", "timestamp", "time_utc_usec")
    np.testing.assert_array_equal(gps[:, 0], utc[:, 0])
    gps_s = gps[:, 1] * 604_800 + gps[:, 2] / 1e3
    np.testing.assert_allclose(gps_s - 18 + 315_964_800, utc[:, 1] / 1e6, atol=1e-3)  # 18 leap seconds since 1980
    said = of(flown.tlog, "SYSTEM_TIME")[-1]
    assert said.time_unix_usec - utc[0, 1] == pytest.approx(said.time_boot_ms * 1000 - utc[0, 0], abs=1000)


# ---------------------------------------------------------------- the recorder's manners


def test_same_seed_same_bytes_alone_or_together(flown: Flown, tmp_path: Path) -> None:
    for kind in ("tlog", "bin", "ulg"):
        fly(told(), tmp_path / f"b.{kind}")
        assert (tmp_path / f"b.{kind}").read_bytes() == (flown.folder / f"a.{kind}").read_bytes()


def test_a_plane_has_a_planes_log(tmp_path: Path) -> None:
    sim = Simulation(unattended(load_scenario("loiter")))
    sim.advance(35.0)
    with Recorder(sim, [tmp_path / "p.bin", tmp_path / "p.ulg"]):
        sim.advance(10.0)
    log = dataflash(tmp_path / "p.bin")
    kinds = Counter(name for name, *_ in log)
    assert kinds["STAT"] == 10 and kinds["EV"] == 1 and kinds["CTUN"] == 100
    assert table(log, "CTUN", "ThO").max() > 5  # per cent, where a copter's is a share
    ulg = ULog(str(tmp_path / "p.ulg"))
    assert not ulg.file_corruption and ulg.initial_parameters["MAV_TYPE"] == 1
    share = topic(ulg, "vehicle_thrust_setpoint", "xyz[0]")
    assert share.min() >= 0 and 100 * share.max() == pytest.approx(table(log, "CTUN", "ThO").max(), abs=5)


def test_a_reboot_begins_a_new_log_but_not_a_new_tlog(tmp_path: Path) -> None:
    sim = simulation(COMPASS + '[autopilot]\nboot_s = 1.5\n[[fault]]\nkind = "reboot"\nat_s = 3.0\n')
    paths = [tmp_path / f"r.{kind}" for kind in ("tlog", "bin", "ulg")]
    with Recorder(sim, paths) as recorder:
        sim.advance(7.0)
    assert [p.name for p in recorder.files] == ["r.tlog", "r.bin", "r.ulg", "r_2.bin", "r_2.ulg"]
    for name, first_s, last_s in (("r", 0.09, 2.99), ("r_2", 1.5, 4.0)):
        times = table(dataflash(tmp_path / f"{name}.bin"), "MAG", "TimeUS")[:, 0] / 1e6
        assert times[0] == pytest.approx(first_s, abs=0.1) and times[-1] == pytest.approx(last_s, abs=0.1)
        stamps = topic(ULog(str(tmp_path / f"{name}.ulg")), "sensor_mag", "timestamp")[:, 0] / 1e6
        np.testing.assert_array_equal(stamps, times)
    names = sim.autopilot.parameters.names
    assert [m.param_id for m in of(heard(tmp_path / "r.tlog"), "PARAM_VALUE")] == names * 2


def test_a_parameter_set_in_flight_stands_at_its_time(tmp_path: Path) -> None:
    sim = simulation()
    ground = Ground(sim)
    with Recorder(sim, [tmp_path / "c.bin", tmp_path / "c.ulg"]):
        ground.run(2.0)
        ground.set("COMPASS_OFS_Y", 77.5)
        ground.run(1.0)
    log, ulg = dataflash(tmp_path / "c.bin"), ULog(str(tmp_path / "c.ulg"))
    y = [(m["TimeUS"], m["Value"]) for name, m, *_ in log if name == "PARM" and m["Name"] == "COMPASS_OFS_Y"]
    assert [value for _, value in y] == [0.0, 77.5] and y[1][0] == 2_010_000
    ((t, name, value),) = ulg.changed_parameters
    assert (name, value) == ("CAL_MAG0_YOFF", pytest.approx(-0.0775)) and abs(t - 2_010_000) <= 20_000
    mag, raw = table(log, "MAG", "TimeUS", "MagY"), 1000 * topic(ulg, "sensor_mag", "y")[:, 0]
    expected = raw + np.where(mag[:, 0] > 2_010_000, 77.5, 0.0)
    assert np.abs(mag[:, 1] - expected).max() < 1.0


def test_a_sensor_that_is_gone_says_nothing_in_a_ulg_and_zero_in_a_bin(tmp_path: Path) -> None:
    sim = simulation(COMPASS + '[[fault]]\nkind = "absent"\ncompass = 1\nat_s = 1.0\n')
    with Recorder(sim, [tmp_path / "g.bin", tmp_path / "g.ulg"]):
        sim.advance(2.0)
    mag = table(dataflash(tmp_path / "g.bin"), "MAG", "TimeUS", "MagX", "MagY", "MagZ", "Health")
    gone = mag[:, 0] >= 1_000_000
    assert gone.sum() == 10 and not mag[gone, 1:].any() and mag[~gone, 1:].any(axis=1).all()
    assert len(topic(ULog(str(tmp_path / "g.ulg")), "sensor_mag", "x")) == (~gone).sum()


def test_demo_flies_without_anybody_and_comes_to_an_end() -> None:
    scenario = unattended(load_scenario("demo"))
    assert not scenario.stay and all(flight.start == "auto" for flight in scenario.flights)
    assert scenario.compasses == load_scenario("demo").compasses


def test_program_writes_what_it_is_told_and_overwrites_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told_by = tmp_path / "s.toml"
    told_by.write_text(TOLD.replace("ground_s = 2.0", "ground_s = 0.5").replace("height_m = 4.0", "height_m = 1.0"))
    files = [str(tmp_path / name) for name in ("x.tlog", "x.bin", "x.ulg")]
    words = [str(told_by), "--json", "--write", *files]
    assert main([*words, "--truth", str(tmp_path / "t")]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["files"] == files and (tmp_path / "t" / "truth.csv").stat().st_size > 1000
    before = (tmp_path / "x.bin").read_bytes()
    assert main(words) == 3
    assert "x.tlog" in json.loads(capsys.readouterr().out)["error"]["text"]
    assert (tmp_path / "x.bin").read_bytes() == before
    assert main([str(told_by), "--write", str(tmp_path / "x.csv")]) == 2
    assert main([str(told_by)]) == 2
    assert main([str(told_by), "--write", str(tmp_path / "no" / "x.bin")]) == 3
    heard_ = capsys.readouterr()
    assert heard_.out == "" and ".ulg" in heard_.err and "--write FILE" in heard_.err and "No such file" in heard_.err


# ---------------------------------------------------------------- laws of the parts

FINITE = st.floats(-1.0, 1.0)


@settings(max_examples=60, deadline=None)
@given(
    field=st.lists(st.floats(-600, 600), min_size=3, max_size=3),
    offsets=st.lists(st.floats(-800, 800), min_size=3, max_size=3),
    diagonal=st.lists(st.floats(0.7, 1.4), min_size=3, max_size=3),
    off_diagonal=st.lists(st.floats(-0.2, 0.2), min_size=3, max_size=3),
    motor=st.lists(st.floats(-20, 20), min_size=3, max_size=3),
    scale=st.sampled_from([0.0, 0.5, 0.8, 1.3, 2.0]),
    orient=st.sampled_from([0, 2, 6, 8, 12, 16, 20, 24, 25]),
    external=st.booleans(),
    mode=st.integers(0, 2),
    driver=st.floats(0.0, 1.0),
)
def test_both_autopilots_correct_alike(
    field: list[float], offsets: list[float], diagonal: list[float], off_diagonal: list[float], motor: list[float],
    scale: float, orient: int, external: bool, mode: int, driver: float,
) -> None:  # fmt: skip
    """ArduPilot adds, PX4 subtracts; behind that the same field, whatever is stored."""
    parameters = Parameters()
    for stem, values in (("OFS", offsets), ("DIA", diagonal), ("ODI", off_diagonal), ("MOT", motor)):
        for axis, value in zip("XYZ", values, strict=True):
            parameters.put(compass_name(stem, 2, axis), value)
    for stem, value in (("SCALE", scale), ("ORIENT", orient), ("EXTERNAL", external)):
        parameters.put(compass_name(stem, 2), value)
    parameters.put("COMPASS_MOTCT", mode)
    throttle, ampere = driver, 40 * driver
    x, y, z = field
    wanted = stored_correction(parameters, 2).apply((x, y, z), throttle, ampere)
    power = np.array([throttle if mode == 1 else ampere / 1000])
    got = px4_formula(dict(px4_parameters(parameters, 2)), 1, np.array([field]) / 1000, power)
    np.testing.assert_allclose(1000 * got[0], wanted, atol=1e-6)


@given(st.sampled_from("cCeEL"), st.floats(-100.0, 100.0))
def test_a_whole_number_of_hundredths_is_within_half_of_one(letter: str, value: float) -> None:
    value = abs(value) if letter in "CE" else value
    one = Layout(200, "TEST", letter, "V", "-", "-")
    record = as_bytes(one, (value,))
    assert record[:3] == b"\xa3\x95\xc8"
    (whole,) = struct.unpack("<" + STRUCT[letter], record[3:])
    assert abs(whole / SCALE[letter] - value) <= 0.5000001 / SCALE[letter]
    assert float(as_text(one, (value,)).decode().split(", ")[1]) == pytest.approx(whole / SCALE[letter], abs=1e-12)


@given(st.floats(-1e6, 1e6))
def test_a_short_is_cast_as_c_casts(value: float) -> None:
    (whole,) = struct.unpack("<h", as_bytes(Layout(200, "TEST", "h", "V", "-", "-"), (value,))[3:])
    assert -32768 <= whole <= 32767 and (whole - math.trunc(value)) % 65536 == 0


@pytest.mark.parametrize("quad", [True, False])
def test_every_layout_fits_its_own_description(quad: bool) -> None:
    layouts = LAYOUTS[quad].values()
    assert len({one.number for one in layouts}) == len(layouts)
    for one in layouts:
        count = len(one.format)
        assert count == len(one.columns.split(",")) == len(one.units) == len(one.multipliers), one.name
        assert count <= 16 and len(one.columns) <= 64 and len(one.name) <= 4
        assert set(one.format) <= set(STRUCT) and set(one.units) <= set(UNITS)
        assert set(one.multipliers) <= set(MULTIPLIERS)


def test_every_topic_is_padded_to_its_widest_field() -> None:
    for name, fields in TOPICS.items():
        letters, padding = layout(fields)
        assert (struct.calcsize("<" + letters) + padding) % 8 == 0, name
        assert struct.calcsize(letters) == struct.calcsize("<" + letters), name  # no gap within, as C lays it out
    with pytest.raises(ValueError, match="double wide"):
        layout("uint8_t thin;double wide;")
