"""Heading filter and smoothers against the seed numbers, plain algebra, and the truth."""

import copy
import math
import pickle

import numpy as np
import pytest
import seed_vectors
from hypothesis import given, settings
from hypothesis import strategies as st

from magmav.core.smoothing import ChannelFilter, FixedLagSmoother, HeadingFilter, Motion, noise_reduction, smooth

SEED = seed_vectors.load()
SIGMA = math.radians(1.25)


def wrapped(angle):
    """The angle in (-pi, pi], numbers or arrays."""
    return np.remainder(np.asarray(angle) + np.pi, 2.0 * np.pi) - np.pi


def run(heading, boot_s, psi, sigma):
    return [heading.step(float(t), float(z), float(s)) for t, z, s in zip(boot_s, psi, sigma, strict=True)]


def lagged(smoother, boot_s, psi, sigma):
    out = [one for step in run(smoother, boot_s, psi, sigma) for one in step]
    return out + smoother.finish()


def column(rows, name):
    return np.array([getattr(row, name) for row in rows])


def uneven(n=60, seed=0):
    """Uneven times, sigmas and turns through north: what a telemetry link gives. All under half a turn a step."""
    r = np.random.default_rng(seed)
    boot_s = 100.0 + np.cumsum(r.uniform(0.02, 0.5, n))
    sigma = np.radians(r.uniform(0.5, 4.0, n))
    psi = math.radians(300.0) + 0.4 * boot_s + 0.6 * np.sin(boot_s) + r.normal(0.0, sigma)
    return boot_s, np.remainder(psi, math.tau), sigma


# ---------------------------------------------------------------- other people's numbers


def seed_case():
    case = SEED["kf_rts"]
    n = len(case["z_deg"])
    motion = Motion(math.radians(math.sqrt(case["q"])) ** 2, math.radians(math.sqrt(case["P0"][1])))
    sigma = np.full(n, math.radians(math.sqrt(case["R"])))
    return case, motion, (case["dt"] * np.arange(n), np.radians(case["z_deg"]), sigma)


def same_as_printed(rows, case, name):
    assert np.degrees(column(rows, "heading_rad")) == pytest.approx(case[f"{name}_psi"], abs=1e-10)
    assert np.degrees(column(rows, "rate_rads")) == pytest.approx(case[f"{name}_rate"], abs=1e-10)
    assert np.degrees(column(rows, "sigma_rad")) ** 2 == pytest.approx(case[f"{name}_P11"], abs=1e-10)


def test_filter_and_smoother_give_the_seed_numbers():
    case, motion, heard = seed_case()
    same_as_printed(run(HeadingFilter(motion), *heard), case, "kf")
    same_as_printed(smooth(*heard, motion), case, "rts")


def test_a_lag_longer_than_the_flight_is_the_whole_smoother():
    case, motion, heard = seed_case()
    for lag in (7, 50):
        same_as_printed(lagged(FixedLagSmoother(lag, motion), *heard), case, "rts")


@pytest.mark.parametrize("case", SEED["rw_gain"], ids=lambda c: f"{c['reduction']:g}")
def test_the_gain_for_a_wanted_noise_reduction(case):
    assert noise_reduction(case["reduction"]) == pytest.approx((case["K"], case["Q_over_R"]), rel=1e-14)


# ---------------------------------------------------------------- plain algebra


def plain_filter(boot_s, z, sigma, motion):
    """The same filter on unwrapped headings, in plain numpy and the short covariance form."""
    x, p = np.array([z[0], 0.0]), np.diag([sigma[0] ** 2, motion.rate_sigma_rads**2])
    out = [(x, p)]
    for k in range(1, len(z)):
        dt = boot_s[k] - boot_s[k - 1]
        f = np.array([[1.0, dt], [0.0, 1.0]])
        p = f @ p @ f.T + motion.q_rad2ps3 * np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
        x = f @ x
        gain = p[:, 0] / (p[0, 0] + sigma[k] ** 2)
        x = x + gain * (z[k] - x[0])
        p = p - np.outer(gain, p[0])
        out.append((x, p))
    return out


@pytest.mark.parametrize("seed", range(4))
def test_filterpy_agrees_with_plain_algebra_step_for_step(seed):
    boot_s, z, sigma = uneven(seed=seed)
    motion = Motion()
    got = run(HeadingFilter(motion), boot_s, z, sigma)
    for one, (x, p) in zip(got, plain_filter(boot_s, np.unwrap(z), sigma, motion), strict=True):
        assert wrapped(one.heading_rad - x[0]) == pytest.approx(0.0, abs=1e-9)
        assert one.rate_rads == pytest.approx(x[1], abs=1e-9)
        assert one.sigma_rad == pytest.approx(math.sqrt(p[0, 0]), abs=1e-9)


def batch(boot_s, z, sigma, motion):
    """The most likely states of all times at once: every equation of the model, whitened, in one least squares."""
    n = len(z)
    rows, right = [], []

    def say(matrix, value, covariance):
        root = np.linalg.inv(np.linalg.cholesky(covariance))
        rows.append(root @ matrix)
        right.append(root @ value)

    def at(k, block):
        out = np.zeros((len(block), 2 * n))
        out[:, 2 * k : 2 * k + 2] = block
        return out

    say(at(0, np.eye(2)), np.array([z[0], 0.0]), np.diag([sigma[0] ** 2, motion.rate_sigma_rads**2]))
    for k in range(1, n):
        dt = boot_s[k] - boot_s[k - 1]
        step = at(k, np.eye(2)) - at(k - 1, np.array([[1.0, dt], [0.0, 1.0]]))
        say(step, np.zeros(2), motion.q_rad2ps3 * np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]]))
        say(at(k, np.array([[1.0, 0.0]])), z[k : k + 1], np.array([[sigma[k] ** 2]]))
    a = np.vstack(rows)
    x = np.linalg.lstsq(a, np.concatenate(right), rcond=None)[0].reshape(n, 2)
    _, r = np.linalg.qr(a)
    inverse = np.linalg.inv(r)
    return x, np.sqrt(np.sum(inverse**2, axis=1)).reshape(n, 2)[:, 0]


@pytest.mark.parametrize("seed", range(4))
def test_rts_is_the_most_likely_flight_of_all(seed):
    """Uneven steps, so that F and Q taken from the neighbouring step (filterpy's trap) would show."""
    boot_s, z, sigma = uneven(seed=seed)
    want, want_sigma = batch(boot_s, np.unwrap(z), sigma, Motion())
    got = smooth(boot_s, z, sigma)
    assert wrapped(column(got, "heading_rad") - want[:, 0]) == pytest.approx(0.0, abs=1e-9)
    assert column(got, "rate_rads") == pytest.approx(want[:, 1], abs=1e-9)
    assert column(got, "sigma_rad") == pytest.approx(want_sigma, abs=1e-9)


def test_the_trap_is_one_that_shows():
    """With every step's F and Q moved by one, the answer of the same flight is far off: the test above can fail."""
    boot_s, z, sigma = uneven()
    moved = np.concatenate([boot_s[:1], boot_s[0] + np.cumsum(np.roll(np.diff(boot_s), -1))])
    want, _ = batch(moved, np.unwrap(z), sigma, Motion())
    assert np.abs(wrapped(column(smooth(boot_s, z, sigma), "heading_rad") - want[:, 0])).max() > 1e-3


@pytest.mark.parametrize("lag", [1, 2, 7, 25])
def test_fixed_lag_is_rts_over_the_states_heard_so_far(lag):
    """Value k is handed out when k + lag has been heard: it is RTS of everything up to there, at k."""
    boot_s, z, sigma = uneven(n=45, seed=5)
    smoother, handed = FixedLagSmoother(lag), []
    for k in range(45):
        got = smoother.step(boot_s[k], z[k], sigma[k])
        handed += got
        want = smooth(boot_s[: k + 1], z[: k + 1], sigma[: k + 1])
        for one, other in zip(smoother.window(), want[-lag - 1 :], strict=True):
            assert one.boot_s == other.boot_s
            assert wrapped(one.heading_rad - other.heading_rad) == pytest.approx(0.0, abs=1e-9)
            assert one.rate_rads == pytest.approx(other.rate_rads, abs=1e-9)
            assert one.sigma_rad == pytest.approx(other.sigma_rad, abs=1e-9)
        assert got == ([] if k < lag else [smoother.window()[0]])
    handed += smoother.finish()
    assert column(handed, "boot_s").tolist() == boot_s.tolist()
    assert smoother.finish() == []


# ---------------------------------------------------------------- angles that wrap, time that jumps


def test_a_steady_turn_through_north_leaves_no_trace():
    """30 degrees a second, no noise: the end is exact, the rate too, and nothing jumps at 360."""
    t = 0.1 * np.arange(300)
    psi = math.radians(340.0) + math.radians(30.0) * t
    for rows in (
        run(HeadingFilter(), t, np.remainder(psi, math.tau), np.full(300, 0.01)),
        smooth(t, np.remainder(psi, math.tau), np.full(300, 0.01)),
        lagged(FixedLagSmoother(10), t, np.remainder(psi, math.tau), np.full(300, 0.01)),
    ):
        off = wrapped(column(rows, "heading_rad") - psi)
        assert off[150:] == pytest.approx(0.0, abs=1e-6)
        assert column(rows, "rate_rads")[150:] == pytest.approx(math.radians(30.0), abs=1e-6)
        assert np.abs(off).max() < 0.01
        assert column(rows, "heading_rad").min() >= 0.0
        assert column(rows, "heading_rad").max() < math.tau


@settings(max_examples=25)
@given(st.floats(-20.0, 20.0), st.integers(-3, 3))
def test_turning_north_turns_the_answer(turned_rad, turns):
    boot_s, z, sigma = uneven(n=20, seed=2)
    want = smooth(boot_s, z, sigma)
    got = smooth(boot_s, z + turned_rad + turns * math.tau, sigma)
    off = column(got, "heading_rad") - column(want, "heading_rad") - turned_rad
    assert wrapped(off) == pytest.approx(0.0, abs=1e-9)
    assert column(got, "rate_rads") == pytest.approx(column(want, "rate_rads"), abs=1e-9)
    assert column(got, "sigma_rad") == pytest.approx(column(want, "sigma_rad"), abs=1e-12)


def test_the_mirror_image_flight_gives_the_mirror_image():
    boot_s, z, sigma = uneven(seed=3)
    want, got = smooth(boot_s, z, sigma), smooth(boot_s, -z, sigma)
    assert wrapped(column(got, "heading_rad") + column(want, "heading_rad")) == pytest.approx(0.0, abs=1e-9)
    assert column(got, "rate_rads") == pytest.approx(-column(want, "rate_rads"), abs=1e-9)


def test_smoothing_backwards_in_time_is_smoothing():
    """No direction of time is left in the answer, but for the prior, which is made to mean nothing here."""
    boot_s, z, sigma = uneven(seed=7)
    motion = Motion(rate_sigma_rads=1e4)
    want = smooth(boot_s, z, sigma, motion)
    got = smooth(boot_s[-1] - boot_s[::-1], z[::-1], sigma[::-1], motion)[::-1]
    assert wrapped(column(got, "heading_rad") - column(want, "heading_rad")) == pytest.approx(0.0, abs=1e-6)
    assert column(got, "rate_rads") == pytest.approx(-column(want, "rate_rads"), abs=1e-5)
    assert column(got, "sigma_rad") == pytest.approx(column(want, "sigma_rad"), abs=1e-6)


@pytest.mark.parametrize("jump_s", [2.5, 1000.0, -0.1, -90.0], ids=["gap", "long gap", "step back", "reboot"])
def test_after_a_gap_or_a_reboot_all_begins_anew(jump_s):
    """What comes after is as if it were all there is, and what was before is not touched by it."""
    boot_s, z, sigma = uneven(n=40, seed=4)
    boot_s[20:] += jump_s - (boot_s[20] - boot_s[19])
    before, after = (boot_s[:20], z[:20], sigma[:20]), (boot_s[20:], z[20:], sigma[20:])
    assert run(HeadingFilter(), boot_s, z, sigma)[20:] == run(HeadingFilter(), *after)
    assert smooth(boot_s, z, sigma) == smooth(*before) + smooth(*after)
    halves = lagged(FixedLagSmoother(6), *before) + lagged(FixedLagSmoother(6), *after)
    assert lagged(FixedLagSmoother(6), boot_s, z, sigma) == halves


def test_a_gap_that_is_bridged_makes_the_heading_less_sure():
    steps = HeadingFilter()
    sure = [steps.step(0.1 * k, 1.0, 0.02) for k in range(50)][-1].sigma_rad
    assert steps.step(4.9 + 1.9, 1.0, 0.5).sigma_rad > 3.0 * sure


def test_two_readings_of_one_moment_count_as_two():
    once, twice = HeadingFilter(), HeadingFilter()
    for k in range(30):
        once.step(0.1 * k, 1.0, 0.02 / math.sqrt(2.0))
        twice.step(0.1 * k, 1.0 - 0.01, 0.02)
        got = twice.step(0.1 * k, 1.0 + 0.01, 0.02)
    want = once.step(3.0, 1.0, 0.02 / math.sqrt(2.0))
    twice.step(3.0, 0.99, 0.02)
    got = twice.step(3.0, 1.01, 0.02)
    assert got.heading_rad == pytest.approx(want.heading_rad, abs=1e-4)
    assert got.sigma_rad == pytest.approx(want.sigma_rad, rel=1e-6)


def test_one_reading_or_none():
    assert smooth([], [], []) == []
    (only,) = smooth([5.0], [7.0], [0.1])
    assert (only.boot_s, only.rate_rads) == (5.0, 0.0)
    assert only.heading_rad == pytest.approx(7.0 - math.tau)
    assert only.sigma_rad == pytest.approx(0.1)


# ---------------------------------------------------------------- against the truth


def matching(seed, n=30):
    """A flight of just the motion the filter takes for granted, steps uneven."""
    r, motion = np.random.default_rng(seed), Motion()
    boot_s = np.cumsum(r.uniform(0.05, 0.3, n))
    x = np.array([r.uniform(0.0, math.tau), r.normal(0.0, motion.rate_sigma_rads)])
    truth = [x]
    for dt in np.diff(boot_s):
        q = motion.q_rad2ps3 * np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
        x = np.array([[1.0, dt], [0.0, 1.0]]) @ x + np.linalg.cholesky(q) @ r.normal(size=2)
        truth.append(x)
    psi = np.array(truth)[:, 0]
    sigma = np.radians(r.uniform(0.5, 3.0, n))
    return psi, (boot_s, np.remainder(psi + r.normal(0.0, sigma), math.tau), sigma)


def test_sigma_is_honest_for_filter_lag_and_smoother():
    """90 flights, error over sigma squared: 1 in the mean. 90 draws know that to 15 % at any one time."""
    squares = {"filter": [], "lag": [], "rts": []}
    for seed in range(90):
        psi, heard = matching(seed)
        for name, rows in (
            ("filter", run(HeadingFilter(), *heard)),
            ("lag", lagged(FixedLagSmoother(6), *heard)),
            ("rts", smooth(*heard)),
        ):
            off = wrapped(column(rows, "heading_rad") - psi) / column(rows, "sigma_rad")
            squares[name].append(off[4::5] ** 2)
    for name, got in squares.items():
        per_time = np.mean(got, axis=0)
        assert np.mean(per_time) == pytest.approx(1.0, abs=0.15), name
        assert per_time.min() > 0.5, name
        assert per_time.max() < 1.6, name


def turns(seed, n):
    """10 Hz, rates up to 20 deg/s that change within seconds: the paper's drive as far as it is told."""
    r = np.random.default_rng(seed)
    t = 0.1 * np.arange(n)
    knots = np.cumsum(r.uniform(2.0, 8.0, 100))
    rate = np.interp(t, knots, np.radians(r.uniform(-20.0, 20.0, 100)))
    psi = r.uniform(0.0, math.tau) + 0.1 * np.cumsum(rate)
    return psi, (t, np.remainder(psi + r.normal(0.0, SIGMA, n), math.tau), np.full(n, SIGMA))


def rms(rows, psi):
    return math.sqrt(np.mean(wrapped(column(rows, "heading_rad") - psi) ** 2))


@pytest.mark.parametrize("seed", range(2))
def test_noise_is_reduced_as_the_paper_reports(seed):
    """Sigma 1.25 deg, q = 16 deg^2/s^3, against the truth: the paper's bounds of 3 and 1.8 degrees hold as bounds."""
    psi, heard = turns(seed, n=1200)
    live, after, lag = run(HeadingFilter(), *heard), smooth(*heard), lagged(FixedLagSmoother(10), *heard)
    assert rms(live, psi) < 0.65 * SIGMA
    assert rms(after, psi) < 0.35 * SIGMA
    assert rms(lag, psi) < 1.1 * rms(after, psi)  # a second of lag is nearly all there is to gain
    worst = np.degrees([np.abs(wrapped(column(rows, "heading_rad") - psi)).max() for rows in (live, after)])
    assert worst[0] < 4.5
    assert worst[1] < 2.5


def test_smoothing_does_not_take_out_deviation():
    """An error that turns with the heading is no noise: 1.57 degrees of it stay."""
    psi, (t, _, sigma) = turns(1, n=600)
    deviation = math.radians(1.57) * np.sin(psi)
    got = smooth(t, np.remainder(psi + deviation, math.tau), sigma)
    assert rms(got, psi) > 0.8 * math.sqrt(np.mean(deviation**2))


# ---------------------------------------------------------------- the paper's channels


def test_noise_of_a_still_field_is_reduced_by_the_factor():
    """6000 steps of which some 800 are independent: the factor is known to 2.5 %."""
    r, channels, got = np.random.default_rng(3), ChannelFilter(5.0, 2.5), []
    for noise in r.normal(0.0, 5.0, (6000, 2)):
        channels.step(200.0 + noise[0], noise[1])
        got.append(channels.field_mg)
    assert 5.0 / np.std(got[100:], axis=0) == pytest.approx([2.5, 2.5], rel=0.08)


@pytest.mark.parametrize("rate_deg", [-60.0, 10.0, 20.0])
@pytest.mark.parametrize("factor", [1.5, 2.5, 4.0])
def test_channels_lag_and_shrink_as_a_first_order_filter_does(rate_deg, factor):
    """Closed form: z <- (1 - K) z + K u with u turning by a per step settles at K / (1 - (1 - K) e^(-i a)) u."""
    k, _ = noise_reduction(factor)
    a = math.radians(rate_deg) * 0.1
    response = k / (1.0 - (1.0 - k) * np.exp(-1j * a))
    channels = ChannelFilter(5.0, factor)
    for step in range(600):
        psi = a * step
        got = channels.step(200.0 * math.cos(psi), -200.0 * math.sin(psi))
    assert wrapped((got or 0.0) - psi) == pytest.approx(np.angle(response), abs=1e-9)
    assert math.hypot(*channels.field_mg) == pytest.approx(200.0 * abs(response), rel=1e-9)


def test_the_lag_of_the_papers_choice():
    """(1 - K) / K steps: 2.6 degrees at 10 deg/s and 10 Hz, where the filter that knows the rate has none."""
    channels, heading = ChannelFilter(5.0), HeadingFilter()
    for step in range(400):
        psi = math.radians(1.0) * step
        behind = psi - (channels.step(200.0 * math.cos(psi), -200.0 * math.sin(psi)) or 0.0)
        with_rate = psi - heading.step(0.1 * step, psi, 0.02).heading_rad
    assert math.degrees(wrapped(behind)) == pytest.approx(2.62, abs=0.01)
    assert math.degrees(wrapped(with_rate)) == pytest.approx(0.0, abs=1e-6)


def test_channels_without_a_field_have_no_heading():
    assert ChannelFilter(5.0).step(0.0, 0.0) is None


# ---------------------------------------------------------------- stopping, going on, and wrong calls


@pytest.mark.parametrize("make", [HeadingFilter, lambda: FixedLagSmoother(5)], ids=["filter", "lag"])
@pytest.mark.parametrize("way", [copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))], ids=["copy", "pickle"])
def test_stopping_and_going_on_changes_no_bit(make, way):
    boot_s, z, sigma = uneven(seed=8)
    straight, half = make(), make()
    want = run(straight, boot_s, z, sigma)
    first = run(half, boot_s[:30], z[:30], sigma[:30])
    assert first + run(way(half), boot_s[30:], z[30:], sigma[30:]) == want


@pytest.mark.parametrize("way", [copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))], ids=["copy", "pickle"])
def test_channels_go_on_to_the_same_bits(way):
    field = np.random.default_rng(5).normal(100.0, 30.0, (40, 2)).tolist()
    straight, half = ChannelFilter(5.0), ChannelFilter(5.0)
    want = [straight.step(*row) for row in field]
    got = [half.step(*row) for row in field[:20]]
    assert [*got, way(half).step(*field[20])] == want[:21]


@pytest.mark.parametrize(
    ("values", "name"),
    [((math.nan, 1.0, 0.1), "boot_s"), ((0.0, math.inf, 0.1), "heading_rad"), ((0.0, 1.0, math.nan), "sigma_rad"),
     ((0.0, 1.0, 0.0), "sigma_rad"), ((0.0, 1.0, -0.1), "sigma_rad")],
)  # fmt: skip
def test_a_wrong_reading_is_refused_by_name_and_leaves_no_trace(values, name):
    boot_s, z, sigma = uneven(n=20)
    heading, lag = HeadingFilter(), FixedLagSmoother(3)
    run(heading, boot_s[:10], z[:10], sigma[:10])
    run(lag, boot_s[:10], z[:10], sigma[:10])
    for one in (heading, lag):
        with pytest.raises(ValueError, match=name):
            one.step(*values)
    with pytest.raises(ValueError, match=name):
        smooth(*([value] for value in values))
    assert run(heading, boot_s[10:], z[10:], sigma[10:]) == run(HeadingFilter(), boot_s, z, sigma)[10:]
    assert run(lag, boot_s[10:], z[10:], sigma[10:]) == run(FixedLagSmoother(3), boot_s, z, sigma)[10:]


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: Motion(q_rad2ps3=0.0), "q_rad2ps3"),
        (lambda: Motion(rate_sigma_rads=math.nan), "rate_sigma_rads"),
        (lambda: Motion(gap_s=-1.0), "gap_s"),
        (lambda: FixedLagSmoother(0), "lag"),
        (lambda: ChannelFilter(0.0), "sigma_mg"),
        (lambda: ChannelFilter(5.0, 1.0), "factor"),
        (lambda: noise_reduction(math.inf), "factor"),
        (lambda: smooth([0.0, 1.0], [0.0], [0.1]), "lengths differ: 2 times, 1 headings, 1 sigmas"),
    ],
)
def test_settings_that_cannot_be_are_refused_by_name(make, name):
    with pytest.raises(ValueError, match=name):
        make()
