"""Three by three in plain numbers says what numpy says."""

import numpy as np
import pytest

from magmav.core.threes import inverse3, squared_distance


@pytest.mark.parametrize("seed", range(8))
def test_an_inverse_undoes(seed):
    matrix = np.random.default_rng(seed).normal(0.0, 10.0 ** (seed - 4), (3, 3))
    assert inverse3(matrix) == pytest.approx(np.linalg.inv(matrix), rel=1e-9)


@pytest.mark.parametrize("size", (1, 2, 3))
@pytest.mark.parametrize("wide", (1.0, 1e4))
def test_a_distance_counts_every_direction_by_its_own_sigma(size, wide):
    r = np.random.default_rng(size)
    root = r.normal(0.0, 1.0, (size, size)) * np.geomspace(1.0, wide, size)
    covariance, off = root @ root.T + np.eye(size), r.normal(0.0, 30.0, size)
    before = covariance.copy(), off.copy()
    assert squared_distance(off, covariance) == pytest.approx(float(off @ np.linalg.inv(covariance) @ off), rel=1e-6)
    assert np.array_equal(covariance, before[0])
    assert np.array_equal(off, before[1])


def test_what_is_singular_is_told():
    with pytest.raises(ZeroDivisionError):
        inverse3(np.ones((3, 3)))
    with pytest.raises(ZeroDivisionError):
        squared_distance(np.ones(3), np.diag((1.0, 1.0, 0.0)))
