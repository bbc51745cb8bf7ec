"""The own frame in plain numbers against the same in rotation matrices."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from magmav.core.own_frame import carried, levelled, matrix, of_attitude, stepped
from magmav.core.rotation import body_from_earth, rotation

ANGLE = st.floats(-math.pi, math.pi)
ATTITUDE = st.tuples(ANGLE, st.floats(-math.pi / 2, math.pi / 2), ANGLE)
RATE = st.tuples(*[st.floats(-20.0, 20.0)] * 3)


def down_at(roll_rad, pitch_rad):
    """Where down is, seen from the body."""
    level = math.cos(pitch_rad)
    return -math.sin(pitch_rad), level * math.sin(roll_rad), level * math.cos(roll_rad)


@given(ATTITUDE)
def test_an_attitude_as_a_frame_is_that_attitude(attitude):
    assert matrix(of_attitude(*attitude)) == pytest.approx(body_from_earth(*attitude), abs=1e-14)


@given(ATTITUDE, RATE, st.floats(-0.6, 0.6))
def test_carried_by_rates_it_turns_as_the_body_does_backwards(attitude, rate, dt_s):
    """At any rate, none included; the matrix formula itself leaves out turns below 1e-9."""
    got = matrix(carried(of_attitude(*attitude), rate, dt_s))
    assert got == pytest.approx(rotation(-dt_s * np.array(rate)) @ body_from_earth(*attitude), abs=2e-9)


@given(ATTITUDE, ATTITUDE)
def test_levelled_it_has_the_earths_down_and_took_the_shortest_way(frame, attitude):
    was, now = matrix(of_attitude(*frame)), body_from_earth(*attitude)
    apart = math.acos(max(-1.0, min(1.0, float(was[:, 2] @ now[:, 2]))))
    assume(apart < math.radians(177.0))
    got = matrix(levelled(of_attitude(*frame), down_at(*attitude[:2])))
    turn = got @ was.T
    assert got[:, 2] == pytest.approx(now[:, 2], abs=1e-11)
    assert got @ got.T == pytest.approx(np.eye(3), abs=1e-14)
    assert math.acos(max(-1.0, min(1.0, 0.5 * float(np.trace(turn)) - 0.5))) == pytest.approx(apart, abs=1e-6)


def test_upside_down_there_is_no_shortest_way_and_nothing_turns():
    upright = of_attitude(0.0, 0.0, 1.0)
    assert levelled(upright, down_at(math.pi, 0.0)) == upright


@given(ATTITUDE, ATTITUDE, ATTITUDE)
def test_over_a_gap_it_turns_with_the_attitude(frame, before, after):
    got = matrix(stepped(of_attitude(*frame), of_attitude(*before), of_attitude(*after)))
    step = body_from_earth(*after) @ body_from_earth(*before).T
    assert got == pytest.approx(step @ body_from_earth(*frame), abs=1e-13)


def test_it_is_a_rotation_still_after_an_hour():
    frame = of_attitude(0.1, 0.2, 0.3)
    for i in range(180_000):
        frame = levelled(carried(frame, (0.3, -0.2, 0.5), 0.02), down_at(0.2 * math.sin(0.01 * i), 0.1))
    assert math.sqrt(sum(v * v for v in frame)) == pytest.approx(1.0, abs=1e-12)
