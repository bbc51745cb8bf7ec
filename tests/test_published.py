"""The heading that goes out: as measured, through the live filter, or a fixed lag late; never across a silence."""

import math

import numpy as np
import pytest
from memory_flight import Bench, flight

from magmav.core.heading import UNKNOWN
from magmav.core.published import SMOOTHINGS, Publisher
from magmav.core.rotation import wrap_tau
from magmav.core.types import Heading
from magmav.settings import Settings, SettingsError, with_value

NOISE = math.radians(2.0)
DECLINATION = math.radians(-11.0)
DT = 0.1


def turning(n=300, seed=1, rate_dps=12.0):
    """Headings through 360 degrees with 2 degrees of noise, (measured, true magnetic)."""
    rng = np.random.default_rng(seed)
    true = np.radians(350.0 + rate_dps * DT * np.arange(n))
    return [said(v) for v in true + rng.normal(0.0, NOISE, n)], true


def said(magnetic):
    return Heading(True, True, wrap_tau(magnetic), wrap_tau(magnetic + DECLINATION), 0.05)


def ns(i):
    return round(i * DT * 1e9)


def run(publisher, headings):
    return [publisher.step(ns(i), h, NOISE) for i, h in enumerate(headings)]


def errors(out, true):
    """Against the truth of the time each value says it belongs to, rad."""
    return np.array([math.remainder(h.magnetic_rad - true[round(at / 1e9 / DT)], math.tau) for h, at in out if h.valid])


def test_off_is_the_heading_itself():
    headings, _ = turning()
    assert run(Publisher(), headings) == [(h, ns(i)) for i, h in enumerate(headings)]


@pytest.mark.parametrize("smoothing", SMOOTHINGS[1:])
def test_smoothing_takes_noise_out_and_never_jumps_at_north(smoothing):
    headings, true = turning()
    out = run(Publisher(smoothing, lag=10), headings)
    raw = math.sqrt(np.mean(errors([(h, ns(i)) for i, h in enumerate(headings)], true) ** 2))
    assert math.sqrt(np.mean(errors(out, true)[50:] ** 2)) < (0.75 if smoothing == "kalman" else 0.5) * raw


def test_a_fixed_lag_says_how_late_it_is_and_is_silent_until_its_window_is_full():
    headings, _ = turning()
    out = run(Publisher("fixed_lag", lag=10), headings)
    assert [h.valid for h, _ in out[:11]] == [False] * 10 + [True]
    assert [at for h, at in out if h.valid] == [ns(i) for i in range(len(headings) - 10)]


@pytest.mark.parametrize("smoothing", SMOOTHINGS)
def test_true_is_magnetic_and_the_declination_whatever_is_smoothed(smoothing):
    headings, _ = turning()
    for h, _ in run(Publisher(smoothing), headings):
        if h.valid:
            assert math.remainder(h.true_rad - h.magnetic_rad - DECLINATION, math.tau) == pytest.approx(0.0, abs=1e-12)
            assert h.sigma_rad == 0.05


@pytest.mark.parametrize("smoothing", SMOOTHINGS)
def test_what_is_not_known_is_not_published_and_what_was_before_is_forgotten(smoothing):
    headings, _ = turning(40)
    broken = [*headings[:20], UNKNOWN, *headings[20:]]
    out = run(Publisher(smoothing), broken)
    assert not out[20][0].valid
    fresh = Publisher(smoothing)
    assert [h for h, _ in out[21:]] == [fresh.step(ns(21 + i), h, NOISE)[0] for i, h in enumerate(headings[20:])]


@pytest.mark.parametrize("smoothing", SMOOTHINGS)
def test_after_a_silence_nothing_from_before_it_goes_out_as_new(smoothing):
    """S12: a minute without a compass, and then the window of before it is final: but it is a minute old."""
    headings, _ = turning(80)
    publisher = Publisher(smoothing)
    for i, h in enumerate(headings[:40]):
        publisher.step(ns(i), h, NOISE)
    for i, h in enumerate(headings[40:]):
        now = ns(640 + i)
        got, at = publisher.step(now, h, NOISE)
        assert not got.valid or now - at < 1.5e9


def test_a_lag_of_minutes_is_never_published_as_the_heading():
    publisher = Publisher("fixed_lag", lag=200)
    headings, _ = turning(400)
    out = [publisher.step(round(i * 0.5e9), h, NOISE) for i, h in enumerate(headings)]
    assert not any(h.valid for h, _ in out)


def test_the_service_publishes_what_the_setting_says():
    """Same flight, three settings: measured headings are bit for bit the same, published ones are not."""
    frames = flight(seconds=20.0)
    runs = {s: Bench(with_value(Settings(), "heading", "smooth", s)).play(frames) for s in SMOOTHINGS}
    assert all([r.heading for r in records] == [r.heading for r in runs["off"]] for records in runs.values())
    assert [r.published for r in runs["off"]] == [r.heading for r in runs["off"]]
    late = [(r.boot_ns, r.published_boot_ns) for r in runs["fixed_lag"] if r.published.valid]
    assert len(late) > 100
    assert all(now - then == pytest.approx(0.4e9, abs=0.05e9) for now, then in late)  # 10 samples at 25 Hz
    assert [r.published for r in runs["kalman"]][100] != runs["off"][100].published


def test_a_smoothing_nobody_has_heard_of_is_refused():
    with pytest.raises(ValueError, match="moving_average"):
        Publisher("moving_average")
    with pytest.raises(SettingsError, match="moving_average"):
        with_value(Settings(), "heading", "smooth", "moving_average")
