"""Streaming estimators of hard iron: one method per file, one contract.

An estimator takes Samples one at a time in O(1) and says on request what it believes. It must not know where Samples
come from. It can be copied at any moment (copy.deepcopy, pickle) and the copy goes on to the same bits.

circle   Sawicki's method III, on levelled data, in its O(1) centred form: the two level axes only
sphere   the same regression in three dimensions
kalman   a linear Kalman filter: levelled field constant but for the turning the gyro reports (the default)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from magmav.core.field import ExpectedField
from magmav.core.types import Estimate, Sample


class Estimator(Protocol):
    """What every method offers."""

    def step(self, sample: Sample) -> None:
        """Learn from one sample (or only carry time forward, where sample.learn is False)."""
        ...

    def estimate(self, expected: ExpectedField | None) -> Estimate | None:
        """What is believed now; None while there is too little to say anything. Changes nothing."""
        ...


def _circle() -> Estimator:
    from magmav.core.estimators.circle import CircleEstimator

    return CircleEstimator()


def _sphere() -> Estimator:
    from magmav.core.estimators.sphere import SphereEstimator

    return SphereEstimator()


def _kalman() -> Estimator:
    from magmav.core.estimators.kalman import KalmanEstimator

    return KalmanEstimator()


ESTIMATORS: dict[str, Callable[[], Estimator]] = {"circle": _circle, "sphere": _sphere, "kalman": _kalman}
