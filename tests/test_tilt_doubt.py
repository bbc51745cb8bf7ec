"""How far an own tilt is doubted, and what standing still teaches: nothing."""

import copy
import math
from dataclasses import replace

import numpy as np
import pytest
from honest_flight import EXPECTED, MOTIONS, RATE_HZ, Motion, field_in_body, samples
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_flight import EARTH_MG, HARD_IRON_MG
from test_adaptive import placed, taught

from magmav.core.estimators.adaptive import AdaptiveEstimator
from magmav.core.estimators.adaptive import layout as at
from magmav.core.estimators.adaptive.block import Gathering
from magmav.core.estimators.adaptive.robust import Stillness
from magmav.core.motion import _OwnTilt
from magmav.core.rotation import body_from_earth
from magmav.core.tilt_doubt import TiltDoubt
from magmav.core.types import ZERO3, InertialReading, vec3

FLOOR, UNKNOWN = math.radians(0.5), math.radians(5.0)
MEMORY_S = 12.0
DEG = math.radians(1.0)

# ---------------------------------------------------------------- how far a tilt is doubted


def doubted(apart, seconds, dt_s=0.02, tau_s=2.0, per_turning_s=0.0, rate=ZERO3):
    """apart: (x, y), or what gives it for a time."""
    d = TiltDoubt(tau_s, per_turning_s)
    for i in range(round(seconds / dt_s)):
        d.step(apart(i * dt_s) if callable(apart) else apart, 1.0, rate, dt_s)
    return d


def test_before_anything_is_seen_it_is_five_degrees():
    assert TiltDoubt(2.0, 0.0).sigma_rad == pytest.approx(math.hypot(UNKNOWN, FLOOR))


@settings(max_examples=20, deadline=None)
@given(st.floats(0.5, 60.0), st.sampled_from([0.02, 0.1, 0.5]))
def test_agreement_brings_it_to_its_floor_as_the_memory_fades_whatever_the_rate(seconds, dt_s):
    """sigma^2 = floor^2 + unknown^2 exp(-t / memory)."""
    d = doubted((0.0, 0.0), seconds, dt_s)
    t = round(seconds / dt_s) * dt_s
    assert d.sigma_rad == pytest.approx(math.sqrt(FLOOR**2 + UNKNOWN**2 * math.exp(-t / MEMORY_S)), rel=1e-9)
    assert doubted((0.0, 0.0), 120.0, 0.1).sigma_rad == pytest.approx(FLOOR, rel=1e-2)


@settings(max_examples=12, deadline=None)
@given(st.floats(0.1, 20.0), st.floats(0.0, math.tau))
def test_a_steady_disagreement_is_claimed_twice_about_each_axis_and_no_direction_is_better(degrees, way):
    """a about each level axis gives 2 a and the floor; along one direction, the same squares shared by two axes."""
    a = math.radians(degrees)
    each = doubted((a, -a), 400.0, 0.5).sigma_rad
    assert each >= 2.0 * a
    assert each == pytest.approx(math.hypot(2.0 * a, FLOOR), rel=1e-6)
    length = math.sqrt(2.0) * a
    turned = doubted((length * math.cos(way), length * math.sin(way)), 400.0, 0.5).sigma_rad
    assert turned == pytest.approx(each, rel=1e-9)


@pytest.mark.parametrize("tau_s", [1.0, 2.0, 5.0])
def test_the_disagreement_goes_through_both_filters_as_their_closed_form_says(tau_s):
    """x = a (1 - e^(-t/tau)); its square through the memory, as an integral, plus what is left of the beginning."""
    a, seconds, dt = 3.0 * DEG, 9.0, 0.001
    u = (np.arange(round(seconds / dt)) + 0.5) * dt
    seen = ((a * -np.expm1(-u / tau_s)) ** 2 * np.exp((u - seconds) / MEMORY_S)).sum() * dt / MEMORY_S
    before = (0.5 * UNKNOWN) ** 2 * math.exp(-seconds / MEMORY_S)
    want = math.sqrt(FLOOR**2 + 4.0 * (seen + before))
    assert doubted((a, a), seconds, 0.002, tau_s).sigma_rad == pytest.approx(want, rel=1e-3)


def test_noise_of_the_accelerometer_averages_out_over_the_time_in_which_the_tilt_follows():
    """White noise of 4 degrees at 50 Hz through 2 s leaves s sqrt(dt / 2 tau) = 0.28 of them."""
    r, s, dt, tau = np.random.default_rng(5), 4.0 * DEG, 0.02, 2.0
    got = np.mean([doubted(lambda t: tuple(r.normal(0.0, s, 2)), 60.0, dt, tau).sigma_rad ** 2 for _ in range(8)])
    left = s * math.sqrt(dt / (2.0 * tau))
    want = FLOOR**2 + UNKNOWN**2 * math.exp(-60.0 / MEMORY_S) + 4.0 * left**2
    assert got == pytest.approx(want, rel=0.15)
    assert math.sqrt(got) < 0.25 * s


def test_what_swings_slowly_counts_more_than_what_swings_fast():
    """A sine of amplitude a comes through as a / sqrt(1 + (w tau)^2), and its square's mean is half of that's."""
    a, tau = 5.0 * DEG, 2.0
    for w in (0.2, 1.0, 4.0):
        got = np.mean(
            [doubted(lambda t, w=w, b=b: (a * math.sin(w * t + b),) * 2, 100.0, 0.05).sigma_rad ** 2 for b in range(6)]
        )
        want = FLOOR**2 + 4.0 * 0.5 * a**2 / (1.0 + (w * tau) ** 2)
        assert got == pytest.approx(want, rel=0.12), w


@given(st.floats(0.0, 3.0), st.floats(0.0, 0.1), st.sampled_from([0.01, 0.1]))
@settings(max_examples=20, deadline=None)
def test_turning_adds_what_gyro_scale_and_timing_err_by(rate_rads, per_s, dt_s):
    """per_turning_s times the rate, about any axis, filled in as the memory fills."""
    seconds = 30.0
    for way in np.eye(3):
        d = doubted((0.0, 0.0), seconds, dt_s, per_turning_s=per_s, rate=vec3(rate_rads * way, "w"))
        old = math.exp(-seconds / MEMORY_S)
        want = FLOOR**2 + UNKNOWN**2 * old + (per_s * rate_rads) ** 2 * (1.0 - old)
        assert d.sigma_rad == pytest.approx(math.sqrt(want), rel=1e-6)


def test_a_tilt_that_nothing_corrects_any_more_is_not_claimed_to_be_right():
    """A fixed-wing loiter, 20 m/s, without ATTITUDE; a gyro bias of 0.3 deg/s. Six times the sigma is no claim."""
    own, bank, g, dt = _OwnTilt(), math.radians(45.0), 9.80665, 0.02
    turn = g * math.tan(bank) / 20.0
    for i in range(round(81.0 / dt)):
        t, force, rate = i * dt, (0.0, 0.0, -g), (0.0, 0.0, 0.0)
        if 30.0 < t <= 31.0:
            rate = (bank, 0.0, 0.0)
        elif t > 31.0:
            force, rate = (0.0, 0.0, -g / math.cos(bank)), (0.0, turn * math.sin(bank), turn * math.cos(bank))
        rates = np.add(rate, (math.radians(0.3), 0.0, 0.0))
        own.step(InertialReading(1, "RAW_IMU", round((1.0 + t) * 1e9), vec3(force, "f"), vec3(rates, "w")))
    carried = own.at(round(82e9))
    wrong = math.hypot(carried.roll_rad - bank, carried.pitch_rad)
    assert wrong < 4.0 * carried.tilt_sigma_rad


# ---------------------------------------------------------------- standing still


def readings(yaw_rad, seed=0, noise_mg=4.0):
    """Level, on these headings, (N, 3) mG."""
    zero = np.zeros(len(yaw_rad))
    field = field_in_body(Motion(zero, zero, np.asarray(yaw_rad, float)))
    return field + HARD_IRON_MG + np.random.default_rng(seed).normal(0.0, noise_mg, field.shape)


def stillness(z, rates, dt_s=0.1, watch=None):
    watch = watch or Stillness()
    return np.array([watch.step(one, float(w), dt_s) for one, w in zip(z, np.broadcast_to(rates, len(z)), strict=True)])


@pytest.mark.parametrize("noise_mg", [0.0, 1.0])
def test_it_is_still_from_the_first_reading_until_it_is_seen_to_move(noise_mg):
    assert stillness(readings(np.zeros(600), noise_mg=noise_mg), 0.0).all()


def test_noise_of_a_good_sensor_is_no_motion_and_that_of_a_fair_one_seldom_is():
    """A minute on the table, ten seeds. A mean over 1 s leaves a quarter of the noise; the line is at 4 mG."""

    def share(noise_mg):
        return np.mean([stillness(readings(np.zeros(600), seed, noise_mg), 0.0)[100:].mean() for seed in range(10)])

    assert share(1.0) == 1.0 and share(2.0) > 0.97
    assert share(4.0) > 0.85


@pytest.mark.parametrize("hz", [5.0, 10.0, 50.0])
def test_a_turn_of_two_degrees_a_second_is_never_still_for_long_because_the_field_moves(hz):
    """The gyro is not asked: it says nothing turns. 2 deg/s in 205 mG are 7 mG each second."""
    t = np.arange(0.0, 120.0, 1.0 / hz)
    for noise_mg in (0.0, 4.0):
        still = stillness(readings(2.0 * DEG * t, 3, noise_mg), 0.0, 1.0 / hz)[round(3.0 * hz) :]
        assert still.mean() < 0.05, noise_mg
    assert not stillness(readings(2.0 * DEG * t, 3, 0.0), 0.0, 1.0 / hz)[round(3.0 * hz) :].any()


def test_the_gyro_alone_shows_moving_too_where_no_field_moves():
    """Turning about the field's own direction; a bias of 0.5 deg/s of a bad gyro is none."""
    z = readings(np.zeros(300), noise_mg=0.0)
    assert not stillness(z, math.radians(3.0))[30:].any()
    assert stillness(z, math.radians(0.5)).all()


def test_moving_then_still_then_moving():
    """Still three seconds after the mean has settled, some more in noise; moving at once when it begins again."""
    t = np.arange(600) * 0.1
    yaw = np.where(t < 20.0, 0.5 * t, np.where(t < 40.0, 10.0, 10.0 + 0.5 * (t - 40.0)))
    rates = np.where((t < 20.0) | (t >= 40.0), 0.5, 0.0)
    for seed in range(5):
        still = stillness(readings(yaw, seed), rates)
        assert not still[10:200].any()
        begun = int(np.flatnonzero(still[200:])[0])
        assert 30 <= begun <= 120
        assert still[200 + begun : 400].mean() > 0.6
        assert not still[403:].any()


def test_a_gap_in_the_data_is_no_stillness():
    watch = Stillness()
    z = readings(np.zeros(100), noise_mg=0.0)
    stillness(z, 0.0, watch=watch)
    assert not watch.step(z[0], 0.0, 1.5)
    after = stillness(z[:40], 0.0, watch=watch)
    assert not after[:10].any() and after[30:].all()


# ---------------------------------------------------------------- in the estimator


def stands(last, seconds, seed=1, noise_mg=1.0, bias_rads=0.0):
    """Samples of somebody who stays where ``last`` was; the gyro says it turns about down by its bias."""
    r, n, dt = np.random.default_rng(seed), int(seconds * RATE_HZ), 1.0 / RATE_HZ
    down_b = body_from_earth(last.roll_rad, last.pitch_rad, 0.0)[:, 2]
    z = np.array(last.mag_b_mg) + r.normal(0.0, noise_mg, (n, 3))
    return [
        replace(last, boot_ns=last.boot_ns + int((i + 1) * dt * 1e9), dt_s=dt, gap=False, yaw_step_rad=bias_rads * dt,
                rate_b_rads=vec3(bias_rads * down_b, "w"), mag_b_mg=vec3(z[i], "m"))
        for i in range(n)
    ]  # fmt: skip


def resumed(flight, start_ns):
    """The same flight, begun at another time, going on from where it stands."""
    first = flight[0].boot_ns
    return [replace(s, boot_ns=s.boot_ns - first + start_ns, gap=False, dt_s=s.dt_s or 1.0 / RATE_HZ) for s in flight]


@pytest.mark.parametrize("where", ["placed", "nowhere"])
def test_standing_from_the_start_teaches_nothing(where):
    (first,) = samples("figure eight", 7, seconds=1.0)[:1]
    flight = [first, *stands(first, 60.0)]
    e = taught(placed(flight) if where == "placed" else flight)
    assert e.estimate(None) is None
    assert e._bank is None


@pytest.mark.parametrize(
    ("noise_mg", "second"),
    [
        (4.0, False),
        (6.0, False),
        (4.0, True),
    ],
)
def test_standing_from_the_start_in_noise_claims_nothing_it_cannot_know(noise_mg, second):
    """Some of it may pass for motion. No field of nothing comes of it, and no sure iron."""
    (first,) = samples("figure eight", 7, seconds=1.0)[:1]
    for seed in range(2):
        e = taught([first, *stands(first, 120.0, seed, noise_mg)], AdaptiveEstimator(second=second))
        got = e.estimate(None)
        if got is None:
            continue
        mean, p = e._bank.mixture()
        assert abs(mean[at.H] - EXPECTED.horizontal_mg) < 3.0 * math.sqrt(p[at.H, at.H])
        assert np.all(np.abs(got.hard_iron_b_mg - HARD_IRON_MG) < 3.5 * got.own_sigma_mg)
        assert np.all(got.own_sigma_mg > 30.0)


def test_standing_after_a_flight_changes_neither_field_nor_iron():
    """Without a position, so that only what was learnt holds the level field up."""
    flight = samples("figure eight", 8, seconds=30.0)
    e = taught(flight)
    settled = taught(stands(flight[-1], 8.0), e)
    before = settled.estimate(None)
    after = taught(stands(flight[-1], 120.0, 2), settled).estimate(None)
    assert after.horizontal_mg == pytest.approx(before.horizontal_mg, abs=2.0)
    claimed = np.sqrt(np.diag(before.covariance_mg2))
    assert np.all(np.abs(after.hard_iron_b_mg - before.hard_iron_b_mg) < claimed)
    assert np.all(np.diag(after.covariance_mg2) > 0.9 * np.diag(before.covariance_mg2))
    assert after.horizontal_mg == pytest.approx(EXPECTED.horizontal_mg, abs=15.0)


def test_after_a_minute_on_the_table_a_flight_teaches_as_if_there_had_been_none():
    flight = samples("figure eight", 9, seconds=40.0)
    first = flight[0]
    table = [first, *stands(first, 60.0)]
    got = taught(resumed(placed(flight), table[-1].boot_ns + int(1e8)), taught(placed(table))).estimate(EXPECTED)
    plain = taught(placed(flight)).estimate(EXPECTED)
    assert got.hard_iron_b_mg == pytest.approx(plain.hard_iron_b_mg, abs=2.0)
    assert np.all(np.abs(got.hard_iron_b_mg - HARD_IRON_MG) < 4.0 * np.sqrt(np.diag(got.covariance_mg2)) + 1.0)


def test_a_block_counts_exactly_what_its_axes_turned_at_rest():
    r, gathering, total = np.random.default_rng(4), Gathering(), 0.0
    (s,) = samples("figure eight", 5, seconds=1.0)[:1]
    for turned in r.normal(0.0, 0.01, 50):
        gathering.rests(0.1, turned)
        total += turned
    gathering.passes(0.1, np.array((0.0, 0.0, 1.0)), 1e-6)
    gathering.add(s, EARTH_MG, body_from_earth(0.1, 0.2, 0.3), 0.0, 0.0)
    block = gathering.close()
    assert block.turned_rad == pytest.approx(total, abs=1e-12)
    assert block.dt_s == pytest.approx(5.1)
    assert block.down_s == pytest.approx((0.0, 0.0, 0.1))  # the gyro's own bias is not asked for the rest's part
    assert block.turn_rad2 == pytest.approx(1e-6 + 0.02**2)  # so much turning a rest may have hidden
    assert len(gathering) == 0


@pytest.mark.parametrize("bias_rads", [0.0, math.radians(0.7), math.radians(-0.9)])
def test_what_a_biased_gyro_turns_the_own_axes_by_while_it_stands_turns_alpha_as_much(bias_rads):
    """A minute: up to 54 degrees. Without it the heading would be wrong by so much when it takes off again."""
    flight = placed(samples("figure eight", 10, seconds=40.0))
    e = taught(flight[:300])
    standing = stands(flight[299], 60.0, bias_rads=bias_rads)
    counted = 0.0
    for s in standing:
        resting = e._gathering._turned_rad
        e.step(s)
        counted += max(e._gathering._turned_rad - resting, 0.0) - max(resting - e._gathering._turned_rad, 0.0)
    assert counted == pytest.approx(e._gathering._turned_rad)
    assert abs(counted - bias_rads * 60.0) <= abs(bias_rads) * 12.0  # all but the first seconds
    alpha = e._bank.x[:, at.ALPHA].copy()
    one = copy.deepcopy(e)
    one._update = lambda bank, block: None  # only time passes
    again = resumed(flight[300:], standing[-1].boot_ns + int(1e8))
    for s in again[:6]:
        one.step(s)
    moved = one._bank.x[:, at.ALPHA] - alpha - one._bank.x[:, at.G] @ _down_s(again[:6])
    assert moved[0] == pytest.approx(counted, abs=2e-3)
    after = taught(again, e).estimate(EXPECTED)
    # Magnetic north in the own axes: where the first yaw put it, turned by what the gyro made up.
    yaw_rad = MOTIONS["figure eight"](np.arange(400) / RATE_HZ, np.random.default_rng(10)).yaw_rad
    north = math.atan2(EARTH_MG[1], EARTH_MG[0]) - yaw_rad[-1] + e._own_yaw_rad
    assert math.remainder(e._bank.mixture()[0][at.ALPHA] - north, math.tau) == pytest.approx(0.0, abs=1.0 * DEG)
    assert np.all(np.abs(after.hard_iron_b_mg - HARD_IRON_MG) < 4.0 * np.sqrt(np.diag(after.covariance_mg2)) + 1.0)


def _down_s(flight):
    """Integral of down over the first samples, as far as the state has been carried, (3,)."""
    return sum(s.dt_s * body_from_earth(s.roll_rad, s.pitch_rad, 0.0)[:, 2] for s in flight)
