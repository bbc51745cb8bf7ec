"""The circle of the seed paper: right on level turns, blind to the down axis and honest about it."""

import numpy as np
import pytest
from test_sphere import sample

from magmav.core.estimators.circle import CircleEstimator
from magmav.core.gate import axis_states
from magmav.core.types import AxisState, Shaping, mat3, vec3

IRON = np.array([310.0, -140.0, 220.0])


def turns(roll=0.0, pitch=0.0, noise_mg=0.0, n=400):
    """Level or steadily leaning turns: (field (n, 3), roll, pitch)."""
    a = np.linspace(0, 4 * np.pi, n)
    level = np.stack((205 * np.cos(a), -205 * np.sin(a), np.full(n, 430.0)), 1)
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    to_body = np.array([[cp, 0, -sp], [sr * sp, cr, sr * cp], [cr * sp, -sr, cr * cp]])
    field = level @ to_body.T + IRON
    return field + np.random.default_rng(2).normal(0, noise_mg, field.shape) if noise_mg else field


def learnt(fields, roll=0.0, pitch=0.0, shaping=None):
    e = CircleEstimator()
    for m in fields:
        e.step(sample(m, roll=roll, pitch=pitch) if shaping is None else sample(m, shaping, roll, pitch))
    return e.estimate(None)


def test_level_turns_give_the_two_level_axes_and_leave_the_third_alone():
    got = learnt(turns())
    assert got.hard_iron_b_mg[:2] == pytest.approx(IRON[:2], abs=1e-8)
    assert got.hard_iron_b_mg[2] == pytest.approx(0.0, abs=1e-9)
    assert got.horizontal_mg == pytest.approx(205.0, abs=1e-8)
    assert got.down_mg == pytest.approx(650.0)  # the sum of both, which is all that can be seen


def test_the_down_axis_is_not_observed_and_says_so():
    got = learnt(turns(noise_mg=4.0))
    assert got.own_sigma_mg[2] > 500.0
    assert max(got.own_sigma_mg[:2]) < 2.0
    states = axis_states(got.own_sigma_mg, got.own_sigma_mg, 10.0)
    assert states == (AxisState.OBSERVED, AxisState.OBSERVED, AxisState.NOT_OBSERVED)


def test_a_steady_lean_is_levelled_first():
    """Body iron along the levelled horizontal plane comes back; what points along earth's down cannot."""
    roll = 0.2
    got = learnt(turns(roll), roll)
    level = np.array([[1, 0, 0], [0, np.cos(roll), -np.sin(roll)]])
    assert level @ got.hard_iron_b_mg == pytest.approx(level @ IRON, abs=1e-7)
    assert np.diag(level @ got.covariance_mg2 @ level.T) == pytest.approx([0, 0], abs=0.01)


def test_a_stored_matrix_is_fitted_through():
    soft = np.array([[1.1, 0.05, 0.0], [0.05, 0.93, 0.0], [0.0, 0.0, 1.0]])
    sensor = (turns() - IRON) @ np.linalg.inv(soft).T + IRON
    got = learnt(sensor, shaping=Shaping(mat3(soft, "m"), vec3((0, 0, 0), "motor")))
    assert got.hard_iron_b_mg[:2] == pytest.approx(IRON[:2], abs=1e-6)


def test_too_little_gives_none_and_ground_time_teaches_nothing():
    assert learnt(turns()[:5]) is None
    e = CircleEstimator()
    for m in turns():
        e.step(sample(m, learn=False))
    assert e.estimate(None) is None
