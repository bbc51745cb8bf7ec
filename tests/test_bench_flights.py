"""The judge's flights: rotations are rotations, forces are those of the motion, and the readings carry the errors."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from magmav.core.types import AttitudeReading, InertialReading, MagReading, PositionReading, VehicleReading

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from estimator_bench import motions
from estimator_bench.flights import STEP_S, body_rates, rotations, true_flight, truth_of
from estimator_bench.scenarios import SCENARIOS, Compass, Link, Scenario, chosen
from estimator_bench.telemetry import BOOT_S, SITES, angles, rotation_vectors, sent

ANGLE = st.floats(-7.0, 7.0)
KINDS = {s.motion: s.kind for s in SCENARIOS.values() if s.jsbsim is None}
PERFECT = Scenario(
    "perfect", motions.figure8, compass=Compass(bias_mg=0.0, noise_mg=0.0, late_s=0.0), link=Link(arrival_jitter_s=0.0)
)


def fly(scenario, seed, seconds=40.0):
    """A short flight."""
    return sent(scenario, seed, true_flight(scenario.motion, scenario.kind, seed, scenario.start, seconds))


@pytest.fixture(scope="module")
def figure8():
    return fly(SCENARIOS["figure8"], 3)


@given(ANGLE, ANGLE, ANGLE)
def test_attitude_is_a_rotation_and_its_angles_lead_back_to_it(roll, pitch, yaw):
    C = rotations(*(np.array([a]) for a in (roll, pitch, yaw)))[0]
    assert np.allclose(C @ C.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(C) == pytest.approx(1.0)
    again = rotations(*(np.array([a]) for a in angles(C)))[0]
    assert np.allclose(again, C, atol=1e-6)  # at 90 degrees of pitch the arc sine is only so good


def test_yaw_right_of_north_puts_east_ahead():
    C = rotations(np.zeros(1), np.zeros(1), np.array([np.pi / 2]))[0]
    assert np.allclose(C @ (0.0, 1.0, 0.0), (1.0, 0.0, 0.0))


@settings(max_examples=30)
@given(st.tuples(*[st.floats(-2.0, 2.0)] * 3))
def test_a_steady_turn_about_any_axis_has_that_rate(rate):
    rate = np.array(rate)
    t = np.arange(50) * STEP_S
    C = rotation_vectors(t[:, None] * rate)
    assert np.allclose(body_rates(C, STEP_S), rate, atol=1e-6)


@pytest.mark.parametrize("motion", KINDS, ids=lambda m: m.__name__)
def test_every_motion_can_be_flown(motion):
    """Rates carry the attitude from one instant to the next, whatever the attitude; nothing jumps."""
    truth = true_flight(motion, KINDS[motion], 5, seconds=40.0)
    carried = rotation_vectors(0.5 * (truth.rate_b_rads[1:] + truth.rate_b_rads[:-1]) * STEP_S) @ truth.C_bn[:-1]
    assert np.abs(carried - truth.C_bn[1:]).max() < 2e-4
    assert np.linalg.norm(truth.rate_b_rads, axis=1).max() < 4.0
    assert np.linalg.norm(truth.accel_n_mss, axis=1).max() < 45.0
    assert (truth.throttle >= 0.0).all() and (truth.throttle <= 1.0).all()


def test_vertical_and_inverted_flight_happen():
    """Or the scenarios would not be what they are called."""
    up = true_flight(motions.tailsitter, motions.TAILSITTER, 1, seconds=40.0).C_bn
    assert (-up[:, 0, 2]).max() > np.sin(np.radians(87.0))
    over = true_flight(motions.aerobatics, motions.PLANE, 1, seconds=40.0).C_bn
    assert over[:, 2, 2].min() < -0.95
    flat = true_flight(motions.rover, motions.ROVER, 1, seconds=40.0).C_bn
    assert np.degrees(np.arccos(flat[:, 2, 2])).max() < 2.0


def test_specific_force_is_what_an_accelerometer_feels():
    """Level and still it is -g on z; in a turn without slip it stays in the plane of symmetry and grows by 1/cos."""
    n = 400
    t, nil = np.arange(n) * STEP_S, np.zeros((n, 3))
    still = truth_of(2, t, np.broadcast_to(np.eye(3), (n, 3, 3)), nil, nil, t, t, 0.0)
    assert np.allclose(still.force_b_mss, (0.0, 0.0, -motions.GRAVITY_MSS))
    bank, speed = np.radians(30.0), 18.0
    rate = motions.GRAVITY_MSS * np.tan(bank) / speed
    yaw = rate * t
    C = rotations(np.full(n, bank), np.zeros(n), yaw)
    accel = speed * rate * np.stack((-np.sin(yaw), np.cos(yaw), np.zeros(n)), 1)
    turning = truth_of(1, t, C, accel, nil, t, t, 0.0)
    assert np.allclose(turning.force_b_mss[:, :2], 0.0, atol=1e-9)
    assert np.allclose(turning.force_b_mss[:, 2], -motions.GRAVITY_MSS / np.cos(bank))


def test_a_perfect_sensor_reads_the_earths_field(figure8):
    flight = sent(PERFECT, 3, figure8.truth)
    mags = [r for _, r in flight.readings if isinstance(r, MagReading)]
    at = [round((m.boot_ns / 1e9 - BOOT_S) / STEP_S) for m in mags]
    wanted = flight.truth.C_bn[at] @ flight.errors.field_n_mg
    assert np.abs(np.array([m.field_b_mg for m in mags]) - wanted).max() <= 0.5 + 1e-9  # whole milligauss


@pytest.mark.parametrize(("change", "size"), [({"bias_length_mg": 600.0}, 600.0), ({"late_s": 0.06}, None)])
def test_iron_and_lateness_are_where_they_are_said_to_be(figure8, change, size):
    scenario = dataclasses.replace(PERFECT, compass=dataclasses.replace(PERFECT.compass, **change))
    flight = sent(scenario, 3, figure8.truth)
    mags = [r for _, r in flight.readings if isinstance(r, MagReading)]
    at = np.array([round((m.boot_ns / 1e9 - BOOT_S) / STEP_S) for m in mags])
    measured = np.maximum(at - round(scenario.compass.late_s / STEP_S), 0)
    assert (flight.heard == measured).all()
    left = np.array([m.field_b_mg for m in mags]) - flight.truth.C_bn[measured] @ flight.errors.field_n_mg
    if size is not None:
        assert np.linalg.norm(left.mean(axis=0)) == pytest.approx(size, abs=0.2)
    assert np.abs(left - flight.errors.iron_b_mg[measured]).max() <= 0.5 + 1e-9


def test_step_and_drift_are_as_large_as_announced(figure8):
    drifting = sent(SCENARIOS["drift"], 3, figure8.truth)
    assert np.linalg.norm(drifting.iron_at(40.0) - drifting.iron_at(0.0)) == pytest.approx(12.0, abs=0.1)
    slow = dataclasses.replace(SCENARIOS["step"], link=Link(1.0, 1.0))
    stepped = fly(slow, 3, 100.0)
    assert np.linalg.norm(stepped.iron_at(90.1) - stepped.iron_at(89.9)) == pytest.approx(70.0)
    pushed = sent(SCENARIOS["motor"], 3, figure8.truth)
    assert np.linalg.norm(pushed.errors.throttle_b_mg) == pytest.approx(80.0)
    assert np.allclose(
        pushed.iron_at(5.0), pushed.errors.iron_b_mg[0] + pushed.mean_throttle * pushed.errors.throttle_b_mg
    )


def test_the_autopilots_attitude_is_wrong_by_what_is_said():
    """Tilt 0.45 degrees an axis and what acceleration adds; yaw by what its own bad compass makes of it."""
    off, yaws = [], []
    slow = dataclasses.replace(SCENARIOS["hover_only"], link=Link(1.0, 1.0))
    for seed in range(4):
        flight = fly(slow, seed, 150.0)
        down = np.einsum("ni,ni->n", flight.reported_C_bn[:, :, 2], flight.truth.C_bn[:, :, 2])
        off.append(np.degrees(np.arccos(np.minimum(down, 1.0))))
        nose, true = flight.reported_C_bn[:, 0], flight.truth.C_bn[:, 0]
        yaws.append(np.degrees(np.arctan2(nose[:, 1], nose[:, 0]) - np.arctan2(true[:, 1], true[:, 0])))
    rms = float(np.sqrt(np.mean(np.square(off))))
    assert 0.4 * np.sqrt(2.0) < rms < 0.7 * np.sqrt(2.0)
    assert float(np.sqrt(np.mean(np.square(yaws)))) > 3.0


def test_what_is_not_there_is_not_sent():
    kinds = {type(r) for _, r in fly(SCENARIOS["imu_only"], 1).readings}
    assert {MagReading, InertialReading, VehicleReading} <= kinds
    assert not kinds & {AttitudeReading, PositionReading}


def test_a_rough_link_loses_a_fifth_and_keeps_order():
    flight = fly(SCENARIOS["rough10"], 1)
    times = [t for t, _ in flight.readings]
    assert times == sorted(times)
    mags = sum(isinstance(r, MagReading) for _, r in flight.readings)
    assert 275 < mags < 365
    assert mags - len(flight.heard) == pytest.approx(0.01 * mags, abs=7)


def test_an_averaged_compass_holds_its_value():
    flight = fly(SCENARIOS["averaged10"], 1)
    fields = np.array([r.field_b_mg for _, r in flight.readings if isinstance(r, MagReading)])
    news = np.abs(np.diff(fields, axis=0)).max(axis=1) > 0
    assert news.mean() == pytest.approx(0.2, abs=0.02)


def test_same_seed_same_flight_other_seed_other_place(figure8):
    again = fly(SCENARIOS["figure8"], 3)
    assert [t for t, _ in again.readings] == [t for t, _ in figure8.readings]
    both = zip(again.readings, figure8.readings, strict=True)
    assert all(np.array_equal(a.field_b_mg, b.field_b_mg) for (_, a), (_, b) in both if isinstance(a, MagReading))
    assert figure8.errors.site != fly(SCENARIOS["figure8"], 4).errors.site
    assert len(SITES) == 6


def test_the_table_of_scenarios():
    assert len(chosen("reference")) == 18
    assert [s.name for s in chosen("boat,step")] == ["boat", "step"]
    with pytest.raises(ValueError, match="no_such"):
        chosen("no_such")
