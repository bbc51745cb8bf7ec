"""One or two attitudes a second: what lies between two is guessed at, so the bank claims less and TWOSTEP is heard."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from estimator_bench.running import run, tape
from estimator_bench.scenarios import SCENARIOS, Link
from estimator_bench.score import score
from estimator_bench.telemetry import fly

from magmav.core.motion import Motion
from magmav.core.types import AttitudeReading, InertialReading, vec3

STILL = vec3((0.0, 0.0, 0.0), "rate")
DOWN = vec3((0.0, 0.0, -9.81), "force")


def survey(link):
    return replace(SCENARIOS["survey"], link=link)


@pytest.mark.parametrize(("link", "seed"), [(Link(2.0, 2.0), 4), (Link(10.0, 2.0), 4), (Link(1.0, 1.0), 3)])
def test_never_ready_and_wrong_and_no_surer_than_it_is(link, seed):
    """Seeds at which the bank alone was 20 mG wrong, sure to 8, and READY for a minute and a half."""
    flight = fly(survey(link), seed)
    heard = tape(flight)
    judged = score(flight, heard, run("adaptive", heard))
    assert judged.ready_wrong == judged.ready_beyond == 0.0
    assert max(judged.nees) < 3.0
    assert judged.full_deg[-1] < 1.5


def test_motion_says_how_far_apart_the_readings_of_its_tilt_are():
    motion = Motion()
    for i in range(4):
        motion.attitude(AttitudeReading(1, "ATTITUDE", i * 500_000_000, 0.0, 0.0, 0.0, STILL))
        for k in range(5):
            motion.inertial(InertialReading(1, "RAW_IMU", i * 500_000_000 + k * 100_000_000, DOWN, STILL))
    state = motion.at(1_600_000_000)
    assert state is not None and state.source == "ATTITUDE" and state.every_s == pytest.approx(0.5)
    for k in range(1, 20):
        motion.inertial(InertialReading(1, "RAW_IMU", 1_900_000_000 + k * 50_000_000, DOWN, STILL))
    state = motion.at(2_850_000_000)
    assert state is not None and state.source == "OWN" and state.every_s == pytest.approx(0.05)


def test_what_the_bank_claims_changes_with_the_attitudes_pace_alone():
    """The same samples, said to come from attitudes half a second apart: five times the bank's sigma, or TWOSTEP's."""
    flight = fly(survey(Link(10.0, 10.0)), 3)
    heard = tape(flight)[:250]  # too little for TWOSTEP to know more than the bank
    slow = [replace(h, sample=replace(h.sample, tilt_every_s=0.5)) for h in heard]
    sure, unsure = (run("adaptive", one).ticks[-1].estimate for one in (heard, slow))
    assert (np.diag(unsure.covariance_mg2) > np.diag(sure.covariance_mg2)).all()
