"""Laws of the whole path that hold for any flight: what must not matter does not."""

import math

import numpy as np
import pytest
from fastcrc import crc16
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from memory_flight import HZ, STORED, Bench, Teller, flight
from pymavlink.dialects.v20 import ardupilotmega as dialect
from synthetic_flight import EARTH_MG, HARD_IRON_MG
from test_pipeline import bits

from magmav.core.estimators import ESTIMATORS
from magmav.core.types import AxisState, State
from magmav.settings import Settings, with_value

FLIGHT = flight(seconds=16.0)
SHORT = FLIGHT[:160]


@pytest.fixture(scope="module")
def plain():
    return bits(Bench().play(FLIGHT))


def test_the_same_bytes_give_the_same_bits(plain):
    assert bits(Bench().play(FLIGHT)) == plain


def test_the_autopilots_yaw_is_never_a_measurement(plain):
    """Its yaw follows the compass that is judged. Any yaw whatever, the same answer to the last bit."""
    nonsense = np.random.default_rng(3).uniform(-3.0, 3.0, 16 * HZ)
    assert bits(Bench().play(flight(seconds=16.0, yaw=nonsense))) == plain


def test_what_is_stored_does_not_matter(plain):
    """Whole offsets, so that no rounding differs: the sensor's own iron comes out to the last bit."""
    offsets = np.array([-300.0, 150.0, -210.0])
    told = STORED | {f"COMPASS_OFS_{a}": v for a, v in zip("XYZ", offsets, strict=True)}
    got = Bench().play(flight(seconds=16.0, offsets_mg=offsets, told=told))
    assert bits(got) == plain


def test_everything_sent_twice_changes_nothing(plain):
    assert bits(Bench().play([f for frame in FLIGHT for f in (frame, frame)])) == plain


def test_noise_on_the_line_changes_nothing(plain):
    r = np.random.default_rng(4)
    bench = Bench(datagrams=False)
    dirty = [bytes(r.integers(0, 0xFD, r.integers(0, 12), dtype=np.uint8)) + data for _, data in FLIGHT]
    assert bits(bench.play(dirty)) == plain
    assert bench.service.counts()["codec"]["garbage bytes"] > 1000


@settings(max_examples=8, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.lists(st.integers(1, 700), min_size=1, max_size=40))
def test_a_stream_cut_anywhere_gives_the_same(cuts):
    data = b"".join(d for _, d in SHORT)
    whole = bits(Bench().play(SHORT))
    pieces, at = [], 0
    while at < len(data):
        size = cuts[len(pieces) % len(cuts)]
        pieces.append(data[at : at + size])
        at += size
    assert bits(Bench(datagrams=False).play(pieces)) == whole


def test_other_components_and_ground_stations_change_nothing(plain):
    gimbal, station = Teller(1, 154), Teller(255, 190)
    frames = []
    for ms, data in FLIGHT:
        frames += [(ms, data), (ms, gimbal.attitude(ms, 0.5, 0.5, 0.0, np.zeros(3)))]
        frames += [(ms, station.param("COMPASS_OFS_X", 55.0))]
    bench = Bench()
    bench.play(frames)
    assert bits(bench.of(1)) == plain


def test_messages_that_get_lost_cost_certainty_and_not_truth():
    r = np.random.default_rng(5)
    frames = flight(seconds=60.0)
    kept = [f for i, f in enumerate(frames) if i < 3 or r.random() > 0.3]
    last = Bench().play(kept)[-1]
    assert np.all(np.abs(last.offsets_mg + HARD_IRON_MG) < 4.0 * last.sigma_mg)
    assert last.verdict.state is State.READY


def test_a_quiet_tick_and_empty_input_give_nothing():
    bench = Bench()
    assert bench.play([b""] * 5) == []
    assert bench.pipeline.vehicles == {}


def test_sigma_never_lies_under_its_floor_and_every_number_is_finite():
    for record in Bench().play(FLIGHT):
        assert np.all(record.sigma_mg >= record.estimate.floor_mg)
        for vector in (record.offsets_mg, record.sigma_mg, record.corrected_b_mg, record.mag_b_mg):
            assert np.isfinite(vector).all()
        if record.heading.valid:
            assert 0.0 <= record.heading.magnetic_rad < math.tau
            assert 0.0 <= record.heading.sigma_rad < math.radians(45.0)


def test_sums_fit_known_axes_store_minus_the_iron_and_the_correction_uses_the_iron():
    known = 0
    for record in Bench().play(FLIGHT)[60:]:
        e = record.estimate
        # Soft iron bends the downward field of a level vehicle into what looks like iron, and offsets take that too.
        iron = e.hard_iron_b_mg + (np.linalg.inv(e.soft_iron_b) - np.eye(3))[:, 2] * EARTH_MG[2]
        for axis, state in enumerate(record.verdict.axes):
            seen = state is not AxisState.NOT_OBSERVED
            known += seen
            assert record.offsets_mg[axis] == pytest.approx(-iron[axis] if seen else 0.0, abs=0.1)
        level = e.soft_iron_b @ (record.mag_b_mg - e.hard_iron_b_mg)
        assert record.corrected_b_mg == pytest.approx(level, abs=1e-9)
    assert known > 100


def rover(offsets_mg, told, tilt_noise_deg=0.0, placed=False):
    """A rover on flat ground turning on the spot for 40 s: no tilt but the attitude's own noise."""
    tell, r = Teller(1), np.random.default_rng(0)
    out = [(10_000, tell.heartbeat(kind=10) + tell.params(told))]
    for i in range(40 * HZ):
        ms, yaw = 10_000 + i * 1000 // HZ, 0.4 * i / HZ
        north, east, down = EARTH_MG
        field = (north * math.cos(yaw) + east * math.sin(yaw), east * math.cos(yaw) - north * math.sin(yaw), down)
        sent = np.trunc(np.array(field) + HARD_IRON_MG + r.normal(0.0, 3.0, 3) + offsets_mg)
        roll, pitch = np.radians(r.normal(0.0, tilt_noise_deg, 2))
        out += [(ms, tell.attitude(ms, roll, pitch, yaw, np.array([0.0, 0.0, 0.4]))), (ms, tell.imu(ms, sent))]
        if placed and i % HZ == 0:
            out.append((ms, tell.height(ms, 0.0)))
    return out


def test_S4_an_axis_that_was_not_observed_keeps_its_stored_offset_bit_for_bit():
    """Level turns and no position: nothing tells the down axis of the sensor from the field's own down part."""
    stored = np.array([12.0, -34.0, 56.789])
    told = {n: v for n, v in STORED.items() if not n.startswith("COMPASS_OFS_")}
    told |= {f"COMPASS_OFS_{a}": float(np.float32(v)) for a, v in zip("XYZ", stored, strict=True)}
    records = Bench().play(rover(stored, told))
    last = records[-1]
    assert last.verdict.axes[2] is AxisState.NOT_OBSERVED and last.sigma_mg[2] > 100.0
    assert all(r.offsets_mg[2] == float(np.float32(stored[2])) for r in records)
    assert last.verdict.axes[0] is not AxisState.NOT_OBSERVED and last.offsets_mg[0] != stored[0]


@pytest.mark.parametrize("noise_deg", [0.1, 0.3, 1.0])
@pytest.mark.parametrize("placed", [False, True])
def test_noise_of_the_attitude_is_no_tilting(noise_deg, placed):
    """A noisy regressor "proved" the down axis of a level rover 430 mG wrong at 9 mG of sigma."""
    last = Bench().play(rover(np.zeros(3), STORED, noise_deg, placed))[-1]
    assert last.verdict.axes[2] is (AxisState.FROM_MODEL if placed else AxisState.NOT_OBSERVED)
    assert last.estimate.own_sigma_mg[2] > 50.0
    known = slice(0, 3 if placed else 2)
    assert np.all(np.abs(last.estimate.hard_iron_b_mg - HARD_IRON_MG)[known] < 3.5 * last.sigma_mg[known])


def test_learning_off_keeps_the_answer_through_a_foreign_change_and_a_reboot():
    bench = Bench()
    learnt = bench.play(flight(seconds=60.0))[-1]
    assert learnt.verdict.state is State.READY
    bench.pipeline.apply(with_value(Settings(), "learn", "on", False))
    tell, moved = Teller(1), np.array([40.0, 0.0, 0.0])
    bench.play([tell.param("COMPASS_OFS_X", 40.0)])
    later = bench.play(flight(seconds=5.0, told=None, from_ms=71_000, offsets_mg=moved))[-1]
    assert later.estimate is not None and later.verdict.state is State.READY
    assert later.offsets_mg == pytest.approx(learnt.offsets_mg, abs=0.5)
    bench.play(flight(seconds=2.0, told=None, from_ms=1_000))
    bench.play([tell.params()])  # read again after the reboot
    again = bench.play(flight(seconds=4.0, told=None, from_ms=3_000))[-1]
    assert again.offsets_mg == pytest.approx(later.offsets_mg) and again.verdict.state is State.READY


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_every_estimator_survives_a_stuck_a_saturated_and_a_zero_compass(estimator):
    tell = Teller(1)
    for value in ((300, 20, 600), (32767, -32768, 32767), (0, 0, 0), (1, 0, 0)):
        bench = Bench(with_value(Settings(), "learn", "estimator", estimator))
        frames = [(ms, tell.imu(ms, np.array(value)) if d[7:10] == bytes((27, 0, 0)) else d) for ms, d in SHORT]
        assert all(r.verdict.state is not State.READY for r in bench.play(frames))


@settings(max_examples=12, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.binary(max_size=300), st.integers(0, len(SHORT) - 1), st.integers(0, 2**31))
def test_no_bytes_at_all_raise(junk, at, seed):
    """Arbitrary bytes, and a real frame with some of its own bytes exchanged and its checksum made good again."""
    r = np.random.default_rng(seed)
    bench = Bench()
    bench.play(SHORT[:10])
    for _, data in SHORT[at : at + 6]:
        frame = bytearray(data[: 12 + data[1]])
        for i in r.integers(10, len(frame) - 2, 4):
            frame[i] = r.integers(0, 256)
        extra = dialect.mavlink_map[int.from_bytes(frame[7:10], "little")].crc_extra
        frame[-2:] = crc16.mcrf4xx(bytes(frame[1:-2]) + bytes((extra,))).to_bytes(2, "little")
        bench.play([junk, bytes(frame)])
    bench.play(SHORT[:60])


@pytest.mark.parametrize("value", [1e38, -1e38, 1e-38, 0.0, 32767.0])
@pytest.mark.parametrize("group", ["OFS", "DIA", "ODI", "MOT"])
def test_no_stored_value_raises(group, value):
    told = STORED | {f"COMPASS_{group}_{a}": value for a in "XYZ"} | {"COMPASS_MOTCT": 2.0}
    bench = Bench()
    tell = Teller(1)
    bench.play([tell.params(told)])
    bench.play([tell(dialect.MAVLink_sys_status_message(0, 0, 0, 500, 16000, 1500, 80, 0, 0, 0, 0, 0, 0))])
    for record in bench.play(SHORT[3:120]):
        assert np.isfinite(record.offsets_mg).all()
