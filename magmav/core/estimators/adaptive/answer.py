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


def surprise(h_mg: float, v_mg: float, model_mg: tuple[float, float], n: Tuning) -> float:
    """By how many sigmas of its own doubt the readings have moved the world model's field.

    A sensor whose scale is wrong shows another field, and until that is found the iron is bent to make up for it.
    """
    h, v = model_mg
    gain2 = n.gain * n.gain
    both = n.model_mg**2 + gain2 * h * h, gain2 * h * v, n.model_mg**2 + gain2 * v * v
    (a, b), (_, c) = inverse2(*both)
    x, y = h_mg - h, v_mg - v
    return math.sqrt(a * x * x + 2.0 * b * x * y + c * y * y)


def inverse2(a: float, b: float, c: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Of the symmetric matrix a b, b c."""
    d = a * c - b * b
    return (c / d, -b / d), (-b / d, a / d)
