"""The simulated PX4's manners, each with its value: sources in the reference on how autopilots stream and store."""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from magmav_sim import ScenarioError, Simulation, load_scenario, parse_scenario
from magmav_sim.__main__ import main
from magmav_sim.param_manners import hash_check, payload
from magmav_sim.recorder import Recorder, unattended
from magmav_sim.scenario import with_autopilot
from pymavlink.dialects.v20 import ardupilotmega as dialect
from pyulog import ULog
from sim_rig import COMPASS, HEAD, Ground, body_from_ned, mag, simulation

ACCEPTED, REJECTED, FAILED = 0, 1, 4
INT32, REAL32, UINT32 = 6, 9, 5
IRON = np.array((100.0, -50.0, 200.0))
FLIGHT = """
[[flight]]
ground_s = 1.0
pattern = [
    { kind = "takeoff", height_m = 8.0, climb_mps = 3.0 },
    { kind = "hover", seconds = %s },
    { kind = "land", sink_mps = 2.0 },
]
"""


def vehicle(
    words: str = "", *, release: str = "older", compass: str = COMPASS, top: str = "stay = true", more: str = ""
):
    """A PX4 on the ground; ``words`` are stored parameters, ``more`` further keys of its table."""
    body = f'{compass}\n[autopilot]\nkind = "px4"\nyaw = "truth"\nrelease = "{release}"\ngyro_bias_dps = 0.0\n{more}\n'
    return simulation(body + "[autopilot.parameters]\n" + words, top=top)


class Px4Ground(Ground):
    """A ground station that packs values by their bytes and reads them so."""

    def put(self, name: str, value: float, kind: int = REAL32, component: int = 1) -> list[Any]:
        packed = struct.pack("<i", int(value)) if kind == INT32 else struct.pack("<f", value)
        message = dialect.MAVLink_param_set_message(1, component, name.encode(), struct.unpack("<f", packed)[0], kind)
        self.send(message)
        return self.of("PARAM_VALUE", 0.02)

    def value(self, name: str) -> float:
        (m,) = self.read(name)
        return number(m)

    def offsets(self, x: float, y: float, z: float, slot: int = 0) -> None:
        for axis, value in zip("XYZ", (x, y, z), strict=True):
            self.send(dialect.MAVLink_param_set_message(1, 1, f"CAL_MAG{slot}_{axis}OFF".encode(), value, REAL32))
        self.run(1.5)

    def gauss(self) -> np.ndarray:
        """HIGHRES_IMU's field, gauss."""
        self.stream(105, 20)
        return mag([m for m in self.run(0.5) if m.get_type() == "HIGHRES_IMU"][-1])


def number(m: Any) -> float:
    """A PARAM_VALUE's value from its bytes."""
    return float(struct.unpack("<f" if m.param_type == REAL32 else "<i", payload(m)[:4])[0])


def earth_b_mg(sim: Simulation) -> np.ndarray:
    s = sim.autopilot.state
    return body_from_ned(s.roll_rad, s.pitch_rad, s.heading_rad) @ np.array(sim.world.field_ned_mg)


# ---------------------------------------------------------------- who it is


def test_heartbeat_names_px4_its_modes_and_arming():
    ground = Px4Ground(vehicle())
    beat = ground.run(0.1)[0]
    assert (beat.autopilot, beat.type, beat.base_mode) == (12, 2, 29)
    assert (beat.custom_mode >> 16 & 0xFF, beat.custom_mode >> 24) == (4, 3)  # auto, loiter
    assert ground.command(176, 1, 3, 0) == ACCEPTED  # position control
    beat = ground.of("HEARTBEAT", 1.1)[-1]
    assert (beat.base_mode, beat.custom_mode) == (0x51, 3 << 16)
    assert ground.command(400, 1) == ACCEPTED
    assert ground.of("HEARTBEAT", 1.1)[-1].base_mode == 0x51 | 0x80


def test_in_a_mission_it_says_so_and_how_it_lands():
    ground = Px4Ground(vehicle(FLIGHT % 5.0))
    heard = ground.run(30.0)
    landed = [m.landed_state for m in heard if m.get_type() == "EXTENDED_SYS_STATE"]
    assert [b for a, b in zip([0, *landed], landed, strict=False) if a != b] == [1, 3, 2, 4, 1]
    modes = [m.custom_mode >> 24 for m in heard if m.get_type() == "HEARTBEAT" and m.base_mode & 128]
    assert set(modes) == {3, 4} and modes[len(modes) // 2] == 4


def test_version_tells_the_board_and_only_newer_ones_tell_the_encoding():
    for release, bit in (("older", 0), ("newer", 16)):
        ground = Px4Ground(vehicle(release=release, more="uid = 4660"))
        assert ground.command(512, 148) == ACCEPTED
        (version,) = [m for m in ground.heard if m.get_type() == "AUTOPILOT_VERSION"]
        assert (version.uid, version.capabilities & 16) == (4660, bit)
        assert bytes(version.uid2)[:2] == b"\x34\x12" and version.flight_sw_version >> 16 == 0x010E


def test_only_its_own_component_is_answered():
    ground = Px4Ground(vehicle())
    assert ground.put("CAL_MAG0_XOFF", 0.1, component=191) == []
    ground.send(dialect.MAVLink_command_long_message(1, 191, 400, 0, 1, 0, 0, 0, 0, 0, 0))
    assert ground.of("COMMAND_ACK", 0.1) == [] and not ground.sim.truth.armed
    assert ground.value("CAL_MAG0_XOFF") == 0.0
    assert number(ground.put("CAL_MAG0_XOFF", 0.1, component=0)[0]) == np.float32(0.1)


# ---------------------------------------------------------------- parameters


def test_list_begins_with_the_hash_and_is_complete_and_alphabetical():
    ground = Px4Ground(vehicle())
    ground.send(dialect.MAVLink_param_request_list_message(1, 1))
    first, *values = ground.of("PARAM_VALUE", 3.0)
    assert (first.param_id, first.param_type, first.param_index) == ("_HASH_CHECK", UINT32, 65535)
    assert payload(first)[:4] == hash_check(ground.sim.autopilot.parameters)
    assert len(values) == first.param_count == values[0].param_count
    assert [v.param_index for v in values] == list(range(len(values)))
    assert [v.param_id for v in values] == sorted(v.param_id for v in values)
    assert {v.param_type for v in values} == {INT32, REAL32}
    held = {v.param_id: number(v) for v in values}
    assert (held["CAL_MAG0_ID"], held["CAL_MAG0_ROT"], held["CAL_MAG0_PRIO"]) == (97539, 0, 75)
    assert (held["CAL_MAG3_ROT"], held["CAL_MAG3_ID"], held["CAL_MAG0_XSCALE"]) == (-1, 0, 1.0)
    assert held["SENS_MAG_AUTOCAL"] == 1


def test_minus_one_is_no_number_as_a_float_and_minus_one_in_its_bytes():
    (m,) = Px4Ground(vehicle()).read("CAL_MAG3_ROT")
    assert math.isnan(m.param_value) and payload(m)[:4] == b"\xff\xff\xff\xff" and number(m) == -1


@settings(max_examples=40, deadline=None)
@given(st.integers(-(2**31), 2**31 - 1))
def test_every_int32_comes_back_bit_for_bit(device):
    """Signalling NaNs among them, which Python's float would change."""
    ground = SHARED
    table = ground.sim.autopilot.parameters
    table.put("CAL_MAG2_ID", device)
    (m,) = ground.read("CAL_MAG2_ID")
    assert payload(m)[:4] == struct.pack("<i", device)
    assert m.param_index == table.index("CAL_MAG2_ID")


SHARED = Px4Ground(vehicle())


def test_set_wants_the_stored_type_and_answers_with_the_true_index():
    ground = Px4Ground(vehicle())
    (echo,) = ground.put("CAL_MAG0_ROT", -1, INT32)
    assert (number(echo), echo.param_type) == (-1, INT32)
    assert echo.param_index == ground.sim.autopilot.parameters.index("CAL_MAG0_ROT")
    assert ground.put("CAL_MAG0_ROT", 6.0, REAL32) == [] and ground.value("CAL_MAG0_ROT") == -1
    assert ground.put("CAL_MAG0_XOFF", 1, INT32) == [] and ground.value("CAL_MAG0_XOFF") == 0.0


def test_an_unknown_name_is_met_with_a_text_only():
    ground = Px4Ground(vehicle())
    assert ground.put("COMPASS_OFS_X", 1.0) == [] == ground.read("COMPASS_OFS_X")
    assert [m.text for m in ground.heard if m.get_type() == "STATUSTEXT"] == ["unknown param: COMPASS_OFS_X"] * 2


def test_hash_moves_with_any_value_and_setting_it_ends_a_list():
    ground = Px4Ground(vehicle())
    before = payload(ground.read("_HASH_CHECK")[0])[:4]
    ground.put("CAL_MAG0_ZOFF", 0.001)
    assert payload(ground.read("_HASH_CHECK")[0])[:4] != before
    ground.send(dialect.MAVLink_param_request_list_message(1, 1))
    ground.run(0.02)
    ground.send(dialect.MAVLink_param_set_message(1, 1, b"_HASH_CHECK", 0.0, UINT32))
    ground.run(0.02)
    assert ground.of("PARAM_VALUE", 1.0) == []


# ---------------------------------------------------------------- streams


def test_no_raw_imu_and_no_stream_groups():
    ground = Px4Ground(vehicle())
    assert ground.command(511, 27, 100_000) == FAILED
    ground.send(dialect.MAVLink_request_data_stream_message(1, 1, 1, 10, 1))
    names = {m.get_type() for m in ground.run(3.0)}
    assert "EXTENDED_SYS_STATE" in names and "ATTITUDE" in names
    assert not names & {"RAW_IMU", "SCALED_IMU", "HIGHRES_IMU"}


@pytest.mark.parametrize("orient", [0, 2, 8, 24, 31, 38, 40])
def test_scaled_imu_is_the_sensor_before_any_correction_in_its_own_axes(orient):
    """The truth: mounting^-1 (earth + iron), cut toward zero; offsets do not show."""
    ground = Px4Ground(vehicle("CAL_MAG0_XOFF = 0.3\nCAL_MAG0_YSCALE = 1.2\n", compass=f"{COMPASS}orient = {orient}\n"))
    ground.stream(26, 10)
    message = ground.of("SCALED_IMU", 0.5)[-1]
    roll, pitch, yaw = ANGLES[orient]
    r = body_from_ned(*np.radians((roll, pitch, yaw))).T
    want = r.T @ (earth_b_mg(ground.sim) + IRON)
    np.testing.assert_array_equal(mag(message), np.trunc(want))
    assert message.zacc == pytest.approx(-1000, abs=20)


ANGLES = {
    0: (0, 0, 0), 2: (0, 0, 90), 8: (180, 0, 0), 24: (0, 90, 0), 31: (90, 180, 0), 38: (90, 68, 293), 40: (90, 315, 0),
}  # fmt: skip


@pytest.mark.parametrize("orient", range(41))
def test_every_mounting_is_undone_by_its_number(orient):
    turned, plain = vehicle(compass=f"{COMPASS}orient = {orient}\n"), vehicle()
    for sim in (turned, plain):
        sim.advance(0.2)
    np.testing.assert_allclose(turned.autopilot.published_mg[0], plain.autopilot.published_mg[0], atol=1e-9)


def test_the_order_of_correction_by_hand():
    """body = R S (sensor + COMP power - OFF): any other order gives other numbers."""
    stored = {"XOFF": 0.1, "XSCALE": 2.0, "XODIAG": 0.5, "XCOMP": 10.0}
    words = "CAL_MAG_COMP_TYP = 2\n" + "".join(f"CAL_MAG0_{k} = {v}\n" for k, v in stored.items())
    sim = vehicle(words, compass=COMPASS + "orient = 2\n")  # sensor x is body y
    sim.advance(0.1)
    x, y, z = (earth_b_mg(sim) + IRON)[[1, 0, 2]] * (1, -1, 1)
    power_mg = sim.autopilot.battery.measured_ampere / 1000 * 10.0 * 1000
    u, v = x + power_mg - 100, y
    np.testing.assert_allclose(sim.autopilot.published_mg[0], (-(0.5 * u + v), 2 * u + 0.5 * v, z), atol=1e-6)


def test_highres_imu_is_corrected_gauss_and_marks_the_field_only_when_new():
    ground = Px4Ground(vehicle("CAL_MAG0_XOFF = 0.1\nCAL_MAG0_YOFF = -0.05\nCAL_MAG0_ZOFF = 0.2\n"))
    np.testing.assert_allclose(ground.gauss() * 1000, earth_b_mg(ground.sim), atol=1e-3)
    ground.stream(105, 100)
    flags = [m.fields_updated & 0b111000000 for m in ground.of("HIGHRES_IMU", 2.0)]
    assert flags.count(0b111000000) == 20 and flags.count(0) == 180


def test_highest_priority_is_what_the_filter_follows():
    second = "[[compass]]\ndevice_id = 131874\nexternal = false\nhard_iron_mg = [0.0, 30.0, 0.0]\nnoise_mg = 0.0\n"
    ground = Px4Ground(vehicle(compass=COMPASS + second))
    assert (ground.value("CAL_MAG1_ROT"), ground.value("CAL_MAG1_PRIO")) == (-1, 50)
    np.testing.assert_allclose(ground.gauss() * 1000, earth_b_mg(ground.sim) + IRON, atol=1e-3)
    ground.put("CAL_MAG0_PRIO", 25, INT32)
    ground.run(1.2)
    np.testing.assert_allclose(ground.gauss() * 1000, earth_b_mg(ground.sim) + np.array((0, 30, 0)), atol=1e-3)


# ---------------------------------------------------------------- calibration


def test_a_slot_is_found_by_device_id_and_not_by_number():
    words = "CAL_MAG0_ID = 0\nCAL_MAG2_ID = 97539\nCAL_MAG0_XOFF = 9.0\nCAL_MAG2_XOFF = 0.1\nCAL_MAG2_ROT = 0\n"
    sim = vehicle(words)
    sim.advance(0.1)
    np.testing.assert_allclose(sim.autopilot.published_mg[0], earth_b_mg(sim) + IRON - (100, 0, 0), atol=1e-4)


@pytest.mark.parametrize(("external", "rot"), [("false", "SENS_BOARD_ROT = 4\n"), ("true", "")])
def test_internal_compass_turns_with_the_board_and_both_are_levelled(external, rot):
    compass = COMPASS + f"external = {external}\norient = 4\n"
    level = body_from_ned(math.radians(3.0), 0.0, 0.0).T
    for words, turn in (("", np.eye(3)), ("SENS_BOARD_X_OFF = 3.0\n", level)):
        sim = vehicle(rot + words, compass=compass)
        sim.advance(0.1)
        np.testing.assert_allclose(sim.autopilot.published_mg[0], turn @ (earth_b_mg(sim) + IRON), atol=1e-9)


@pytest.mark.parametrize(("release", "ignored_mg"), [("older", 10.0), ("newer", 5.0)])
def test_a_small_change_of_offsets_waits_for_a_boot(release, ignored_mg):
    ground = Px4Ground(vehicle(release=release))
    ground.run(1.0)
    before = ground.gauss() * 1000
    small = (ignored_mg - 0.5) / 1000
    ground.offsets(small, 0, 0)
    assert ground.value("CAL_MAG0_XOFF") == np.float32(small)
    np.testing.assert_allclose(ground.gauss() * 1000, before, atol=1e-3)
    assert ground.command(246, 1) == ACCEPTED
    ground.run(3.0)
    np.testing.assert_allclose(ground.gauss() * 1000, before - (small * 1000, 0, 0), atol=1e-3)
    ground.offsets(small + (ignored_mg + 0.5) / 1000, 0, 0)
    np.testing.assert_allclose(ground.gauss() * 1000, before - (2 * ignored_mg, 0, 0), atol=1e-3)


@pytest.mark.parametrize(("release", "waits"), [("older", True), ("newer", False)])
def test_older_ones_do_not_apply_while_armed(release, waits):
    ground = Px4Ground(vehicle("COM_DISARM_PRFLT = 60.0\n", release=release))
    before = ground.gauss() * 1000
    assert ground.command(400, 1) == ACCEPTED
    ground.offsets(0.1, 0, 0)
    np.testing.assert_allclose(ground.gauss() * 1000, before - (0 if waits else 100, 0, 0), atol=1e-3)
    assert ground.command(400, 0) == ACCEPTED
    ground.run(1.2)
    np.testing.assert_allclose(ground.gauss() * 1000, before - (100, 0, 0), atol=1e-3)


def test_mag_cal_report_tells_gauss_to_subtract_once_after_each_look():
    ground = Px4Ground(vehicle("CAL_MAG0_XOFF = 0.125\nCAL_MAG0_ROT = 0\n"))
    ground.stream(192, 1)
    (report,) = ground.of("MAG_CAL_REPORT", 3.0) or [m for m in ground.heard if m.get_type() == "MAG_CAL_REPORT"]
    assert (report.compass_id, report.ofs_x, report.diag_x, report.cal_status) == (0, 0.125, 1.0, 4)
    ground.put("CAL_MAG0_ZOFF", -0.5)
    (report,) = ground.of("MAG_CAL_REPORT", 3.0)
    assert (report.ofs_x, report.ofs_z) == (0.125, -0.5)


def test_a_compass_without_a_slot_may_not_arm():
    ground = Px4Ground(vehicle(compass=COMPASS + "committed = false\n"))
    assert ground.value("CAL_MAG0_ID") == 0
    assert ground.command(400, 1) == REJECTED
    assert [m.text for m in ground.heard if m.get_type() == "STATUSTEXT"] == ["Preflight Fail: Compass 0 uncalibrated"]
    ground.put("CAL_MAG0_ID", 97539, INT32)
    assert ground.command(400, 1) == ACCEPTED


# ---------------------------------------------------------------- the filter, and the second writer


def test_the_filter_takes_its_bias_off_highres_imu_and_nothing_off_scaled_imu():
    """After t seconds in the air e (1 - exp(-t / tau)) is gone, e being what the offsets left over."""
    sim = vehicle("CAL_MAG0_XOFF = 0.06\n" + FLIGHT % 15.0)
    seen = []
    sim.watchers.append(lambda sent: seen.append((sim.elapsed_ns, sim.autopilot.landed_state, sim.autopilot.reads)))
    while not any(e["what"] == "touchdown" for e in sim.autopilot.events):
        sim.advance(0.1)
    air_s = 0.1 * len({reads for _, landed, reads in seen if landed != 1})
    left_over = IRON - (60, 0, 0)
    bias = sim.autopilot.bias_b_mg
    np.testing.assert_allclose(bias, left_over * (1 - math.exp(-air_s / 20.0)), rtol=0.01)
    assert np.linalg.norm(bias) > 100
    published = np.array(sim.autopilot.published_mg[0])
    np.testing.assert_allclose(sim.autopilot.trusted_mg, published - bias, atol=1e-9)
    ground = Px4Ground(sim)
    np.testing.assert_allclose(ground.gauss() * 1000, np.array(sim.autopilot.trusted_mg), atol=1e-3)
    ground.stream(26, 20)
    np.testing.assert_array_equal(mag(ground.of("SCALED_IMU", 0.2)[-1]), np.trunc(sim.autopilot.raw_mg[0]))


@pytest.mark.parametrize(("release", "share"), [("older", 0.2), ("newer", 0.5)])
def test_autocal_moves_offsets_after_landing_by_its_share_and_says_nothing(release, share):
    """vref / (vref + variance): 2.5e-7 or 1e-6 gauss^2 against 1e-6."""
    sim = vehicle("CAL_MAG0_XOFF = 0.06\n" + FLIGHT % 35.0, release=release)
    ground, bias = Px4Ground(sim), None
    while sim.autopilot.armed or sim.elapsed_ns < 5e9:
        bias = sim.autopilot.bias_b_mg
        ground.run(0.1)
    ground.run(3.0)
    want = np.array((0.06, 0, 0)) + share * bias / 1000
    got = [ground.value(f"CAL_MAG0_{axis}OFF") for axis in "XYZ"]
    np.testing.assert_allclose(got, want, atol=1e-6)
    told = [m for m in ground.heard if m.get_type() == "PARAM_VALUE"]
    assert len(told) == 3  # those just asked for
    np.testing.assert_allclose(ground.gauss() * 1000, earth_b_mg(sim) + IRON - 1000 * want, atol=0.01)
    assert [e["what"] for e in sim.autopilot.events][-2:] == ["disarm", "autocal"]


@pytest.mark.parametrize("words", ["SENS_MAG_AUTOCAL = 0\n" + FLIGHT % 35.0, FLIGHT % 10.0])
def test_autocal_off_or_too_short_in_the_air_changes_nothing(words):
    sim = vehicle(words, top="end_ground_s = 1.0")
    sim.advance(120.0)
    assert sim.finished and sim.autopilot.parameters["CAL_MAG0_XOFF"] == 0.0
    assert "autocal" not in [e["what"] for e in sim.autopilot.events]


# ---------------------------------------------------------------- files and words


def test_any_scenario_may_be_flown_by_px4_unless_it_names_the_others_parameters(tmp_path, capsys):
    sim = Simulation(with_autopilot(load_scenario("demo"), "px4"))
    assert sim.advance(0.1) and sim.autopilot.vendor == 12
    text = HEAD + COMPASS + "[autopilot.parameters]\nARMING_CHECK = 1\n"
    with pytest.raises(ScenarioError, match="ARMING_CHECK"):
        with_autopilot(parse_scenario(text.encode(), "x.toml"), "px4")
    assert main(["figure8", "--autopilot", "px4", "--write", str(tmp_path / "x.bin")]) == 2
    assert "PX4 keeps no such log" in capsys.readouterr().err


def test_ulog_of_a_px4_holds_its_own_parameters_and_raw_sensors(tmp_path):
    body = (
        COMPASS
        + 'orient = 2\n[autopilot]\nkind = "px4"\n[autopilot.parameters]\nCAL_MAG0_XOFF = 0.125\n'
        + FLIGHT % 2.0
    )
    scenario = parse_scenario((HEAD + "end_ground_s = 1.0\n" + body).encode(), "x.toml")
    sim = Simulation(unattended(scenario))
    parked = earth_b_mg(sim)
    with Recorder(sim, [tmp_path / "x.ulg", tmp_path / "x.tlog"]):
        sim.advance(60.0)
    log = ULog(str(tmp_path / "x.ulg"))
    assert {k: log.initial_parameters[k] for k in ("CAL_MAG0_ID", "CAL_MAG0_ROT", "CAL_MAG0_XOFF", "CAL_MAG3_ROT")} == {
        "CAL_MAG0_ID": 97539, "CAL_MAG0_ROT": 2, "CAL_MAG0_XOFF": 0.125, "CAL_MAG3_ROT": -1,
    }  # fmt: skip
    assert log.initial_parameters["SENS_MAG_AUTOCAL"] == 1
    first = log.get_dataset("sensor_mag").data
    raw = np.array([first[k][3] for k in "xyz"]) * 1000
    np.testing.assert_allclose(raw, np.array(((0, 1, 0), (-1, 0, 0), (0, 0, 1))) @ (parked + IRON), atol=1e-3)
    assert (tmp_path / "x.tlog").stat().st_size > 10_000
