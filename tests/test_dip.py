"""The dip from what two axes read: one reading (Sytnyk's eq. 5) and all of them."""

import copy
import math
import pickle

import numpy as np
import pytest
import seed_vectors
from hypothesis import assume, given
from hypothesis import strategies as st
from synthetic_flight import turn

from magmav.core.dip import DipFit, DipFitter, Refused, extended_dip
from magmav.core.two_axis import two_axis_heading, vertical_component

SEED = seed_vectors.load()
ANGLE = st.floats(-1.0, 1.0)
YAW = st.floats(0.0, 6.28)
DIP_RAD, FIELD_MG = math.radians(66.0), 500.0
RADIUS_MG, DOWN_MG = FIELD_MG * math.cos(DIP_RAD), FIELD_MG * math.sin(DIP_RAD)


def body(roll, pitch, yaw, dip=DIP_RAD):
    return turn(0, roll) @ turn(1, pitch) @ turn(2, yaw) @ (FIELD_MG * np.array([math.cos(dip), 0.0, math.sin(dip)]))


def d_of(roll, pitch, yaw):
    """D of the reference: what a reading's noise is divided by."""
    return math.sin(pitch) * math.cos(roll) * math.sin(yaw) - math.sin(roll) * math.cos(yaw)


# ---------------------------------------------------------------- one reading


@pytest.mark.parametrize("case", SEED["tilt"], ids=lambda c: f"{c['roll']}/{c['pitch']}/{c['psi']}")
def test_extended_dip_of_the_seed_attitudes(case):
    roll, pitch, psi = (math.radians(case[k]) for k in ("roll", "pitch", "psi"))
    assert d_of(roll, pitch, psi) == pytest.approx(case["D"], abs=1e-15)
    got = extended_dip(*case["m_unit"][:2], roll, pitch, psi)
    if case["eda_deg"] is None:
        assert got is None
    else:
        assert got is not None
        assert math.degrees(got.dip_rad) == pytest.approx(case["incl"], abs=1e-10 / abs(case["D"]))
        assert got.z_b_mg == pytest.approx(case["z_from_azimuth"], abs=1e-12 / abs(case["D"]))
        assert got.down_mg == pytest.approx(case["h"][2], abs=1e-12 / abs(case["D"]))


@given(ANGLE, ANGLE, YAW, st.floats(-1.4, 1.4))
def test_extended_dip_is_exact_wherever_it_is_said(roll, pitch, yaw, dip):
    """Also at 90 and 270 degrees, where the printed tangent form has no value."""
    d = d_of(roll, pitch, yaw)
    got = extended_dip(*body(roll, pitch, yaw, dip)[:2], roll, pitch, yaw)
    if abs(d) < 0.00999:
        assert got is None
    elif abs(d) > 0.01001:
        assert got is not None
        assert got.dip_rad == pytest.approx(dip, abs=1e-13 / abs(d))
        assert got.down_mg == pytest.approx(FIELD_MG * math.sin(dip), abs=1e-10 / abs(d))


@pytest.mark.parametrize("yaw_deg", [90.0, 270.0])
def test_east_and_west_are_no_exception(yaw_deg):
    yaw = math.radians(yaw_deg)
    got = extended_dip(*body(0.1, 0.2, yaw)[:2], 0.1, 0.2, yaw)
    assert got is not None
    assert got.dip_rad == pytest.approx(DIP_RAD, abs=1e-12)


@given(st.floats(-1.0, 1.0), st.floats(0.3, 1.2))
def test_there_is_no_dip_on_a_whole_surface_of_tilted_attitudes(pitch, yaw):
    """tan(phi) = sin(theta) tan(psi); the text says only level."""
    roll = math.atan(math.sin(pitch) * math.tan(yaw))
    assert extended_dip(*body(roll, pitch, yaw)[:2], roll, pitch, yaw) is None


@given(ANGLE, st.floats(-0.5, 0.5), YAW, st.floats(0.5, 1.3))
def test_a_heading_made_with_a_wrong_dip_only_gives_it_back(roll, pitch, yaw, guess):
    """Circular: eq. (5) says nothing unless the heading came from elsewhere."""
    x, y, _ = body(roll, pitch, yaw)
    radius = FIELD_MG * math.cos(guess)
    psi = two_axis_heading(x, y, roll, pitch, radius, guess)
    assume(psi is not None)
    got = extended_dip(x, y, roll, pitch, psi, least_d=0.05)
    assume(got is not None)
    assert got.z_b_mg == pytest.approx(vertical_component(x, y, roll, pitch, radius * math.tan(guess)), abs=1e-8)


# ---------------------------------------------------------------- all readings


def flown(seed, n=300, swing_deg=10.0, noise_mg=2.5, attitude_deg=0.0, dip=DIP_RAD):
    """Rows (x, y, roll, pitch, psi) as they were heard."""
    r = np.random.default_rng(seed)
    rows = []
    for _ in range(n):
        roll, pitch = math.radians(swing_deg) * r.uniform(-1.0, 1.0, 2)
        yaw = r.uniform(0.0, math.tau)
        x, y, _ = body(roll, pitch, yaw, dip) + r.normal(0.0, noise_mg, 3)
        rows.append((x, y, *np.array([roll, pitch]) + r.normal(0.0, math.radians(attitude_deg), 2), yaw))
    return rows


ALWAYS = (*body(0.2, 0.1, 1.0)[:2], 0.2, 0.1, 1.0)


def fitted(rows, **settings):
    fitter = DipFitter(**settings)
    for row in rows:
        fitter.add(*row)
    return fitter


def answer(rows, **settings):
    got = fitted(rows, **settings).fit()
    assert isinstance(got, DipFit), got
    return got


def design(rows):
    """The regression in full: (2 n, 2) and (2 n,)."""
    a, b = [], []
    for x, y, roll, pitch, yaw in rows:
        c = turn(0, roll) @ turn(1, pitch) @ turn(2, yaw)
        a += [c[0, [0, 2]], c[1, [0, 2]]]
        b += [x, y]
    return np.array(a), np.array(b)


@pytest.mark.parametrize("seed", range(5))
def test_one_at_a_time_is_least_squares_over_all(seed):
    rows = flown(seed, n=60)
    a, b = design(rows)
    want, rest, *_ = np.linalg.lstsq(a, b, rcond=None)
    got = answer(rows)
    assert [got.radius_mg, got.down_mg] == pytest.approx(want, rel=1e-11)
    per_axis = rest[0] / (len(b) - 2)
    assert got.residual_mg == pytest.approx(math.sqrt(per_axis), rel=1e-9)
    assert got.covariance_mg2 == pytest.approx(per_axis * np.linalg.inv(a.T @ a), rel=1e-9)
    assert got.readings == 60


def test_attitude_noise_is_taken_off_the_normal_equations():
    """In full: (A'A - N) theta = A'b, N what noise alone would bring, and the sandwich for its covariance."""
    rows, tilt_sigma = flown(8, n=60), math.radians(2.0)
    a, b = design(rows)
    inverse = np.linalg.inv(a.T @ a - np.diag([0.0, 60 * 2.0 * tilt_sigma**2]))
    want = inverse @ a.T @ b
    got = answer(rows, tilt_sigma_rad=tilt_sigma)
    assert [got.radius_mg, got.down_mg] == pytest.approx(want, rel=1e-10)
    per_axis = np.sum((b - a @ want) ** 2) / (len(b) - 2)
    assert got.covariance_mg2 == pytest.approx(per_axis * inverse @ a.T @ a @ inverse, rel=1e-9)


def test_forgetting_is_weighted_least_squares():
    rows = flown(3, n=80)
    a, b = design(rows)
    weight = np.repeat(0.95 ** (np.arange(80)[::-1] / 2.0), 2)
    want = np.linalg.lstsq(a * weight[:, None], b * weight, rcond=None)[0]
    got = answer(rows, forget=0.95)
    assert [got.radius_mg, got.down_mg] == pytest.approx(want, rel=1e-10)
    assert got.readings == pytest.approx((1.0 - 0.95**80) / 0.05)


@given(st.floats(-1.4, 1.4), st.integers(0, 1000))
def test_without_noise_the_dip_is_exact(dip, seed):
    got = answer(flown(seed, n=12, swing_deg=20.0, noise_mg=0.0, dip=dip))
    assert got.dip_rad == pytest.approx(dip, abs=1e-10)
    assert got.dip_sigma_rad < 1e-9


def test_merging_two_halves_is_the_whole():
    rows = flown(1)
    one, other, whole = fitted(rows[:100]), fitted(rows[100:]), answer(rows)
    one.merge(other)
    one.merge(DipFitter())
    got = one.fit()
    assert isinstance(got, DipFit)
    assert got.dip_rad == pytest.approx(whole.dip_rad, abs=1e-12)
    assert got.dip_sigma_rad == pytest.approx(whole.dip_sigma_rad, rel=1e-9)
    assert got.readings == whole.readings


@pytest.mark.parametrize("cut", [0, 100, 170, 300])
def test_halves_that_forget_are_the_whole_that_forgets(cut):
    """The first half has faded by as many readings as the second took; a merge forgets no more than that."""
    rows = flown(2)
    parts = [DipFitter(0.01, 0.98) for _ in range(3)]
    for fitter, some in zip(parts, (rows[:cut], rows[cut:], rows), strict=True):
        for row in some:
            fitter.add(*row)
    one, other, whole = parts
    one.merge(other)
    got, want = one.fit(), whole.fit()
    assert isinstance(got, DipFit)
    assert got.readings == pytest.approx(want.readings, rel=1e-12)
    assert got.dip_rad == pytest.approx(want.dip_rad, abs=1e-12)
    assert got.dip_sigma_rad == pytest.approx(want.dip_sigma_rad, rel=1e-9)
    one.add(*rows[0])
    whole.add(*rows[0])
    assert one.fit().dip_rad == pytest.approx(whole.fit().dip_rad, abs=1e-12)


@pytest.mark.parametrize("other", [DipFitter(0.01, 0.99), DipFitter(0.02, 0.98)], ids=["forget", "tilt sigma"])
def test_what_was_fitted_otherwise_does_not_merge(other):
    with pytest.raises(ValueError, match="forgetting and tilt sigma"):
        DipFitter(0.01, 0.98).merge(other)


def test_two_attitudes_merged_are_no_longer_one():
    """The scatter between the halves counts, and nothing merged into nothing is nothing."""
    one, other = fitted([ALWAYS] * 20), fitted([(*body(0.2, 0.1, 4.0)[:2], 0.2, 0.1, 4.0)] * 20)
    assert isinstance(one.fit(), Refused)
    assert isinstance(other.fit(), Refused)
    whole = DipFitter()
    for part in (DipFitter(), one, other):
        whole.merge(part)
    got = whole.fit()
    assert isinstance(got, DipFit)
    assert got.dip_rad == pytest.approx(DIP_RAD, abs=1e-12)


@pytest.mark.parametrize("turned_rad", [0.5, 3.0])
def test_what_north_is_called_does_not_matter_only_that_headings_fit_the_field(turned_rad):
    """The same flight begun in another direction sees the same dip."""
    rows = [(row[2], row[3], row[4]) for row in flown(4, noise_mg=0.0)]
    got = answer([(*body(r, p, y + turned_rad)[:2], r, p, y + turned_rad) for r, p, y in rows])
    assert got.dip_rad == pytest.approx(DIP_RAD, abs=1e-12)


@pytest.mark.parametrize(("swing_deg", "attitude_deg"), [(10.0, 0.0), (5.0, 0.7), (20.0, 1.5)])
def test_sigma_is_honest_and_noise_does_not_bias(swing_deg, attitude_deg):
    """60 flights: rms of error over sigma within what 60 draws allow (9 % is one sigma), mean within 3 sigma of 0."""
    off = []
    for seed in range(60):
        rows = flown(seed, n=80, swing_deg=swing_deg, attitude_deg=attitude_deg)
        got = answer(rows, tilt_sigma_rad=math.radians(attitude_deg))
        off.append((got.dip_rad - DIP_RAD) / got.dip_sigma_rad)
    assert 0.75 < math.sqrt(np.mean(np.square(off))) < 1.27
    assert abs(np.mean(off)) < 3.0 / math.sqrt(60.0)


def test_attitude_noise_that_is_not_owned_up_to_makes_the_dip_too_small():
    """The docstring's 1.2 degrees, and the reason for tilt_sigma_rad."""
    bias = np.mean([answer(flown(s, swing_deg=5.0, attitude_deg=0.7)).dip_rad - DIP_RAD for s in range(12)])
    assert math.degrees(bias) == pytest.approx(-1.2, abs=0.3)


def test_all_readings_together_beat_the_mean_of_single_ones():
    """Eq. (5) averaged is pulled down by 2 degrees at 10 degrees of tilt; least squares is not."""
    single, together = [], []
    for seed in range(4):
        rows = flown(seed, n=600)
        got = [extended_dip(*row, least_d=1e-9) for row in rows]
        single.append(np.mean([one.dip_rad for one in got if one is not None]) - DIP_RAD)
        together.append(answer(rows).dip_rad - DIP_RAD)
    assert math.degrees(np.mean(single)) == pytest.approx(-2.0, abs=0.8)
    assert max(map(abs, np.degrees(together))) < 0.2


def test_a_copy_goes_on_to_the_same_bits():
    rows = flown(6)
    straight, half = fitted(rows), fitted(rows[:150])
    for one in (copy.deepcopy(half), pickle.loads(pickle.dumps(half))):
        for row in rows[150:]:
            one.add(*row)
        got, want = one.fit(), straight.fit()
        assert isinstance(got, DipFit)
        assert isinstance(want, DipFit)
        assert (got.radius_mg, got.down_mg, got.dip_sigma_rad) == (want.radius_mg, want.down_mg, want.dip_sigma_rad)


def noise_only(n=200):
    r = np.random.default_rng(9)
    return [(*r.normal(0.0, 100.0, 2), *r.uniform(-0.3, 0.3, 2), r.uniform(0.0, 6.28)) for _ in range(n)]


@pytest.mark.parametrize(
    ("rows", "why"),
    [
        ([], "fewer than 10"),
        (flown(0, n=9), "fewer than 10"),
        (flown(0, swing_deg=0.0), "too little tilt"),
        (flown(0, swing_deg=2.0), "too little tilt"),
        ([ALWAYS] * 50, "same attitude"),
        ([(*body(0.0, 0.2, 0.0)[:2], 0.0, 0.2, 0.0)] * 50, "same attitude"),  # D = 0 all the time
        ([(0.0, 0.0, *row[2:]) for row in flown(0)], "no horizontal field"),
        ([(-row[0], -row[1], *row[2:]) for row in flown(0)], "no horizontal field"),
        (noise_only(), "no horizontal field"),
        ([(x + 120.0 * (-1) ** i, *rest) for i, (x, *rest) in enumerate(flown(0))], "scatter"),
    ],
    ids=[
        "none",
        "few",
        "level",
        "hardly tilted",
        "one attitude",
        "D is 0",
        "all zero",
        "half a turn",
        "noise",
        "shaken",
    ],
)
def test_what_says_nothing_is_refused_with_the_reason(rows, why):
    got = fitted(rows).fit()
    assert isinstance(got, Refused), got
    assert why in got.why


def test_tilt_that_may_be_noise_is_no_tilt():
    """4 degrees RMS of tilt is enough; not where 2.5 degrees on each axis may be the attitude's own error."""
    rows = flown(0, swing_deg=5.0)
    assert isinstance(fitted(rows).fit(), DipFit)
    assert isinstance(fitted(rows, tilt_sigma_rad=math.radians(2.5)).fit(), Refused)


@pytest.mark.parametrize("place", range(5))
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_reading_that_is_no_number_is_refused_and_leaves_no_trace(place, bad):
    fitter = fitted(flown(2))
    before = fitter.fit()
    row = [*flown(2)[0]]
    row[place] = bad
    for function in (fitter.add, extended_dip):
        with pytest.raises(ValueError, match="want a finite number"):
            function(*row)
    assert isinstance(before, DipFit)
    assert fitter.fit()[:4] == before[:4]


@pytest.mark.parametrize("settings", [{"forget": 0.0}, {"forget": 1.1}, {"tilt_sigma_rad": -0.1}, {"forget": math.nan}])
def test_settings_that_cannot_be_are_refused(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        DipFitter(**settings)
