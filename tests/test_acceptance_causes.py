"""Acceptance tests of users.md, of the service's default estimator: what is wrong, and the figures that say so.

Magnets, ground and steel, gyro bias, mounting, scale and a weak field (AT-3a, 11, 12c, 15, 19, 20), and the heading's
error before and after against a named truth (AT-13).
"""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from ground_frames import COPTER, eased, frames, true_yaw
from honest_flight import (
    EXPECTED,
    RATE_HZ,
    Motion,
    figure_eight,
    samples,
    wander,
)
from matplotlib.axes import Axes
from matplotlib.text import Text
from memory_flight import Bench, Teller
from pymavlink.dialects.v20 import ardupilotmega as dialect
from synthetic_flight import HARD_IRON_MG
from test_acceptance import learnt
from test_causes import MOUNTS, about, bent, mounted, watch
from test_channel import HERE, channel, run

from magmav.appraisal import CompassLog, describe
from magmav.core.field import ExpectedField
from magmav.core.types import Reason, State, vec3
from magmav.reference import Reference
from magmav.view.plots import TraceCollector, plot_replay
from magmav.view.table import replay_view, to_text

# ---------------------------------------------------------------- AT-3a


def test_AT_3a_through_the_whole_service_a_strange_field_is_named_within_five_seconds():
    """|B| over 950 mG from the first sample: hatch magnets. Under 150 mG is test_causes'."""
    bench = Bench()
    hatch = np.array([2900.0, -1500.0, 1800.0])
    records = bench.play(frames(figure_eight, COPTER, 5.0, 3, hz=10, iron_mg=hatch))
    (cause,) = bench.pipeline.vehicles[1].causes.latest(1)
    assert cause.code == "MAGNET_NEARBY"
    assert cause.figure["field_mg"] == pytest.approx(np.linalg.norm(hatch), abs=600.0)
    assert f"{cause.figure['field_mg']:.0f} mG" in cause.text and "magnet or steel near compass" in cause.text
    assert not any(r.verdict.state is State.READY for r in records)


# ---------------------------------------------------------------- AT-11


BURIED_M, GROUND_MG = 0.8, np.array([140.0, -180.0, 120.0])


def climb(t, r):
    """Twelve seconds on the ground, up to 30 m in fifteen, and figure eights all the way."""
    begun, since = eased(t - 12.0, 4.0), np.maximum(t - 12.0, 0.0)
    m = figure_eight(since, r)
    return Motion(m.roll_rad * begun, m.pitch_rad * begun, m.yaw_rad)


def climbing(near_mg=GROUND_MG, seconds=70.0, hz=10):
    """Frames of it over a dipole in the ground, with heights told."""
    t = np.arange(int(seconds * hz)) / hz
    height_m = np.clip((t - 12.0) * 2.0, 0.0, 30.0)
    dipole = near_mg * ((BURIED_M / (BURIED_M + height_m)) ** 3)[:, None]
    tell, out = Teller(), []
    sent = frames(climb, COPTER, seconds, 5, armed=True, gps=False, hz=hz, near_mg=dipole)
    for i in range(0, len(t), hz // 2):
        ms = 10_000 + i * 1000 // hz
        out.append((ms, tell.height(ms, float(height_m[i]))))
    return sorted(sent + out, key=lambda f: f[0])


def test_AT_11a_a_dipole_under_the_pad_is_not_learnt_and_the_rest_of_the_flight_is():
    """AT-11a through the whole service: steel in the ground, gone at 3 m; at 30 m at most 10 mG off."""
    bench = Bench()
    records = bench.play(climbing())
    low = [r for r in records if r.boot_ns < (10.0 + 12.0 + 1.5) * 1e9]
    assert low and not any(r.learnt or r.verdict.state is State.READY for r in low)
    last = records[-1]
    assert last.verdict.state is State.READY
    assert np.abs(last.offsets_mg + HARD_IRON_MG).max() <= 10.0
    assert "GROUND_DISTURBED" in {c.code for c in bench.pipeline.vehicles[1].causes.of(1)}


@pytest.mark.parametrize("motion", ["hover turns", "survey"])
def test_AT_11c_a_whole_session_among_steel_is_never_ready_to_upload(motion):
    """The field wanders by 80 mG over some seconds, all the time."""
    r = np.random.default_rng(12)
    flight = samples(motion, 12, seconds=60.0)
    steel = np.stack([wander(r, len(flight), 1 / RATE_HZ, 80.0, 3.0) for _ in range(3)], 1)
    found = learnt([replace(s, mag_b_mg=vec3(s.mag_b_mg + d, "m")) for s, d in zip(flight, steel, strict=True)])
    assert all(f.verdict.state is not State.READY for f in found)


# ---------------------------------------------------------------- AT-12c


@pytest.mark.parametrize("motion", ["figure eight", "survey", "hover turns"])
def test_AT_12c_a_constant_gyro_bias_leaves_the_offsets_right_and_is_called_gyro_bias(motion):
    """AT-12c with the default estimator: 0.02 rad/s of yaw that is none."""
    flight = bent(samples(motion, 13, seconds=90.0), bias_rads=0.02)
    last = learnt(flight)[-1]
    assert np.all(np.abs(last.offsets_mg + HARD_IRON_MG) < 10.0)
    (cause,) = watch(flight).of(1)
    assert cause.code == "GYRO_BIAS"
    assert cause.text.startswith("gyro bias") and "the compass is not to blame" in cause.text
    assert cause.figure["bias_degs"] == pytest.approx(math.degrees(0.02), abs=4 * cause.figure["sigma_degs"])


# ---------------------------------------------------------------- AT-13


def told_course(crab_deg, seconds=40.0, hz=10):
    """A flight whose GPS speaks of 8 m/s, so many degrees to the right of the nose; None: it stands still."""
    sent = frames(figure_eight, COPTER, seconds, 3, armed=True, gps=False, hz=hz)
    yaw, tell, out = true_yaw(figure_eight, seconds, 3, hz), Teller(), []
    for i in range(0, len(yaw), hz // 5):
        ms, way = 10_000 + i * 1000 // hz, yaw[i] + math.radians(crab_deg or 0.0)
        north, east = (0, 0) if crab_deg is None else (int(800 * math.cos(way)), int(800 * math.sin(way)))
        course = round(math.degrees(way) % 360.0 * 100.0) % 36000
        out.append((ms, tell(dialect.MAVLink_global_position_int_message(
            ms, 473977000, 85456000, 518_000, 30_000, north, east, 0, course))))  # fmt: skip
    return sorted(sent + out, key=lambda f: f[0])


def gps_yaw(folder, seconds=40.0, hz=10):
    """What two antennas would say of that flight, as a reference file: true yaw, half a degree of noise, 5 Hz."""
    yaw, r = np.degrees(true_yaw(figure_eight, seconds, 3, hz)), np.random.default_rng(8)
    rows = [f"{10.0 + i / hz},0,0,{(yaw[i] + r.normal(0.0, 0.5)) % 360.0}" for i in range(0, len(yaw), 2)]
    path = folder / "gps_yaw.csv"
    path.write_text("boot_time_s,roll_deg,pitch_deg,heading_true_deg\n" + "\n".join(rows) + "\n")
    return Reference.from_csv(path)


def appraised(records, vehicle, reference):
    log = CompassLog()
    for r in records:
        log.add(r, vehicle.calibrations.shaping(1))
    return describe(log, vehicle, reference, None)


@pytest.fixture(scope="module")
def crabbing(tmp_path_factory):
    """Records of a flight with 20 degrees of wind angle, its entry in the result, and the name of its reference."""
    reference, bench = gps_yaw(tmp_path_factory.mktemp("crab")), Bench()
    records = bench.play(told_course(20.0))
    return records, appraised(records, bench.pipeline.vehicles[1], reference), reference


def test_AT_13a_heading_before_and_after_against_gps_yaw_with_n_mean_and_rms(crabbing):
    records, entry, reference = crabbing
    scored = entry["heading"]
    assert scored["n"] > 200 and scored["n"] + sum(scored["excluded"].values()) == len(records)
    assert scored["stored_rms_deg"] > 30.0  # hundreds of mG of iron, nothing stored
    assert abs(scored["bias_deg"]) <= scored["rms_deg"] < 0.1 * scored["stored_rms_deg"]
    after = [r for r in records if scored["from_s"] <= r.boot_ns / 1e9 <= scored["to_s"] and r.heading.true_valid]
    yaw = reference.interpolate([r.boot_ns / 1e9 for r in after])
    off = np.array([math.remainder(r.heading.true_rad - y, math.tau) for r, y in zip(after, yaw[2], strict=True)])
    off = np.degrees(off[yaw.valid])
    assert np.sqrt(np.mean(off**2)) == pytest.approx(scored["rms_deg"], rel=0.2)
    assert np.mean(off) == pytest.approx(scored["bias_deg"], abs=0.2)


def test_AT_13a_the_mean_before_is_reported_too_and_in_the_text(crabbing):
    records, entry, reference = crabbing
    text = to_text(replay_view({"vehicles": [{"system": 1, "autopilot": 3, "compasses": [entry]}]}))
    assert len([key for key in entry["heading"] if "bias" in key or "mean" in key]) >= 2
    assert re.search("mean|bias", text)
    scored = entry["heading"]
    both = [r for r in records if r.heading.true_valid and r.stored_heading.true_valid]
    yaw = reference.interpolate([r.boot_ns / 1e9 for r in both])
    assert np.count_nonzero(yaw.valid) == scored["n"]
    for name, said in (
        ("stored_bias_deg", [r.stored_heading.true_rad for r in both]),
        ("bias_deg", [r.heading.true_rad for r in both]),
    ):
        off = (np.array(said) - yaw.yaw_true_rad)[yaw.valid]
        assert np.degrees(np.angle(np.mean(np.exp(1j * off)))) == pytest.approx(scored[name], abs=0.01)
    before, after = (f"{scored[name]:+.2f}" for name in ("stored_bias_deg", "bias_deg"))
    assert f"as stored {before} → corrected {after} deg" in text
    assert abs(scored["stored_bias_deg"]) > 5.0 * abs(scored["bias_deg"])


def test_AT_13a_the_course_over_ground_moves_no_offset_by_a_bit_however_it_crabs(crabbing):
    """Course is no heading: 20 degrees of wind angle, none, and no course at all teach the same."""
    last = crabbing[0][-1]
    for crab_deg in (0.0, None):
        other = Bench().play(told_course(crab_deg))[-1]
        assert np.array_equal(other.offsets_mg, last.offsets_mg) and np.array_equal(other.sigma_mg, last.sigma_mg)
        assert other.heading.true_rad == last.heading.true_rad


def test_AT_13b_every_number_and_every_plot_names_its_truth(crabbing, tmp_path):
    records, entry, reference = crabbing
    scores = {key: value for key, value in entry.items() if isinstance(value, dict) and "rms_deg" in value}
    assert {"heading", "heading_offsets_only"} <= set(scores)
    assert {value["reference"] for value in scores.values()} == {"file gps_yaw.csv"}
    text = to_text(replay_view({"vehicles": [{"system": 1, "autopilot": 3, "compasses": [entry]}]}))
    assert "Heading RMS against file gps_yaw.csv:" in text
    collector = TraceCollector()
    for r in records:
        collector.add(r)
    (trace,) = collector.traces()
    drawn = trace.against(reference.interpolate(trace.boot_s).yaw_true_rad, 90.0, 1.0, None, None)
    figure = plot_replay(tmp_path / "p.png", [drawn], "flight", reference.name)
    blocks = [figure, *figure.findobj(Axes)]
    said = [" / ".join(part.get_text() for part in block.findobj(Text)) for block in blocks]
    errors = [text for text in said if "error" in text]
    assert len(errors) >= 3
    assert all("file gps_yaw.csv" in text for text in errors), errors


# ---------------------------------------------------------------- AT-15, 19, 20


@pytest.mark.parametrize("name", ["YAW_180", "PITCH_90"])
def test_AT_15a_a_compass_at_right_angles_is_not_ready_at_any_moment_and_the_rotation_is_printed(name):
    bench = Bench()
    records = bench.play(mounted(MOUNTS[name].T))
    assert not any(r.verdict.state is State.READY for r in records)
    assert records[-1].verdict.state is State.REFUSED
    entry = appraised(records, bench.pipeline.vehicles[1], None)
    assert name in to_text(replay_view({"vehicles": [{"system": 1, "autopilot": 3, "compasses": [entry]}]}))


@pytest.mark.parametrize("degrees", [30.0, -30.0])
def test_AT_15b_a_compass_turned_by_thirty_degrees_is_said_to_be_and_not_hidden_in_the_offsets(degrees):
    """AT-15b through the whole service, from the first moment at which it would write."""
    bench, silent = Bench(), []
    vehicle, records = None, []
    for frame in mounted(about(z=degrees).T):
        for r in bench.play([frame]):
            vehicle = bench.pipeline.vehicles[1]
            records.append(r)
            if r.verdict.state is State.READY and "MOUNTED_CROOKED" not in {c.code for c in vehicle.causes.of(1)}:
                silent.append(np.abs(r.offsets_mg + HARD_IRON_MG).max())
    (cause,) = vehicle.causes.of(1)
    assert cause.code == "MOUNTED_CROOKED"
    assert cause.figure["yaw_deg"] == pytest.approx(degrees, abs=5.0)
    last = records[-1]
    assert last.verdict.state is not State.READY or np.abs(last.offsets_mg + HARD_IRON_MG).max() < 10.0
    assert max(silent, default=0.0) < 30.0


@pytest.fixture(scope="module", params=[0.7, 1.3])
def scaled(request):
    """The gain of a compass, the records of a flight with it, and what was found."""
    bench = Bench()
    records = bench.play(mounted(request.param * np.eye(3), seed=16))
    return request.param, records, {c.code: c for c in bench.pipeline.vehicles[1].causes.of(1)}


def test_AT_19a_the_service_calls_scale_scale_and_refuses_beyond_a_fifth(scaled):
    """Within 36 s of flight."""
    gain, records, causes = scaled
    cause = causes["SCALE_WRONG"]
    assert cause.figure["gain"] == pytest.approx(gain, abs=max(4 * cause.figure["sigma"], 0.01))
    last = records[-1]
    assert last.verdict.state is State.REFUSED and Reason.SCALE_WRONG in last.verdict.reasons


def test_AT_19a_scale_is_not_hidden_in_the_offsets_of_anything_that_was_ready(scaled):
    _, records, _ = scaled
    ready = [r for r in records if r.verdict.state is State.READY]
    assert all(np.abs(r.offsets_mg + HARD_IRON_MG).max() <= 30.0 for r in ready)


def test_AT_20a_a_weak_horizontal_field_makes_the_heading_as_unsure_as_it_is():
    """60 mG level instead of 205: the sigma grows in proportion, is honest, and the warning stands."""
    steep = np.array([60.0, 0.0, 560.0])
    flight = samples("figure eight", 19, earth_mg=steep)
    there = replace(HERE, expected=ExpectedField(60.0, 560.0, 0.0))
    weak = run([replace(s, model_mg=(60.0, 560.0)) for s in flight], channel("adaptive"), there)
    strong = learnt(samples("figure eight", 19))
    assert Reason.HORIZONTAL_WEAK in weak[-1].verdict.reasons
    assert Reason.HORIZONTAL_WEAK not in strong[-1].verdict.reasons
    sigma = [np.median([f.heading.sigma_rad for f in found[-100:]]) for found in (weak, strong)]
    assert sigma[0] > 0.7 * EXPECTED.horizontal_mg / 60.0 * sigma[1]
    yaw = figure_eight(np.arange(len(flight)) / RATE_HZ, np.random.default_rng(19)).yaw_rad
    off = [math.remainder(f.heading.magnetic_rad - y, math.tau) for f, y in zip(weak[-300:], yaw[-300:], strict=True)]
    assert np.sqrt(np.mean(np.square(off))) < 2.0 * sigma[0]
