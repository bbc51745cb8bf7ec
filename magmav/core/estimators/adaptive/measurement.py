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

import numpy as np

from magmav.core.estimators.adaptive import layout as at
from magmav.core.estimators.adaptive.block import Block
from magmav.core.estimators.adaptive.layout import Array

_EYE3 = np.eye(3)
_PLACES = np.array((0, 3, 4, 3, 1, 5, 4, 5, 2))  # where each entry of S stands among the six


def soft_matrix(s: Array) -> Array:
    """S, (..., 3, 3), of its six numbers (..., 6)."""
    out: Array = s[..., _PLACES].reshape(*s.shape[:-1], 3, 3)
    return out


# (3, 18): u times this is S u as a matrix of the six of S
_SOFT = np.stack([np.column_stack([soft_matrix(row) @ unit for row in np.eye(6)]).ravel() for unit in _EYE3])


# (3, 9): v times this is [v x]
_CROSS = np.array([[0, 0, 0, 0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 0, 0, -1, 0, 0], [0, -1, 0, 1, 0, 0, 0, 0, 0]], float)


def equation(x: Array, block: Block) -> tuple[Array, Array, Array]:
    """Predicted A m + e (K, n, 3) mG, its Jacobian (K, n, 3, SIZE), and u (K, n, 3) mG.

    The columns of H, V, tilt and soft iron are taken at S = 0: relinearised there, the product of field and soft
    iron invents information (estimation.md section 7.4).
    """
    k, n = len(x), len(block)
    j = np.zeros((k, n, 3, at.SIZE))
    j[..., at.D] = _EYE3
    angle = (x[:, at.ALPHA, None] - x[:, at.G] @ block.ahead_s.T)[:, :, None]
    c, s = np.cos(angle), np.sin(angle)
    h = x[:, at.H, None, None]
    ahead = c * block.north_b + s * block.east_b  # the horizontal field's direction, and a right angle on from it
    turned = h * (c * block.east_b - s * block.north_b)
    u = h * ahead + x[:, at.V, None, None] * block.down_b
    q = (block.turns_b @ x[:, None, at.TURNS, None])[..., 0]
    around = cross_matrices(q)
    turn = _EYE3 + around + 0.5 * (around @ around)
    seen, turned, ahead, down = np.moveaxis(turn @ np.stack((u, turned, ahead, _like(block.down_b, k)), 3), 3, 0)
    soft = soft_matrix(x[:, at.S])
    constant = x[:, None, at.B] @ block.shaping.matrix.T + x[:, None, at.D]
    y = seen + seen @ soft + constant + block.drive[:, None] * x[:, None, at.K]
    turning = turned + turned @ soft
    j[..., at.ALPHA] = turning
    j[..., at.B] = block.shaping.matrix
    j[..., at.H] = ahead
    j[..., at.V] = down
    j[..., at.K] = block.drive[:, None, None] * _EYE3
    j[..., at.S] = (seen @ _SOFT).reshape(k, n, 3, 6)
    j[..., at.G] = -turning[..., None] * block.ahead_s[:, None, :]
    by_q = cross_matrices(u)
    by_q = by_q + 0.5 * (cross_matrices((around @ u[..., None])[..., 0]) + around @ by_q)
    j[..., at.TURNS] = -(by_q @ block.turns_b)
    return y, j, u


def _like(values: Array, k: int) -> Array:
    return np.broadcast_to(values, (k, *values.shape))


def cross_matrices(v: Array) -> Array:
    """[v x] of vectors (..., 3): (..., 3, 3)."""
    out: Array = (v @ _CROSS).reshape(*v.shape, 3)
    return out


def smear(u: Array, block: Block, sync_s: float) -> Array:
    """(K, n, 3, 3) mG^2: what a mismatch in time or tilt does to the field; it never changes the field's length."""
    share = sync_s**2 * (block.rate_b_rads * block.rate_b_rads).sum(1) + block.calmed_rad**2
    out: Array = (-share[:, None, None] * u[..., :, None]) * u[..., None, :]
    diagonal = out.reshape(*out.shape[:2], 9)[..., ::4]
    diagonal += (share * (u * u).sum(2))[..., None]
    return out
