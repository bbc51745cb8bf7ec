"""The simulated autopilot's manners, each as observed on ArduPilot 4.5 (reference: how autopilots stream
and store)."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect
from sim_rig import COMPASS, Ground, mag, simulation

ACCEPTED, DENIED, UNSUPPORTED, FAILED = 0, 2, 3, 4


@pytest.fixture
def ground():
    return Ground(simulation())


# ---------------------------------------------------------------- parameters


def test_list_is_complete_in_order_and_typed(ground):
    ground.send(dialect.MAVLink_param_request_list_message(1, 1))
    values = ground.of("PARAM_VALUE", 2.0)
    assert [v.param_index for v in values] == list(range(values[0].param_count))
    by_name = {v.param_id: v for v in values}
    assert len(by_name) == len(values) > 120
    for name, kind in (
        ("COMPASS_OFS3_Z", 9),
        ("COMPASS_DEV_ID2", 6),
        ("COMPASS_EXTERN2", 2),
        ("COMPASS_OFFS_MAX", 4),
    ):
        assert by_name[name].param_type == kind
    assert by_name["COMPASS_DEV_ID"].param_value == 97539
    assert by_name["COMPASS_DEV_ID2"].param_value == 0
    assert by_name["COMPASS_OFFS_MAX"].param_value == 1800
    assert "COMPASS_EXTERNAL2" not in by_name


def test_set_is_echoed_with_no_index_and_kept_as_float32(ground):
    (echo,) = ground.set("COMPASS_OFS_X", 12.3456789)
    assert (echo.param_id, echo.param_index) == ("COMPASS_OFS_X", 65535)
    assert echo.param_value == float(np.float32(12.3456789))
    (again,) = ground.set("COMPASS_OFS_X", 12.3456789)
    assert again.param_value == echo.param_value


def test_read_by_name_has_no_index_and_by_index_has_it(ground):
    (by_name,) = ground.read("COMPASS_OFS_X")
    assert by_name.param_index == 65535
    index = ground.sim.autopilot.parameters.index("COMPASS_OFS_X")
    (by_index,) = ground.read(index=index)
    assert (by_index.param_id, by_index.param_index) == ("COMPASS_OFS_X", index)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_no_number_is_met_with_silence(ground, value):
    ground.set("COMPASS_OFS_X", 5.0)
    assert ground.set("COMPASS_OFS_X", value) == []
    assert ground.read("COMPASS_OFS_X")[0].param_value == 5.0


def test_unknown_names_and_indices_are_met_with_silence(ground):
    assert ground.set("MMAG_OFS_X", 1.0) == []
    assert ground.read("MMAG_OFS_X") == []
    assert ground.read(index=5000) == []


def test_nothing_checks_the_range_of_a_float_but_integers_are_cast(ground):
    assert ground.set("COMPASS_OFS_X", 99999.0)[0].param_value == 99999.0
    assert ground.set("COMPASS_LEARN", 2.7)[0].param_value == 2.0
    assert ground.set("COMPASS_LEARN", 999.0)[0].param_value == 127.0


def test_accepts_while_armed(ground):
    assert ground.command(400, 1) == ACCEPTED
    assert ground.of("HEARTBEAT", 1.1)[-1].base_mode & 128
    assert ground.set("COMPASS_OFS_X", 60.0)[0].param_value == 60.0


def test_set_for_an_unseen_component_of_its_system_is_taken_as_its_own(ground):
    """The routing trap: what it cannot forward to another link it processes."""
    (echo,) = ground.set("COMPASS_OFS_Y", 77.0, component=191)
    assert (echo.get_srcComponent(), echo.param_value) == (1, 77.0)


def test_another_system_is_none_of_its_business(ground):
    ground.send(dialect.MAVLink_param_set_message(2, 1, b"COMPASS_OFS_X", 5.0, 9))
    assert ground.of("PARAM_VALUE", 0.1) == []
    assert ground.read("COMPASS_OFS_X")[0].param_value == 0.0


def test_written_offsets_move_the_stream_by_exactly_that(ground):
    ground.stream(27, 20)
    before = ground.field()
    ground.set("COMPASS_OFS_Z", 50.0)
    np.testing.assert_array_equal(ground.field() - before, (0, 0, 50))


def test_learnt_declination_is_the_models(ground):
    # WMM2025 at Zurich in late 2026: 3.65 degrees east.
    assert math.degrees(ground.read("COMPASS_DEC")[0].param_value) == pytest.approx(3.66, abs=0.05)


# ---------------------------------------------------------------- streams


def test_only_the_heartbeat_is_sent_unasked(ground):
    heard = ground.run(5.0)
    assert {m.get_type() for m in heard} == {"HEARTBEAT"}
    assert len(heard) == 6  # at once, then each second
    beat = heard[0]
    assert (beat.autopilot, beat.type, beat.base_mode & 128) == (3, 2, 0)


def test_field_is_refreshed_at_10_hz_and_repeated_in_a_faster_stream():
    ground = Ground(simulation(COMPASS.replace("noise_mg = 0.0", "noise_mg = 30.0")))
    ground.stream(27, 50)
    ground.run(1.0)
    heard = ground.of("RAW_IMU", 20.0)
    assert len(heard) == 1000
    fields = [tuple(mag(m)) for m in heard]
    assert 190 <= len(set(fields)) <= 201
    runs = np.diff([i for i in range(1, 1000) if fields[i] != fields[i - 1]])
    assert np.median(runs) == 5
    assert [b.time_usec - a.time_usec for a, b in pairwise(heard)] == [20_000] * 999


def test_intervals_are_whole_milliseconds_capped_and_stoppable(ground):
    assert ground.command(511, 30, 33_900) == ACCEPTED
    times = [m.time_boot_ms for m in ground.of("ATTITUDE", 3.3)]
    assert len(times) == pytest.approx(100, abs=1)
    assert ground.command(511, 30, 1.0) == ACCEPTED  # faster than anything: the loop's own rate
    assert len(ground.of("ATTITUDE", 1.0)) == 100
    assert ground.command(511, 30, -1) == ACCEPTED
    assert ground.of("ATTITUDE", 1.0) == []
    assert ground.command(511, 105, 10_000) == DENIED  # HIGHRES_IMU is not in 4.5
    assert ground.command(511, 30, 100_000) == ACCEPTED
    assert ground.command(511, 30, 0) == ACCEPTED  # the default, which is off
    assert ground.of("ATTITUDE", 1.0) == []


def test_request_data_stream_starts_and_stops_a_group(ground):
    ground.send(dialect.MAVLink_request_data_stream_message(1, 1, 1, 10, 1))
    names = [m.get_type() for m in ground.run(2.0)]
    assert names.count("RAW_IMU") == names.count("SCALED_IMU2") == pytest.approx(20, abs=1)
    assert "SCALED_IMU" not in names and "ATTITUDE" not in names
    ground.send(dialect.MAVLink_request_data_stream_message(1, 1, 1, 10, 0))
    ground.run(0.1)
    assert ground.of("RAW_IMU", 1.0) == []


def test_absent_compass_of_a_second_imu_is_all_zero_and_a_third_is_not_sent(ground):
    ground.stream(116, 10)
    ground.stream(129, 10)
    heard = ground.run(1.0)
    second = [m for m in heard if m.get_type() == "SCALED_IMU2"]
    assert second and not any(mag(m).any() for m in second)
    assert second[0].zacc == pytest.approx(-1000, abs=15)
    assert not [m for m in heard if m.get_type() == "SCALED_IMU3"]


def test_scaled_imu_is_compass_1_and_raw_imu_too(ground):
    ground.stream(26, 10)
    ground.stream(27, 10)
    heard = {m.get_type(): m for m in ground.run(1.0)}
    np.testing.assert_array_equal(mag(heard["SCALED_IMU"]), mag(heard["RAW_IMU"]))
    assert heard["RAW_IMU"].time_usec // 1000 - heard["SCALED_IMU"].time_boot_ms == 20  # asked one ack later


def test_what_else_can_be_asked_for(ground):
    for number in (1, 2, 24, 31, 33, 74, 147, 245):
        assert ground.stream(number, 2) == ACCEPTED
    heard = {m.get_type(): m for m in ground.run(2.0)}
    assert heard["EXTENDED_SYS_STATE"].landed_state == 1
    position = heard["GLOBAL_POSITION_INT"]
    assert (position.lat, position.lon) == (473977000, 85456000)
    assert position.alt == 488000 and position.relative_alt == 0
    assert heard["BATTERY_STATUS"].current_battery == pytest.approx(50, abs=90)  # centiampere, motors off
    assert heard["SYSTEM_TIME"].time_unix_usec == 1795341600_000000 + heard["SYSTEM_TIME"].time_boot_ms * 1000
    q = heard["ATTITUDE_QUATERNION"]
    assert q.q1**2 + q.q2**2 + q.q3**2 + q.q4**2 == pytest.approx(1, abs=1e-5)
    assert heard["GPS_RAW_INT"].fix_type == 3


def test_request_message_sends_it_once(ground):
    assert ground.command(512, 148) == ACCEPTED
    version = [m for m in ground.heard if m.get_type() == "AUTOPILOT_VERSION"]
    assert len(version) == 1 and version[0].flight_sw_version >> 16 == 0x0405
    assert ground.command(512, 397) == FAILED


# ---------------------------------------------------------------- commands


def test_unknown_commands_are_unsupported_and_calibration_is_refused_armed(ground):
    assert ground.command(242, 2, 1, 2, 3) == UNSUPPORTED
    assert ground.command(241, 0, 1) == UNSUPPORTED
    assert ground.command(400, 1) == ACCEPTED
    assert ground.command(241, 0, 1) == FAILED
    assert ground.command(246, 1) == FAILED  # no reboot while armed


def test_arming_is_refused_without_offsets_when_checks_are_on():
    ground = Ground(simulation(COMPASS + "[autopilot.parameters]\nARMING_CHECK = 1\n"))
    assert ground.command(400, 1) == FAILED
    assert [m.text for m in ground.heard if m.get_type() == "STATUSTEXT"] == ["PreArm: Compass not calibrated"]
    ground.set("COMPASS_OFS_X", -100.0)
    assert ground.command(400, 1) == ACCEPTED


def test_flight_that_may_not_arm_waits_and_gives_up():
    body = COMPASS + "[autopilot.parameters]\nARMING_CHECK = 1\n"
    body += '[[flight]]\nground_s = 1.0\nwait_s = 10.0\npattern = [{ kind = "takeoff" }, { kind = "land" }]\n'
    sim = simulation(body, top="end_ground_s = 1.0")
    sim.advance(30.0)
    assert sim.finished and sim.elapsed_ns / 1e9 == pytest.approx(12, abs=0.1)
    assert sim.autopilot.events == []


def test_standing_armed_it_disarms_after_ten_seconds(ground):
    ground.command(400, 1)
    ground.run(9.0)
    assert ground.sim.truth.armed
    ground.run(2.0)
    assert not ground.sim.truth.armed


def test_reboot_starts_clock_and_streams_again_and_keeps_parameters(ground):
    ground.stream(30, 10)
    ground.set("COMPASS_OFS_X", 42.0)
    ground.run(5.0)
    assert ground.command(246, 1) == ACCEPTED
    assert ground.sim.boot_ns < 0.1e9
    heard = ground.run(5.0)
    assert {m.get_type() for m in heard} == {"HEARTBEAT"}
    assert ground.read("COMPASS_OFS_X")[0].param_value == 42.0
    ground.stream(30, 10)
    assert ground.of("ATTITUDE", 0.5)[0].time_boot_ms < 6000


def test_ping_of_others_is_answered_to_the_sender(ground):
    ground.send(dialect.MAVLink_ping_message(123, 9, 0, 0))
    (answer,) = ground.of("PING", 0.1)
    assert (answer.seq, answer.time_usec, answer.target_system, answer.target_component) == (9, 123, 255, 190)


def test_yaw_follows_the_corrected_compass_wherever_that_leads(ground):
    """As a real filter does: which is why the autopilot's yaw proves nothing about the compass."""
    ground.stream(30, 10)
    ground.run(1.0)
    wrong = math.degrees(ground.of("ATTITUDE", 0.2)[-1].yaw) % 360
    assert abs(math.remainder(wrong - 70, 360)) > 10
    for axis, value in (("X", -100.0), ("Y", 50.0), ("Z", -200.0)):
        ground.set(f"COMPASS_OFS_{axis}", value)
    ground.run(8.0)
    half = math.degrees(ground.of("ATTITUDE", 0.2)[-1].yaw) % 360
    assert abs(half - 70) == pytest.approx(abs(wrong - 70) / math.e, rel=0.2)
    ground.run(50.0)
    assert math.degrees(ground.of("ATTITUDE", 0.2)[-1].yaw) % 360 == pytest.approx(70, abs=2.5)


def test_garbage_and_broken_frames_change_nothing(ground):
    rng = np.random.default_rng(3)
    before = dict(ground.sim.autopilot.parameters._values)
    for size in rng.integers(1, 300, 300):
        ground.sim.receive(rng.bytes(int(size)))
    ground.run(0.5)
    assert dict(ground.sim.autopilot.parameters._values) == before
    assert ground.set("COMPASS_OFS_X", 3.0)


# ---------------------------------------------------------------- faults of the autopilot


def fault(text):
    return Ground(simulation(COMPASS + "[[fault]]\n" + text))


def test_deaf_autopilot_answers_no_parameter_message():
    ground = fault('kind = "deaf"\nat_s = 1.0\nuntil_s = 2.0\n')
    assert ground.set("COMPASS_OFS_X", 1.0)
    ground.run(1.0)
    assert ground.set("COMPASS_OFS_X", 2.0) == [] == ground.read("COMPASS_OFS_X")
    assert ground.command(511, 27, 100_000) == ACCEPTED
    ground.run(1.0)
    assert ground.read("COMPASS_OFS_X")[0].param_value == 1.0


def test_echo_without_effect_leaves_the_field_as_it_was():
    ground = fault('kind = "no_effect"\n')
    ground.stream(27, 10)
    before = ground.field()
    assert ground.set("COMPASS_OFS_X", 90.0)[0].param_value == 90.0
    assert ground.read("COMPASS_OFS_X")[0].param_value == 90.0
    np.testing.assert_array_equal(ground.field(), before)


def test_arms_after_the_nth_set_and_disarms_later():
    ground = fault('kind = "arms_after_sets"\nsets = 2\nseconds = 3.0\n')
    ground.set("COMPASS_OFS_X", 1.0)
    assert not ground.sim.truth.armed
    ground.set("COMPASS_OFS_Y", 1.0)
    assert ground.sim.truth.armed
    ground.run(3.1)
    assert not ground.sim.truth.armed


def test_swapped_sensor_shows_its_own_device_id():
    ground = fault('kind = "device_id"\ncompass = 1\ndevice_id = 4711\nat_s = 1.0\n')
    assert ground.read("COMPASS_DEV_ID")[0].param_value == 97539
    ground.run(1.2)
    assert ground.read("COMPASS_DEV_ID")[0].param_value == 4711
