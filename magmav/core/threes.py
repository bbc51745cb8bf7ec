"""Algebra of three by three in plain numbers: numpy asks for longer what it was given than it then reckons."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]


def inverse3(matrix: Array) -> NDArray[np.float64]:
    """Of a (3, 3) matrix, by its cofactors. ZeroDivisionError where it has none."""
    (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()
    p, q, r = e * i - f * h, f * g - d * i, d * h - e * g
    one = 1.0 / (a * p + b * q + c * r)
    out = np.array(
        ((p, c * h - b * i, b * f - c * e), (q, a * i - c * g, c * d - a * f), (r, b * g - a * h, a * e - b * d))
    )
    out *= one
    return out


def squared_distance(off: Array, covariance: Array) -> float:
    """off' covariance^-1 off of (n,) and a symmetric (n, n), n small, by elimination. ZeroDivisionError if singular."""
    total, left, rest = 0.0, off.tolist(), covariance.tolist()
    while left:
        a, pivot = left.pop(), rest.pop()
        total += a * a / pivot[-1]
        for i, row in enumerate(rest):
            share = row.pop() / pivot[-1]
            left[i] -= share * a
            for j in range(len(row)):
                row[j] -= share * pivot[j]
    return float(total)
