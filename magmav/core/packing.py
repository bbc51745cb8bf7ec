"""Symmetric matrices, saved by halves."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]


def upper(matrices: Array) -> Array:
    """The upper triangles (K, n (n + 1) / 2) of symmetric matrices (K, n, n)."""
    i, j = np.triu_indices(matrices.shape[-1])
    out: Array = matrices[:, i, j]
    return out


def whole(triangles: Array, n: int) -> NDArray[np.float64]:
    """The matrices (K, n, n) of ``upper``, every bit as it was."""
    i, j = np.triu_indices(n)
    out = np.empty((len(triangles), n, n))
    out[:, i, j] = out[:, j, i] = triangles
    return out
