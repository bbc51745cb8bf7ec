"""benchmarks/papers.py reproduces what it says it does, and docs/methods.md shows what it prints."""

import importlib.util
import math
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from magmav.core import marg
from magmav.core.dip import dip_from_latitude
from magmav.core.smoothing import noise_reduction
from magmav.core.two_axis import worst_turn_per_dip

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "methods.md"
SCRIPT = ROOT / "benchmarks" / "papers.py"

spec = importlib.util.spec_from_file_location("papers", SCRIPT)
papers = importlib.util.module_from_spec(spec)
sys.modules["papers"] = papers  # or its functions could not be sent to another process
spec.loader.exec_module(papers)


def between(page, name):
    """What stands between two markers of the page."""
    got = re.search(rf"<!-- {name} -->\n(.*?)<!-- end {name} -->", page, flags=re.S)
    assert got is not None, name
    return got[1].strip()


# ---------------------------------------------------------------- the page


@pytest.mark.long
def test_the_page_shows_what_the_command_prints():
    done = subprocess.run([sys.executable, str(SCRIPT), "--markdown"], capture_output=True, text=True, check=True)
    assert between(PAGE.read_text(encoding="utf-8"), "papers") == done.stdout.strip()


def test_every_picture_of_the_page_is_there_and_small_and_every_picture_is_on_the_page():
    shown = set(re.findall(r"\]\((methods/\w+\.png)\)", PAGE.read_text(encoding="utf-8")))
    there = {f"methods/{p.name}" for p in (PAGE.parent / "methods").glob("*.png")}
    assert shown == there
    assert all((PAGE.parent / name).stat().st_size < 150_000 for name in there)


# ---------------------------------------------------------------- Sawicki


@pytest.mark.parametrize("seed", range(3))
def test_the_spikes_are_those_the_table_implies(seed):
    """Whatever the noise: method I to the printed digit, II and III within a count and one with the other."""
    points = papers.spiked(seed=seed)
    one, two, three = (papers.fitted_points(m, points, 1500.0) for m in ("minmax", "kasa", "bullock"))
    assert one.centre == pytest.approx(papers.PRINTED_I[:2], abs=1e-9)
    assert points[:, 0].max() - one.centre[0] == pytest.approx(papers.PRINTED_I[2], abs=1e-9)
    assert [*two.centre, two.radius] == pytest.approx(papers.PRINTED_II, abs=1.0)
    assert np.append(two.centre - three.centre, two.radius - three.radius) == pytest.approx(0.0, abs=1e-9)
    assert math.dist(one.centre, two.centre) > 100.0


def test_without_the_spikes_all_three_agree():
    """The shift is theirs and not that of the noise beside them."""
    points = papers.spiked()[np.setdiff1d(np.arange(1000), (0, 250, 500))]
    centres = [papers.fitted_points(m, points, 1500.0).centre for m in ("minmax", "kasa", "bullock")]
    assert np.ptp(centres, axis=0).max() < 5.0


# ---------------------------------------------------------------- Sytnyk


def test_the_printed_dip():
    assert math.degrees(dip_from_latitude(math.radians(49.2))) == pytest.approx(66.6555313904272, abs=1e-10)


def test_a_wrong_dip_costs_as_the_formula_says():
    """Worst of all headings, over a small error of dip: sec^2 I tan(tilt)."""
    tilt, error = math.radians(20.0), 1e-4
    cost = papers.worst_heading_error(tilt, 0.0, papers.INCLINATION, error) / error
    assert cost == pytest.approx(worst_turn_per_dip(tilt, papers.INCLINATION), rel=2e-3)
    assert math.isnan(papers.worst_heading_error(math.radians(61.0), 0.0, papers.INCLINATION, error))


def test_any_noise_reduction_can_be_chosen():
    """4000 values of a still field; the share of those that is independent lets 10 % stand."""
    for factor in (1.5, 2.5, 4.0):
        assert papers.still(factor) == pytest.approx(factor, rel=0.1)


def test_the_channel_filter_run_back_over_itself_is_rts():
    """Of a random walk seen in noise, once the gain has settled: the most likely path of all, by least squares."""
    n, sigma = 60, 2.0
    _, q_over_r = noise_reduction(2.5)
    seen = 200.0 + np.random.default_rng(3).normal(0.0, sigma, (n, 2))
    got = papers.channels(papers.channels(seen, sigma)[::-1], sigma)[::-1]
    step = np.diff(np.eye(n), axis=0) / math.sqrt(q_over_r)
    want = np.linalg.solve(np.eye(n) + step.T @ step, seen)
    middle = slice(20, -20)  # the ends begin from one value, and the gain with it
    assert got[middle] == pytest.approx(want[middle], abs=0.02)
    assert np.abs(seen - want)[middle].max() > 1.0


def test_a_flight_is_made_better_by_the_filter_and_better_still_by_rts():
    flight = papers.flown(3)
    assert flight.raw.rms == pytest.approx(papers.SIGMA_DEG, rel=0.05)
    assert flight.kalman.rms < 0.65 * flight.raw.rms
    assert flight.rts.rms < 0.35 * flight.raw.rms
    assert flight.rts_from_raw.rms > flight.kalman_from_raw.rms  # the paper's own yardstick prefers the worse


def test_deviation_stays_through_rts():
    """A sine of 1.57 degrees has a mean size of 1.00, and that much is left."""
    left = papers.deviating(1)
    assert left.mean == pytest.approx(papers.DEVIATION_DEG * 2.0 / math.pi, abs=0.05)
    assert 1.7 < left.worst < 2.3


# ---------------------------------------------------------------- MARG


@pytest.mark.parametrize("component", [1e-6, 8.33e-4, 0.0425])
def test_a_mean_component_as_a_rotation(component):
    """Over axes drawn evenly in all four directions the mean component of a turn is what it is converted from."""
    r = np.random.default_rng(6)
    angle = math.radians(papers.rotation_deg(component))
    length = 2.0 * math.sin(angle / 4.0)
    directions = r.normal(size=(20000, 4))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    assert length * np.abs(directions).mean() == pytest.approx(component, rel=0.01)


def test_the_printed_error_of_the_dynamic_reference_is_the_floor_of_a_normalised_step():
    assert pytest.approx(0.0425, abs=1e-4) == papers.FLOOR
    floors = [
        papers.path(papers.task(s, 40.0), papers.NORMALISED, d, 80)[-30:] for s in range(6) for d in (True, False)
    ]
    assert np.mean(floors) == pytest.approx(papers.FLOOR, rel=0.15)
    plain = [papers.path(papers.task(s, 40.0), papers.PLAIN, d, 80)[-1] for s in range(6) for d in (True, False)]
    assert max(plain) < 0.1 * papers.FLOOR


def test_neither_reference_gains_on_the_other_as_plain_steps_go_on():
    """One slow mode: the ratio of the errors settles, at one value for each start, and about as often below 1."""
    settled = []
    for seed in range(8):
        t = papers.task(seed, 45.0)
        dynamic, direct = (papers.path(t, papers.PLAIN, d, 120) for d in (True, False))
        settled.append(dynamic[-1] / direct[-1])
        assert settled[-1] == pytest.approx(dynamic[-20] / direct[-20], rel=0.02)
    assert min(settled) < 1.0 < max(settled)
    assert 1.0 / 3.0 < np.exp(np.mean(np.log(settled))) < 3.0


def test_a_frozen_reference_settles_elsewhere():
    t = papers.task(2, 45.0)
    end = papers.path(t, papers.PLAIN, False, 200, frozen=True)
    assert end[-1] == pytest.approx(end[-50], rel=1e-3)
    assert end[-1] > 1e3 * papers.path(t, papers.PLAIN, False, 200)[-1]


def test_steps_to_a_tolerance_are_counted_as_solve_counts_them():
    """The last step of solve moves nothing, so the one before it was there."""
    t = papers.task(1, 45.0)
    (count,) = papers.steps_to(t, papers.NEWTON, False, (1e-12,))
    assert count <= 5
    assert marg.solve(t.start, t.pair, papers.NEWTON, tolerance=1e-12).steps - count in (0, 1)
    assert papers.steps_to(t, papers.NEWTON, True, (1e-2, 1e-4, 1e-300), limit=40)[2] == 40
