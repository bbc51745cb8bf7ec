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


# ---------------------------------------------------------------- the story of a flight


def told(phase, until_s, height, landed=None, from_s=0.0):
    """Ten times a second: heights over time, and what the autopilot says of landing, if it says anything."""
    for tenth in range(round(from_s * 10), round(until_s * 10)):
        now = tenth / 10
        metres = height(now)
        at_height(phase, metres, now, speed=0.0 if metres < 1.0 else 3.0)
        if landed is not None:
            phase.landed(LandedReading(1, landed(now)))
        phase.learnable(round(now * S), False)


def hop(now):
    """Up at 5 s, at 10 m from 7 s to 20 s, down at 22 s."""
    return max(0.0, min(10.0, (now - 5.0) * 5.0, (22.0 - now) * 5.0))


def test_a_flight_is_told_from_arming_to_disarming():
    phase = Phase()
    beat(phase, armed=False)
    told(phase, 2.0, hop)
    beat(phase, at_s=2.0)
    told(phase, 40.0, hop, from_s=2.0)
    beat(phase, armed=False, at_s=40.0)
    (flight,) = phase.flights
    assert flight.as_seconds() == {
        "armed_s": 2.0,
        "takeoff_s": pytest.approx(6.0, abs=0.11),  # 5 m up
        "landed_s": pytest.approx(21.6 + 3.0, abs=0.41),  # low and slow for three seconds
        "disarmed_s": 40.0,
        "crash_s": None,
    }


def test_the_autopilots_word_on_landing_counts_before_height():
    phase = Phase()
    beat(phase)
    told(phase, 40.0, lambda now: 30.0, lambda now: Landed.IN_AIR if 5.0 < now < 25.0 else Landed.ON_GROUND)
    assert phase.flights[0].as_seconds()["takeoff_s"] == pytest.approx(5.1)
    assert phase.flights[0].as_seconds()["landed_s"] == pytest.approx(25.0)


def test_two_hops_without_disarming_are_two_flights_of_one_arming():
    phase = Phase()
    beat(phase, at_s=1.0)
    told(phase, 30.0, hop, from_s=1.0)
    told(phase, 60.0, lambda now: hop(now - 30.0), from_s=30.0)
    first, second = phase.flights
    assert first.armed_ns == second.armed_ns == S
    assert first.landed_ns < second.takeoff_ns < second.landed_ns
    assert phase.takeoff_ns == first.takeoff_ns


def test_disarming_in_the_air_ends_the_flight():
    phase = Phase()
    beat(phase)
    told(phase, 10.0, lambda now: 50.0)
    beat(phase, armed=False, at_s=10.0)
    assert phase.flights[0].landed_ns == phase.flights[0].disarmed_ns == 10 * S


def test_arming_without_flying_has_no_take_off():
    phase = Phase()
    beat(phase)
    told(phase, 20.0, lambda now: 0.0)
    beat(phase, armed=False, at_s=20.0)
    beat(phase, at_s=30.0)
    assert [(f.takeoff_ns, f.landed_ns) for f in phase.flights] == [(None, None), (None, None)]
    assert [f.disarmed_ns for f in phase.flights] == [20 * S, None]


def test_a_crash_stands_in_its_flight():
    phase = Phase()
    beat(phase)
    told(phase, 5.0, lambda now: 20.0)
    for tenth in range(50, 80):
        phase.tilt(math.pi, 0.0, tenth * S // 10)
    assert phase.flights[0].as_seconds()["crash_s"] == phase.crash_ns / S == 5.0


def test_what_does_not_fly_takes_off_nowhere():
    """A rover up a hill, and one armed for a minute with no height known: flights there are only of what flies."""
    uphill, blind = Phase(), Phase()
    for phase in (uphill, blind):
        beat(phase, kind=ROVER)
    told(uphill, 30.0, lambda now: now)
    for tenth in range(600):
        blind.learnable(tenth * S // 10, False)
    for phase in (uphill, blind):
        assert phase.takeoff_ns is None
        assert [f.takeoff_ns for f in phase.flights] == [None]


def test_a_mended_vehicle_learns_again():
    phase = Phase()
    beat(phase)
    told(phase, 5.0, lambda now: 20.0)
    for tenth in range(50, 80):
        phase.tilt(math.pi, 0.0, tenth * S // 10)
    assert not phase.learnable(8 * S, False)
    beat(phase, armed=False, at_s=60.0)
    phase.tilt(0.0, 0.0, 61 * S)
    beat(phase, at_s=600.0)
    at_height(phase, 20.0, 610.0)
    assert phase.learnable(610 * S, False)
    assert [f.crash_ns is None for f in phase.flights] == [False, True]
