"""The simulated ArduPilot's further manners: committed ids, priorities, both naming schemes, errors, mountings."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from magmav_sim import Simulation
from magmav_sim.mounting import rotation_matrix
from magmav_sim.parameters import Parameters, compass_name, new_name
from pymavlink.dialects.v20 import ardupilotmega as dialect
from sim_rig import COMPASS, Ground, body_from_ned, mag, simulation

ACCEPTED, UNSUPPORTED, FAILED = 0, 3, 4
CHECKS = "[autopilot.parameters]\nARMING_CHECK = 1\n"
NOT_CALIBRATED = "PreArm: Compass not calibrated"
THREE = "".join(
    f"[[compass]]\ndevice_id = {device}\nhard_iron_mg = [{iron}, 0.0, 0.0]\nnoise_mg = 0.0\n"
    for device, iron in ((97539, 10.0), (131874, 20.0), (263178, 30.0))
)
DEVICES = (97539, 131874, 263178)


def said(ground):
    return [m.text for m in ground.heard if m.get_type() == "STATUSTEXT"]


# ---------------------------------------------------------------- committed device ids


def test_offsets_alone_do_not_commit_a_device_id():
    ground = Ground(simulation(COMPASS + "committed = false\n" + CHECKS))
    ground.set("COMPASS_OFS_X", -100.0)
    assert ground.read("COMPASS_DEV_ID")[0].param_value == 97539  # nothing to be seen from outside
    assert ground.command(400, 1) == FAILED and said(ground) == [NOT_CALIBRATED]
    assert ground.command(241, 0, 76) == ACCEPTED
    assert ground.command(400, 1) == ACCEPTED
    assert ground.command(241, 0, 76) == FAILED  # disarmed only


def test_asked_for_its_checks_it_says_what_they_find_and_changes_nothing():
    ground = Ground(simulation(COMPASS + "committed = false\n" + CHECKS))
    ground.set("COMPASS_OFS_X", -100.0)
    assert ground.command(401) == ACCEPTED and said(ground) == [NOT_CALIBRATED]
    ground.command(241, 0, 76)
    ground.heard.clear()
    assert ground.command(401) == ACCEPTED and said(ground) == []
    assert not ground.sim.truth.armed


def test_all_zero_offsets_are_not_calibrated_whatever_is_committed():
    ground = Ground(simulation(COMPASS + CHECKS))
    assert ground.command(241, 0, 76) == ACCEPTED
    assert ground.command(400, 1) == FAILED and said(ground) == [NOT_CALIBRATED]


def test_storing_the_device_id_itself_commits_it():
    ground = Ground(simulation(COMPASS + "committed = false\n" + CHECKS))
    ground.set("COMPASS_OFS_X", -100.0)
    ground.set("COMPASS_DEV_ID", 97539)
    assert ground.command(400, 1) == ACCEPTED


def test_another_sensor_is_not_the_one_that_was_committed():
    body = (
        COMPASS
        + CHECKS
        + 'COMPASS_OFS_X = -1.0\n[[fault]]\nkind = "device_id"\ncompass = 1\ndevice_id = 4711\nat_s = 1\n'
    )
    ground = Ground(simulation(body))
    assert ground.sim.autopilot.calibrated(1)
    ground.run(1.2)
    assert not ground.sim.autopilot.calibrated(1)
    assert ground.command(400, 1) == FAILED


# ---------------------------------------------------------------- priorities


@pytest.mark.parametrize("order", list(itertools.permutations(DEVICES)))
def test_priority_orders_streams_and_blocks_at_the_next_boot(order):
    """Before it the parameters say one thing and the streams another."""
    ground = Ground(simulation(THREE + "[autopilot]\nimus = 3\nboot_s = 0.5\n" + CHECKS))
    for n, device in enumerate(order, start=1):
        ground.set(compass_name("OFS", n, "Y"), 100.0 * n)
        ground.set(f"COMPASS_PRIO{n}_ID", device)
    before = streams(ground)
    np.testing.assert_allclose(before[1] - before[0], (10, 100, 0), atol=1)
    assert ground.command(400, 1) == (ACCEPTED if order == DEVICES else FAILED)
    if order != DEVICES:
        assert said(ground)[-1] == "PreArm: Compass order change requires reboot"
    ground.command(400, 0)
    assert ground.command(246, 1) == ACCEPTED
    ground.run(1.0)
    after = streams(ground)
    for n, device in enumerate(order, start=1):
        was = DEVICES.index(device) + 1
        assert ground.read(compass_name("DEV_ID", n))[0].param_value == device
        assert ground.read(compass_name("OFS", n, "Y"))[0].param_value == 100.0 * was
        np.testing.assert_allclose(after[n - 1], before[was - 1], atol=0)
    assert ground.command(400, 1) == ACCEPTED


def streams(ground):
    for number in (27, 116, 129):
        ground.stream(number, 20)
    heard = {m.get_type(): m for m in ground.run(0.5)}
    return [mag(heard[name]) for name in ("RAW_IMU", "SCALED_IMU2", "SCALED_IMU3")]


def test_priorities_that_name_nobody_move_nothing():
    ground = Ground(simulation(THREE + "[autopilot]\nboot_s = 0.5\n"))
    ground.set("COMPASS_PRIO1_ID", 5)
    assert ground.command(246, 1) == ACCEPTED
    ground.run(1.0)
    assert ground.sim.autopilot.detected == list(DEVICES)


# ---------------------------------------------------------------- names


def test_both_naming_schemes_hold_the_same_values():
    old, new = Parameters(), Parameters(renamed=True)
    assert [new_name(n) for n in old.names] == new.names and len(set(new.names)) == len(new.names)
    assert [old[n] for n in old.names] == [new[n] for n in new.names]
    pairs = {
        "COMPASS_OFS_X": "COMPASS1_OFS_X", "COMPASS_ODI3_Z": "COMPASS3_ODI_Z", "COMPASS_SCALE2": "COMPASS2_SCALE",
        "COMPASS_DEV_ID": "COMPASS1_DEV_ID", "COMPASS_EXTERNAL": "COMPASS1_EXTERN",
        "COMPASS_EXTERN3": "COMPASS3_EXTERN",
        "COMPASS_PRIO2_ID": "COMPASS_PRIO2_ID", "COMPASS_LEARN": "COMPASS_LEARN", "COMPASS_MOTCT": "COMPASS_MOTCT",
    }  # fmt: skip
    assert {name: new_name(name) for name in pairs} == pairs
    assert "COMPASS_OFS_X" not in new and "COMPASS1_OFS_X" in new


def test_a_vehicle_of_the_newer_scheme_knows_only_its_own_names_and_applies_them():
    ground = Ground(simulation(COMPASS + '[autopilot]\nnaming = "new"\n[autopilot.parameters]\nCOMPASS1_OFS_Y = 7.0\n'))
    ground.stream(27, 20)
    before = ground.field()
    assert ground.set("COMPASS_OFS_X", 50.0) == []
    (echo,) = ground.set("COMPASS1_OFS_X", 50.0)
    assert (echo.param_id, echo.param_value) == ("COMPASS1_OFS_X", 50.0)
    np.testing.assert_array_equal(ground.field() - before, (50, 0, 0))
    ground.send(dialect.MAVLink_param_request_list_message(1, 1))
    values = ground.of("PARAM_VALUE", 2.0)
    assert [v.param_id for v in values] == ground.sim.autopilot.parameters.names
    assert {v.param_id: v.param_value for v in values}["COMPASS1_OFS_Y"] == 7.0


# ---------------------------------------------------------------- what newer releases say


def test_newer_releases_answer_with_param_error():
    ground = Ground(simulation(COMPASS + '[autopilot]\nrelease = "newer"\n'))

    def errors(act):
        act()
        found = [(m.param_id, m.error, m.param_index) for m in ground.heard if m.get_type() == "PARAM_ERROR"]
        ground.heard.clear()
        return found

    assert errors(lambda: ground.set("MMAG_OFS_X", 1.0)) == [("MMAG_OFS_X", 1, -1)]
    assert errors(lambda: ground.read("MMAG_OFS_X")) == [("MMAG_OFS_X", 1, -1)]
    assert errors(lambda: ground.set("COMPASS_OFS_X", float("nan"))) == [("COMPASS_OFS_X", 2, -1)]
    assert errors(lambda: ground.set("COMPASS_OFS_X", 1.0)) == []


def test_newer_releases_send_highres_imu_a_million_times_too_large():
    ground = Ground(simulation(COMPASS + '[autopilot]\nrelease = "newer"\n'))
    ground.stream(27, 20)
    assert ground.command(511, 105, 50_000) == ACCEPTED
    heard = {m.get_type(): m for m in ground.run(0.5)}
    gauss = mag(heard["HIGHRES_IMU"]) / 1e6
    np.testing.assert_array_equal(np.trunc(gauss * 1000), mag(heard["RAW_IMU"]))
    assert heard["HIGHRES_IMU"].zacc == pytest.approx(-9.81, abs=0.2)


def test_command_int_does_what_command_long_does():
    ground = Ground(simulation())
    for command, params, result in ((511, (27, 50_000), ACCEPTED), (242, (2, 1), UNSUPPORTED), (400, (1, 0), ACCEPTED)):
        ground.send(dialect.MAVLink_command_int_message(1, 1, 0, command, 0, 0, *params, 0, 0, 0, 0, 0))
        (ack,) = [m for m in ground.run(0.02) if m.get_type() == "COMMAND_ACK"]
        assert (ack.command, ack.result, ack.target_system, ack.target_component) == (command, result, 255, 190)
    assert ground.sim.truth.armed and len(ground.of("RAW_IMU", 1.0)) == 20


def test_board_is_told_in_uid2_as_ardupilot_does():
    def version(body):
        ground = Ground(simulation(COMPASS + body))
        assert ground.command(512, 148) == ACCEPTED
        return next(m for m in ground.heard if m.get_type() == "AUTOPILOT_VERSION")

    told = version("[autopilot]\nuid = 4660\n")
    assert told.uid == 0 and bytes(told.uid2)[:3] == b"\x34\x12\x00"
    ground = Ground(simulation())
    assert ground.command(520, 1) == ACCEPTED  # the old way to ask
    assert [m for m in ground.heard if m.get_type() == "AUTOPILOT_VERSION"]
    assert bytes(version("").uid2) == bytes(version("").uid2) != bytes(told.uid2)


# ---------------------------------------------------------------- mountings


@pytest.mark.parametrize("orient", range(41))
def test_every_mounting_is_undone_by_its_number(orient):
    turned, plain = simulation(f"{COMPASS}orient = {orient}\n"), simulation()
    for sim in (turned, plain):
        sim.advance(0.2)
    np.testing.assert_allclose(turned.autopilot.published_mg[0], plain.autopilot.published_mg[0], atol=1e-9)


def test_mountings_by_hand_and_where_the_two_autopilots_differ():
    """Rz Ry Rx, by way of three turns written elsewhere; 38 is the one number with two meanings."""
    for number, angles in {
        5: (0, 0, 225),
        12: (0, 180, 0),
        36: (90, 180, 90),
        39: (0, 315, 0),
        40: (90, 315, 0),
    }.items():
        for kind in ("ardupilot", "px4"):
            np.testing.assert_allclose(rotation_matrix(number, kind), body_from_ned(*np.radians(angles)).T, atol=1e-12)
    np.testing.assert_allclose(rotation_matrix(38, "px4"), body_from_ned(*np.radians((90, 68, 293))).T, atol=1e-12)
    np.testing.assert_allclose(rotation_matrix(38), body_from_ned(*np.radians((90, 68.8, 293.3))).T, atol=1e-12)
    distinct = {tuple(np.round(rotation_matrix(n), 6).ravel() + 0.0) for n in range(41)}
    assert len(distinct) >= 35  # some numbers name the same turn in two ways


@pytest.mark.parametrize("number", [-1, 41, 100])
def test_a_mounting_that_is_not_simulated_is_refused_by_number(number):
    with pytest.raises(ValueError, match=str(number)):
        rotation_matrix(number)


def test_same_scenario_same_bytes():
    one, two = (Simulation(simulation(THREE).scenario) for _ in range(2))
    assert one.advance(3.0) == two.advance(3.0)
