"""The Cramer-Rao bound: closed forms, monotony, Jacobians by differences."""

import dataclasses
import math
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from estimator_bench.bound import bound, heading_map, jacobian, layout, prior
from estimator_bench.flights import rotations, true_flight
from estimator_bench.scenarios import SCENARIOS, Link
from estimator_bench.score import heading_rms_deg, sensed
from estimator_bench.telemetry import rotation_vectors, sent


def flown(scenario, seed, seconds=30.0):
    """A short flight; the recursion does not care."""
    return sent(scenario, seed, true_flight(scenario.motion, scenario.kind, seed, seconds=seconds))


@pytest.fixture(scope="module")
def rich():
    """A flight that has all the unknowns there are."""
    both = dataclasses.replace(SCENARIOS["figure8"].compass, soft=0.05, throttle_mg=80.0, drift_mgps=0.3)
    return flown(dataclasses.replace(SCENARIOS["figure8"], compass=both), 2)


def test_every_column_of_the_jacobian_is_a_difference(rich):
    at = layout(rich)
    r = np.random.default_rng(1)
    C = rotations(*r.uniform(-1.0, 1.0, (3, 1)))[0]
    rate, felt, throttle, t_s = r.normal(size=3), r.normal(size=2), 0.6, 40.0
    field, soft = np.array((210.0, 0.0, 430.0)), rich.errors.soft

    def sensor(x):
        turn = np.zeros(3)
        turn[2] = x[at.yaw]
        turn[:2] = x[at.tilt] + x[at.misled] * np.array((-felt[1], felt[0]))
        s = np.zeros((3, 3))
        for value, (i, j) in zip(x[at.soft], ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)), strict=True):
            s[i, j] = s[j, i] = value
        # Axes turned by -v: the field itself turns by v.
        body = C @ rotation_vectors(-turn[None])[0] @ (field + x[at.field])
        body = rotation_vectors(-rate[None] * x[at.late])[0] @ body
        out = (np.eye(3) + soft + s) @ body + x[at.iron]
        return out + x[at.throttle] * throttle + x[at.drift] * t_s

    H = jacobian(C, rate, field, soft, throttle, felt, t_s, at)
    for k in range(at.size):
        step = np.zeros(at.size)
        step[k] = 1e-6
        assert np.allclose((sensor(step) - sensor(-step)) / 2e-6, H[:, k], atol=1e-4), k


def test_heading_map_is_what_the_score_measures(rich):
    """A small error of the iron costs the heading what the map says."""
    at = layout(rich)
    J = heading_map(rich, 10.0, at)
    error = np.array((0.3, -0.2, 0.4))
    x = np.zeros(at.size)
    x[at.iron] = error
    said = math.degrees(float(np.sqrt(np.mean((J @ x) ** 2))))
    back = np.linalg.inv(np.eye(3) + rich.errors.soft)
    # What is left of the iron lies in the sensor's reading, so an estimate too small by it leaves plus the error.
    left = (sensed(rich, 10.0) - rich.iron_at(10.0) + error) @ back.T
    assert said == pytest.approx(heading_rms_deg(left), rel=2e-3)


def test_more_data_never_hurts_and_the_prior_is_the_start():
    flight = flown(SCENARIOS["hover_only"], 1)
    at = layout(flight)
    got = bound(flight, (-1.0, 2.0, 8.0, 30.0, 178.0)).heading_deg
    J = heading_map(flight, 0.0, at)
    first = math.degrees(math.sqrt(float(np.einsum("ij,jk,ik->i", J, prior(flight, at), J).mean())))
    assert got[0] == pytest.approx(first, rel=1e-6)
    assert list(got) == sorted(got, reverse=True)


def test_a_step_tears_the_bound_open_and_drift_costs():
    slow = Link(5.0, 5.0)
    plain, stepped, drifting = (
        bound(flown(dataclasses.replace(SCENARIOS[n], link=slow), 1, 110.0), (89.0, 90.3, 109.0))
        for n in ("figure8", "step", "drift")
    )
    assert stepped.heading_deg[0] == pytest.approx(plain.heading_deg[0], rel=0.05)
    assert stepped.heading_deg[1] > 1.5 * plain.heading_deg[1]
    assert drifting.heading_deg[2] > 1.3 * plain.heading_deg[2]


def test_a_still_compass_that_knows_all_else_averages_its_noise():
    """With attitude, field and delay known exactly the bound is noise over root n, and nothing else."""
    flight = flown(SCENARIOS["hover_only"], 2)
    at = layout(flight)
    information = np.linalg.inv(prior(flight, at)[at.iron, at.iron])
    variance = flight.errors.noise_mg**2 + 1.0 / 12.0
    information += np.eye(3) * (len(flight.heard) / variance)
    least = np.sqrt(np.diag(np.linalg.inv(information)))
    assert (np.array(bound(flight, (40.0,)).iron_mg[-1]) >= 0.999 * least).all()
