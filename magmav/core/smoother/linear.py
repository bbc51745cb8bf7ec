"""The measurement equation of all nodes made linear about a path: information and what it says, and what is left over.

As in the estimator that flies: own noise of each reading, a strange reading counts less (Huber's weights), what a wrong
time or tilt does to the field, and what all readings of a node share. That last part is taken out of the information
by the matrix inversion lemma, so that no covariance of a whole node has to be inverted.
"""

from __future__ import annotations

import numpy as np

from magmav.core.estimators.adaptive import layout as at
from magmav.core.estimators.adaptive.layout import Array
from magmav.core.estimators.adaptive.measurement import equation
from magmav.core.estimators.adaptive.tuning import Tuning
from magmav.core.smoother.nodes import Nodes
from magmav.core.smoother.noise import Noise

_EYE3 = np.eye(3)
_AT_ONCE = 512  # nodes: what is laid out for each is some kilobytes


def linear(nodes: Nodes, x: Array, noise: Noise, n: Tuning) -> tuple[Array, Array]:
    """Information (N, SIZE + 1, SIZE + 1) about the path x (N, SIZE), and what is left, (N, m, 3) mG.

    The last row and column belong to what is measured: of the least squares |J state - (z - y + J x)|^2 these are
    J' W J, J' W (z - y + J x), and the square of that.
    """
    info = np.empty((len(nodes), at.SIZE + 1, at.SIZE + 1))
    left = np.empty((*nodes.rows.shape, 3))
    for a in range(0, len(nodes), _AT_ONCE):
        part = slice(a, min(a + _AT_ONCE, len(nodes)))
        info[part], left[part] = _part(nodes, part, x[part], noise, n)
    return info, left


def leftover(nodes: Nodes, x: Array) -> Array:
    """What a path (N, SIZE) leaves of each reading, (N, m, 3) mG."""
    out = np.empty((*nodes.rows.shape, 3))
    for a in range(0, len(nodes), _AT_ONCE):
        part = slice(a, min(a + _AT_ONCE, len(nodes)))
        r = nodes.readings(part.start, part.stop)
        out[part] = r.z - equation(x[part], r)[0]
    return out


def _part(nodes: Nodes, part: slice, x: Array, noise: Noise, n: Tuning) -> tuple[Array, Array]:
    r, axes = nodes.readings(part.start, part.stop), nodes.columns.axes
    y, j, of_u = equation(x, r)
    left = r.z - y
    share = n.sync_s**2 * r.rate_rads2 + r.calmed_rad**2
    squares = of_u @ of_u
    total = noise.white_mg2 + noise.common_mg2
    strange = _squared(left, _precision(total, share, squares, axes))
    count = nodes.there[part] / np.maximum(strange / n.doubt_nis, 1.0)
    weight = _precision(noise.white_mg2, share, squares, axes) * count[..., None, None]
    both = np.concatenate((j, (left + (j @ x[:, None, :, None])[..., 0])[..., None]), axis=-1)
    weighed = weight @ both
    k, m = both.shape[:2]
    info = both.reshape(k, m * 3, -1).transpose(0, 2, 1) @ weighed.reshape(k, m * 3, -1)
    sums = weighed.sum(1)
    info -= sums.transpose(0, 2, 1) @ np.linalg.solve(weight.sum(1) + _EYE3 / noise.common_mg2, sums)
    return info, left


def _precision(noise_mg2: float, share: Array, squares: Array, axes: int) -> Array:
    """Inverse of (noise I - share [u x]^2), (..., 3, 3): [u x]^2 = u u' - |u|^2 I has u for an eigenvector.

    Of two axes, their own part of it.
    """
    expected = noise_mg2 * _EYE3 - share[..., None, None] * squares
    if axes == 2:
        out = np.zeros_like(expected)
        out[..., :2, :2] = np.linalg.inv(expected[..., :2, :2])
        return out
    u2 = -0.5 * np.trace(squares, axis1=-2, axis2=-1)
    along = squares + u2[..., None, None] * _EYE3  # u u'
    wide = noise_mg2 + share * u2
    return np.asarray((_EYE3 + (share / noise_mg2)[..., None, None] * along) / wide[..., None, None])


def _squared(left: Array, precision: Array) -> Array:
    out: Array = ((precision @ left[..., None])[..., 0] * left).sum(-1)
    return out
