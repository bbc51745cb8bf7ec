"""The deviation card (AT-1d) against the mariner's formula, against a compass swung by hand, and as text and JSON."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from ground_frames import ROVER, frames, rover
from hypothesis import given
from hypothesis import strategies as st
from memory_flight import STORED, Bench, flight
from synthetic_flight import HARD_IRON_MG

from magmav.appraisal import CompassLog, describe
from magmav.commands.common import finite
from magmav.core.deviation import NAMES, deviation_card
from magmav.core.types import IDENTITY3, Estimate, mat3, vec3
from magmav.view.deviation import card_view
from magmav.view.table import replay_view, to_text

H, V = 200.0, 430.0
ZERO = vec3((0, 0, 0), "zero")
MG = st.floats(-150.0, 150.0)


def estimate(iron=(0.0, 0.0, 0.0), soft=IDENTITY3, horizontal=H):
    iron = vec3(iron, "b")
    return Estimate(iron, np.diag([4.0, 9.0, 16.0]), vec3((2, 3, 4), "s"), horizontal, V, 5.0, 1.0, 500, 1e9, 0.0, soft)


def card(e, stored=ZERO, offsets=None, matrix=IDENTITY3, covariance=None):
    offsets = vec3(-e.hard_iron_b_mg, "o") if offsets is None else offsets
    return deviation_card(e, e.covariance_mg2 if covariance is None else covariance, matrix, stored, offsets)


@given(MG, MG, st.floats(-400, 400))
def test_a_leftover_iron_follows_the_mariners_law(x, y, z):
    """tan(error) = -(y cos psi + x sin psi) / (H + x cos psi - y sin psi), whatever is left of the down axis."""
    e = estimate((50.0 + x, -20.0 + y, z))
    for row in card(e, stored=vec3((-50, 20, 0), "o")):
        c, s = math.cos(row.heading_rad), math.sin(row.heading_rad)
        across, along = -(y * c + x * s), H + x * c - y * s
        if math.hypot(across, along) < 20.0:
            assert row.before is None
        else:
            assert row.before.error_rad == pytest.approx(math.atan2(across, along), abs=1e-9)
        assert row.after.error_rad == pytest.approx(0.0, abs=1e-12)
        assert row.full.error_rad == pytest.approx(0.0, abs=1e-12)


def test_iron_ahead_by_hand():
    """80 mG ahead: none on north and south; on east atan(80/200) too far north, on west as much the other way."""
    shown = {row.name: math.degrees(row.before.error_rad) for row in card(estimate((80.0, 0.0, 0.0)))}
    assert tuple(shown) == NAMES == ("N", "NE", "E", "SE", "S", "SW", "W", "NW")
    assert shown["N"] == shown["S"] == pytest.approx(0.0, abs=1e-9)
    assert shown["E"] == -shown["W"] == pytest.approx(-math.degrees(math.atan2(80, 200)))


def swung(stored, matrix, soft, iron, motor):
    """Errors of a compass turned through the eight headings: the autopilot's correction of what its sensor shows."""
    out = []
    for i in range(8):
        psi = math.tau * i / 8
        truth = np.array((H * math.cos(psi), -H * math.sin(psi), V))
        sensor = np.linalg.solve(matrix, np.linalg.solve(soft, truth) - motor) + iron
        shown = matrix @ (sensor + stored) + motor
        out.append(math.remainder(math.atan2(-shown[1], shown[0]) - psi, math.tau))
    return out


@given(st.integers(0, 10_000))
def test_any_calibration_swung_heading_by_heading(seed):
    r = np.random.default_rng(seed)
    matrix, soft = (mat3(np.eye(3) + r.normal(0, 0.05, (3, 3)), "m") for _ in range(2))
    iron, stored, offsets = (vec3(r.normal(0, 40, 3), "v") for _ in range(3))
    rows = card(estimate(iron, soft), stored, offsets, matrix)
    motor = r.normal(0, 30, 3)  # is in both what the sensor shows and what is added: no part of the card
    for got, held in (([d.before for d in rows], stored), ([d.after for d in rows], offsets)):
        expected = swung(held, matrix, soft, iron, motor)
        for error, want in zip(got, expected, strict=True):
            assert error is None or math.remainder(error.error_rad - want, math.tau) == pytest.approx(0.0, abs=1e-9)
    assert all(abs(d.full.error_rad) < 1e-12 for d in rows)


def test_sigma_is_what_the_doubt_of_the_iron_does_to_the_shown_heading():
    """20000 irons drawn from the covariance, a fixed sensor reading, the spread of the heading it shows."""
    r = np.random.default_rng(4)
    covariance = np.array([[16.0, 5.0, 0.0], [5.0, 9.0, 2.0], [0.0, 2.0, 25.0]])
    matrix = mat3([[1.1, 0.05, 0.02], [0.05, 0.9, 0.0], [0.02, 0.0, 1.0]], "m")
    e = replace(estimate((60.0, -30.0, 10.0)), covariance_mg2=covariance)
    drawn = r.multivariate_normal(e.hard_iron_b_mg, covariance, 20_000)
    for row in card(e, stored=vec3((10, 20, 0), "o"), matrix=matrix):
        truth = np.array((H * math.cos(row.heading_rad), -H * math.sin(row.heading_rad), V))
        shown = truth + (drawn + np.array((10, 20, 0))) @ matrix.T
        spread = np.std(np.angle(np.exp(1j * (np.arctan2(-shown[:, 1], shown[:, 0]) - row.heading_rad))))
        assert row.before.sigma_rad == pytest.approx(spread, rel=0.05)


def test_where_no_field_is_left_no_heading_is_shown_and_without_a_field_no_card():
    rows = card(estimate((H, 0.0, 0.0)))  # on south the iron takes all of it away
    assert [r.name for r in rows if r.before is None] == ["S"]
    assert card(estimate(horizontal=0.0)) == () == card(estimate(horizontal=math.nan))


def test_of_two_axes_the_third_takes_no_part():
    matrix = mat3([[1.0, 0.0, 0.3], [0.0, 1.0, 0.3], [0.3, 0.3, 1.0]], "m")
    e = replace(estimate((40.0, 10.0, 5000.0)), says_b=(True, True, False))
    plain = card(estimate((40.0, 10.0, 0.0)))
    assert [d.before for d in card(e, matrix=matrix)] == [d.before for d in plain]


# ---------------------------------------------------------------- in a result, and for people


def entry(records, vehicle):
    log = CompassLog()
    for record in records:
        log.add(record, vehicle.calibrations.shaping(record.compass))
    return json.loads(json.dumps(finite(describe(log, vehicle, None, None))))


def drive(**options):
    bench = Bench()
    return bench.play(frames(rover, ROVER, 60.0, 3, hz=10, **options)), bench.pipeline.vehicles[1]


def test_AT_1d_the_card_of_a_drive_is_in_the_result_and_right():
    told = STORED | {"COMPASS_OFS_X": -280.0, "COMPASS_OFS_Y": 60.0}
    got = entry(*drive(told=told))["deviation_card"]
    assert [row["heading"] for row in got] == list(NAMES)
    assert [row["heading_deg"] for row in got] == [45.0 * i for i in range(8)]
    x, y = HARD_IRON_MG[:2] + np.array((-280.0, 60.0))
    for row in got:
        c, s = math.cos(math.radians(row["heading_deg"])), math.sin(math.radians(row["heading_deg"]))
        level = math.hypot(205.0, 14.0)
        truth = math.degrees(math.atan2(-(y * c + x * s), level + x * c - y * s))
        assert abs(row["before_deg"] - truth) < 4.0 * row["before_sigma_deg"] < 8.0
        assert abs(row["after_deg"]) < 0.1
        assert row["full_deg"] == 0.0
        assert 0.2 < row["after_sigma_deg"] < 2.0
    assert max(abs(row["before_deg"]) for row in got) > 15.0


def test_AT_1d_and_in_the_text():
    shown = entry(*drive())
    text = to_text(replay_view({"source": "x", "vehicles": [{"system": 1, "autopilot": 3, "compasses": [shown]}]}))
    lines = {line.split()[0]: line for line in text.splitlines() if line.split()[:1] and line.split()[0] in NAMES}
    assert tuple(lines) == NAMES
    for row in shown["deviation_card"]:
        for name in ("before", "after", "full"):
            assert (
                f"{row[f'{name}_deg']:+.1f} ± {row[f'{name}_sigma_deg']:.1f}".replace("-0.0", "+0.0")
                in lines[row["heading"]]
            )
    assert max(map(len, text.splitlines())) <= 100


def test_no_card_before_anything_is_known_and_no_number_where_no_heading_shows():
    bench = Bench()
    shown = entry(bench.play(flight(seconds=0.4, height_m=0.0)), bench.pipeline.vehicles[1])
    assert shown["deviation_card"] is None
    assert "Deviation" not in to_text(replay_view({"vehicles": [{"compasses": [shown]}]}))
    row = {"heading": "S", "heading_deg": 180.0, "before_deg": None, "before_sigma_deg": None}
    assert "no heading" in to_text(card_view([row]))
    assert to_text(card_view([])).strip() == ""
