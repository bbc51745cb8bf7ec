"""Acceptance tests of users.md, of the service's default estimator: what is learnt, ready and said.

AT-3a, 11, 12c, 13, 15, 19 and 20 are in test_acceptance_causes. The rest of each is where the last test finds it: AT-1
test_planar and test_deviation, AT-2a, 2d, 3a, 3d, 11, 15, 19, 20 test_causes, AT-3c test_coach, AT-17 test_trust.
"""

import ast
import json
import math
import pickle
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ground_frames import BOAT, COPTER, ROVER, boat, eased, frames, rover, true_yaw
from honest_flight import (
    EXPECTED,
    MOTIONS,
    Motion,
    body_rates,
    field_in_body,
    figure_eight,
    samples,
)
from memory_flight import Bench
from synthetic_flight import DECLINATION_RAD, EARTH_MG, HARD_IRON_MG
from test_causes import arc
from test_channel import HERE, NOWHERE, channel, run
from test_geomag import NOAA, unix_ns
from test_kalman import yaw_only
from test_planar import STORED_Z, driven, onto_a_ramp

from magmav.coaching import advice_for
from magmav.core.causes import Causes
from magmav.core.coach import advise, next_step
from magmav.core.estimators.adaptive import AdaptiveEstimator
from magmav.core.excitation import Excitation
from magmav.core.types import NO_SHAPING, AxisState, Reason, Sample, State, VehicleReading, vec3
from magmav.geomag import world_magnetic_model
from magmav.settings import Place, Settings
from magmav.vehicle import Vehicle
from magmav.view.reporter import line

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from random_motions import drawn, judge, summary, wild

MODEL_MG = (EXPECTED.horizontal_mg, EXPECTED.down_mg)


def placed(flight):
    """The same samples, with the world model's field on them as the assembler puts it there."""
    return [replace(s, model_mg=MODEL_MG) for s in flight]


def learnt(flight):
    """The adaptive estimator through the gate: what was found after each sample."""
    return run(placed(flight), channel("adaptive"))


def coached(found, kind, roll_rad=0.0, pitch_rad=0.0):
    """What the coach says of a finding or a record."""
    reasons = found.verdict.reasons
    return next_step(found.verdict, advise(found.estimate, roll_rad, pitch_rad, None, kind, reasons=reasons))


def wrong(finding):
    """Errors of the axes that would be written, mG, and in their own sigmas."""
    axes = [i for i in range(3) if finding.verdict.axes[i] is not AxisState.NOT_OBSERVED]
    off = np.abs(finding.offsets_mg + HARD_IRON_MG)[axes]
    return off, off / finding.sigma_mg[axes]


# ---------------------------------------------------------------- AT-1


def test_AT_1a_an_unknown_down_axis_makes_the_heading_of_a_tilted_rover_less_sure():
    """Flat for a minute, then a ramp of 8 degrees: what Z may be off comes into the level field with the tilt."""
    records = driven(onto_a_ramp, ROVER, 3, "adaptive", gps=False, seconds=70.0)
    level, tilted = records[-10], records[-2]
    assert level.verdict.axes[2] is AxisState.NOT_OBSERVED and level.offsets_mg[2] == STORED_Z
    assert tilted.pitch_rad > math.radians(6.0) > level.pitch_rad
    unknown = level.estimate.own_sigma_mg[2] * math.sin(tilted.pitch_rad) / EXPECTED.horizontal_mg
    assert tilted.heading.sigma_rad > max(1.5 * level.heading.sigma_rad, 0.5 * min(unknown, 1.0))
    yaw = true_yaw(onto_a_ramp, 70.0, 3, 10)[-1] - DECLINATION_RAD
    assert abs(math.remainder(tilted.heading.magnetic_rad - yaw, math.tau)) < 3.0 * tilted.heading.sigma_rad


def test_AT_1c_what_the_coach_says_all_along_a_drive_never_asks_to_invert_nose_down_or_roll():
    for motion, kind in ((rover, ROVER), (boat, BOAT)):
        said = set()
        for r in driven(motion, kind, 1, "adaptive", gps=False, seconds=60.0)[::30]:
            said.add(coached(r, kind, r.roll_rad, r.pitch_rad))
            said |= {reason.text for reason in r.verdict.reasons}
        assert len(said) > 2
        assert not [text for text in said if re.search("bank|pitch|roll|nose|invert|turn over", text)]


# ---------------------------------------------------------------- AT-2a, 2d


@pytest.mark.parametrize("where", [HERE, NOWHERE], ids=["position", "none"])
def test_AT_2a_forty_degrees_of_yaw_are_not_enough_at_any_moment(where):
    """Never READY, and the reason names the axis and the motion; what is claimed of it all the same is true."""
    flight = arc()
    found = run(placed(flight) if where is HERE else flight, channel("adaptive"), where)
    assert {f.verdict.state for f in found} == {State.LEARNING}
    last = found[-1]
    assert {Reason.X_NOT_OBSERVED, Reason.Y_NOT_OBSERVED, Reason.HEADING_UNSURE} & set(last.verdict.reasons)
    assert coached(last, COPTER)
    off, sigma = np.abs(last.offsets_mg + HARD_IRON_MG), last.sigma_mg
    assert np.all(off < 3.5 * sigma)


@pytest.mark.parametrize("where", [HERE, NOWHERE], ids=["position", "none"])
def test_AT_2a_the_motion_that_is_missing_is_yaw_and_the_coach_says_so(where):
    flight = arc()
    last = run(placed(flight) if where is HERE else flight, channel("adaptive"), where)[-1]
    assert re.search("yaw|turn", coached(last, COPTER))


def narrow(t, r):
    """Level, swinging through an arc of forty degrees of yaw."""
    begun = eased(t - 12.0, 4.0)
    return Motion(0.0 * t, 0.0 * t, begun * math.radians(20.0) * np.sin(0.5 * t))


def test_AT_2a_through_the_whole_service_the_motion_that_is_missing_is_yaw():
    """Position unknown: the level axes are known, the down axis is not, and it is headings that hold it up."""
    bench = Bench()
    last = bench.play(frames(narrow, COPTER, 70.0, 7, armed=True, gps=False, height_m=30.0, hz=10))[-1]
    assert last.verdict.axes == (AxisState.OBSERVED, AxisState.OBSERVED, AxisState.NOT_OBSERVED)
    assert Reason.HEADING_UNSURE in last.verdict.reasons
    assert advice_for(last, bench.pipeline.vehicles[1]).startswith("yaw")


def test_AT_2d_an_unknown_down_axis_holds_nothing_up_and_is_not_dragged_along_by_the_level_ones():
    """Level turns, position unknown: X and Y are found, and of Z nothing is claimed."""
    last = run(yaw_only(60.0), channel("adaptive"), NOWHERE)[-1]
    assert last.verdict.state is State.READY
    assert last.verdict.axes == (AxisState.OBSERVED, AxisState.OBSERVED, AxisState.NOT_OBSERVED)
    off = np.abs(last.offsets_mg + HARD_IRON_MG)
    assert np.all(off[:2] < 10.0)
    assert off[2] < 3.0 * last.estimate.own_sigma_mg[2]


# ---------------------------------------------------------------- AT-2b


def random_motion(t, r):
    """One of the wild motions of benchmarks/random_motions.py."""
    path = wild(t, r)
    return Motion(path.roll_rad, path.pitch_rad, path.yaw_rad)


def test_AT_2b_whatever_the_motion_what_is_accepted_is_as_right_as_it_claims(monkeypatch):
    """AT-2b on 16 wild motions; all 500, through the whole path, are `make soak`'s (benchmarks/random_motions.py)."""
    monkeypatch.setitem(MOTIONS, "wild", random_motion)
    shares, accepted = [], 0
    for seed in range(16):
        ready = [f for f in learnt(samples("wild", 6000 + seed, seconds=25.0)) if f.verdict.state is State.READY]
        accepted += bool(ready)
        for f in ready[::10]:
            assert wrong(f)[0].max() <= 30.0, seed
        shares += wrong(ready[-1])[1].tolist() if ready else []
    assert accepted >= 8  # timid it is not
    assert np.mean(np.array(shares) <= 3.0) >= 0.99, sorted(shares)[-5:]


def test_AT_2b_the_benchmark_judges_by_the_truth_and_counts_what_breaks_the_line():
    """One flight of it, its judge, and its table of a liar."""
    scenario, seconds = drawn(5001, 40.0)
    assert scenario == drawn(5001, 40.0)[0] and seconds == 40.0
    seed = next(s for s in range(5000, 5100) if drawn(s)[0].name == "figure8")
    told = judge(seed, longest_s=40.0)
    assert told.accepted and told.axes >= 2 and told.worst_mg < 30.0
    liar = replace(told, outside=1, worst_mg=44.0, worst_sigmas=9.0)
    table = summary([told, liar, replace(told, first_ready_s=None, reasons=("HEADING_UNSURE",))])
    assert "| figure8 | 3 | 2 | " in table
    assert f"seed {seed}, figure8: worst 44.0 mG, 9.0 sigma" in table
    assert "1 HEADING_UNSURE" in table


# ---------------------------------------------------------------- AT-2c


def spins(t, late_s):
    """A copter turning at 180 deg/s one way and the other, leaning 8 degrees into a wind; as it was late_s ago."""
    at = t - late_s
    swing = 4.0  # s; a triangle of yaw
    yaw = math.pi * (swing / 2.0) * 2.0 / math.pi * np.arcsin(np.sin(np.pi * at / swing))
    lean = np.radians(8.0 + 3.0 * np.sin(0.4 * at))
    return Motion(lean * np.sin(yaw), -lean * np.cos(yaw) + np.radians(3.0) * np.sin(0.9 * at), yaw)


@pytest.mark.parametrize("late_s", [0.0, 0.1])
def test_AT_2c_a_compass_a_tenth_of_a_second_late_at_180_degrees_a_second(late_s):
    """AT-2c: refused, or right to 15 mG. A compass on time is accepted in the same motion."""
    hz, r = 25.0, np.random.default_rng(41)
    t = np.arange(0.0, 60.0, 1.0 / hz)
    m = spins(t, 0.0)
    assert np.abs(np.gradient(m.yaw_rad, t)).max() == pytest.approx(math.pi, rel=0.02)
    mag = np.trunc(field_in_body(spins(t, late_s)) + HARD_IRON_MG + r.normal(0.0, 4.0, (len(t), 3)))
    rates, steps = body_rates(m, 1.0 / hz), np.diff(m.yaw_rad, prepend=m.yaw_rad[0])
    flight = [
        Sample(1, 1, int(1e9 * (10.0 + t[i])), 1.0 / hz if i else 0.0, vec3(mag[i], "m"), NO_SHAPING,
               vec3(rates[i], "w"), float(m.roll_rad[i]), float(m.pitch_rad[i]), float(steps[i]), 0.0, 0.0, i == 0,
               "ATTITUDE", True)
        for i in range(len(t))
    ]  # fmt: skip
    found = learnt(flight)
    ready = [f for f in found if f.verdict.state is State.READY]
    assert all(wrong(f)[0].max() <= 15.0 for f in ready)
    if ready or not late_s:
        assert found[-1].verdict.state is State.READY
        assert found[-1].estimate.delay_s == pytest.approx(late_s, abs=0.02)


# ---------------------------------------------------------------- AT-3b


def test_AT_3b_coverage_is_counted_in_body_axes():
    """AT-3b: a tumble in one field fills over 60 % of the sphere, yaw alone only a ring of it."""
    r = np.random.default_rng(3)
    tumble, ring = Excitation(), Excitation()
    for _ in range(6000):
        turned = r.normal(size=3)
        tumble.see(np.linalg.norm(EARTH_MG) * turned / np.linalg.norm(turned), 0.0)
        yaw = r.uniform(0.0, 2.0 * math.pi)
        level = field_in_body(Motion(np.zeros(1), np.zeros(1), np.array([yaw])))[0]
        ring.see(level, yaw)
    assert tumble.coverage > 0.6
    assert 0.03 < ring.coverage < 0.3


# ---------------------------------------------------------------- AT-3d


def words_of(path):
    """Every string of a module but its docstrings, f-strings in one piece."""
    tree = ast.parse(path.read_text())
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    docs = {id(n.body[0].value) for n in ast.walk(tree) if isinstance(n, documented) and n.body
            and isinstance(n.body[0], ast.Expr)}  # fmt: skip
    parts = {id(v) for n in ast.walk(tree) if isinstance(n, ast.JoinedStr) for v in n.values}
    for n in ast.walk(tree):
        if isinstance(n, ast.JoinedStr):
            yield "".join(str(v.value) if isinstance(v, ast.Constant) else "{}" for v in n.values)
        elif isinstance(n, ast.Constant) and isinstance(n.value, str) and id(n) not in docs | parts:
            yield n.value


def test_AT_3d_every_refusal_has_a_code_and_a_sentence_and_nothing_just_failed():
    """Whatever failed is named before the word, and why after it; a count may stand for many whys."""
    numbers = [r.number for r in Reason]
    assert len(set(numbers)) == len(numbers)
    for r in Reason:
        assert re.fullmatch("[A-Z][A-Z_]+", r.name) and len(r.text.split()) >= 3 and "failed" not in r.text
    package = Path(__file__).parents[1] / "magmav"
    paths = [path for path in package.rglob("*.py") if "failed" in path.read_text().lower()]
    said = {text for path in paths for text in words_of(path) if "failed" in text.lower()}
    assert all(re.search(r"\w+ failed: \{\}", text) for text in said - {"open failed"}), said


# ---------------------------------------------------------------- AT-12


def flown(gps, seconds=30.0):
    """The last record of a copter's figure eights; armed for ten seconds without a word of height, it is aloft."""
    return Bench().play(frames(figure_eight, COPTER, seconds, 3, armed=True, gps=gps, height_m=30.0, hz=10))[-1]


def test_AT_12a_without_a_place_heading_is_magnetic_only_and_true_is_absent_not_zero():
    """AT-12a: in the record, and in what `run --json` prints."""
    last = flown(gps=False)
    assert last.heading.valid and not last.heading.true_valid
    assert not last.published.true_valid
    said = json.loads(json.dumps(line(last)))
    assert said["heading_true_deg"] is None and said["heading_deg"] is not None
    assert flown(gps=True).heading.true_valid


def at_hand(lat, lon, alt_m, unix_ns):
    """The field a vehicle that never sends a position has at a place given in the settings."""
    settings = Settings(place=Place(lat_deg=lat, lon_deg=lon, alt_m=alt_m))
    vehicle = Vehicle(1, settings, world_magnetic_model)
    vehicle.step(VehicleReading(1, 1, 3, 12, True, 4), 0, unix_ns)  # an ROV
    return vehicle.expected(unix_ns)


def test_AT_12b_a_place_given_by_hand_gives_noaas_declination_and_counts_in_full():
    """AT-12b: declination within half a degree of every one of NOAA's test values, and no digit of a place is cut."""
    places = set()
    for _, year, alt_km, lat, lon, north, east, _ in NOAA["rows"]:
        here = at_hand(float(lat), (lon + 180.0) % 360.0 - 180.0, alt_km * 1000.0, unix_ns(year))
        off = math.remainder(here.declination_rad - math.atan2(east, north), math.tau)
        assert abs(math.degrees(off)) < 0.5
        places.add((year, alt_km, lat, lon))
    assert len(places) >= 20
    now = unix_ns(2026.4)
    fine = [at_hand(47.37 + step, 8.54, 400.0, now).horizontal_mg for step in (0.0, 0.001, 0.002, 0.003)]
    assert np.diff(fine) == pytest.approx(np.mean(np.diff(fine)), rel=0.2)
    assert abs(np.diff(fine)).min() > 0.0


def calls_of(do):
    """How many functions, Python's and C's, are called while this runs: a cost no busy machine can change."""
    count = [0]

    def see(frame, event, arg):
        count[0] += event in ("call", "c_call")

    sys.setprofile(see)
    try:
        do()
    finally:
        sys.setprofile(None)
    return count[0]


def test_AT_12d_the_work_of_a_sample_is_small_and_does_not_grow():
    """AT-12d: 15 % of a Raspberry Pi 4's core at 10 Hz is 15 ms a sample; benchmarks/estimator_cost.py prints the time.

    Here the work is counted: calls per sample, of estimator, gate and cause finder, early and late; what is kept.
    """
    flight = placed(samples("figure eight", 51, seconds=130.0))
    c, found = channel("adaptive"), Causes()

    def watched(s):
        f = c.step(s, s.mag_b_mg, HERE)
        found.step(s, f.estimate, EXPECTED, s.mag_b_mg, False)

    per_sample, kept, done = [], [], 0
    for begin in (250, 1200):
        for s in flight[done:begin]:
            watched(s)
        done = begin + 100
        stretch = flight[begin:done]
        per_sample.append(calls_of(lambda some=stretch: [watched(s) for s in some]) / len(stretch))
        kept.append((len(pickle.dumps(c._estimator)), len(pickle.dumps(found))))
    assert max(per_sample) < 1500.0
    assert per_sample[1] < 1.5 * per_sample[0]
    assert max(k[0] for k in kept) < 50_000
    assert kept[1][1] < 31 * 21 * 21 * 8 * 1.5  # thirty blocks of sums, and what goes with them


def test_AT_12d_most_hypotheses_are_gone_after_twenty_seconds():
    e = AdaptiveEstimator()
    for s in placed(samples("figure eight", 52, seconds=20.0)):
        e.step(s)
    assert e._bank is not None and len(e._bank) <= 8


# ---------------------------------------------------------------- none is missing

NAMED = {
    1: "abcd", 2: "abcd", 3: "abcd", 11: "abc", 12: "abcd", 13: "ab", 15: "ab", 17: "ab", 19: "a", 20: "a",
}  # fmt: skip


def test_every_acceptance_test_of_the_estimator_has_a_test_of_its_name():
    sources = "".join(p.read_text() for p in Path(__file__).parent.glob("test_*.py"))
    tests = set(re.findall(r"def test_AT_(\d+[a-d])_", sources))
    assert [f"{n}{x}" for n, of in NAMED.items() for x in of if f"{n}{x}" not in tests] == []
