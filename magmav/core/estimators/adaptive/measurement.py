"""The one measurement equation, for every hypothesis at once.

    A m + e = A b + (I + S)(u + (e_tilt + kappa t) x u + tau w x u) + k (throttle - 1/2) + d + noise
    u = R_bo (H cos alpha, H sin alpha, V)
R_bo takes the own frame to body axes; t is the vehicle's tilt as a rotation; w the body rate. It holds the norm, the
dip, the turning and the world model, each with its own direction. Angles of attitude appear nowhere: no gimbal.
"""

from __future__ import annotations

import numpy as np

from magmav.core.estimators.adaptive import layout as at
from magmav.core.estimators.adaptive.layout import Array
from magmav.core.rotation import cross_matrix

_EYE3 = np.eye(3)
_PLACES = np.array((0, 3, 4, 3, 1, 5, 4, 5, 2))  # where each entry of S stands among the six


def soft_matrix(s: Array) -> Array:
    """S, (..., 3, 3), of its six numbers (..., 6)."""
    out: Array = s[..., _PLACES].reshape(*s.shape[:-1], 3, 3)
    return out


class Equation:
    """Predictions and Jacobians of K hypotheses; the arrays are kept, so what never changes is written once."""

    def __init__(self, k: int) -> None:
        self._j = np.zeros((k, 3, at.SIZE))
        for i in range(3):
            self._j[:, i, at.D.start + i] = 1.0

    def __len__(self) -> int:
        return len(self._j)

    def __call__(
        self, x: Array, body_from_own: Array, matrix: Array, rate_b: Array, drive: float
    ) -> tuple[Array, Array, Array]:
        """Predicted A m + e (K, 3) mG, its Jacobian (K, 3, n) (good until the next call), and the field u (K, 3) mG.

        The columns of H, V, tilt and soft iron are taken at S = 0: relinearised there, the product of field and soft
        iron invents information (estimation.md section 7.4).
        """
        j = self._j
        c, s = np.cos(x[:, at.ALPHA]), np.sin(x[:, at.ALPHA])
        earth = np.zeros((2, len(x), 3))
        earth[0, :, 0], earth[0, :, 1] = c, s  # horizontal north in the own frame, and a right angle on from it
        earth[1, :, 0], earth[1, :, 1] = -s, c
        ahead, beside = earth @ body_from_own.T
        down = body_from_own[:, 2]
        h = x[:, at.H, None]
        u = h * ahead + x[:, at.V, None] * down
        tilt = cross_matrix(-down[1], down[0], 0.0)
        late, leaning = u @ cross_matrix(*rate_b.tolist()).T, u @ tilt.T
        ux, uy, uz = u.T
        e0, s0 = at.E.start, at.S.start
        j[:, 0, e0 + 1], j[:, 0, e0 + 2] = uz, -uy
        j[:, 1, e0], j[:, 1, e0 + 2] = -uz, ux
        j[:, 2, e0], j[:, 2, e0 + 1] = uy, -ux
        j[:, 0, s0], j[:, 1, s0 + 1], j[:, 2, s0 + 2] = ux, uy, uz
        j[:, 0, s0 + 3], j[:, 1, s0 + 3] = uy, ux
        j[:, 0, s0 + 4], j[:, 2, s0 + 4] = uz, ux
        j[:, 1, s0 + 5], j[:, 2, s0 + 5] = uz, uy
        moved = (j[:, :, at.E] @ x[:, at.E, None])[:, :, 0] + x[:, at.KAPPA, None] * leaning + x[:, at.T, None] * late
        seen = u + moved
        soft = soft_matrix(x[:, at.S])
        y = seen + (soft @ seen[:, :, None])[:, :, 0] + x[:, at.B] @ matrix.T + drive * x[:, at.K] + x[:, at.D]
        turned = h * beside
        j[:, :, at.ALPHA] = turned + (soft @ turned[:, :, None])[:, :, 0]
        j[:, :, at.B] = matrix
        j[:, :, at.H] = ahead
        j[:, :, at.V] = down
        j[:, :, at.K] = drive * _EYE3
        j[:, :, at.T] = late
        j[:, :, at.KAPPA] = leaning
        return y, j, u


def noise(u: Array, variance: Array, smear: float) -> Array:
    """R (K, 3, 3): white noise, and what a mismatch in time does, which never changes the field's length."""
    square = (u * u).sum(1)
    out = (-smear * u[:, :, None]) * u[:, None, :]
    diagonal = out.reshape(len(u), 9)[:, ::4]
    diagonal += (variance + smear * square)[:, None]
    return out
