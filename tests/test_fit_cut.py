"""What a fit leaves out, and what it calls it."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from magmav.comparison import Columns
from magmav.core.phase import Flight, Phase
from magmav.fitting import cut

N, HZ = 1200, 10.0


def columns(roll_rad=None, sensor=None, learn=None):
    t = 10.0 + np.arange(N) / HZ
    turn = np.column_stack([200.0 * np.cos(t), 200.0 * np.sin(t), np.full(N, 400.0)])
    nan = np.full(N, math.nan)
    roll = np.zeros(N) if roll_rad is None else roll_rad
    taught = np.ones(N, dtype=bool) if learn is None else learn
    return Columns(t, turn if sensor is None else sensor, roll, np.zeros(N), taught, 3, None, nan, nan)


def flight(takeoff_s=20.0, landed_s=None, crash_s=None):
    phase = Phase()
    phase.kind = 2
    ns = [None if s is None else round(s * 1e9) for s in (takeoff_s, landed_s, None, crash_s)]
    phase.flights = [Flight(round(15e9), *ns)]
    return phase


NOBODY = np.zeros(N, dtype=bool)


def test_a_tumble_is_cut_from_when_it_last_flew_upright_and_what_follows_is_after_the_crash():
    roll = np.zeros(N)
    roll[1000:] = math.radians(120.0)  # from 110 s on; noticed at 112 s
    learn = np.ones(N, dtype=bool)
    learn[:100] = learn[1020:] = False
    keep, spans = cut.before_the_fit(columns(roll, learn=learn), flight(crash_s=112.0), NOBODY, NOBODY)
    by = {s.code: s for s in spans}
    assert by["TUMBLE"].from_s == pytest.approx(110.0, abs=0.11) and by["TUMBLE"].to_s == pytest.approx(111.9, abs=0.11)
    assert by["CRASHED"].from_s == pytest.approx(112.0, abs=0.01)
    assert by["GROUND"].to_s == pytest.approx(19.9)
    assert keep.sum() == 900


def test_a_sensor_at_its_rail_is_cut_where_it_stands_and_one_that_turns_fast_is_not():
    c = columns()
    strong = c.sensor_b_mg.copy()
    strong[:, 0] = 1100.0 + 1.3 * strong[:, 0]
    assert not cut.saturated(strong).any()
    clipped = np.minimum(strong, 1300.0)
    assert (cut.saturated(clipped) == (clipped[:, 0] == 1300.0)).all() and cut.saturated(clipped).any()
    assert (cut.saturated(-clipped) == cut.saturated(clipped)).all()


def test_a_strong_still_field_is_no_rail():
    """Standing on the pad by a magnet: all axes stand still."""
    assert not cut.saturated(np.tile([2900.0, 10.0, -50.0], (N, 1))).any()


@pytest.mark.parametrize("seconds", [0.0, 4.0, 10.0])
def test_what_fits_badly_from_take_off_on_is_cut_and_nothing_in_mid_flight(seconds):
    c, phase = columns(), flight(takeoff_s=20.0, landed_s=125.0)
    keep = c.boot_s >= 20.0
    misfit = np.where(keep & (c.boot_s < 20.0 + seconds), 150.0, 8.0)
    misfit[700:740] = 150.0  # elsewhere it is the iron that changed, and not for cutting
    left, spans = cut.near_ground(c.boot_s, misfit, keep, phase)
    if not seconds:
        assert spans == [] and (left == keep).all()
        return
    (span,) = spans
    assert span.code == "TAKEOFF_ANOMALY" and span.from_s == pytest.approx(20.0)
    assert span.to_s == pytest.approx(20.0 + seconds, abs=2.0)
    assert left[700:740].all()


def test_the_same_before_landing():
    c, phase = columns(), flight(takeoff_s=20.0, landed_s=125.0)
    keep = (c.boot_s >= 20.0) & (c.boot_s <= 125.0)
    _, (span,) = cut.near_ground(c.boot_s, np.where(c.boot_s > 120.0, 200.0, 5.0), keep, phase)
    assert span.code == "LANDING_ANOMALY" and span.from_s == pytest.approx(120.0, abs=2.0)


def test_never_more_than_half_is_taken_for_strange():
    c, phase = columns(), flight(takeoff_s=100.0, landed_s=129.0)
    keep = c.boot_s >= 70.0
    left, spans = cut.near_ground(c.boot_s, np.where(c.boot_s > 99.0, 500.0, 5.0), keep, phase)
    assert (left == keep).all() and spans == []


@given(st.lists(st.sampled_from(["", "GROUND", "TUMBLE", "SATURATED"]), min_size=1, max_size=60))
def test_spans_hold_every_labelled_moment_once_and_no_other(labels):
    t = 1.0 + np.arange(len(labels)) * 0.1
    found = cut.spans(t, np.array(labels, dtype=object))
    for moment, label in zip(t, labels, strict=True):
        around = [s.code for s in found if s.from_s <= moment <= s.to_s]
        assert around == ([label] if label else [])
    assert all(s.text and s.as_json()["code"] in cut.TEXTS for s in found)
