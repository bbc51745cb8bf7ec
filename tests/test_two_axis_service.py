"""compass.axes = 2, the whole service: x and y alone, the dip from the place, and a heading with its larger sigma."""

import math

import numpy as np
import pytest
from flight_rig import IRON_MG, Flight, staying
from hypothesis import given, settings
from hypothesis import strategies as st
from memory_flight import HZ, Bench, flight
from synthetic_flight import HARD_IRON_MG

from magmav.core.correction import without_third
from magmav.core.types import AxisState, Reason, Shaping, State, mat3, vec3
from magmav.pipeline import Pipeline
from magmav.settings import Settings, with_value

pytestmark = pytest.mark.long  # whole flights; test_two_axis.py holds the method
TWO = with_value(Settings(), "compass", "axes", 2)


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    f = Flight(staying(), tmp_path_factory.mktemp("two"), settings=TWO)
    headings = []

    def note(reading, record):
        if record is not None and record.heading.true_valid and record.learnt:
            wrong = math.remainder(record.heading.true_rad - f.sim.truth.heading_rad, math.tau)
            headings.append((record.boot_ns / 1e9, wrong, record.heading.sigma_rad))

    f.service.watchers = (*f.service.watchers, note)
    f.land()
    f.end()
    return f, np.array(headings)


def test_two_axes_are_learnt_in_flight_and_the_third_is_left_as_stored(flown):
    f, _ = flown
    last = f.last()
    assert last.verdict.state is State.READY
    assert Reason.TWO_AXES in last.verdict.reasons
    assert last.verdict.axes == (AxisState.OBSERVED, AxisState.OBSERVED, AxisState.NOT_OBSERVED)
    error = (last.estimate.hard_iron_b_mg - IRON_MG)[:2]
    assert np.all(np.abs(error) < 3.0 * last.sigma_mg[:2])
    assert last.offsets_mg[2] == f.value("COMPASS_OFS_Z")


def test_the_heading_of_two_axes_is_right_within_its_sigma(flown):
    """After ten seconds of learning; the true heading is the simulator's."""
    _, h = flown
    later = h[h[:, 0] > h[0, 0] + 20.0]
    assert len(later) > 200
    assert math.degrees(np.sqrt(np.mean(later[:, 1] ** 2))) < 4.0
    assert 0.3 < np.sqrt(np.mean((later[:, 1] / later[:, 2]) ** 2)) < 1.3


def test_what_the_third_axis_says_changes_nothing():
    """Bit for bit: a broken z is not looked at."""
    noise = np.zeros((20 * HZ, 3))
    noise[:, 2] = np.random.default_rng(1).uniform(-900.0, 900.0, 20 * HZ)
    a = Bench(TWO).play(flight(seconds=20.0, seed=3))
    b = Bench(TWO).play(flight(seconds=20.0, seed=3, offsets_mg=noise))
    assert len(a) == len(b) > 100
    for x, y in zip(a, b, strict=True):
        assert np.array_equal(x.estimate.hard_iron_b_mg, y.estimate.hard_iron_b_mg)
        assert x.heading == y.heading
        assert x.verdict == y.verdict


def test_two_axes_cost_sigma_and_never_claim_less_than_three():
    three, two = Bench(), Bench(TWO)
    a, b = three.play(flight(seconds=60.0)), two.play(flight(seconds=60.0))
    cost = b[-1].sigma_mg[:2] / a[-1].sigma_mg[:2]  # the field's length, which three axes show, tells of x and y too
    assert np.all(cost > 0.8) and np.all(cost < 2.5)  # three axes have a second opinion
    of_three = {r.boot_ns: r.heading.sigma_rad for r in a}  # two axes repeat themselves sometimes: fewer samples
    pairs = [(of_three[r.boot_ns], r.heading.sigma_rad) for r in b[200:]]
    larger = [y >= 0.9 * x for x, y in pairs]
    assert np.mean(larger) > 0.95
    assert np.mean([y for _, y in pairs]) > np.mean([x for x, _ in pairs])


def test_without_a_place_there_is_no_dip_and_no_heading():
    bench = Bench(TWO)
    bench.pipeline = bench.service.pipeline = Pipeline(TWO, lambda *place: None)
    records = bench.play(flight(seconds=60.0))
    assert not any(r.heading.valid for r in records)
    assert {Reason.TWO_AXES, Reason.NO_POSITION} <= set(records[-1].verdict.reasons)
    assert np.all(np.abs(records[-1].offsets_mg + HARD_IRON_MG)[:2] < 4.0 * records[-1].sigma_mg[:2])


@settings(max_examples=50)
@given(st.integers(0, 10**6))
def test_the_inverse_of_two_axes_is_exact(seed):
    """undo(corrected(x)) is x on the two axes, for every stored matrix without a share of the third."""
    rng = np.random.default_rng(seed)
    matrix = np.eye(3)
    matrix[:2, :2] += rng.uniform(-0.3, 0.3, (2, 2))
    matrix[2, 2] = rng.uniform(0.6, 1.4)
    offset, motor, sensor = rng.uniform(-400.0, 400.0, (3, 3))
    sent = matrix @ (sensor + offset) + motor

    def undo(value):
        return vec3(np.linalg.solve(matrix, value - motor) - offset, "field")

    two, shaping = without_third(undo, Shaping(mat3(matrix, "m"), vec3(motor, "e")))
    back = two(vec3((*sent[:2], 0.0), "sent"))
    assert back[:2] == pytest.approx(sensor[:2], abs=1e-8)
    assert back[2] == 0.0
    again = shaping.matrix @ (back + np.append(offset[:2], 0.0)) + shaping.motor_b_mg
    assert again[:2] == pytest.approx(sent[:2], abs=1e-8)


def test_a_sensor_mounted_upright_is_refused():
    """Pitched by 90 degrees its x looks down: two axes of it hold one of the level plane."""
    upright = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    with pytest.raises(ValueError, match="two axes"):
        without_third(lambda m: vec3(upright @ m, "field"), Shaping(mat3(np.eye(3), "m"), vec3((0, 0, 0), "e")))
