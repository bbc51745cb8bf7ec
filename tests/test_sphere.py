"""The sphere: exact on a tumble, indifferent to mounting and to attitude, through the stored matrix."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
from honest_flight import samples
from rotated import MOUNTINGS, remounted
from synthetic_flight import HARD_IRON_MG, SOFT_IRON, fly

from magmav.core.estimators.sphere import SphereEstimator
from magmav.core.types import NO_SHAPING, Sample, Shaping, mat3, vec3


def tumble(n=300, soft=False, noise_mg=0.0):
    """Every attitude there is, in the sensor's axes."""
    r = np.random.default_rng(11)
    d = r.normal(size=(n, 3))
    field = 476.0 * d / np.linalg.norm(d, axis=1)[:, None]
    if soft:
        field = field @ np.linalg.inv(SOFT_IRON).T
    return field + HARD_IRON_MG + r.normal(0, noise_mg, (n, 3)) if noise_mg else field + HARD_IRON_MG


def sample(mag, shaping=NO_SHAPING, roll=0.0, pitch=0.0, learn=True):
    zero = vec3((0, 0, 0), "rate")
    return Sample(1, 1, 0, 0.1, vec3(mag, "f"), shaping, zero, roll, pitch, 0.0, 0.0, 0.0, False, "ATTITUDE", learn)


def learnt(stream):
    e = SphereEstimator()
    for s in stream:
        e.step(s)
    return e.estimate(None)


def test_exact_on_a_noise_free_tumble():
    got = learnt(sample(m) for m in tumble())
    assert got.hard_iron_b_mg == pytest.approx(HARD_IRON_MG, abs=1e-8)
    assert got.residual_mg < 1e-6
    assert got.samples == 300


def test_a_stored_matrix_makes_the_ellipsoid_round():
    shaping = Shaping(mat3(SOFT_IRON, "m"), vec3((3, -2, 5), "motor"))
    corrected = [m - np.linalg.solve(SOFT_IRON, shaping.motor_b_mg) for m in tumble(soft=True)]
    got = learnt(sample(m, shaping) for m in corrected)
    assert got.hard_iron_b_mg == pytest.approx(HARD_IRON_MG, abs=1e-8)
    plain = learnt(sample(m) for m in tumble(soft=True))
    assert np.linalg.norm(plain.hard_iron_b_mg - HARD_IRON_MG) > 1.0 or plain.residual_mg > 5.0


def test_horizontal_and_down_field_of_a_flight():
    f = fly(60.0)
    rows = zip(f.sensor_b_mg, f.roll_rad, f.pitch_rad, strict=True)
    got = learnt(sample(m, roll=r, pitch=p) for m, r, p in rows)
    assert got.hard_iron_b_mg == pytest.approx(HARD_IRON_MG, abs=1e-5)
    assert got.down_mg == pytest.approx(430.0, abs=1e-4)
    assert got.horizontal_mg == pytest.approx(np.hypot(205, 14), abs=1e-4)


@pytest.mark.parametrize("mounting", MOUNTINGS.values(), ids=MOUNTINGS)
def test_the_answer_turns_with_the_mounting(mounting):
    flight = samples("figure eight", 1)
    here, there = learnt(flight), learnt(remounted(flight, mounting))
    assert there.hard_iron_b_mg == pytest.approx(mounting @ here.hard_iron_b_mg, abs=1e-6)
    assert there.covariance_mg2 == pytest.approx(mounting @ here.covariance_mg2 @ mounting.T, rel=1e-6)
    assert (there.down_mg, there.horizontal_mg) == pytest.approx((here.down_mg, here.horizontal_mg), abs=1e-6)


def test_what_must_not_be_learnt_is_not():
    flight = [sample(m) for m in tumble(100)]
    poison = [replace(s, mag_b_mg=vec3(s.mag_b_mg * 3, "f"), learn=False) for s in flight]
    got = learnt([*flight, *poison])
    assert got.samples == 100
    assert got.hard_iron_b_mg == pytest.approx(HARD_IRON_MG, abs=1e-8)


def test_too_little_gives_none():
    assert learnt([]) is None
    assert learnt(sample(m) for m in tumble(7)) is None
    assert learnt([sample((200.0, 10.0, 430.0))] * 100) is None


def test_white_noise_is_claimed_for_what_it_is():
    r, ratios = np.random.default_rng(12), []
    for _ in range(80):
        noisy = tumble(120) + r.normal(0.0, 4.0, (120, 3))
        got = learnt(sample(m) for m in noisy)
        ratios.append((got.hard_iron_b_mg - HARD_IRON_MG) / got.own_sigma_mg)
    assert 0.7 < np.sqrt(np.mean(np.square(ratios))) < 1.2


def test_a_copy_goes_on_to_the_same_bits():
    flight = [sample(m) for m in tumble(200, noise_mg=4.0)]
    e = SphereEstimator()
    for s in flight[:100]:
        e.step(s)
    twins = [e, copy.deepcopy(e), pickle.loads(pickle.dumps(e))]
    answers = set()
    for twin in twins:
        for s in flight[100:]:
            twin.step(s)
        answers.add(twin.estimate(None).hard_iron_b_mg.tobytes())
    assert len(answers) == 1
