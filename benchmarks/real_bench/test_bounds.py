"""The adaptive estimator on real recordings, to the bounds of the project; and the judge that says so, to closed forms.

The recordings are judged by benchmarks/real_flights.py's own parts, which are held here to `magmav replay --learn-for`.
"""

from __future__ import annotations

import math
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from magmav.core.rotation import body_from_earth, rotation
from magmav.geomag import world_magnetic_model
from magmav.recording import open_recording, replay
from magmav.settings import Settings, with_value

sys.path.insert(0, str(Path(__file__).parents[1]))

from real_bench.held_out import Judge, held_out
from real_bench.magnets import MAGNETS, UNDISTURBED, euler, judge, level_deg, trials
from real_bench.optical import Iron, Moved, Room, room, truth
from real_bench.ready import ready
from real_bench.running import before, run
from real_bench.tapes import load

_DATA = Path(os.environ.get("MAGMAV_DATA", Path(__file__).parents[3] / "shared" / "data"))
_HERE = pytest.mark.skipif(not (_DATA / "flights").is_dir(), reason="no real recordings: set MAGMAV_DATA")


def real(test):
    """Needs the recordings."""
    return pytest.mark.flights(_HERE(test))


class Flown:
    """The adaptive estimator over one recording, and a judge for each compass."""

    def __init__(self, name: str) -> None:
        (self.tape,) = load(_DATA / name)
        self.moments = run(self.tape, "adaptive")
        self.judges = {compass: Judge(self.tape, compass) for compass in self.tape.logs}
        self.said = {c: ready(j, "adaptive", self.moments[c]) for c, j in self.judges.items()}

    def held_out_deg(self, compass: int, learn_for_s: float) -> float:
        known = before(self.moments[compass], self.tape.started_s + learn_for_s)
        return self.judges[compass].score(learn_for_s, known.estimate, -known.estimate.hard_iron_b_mg)[0]


@pytest.fixture(scope="module")
def thor():
    return Flown("flights/thor75.tlog")


@pytest.fixture(scope="module")
def log171():
    return Flown("logs/log171.bin")


@real
@pytest.mark.parametrize(("learn_for_s", "most_deg"), [(30.0, 4.0), (60.0, 3.4)])
def test_thor_soon(thor, learn_for_s, most_deg):
    assert thor.held_out_deg(1, learn_for_s) <= most_deg


@real
def test_thor_an_answer_that_was_right_does_not_get_worse(thor):
    errors = {s: thor.held_out_deg(1, float(s)) for s in range(60, 251, 10)}
    assert {s: deg for s, deg in errors.items() if deg > 3.6} == {}


@real
@pytest.mark.parametrize(("compass", "learn_for_s", "most_deg"), [(1, 30.0, 3.8), (2, 30.0, 5.2), (3, 60.0, 6.2)])
def test_log171(log171, compass, learn_for_s, most_deg):
    assert log171.held_out_deg(compass, learn_for_s) <= most_deg


@real
def test_thor_is_ready_within_two_minutes_of_flying_and_right_then(thor):
    said = thor.said[1]
    assert said.after_s is not None and said.after_s <= 120.0
    assert said.full_deg <= 5.0


@real
@pytest.mark.parametrize("compass", [1, 2])
def test_log171_is_ready_before_its_tumble_and_right_then(log171, compass):
    said = log171.said[compass]
    assert said.after_s is not None
    assert said.full_deg <= 5.0


@real
@pytest.mark.parametrize(("flight", "compass"), [("thor", 1), ("log171", 1), ("log171", 2), ("log171", 3)])
def test_ready_is_never_said_of_a_wrong_one(request, flight, compass):
    """Held-out error within 3 sqrt(sigma^2 + r^2), of the full model and of the offsets that would be written."""
    said = request.getfixturevalue(flight).said[compass]
    assert said.wrong_s == 0.0
    assert said.offsets_wrong_s == 0.0


@pytest.fixture(scope="module")
def magnets():
    given = trials(_DATA / "flights", MAGNETS, ["own tilt"])
    return {trial.name: judge(trial, "own tilt", "adaptive", "adaptive") for trial in given}


@real
@pytest.mark.parametrize("name", MAGNETS)
def test_a_magnet_that_was_taken_off_is_forgotten_within_ten_seconds(magnets, name):
    """It was turned before the removal; before the attachment it lay still on the table."""
    on, off = magnets[name].spells
    assert on.turned_before_s < 1.0 < 30.0 < off.turned_before_s
    assert off.level_s is not None and off.level_s <= 10.0


@real
@pytest.mark.parametrize("name", MAGNETS)
def test_ready_is_never_said_of_a_heading_a_magnet_has_made_wrong(magnets, name):
    assert magnets[name].wrongs == []


# ---------------------------------------------------------------- the judge


@real
@pytest.mark.parametrize("estimator", ["kalman", "adaptive"])
def test_the_judge_says_what_a_replay_says(estimator):
    path = _DATA / "logs" / "esc_status_log.ulg"
    (tape,) = load(path)
    got = held_out(Judge(tape, 1), estimator, run(tape, estimator)[1], 20.0)
    settings = with_value(Settings(), "learn", "estimator", estimator)
    told = replay(open_recording(path), settings, world_magnetic_model, learn_for_s=20.0)
    (compass,) = told["vehicles"][0]["compasses"]
    assert got.n == compass["heading"]["n"] > 20
    assert got.full_deg == pytest.approx(compass["heading"]["rms_deg"], abs=1e-6)
    assert got.offsets_deg == pytest.approx(compass["heading_offsets_only"]["rms_deg"], abs=1e-6)


@real
def test_no_constant_offset_is_better_than_the_best_one(log171):
    for compass, judged in log171.judges.items():
        best = judged.best(0.0)
        for e in (m.estimate for m in log171.moments[compass][::40] if m.known):
            _, offsets_deg, _ = judged.score(0.0, e, -e.hard_iron_b_mg)
            assert offsets_deg >= best - 0.02


@real
def test_the_undisturbed_recording_is_undisturbed():
    (trial,) = trials(_DATA / "flights", [UNDISTURBED], [])
    assert trial.truth.magnet is None
    assert 400.0 < np.linalg.norm(trial.truth.room.field_n_mg) < 480.0
    assert trial.truth.room.rms_mg < 10.0


ROOM_MG = np.array((180.0, 0.0, 420.0))


def tumbled(seed: int, iron_mg: np.ndarray, magnet_mg: np.ndarray, soft: np.ndarray, lag_s: float) -> Moved:
    """Still for 20 s, then turned about changing axes; a magnet on it from 30 to 32 s in a ramp until 70 to 71 s."""
    rng = np.random.default_rng(seed)
    boot_s = 10.0 + np.arange(0.0, 100.0, 0.02)
    t = boot_s - 10.0
    share = np.interp(t, [30.0, 32.0, 70.0, 71.0], [0.0, 1.0, 1.0, 0.0])
    a, b, c = rng.uniform(0.5, 1.5, 3)
    rate = np.stack((a * np.sin(0.7 * t), b * np.cos(0.5 * t), c * np.sin(0.3 * t + 1.0)), 1) * (t > 20.0)[:, None]
    attitude = [np.eye(3)]
    for i in range(1, len(t)):
        attitude.append(rotation(-0.02 * 0.5 * (rate[i] + rate[i - 1])) @ attitude[-1])
    turned = np.array(attitude)
    seen = np.array([rotation(lag_s * w) @ r for w, r in zip(rate, turned, strict=True)]) @ ROOM_MG
    mag = seen @ soft.T + iron_mg + share[:, None] * magnet_mg + rng.normal(0.0, 4.0, (len(t), 3))
    return Moved("made up", boot_s, mag, rate, turned, np.ones(len(t), dtype=bool))


@pytest.mark.parametrize(("seed", "magnet_mg"), [(1, (60.0, -200.0, 500.0)), (2, (0.0, 5.0, -60.0))])
def test_field_lag_iron_and_magnet_are_found(seed, magnet_mg):
    iron, soft = np.array((20.0, -10.0, 5.0)), np.eye(3) + 0.02 * np.array([[1, 1, 0], [1, -1, 0], [0, 0, 0.5]])
    here = room(tumbled(seed + 10, iron, np.zeros(3), np.eye(3), 0.02))
    assert here.lag_s == pytest.approx(0.02, abs=0.003)
    assert here.field_n_mg == pytest.approx(ROOM_MG, abs=1.0)
    assert here.offset_b_mg == pytest.approx(iron, abs=1.0)
    known = truth(tumbled(seed, iron, np.array(magnet_mg), soft, 0.02), here, True)
    (a, b), (c, d) = known.magnet
    assert (a, b, c, d) == pytest.approx((40.0, 42.0, 80.0, 81.0), abs=0.8)
    assert known.with_magnet.hard_b_mg - known.iron.hard_b_mg == pytest.approx(np.array(magnet_mg), abs=2.0)
    assert known.iron.hard_b_mg == pytest.approx(iron, abs=2.0)
    assert known.iron.soft_b == pytest.approx(soft, abs=0.006)
    assert known.turned_s(10.0, a) == pytest.approx(a - 30.0, abs=2.0)
    assert known.odd_at(41.0) and not known.odd_at(60.0) and known.iron_at(60.0) is known.with_magnet


def test_a_level_error_is_the_offset_over_the_horizontal_field():
    """An offset e across the heading turns it by asin(e / H) at most: RMS over all headings e / (sqrt 2 H)."""
    here = Room(ROOM_MG, np.zeros(3), 0.0, 0.0)
    right = Iron(np.zeros(3), np.zeros(3), np.eye(3))
    assert level_deg(here, right, np.zeros(3), np.eye(3)) == pytest.approx(0.0, abs=1e-9)
    assert level_deg(here, right, np.array((3.0, 4.0, 50.0)), np.eye(3)) == pytest.approx(
        math.degrees(5.0 / 180.0 / math.sqrt(2.0)), rel=1e-3
    )
    bent = Iron(np.zeros(3), np.array((7.0, 0.0, 0.0)), np.diag((1.05, 0.95, 1.0)))
    assert level_deg(here, bent, bent.hard_b_mg, np.linalg.inv(bent.soft_b)) == pytest.approx(0.0, abs=1e-9)


def test_angles_go_to_a_matrix_and_back():
    rng = np.random.default_rng(5)
    for roll, pitch, yaw in rng.uniform((-3.1, -1.5, -3.1), (3.1, 1.5, 3.1), (50, 3)):
        assert euler(body_from_earth(roll, pitch, yaw)) == pytest.approx((roll, pitch, yaw), abs=1e-9)
