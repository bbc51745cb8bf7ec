"""The second opinion: what the field's length alone says of the iron, joined to what the bank says.

TWOSTEP knows nothing of attitude, so nothing that is wrong with the attitude can mislead it; the bank knows of turning,
throttle and sudden changes. Their errors have causes of their own, hence they are joined as two measurements are. The
further apart they are, the less the second counts, until the bank alone is heard and the gate refuses.
"""

from __future__ import annotations

import numpy as np

from magmav.core.estimators.adaptive.layout import Array
from magmav.core.estimators.twostep import KNOWS_MG, TwostepEstimator
from magmav.core.threes import inverse3
from magmav.core.types import Estimate

_EYE3 = np.eye(3)
_APART = 1.5  # sigmas between the two from which on the second counts less
_NOTHING_MG2 = 1e8
_SINCE_S = 2.0  # it must have begun its stretch of data no longer than this before the last change of the iron


def stale(second: TwostepEstimator, changed_ago_s: float) -> bool:
    """Does what it says rest on data from before the iron changed?"""
    return second.reaches_back_s > changed_ago_s + _SINCE_S


def doubt(apart: float) -> float:
    """By what the second's variance is multiplied when the two are so many sigmas apart."""
    return max(1.0, apart / _APART) ** 4


def joined(ours_mg2: Array, theirs_mg2: Array, less: float) -> tuple[Array, Array]:
    """Covariances (n, 3, 3) of both together where ours are weighed as if their variances were ``less`` times as large.

    What is claimed is ours as it is (Joseph's form): who learns nothing from the second claims no more and no less.
    And (n, 3, 3): what times the covariance of a state and our iron takes the difference of the two to the state.
    """
    pull = less * np.array([inverse3(one) for one in less * ours_mg2 + theirs_mg2])
    gain = ours_mg2 @ pull
    left = _EYE3 - gain
    both = left @ ours_mg2 @ left.swapaxes(1, 2) + gain @ theirs_mg2 @ gain.swapaxes(1, 2)
    return 0.5 * (both + both.swapaxes(1, 2)), pull


def known(iron_mg2: Array) -> Array:
    """The covariance (3, 3) with directions in which it knows too little to be contradicted left out altogether.

    A sphere seen from a point fits anywhere along the line of sight: there even a wide claim is no claim.
    """
    if iron_mg2.trace() <= KNOWS_MG**2:
        return iron_mg2
    variances, ways = np.linalg.eigh(iron_mg2)
    out: Array = (ways * np.where(variances > KNOWS_MG**2, _NOTHING_MG2, variances)) @ ways.T
    return out


def told(second: Estimate) -> Array:
    """What is ``known`` of it with everything used and as if the field's length had not been known, (2, 3, 3) mG^2."""
    return np.array((known(second.covariance_mg2), known(own_covariance(second))))


def own_covariance(second: Estimate) -> Array:
    """Its covariance had the field's length not been known, (3, 3) mG^2: the same correlations, its own sigmas."""
    claimed = np.sqrt(second.covariance_mg2.diagonal())
    scale = np.maximum(second.own_sigma_mg / claimed, 1.0)
    out: Array = second.covariance_mg2 * scale[:, None] * scale
    return out
