"""What flies, turned in somebody's hands: it teaches, it is not ready but on the bench, and steel never teaches."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from ground_frames import COPTER, ROVER, eased, frames, parked, rover, tumble
from honest_flight import Motion
from memory_flight import Bench
from memory_flight import flight as flown
from synthetic_flight import HARD_IRON_MG

from magmav.cli import parser
from magmav.commands.common import settings_of
from magmav.core.handling import Handling
from magmav.core.types import NO_SHAPING, Reason, Sample, State, vec3
from magmav.settings import Settings, with_value

BENCH = with_value(Settings(), "learn", "on_ground", True)
STEEL_N = np.array([180.0, 120.0, -250.0])  # what a steel pad adds where it stands


class Heard:
    """A bench that also keeps every Sample."""

    def __init__(self, settings=None):
        self.samples = []
        self.bench = Bench(settings)
        self.bench.pipeline._tap = lambda sample, *_: self.samples.append(sample)

    def play(self, some):
        """Records and samples of these frames."""
        before = len(self.samples)
        records = self.bench.play(some)
        return records, self.samples[before:]

    @property
    def vehicle(self):
        return self.bench.pipeline.vehicles[1]


@cache
def tumbled(bench=False):
    heard = Heard(BENCH if bench else None)
    return heard.play(frames(tumble, COPTER, 60.0, 5))


def test_a_tumble_gives_an_answer_but_ready_waits_for_a_flight():
    records, samples = tumbled()
    last = records[-1]
    assert np.all(np.abs(last.offsets_mg + HARD_IRON_MG) < 4.0 * last.sigma_mg)
    assert np.all(last.sigma_mg < 10.0)
    assert last.heading.valid
    assert last.verdict.state is State.LEARNING
    assert last.verdict.reasons == (Reason.NOT_FLYING,)  # all else is there
    assert all(r.verdict.state is not State.READY for r in records)
    assert all(s.by_hand for s in samples if s.learn)
    assert not any(s.learn or s.by_hand for s in samples if s.boot_ns < 13e9)  # it lay still for three seconds


def test_on_the_bench_the_same_tumble_is_ready():
    records, samples = tumbled(bench=True)
    assert records[-1].verdict.state is State.READY
    assert Reason.NOT_FLYING not in records[-1].verdict.reasons
    assert np.all(np.abs(records[-1].offsets_mg + HARD_IRON_MG) < 4.0 * records[-1].sigma_mg)
    assert all(s.by_hand == s.learn for s in samples)


@pytest.mark.parametrize("words", [["run", "udpin:127.0.0.1:1"], ["replay", "x.tlog"]])
def test_the_flag_is_the_setting(words):
    assert settings_of(parser().parse_args([*words, "--bench"])).learn.on_ground
    assert not settings_of(parser().parse_args(words)).learn.on_ground


@pytest.mark.parametrize("armed", [False, True])
def test_S10_parked_on_steel_teaches_nothing_rocked_by_wind_or_turned_on_its_wheels(armed):
    heard = Heard()
    records, samples = heard.play(frames(parked, COPTER, 45.0, 6, near_mg=STEEL_N, armed=armed))
    assert len(samples) > 1000
    assert not any(s.learn or s.by_hand for s in samples)
    assert records[-1].estimate.samples == 0
    assert not records[-1].heading.valid
    assert records[-1].verdict.reasons[0] is Reason.NOT_FLYING


def put_down(t, r):
    """The tumble for 20 s, then level within 2 s, and left on the pad."""
    m, left = tumble(t, r), 1.0 - eased(t - 20.0)
    return Motion(m.roll_rad * left, m.pitch_rad * left, np.where(t < 22.0, m.yaw_rad, m.yaw_rad[t < 22.0][-1]))


def test_put_down_on_steel_it_stops_learning_within_a_second():
    seconds, hz = 40.0, 25
    near = np.zeros((int(seconds * hz), 3))
    near[int(21.5 * hz) :] = STEEL_N
    heard = Heard()
    records, samples = heard.play(frames(put_down, COPTER, seconds, 7, near_mg=near))
    taught = [s.boot_ns / 1e9 - 10.0 for s in samples if s.learn]
    assert 19.0 < max(taught) < 22.0 + 1.1
    assert np.all(np.abs(records[-1].offsets_mg + HARD_IRON_MG) < 5.0 * records[-1].sigma_mg)


def test_armed_on_the_ground_teaches_nothing_even_in_the_hands():
    _, samples = Heard().play(frames(tumble, COPTER, 25.0, 5, armed=True, height_m=2.0))
    assert not any(s.learn or s.by_hand for s in samples)


def test_flight_follows_the_hands_and_makes_it_ready():
    """by_hand ends with the flight; what is carried into the shed afterwards teaches nothing at all."""
    heard = Heard()
    heard.play(frames(tumble, COPTER, 20.0, 5))
    assert heard.samples[-1].by_hand
    records, air = heard.play(flown(seconds=25.0, from_ms=31_000, told=None))
    assert all(s.learn and not s.by_hand for s in air)
    assert records[-1].verdict.state is State.READY
    known = records[-1].offsets_mg.tobytes()
    records, carried = heard.play(frames(tumble, COPTER, 20.0, 9, from_ms=57_000, near_mg=STEEL_N))
    assert not any(s.learn or s.by_hand for s in carried)
    assert records[-1].offsets_mg.tobytes() == known
    assert records[-1].verdict.state is State.READY


def test_a_rover_learns_on_the_ground_armed_or_not_and_needs_no_hands():
    for armed in (False, True):
        _, samples = Heard().play(frames(rover, ROVER, 12.0, 8, armed=armed))
        assert all(s.learn for s in samples if s.boot_ns > 11.1e9)
        assert not any(s.by_hand for s in samples)


def test_what_never_says_what_it_is_learns_after_three_seconds_as_before():
    """A recorder without heartbeats: nobody could say whether it flies."""
    heard = Heard()
    some = frames(tumble, COPTER, 12.0, 5, gps=False)
    silent = [(ms, d) for ms, d in some if d[7:10] != bytes(3)]  # message 0 is the heartbeat
    _, samples = heard.play(silent)
    assert heard.vehicle.phase.kind is None
    assert all(s.learn == (s.boot_ns >= 13e9) and not s.by_hand for s in samples)


def test_while_held_or_settling_the_hands_teach_nothing():
    heard = Heard()
    some = frames(tumble, COPTER, 24.0, 5)
    third = len(some) // 3
    heard.play(some[:third])
    heard.vehicle.settle(1)
    _, samples = heard.play(some[third : 2 * third])
    assert not any(s.learn for s in samples[:20]) and samples[-1].learn
    heard.bench.pipeline.apply(with_value(Settings(), "learn", "on", False))
    _, samples = heard.play(some[2 * third :])
    assert not any(s.learn or s.by_hand for s in samples)


# ---------------------------------------------------------------- the watch by itself


def lies(t_s, roll_deg=0.0, pitch_deg=0.0, rate_degs=0.0):
    return Sample(
        1, 1, round(t_s * 1e9), 0.1, vec3((0, 0, 0), "m"), NO_SHAPING, vec3((math.radians(rate_degs), 0, 0), "r"),
        math.radians(roll_deg), math.radians(pitch_deg), 0.0, 0.0, 0.0, False, "ATTITUDE", True,
    )  # fmt: skip


def seen(rolls, rate_degs=None, step_s=0.1):
    """Handled at each of these rolls; the gyro agrees unless told otherwise."""
    watch, out, before = Handling(), [], rolls[0]
    for i, roll in enumerate(rolls):
        rate = (roll - before) / step_s if rate_degs is None else rate_degs
        out.append(watch.see(lies(i * step_s, roll, rate_degs=rate)))
        before = roll
    return out


def test_taken_up_by_twenty_degrees_and_no_less():
    assert not any(seen([*np.linspace(0, 19, 10), *np.linspace(19, 0, 10)] * 5))
    assert seen([*np.linspace(0, 21, 10)])[-1]


def test_a_tail_dragger_may_lie_at_any_angle():
    for lying in (12.0, 90.0, 180.0):
        assert not any(seen([lying + math.sin(i) for i in range(100)]))
        assert seen([lying] * 20 + [*np.linspace(lying, lying - 30, 10)])[-1]


def test_it_ends_a_second_after_it_rests_wherever_that_is():
    got = seen([0.0] * 20 + [*np.linspace(0, 60, 10)] + [60.0] * 30)
    assert got[29] and got[38] and not got[41] and not any(got[41:])


def test_turning_alone_counts_only_while_tilted():
    watch = Handling()
    for i in range(10):
        watch.see(lies(i / 10, 4.0 * i, rate_degs=40.0))
    assert all(watch.see(lies(1.0 + i / 10, 36.0, rate_degs=30.0)) for i in range(100))
    level = Handling()
    assert not any(level.see(lies(i / 10, 0.0, rate_degs=90.0)) for i in range(100))


def test_an_attitude_that_jumps_is_nobody_lifting_it():
    assert not any(seen([0.0] * 20 + [90.0] * 30, rate_degs=0.3))


def test_after_silence_nothing_is_taken_for_granted():
    watch = Handling()
    watch.see(lies(0.0))
    assert not watch.see(lies(60.0, 90.0, rate_degs=20.0))


def test_several_compasses_of_one_vehicle_see_one_handling():
    watch, got = Handling(), []
    for i in range(20):
        for compass in (1, 2, 3):
            got.append(watch.see(replace(lies(i / 10, 4.0 * i, rate_degs=40.0), compass=compass)))
    assert got[-3:] == [True] * 3 and not any(got[:12])
