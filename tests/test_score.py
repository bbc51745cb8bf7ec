"""Scores: right on a flight whose truth is known, honest about what was left out."""

import math
import os
import struct
from pathlib import Path

import numpy as np
import pytest
from synthetic_flight import DECLINATION_RAD, HARD_IRON_MG, SOFT_IRON, fly

from magmav.core.types import ZERO3, AttitudeReading
from magmav.reference import Reference, TruthError, shortest_rad
from magmav.score import (
    Calibration,
    Window,
    crash_s,
    heading_error_rad,
    magnetic_heading_rad,
    score_field,
    score_freeze,
    score_heading,
    score_headings,
)


def attitude(boot_s, roll_deg, pitch_deg, yaw_deg, system=1, source="ATTITUDE"):
    r, p, y = map(math.radians, (roll_deg, pitch_deg, yaw_deg))
    return AttitudeReading(system, source, round(boot_s * 1e9), r, p, y, ZERO3)


def reference_of(flight, name="the truth"):
    yes = np.ones(len(flight.boot_s), dtype=bool)
    return Reference(name, flight.boot_s, flight.roll_rad, flight.pitch_rad, flight.yaw_rad, yes, yes)


def yaw_only(boot_s, yaw_deg, roll_deg=None, **flags):
    boot_s = np.asarray(boot_s, float)
    zero, yes = np.zeros(len(boot_s)), np.ones(len(boot_s), dtype=bool)
    roll = zero if roll_deg is None else np.radians(roll_deg)
    return Reference("bench", boot_s, roll, zero, np.radians(yaw_deg), flags.get("armed", yes), yes)


# ---------------------------------------------------------------- heading of a field


def test_the_heading_of_a_tilted_vehicle_is_its_yaw_less_declination():
    flight = fly()
    got = magnetic_heading_rad(flight.true_b_mg, flight.roll_rad, flight.pitch_rad) + DECLINATION_RAD
    assert np.abs(shortest_rad(got - flight.yaw_rad)).max() < 1e-12


def test_four_level_vehicles_point_north_east_south_and_west():
    # Facing east, north is on the left: the field's right component is negative.
    fields = [(200, 0, 400), (0, -200, 400), (-200, -1e-9, 400), (0, 200, 400)]
    got = np.degrees(magnetic_heading_rad(fields, np.zeros(4), np.zeros(4)))
    assert got == pytest.approx([0.0, 90.0, 180.0, -90.0])


def test_a_list_of_one_shape_only():
    with pytest.raises(ValueError, match=r"field_b_mg: want shape \(N, 3\), got \(3, 4\)"):
        magnetic_heading_rad(np.zeros((3, 4)), np.zeros(4), np.zeros(4))


# ---------------------------------------------------------------- the reference


def test_interpolation_goes_the_short_way_through_north():
    reference = Reference.from_attitude([attitude(1.0, 170, 0, 350), attitude(1.4, -170, 4, 10)])
    got = reference.interpolate([1.0, 1.1, 1.2, 1.3, 1.4])
    assert np.degrees(got.yaw_true_rad) % 360 == pytest.approx([350, 355, 0, 5, 10])
    assert np.degrees(got.roll_rad) % 360 == pytest.approx([170, 175, 180, 185, 190])
    assert np.degrees(got.pitch_rad) == pytest.approx([0, 1, 2, 3, 4])
    assert got.valid.all()


def test_nothing_is_made_up_outside_the_series_or_inside_a_gap():
    reference = Reference.from_attitude([attitude(t, 0, 0, 10 * t) for t in (1.0, 1.5, 2.1, 2.2)])
    got = reference.interpolate([0.99, 1.0, 1.25, 1.5, 1.501, 1.8, 2.1, 2.15, 2.2, 2.2001])
    assert list(got.valid) == [False, True, True, True, False, False, True, True, True, False]
    assert np.array_equal(np.isnan(got.yaw_true_rad), ~got.valid)
    assert Reference.from_attitude([]).interpolate([1.0, 2.0]).valid.tolist() == [False, False]
    one = Reference.from_attitude([attitude(3.0, 0, 0, 77)]).interpolate([2.9, 3.0, 3.1])
    assert one.valid.tolist() == [False, True, False] and math.degrees(one.yaw_true_rad[1]) == pytest.approx(77)


def test_attitude_at_two_a_second_is_bridged_at_every_boot_time():
    times = 1000.1 + 0.5 * np.arange(200)
    reference = Reference.from_attitude([attitude(t, 0, 0, 0) for t in times])
    assert reference.interpolate(np.linspace(1001, 1090, 999)).valid.all()


def test_attitude_in_any_order_and_sent_twice_gives_one_series():
    readings = [attitude(t, t, 0, 20 * t) for t in (1.0, 1.2, 1.4)]
    mixed = Reference.from_attitude([readings[2], readings[0], readings[1], readings[0]])
    assert np.array_equal(mixed.boot_s, [1.0, 1.2, 1.4])
    assert np.degrees(mixed.yaw_true_rad) == pytest.approx([20, 24, 28])
    with pytest.raises(ValueError, match="one system and one source"):
        Reference.from_attitude([readings[0], attitude(2, 0, 0, 0, system=7)])


def test_flags_hold_from_their_own_time_on():
    reference = yaw_only([1, 2, 3, 4], [0, 0, 0, 0]).with_flags([2, 3.5], [True, True], [False, True])
    assert reference.armed.tolist() == [True] * 4
    assert reference.airborne.tolist() == [False, False, False, True]
    with pytest.raises(ValueError, match="airborne: want 1 flags"):
        reference.with_flags([1], [True], [True, False])


def test_a_truth_file_is_read_whatever_the_order_of_its_columns(tmp_path):
    path = tmp_path / "truth.csv"
    path.write_text("\ufeffheading_true_deg, pitch_deg,note,roll_deg,boot_time_s\n359,1,a,-2,10.0\n\n1,3,b,4,10.2\n")
    reference = Reference.from_csv(path)
    assert reference.name == "file truth.csv"
    got = reference.interpolate([10.1])
    for value, want in zip(got[:3], (1.0, 2.0, 0.0), strict=True):
        assert math.degrees(value[0]) == pytest.approx(want, abs=1e-9)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", r"truth\.csv, line 1: no column boot_time_s"),
        ("boot_time_s,roll_deg,pitch_deg\n1,2,3\n", r"truth\.csv, line 1: no column heading_true_deg"),
        (
            "boot_time_s,roll_deg,pitch_deg,heading_true_deg\n1,2,3,4\n2,x,3,4\n",
            r"line 3, column roll_deg.*'x'",
        ),
        (
            "boot_time_s,roll_deg,pitch_deg,heading_true_deg\n1,2,3,nan\n",
            r"line 2, column heading_true_deg.*'nan'",
        ),
        ("boot_time_s,roll_deg,pitch_deg,heading_true_deg\n1,2,3\n", r"line 2, column heading_true_deg.*''"),
        (
            "boot_time_s,roll_deg,pitch_deg,heading_true_deg\n2,0,0,0\n1,0,0,0\n",
            r"line 3, column boot_time_s: times",
        ),
        ("boot_time_s,roll_deg,pitch_deg,heading_true_deg\n", r"a header and no rows"),
        (b"\xff\xfe\x00\x01", r"not a CSV text file"),
    ],
)
def test_a_bad_truth_file_is_named_by_file_line_and_column(tmp_path, text, says):
    path = tmp_path / "truth.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(TruthError, match=says):
        Reference.from_csv(path)
    with pytest.raises(TruthError, match=r"nowhere\.csv: cannot read: No such file"):
        Reference.from_csv(tmp_path / "nowhere.csv")


# ---------------------------------------------------------------- scores


def test_a_known_error_gives_known_numbers():
    t = np.arange(100) / 10
    reference = yaw_only(t, np.full(100, 355.0))
    error_deg = np.where(np.arange(100) < 90, 3.0, -5.0)
    score = score_heading(t, np.radians(355.0 + error_deg), reference)
    assert score.rms_deg == pytest.approx(math.sqrt(0.9 * 9 + 0.1 * 25))
    assert score.bias_deg == pytest.approx(0.9 * 3 - 0.1 * 5, abs=0.01)
    assert score.p95_deg == pytest.approx(5.0)
    assert (score.n, score.from_s, score.to_s, score.excluded) == (100, 0.0, 9.9, {})
    assert score.reference == "bench"


def test_whole_turns_make_no_error():
    flight = fly()
    for turns in (-2, 0, 1):
        score = score_heading(flight.boot_s, flight.yaw_rad + turns * 2 * np.pi, reference_of(flight))
        assert score.rms_deg == pytest.approx(0.0, abs=1e-9)


def test_every_sample_is_scored_or_counted_once_under_the_first_exclusion():
    flight = fly(60.0)
    n = len(flight.boot_s)
    roll = np.where(np.arange(n) % 10 == 0, np.radians(75.0), 0.0)
    reference = Reference(
        "r",
        flight.boot_s[:1200],
        roll[:1200],
        np.zeros(1200),
        flight.yaw_rad[:1200],
        *np.ones((2, 1200), bool),
    ).with_flags([0.0, 20.0, 30.0], [False, True, True], [False, False, True])
    heading = flight.yaw_rad.copy()
    heading[1100] = np.nan
    score = score_heading(
        flight.boot_s, heading, reference, Window(12.0, 200.0, crash_s=55.0), {"mine": np.arange(n) == 1101}
    )
    # 25 Hz from 10 s: 50 before the window, disarmed until 20 s, armed on the ground until 30 s, then flight.
    assert score.excluded["outside window"] == 50
    assert score.excluded["disarmed"] == 200
    assert score.excluded["not airborne"] == 250
    assert score.excluded["after crash"] == n - 1125
    assert "no reference" not in score.excluded  # all of it lies after the crash
    assert score.excluded["tilt over 60 deg"] == sum(1 for i in range(500, 1125) if i % 10 == 0)
    assert "no heading" not in score.excluded  # 1100 is tilted, which comes first
    assert score.excluded["mine"] == 1
    assert score.n + sum(score.excluded.values()) == n
    assert (score.from_s, score.to_s) == (flight.boot_s[501], flight.boot_s[1124])


def test_without_a_single_sample_nothing_is_claimed():
    flight = fly(5.0)
    score = score_heading(flight.boot_s, flight.yaw_rad, reference_of(flight), Window(from_s=1e6))
    assert (score.rms_deg, score.p95_deg, score.bias_deg, score.from_s, score.to_s) == (None,) * 5
    assert score.n == 0 and score.excluded == {"outside window": len(flight.boot_s)}


def test_headings_that_are_compared_share_their_samples():
    t = np.arange(10.0) * 0.4
    late = np.where(np.arange(10) < 6, np.nan, 0.0)
    both = score_headings(t, {"early": np.radians(np.arange(10.0)), "late": late}, yaw_only(t, np.zeros(10)))
    assert both["early"].n == both["late"].n == 4
    assert both["early"].excluded == {"no heading": 6}
    assert both["early"].rms_deg == pytest.approx(math.sqrt((36 + 49 + 64 + 81) / 4))
    again = score_heading(t, np.zeros(10), yaw_only(t, np.zeros(10)), leave_out={"no heading": np.isnan(late)})
    assert (again.n, again.excluded) == (
        4,
        {"no heading": 6},
    )  # the caller's own count under that name holds too


def test_a_field_is_scored_with_the_references_own_tilt():
    flight = fly()
    good = score_field(flight.boot_s, flight.true_b_mg, DECLINATION_RAD, reference_of(flight))
    assert good.rms_deg == pytest.approx(0.0, abs=1e-9) and good.n == len(flight.boot_s)
    turned = score_field(flight.boot_s, flight.true_b_mg, DECLINATION_RAD + math.radians(4), reference_of(flight))
    assert turned.rms_deg == pytest.approx(4.0) and turned.bias_deg == pytest.approx(4.0)
    short = reference_of(flight._replace(**{k: v[:500] for k, v in flight._asdict().items()}))
    assert score_field(flight.boot_s, flight.true_b_mg, DECLINATION_RAD, short).excluded == {
        "no reference": len(flight.boot_s) - 500
    }


def test_freezing_the_right_calibration_removes_the_error_and_a_wrong_one_does_not():
    flight = fly(soft=True)
    scores = score_freeze(
        flight.boot_s,
        flight.sensor_b_mg,
        {
            "full": Calibration(HARD_IRON_MG, SOFT_IRON),
            "offsets only": Calibration(HARD_IRON_MG),
            "wrong sign": Calibration(-HARD_IRON_MG, SOFT_IRON),
            "follows current": Calibration(np.tile(HARD_IRON_MG, (len(flight.boot_s), 1)), SOFT_IRON),
        },
        DECLINATION_RAD,
        reference_of(flight),
        Window(from_s=40.0),
    )
    assert scores["full"].rms_deg == pytest.approx(0.0, abs=1e-9)
    assert scores["follows current"] == scores["full"]
    assert 1.0 < scores["offsets only"].rms_deg < 8.0
    assert scores["uncalibrated"].rms_deg > 40 and scores["wrong sign"].rms_deg > 40
    assert {s.n for s in scores.values()} == {len(flight.boot_s) - 750}
    transposed = Calibration(HARD_IRON_MG, [[1, 0.5, 0], [0, 1, 0], [0, 0, 1]])
    by_hand = np.array([[1, 0.5, 0], [0, 1, 0], [0, 0, 1]]) @ (flight.sensor_b_mg[9] - HARD_IRON_MG)
    want = magnetic_heading_rad([by_hand], flight.roll_rad[9:10], flight.pitch_rad[9:10])
    got = score_freeze(flight.boot_s[9:10], flight.sensor_b_mg[9:10], {"t": transposed}, 0.0, reference_of(flight))
    assert got["t"].bias_deg == pytest.approx(float(np.degrees(shortest_rad(want - flight.yaw_rad[9])[0])))
    with pytest.raises(ValueError, match="odd: want hard iron"):
        score_freeze(flight.boot_s, flight.sensor_b_mg, {"odd": Calibration([1, 2])}, 0.0, reference_of(flight))


def test_the_error_series_is_what_the_score_is_made_of():
    flight = fly()
    heading = flight.yaw_rad + 0.1 * np.sin(flight.boot_s)
    error = heading_error_rad(flight.boot_s, heading, reference_of(flight))
    score = score_heading(flight.boot_s, heading, reference_of(flight))
    assert score.rms_deg == pytest.approx(np.degrees(np.sqrt(np.mean(error**2))))
    assert error == pytest.approx(0.1 * np.sin(flight.boot_s))


def test_a_crash_is_a_long_tilt_of_a_vehicle_that_said_it_was_flying():
    t = np.arange(0, 60, 0.1)
    roll = np.where((t > 20) & (t < 22), 80.0, 0.0) + np.where((t > 40) & (t < 45), 170.0, 0.0)
    bench = yaw_only(t, np.zeros(len(t)), roll)
    assert crash_s(bench) is None
    flying = bench.with_flags([0.0], [True], [True])
    assert crash_s(flying) == pytest.approx(40.1, abs=0.11)
    assert crash_s(bench.with_flags([0.0], [False], [True])) is None
    cut = Reference("r", t[:430], flying.roll_rad[:430], *np.zeros((2, 430)), *np.ones((2, 430), bool))
    assert crash_s(cut.with_flags([0.0], [True], [True])) is None  # 2.9 s of it only


# ---------------------------------------------------------------- a real flight

FLIGHTS = Path(os.environ.get("MAGMAV_DATA", Path(__file__).parents[2] / "shared" / "data")) / "flights"


@pytest.mark.flights
@pytest.mark.skipif(not (FLIGHTS / "thor75.tlog").exists(), reason="real recordings are not here")
def test_thor_scores_as_published_before_and_after_the_batch_fit():
    # data/README.md: airborne about 220 to 588 s, uncalibrated 97 deg RMS, attitude-aided batch fit 3.2 deg.
    # The fit's offsets are given as "about", and not which part of the flight 3.2 covers (halves: 4.2, 2.8).
    boot_s, mag = raw_imu(FLIGHTS / "thor75.tlog")
    reference = Reference.from_csv(FLIGHTS / "thor75_truth.csv")
    fit = Calibration((389.0, -162.0, 395.0))
    scores = score_freeze(boot_s, mag, {"fit": fit}, math.radians(0.4), reference, Window(220.0, 588.0))
    assert scores["uncalibrated"].rms_deg == pytest.approx(97.0, abs=0.5)
    assert scores["fit"].rms_deg == pytest.approx(3.2, abs=0.5)
    assert scores["fit"].n > 10_000


def raw_imu(path):
    """Boot times and mag of RAW_IMU in a .tlog of v1 or v2 frames, cut by the length byte."""
    data, at, rows = path.read_bytes(), 8, []
    while at + 12 < len(data):
        v2, size = data[at] == 0xFD, data[at + 1]
        number = int.from_bytes(data[at + 7 : at + 10], "little") if v2 else data[at + 5]
        start = at + (10 if v2 else 6)
        if number == 27:
            payload = data[start : start + size].ljust(26, b"\0")
            rows.append(struct.unpack_from("<Q9h", payload))
        at = start + size + 2 + 8
    table = np.array(rows, dtype=float)
    return table[:, 0] * 1e-6, table[:, 7:10]
