"""Vehicles that cannot be tumbled (users.md N1): X and Y from yaw alone, Z left alone or labelled, a deviation card."""

import math
from functools import cache

import numpy as np
import pytest
from ground_frames import BOAT, ROVER, boat, frames, rover, true_yaw
from honest_flight import Motion
from memory_flight import STORED, Bench
from synthetic_flight import DECLINATION_RAD

from magmav.core.types import AxisState, Reason, State
from magmav.settings import Settings, with_value

SEEN, MODEL, BLIND = AxisState.OBSERVED, AxisState.FROM_MODEL, AxisState.NOT_OBSERVED
SECONDS = 120.0
STORED_Z = 37.25
HZ = 10


def iron(seed):
    """400 mG in any direction."""
    way = np.random.default_rng(1000 + seed).normal(size=3)
    return 400.0 * way / np.linalg.norm(way)


@cache
def driven(motion, kind, seed, estimator, *, gps, seconds=SECONDS):
    """Records of two turns in two minutes; the autopilot holds some offset of the down axis."""
    bench = Bench(with_value(Settings(), "learn", "estimator", estimator))
    told = STORED | {"COMPASS_OFS_Z": STORED_Z}
    return bench.play(frames(motion, kind, seconds, seed, gps=gps, iron_mg=iron(seed), hz=HZ, told=told))


def heading_rms_deg(records, motion, seed, from_s=100.0):
    """Against the true yaw less declination, over the last turns."""
    yaw = true_yaw(motion, SECONDS, seed, HZ) - DECLINATION_RAD
    errors = [
        math.remainder(r.heading.magnetic_rad - yaw[round((r.boot_ns / 1e9 - 10.0) * HZ)], math.tau)
        for r in records
        if r.boot_ns > from_s * 1e9
    ]
    assert len(errors) > 200
    return math.degrees(math.sqrt(np.mean(np.square(errors))))


def level_axes_are_right(last, seed):
    assert last.verdict.axes[:2] == (SEEN, SEEN)
    assert last.verdict.state is State.READY
    assert np.all(np.abs(last.estimate.hard_iron_b_mg - iron(seed))[:2] < 4.0 * last.sigma_mg[:2])
    assert np.all(last.sigma_mg[:2] < 10.0)


@pytest.mark.parametrize("estimator", ["kalman", "adaptive"])
@pytest.mark.parametrize(("motion", "kind"), [(boat, BOAT), (rover, ROVER)])
def test_AT_1a_two_turns_show_the_level_axes_and_the_heading(motion, kind, estimator):
    records = driven(motion, kind, 1, estimator, gps=False)
    last = records[-1]
    level_axes_are_right(last, 1)
    assert heading_rms_deg(records, motion, 1) <= 3.0
    # The down axis is labelled by its claimed sigma, never observed beyond 20 mG, and honest where it is observed.
    if last.estimate.own_sigma_mg[2] > 20.0 or motion is rover:
        assert last.verdict.axes[2] is BLIND
    if last.verdict.axes[2] is BLIND:
        assert last.offsets_mg[2] == STORED_Z  # bit for bit
        assert Reason.Z_NOT_OBSERVED in last.verdict.reasons
    else:
        assert abs(last.estimate.hard_iron_b_mg[2] - iron(1)[2]) < 3.0 * last.sigma_mg[2]


@pytest.mark.parametrize("estimator", ["kalman", "adaptive"])
def test_AT_1b_with_a_position_the_down_axis_of_a_rover_is_never_called_observed(estimator):
    records = driven(rover, ROVER, 2, estimator, gps=True)
    last = records[-1]
    level_axes_are_right(last, 2)
    assert {r.verdict.axes[2] for r in records} <= {MODEL, BLIND}
    if last.verdict.axes[2] is MODEL:
        assert Reason.Z_FROM_MODEL in last.verdict.reasons
        assert abs(last.estimate.hard_iron_b_mg[2] - iron(2)[2]) < 3.0 * last.sigma_mg[2]
    else:
        assert last.offsets_mg[2] == STORED_Z
    if estimator == "kalman":
        assert last.verdict.axes[2] is MODEL


def onto_a_ramp(t, r):
    """The rover, and its nose 8 degrees up in the last half second."""
    m = rover(t, r)
    return Motion(m.roll_rad, np.where(t > t[-1] - 0.5, np.radians(8.0), 0.0), m.yaw_rad)


def test_AT_1a_the_heading_of_a_flat_rover_is_less_sure_when_it_tilts():
    """An unknown down axis of 400 mG is 56 mG across at 8 degrees: a heading that does not say so would be a lie."""
    records = driven(onto_a_ramp, ROVER, 3, "kalman", gps=False, seconds=70.0)
    level, tilted = records[-10].heading, records[-2].heading
    assert records[-2].pitch_rad > math.radians(6.0) > records[-10].pitch_rad
    assert tilted.sigma_rad > 1.5 * level.sigma_rad
    yaw = true_yaw(onto_a_ramp, 70.0, 3, HZ)[-1] - DECLINATION_RAD
    assert abs(math.remainder(tilted.magnetic_rad - yaw, math.tau)) < 3.0 * tilted.sigma_rad


def test_AT_1c_no_word_of_the_planar_path_asks_to_bank_pitch_roll_or_turn_over():
    """Every reason a drive brings, from its first second to its last."""
    for motion, kind in ((rover, ROVER), (boat, BOAT)):
        records = driven(motion, kind, 1, "kalman", gps=False)
        words = {reason.text for r in records for reason in r.verdict.reasons}
        assert words
        assert not [w for w in words if any(x in w for x in ("bank", "pitch", "roll", "nose", "invert", "turn over"))]
