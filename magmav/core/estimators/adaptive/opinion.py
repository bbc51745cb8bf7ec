"""The second opinion: what the field's length alone says of the iron, joined to what the bank says.

TWOSTEP knows nothing of attitude, so nothing that is wrong with the attitude can mislead it; the bank knows of turning,
throttle and sudden changes. Their errors have causes of their own, hence they are joined as two measurements are. The
further apart they are, the less the second counts, until the bank alone is heard and the gate refuses.
"""

from __future__ import annotations

import numpy as np

from magmav.core.estimators.adaptive.layout import Array
from magmav.core.estimators.twostep import TwostepEstimator
from magmav.core.types import Estimate

_APART = 1.5  # sigmas between the two from which on the second counts less
_SINCE_S = 2.0  # it must have begun its stretch of data no longer than this before the last change of the iron


def heard(second: TwostepEstimator, estimate: Estimate | None, changed_ago_s: float) -> Estimate | None:
    """What it says, unless that rests on data from before the iron changed."""
    if estimate is None or second.reaches_back_s > changed_ago_s + _SINCE_S:
        return None
    return estimate


def doubt(apart: float) -> float:
    """By what the second's variance is multiplied when the two are so many sigmas apart."""
    return max(1.0, apart / _APART) ** 4


def joined(mean: Array, covariance: Array, take: Array, iron_mg: Array, iron_mg2: Array) -> tuple[Array, Array]:
    """State (n,) and covariance (n, n) with a measurement of the iron, (3,) and (3, 3); take (3, n) is its Jacobian."""
    pulled = covariance @ take.T
    gain = pulled @ np.linalg.inv(take @ pulled + iron_mg2)
    left = covariance - gain @ pulled.T
    return mean + gain @ (iron_mg - take @ mean), 0.5 * (left + left.T)


def own_covariance(second: Estimate) -> Array:
    """Its covariance had the field's length not been known, (3, 3) mG^2: the same correlations, its own sigmas."""
    claimed = np.sqrt(np.diag(second.covariance_mg2))
    scale = np.maximum(second.own_sigma_mg / claimed, 1.0)
    out: Array = second.covariance_mg2 * np.outer(scale, scale)
    return out
