"""Tilt and turning between messages, with and without an attitude, against plain kinematics."""

import math

import numpy as np
import pytest
from synthetic_flight import turn

from magmav.core.motion import Motion
from magmav.core.types import AttitudeReading, InertialReading, vec3

MS = 10**6
G = 9.80665


def attitude(ms, roll=0.0, pitch=0.0, yaw=0.0, rate=(0.0, 0.0, 0.0)):
    return AttitudeReading(1, "ATTITUDE", ms * MS, roll, pitch, yaw, vec3(rate, "rate"))


def inertial(ms, force=(0.0, 0.0, -G), rate=(0.0, 0.0, 0.0), source="RAW_IMU"):
    return InertialReading(1, source, ms * MS, vec3(force, "force"), vec3(rate, "rate"))


def resting_force(roll, pitch):
    """Specific force of a body at rest: minus gravity, in body axes."""
    return turn(0, roll) @ turn(1, pitch) @ np.array([0.0, 0.0, -G])


def test_nothing_heard_nothing_known():
    assert Motion().at(5 * MS) is None
    assert Motion().rate_rads == 0.0


def test_tilt_is_carried_on_by_the_rates():
    m = Motion()
    m.attitude(attitude(1000, 0.1, 0.0, 0.5, (0.2, -0.1, 0.0)))
    state = m.at(1300 * MS)
    assert state is not None
    assert state.roll_rad == pytest.approx(0.1 + 0.2 * 0.3)
    assert state.pitch_rad == pytest.approx(-0.1 * math.cos(0.1) * 0.3)
    assert state.source == "ATTITUDE"
    assert m.rate_rads == pytest.approx(math.hypot(0.2, 0.1))


def test_an_attitude_is_not_used_beyond_600_ms():
    m = Motion()
    m.attitude(attitude(1000))
    assert m.at(1600 * MS) is not None
    assert m.at(1601 * MS) is None


def test_the_nearest_attitude_is_used_for_a_moment_in_the_past():
    m = Motion()
    for ms, roll in ((1000, 0.0), (1040, 0.1), (1080, 0.2), (1120, 0.3)):
        m.attitude(attitude(ms, roll))
    assert m.at(1058 * MS).roll_rad == 0.1
    assert m.at(1062 * MS).roll_rad == 0.2
    assert m.at(1200 * MS).roll_rad == 0.3
    assert m.at(900 * MS).roll_rad == 0.0


def test_duplicates_and_latecomers_change_nothing():
    m = Motion()
    assert m.attitude(attitude(1000, 0.1))
    assert m.attitude(attitude(1040, 0.2))
    assert not m.attitude(attitude(1040, 0.9))
    assert not m.attitude(attitude(1020, 0.9))
    assert m.at(1040 * MS).roll_rad == 0.2


@pytest.mark.parametrize("period_ms", [20, 40, 100, 200])
def test_turning_is_integrated_from_rates_and_not_from_the_compass(period_ms):
    """Three whole turns, banked, while the reported yaw is nonsense: only rates may count."""
    m, bank = Motion(), math.radians(30.0)
    rate = (0.0, 0.5 * math.sin(bank), 0.5 * math.cos(bank))  # 0.5 rad/s about earth's down
    for ms in range(0, 40_001, period_ms):
        m.attitude(attitude(ms, bank, 0.0, math.sin(ms), rate))
    assert m.at(40_000 * MS).yaw_rad == pytest.approx(20.0, abs=1e-9)
    assert m.at(40_000 * MS).yaw_rad > 3 * math.tau


def test_a_turn_that_quickens_is_integrated_at_its_mean():
    m = Motion()
    for ms in range(0, 10_001, 200):
        m.attitude(attitude(ms, rate=(0.0, 0.0, ms / 10_000)))
    assert m.at(10_000 * MS).yaw_rad == pytest.approx(5.0, abs=1e-9)


def test_over_a_slow_stream_the_yaw_step_itself_is_used_across_north():
    m = Motion()
    for i in range(9):
        m.attitude(attitude(500 * i, 0.0, 0.0, math.remainder(3.0 + 0.4 * i, math.tau), (0, 0, 0.1)))
    assert m.at(4000 * MS).yaw_rad == pytest.approx(3.2, abs=1e-9)
    assert m.at(4000 * MS).bridged


def test_after_a_long_silence_headings_are_not_compared():
    m = Motion()
    m.attitude(attitude(1000))
    before = m.at(1000 * MS).epoch
    m.attitude(attitude(5900))
    assert m.at(5900 * MS).epoch == before
    m.attitude(attitude(11_000))
    assert m.at(11_000 * MS).epoch != before


# ------------------------------------------------------------ without ATTITUDE


def test_own_tilt_starts_from_the_accelerometer():
    m = Motion()
    m.inertial(inertial(1000, resting_force(0.3, -0.2)))
    state = m.at(1010 * MS)
    assert (state.roll_rad, state.pitch_rad) == pytest.approx((0.3, -0.2), abs=1e-12)
    assert state.source == "OWN"
    assert m.at(1210 * MS) is None


def test_own_tilt_follows_the_gyro_through_a_banked_turn():
    """Coordinated turn at 30 degrees: the accelerometer says level (and 15 % too strong), the gyro knows better."""
    m, bank, turn_rate = Motion(), math.radians(30.0), 0.4
    ms = 0
    m.inertial(inertial(ms, resting_force(0, 0)))
    for i in range(1, 101):  # roll in for one second
        ms += 10
        m.inertial(inertial(ms, resting_force(bank * i / 100, 0), (bank, 0, 0)))
    force = (0.0, 0.0, -G / math.cos(bank))
    for _ in range(500):
        ms += 10
        m.inertial(inertial(ms, force, (0, turn_rate * math.sin(bank), turn_rate * math.cos(bank))))
    state = m.at(ms * MS)
    assert math.degrees(state.roll_rad) == pytest.approx(30.0, abs=5.0)
    assert abs(math.degrees(state.pitch_rad)) < 3.0
    assert state.yaw_rad == pytest.approx(5.0 * turn_rate, rel=0.03)


def test_the_accelerometer_pulls_a_wrong_tilt_back_and_forgets_a_gyro_bias():
    m = Motion()
    m.inertial(inertial(0, resting_force(0.5, 0.0)))
    for ms in range(10, 15_001, 10):
        m.inertial(inertial(ms, resting_force(0.1, 0.05), (0.01, 0.0, 0.0)))
    state = m.at(15_000 * MS)
    assert state.roll_rad == pytest.approx(0.1 + 0.01 * 3.0, abs=0.01)  # bias times time constant
    assert state.pitch_rad == pytest.approx(0.05, abs=0.01)


def test_a_hard_push_does_not_tilt():
    m = Motion()
    m.inertial(inertial(0))
    for ms in range(10, 2001, 10):
        m.inertial(inertial(ms, (8.0, 0.0, -G)))
    assert abs(math.degrees(m.at(2000 * MS).pitch_rad)) < 2.0


def test_free_fall_and_other_imus_are_not_used():
    m = Motion()
    m.inertial(inertial(0))
    m.inertial(inertial(10, (0.0, 0.0, 0.0)))
    m.inertial(inertial(20, resting_force(1.0, 0.0), source="SCALED_IMU2"))
    assert m.at(20 * MS).roll_rad == pytest.approx(0.0)


def test_lost_attitude_hands_its_tilt_to_the_gyro():
    m = Motion()
    force = (0.0, 0.0, -G / math.cos(0.5))  # banked in a turn: the accelerometer alone would say level
    for ms in range(0, 2001, 20):
        m.attitude(attitude(ms, 0.5))
        m.inertial(inertial(ms, force))
    for ms in range(2020, 3001, 20):
        m.inertial(inertial(ms, force))
    state = m.at(3000 * MS)
    assert state.source == "OWN"
    assert state.roll_rad == pytest.approx(0.5, abs=0.12)


def euler(body_from_earth):
    """Roll, pitch, yaw of a matrix; at the vertical any of the many that mean the same."""
    r = body_from_earth
    return math.atan2(r[1, 2], r[2, 2]), math.asin(max(-1.0, min(1.0, -r[0, 2]))), math.atan2(r[0, 1], r[0, 0])


def test_the_own_frame_goes_through_the_vertical():
    """A tail-sitter stands up, turns about the vertical, leans over on its back and comes down: no angle is special."""
    hz, truth, motion = 50, np.eye(3), Motion()
    worst = steepest = 0.0
    for i in range(12 * hz):
        t = i / hz
        rate = np.array((0.6 * (4 < t < 7), 0.5 * (t < 4) - 0.4 * (t > 8), 0.02 * (t > 4)))
        if i:
            truth = turn_by(-rate / hz) @ truth
        motion.attitude(AttitudeReading(1, "ATTITUDE", round(t * 1e9), *euler(truth), vec3(rate, "rate")))
        state = motion.at(round(t * 1e9))
        off = state.body_from_own @ truth.T
        steepest = max(steepest, abs(euler(truth)[1]))
        worst = max(worst, math.degrees(math.acos(min(1.0, (np.trace(off) - 1.0) / 2.0))))
    assert steepest > math.radians(88.0)
    assert worst < 1.0


def turn_by(v):
    """Rotation by a vector, by its series: nothing of ours in it."""
    k = np.array(((0.0, -v[2], v[1]), (v[2], 0.0, -v[0]), (-v[1], v[0], 0.0)))
    out, term = np.eye(3), np.eye(3)
    for n in range(1, 12):
        term = term @ k / n
        out = out + term
    return out


@pytest.mark.parametrize("own", [False, True])
def test_yaw_alone_is_that_of_the_whole_answer_and_the_answer_is_kept_until_the_next_reading(own):
    m = Motion()
    for i in range(12):
        ns, rate = i * 50_000_000, vec3((0.1, -0.2, 0.7), "r")
        if own:
            m.inertial(InertialReading(1, "RAW_IMU", ns, vec3((0, 0, -9.8), "f"), rate))
        else:
            m.attitude(AttitudeReading(1, "ATTITUDE", ns, 0.1, 0.2, 0.0, rate))
        for at_ns in (ns - 70_000_000, ns, ns + 20_000_000):
            state = m.at(at_ns)
            assert (state.yaw_rad, state.epoch) == m.yaw_at(at_ns)
            assert m.at(at_ns) is state
            assert not state.body_from_own.flags.writeable
    assert state.yaw_rad > 0.2
    before = m.at(600_000_000)
    m.attitude(AttitudeReading(1, "ATTITUDE", 600_000_000, 0.3, 0.2, 0.0, vec3((0, 0, 0), "r")))
    assert before.roll_rad != m.at(600_000_000).roll_rad == 0.3
