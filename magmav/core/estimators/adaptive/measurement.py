"""The one measurement equation, for every hypothesis and every sample of a block at once.

    A m + e = A b + (I + S) T(q) u + k (throttle - 1/2) + d + noise
    u = R_bo (H cos a, H sin a, V),   a = alpha - g . (integral of down since the sample)
    q = R_bo e_tilt + r + kappa t + tau w,   T(q) = I + [q x] + [q x]^2 / 2
R_bo takes the own frame to body axes; t is the vehicle's tilt as a rotation, r that of the mounting; w the body rate.
It holds the norm, the dip, the turning and the world model, each with its own direction. T is a turn but for the third
power of its angle: with its first two terms alone a tilt ten degrees wrong would make the field longer. Angles of
attitude appear nowhere: no gimbal.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from magmav.core.estimators.adaptive import layout as at
from magmav.core.estimators.adaptive.block import Readings
from magmav.core.estimators.adaptive.layout import Array

_PLACES = np.array((0, 3, 4, 3, 1, 5, 4, 5, 2))  # where each entry of S stands among the six


def soft_matrix(s: Array) -> Array:
    """S, (..., 3, 3), of its six numbers (..., 6)."""
    out: Array = s[..., _PLACES].reshape(*s.shape[:-1], 3, 3)
    return out


# (3, 18): u times this is S u as a matrix of the six of S
_SOFT = np.stack([np.column_stack([soft_matrix(row) @ unit for row in np.eye(6)]).ravel() for unit in np.eye(3)])


# (3, 9): v times this is [v x]
_CROSS = np.array([[0, 0, 0, 0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 0, 0, -1, 0, 0], [0, -1, 0, 1, 0, 0, 0, 0, 0]], float)


def equation(x: Array, block: Readings) -> tuple[Array, Array, Array]:
    """Predicted A m + e (K, n, 3) mG, its Jacobian (K, n, 3, SIZE), and [u x] (K, n, 3, 3) mG.

    x (K, SIZE) : hypotheses about one block; or one state for each of K blocks.
    The columns of H, V, tilt and soft iron are taken at S = 0: relinearised there, the product of field and soft
    iron invents information (estimation.md section 7.4).
    """
    k, n = len(x), block.z.shape[-2]
    angle = x[:, at.ALPHA, None] - (block.ahead_s @ x[:, at.G, None])[..., 0]
    level, ahead, right = x[:, at.H, None], np.cos(angle), np.sin(angle)
    own = np.zeros((k, n, 3, 4))  # own frame: the field, a right angle on from its level part, and 1 mG ahead and down
    own[..., 0, 2], own[..., 1, 2], own[..., 2, 3] = ahead, right, 1.0
    own[..., 0, 0] = own[..., 1, 1] = level * ahead
    own[..., 1, 0] = level * right
    own[..., 0, 1] = -own[..., 1, 0]
    own[..., 2, 0] = x[:, at.V, None]
    body = block.body_from_own @ own
    around = cross_matrices((block.turns_b @ x[:, None, at.TURNS, None])[..., 0])
    turned = body + around @ (body + 0.5 * (around @ body))
    seen, turning = turned[..., 0], turned[..., 1]
    j = np.empty((k, n, 3, at.SIZE))
    j[:] = block.same
    j[..., at.S] = (seen @ _SOFT).reshape(k, n, 3, 6)
    y = seen + (j.reshape(k, -1, at.SIZE) @ x[:, :, None]).reshape(k, n, 3)  # in all columns there so far it is linear
    turning = turning + turning @ soft_matrix(x[:, at.S])
    j[..., at.ALPHA] = turning
    j[..., at.H : at.V + 1] = turned[..., 2:]
    j[..., at.G] = turning[..., None] * -block.ahead_s[..., None, :]
    of_u = cross_matrices(body[..., 0])
    u_q = of_u @ around  # its transpose is [q x] [u x], and [(q x u) x] is that less this
    by_turns = (0.5 * u_q - u_q.swapaxes(2, 3) - of_u) @ block.turns_b
    j[..., at.E], j[..., at.LATE] = by_turns[..., :2], by_turns[..., 2:]
    return y, j, of_u


def cross_matrices(v: Array) -> Array:
    """[v x] of vectors (..., 3): (..., 3, 3)."""
    out: Array = (v @ _CROSS).reshape(*v.shape, 3)
    return out


@cache
def shared_by_all(n: int, axes: int) -> Array:
    """(n axes, n axes): one where two numbers of a block belong to the same axis."""
    return np.tile(np.eye(axes), (n, n))


@cache
def means(n: int, axes: int) -> Array:
    """(n axes, axes): what makes of a block's numbers their mean by axis."""
    return np.tile(np.eye(axes) / n, (n, 1))


def smear(of_u: Array, block: Readings, sync_s: float) -> Array:
    """(K, n, 3, 3) mG^2: what a mismatch in time or tilt does to the field; it never changes the field's length.

    of_u (K, n, 3, 3) : [u x], whose square is u u' - |u|^2 I.
    """
    share = sync_s**2 * block.rate_rads2 + block.calmed_rad**2
    out: Array = -share[..., None, None] * (of_u @ of_u)
    return out
