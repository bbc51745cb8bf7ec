"""The one equation of TWOSTEP, linear in what a cell says, and its priors.

    r = (y - c)' Q (y - c) - rho = 0          y = A m + e, c = A b, Q = (I + S)^2, rho = |B|^2

Alonso and Shuster 2002 (TWOSTEP) write it with Q = I as z = |y|^2 - |B|^2 = 2 y.c - |c|^2 + v; with Q it is their
"Complete linear attitude-independent magnetometer calibration" of the same year. State x = (c, rho, D), Q = I + D, D
over PAIRS: (10,), in units of UNIT_MG. A mean over values obeys the equation as the values do, since r is linear in
w = (1, y, |y|^2, y_i y_j). Residuals in this unit are those of the length times 2 |B|.

DEVIATES: Jacobians are taken at D = 0 whatever D is. Length, soft iron and centre trade off along a line that level
turns do not see; were the Jacobian to move with D, it would claim to see along it (estimation.md section 7.4).
DEVIATES: c and the length are one Gauss-Newton step instead of two: with the sums about c this is the second step, and
where the length is not known its prior is wide, which leaves the first (the centred) step.
DEVIATES: noise in y is noise in the regressors too. It draws the gradient by multiples of its variance per cell, and
this is taken back; the paper takes back only the mean 3 s^2. Where the vehicle only wobbles it is the larger error.
"""

from __future__ import annotations

import numpy as np

from magmav.core.estimators.twostep_window import Array

STATE = 10
_EYE3 = np.eye(3)
_PLACES = np.array(((0, 3, 4), (3, 1, 5), (4, 5, 2)))  # where each entry of D stands among PAIRS
C, RHO, D = slice(0, 3), 3, slice(4, 10)
# Of E[gradient] per cell, in s^2 E[J]: of (2 d.n + |n|^2)(J(d + n)) for J of degree 1, 0 and 2 in d.
_DRAWN = np.array((5.0,) * 3 + (3.0,) + (7.0,) * 6)


def symmetric(pairs: Array) -> Array:
    """The symmetric (3, 3) matrix of its six entries."""
    out: Array = pairs[_PLACES]
    return out


def rows(x: Array) -> Array:
    """(11, 11): row i < 10 gives dr/dx_i, the last r itself, from w. Plain numbers: thrice as fast as array algebra."""
    a, b, c, rho, daa, dbb, dcc, dab, dac, dbc = x.tolist()
    qa = a + daa * a + dab * b + dac * c
    qb = b + dab * a + dbb * b + dbc * c
    qc = c + dac * a + dbc * b + dcc * c
    a2, b2, c2 = 2.0 * a, 2.0 * b, 2.0 * c
    return np.array(
        (
            (a2, -2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
            (b2, 0.0, -2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
            (c2, 0.0, 0.0, -2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
            (-1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
            (a * a, -a2, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0),
            (b * b, 0.0, -b2, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0),
            (c * c, 0.0, 0.0, -c2, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0),
            (a2 * b, -b2, -a2, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0),
            (a2 * c, -c2, 0.0, -a2, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0, 0.0),
            (b2 * c, 0.0, -c2, -b2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0),
            (
                a * qa + b * qb + c * qc - rho,
                *(-2.0 * qa, -2.0 * qb, -2.0 * qc, 1.0),
                *(daa, dbb, dcc, 2.0 * dab, 2.0 * dac, 2.0 * dbc),
            ),
        )
    )


def drawn(mean_jacobian: Array, cells: Array | float, white2: float, size: int = STATE) -> Array:
    """What noise of variance white2 a value adds to the gradient sum n J r, (..., size), over a number of cells."""
    out: Array = _DRAWN[:size] * mean_jacobian * (white2 * np.asarray(cells)[..., None])
    return out


def soft_root(x: Array) -> Array:
    """I + S, the symmetric root of Q, (3, 3)."""
    values, vectors = np.linalg.eigh(_EYE3 + symmetric(x[D]))
    out: Array = (vectors * np.sqrt(np.maximum(values, 0.1))) @ vectors.T
    return out
