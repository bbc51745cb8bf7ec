"""When is a vehicle flying: arming, height, landed state, crash, and vehicles that never fly."""

import math

import pytest

from magmav.core.phase import Phase
from magmav.core.types import Landed, LandedReading, MotionReading, PositionReading, VehicleReading

COPTER, PLANE, ROVER = 2, 1, 10
S = 10**9


def beat(phase, armed=True, kind=COPTER, at_s=0.0):
    phase.vehicle(VehicleReading(1, 1, 3, kind, armed, 4), int(at_s * S))


def at_height(phase, metres, at_s=0.0, speed=0.0):
    phase.moving(MotionReading(1, int(at_s * S), speed, 0.0, metres))


def at_altitude(phase, metres, source="GLOBAL_POSITION_INT"):
    phase.position(PositionReading(1, source, 0, 47.0, 8.0, metres))


@pytest.mark.parametrize(("height", "flies"), [(-3.0, False), (0.0, False), (4.9, False), (5.0, True), (80.0, True)])
def test_five_metres_up_is_flying(height, flies):
    phase = Phase()
    beat(phase)
    at_height(phase, height)
    assert phase.aloft(S) is flies
    assert phase.learnable(S, False) is flies


def test_on_the_ground_or_disarmed_nothing_flies():
    phase = Phase()
    beat(phase, armed=False)
    at_height(phase, 50.0)
    assert not phase.aloft(S)
    beat(phase)
    assert phase.aloft(S)
    phase.landed(LandedReading(1, Landed.ON_GROUND))
    assert not phase.aloft(S)
    phase.landed(LandedReading(1, Landed.IN_AIR))
    assert phase.aloft(S)


def test_height_above_the_place_of_arming_counts_where_home_is_wrong():
    """A home 30 m above the field: relative height is negative all flight."""
    phase = Phase()
    at_altitude(phase, 500.0)
    beat(phase)
    at_height(phase, -30.0)
    assert not phase.aloft(S)
    at_altitude(phase, 506.0)
    at_height(phase, -24.0)
    assert phase.aloft(S)


def test_altitudes_of_two_messages_are_not_compared():
    phase = Phase()
    at_altitude(phase, 500.0)
    beat(phase)
    at_altitude(phase, 540.0, "GPS_RAW_INT")  # above the ellipsoid, or another datum
    at_height(phase, 0.0)
    assert not phase.aloft(S)


def test_the_first_moment_aloft_is_remembered():
    phase = Phase()
    beat(phase)
    at_height(phase, 1.0)
    phase.aloft(3 * S)
    assert phase.takeoff_ns is None
    at_height(phase, 9.0)
    phase.aloft(4 * S)
    at_height(phase, 0.0)
    phase.aloft(5 * S)
    at_height(phase, 9.0)
    phase.aloft(6 * S)
    assert phase.takeoff_ns == 4 * S


def test_a_fixed_wing_at_speed_flies_even_low():
    for kind, flies in ((PLANE, True), (COPTER, False)):
        phase = Phase()
        beat(phase, kind=kind)
        at_height(phase, 2.0, speed=17.0)
        assert phase.aloft(S) is flies
    phase = Phase()
    beat(phase, kind=PLANE)
    at_height(phase, 2.0, speed=15.0)
    assert not phase.aloft(S)


def test_without_heights_the_landed_state_decides_and_without_both_ten_seconds():
    phase = Phase()
    beat(phase, at_s=100.0)
    assert not phase.aloft(110 * S)
    assert phase.aloft(111 * S)
    phase.landed(LandedReading(1, Landed.TAKING_OFF))
    assert not phase.aloft(111 * S)
    phase.landed(LandedReading(1, Landed.IN_AIR))
    assert phase.aloft(100 * S)


@pytest.mark.parametrize("kind", [ROVER, 11, 12, 0, None])
def test_what_does_not_fly_learns_wherever_it_is(kind):
    phase = Phase()
    if kind is not None:
        beat(phase, armed=False, kind=kind)
    assert not phase.flyer
    assert phase.learnable(S, False) == (kind is not None)  # three seconds for it to say what it is
    assert phase.learnable(5 * S, False)


@pytest.mark.parametrize("kind", [1, 2, 3, 4, 13, 14, 15, 19, 20, 21, 22, 29])
def test_S10_what_flies_learns_nothing_on_the_ground_unless_told(kind):
    phase = Phase()
    beat(phase, armed=False, kind=kind)
    assert phase.flyer
    assert not phase.learnable(S, False)
    assert phase.learnable(S, True)


def over(phase, seconds, start_s=20.0, tilt_deg=150.0):
    for i in range(int(seconds * 10) + 1):
        phase.tilt(math.radians(tilt_deg), 0.0, int((start_s + i / 10) * S))


def test_a_copter_on_its_back_has_crashed_and_teaches_nothing_more():
    phase = Phase()
    beat(phase)
    at_height(phase, 20.0)
    assert phase.learnable(19 * S, False)
    over(phase, 1.2)
    assert phase.crash_ns == 20 * S
    assert not phase.learnable(30 * S, False)
    assert not phase.learnable(30 * S, True)


def test_a_flip_is_no_crash_and_aerobatics_of_a_plane_are_none():
    phase = Phase()
    beat(phase)
    over(phase, 0.8)
    phase.tilt(0.1, 0.0, 21 * S)
    over(phase, 0.8, 21.2)
    assert phase.crash_ns is None
    over(phase, 5.0, 30.0, tilt_deg=95.0)
    assert phase.crash_ns is None
    phase = Phase()
    beat(phase, kind=PLANE)
    over(phase, 5.0)
    assert phase.crash_ns is None


def test_disarmed_on_its_back_is_carrying():
    phase = Phase()
    beat(phase, armed=False)
    over(phase, 5.0)
    assert phase.crash_ns is None
