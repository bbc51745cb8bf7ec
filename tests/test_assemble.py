"""Readings to Samples: what is fresh, what is late, what is another life of the vehicle."""

import math

import numpy as np
import pytest

from magmav.core.assemble import Assembler, BootClock, Tick
from magmav.core.types import NO_SHAPING, AttitudeReading, InertialReading, MagReading, vec3

MS, S = 10**6, 10**9
G = 9.80665


class Rig:
    """An assembler fed by hand. Every value is new unless said."""

    def __init__(self) -> None:
        self.a = Assembler(1)
        self.n = 0

    def attitude(self, ms, yaw_rate=0.0, roll=0.0, yaw=0.0):
        rate = (0.0, yaw_rate * math.sin(roll), yaw_rate * math.cos(roll))
        self.a.attitude(AttitudeReading(1, "ATTITUDE", round(ms * MS), roll, 0.0, yaw, vec3(rate, "rate")))

    def mag(self, ms, value=None, source="RAW_IMU", compass=1):
        if value is None:
            self.n += 1
            value = self.n
        reading = MagReading(1, compass, source, round(ms * MS), vec3((value, 50, 430), "field"))
        return self.a.mag(reading, lambda v: v, NO_SHAPING, True)

    def imu(self, ms, force=(0, 0, -G), rate=(0, 0, 0)):
        self.a.inertial(InertialReading(1, "RAW_IMU", round(ms * MS), vec3(force, "f"), vec3(rate, "r")))


@pytest.fixture
def rig():
    return Rig()


def test_a_repeated_value_is_one_sample(rig):
    got = []
    for ms in range(0, 1000, 20):
        rig.attitude(ms)
        got.append(rig.mag(ms, value=100 + ms // 100))
    assert sum(s is not None for s in got) == 10
    assert rig.a.counts["mag: repeated value"] == 40


def test_a_sample_carries_tilt_and_the_undone_field(rig):
    rig.attitude(0, roll=0.3)
    reading = MagReading(1, 2, "SCALED_IMU2", 0, vec3((1, 2, 3), "field"))
    sample = rig.a.mag(reading, lambda v: vec3(v * 2, "field"), NO_SHAPING, False)
    assert list(sample.mag_b_mg) == [2, 4, 6]
    assert (sample.compass, sample.roll_rad, sample.tilt_from, sample.learn) == (2, 0.3, "ATTITUDE", False)
    assert sample.gap
    assert sample.dt_s == 0.0


def test_duplicates_and_late_messages_are_dropped_and_counted(rig):
    for ms in (0, 100, 200):
        rig.attitude(ms)
        assert rig.mag(ms) is not None
    assert rig.mag(200) is None
    assert rig.mag(150) is None
    assert (rig.a.counts["mag: duplicate"], rig.a.counts["mag: late"]) == (1, 1)
    rig.attitude(100)
    assert rig.a.counts["ATTITUDE: duplicate or late"] == 1
    rig.attitude(300)
    assert rig.mag(300).dt_s == pytest.approx(0.1)


def test_no_tilt_no_sample(rig):
    assert rig.mag(0) is None
    assert rig.a.counts["mag: no tilt yet"] == 1


def test_one_compass_seen_through_two_messages_is_one_compass(rig):
    got = []
    for ms in range(0, 3000, 100):
        rig.attitude(ms)
        got.append(rig.mag(ms, source="SCALED_IMU"))
        got.append(rig.mag(ms + 20, source="RAW_IMU"))  # the better one takes over
    samples = [s for s in got if s is not None]
    assert len(samples) == 31
    assert rig.a.counts["mag: same compass in another message"] == 29


def test_the_second_message_takes_over_when_the_first_falls_silent(rig):
    for ms in range(0, 1000, 100):
        rig.attitude(ms)
        rig.mag(ms)
    taken = []
    for ms in range(1000, 4000, 100):
        rig.attitude(ms)
        taken.append(rig.mag(ms, source="HIGHRES_IMU") is not None)
    assert taken.index(True) == 19  # two seconds after the last RAW_IMU at 900 ms
    assert all(taken[19:])


# ------------------------------------------------------------ age of a value


def stream(rig, period_ms, refresh_ms, seconds=20):
    last = None
    for ms in range(0, seconds * 1000, period_ms):
        rig.attitude(ms, yaw_rate=0.5)
        last = rig.mag(ms, value=1 + ms // refresh_ms) or last
    return last


@pytest.mark.parametrize(
    ("period_ms", "refresh_ms", "age_s"),
    [(20, 100, 0.06), (100, 100, 0.1), (50, 100, 0.075), (20, 20, 0.0), (200, 100, 0.1)],
)
def test_age_of_the_autopilots_average(rig, period_ms, refresh_ms, age_s):
    """Half the 100 ms it is averaged over, and half the time it waits for its message; a fast sensor has none."""
    sample = stream(rig, period_ms, refresh_ms)
    assert sample.age_s == pytest.approx(age_s, abs=0.002)
    assert sample.lead_rad == pytest.approx(0.5 * age_s, abs=0.002)


def test_tilt_is_that_of_the_measurement_and_not_of_the_message(rig):
    for ms in range(0, 5000, 20):
        rig.a.attitude(AttitudeReading(1, "ATTITUDE", ms * MS, ms / 10_000, 0.0, 0.0, vec3((0.1, 0, 0), "rate")))
        sample = rig.mag(ms, value=1 + ms // 100) or None
        if sample is not None and ms > 3000:
            assert sample.roll_rad == pytest.approx((ms - 60) / 10_000, abs=2e-4)


# ------------------------------------------------------------ turning


def test_yaw_steps_add_up_through_whole_turns(rig):
    total = 0.0
    for ms in range(0, 30_001, 40):
        rig.attitude(ms, yaw_rate=0.7, roll=0.4, yaw=math.remainder(0.0007 * ms, math.tau))
        sample = rig.mag(ms)
        if sample is not None and not sample.gap:
            total += sample.yaw_step_rad
    assert total == pytest.approx(0.7 * 30.0, abs=1e-6)


def test_steps_over_repeated_values_are_not_lost(rig):
    steps = []
    for ms in range(0, 5001, 20):
        rig.attitude(ms, yaw_rate=1.0)
        sample = rig.mag(ms, value=1 + ms // 100)
        if sample is not None and ms > 3000:
            steps.append(sample.yaw_step_rad)
    assert steps == pytest.approx([0.1] * len(steps), abs=2e-3)


def test_a_silent_compass_is_bridged_by_attitudes(rig):
    for ms in range(0, 6001, 40):
        rig.attitude(ms, yaw_rate=0.5)
        if not 2000 < ms < 5000:
            sample = rig.mag(ms)
            if ms == 5000:
                assert not sample.gap
                assert sample.yaw_step_rad == pytest.approx(1.5, abs=1e-6)
                assert sample.dt_s == pytest.approx(3.0)
    assert rig.a.counts["mag: gap"] == 1


def test_silence_of_everything_is_a_gap(rig):
    for ms in [*range(0, 2001, 40), *range(9000, 11_001, 40)]:
        rig.attitude(ms, yaw_rate=0.5)
        sample = rig.mag(ms)
        assert sample.gap == (ms in (0, 9000)), ms


def test_a_restart_bridges_nothing(rig):
    for ms in range(0, 1000, 40):
        rig.attitude(ms, yaw_rate=0.5)
        rig.mag(ms)
    rig.a.restart(1)
    rig.attitude(1000, yaw_rate=0.5)
    sample = rig.mag(1000)
    assert sample.gap
    assert (sample.dt_s, sample.yaw_step_rad) == (0.0, 0.0)


# ------------------------------------------------------------ clocks


def test_a_reboot_wants_a_second_message(rig):
    for ms in range(100_000, 101_000, 100):
        rig.attitude(ms)
        rig.mag(ms)
    rig.attitude(500)
    assert rig.a.reboots == 0
    assert rig.a.counts["clock: doubt"] == 1
    rig.attitude(600)
    assert rig.a.reboots == 1
    rig.attitude(700)
    sample = rig.mag(700)
    assert sample.gap


def test_one_wild_time_stamp_changes_nothing(rig):
    got = []
    for i, ms in enumerate(range(10_000, 12_000, 100)):
        rig.attitude(ms)
        if i in (5, 12):
            rig.mag(4_000_000 if i == 5 else 3)
        got.append(rig.mag(ms))
    assert rig.a.reboots == 0
    assert rig.a.counts["clock: doubt"] == 2
    assert all(s is not None for s in got)
    assert [s.gap for s in got] == [True] + [False] * 19


def test_two_wild_time_stamps_that_do_not_agree_change_nothing(rig):
    rig.attitude(10_000)
    for ms in (4_000_000, 9_000_000, 5):
        rig.attitude(ms)
    assert rig.a.clock.latest_ns == 10 * S
    assert rig.a.reboots == 0


def test_a_clock_jump_ahead_is_believed_once_confirmed_and_is_no_reboot(rig):
    for ms in range(0, 1000, 100):
        rig.attitude(ms)
        rig.mag(ms)
    rig.attitude(60_000)
    rig.attitude(60_100)
    sample = rig.mag(60_100)
    assert sample.gap
    assert rig.a.reboots == 0
    assert rig.a.counts["clock: clock jump"] == 1


def test_messages_out_of_order_are_no_reboot():
    clock = BootClock()
    assert [clock.hear(t * S) for t in (10, 11, 9, 12, 10)] == [Tick.GOES_ON] * 5
    assert clock.latest_ns == 12 * S


# ------------------------------------------------------------ a stuck sensor, and own tilt


def test_a_stuck_sensor_shows_once_the_vehicle_has_turned(rig):
    for ms in range(0, 5001, 20):
        rig.attitude(ms)
        rig.mag(ms, value=7)
    assert rig.a.frozen_s(1) == 0.0  # standing still, a value may well stay
    for ms in range(5020, 10_001, 20):
        rig.attitude(ms, yaw_rate=0.3)
        rig.mag(ms, value=7)
    assert rig.a.frozen_s(1) == pytest.approx(10.0, abs=0.05)
    rig.mag(10_020)
    assert rig.a.frozen_s(1) == 0.0
    assert rig.a.frozen_s(3) == 0.0


def test_without_attitude_the_imu_gives_tilt_and_turning(rig):
    total, sources = 0.0, set()
    for ms in range(0, 10_001, 20):
        rig.imu(ms, rate=(0, 0, 0.4))
        sample = rig.mag(ms)
        sources.add(sample.tilt_from)
        total += sample.yaw_step_rad
    assert sources == {"OWN"}
    assert total == pytest.approx(4.0, abs=0.02)


def test_attitude_lost_midway_leaves_one_gap_and_goes_on(rig):
    gaps, sources = [], []
    for ms in range(0, 8001, 20):
        rig.imu(ms, rate=(0, 0, 0.4))
        if ms <= 3000:
            rig.attitude(ms, yaw_rate=0.4)
        sample = rig.mag(ms)
        if sample is not None:
            gaps.append(sample.gap)
            sources.append(sample.tilt_from)
    assert sources[0] == "ATTITUDE"
    assert sources[-1] == "OWN"
    assert sum(gaps) == 2  # the first sample, and the change of where the heading comes from
    assert len(gaps) > 390


def test_compasses_do_not_share_memory(rig):
    for ms in range(0, 1000, 100):
        rig.attitude(ms)
        assert rig.mag(ms, value=5 + ms, compass=1) is not None
        assert rig.mag(ms, value=5 + ms, source="SCALED_IMU2", compass=2) is not None


def test_samples_are_frozen_and_their_fields_read_only(rig):
    rig.attitude(0)
    sample = rig.mag(0)
    with pytest.raises(AttributeError):
        sample.dt_s = 3.0
    with pytest.raises(ValueError, match="read-only"):
        np.add(sample.mag_b_mg, 1.0, out=sample.mag_b_mg)
