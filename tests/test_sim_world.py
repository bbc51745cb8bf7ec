"""The field the simulated compasses stand in, and what they and the autopilot make of it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from magmav_sim.correction import Correction, heading_rad
from magmav_sim.world import earth_field_ned_mg, rotation_matrix
from sim_rig import COMPASS, Ground, body_from_ned, iron_free, mag, simulation

# From NOAA's published test values of each model: year, altitude km, latitude, longitude, X, Y, Z in nT.
NOAA = [
    (2025.0, 0, 80, 0, 6521.6, 145.9, 54791.5),
    (2025.0, 0, 0, 120, 39677.8, -109.6, -10580.2),
    (2025.0, 0, -80, 240, 6117.5, 15751.9, -52022.5),
    (2020.0, 0, 80, 0, 6570.4, -146.3, 54606.0),
    (2020.0, 0, 0, 120, 39624.3, 109.9, -10932.5),
    (2020.0, 0, -80, 240, 5940.6, 15772.1, -52480.8),
]


@pytest.mark.parametrize(("year", "km", "lat", "lon", "x", "y", "z"), NOAA)
def test_field_is_that_of_the_published_table(year, km, lat, lon, x, y, z):
    field_nt = 100 * np.array(earth_field_ned_mg(lat, lon, km * 1000, year))
    np.testing.assert_allclose(field_nt, (x, y, z), atol=1.0)


def test_field_outside_the_models_years_is_refused():
    with pytest.raises(ValueError, match=r"2031"):
        earth_field_ned_mg(47, 8, 0, 2031.0)


def test_parked_compass_reads_the_rotated_field_plus_its_iron():
    sim = simulation(top="stay = true\nend_ground_s = 0.0")
    sim.advance(0.5)
    truth = sim.truth
    body = body_from_ned(truth.roll_rad, truth.pitch_rad, truth.heading_rad) @ sim.world.field_ned_mg
    assert math.degrees(truth.heading_rad) == pytest.approx(70)
    np.testing.assert_allclose(sim.autopilot.published_mg[0], body + np.array((100, -50, 200)), atol=1e-9)


def correction(**changes):
    plain = Correction(None, (0, 0, 0), 0.0, (1, 1, 1), (0, 0, 0), (0, 0, 0), 0)
    return plain._replace(**changes)


def test_offsets_are_added_before_scale():
    fix = correction(offsets_mg=(10, 20, 30), scale=1.2)
    np.testing.assert_allclose(fix.apply((100, 200, 300), 0, 0), (132, 264, 396))


@pytest.mark.parametrize(("scale", "factor"), [(0.0, 1), (0.6, 1), (0.67, 0.67), (1.5, 1.5), (1.6, 1)])
def test_scale_counts_only_from_two_thirds_to_three_halves(scale, factor):
    np.testing.assert_allclose(correction(scale=scale).apply((100, 0, -50), 0, 0), (100 * factor, 0, -50 * factor))


def test_matrix_is_symmetric_and_follows_the_scale():
    fix = correction(offsets_mg=(0, 0, 10), scale=1.1, diagonal=(1.1, 0.9, 1.0), off_diagonal=(0.1, 0.2, 0.3))
    # (100, 200, 310) * 1.1 = (110, 220, 341), then by hand through the matrix
    np.testing.assert_allclose(fix.apply((100, 200, 300), 0, 0), (211.2, 311.3, 429.0))


def test_zero_diagonal_switches_the_matrix_off():
    fix = correction(diagonal=(0, 0, 0), off_diagonal=(0.1, 0.2, 0.3))
    np.testing.assert_allclose(fix.apply((100, 200, 300), 0, 0), (100, 200, 300))


@pytest.mark.parametrize(("by", "share"), [(0, 0.0), (1, 0.5), (2, 20.0)])
def test_motor_term_comes_last_and_follows_its_selector(by, share):
    fix = correction(scale=1.2, diagonal=(2, 2, 2), motor_mg=(1, -2, 3), motor_by=by)
    got = np.array(fix.apply((100, 0, 0), 0.5, 20.0))
    np.testing.assert_allclose(got - (240, 0, 0), np.array((1, -2, 3)) * share)


def test_stream_cuts_towards_zero():
    # North field about 215 mG: a scale puts known fractions on it.
    sim = iron_free(
        "COMPASS_DIA_X = 0.001\nCOMPASS_DIA_Y = 0.001\nCOMPASS_DIA_Z = 0.001\nCOMPASS_OFS_X = 0\nCOMPASS_MOTCT = 1\n"
    )
    ground = Ground(sim)
    ground.stream(27, 50)
    field = np.array(sim.autopilot.published_mg[0])
    sim.advance(0.3)
    field = np.array(sim.autopilot.published_mg[0])
    assert np.all(np.abs(field) < 1)
    assert np.all(ground.field() == 0)
    ground.set("COMPASS_MOTCT", 2)
    for axis, value in (("X", 1.99), ("Y", -2.99), ("Z", 3.4)):
        per_ampere = (value - field["XYZ".index(axis)]) / sim.autopilot.battery.measured_ampere
        ground.set(f"COMPASS_MOT_{axis}", per_ampere)
    for _ in range(20):
        got = ground.field()
        np.testing.assert_array_equal(got, np.trunc(sim.autopilot.published_mg[0]))
    assert got[1] <= 0 <= got[0]


def test_soft_iron_stretches_the_field_before_the_hard_iron_is_added():
    body = COMPASS + "soft = [[1.2, 0.0, 0.0], [0.0, 1.0, 0.1], [0.0, 0.0, 0.9]]\n"
    plain, soft = simulation(), simulation(body)
    for sim in (plain, soft):
        sim.advance(0.5)
    iron = np.array((100, -50, 200))
    x, y, z = np.array(plain.autopilot.published_mg[0]) - iron
    expected = np.array((1.2 * x, y + 0.1 * z, 0.9 * z)) + iron
    np.testing.assert_allclose(soft.autopilot.published_mg[0], expected, atol=1e-9)


def test_mounting_is_undone_by_the_orientation_parameter_of_an_external_compass():
    turned = simulation(COMPASS + "orient = 2\n")
    plain = simulation()
    ground = Ground(turned)
    for sim in (turned, plain):
        sim.advance(0.5)
    np.testing.assert_allclose(turned.autopilot.published_mg[0], plain.autopilot.published_mg[0], atol=1e-9)
    ground.set("COMPASS_ORIENT", 0)
    ground.run(0.3)
    x, y, z = plain.autopilot.published_mg[0]  # yawed 90 degrees right, a sensor feels our right as its front
    np.testing.assert_allclose(turned.autopilot.published_mg[0], (y, -x, z), atol=1e-9)


def test_every_mounting_is_a_rotation():
    for orient in range(26):
        matrix = np.array(rotation_matrix(orient))
        np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(matrix) == pytest.approx(1)


def test_delay_shows_the_field_of_then():
    late = simulation(COMPASS + "delay_ms = 200.0\n")
    late.autopilot._world.sensors[0].read()
    sensor = late.autopilot._world.sensors[0]
    seen = []
    for i in range(60):
        sensor.sample((float(i), 0.0, 0.0), 0.0, i * 0.01)
        value = sensor.read()
        seen.append(value[0] - 100)
    assert seen[50] == pytest.approx(30)


def test_noise_of_the_mean_is_a_tenth_reading_noise_over_root_ten():
    sim = simulation("[[compass]]\ndevice_id = 1\nhard_iron_mg = [0.0, 0.0, 0.0]\nnoise_mg = 12.0\n")
    fields = []
    for _ in range(600):
        sim.advance(0.1)
        fields.append(sim.autopilot.published_mg[0])
    std = np.std(fields, axis=0)
    np.testing.assert_allclose(std, 12 / math.sqrt(10), rtol=0.15)


@pytest.mark.parametrize("height", [0.0, 1.0, 3.0, 7.0])
def test_anomaly_falls_with_height_cubed(height):
    sim = simulation(top="stay = true\nanomaly = { ned_mg = [80.0, -160.0, 40.0], scale_m = 2.0 }")
    level = sim.autopilot.state._replace(roll_rad=0.0, pitch_rad=0.0, heading_rad=0.0, height_m=height)
    extra = np.array(sim.world.field_body_mg(level)) - sim.world.field_ned_mg
    np.testing.assert_allclose(extra, np.array((80, -160, 40)) * 8 / (2 + height) ** 3, atol=1e-9)


def test_motor_current_moves_the_field_by_its_share():
    sensor = simulation(COMPASS + "motor_mg_per_a = [2.0, -1.0, 0.5]\n").world.sensors[0]
    sensor.read()
    for ampere in (0.0, 20.0):
        sensor.sample((200.0, 0.0, 400.0), ampere, 0.0)
        np.testing.assert_allclose(sensor.read(), np.array((300, -50, 600)) + np.array((2, -1, 0.5)) * ampere)


def test_heading_formula_against_a_field_built_the_other_way():
    for heading in np.radians((10, 100, 200, 300)):
        field = body_from_ned(0.2, -0.3, heading) @ np.array((215.0, 0.0, 430.0))
        assert math.remainder(heading_rad(tuple(field), 0.2, -0.3) - heading, math.tau) == pytest.approx(0, abs=1e-9)


FAULTS = (
    COMPASS
    + COMPASS.replace("97539", "131874")
    + """
[[fault]]
kind = "iron_step"
compass = 1
at_s = 2.0
until_s = 4.0
mg = [30.0, 0.0, -20.0]
[[fault]]
kind = "drift"
compass = 1
at_s = 5.0
until_s = 7.0
mg_per_s = [0.0, 10.0, 0.0]
[[fault]]
kind = "absent"
compass = 2
at_s = 3.0
until_s = 6.0
"""
)


def test_step_drift_and_absence_happen_when_they_are_said_to():
    sim = simulation(FAULTS)
    ground = Ground(sim)
    ground.stream(27, 10)
    ground.stream(116, 10)
    at: dict[str, dict[int, np.ndarray]] = {"RAW_IMU": {}, "SCALED_IMU2": {}}
    for tenth in range(1, 90):
        for message in ground.run(0.1):
            if message.get_type() in at:
                at[message.get_type()][tenth] = mag(message)
    first, second = at["RAW_IMU"], at["SCALED_IMU2"]
    base = first[10]
    for tenth, extra in {
        15: (0, 0, 0),
        30: (30, 0, -20),
        45: (0, 0, 0),
        60: (0, 10, 0),
        80: (0, 20, 0),
    }.items():
        np.testing.assert_allclose(first[tenth] - base, extra, atol=2.1)
    assert not second[45].any() and second[20].any() and second[70].any()
    assert sim.truth.hard_iron_b_mg[0] == pytest.approx((100, -30, 200))


def test_frozen_compass_repeats_one_value_through_its_noise():
    body = COMPASS.replace("noise_mg = 0.0", "noise_mg = 30.0")
    sim = simulation(body + '[[fault]]\nkind = "frozen"\ncompass = 1\nat_s = 2.0\n')
    values = []
    for _ in range(40):
        sim.advance(0.1)
        values.append(sim.autopilot.published_mg[0])
    assert len(set(values[:19])) == 19
    assert len(set(values[20:])) == 1
