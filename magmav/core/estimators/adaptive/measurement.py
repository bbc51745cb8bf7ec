"""The one measurement equation, for every hypothesis and every sample of a block at once.

    A m + e = A b + (I + S)(u + (R_bo e_tilt + r + kappa t) x u + tau w x u) + k (throttle - 1/2) + d + noise
    u = R_bo (H cos a, H sin a, V),   a = alpha - g . (integral of down since the sample)
R_bo takes the own frame to body axes; t is the vehicle's tilt as a rotation, r that of the mounting; w the body rate.
It holds the norm, the dip, the turning and the world model, each with its own direction. Angles of attitude appear
nowhere: no gimbal.
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
    ahead = c * block.north_b + s * block.east_b  # the horizontal field's direction, and a right angle on from it
    beside = c * block.east_b - s * block.north_b
    h = x[:, at.H, None, None]
    u = h * ahead + x[:, at.V, None, None] * block.down_b
    turned = h * beside
    crossed = (block.crosses @ u[..., None])[..., 0]
    leaning, late = crossed[..., :3], crossed[..., 3:]
    v = x[:, at.V, None, None]
    j[..., at.E.start] = h * s * block.down_b - v * block.east_b
    j[..., at.E.start + 1] = v * block.north_b - h * c * block.down_b
    j[..., 1, at.R.start], j[..., 2, at.R.start] = -u[..., 2], u[..., 1]
    j[..., 0, at.R.start + 1], j[..., 2, at.R.start + 1] = u[..., 2], -u[..., 0]
    moved = (j[..., at.E] @ x[:, None, at.E, None] + j[..., at.R] @ x[:, None, at.R, None])[..., 0]
    moved += x[:, at.KAPPA, None, None] * leaning + x[:, at.T, None, None] * late
    seen = u + moved
    soft = soft_matrix(x[:, at.S])
    constant = x[:, None, at.B] @ block.shaping.matrix.T + x[:, None, at.D]
    y = seen + seen @ soft + constant + block.drive[:, None] * x[:, None, at.K]
    turning = turned + turned @ soft
    j[..., at.ALPHA] = turning
    j[..., at.B] = block.shaping.matrix
    j[..., at.H] = ahead
    j[..., at.V] = block.down_b
    j[..., at.K] = block.drive[:, None, None] * _EYE3
    j[..., at.S] = (u @ _SOFT).reshape(k, n, 3, 6)
    j[..., at.G] = -turning[..., None] * block.ahead_s[:, None, :]
    j[..., at.T] = late
    j[..., at.KAPPA] = leaning
    return y, j, u


def smear(u: Array, block: Block, sync_s: float) -> Array:
    """(K, n, 3, 3) mG^2: what a mismatch in time or tilt does to the field; it never changes the field's length."""
    share = sync_s**2 * (block.rate_b_rads * block.rate_b_rads).sum(1) + block.calmed_rad**2
    out: Array = (-share[:, None, None] * u[..., :, None]) * u[..., None, :]
    diagonal = out.reshape(*out.shape[:2], 9)[..., ::4]
    diagonal += (share * (u * u).sum(2))[..., None]
    return out
