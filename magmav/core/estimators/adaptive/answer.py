"""What is made of the hypotheses: the iron with its doubts, with the world model and as if it had not been known."""

from __future__ import annotations

import math

import numpy as np

from magmav.core.estimators.adaptive.layout import Array
from magmav.core.estimators.adaptive.tuning import Tuning

_LEAST_MG2 = 1e-3


def symmetric(matrix: Array) -> Array:
    """Rounding must not grow into asymmetry."""
    out: Array = 0.5 * (matrix + matrix.T)
    return out


def without_prior(iron_mg2: Array, cross_mg2: Array, field_mg2: Array, h_mg: float, v_mg: float, n: Tuning) -> Array:
    """The iron's covariance had the field not been known beforehand, (3, 3): the prior on (H, V) out, a wide one in.

    cross_mg2 (2, 3) : of field and iron.  field_mg2 (2, 2).
    A prior is a measurement, and a measurement can be taken back: P + P C' (R - C P C')^-1 C P, with R^-1 the
    difference of the two priors' information.
    """
    gain2 = n.gain * n.gain
    (a, b), (_, c) = inverse2(n.model_mg**2 + gain2 * h_mg**2, gain2 * h_mg * v_mg, n.model_mg**2 + gain2 * v_mg**2)
    (a, b), (_, c) = inverse2(a - 1.0 / n.blind_h_mg[1] ** 2, b, c - 1.0 / n.blind_v_mg**2)
    a, b, c = a - float(field_mg2[0, 0]), b - float(field_mg2[0, 1]), c - float(field_mg2[1, 1])
    least = 0.5 * (a + c) - math.hypot(0.5 * (a - c), b)  # eigenvalue
    if least < _LEAST_MG2:  # nothing but the prior is known of it
        a, c = a + _LEAST_MG2 - least, c + _LEAST_MG2 - least
    return symmetric(iron_mg2 + cross_mg2.T @ np.array(inverse2(a, b, c)) @ cross_mg2)


def inverse2(a: float, b: float, c: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Of the symmetric matrix a b, b c."""
    d = a * c - b * b
    return (c / d, -b / d), (-b / d, a / d)
