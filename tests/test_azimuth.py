"""The paper's eight rules against one arctangent, and the way from our levelled field to its X and Y."""

import math

import numpy as np
import pytest
import seed_vectors
from hypothesis import given
from hypothesis import strategies as st
from synthetic_flight import turn

from magmav.core.azimuth import azimuth, azimuth_by_rules, azimuth_of_level, true_azimuth
from magmav.core.heading import magnetic_heading

SEED = seed_vectors.load()
FIELD = st.floats(-1e6, 1e6)


@pytest.mark.parametrize("case", SEED["azimuth_rules_XY"], ids=lambda c: f"{c['az']:.0f}")
def test_the_rules_give_the_seed_angles(case):
    for rule in (azimuth_by_rules, azimuth):
        got = rule(case["X"], case["Y"])
        assert got is not None
        assert math.degrees(got) == pytest.approx(case["az"], abs=1e-12)


@pytest.mark.parametrize("case", SEED["heading_hxhy"], ids=lambda c: f"{c['psi']:g}")
def test_forward_and_right_go_in_as_minus_right_and_ahead(case):
    assert math.degrees(azimuth_of_level(case["hx"], case["hy"]) or 0.0) == pytest.approx(case["psi"], abs=1e-12)


@given(FIELD, FIELD)
def test_eight_rules_are_one_arctangent(x, y):
    rules, one = azimuth_by_rules(x, y), azimuth(x, y)
    if x == 0.0 and y == 0.0:
        assert rules is None
        assert one is None
    else:
        assert rules is not None
        assert one is not None
        assert math.remainder(rules - one, math.tau) == pytest.approx(0.0, abs=1e-14)
        assert 0.0 <= rules < math.tau
        assert 0.0 <= one < math.tau


@given(st.floats(0.0, 6.28), st.floats(1e-3, 1e3))
def test_the_rules_find_the_angle_that_was_put_in(angle, strength):
    got = azimuth_by_rules(strength * math.sin(angle), strength * math.cos(angle))
    assert got is not None
    assert math.remainder(got - angle, math.tau) == pytest.approx(0.0, abs=1e-12)


def test_a_full_turn_is_no_turn():
    """The printed rule 8 gives 360 here."""
    assert azimuth_by_rules(-1e-20, 1.0) == 0.0
    assert azimuth(-1e-20, 1.0) == 0.0
    assert true_azimuth(math.radians(350.0), math.radians(10.0)) == pytest.approx(0.0, abs=1e-15)
    assert math.degrees(true_azimuth(math.radians(5.0), math.radians(-10.0))) == pytest.approx(355.0)


def test_no_field_has_no_azimuth():
    assert azimuth_by_rules(0.0, -0.0) is None
    assert azimuth_of_level(0.0, 0.0) is None


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("rule", [azimuth_by_rules, azimuth])
def test_what_is_no_number_is_refused_by_name(rule, bad):
    with pytest.raises(ValueError, match="x: want a finite number"):
        rule(bad, 1.0)
    with pytest.raises(ValueError, match="y: want a finite number"):
        rule(1.0, bad)


@given(st.floats(0.0, 6.28), st.floats(-0.5, 0.5))
def test_both_papers_agree_on_the_heading_and_declination_makes_it_true(yaw, declination):
    """Sawicki's atan2(-hy, hx) of a level vehicle whose nose points at ``yaw``."""
    body = turn(2, yaw) @ np.array([200.0 * math.cos(declination), 200.0 * math.sin(declination), 430.0])
    got = azimuth_of_level(body[0], body[1])
    assert got is not None
    assert math.remainder(got - (magnetic_heading(body, 0.0, 0.0) or 0.0), math.tau) == pytest.approx(0.0, abs=1e-12)
    assert math.remainder(true_azimuth(got, declination) - yaw, math.tau) == pytest.approx(0.0, abs=1e-12)
