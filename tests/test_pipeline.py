"""Bytes in, records out, on a link in memory: vehicles, parameters, reboots and the ground."""

import math

import numpy as np
import pytest
from honest_flight import MOTIONS
from memory_flight import HZ, STORED, Bench, Teller, earth_model, flight, together
from synthetic_flight import HARD_IRON_MG

from magmav.core.types import AxisState, Reason, State
from magmav.pipeline import Pipeline
from magmav.settings import Settings, with_value


def bits(records):
    return [
        (
            r.boot_ns,
            r.estimate.hard_iron_b_mg.tobytes(),
            r.sigma_mg.tobytes(),
            r.heading,
            r.verdict,
            r.mag_b_mg.tobytes(),
        )
        for r in records
    ]


def test_a_flight_is_learnt_and_its_heading_is_right():
    bench = Bench()
    records = bench.play(flight(seconds=60.0))
    last = records[-1]
    assert np.all(np.abs(last.offsets_mg + HARD_IRON_MG) < 4.0 * last.sigma_mg)
    assert last.verdict.state is State.READY
    assert (last.system, last.compass, last.device_id, last.relative) == (1, 1, 97539, False)
    assert last.stored_b_mg == pytest.approx(last.mag_b_mg)
    truth = MOTIONS["figure eight"](np.arange(60 * HZ) / HZ, np.random.default_rng(0)).yaw_rad
    errors = [
        math.degrees(math.remainder(r.heading.true_rad - truth[round((r.boot_ns / 1e9 - 10.0) * HZ)], math.tau))
        for r in records[-500:]
    ]
    assert np.sqrt(np.mean(np.square(errors))) < 2.0
    assert all(r.heading.true_valid for r in records[-500:])


def test_two_vehicles_on_one_link_are_kept_apart():
    """The same compass number and the same times, other irons: each is bit for bit what it would be alone."""
    other = np.array([-200.0, 90.0, -60.0])
    one, two = flight(1, 20.0, seed=1), flight(2, 20.0, "hover turns", seed=2, iron_mg=other)
    bench, alone, alone2 = Bench(), Bench(), Bench()
    bench.play(together(one, two))
    assert bits(bench.of(1)) == bits(alone.play(one))
    assert bits(bench.of(2)) == bits(alone2.play(two))
    assert np.all(np.abs(bench.of(2)[-1].offsets_mg + other) < 15.0)
    assert set(bench.pipeline.vehicles) == {1, 2}


def test_parameters_of_one_vehicle_do_not_touch_another():
    bench = Bench()
    bench.play(flight(1, 4.0))
    bench.play(flight(2, 4.0))
    bench.play([Teller(2).param("COMPASS_OFS_X", 70.0)])
    assert bench.pipeline.vehicles[1].calibrations.value("COMPASS_OFS_X") == 0.0
    assert bench.pipeline.vehicles[2].calibrations.value("COMPASS_OFS_X") == 70.0


def test_AT_5c_parameters_changed_and_changed_back_never_mix():
    """As a test pilot does: 100 mG more on x, look at it, take it back. The stream lags the echo by 0.4 s."""
    n, change, back, lag = 60 * HZ, 15 * HZ, 30 * HZ, 10
    offsets = np.zeros((n, 3))
    offsets[change + lag : back + lag, 0] = 100.0
    frames = flight(seconds=60.0, offsets_mg=offsets)
    tell = Teller(1)
    at = {10_000 + change * 40: 100.0, 10_000 + back * 40: 0.0}
    bench, samples = Bench(), []
    for ms, data in frames:
        if ms in at:
            bench.play([tell.param("COMPASS_OFS_X", at.pop(ms))])
        samples += bench.play([(ms, data)])
    wrong = [
        r for r in samples if abs(r.mag_b_mg[0] - r.stored_b_mg[0] + offsets[round(r.boot_ns / 4e7) - 250, 0]) > 0.5
    ]
    assert wrong == []  # every value was undone with the offsets it was sent with, learnt from or not
    for start in (change, back):
        at_ns = (10_000 + start * 40) * 10**6
        assert [r for r in samples if r.learnt and at_ns <= r.boot_ns < at_ns + 1.36e9] == []
        first = next(r for r in samples if r.boot_ns >= at_ns + 1.5e9)
        assert first.learnt and first.estimate.samples > 300
    last = samples[-1]
    assert Reason.PARAMETERS_CHANGED in last.verdict.reasons
    assert np.all(np.abs(last.offsets_mg + HARD_IRON_MG) < 4.0 * last.sigma_mg)


def test_stored_offsets_heard_late_turn_a_change_into_an_answer():
    frames = flight(seconds=40.0, told=None, offsets_mg=np.array([50.0, -20.0, 10.0]))
    bench = Bench()
    before = bench.play(frames[: len(frames) // 2])[-1]
    assert before.relative
    assert Reason.RELATIVE_ONLY in before.verdict.reasons
    assert before.verdict.state is not State.READY
    assert before.device_id == 0
    told = STORED | {"COMPASS_OFS_X": 50.0, "COMPASS_OFS_Y": -20.0, "COMPASS_OFS_Z": 10.0}
    bench.play([Teller(1).params(told)])
    after = bench.play(frames[len(frames) // 2 :])[-1]
    assert not after.relative
    assert Reason.RELATIVE_ONLY not in after.verdict.reasons
    assert np.all(np.abs(after.offsets_mg + HARD_IRON_MG) < 4.0 * after.sigma_mg + 1.0)
    assert np.all(np.abs(before.offsets_mg + HARD_IRON_MG + (50.0, -20.0, 10.0)) < 4.0 * before.sigma_mg + 2.0)


def test_a_stored_matrix_that_cannot_be_undone_is_counted_and_gives_nothing():
    singular = STORED | {"COMPASS_DIA_X": 0.0}
    bench = Bench()
    frames = flight(seconds=4.0, told=singular)
    assert bench.play(frames) == []
    counts = bench.service.counts()["vehicle 1"]
    assert counts["compass 1: stored matrix cannot be undone"] == 100
    bench.play([Teller(1).param("COMPASS_DIA_X", 1.0)])
    assert len(bench.play(flight(seconds=4.0, told=None, from_ms=14_000))) > 90


def test_a_reboot_begins_again():
    bench = Bench()
    bench.play(flight(seconds=20.0, from_ms=500_000))
    assert bench.records[-1].estimate.samples > 400
    again = bench.play(flight(seconds=4.0, told=None, from_ms=3000))
    assert bench.service.counts()["vehicle 1"]["reboots"] == 1
    assert again[0].estimate.samples == 0
    assert again[-1].relative  # parameters must be read again
    assert bench.pipeline.vehicles[1].phase.takeoff_ns > 3000 * 10**6
    assert bench.pipeline.vehicles[1].phase.takeoff_ns < 10_000 * 10**6


def test_on_the_ground_nothing_is_learnt_unless_asked():
    for on_ground in (False, True):
        bench = Bench(with_value(Settings(), "learn", "on_ground", on_ground))
        records = bench.play(flight(seconds=8.0, height_m=0.5))
        # Boot times at once after parameters were heard are left out by the settling time.
        assert any(r.learnt for r in records) is on_ground
        if not on_ground:
            assert records[-1].verdict.reasons[0] is Reason.NOT_FLYING
            assert not records[-1].heading.valid


def test_learning_can_be_switched_off_and_keeps_what_is_known():
    bench = Bench()
    frames = flight(seconds=30.0)
    known = bench.play(frames[: len(frames) // 2])[-1]
    bench.pipeline.apply(with_value(bench.pipeline.settings, "learn", "on", False))
    later = bench.play(frames[len(frames) // 2 :])
    assert {r.offsets_mg.tobytes() for r in later} == {known.offsets_mg.tobytes()}
    assert not any(r.learnt for r in later)
    assert all(r.heading.valid for r in later)


def test_learn_for_freezes_so_long_after_take_off():
    bench = Bench()
    frames = flight(seconds=20.0)
    bench.play(frames[:4])
    bench.pipeline.vehicles[1].learn_for_s = 12.0
    records = bench.play(frames[4:])
    assert max(r.boot_ns for r in records if r.learnt) == pytest.approx(22.0e9, abs=0.1e9)
    frozen = [r for r in records if r.boot_ns > 22.3e9]
    assert len({r.offsets_mg.tobytes() for r in frozen}) == 1


def test_changed_limits_count_at_once():
    bench = Bench()
    frames = flight(seconds=50.0)
    bench.play(frames[:-300])
    assert bench.records[-1].verdict.state is State.READY
    bench.pipeline.apply(with_value(bench.pipeline.settings, "gate", "axis_sigma_mg", 2.0))
    assert bench.play(frames[-300:])[-1].verdict.axes != (AxisState.OBSERVED,) * 3


def test_a_place_from_the_settings_serves_a_vehicle_without_gps():
    frames = [(ms, d) for ms, d in flight(seconds=20.0) if d[7:10] != bytes((33, 0, 0))]
    no_gps = [(ms, d[: len(Teller().heartbeat())] if d[7:10] == b"\0\0\0" else d) for ms, d in frames]
    onground = with_value(Settings(), "learn", "on_ground", True)
    bare = Bench(onground).play(no_gps)[-1]
    assert Reason.NO_POSITION in bare.verdict.reasons
    assert not bare.heading.true_valid
    tree = onground.place.__class__(lat_deg=47.0, lon_deg=8.0)
    placed = Bench(onground.__class__(learn=onground.learn, place=tree)).play(no_gps)[-1]
    assert Reason.NO_POSITION not in placed.verdict.reasons
    assert placed.heading.true_valid


def test_the_field_model_is_asked_for_the_date_of_the_vehicle():
    asked = []

    def model(lat, lon, alt, unix_ns):
        asked.append(unix_ns)
        return earth_model(lat, lon, alt, unix_ns)

    from magmav.core.types import PositionReading, TimeReading

    p = Pipeline(Settings(), model, unix_offset_ns=7 * 10**17)
    p.step(PositionReading(1, "GPS_RAW_INT", 5 * 10**9, 47.0, 8.0, 400.0), 10**9)
    assert p.vehicles[1].expected(7 * 10**17 + 10**9) is not None
    assert asked == [7 * 10**17 + 10**9]
    p.step(TimeReading(1, 5 * 10**9, 16 * 10**17), 2 * 10**9)
    p.vehicles[1].expected(7 * 10**17 + 2 * 10**9)
    assert asked[-1] == pytest.approx(16 * 10**17, abs=10**10)


def test_a_stuck_compass_is_said_and_its_heading_withdrawn():
    frames = flight(seconds=30.0)
    bench = Bench()
    bench.play(frames[: len(frames) // 2])
    assert bench.records[-1].heading.valid
    tell, stuck = Teller(1), np.array([300, 20, 600])
    rest = [(ms, tell.imu(ms, stuck) if d[7:10] == bytes((27, 0, 0)) else d) for ms, d in frames[len(frames) // 2 :]]
    last = bench.play(rest)[-1]
    assert last.verdict.state is State.REFUSED
    assert last.verdict.reasons[0] is Reason.FROZEN
    assert not last.heading.valid
