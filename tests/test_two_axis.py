"""A compass of two axes against three, and its sigma against what really happens."""

import math

import numpy as np
import pytest
import seed_vectors
from hypothesis import assume, given
from hypothesis import strategies as st
from synthetic_flight import turn

from magmav.core.dip import dip_from_latitude, dip_from_model
from magmav.core.field import expected
from magmav.core.heading import UNKNOWN, magnetic_heading
from magmav.core.rotation import tilt_angle
from magmav.core.two_axis import (
    MAX_TILT_RAD,
    Doubts,
    down_from_dip,
    heading_of_two_axes,
    heading_slopes,
    level_two_axes,
    two_axis_heading,
    two_axis_sigma,
    vertical_component,
    worst_turn_per_dip,
)
from magmav.core.types import EarthField, vec3
from magmav.geomag import world_magnetic_model

SEED = seed_vectors.load()
ROLL = st.floats(-1.04, 1.04)
YAW = st.floats(0.0, 6.28)
DIP = st.floats(-1.45, 1.45)  # 83 degrees either way
RADIUS_MG, DIP_RAD = 200.0, math.radians(66.65)


def body(roll, pitch, yaw, radius=RADIUS_MG, dip=DIP_RAD):
    """What three axes read, with plain rotation matrices of the tests' own."""
    return turn(0, roll) @ turn(1, pitch) @ turn(2, yaw) @ np.array([radius, 0.0, radius * math.tan(dip)])


# ---------------------------------------------------------------- dip from the place


@pytest.mark.parametrize("case", SEED["dip_deg"], ids=lambda c: f"{c['lat']:g}")
def test_dip_of_the_seed_latitudes(case):
    assert math.degrees(dip_from_latitude(math.radians(case["lat"]))) == pytest.approx(case["dip"], abs=1e-12)


def test_the_printed_dip_of_smela_is_cut_off_and_not_rounded():
    assert math.degrees(dip_from_latitude(math.radians(49.2))) == pytest.approx(66.65, abs=0.01)


@given(st.floats(-1.57, 1.57))
def test_dip_is_odd_in_latitude_and_twice_its_tangent(latitude):
    got = dip_from_latitude(latitude)
    assert math.tan(got) == pytest.approx(2.0 * math.tan(latitude), rel=1e-9)
    assert dip_from_latitude(-latitude) == -got


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1.58, -49.2])
def test_a_latitude_that_is_none_is_refused(bad):
    with pytest.raises(ValueError, match="latitude_rad"):
        dip_from_latitude(bad)


def test_a_dipole_is_a_poor_earth():
    """The docstring's figures: some 11 degrees RMS and 31 at worst, against the world model of 2025."""
    off, weight = [], []
    for lat in range(-60, 61, 10):
        for lon in range(-180, 180, 15):
            field = world_magnetic_model(lat, lon, 0.0, 1_735_689_600 * 10**9)
            assert field is not None
            off.append(math.degrees(dip_from_latitude(math.radians(lat)) - dip_from_model(expected(field))))
            weight.append(math.cos(math.radians(lat)))
    assert math.sqrt(np.average(np.square(off), weights=weight)) == pytest.approx(11.5, abs=1.5)
    assert max(map(abs, off)) == pytest.approx(31.0, abs=3.0)


@given(DIP, st.floats(20.0, 400.0), YAW)
def test_dip_of_a_model_field_is_its_angle_below_the_horizon(dip, horizontal, declination):
    field = EarthField(
        horizontal * math.cos(declination), horizontal * math.sin(declination), horizontal * math.tan(dip)
    )
    assert dip_from_model(expected(field)) == pytest.approx(dip, abs=1e-12)
    assert down_from_dip(horizontal, dip) == pytest.approx(field.down_mg, rel=1e-12)


@pytest.mark.parametrize(("radius", "dip"), [(0.0, 1.0), (-1.0, 1.0), (math.nan, 1.0), (200.0, 1.6), (200.0, math.inf)])
def test_a_radius_or_dip_that_cannot_be_is_refused(radius, dip):
    with pytest.raises(ValueError, match=r"radius|dip_rad"):
        down_from_dip(radius, dip)


# ---------------------------------------------------------------- the missing axis, and the heading


@pytest.mark.parametrize("case", SEED["tilt"], ids=lambda c: f"{c['roll']}/{c['pitch']}/{c['psi']}")
def test_the_seed_attitudes(case):
    roll, pitch, dip = (math.radians(case[k]) for k in ("roll", "pitch", "incl"))
    x, y, _ = case["m_unit"]
    z = vertical_component(x, y, roll, pitch, math.sin(dip))
    got = two_axis_heading(x, y, roll, pitch, math.cos(dip), dip)
    if tilt_angle(roll, pitch) > MAX_TILT_RAD:
        assert (z, got) == (None, None)
    else:
        assert z == pytest.approx(case["z_es"], abs=1e-12)
        assert got is not None
        assert math.remainder(math.degrees(got) - case["psi"], 360.0) == pytest.approx(0.0, abs=1e-9)


@given(ROLL, ROLL, YAW, DIP, st.floats(20.0, 600.0))
def test_two_axes_and_the_right_dip_are_as_good_as_three(roll, pitch, yaw, dip, radius):
    assume(tilt_angle(roll, pitch) <= MAX_TILT_RAD)
    x, y, z = body(roll, pitch, yaw, radius, dip)
    got = two_axis_heading(x, y, roll, pitch, radius, dip)
    assert got is not None
    assert 0.0 <= got < math.tau
    assert math.degrees(math.remainder(got - yaw, math.tau)) == pytest.approx(0.0, abs=1e-9)
    down = down_from_dip(radius, dip)
    z_es = vertical_component(x, y, roll, pitch, down)
    assert z_es == pytest.approx(z, abs=1e-9 * math.hypot(radius, down))
    # The paper's two steps, Z_ES and then the levelling of three axes, are our one.
    three = magnetic_heading(vec3((x, y, z_es), "field"), roll, pitch)
    assert math.remainder(got - (three or 0.0), math.tau) == pytest.approx(0.0, abs=1e-11)
    level = level_two_axes(x, y, roll, pitch, down)
    assert level == pytest.approx((radius * math.cos(yaw), -radius * math.sin(yaw)), abs=1e-9 * radius)


@given(ROLL, ROLL, YAW, YAW)
def test_turning_about_down_turns_the_heading_and_nothing_else(roll, pitch, yaw, more):
    """Even with a dip that is 5 degrees wrong, the error repeats after a whole turn, and is none when level."""
    assume(tilt_angle(roll, pitch) <= MAX_TILT_RAD)
    wrong = DIP_RAD - math.radians(5.0)
    once = two_axis_heading(*body(roll, pitch, yaw)[:2], roll, pitch, RADIUS_MG, wrong)
    again = two_axis_heading(*body(roll, pitch, yaw + math.tau)[:2], roll, pitch, RADIUS_MG, wrong)
    assert (once is None) == (again is None)
    if once is not None:
        assert math.remainder(once - again, math.tau) == pytest.approx(0.0, abs=1e-6)
    level = two_axis_heading(*body(0.0, 0.0, yaw + more)[:2], 0.0, 0.0, RADIUS_MG, wrong)
    assert math.remainder((level or 0.0) - yaw - more, math.tau) == pytest.approx(0.0, abs=1e-12)


@given(st.floats(0.1, 10.0), ROLL, YAW)
def test_only_the_shape_of_the_field_counts(scale, roll, yaw):
    """Half a circle's range or the paper's radius of 0.5: the same heading, as long as V is reckoned from it."""
    x, y, _ = body(roll, 0.2, yaw)
    assume(tilt_angle(roll, 0.2) <= MAX_TILT_RAD)
    one = two_axis_heading(x, y, roll, 0.2, RADIUS_MG, DIP_RAD)
    other = two_axis_heading(scale * x, scale * y, roll, 0.2, scale * RADIUS_MG, DIP_RAD)
    assert math.remainder((one or 0.0) - (other or 0.0), math.tau) == pytest.approx(0.0, abs=1e-12)


def test_beyond_sixty_degrees_everything_refuses():
    for roll_deg, pitch_deg, refused in [(59.9, 0, False), (60.1, 0, True), (0, -60.1, True), (45, 44.9, False),
                                         (45, 45.1, True), (180, 0, True), (0, 90, True)]:  # fmt: skip
        roll, pitch = math.radians(roll_deg), math.radians(pitch_deg)
        x, y, _ = body(roll, pitch, 1.0)
        doubts = Doubts(np.eye(2), 0.01, 0.01)
        got = (
            vertical_component(x, y, roll, pitch, 400.0),
            level_two_axes(x, y, roll, pitch, 400.0),
            two_axis_heading(x, y, roll, pitch, RADIUS_MG, DIP_RAD),
            heading_slopes(x, y, roll, pitch, RADIUS_MG, DIP_RAD),
            two_axis_sigma(x, y, roll, pitch, RADIUS_MG, DIP_RAD, doubts),
        )
        assert all((one is None) == refused for one in got), (roll_deg, pitch_deg)
        published = heading_of_two_axes(x, y, roll, pitch, RADIUS_MG, DIP_RAD, doubts, 0.1)
        assert published.valid != refused
        assert not refused or published == UNKNOWN


def test_without_a_horizontal_field_there_is_no_heading():
    assert two_axis_heading(0.0, 0.0, 0.0, 0.0, RADIUS_MG, DIP_RAD) is None
    doubts = Doubts(np.eye(2), 0.01, 0.01)
    assert not heading_of_two_axes(14.0, 14.0, 0.0, 0.0, RADIUS_MG, DIP_RAD, doubts, 0.1).valid
    assert heading_of_two_axes(15.0, 15.0, 0.0, 0.0, RADIUS_MG, DIP_RAD, doubts, 0.1).valid


@pytest.mark.parametrize("place", range(5))
def test_a_reading_that_is_no_number_is_refused_by_name(place):
    names = ("x_b_mg", "y_b_mg", "roll_rad", "pitch_rad", "down_mg")
    values = [100.0, 100.0, 0.1, 0.1, 400.0]
    values[place] = math.nan
    for function in (vertical_component, level_two_axes):
        with pytest.raises(ValueError, match=names[place]):
            function(*values)


# ---------------------------------------------------------------- how sure


def headings(values):
    """The heading of (x, y, roll, pitch, radius, dip)."""
    got = two_axis_heading(*values)
    assert got is not None
    return got


@given(ROLL, ROLL, YAW, DIP)
def test_slopes_are_finite_differences(roll, pitch, yaw, dip):
    assume(tilt_angle(roll, pitch) < math.radians(59.0))
    at = np.array([*body(roll, pitch, yaw, RADIUS_MG, dip)[:2], roll, pitch, RADIUS_MG, dip])
    slopes = heading_slopes(*at)
    assert slopes is not None
    for i, step in enumerate((1e-3, 1e-3, 1e-6, 1e-6, 1e-3, 1e-6)):
        up, down = at.copy(), at.copy()
        up[i] += step
        down[i] -= step
        moved = math.remainder(headings(up) - headings(down), math.tau) / (2.0 * step)
        assert slopes[i] == pytest.approx(moved, rel=1e-4, abs=1e-6), slopes._fields[i]


LEANING = np.array([[30.0, 12.0], [12.0, 20.0]])


@pytest.mark.parametrize(
    ("roll_deg", "pitch_deg", "yaw_deg"), [(0, 0, 20), (12, -8, 100), (-25, 15, 200), (30, 30, 315)]
)
@pytest.mark.parametrize(
    "doubts",
    [
        Doubts(LEANING, 0.0, 0.0),
        Doubts(np.zeros((2, 2)), math.radians(0.6), 0.0),
        Doubts(np.zeros((2, 2)), 0.0, math.radians(0.5)),
        Doubts(np.zeros((2, 2)), 0.0, 0.0, 3.0),
        Doubts(LEANING, math.radians(0.6), math.radians(0.5), 3.0),
    ],
    ids=["iron", "dip", "tilt", "radius", "all"],
)
def test_sigma_is_the_scatter_of_many_headings(roll_deg, pitch_deg, yaw_deg, doubts):
    """3000 draws know a sigma to 1.3 %; the formula itself is linear and leaves out the square of small errors."""
    r, n = np.random.default_rng(11), 3000
    roll, pitch, yaw = map(math.radians, (roll_deg, pitch_deg, yaw_deg))
    x, y, _ = body(roll, pitch, yaw)
    draws = np.column_stack(
        [
            np.array([x, y]) + r.multivariate_normal(np.zeros(2), doubts.covariance_b_mg2, n),
            roll + r.normal(0.0, doubts.tilt_rad, n),
            pitch + r.normal(0.0, doubts.tilt_rad, n),
            RADIUS_MG + r.normal(0.0, doubts.radius_mg, n),
            DIP_RAD + r.normal(0.0, doubts.dip_rad, n),
        ]
    )
    off = [math.remainder(headings(row) - yaw, math.tau) for row in draws]
    claimed = two_axis_sigma(x, y, roll, pitch, RADIUS_MG, DIP_RAD, doubts)
    assert claimed is not None
    if claimed < 1e-9:  # level, nothing rests on dip or radius
        assert max(map(abs, off)) < 1e-9
    else:
        assert np.std(off) == pytest.approx(claimed, rel=0.06)


def test_sigma_never_passes_half_a_turn():
    x, y, _ = body(0.3, 0.2, 1.0)
    assert two_axis_sigma(x, y, 0.3, 0.2, RADIUS_MG, DIP_RAD, Doubts(np.eye(2) * 1e8, 0.1, 0.1)) == math.pi


@pytest.mark.parametrize(("tilt_deg", "printed"), [(5, 0.79), (10, 1.6), (20, 3.4), (30, 5.6)])
def test_a_wrong_dip_costs_what_was_predicted(tilt_deg, printed):
    """Roll and pitch alike, dip 66.65, the worst of all headings, per degree of dip: by formula, by trial, as known."""
    tilt, error = math.radians(tilt_deg), 1e-5
    worst = 0.0
    for yaw in np.radians(np.arange(0.0, 360.0, 0.5)):
        x, y, _ = body(tilt, tilt, yaw)
        got = headings((x, y, tilt, tilt, RADIUS_MG, DIP_RAD + error))
        worst = max(worst, abs(math.remainder(got - yaw, math.tau)) / error)
    assert worst == pytest.approx(worst_turn_per_dip(tilt_angle(tilt, tilt), DIP_RAD), rel=1e-3)
    assert worst == pytest.approx(printed, rel=0.02)


@given(ROLL, ROLL, DIP)
def test_the_worst_heading_depends_on_tilt_and_dip_only(roll, pitch, dip):
    """The slope along the heading is a sine wave whose height is sec^2 I tan(tilt), however the tilt is made up."""
    assume(tilt_angle(roll, pitch) < MAX_TILT_RAD)
    slopes = [
        heading_slopes(*body(roll, pitch, yaw, RADIUS_MG, dip)[:2], roll, pitch, RADIUS_MG, dip)
        for yaw in (0.7, 0.7 + math.pi / 2.0)
    ]
    height = math.hypot(*(one.dip for one in slopes if one is not None))
    assert height == pytest.approx(worst_turn_per_dip(tilt_angle(roll, pitch), dip), rel=1e-6, abs=1e-6)


def test_the_published_heading_carries_declination_and_sigma():
    x, y, _ = body(0.2, -0.1, 1.0)
    doubts = Doubts(LEANING, 0.01, 0.01)
    sigma = two_axis_sigma(x, y, 0.2, -0.1, RADIUS_MG, DIP_RAD, doubts)
    got = heading_of_two_axes(x, y, 0.2, -0.1, RADIUS_MG, DIP_RAD, doubts, 0.1)
    assert (got.valid, got.true_valid) == (True, True)
    assert (got.magnetic_rad, got.true_rad) == pytest.approx((1.0, 1.1), abs=1e-12)
    assert got.sigma_rad == sigma
    assert not heading_of_two_axes(x, y, 0.2, -0.1, RADIUS_MG, DIP_RAD, doubts, None).true_valid
