"""Whole flights: the vehicle does what the scenario says, and its stream is the true field seen through
its iron."""

from __future__ import annotations

import hashlib
import math
from functools import cache

import numpy as np
import pytest
from magmav_sim import SimulatedLink, Simulation, load_scenario
from magmav_sim.airframe import Airframe, Controls, Home
from magmav_sim.ground import parked
from pymavlink.dialects.v20 import ardupilotmega as dialect
from sim_rig import Ground, body_from_ned, mag, simulation

SHORT = """
[wind]
speed_mps = 3.0
turbulence_mps = 1.0

[[compass]]
device_id = 97539
hard_iron_mg = [180.0, -120.0, 240.0]
soft = [[1.05, 0.02, 0.0], [0.02, 0.97, -0.03], [0.0, -0.03, 1.01]]
motor_mg_per_a = [0.8, -0.5, 1.0]
noise_mg = 4.0

[autopilot]
rates_hz = { RAW_IMU = 50, BATTERY_STATUS = 10, ATTITUDE = 25, EXTENDED_SYS_STATE = 5 }

[autopilot.parameters]
COMPASS_OFS_X = -150.0
COMPASS_OFS_Y = 60.0
COMPASS_OFS_Z = -200.0
COMPASS_SCALE = 1.1
COMPASS_DIA_X = 0.98
COMPASS_ODI_Z = 0.05
COMPASS_MOT_X = -0.7
COMPASS_MOT_Z = -1.5
COMPASS_MOTCT = 2

[[flight]]
ground_s = 3.0
pattern = [
    { kind = "takeoff", height_m = 6.0 },
    { kind = "yaw", turns = 1.0, rate_dps = 36.0 },
    { kind = "figure8", laps = 1, half_length_m = 10.0, speed_mps = 4.0 },
    { kind = "land", sink_mps = 1.5 },
]
"""


class Flown:
    """A flight seen from both sides: what the ground heard, and what was true at every frame."""

    def __init__(self, sim: Simulation, until_s: float = 400.0) -> None:
        self.sim = sim
        ground = Ground(sim)
        rows = []
        while not sim.finished and sim.elapsed_ns < until_s * 1e9:
            ground.run(0.01)
            s = sim.autopilot.state
            rows.append((sim.elapsed_ns / 1e9, *s))
        self.heard = ground.heard
        self.truth = np.array(rows)
        self.t, self.roll, self.pitch, self.heading = self.truth[:, :4].T
        self.rates = self.truth[:, 4:7]
        self.force = self.truth[:, 7:10]
        self.north, self.east, self.height, self.vn, self.ve, self.vd = self.truth[:, 10:16].T

    def of(self, name):
        return [m for m in self.heard if m.get_type() == name]

    def event(self, what):
        return next(e["elapsed_s"] for e in self.sim.autopilot.events if e["what"] == what)

    def pattern(self, kind):
        """Index range of the first leg of that kind."""
        legs = [e for e in self.sim.autopilot.events if e["what"] in ("pattern", "touchdown")]
        at = next(i for i, e in enumerate(legs) if e.get("kind") == kind)
        return slice(round(legs[at]["elapsed_s"] * 100), round(legs[at + 1]["elapsed_s"] * 100) - 1)


@cache
def short() -> Flown:
    return Flown(simulation(SHORT, top="end_ground_s = 1.0"))


CESSNA = """
[[compass]]
device_id = 97539
hard_iron_mg = [180.0, -120.0, 240.0]
[[flight]]
ground_s = 3.0
pattern = [
    { kind = "takeoff", height_m = 60.0 },
    { kind = "loiter", turns = 1.0, bank_deg = 35.0 },
    { kind = "climb", by_m = 40.0, rate_mps = 5.0, bank_deg = -25.0 },
    { kind = "land", sink_mps = 5.0 },
]
"""


@cache
def plane(name: str) -> Flown:
    if name == "c172x":
        return Flown(simulation(CESSNA, top="end_ground_s = 1.0", airframe=name))
    return Flown(Simulation(load_scenario(name)))


def test_undoing_corrections_and_iron_gives_the_model_field_turned_by_true_attitude():
    """The law the whole simulator stands on, by an independent path from the sent integers back to the
    field."""
    flown = short()
    parameters = flown.sim.autopilot.parameters
    field_ned = np.array(flown.sim.world.field_ned_mg)
    spec = flown.sim.scenario.compasses[0]
    matrix = np.array([[0.98, 0, 0], [0, 1, 0.05], [0, 0.05, 1]]) * 1.1
    offsets = np.array([parameters[f"COMPASS_OFS_{a}"] for a in "XYZ"])
    motor = np.array([-0.7, 0.0, -1.5])
    imu = {m.time_usec // 1000: mag(m) for m in flown.of("RAW_IMU")}
    current = {m_ms: m.current_battery / 100 for m_ms, m in battery(flown)}
    errors = []
    for ms in range(300, int(flown.t[-1] * 1000) - 100, 100):
        published = imu[ms]
        published = published + 0.5 * np.sign(published)  # the middle of what is cut to this integer
        sensor = np.linalg.solve(matrix, published - motor * current[ms]) - offsets
        frames = slice(ms // 10 - 10, ms // 10)
        body = np.mean([body_from_ned(*a) @ field_ned for a in flown.truth[frames, 1:4]], axis=0) + np.array(
            spec.motor_mg_per_a
        ) * np.mean(ampere(flown)[frames])
        errors.append(sensor - (np.array(spec.soft) @ body + spec.hard_iron_mg))
    errors = np.array(errors)
    assert len(errors) > 400
    assert np.all(np.abs(errors.mean(axis=0)) < 0.4)
    # noise of ten samples' mean, the cut to integers and the battery monitor's own noise, through the matrix
    assert np.all(errors.std(axis=0) < 1.6) and np.all(errors.std(axis=0) > 1.0)


def battery(flown):
    """Battery messages carry no time: they are sent at 10 Hz from boot, one each tenth."""
    messages = flown.of("BATTERY_STATUS")
    return [(100 * i if i else 10, m) for i, m in enumerate(messages)]


def ampere(flown):
    load = flown.truth[:, 18]
    armed_from, armed_to = flown.event("arm"), flown.event("disarm")
    armed = (flown.t > armed_from + 0.005) & (flown.t < armed_to + 0.005)
    return 0.5 + 0.8 * armed + 17.0 * load / 0.689


def test_stream_twice_from_the_same_seed_is_the_same_bytes():
    def digest(seed):
        link = SimulatedLink(simulation(SHORT, top="", seed=seed), until_s=16.0)
        link.send(
            Ground(link.simulation)
            ._mav.command_long_encode(1, 1, 511, 0, 116, 50_000, 0, 0, 0, 0, 0)
            .pack(dialect.MAVLink(None, 255, 190))
        )
        sha, times = hashlib.sha256(), []
        for packet in link.packets():
            sha.update(packet.data)
            times.append(packet.t_ns)
        assert times[-1] == 16_000_000_000
        return sha.hexdigest()

    assert digest(1) == digest(1)
    assert digest(1) != digest(2)


def test_quadrotor_flies_what_it_was_told():
    flown = short()
    assert flown.height.max() == pytest.approx(6.0, abs=0.5)
    yaw = flown.pattern("yaw")
    turned = np.degrees(np.unwrap(flown.heading[yaw]))
    assert turned[-1] - turned[0] == pytest.approx(360, abs=3)
    assert np.median(np.diff(turned)) * 100 == pytest.approx(36, abs=2)
    eight = flown.pattern("figure8")
    along = np.hypot(flown.north[eight] - flown.north[eight][0], flown.east[eight] - flown.east[eight][0])
    assert along.max() == pytest.approx(10, abs=2.5)
    assert np.degrees(np.abs(flown.roll).max()) > 8
    assert np.hypot(flown.north[-1], flown.east[-1]) < 2


def test_landed_means_landed():
    flown = short()
    after = flown.t > flown.event("touchdown") + 2
    assert np.all(flown.height[after] == 0)
    assert np.ptp(flown.heading[after]) == 0
    assert not flown.sim.truth.armed
    assert [m.landed_state for m in flown.of("EXTENDED_SYS_STATE")][-1] == 1
    states = [m.landed_state for m in flown.of("EXTENDED_SYS_STATE")]
    assert [s for i, s in enumerate(states) if i == 0 or states[i - 1] != s] == [1, 3, 2, 4, 1]


@pytest.mark.long
@pytest.mark.parametrize("name", ["short", "c172x", "s_turns"])
def test_gyro_and_attitude_agree_through_take_off_flight_and_landing(name):
    """Body rates carried through half a second give the attitude change, launches and touch-down included."""
    flown = short() if name == "short" else plane(name)
    worst = 0.0
    for start in range(0, len(flown.t) - 60, 50):
        turn = body_from_ned(*flown.truth[start, 1:4])
        for i in range(start + 1, start + 51):
            p, q, r = 0.5 * (flown.rates[i] + flown.rates[i - 1]) * 0.01
            step = np.array([[1, r, -q], [-r, 1, p], [q, -p, 1]])
            turn = step @ turn
        miss = turn @ body_from_ned(*flown.truth[start + 50, 1:4]).T
        worst = max(worst, abs(miss[0, 1]), abs(miss[0, 2]), abs(miss[1, 2]))
    assert math.degrees(worst) < 0.8


@pytest.mark.parametrize("name", ["short", "c172x", "s_turns"])
def test_specific_force_is_acceleration_less_gravity(name):
    flown = short() if name == "short" else plane(name)
    velocity = np.stack((flown.vn, flown.ve, flown.vd), axis=1)
    acceleration = (velocity[20:] - velocity[:-20]) / 0.2
    expected = np.array(
        [body_from_ned(*flown.truth[i + 10, 1:4]) @ (acceleration[i] - (0, 0, 9.80665))
         for i in range(0, len(acceleration), 10)]
    )  # fmt: skip
    miss = flown.force[10 : len(acceleration) + 10 : 10] - expected
    assert np.sqrt(np.median(np.sum(miss**2, axis=1))) < 0.35  # pilot's seat off the centre, gusts within 0.2 s
    still = flown.t < 2
    np.testing.assert_allclose(np.linalg.norm(flown.force[still], axis=1), 9.80665, atol=1e-6)


def test_attitude_is_truth_with_a_slow_error_of_the_set_size():
    flown = short()
    index = {round(t * 1000): i for i, t in enumerate(flown.t)}
    errors = np.array([
        (m.roll - flown.roll[index[m.time_boot_ms]], m.pitch - flown.pitch[index[m.time_boot_ms]])
        for m in flown.of("ATTITUDE")
    ])  # fmt: skip
    assert 0.1 < np.degrees(errors).std() < 1.2
    assert np.abs(np.diff(np.degrees(errors), axis=0)).max() < 0.2


def test_long_run_of_the_attitude_error_has_the_set_sigma_and_time():
    from magmav_sim.ahrs import Ahrs
    from magmav_sim.scenario import AutopilotSpec

    state = short().sim.autopilot.state
    ahrs = Ahrs(AutopilotSpec(tilt_sigma_deg=0.5, tilt_tau_s=2.0), 9)
    series = []
    for i in range(100_000):
        ahrs.step(state)
        if i % 10 == 0:
            series.append(math.degrees(ahrs.roll_rad - state.roll_rad))
    x = np.array(series)
    assert x.std() == pytest.approx(0.5, rel=0.15)
    assert np.mean(x[20:] * x[:-20]) / x.var() == pytest.approx(math.exp(-1), abs=0.12)


def test_fixed_wing_circles_climbs_and_lands():
    flown = plane("c172x")
    circle = flown.pattern("loiter")
    turned = np.degrees(np.unwrap(flown.heading[circle]))
    assert turned[-1] - turned[0] == pytest.approx(360, abs=3)
    assert np.median(np.degrees(flown.roll[circle])) == pytest.approx(35, abs=5)
    assert np.all(np.abs(flown.height[circle] - 60) < 15)
    climb = flown.pattern("climb")
    assert flown.height[climb][-1] - flown.height[climb][0] == pytest.approx(40, abs=1)
    assert np.median(np.degrees(flown.roll[climb])) == pytest.approx(-25, abs=5)
    assert flown.height[-1] == 0 and np.hypot(flown.vn[-1], flown.ve[-1]) == 0


def test_glider_weaves_down_to_the_ground():
    flown = plane("s_turns")
    weave = flown.pattern("s_turns")
    turned = np.degrees(np.unwrap(flown.heading[weave]))
    assert 90 < np.ptp(turned) < 230
    banks = np.sign(flown.roll[weave][np.abs(flown.roll[weave]) > math.radians(20)])
    assert np.count_nonzero(np.diff(banks)) == 5
    assert flown.height[weave][-1] < flown.height[weave][0] - 30
    assert np.all(flown.truth[weave, 16] > 8)  # m/s, never near a stall
    assert flown.height[-1] == 0


def test_command_starts_the_second_flight_and_nothing_else_does():
    flight = '[[flight]]\nstart = "command"\nwait_s = 50.0\n'
    flight += 'pattern = [{ kind = "takeoff", height_m = 3.0 }, { kind = "land" }]\n'
    sim = simulation("[[compass]]\ndevice_id = 1\nhard_iron_mg = [0.0, 0.0, 0.0]\n" + flight, top="end_ground_s = 2.0")
    ground = Ground(sim)
    ground.run(20.0)
    assert sim.truth.height_m == 0 and not sim.truth.armed
    assert ground.command(300) == 0
    assert sim.truth.armed
    ground.run(4.0)
    assert ground.command(300) == 4  # one is under way already
    assert ground.command(400, 0) == 4  # and is not disarmed in the air
    assert sim.truth.height_m > 0.5
    ground.run(40.0)
    assert sim.finished and sim.truth.height_m == 0 and not sim.truth.armed


def test_command_flight_that_nobody_starts_ends_the_simulation():
    flight = '[[flight]]\nstart = "command"\nwait_s = 5.0\npattern = [{ kind = "takeoff" }, { kind = "land" }]\n'
    sim = simulation("[[compass]]\ndevice_id = 1\nhard_iron_mg = [0.0, 0.0, 0.0]\n" + flight, top="end_ground_s = 2.0")
    sim.advance(6.5)
    assert not sim.finished
    sim.advance(1.0)
    assert sim.finished and sim.elapsed_ns / 1e9 == pytest.approx(7, abs=0.02)


def test_watchdog_reboot_in_flight_keeps_flying_with_a_new_clock():
    scenario = load_scenario("reboot_in_flight")
    sim = Simulation(scenario)
    ground = Ground(sim)
    ground.stream(30, 20)
    ground.run(39.9)
    before = [m.time_boot_ms for m in ground.heard if m.get_type() == "ATTITUDE"][-1]
    assert before > 39_000
    heard = ground.run(6.0)
    late = [m for m in heard if m.get_type() == "ATTITUDE" and m.time_boot_ms < 39_000]
    assert late == []  # streams are at their defaults
    beats = [m for m in heard if m.get_type() == "HEARTBEAT"]
    assert beats[-1].base_mode & 128 and sim.truth.height_m > 10
    ground.stream(30, 20)
    assert ground.of("ATTITUDE", 0.2)[0].time_boot_ms < 7000


@pytest.mark.parametrize("model", ["F450", "c172x", "minisgs"])
def test_airframe_prints_nothing_and_leaves_no_file(model, capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    air = Airframe(model, Home(47.4, 8.5, 400.0), parked(0.0, 0.0, 1.0)._replace(height_m=100.0, vn_mps=20.0))
    states = [air.step(Controls(0.0, 0.0, 0.0, 0.5), (1.0, 0.0, 0.0)) for _ in range(200)]
    assert states[0].height_m == pytest.approx(100, abs=1) and states[-1].height_m != states[0].height_m
    del air
    assert capfd.readouterr() == ("", "")
    assert list(tmp_path.iterdir()) == []
