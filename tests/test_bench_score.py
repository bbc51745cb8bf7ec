"""Scores, peers and tables of the estimators' benchmark."""

import dataclasses
import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from magmav.core.estimators.kalman import KalmanEstimator

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import estimators
from estimator_bench import peers
from estimator_bench.flights import true_flight
from estimator_bench.peer_runs import NAMES, Ready, peer_scores
from estimator_bench.pins import IRON_MG, pins, tumble
from estimator_bench.running import TICK_S, Run, Tick, run, tape
from estimator_bench.scenarios import SCENARIOS
from estimator_bench.score import (
    HEADINGS_RAD,
    NOTHING_DEG,
    Answer,
    as_dict,
    heading_rms_deg,
    score,
    score_answers,
    sensed,
    summed,
)
from estimator_bench.tables import Results
from estimator_bench.telemetry import sent


@pytest.fixture(scope="module")
def flown():
    scenario = SCENARIOS["rough10_f8"]
    flight = sent(scenario, 5, true_flight(scenario.motion, scenario.kind, 5, seconds=70.0))
    return flight, tape(flight)


@pytest.fixture(scope="module")
def judged(flown):
    flight, heard = flown
    return score(flight, heard, run("kalman", heard))


# ---------------------------------------------------------------- scores


def test_the_truth_scores_zero_and_an_error_what_geometry_says(flown):
    flight, _ = flown
    h = float(np.hypot(*flight.errors.field_n_mg[:2]))
    right = score_answers(flight, "right", [(t, Answer(flight.iron_at(t), np.eye(3))) for t in (30.0, 60.0, 178.0)])
    assert max(right.full_deg) < 1e-9
    off = np.array((0.02 * h, 0.0, 30.0))  # down does not turn a level compass
    wrong = score_answers(flight, "off", [(t, Answer(flight.iron_at(t) + off, np.eye(3))) for t in (30.0, 60.0, 178.0)])
    assert wrong.full_deg[0] == pytest.approx(math.degrees(0.02) / math.sqrt(2.0), rel=1e-3)
    assert np.allclose(wrong.iron_mg[0], off)
    assert score_answers(flight, "silent", [(178.0, None)]).full_deg == (NOTHING_DEG,) * 3


@settings(max_examples=25)
@given(st.tuples(*[st.floats(-0.08, 0.08)] * 6), st.tuples(*[st.floats(-300.0, 300.0)] * 3))
def test_undoing_soft_and_hard_iron_leaves_nothing(six, iron):
    xx, yy, zz, xy, xz, yz = six
    soft = np.eye(3) + np.array(((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)))
    level = 200.0 * np.stack((np.cos(HEADINGS_RAD), -np.sin(HEADINGS_RAD), np.full(24, 2.0)), 1)
    raw = level @ soft.T + np.array(iron)
    assert heading_rms_deg((raw - iron) @ np.linalg.inv(soft).T) < 1e-9


def test_a_run_is_scored_through_the_pipeline(flown, judged):
    flight, heard = flown
    assert 0.7 * len(flight.heard) < len(heard) <= 1.05 * len(flight.heard)
    assert judged.full_deg[-1] < 3.0 < heading_rms_deg(sensed(flight, 178.0))
    assert len(judged.ratios) == 9 and len(judged.nees) == 3
    assert judged.ready_wrong <= judged.ready_seconds


def test_a_liar_is_found_out(flown):
    """The right answer with a thousandth of its sigma, and a wrong answer claimed ready."""
    flight, heard = flown
    honest = run("kalman", heard)
    e = honest.ticks[-1].estimate
    off = flight.iron_at(178.0) + np.array((0.0, 0.3 * float(np.hypot(*flight.errors.field_n_mg[:2])), 0.0))
    x, y, z = (-off).tolist()
    lies = [Tick(t.t_s, _with(e, off), (x, y, z), (0.01, 0.01, 0.01), True) for t in honest.ticks]
    got = score(flight, heard, Run("liar", lies, 1.0, 1.0))
    assert got.ready_wrong == got.ready_beyond == got.ready_seconds
    assert got.ready_seconds == pytest.approx(lies[-1].t_s - lies[0].t_s + TICK_S)
    rare = score(flight, heard, Run("liar", lies[::5], 1.0, 1.0))  # a tick counts for as long as it stood
    assert rare.ready_seconds == pytest.approx(lies[::5][-1].t_s - lies[0].t_s + TICK_S)
    assert summed([got]).wrong_share == 1.0
    assert summed([got]).ratio > 100.0 and summed([got]).nees > 100.0


def _with(estimate, hard_iron):
    return dataclasses.replace(estimate, hard_iron_b_mg=hard_iron, covariance_mg2=np.eye(3) * 1e-4)


def test_an_estimator_of_ones_own_can_be_judged(flown, judged):
    flight, heard = flown
    own = score(flight, heard, run("mine", heard, make=KalmanEstimator))
    assert own.full_deg == judged.full_deg and own.name == "mine"


# ---------------------------------------------------------------- peers


def test_corrected_peers_find_the_iron_of_a_noise_free_tumble():
    for pin in pins(None):
        assert np.abs(np.array(pin.corrected_mg) - IRON_MG).max() < (3.0 if pin.method == "sar_aid" else 0.5), pin


def test_the_error_that_is_shipped_matters():
    t_s, mag, rate = tumble()
    assert np.linalg.norm(peers.sar_ls(t_s, mag, rate, shipped=True) - IRON_MG) > 10.0


@settings(max_examples=20)
@given(st.tuples(*[st.floats(-600.0, 600.0)] * 3), st.integers(0, 1000))
def test_twostep_is_exact_without_noise_and_shifts_with_the_iron(iron, seed):
    r = np.random.default_rng(seed)
    way = r.normal(size=(200, 3))
    field = 480.0 * way / np.linalg.norm(way, axis=1)[:, None]
    got = peers.twostep(field + np.array(iron), 480.0, noise_mg=1e-3)
    assert np.allclose(got, iron, atol=1e-3)
    blind = peers.twostep(field + np.array(iron), None, noise_mg=1e-3)
    assert np.allclose(blind, iron, atol=1e-3)


def test_the_windowed_one_survives_outliers():
    r = np.random.default_rng(7)
    way = r.normal(size=(600, 3))
    mag = 480.0 * way / np.linalg.norm(way, axis=1)[:, None] + IRON_MG + r.normal(0.0, 4.0, (600, 3))
    mag[::25] += r.normal(0.0, 250.0, (24, 3))
    plain, windowed = (f(mag, 480.0) for f in (peers.twostep, peers.twostep_windowed))
    assert np.linalg.norm(windowed - IRON_MG) < 2.0 < np.linalg.norm(plain - IRON_MG)


@pytest.mark.parametrize(
    "points", [np.zeros((100, 3)), np.ones((5, 3)), np.outer(np.arange(100.0), (1.0, 2.0, 3.0))], ids=str
)
def test_twostep_refuses_what_does_not_turn(points):
    assert peers.twostep(points, 480.0) is None
    assert peers.twostep_windowed(points, 480.0) is None


def test_peers_that_live_here_need_nothing_else(flown):
    flight, heard = flown
    got = peer_scores(flight, heard, Ready(("twostep_batch", "twostep_win", "sar_kf")))
    assert [s.name for s in got] == ["twostep_batch", "twostep_win", "sar_kf"]
    assert got[1].full_deg[1] < 3.0  # at 60 s; the flight ends at 70
    assert got[0].ready_seconds == 0 and got[0].ready_s == math.inf


# ---------------------------------------------------------------- tables, command line


def test_tables_and_document_hold_what_was_measured(judged):
    results = Results([judged], {})
    page = results.markdown(["a note"], lambda name: True)
    assert "| rough10_f8 |" in page and f"{judged.full_deg[-1]:.2f}" in page
    document = results.document({"seeds": [5, 6]})
    json.dumps(document, allow_nan=False)
    assert document["summaries"][0]["full_deg"] == pytest.approx(list(judged.full_deg))


def test_a_rival_is_beaten_only_where_the_whole_interval_says_so(judged):
    """A peer always twice as far off is beaten, one that is as good in the mean is not."""
    twice, mixed, ours = [], [], []
    for seed in range(20):
        one = 0.2 + 0.01 * seed
        ours.append(dataclasses.replace(judged, seed=seed, full_deg=(one,) * 3))
        silent = dataclasses.replace(judged, seed=seed, ratios=(), ready_seconds=0)
        twice.append(dataclasses.replace(silent, name="twice", full_deg=(2.0 * one,) * 3))
        share = math.sqrt(1.6 if seed % 2 else 0.4)  # the same in the mean square
        mixed.append(dataclasses.replace(silent, name="mixed", full_deg=(one * share,) * 3))
    row = Results([*ours, *twice, *mixed], {}).versus("kalman", 2).splitlines()[-1]
    assert "0.50 (0.50-0.50) <" in row
    assert row.count("<") == 1 and ">" not in row


def test_the_command_says_the_same_twice_and_refuses_by_name(tmp_path, capsys):
    file = tmp_path / "runs.json"
    arguments = "--seeds 7:8 --scenarios slow2 --estimators taubin --peers twostep_batch --jobs 1 --no-bound"
    assert estimators.main([*arguments.split(), "--json", str(file)]) == 0
    assert "TUNING" in capsys.readouterr().out
    first = json.loads(file.read_text())["runs"]
    again = estimators.judged(estimators.Task("slow2", 7, ("taubin",), False, Ready(("twostep_batch",)))).scored
    second = json.loads(json.dumps([as_dict(s) for s in again]))
    for one in (*first, *second):
        one["us_per_sample"] = one["us_first_20s"] = None
    assert first == second and len(first) == 2
    for bad in (["--estimators", "nonesuch"], ["--scenarios", "nonesuch"], ["--peers", "nonesuch"], ["--seeds", "5:5"]):
        with pytest.raises(SystemExit):
            estimators.main(bad)
        assert bad[1] in capsys.readouterr().err


def test_judging_seeds_stand_apart():
    assert estimators.seeds("4") == range(1000, 1004)
    assert estimators.seeds("3:9") == range(3, 9)
    assert set(estimators.peer_names("all")) == set(NAMES)
