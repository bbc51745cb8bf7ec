"""Hard and soft iron together: the ellipse (d = 2) or ellipsoid (d = 3) through the points, as linear regression.

Sytnyk et al. 2014 in the well-posed form (seed-methods.md Y3; three dimensions S5). A conic is scaled so that its
quadratic form G has trace d, so |u|^2 is linear in the rest:
    |u|^2 = sum_k p_k u' A_k u + 2 l . u + p0,   G = I - sum_k p_k A_k,   A_k a basis of the trace-free symmetric forms
Centre G^-1 l; with p = 0 this is method II. Axes and origin do not matter to the answer, as they do to the printed
chain's.

The matrix is the symmetric root of G, of determinant 1, so that the corrected circle's radius is the geometric mean of
the half axes and mG stay mG. A rotation of all the points about the centre, such as a turned sensor or the skew part of
soft iron, leaves the same ellipse: no fit can find it, and it stays as a constant heading offset.
"""

from __future__ import annotations

import math

import numpy as np

from magmav.core.estimators.centred import NO_CIRCLE, SHORT_ARC, WEAK_ARC
from magmav.core.estimators.fit import Array, Fit, Refusal
from magmav.core.estimators.moments import Moments, quadratic

_NO_RANK = 1e-10  # smallest eigenvalue of the regressors' correlation
_FLAT = 1e-9  # smallest over largest variance of the points: rounding
_LONGEST = 3.0  # largest axis over smallest: beyond it is no soft iron but an arc
_NOTHING_BUT_NOISE = 0.5  # share; 3 or 4 headings, which leave a shape open, have .91 to 1.18, any arc under .28
_SHAPE = 0.1  # one sigma, and error by noise, of the shape; half of it is an error of heading in radians
_THREE_QUARTERS = 0.5  # lmin / lmax of the corrected points

_FORMS: dict[int, Array] = {
    2: np.array([[[1, 0], [0, -1]], [[0, 1], [1, 0]]], dtype=np.float64),
    3: np.array(
        [
            [[1, 0, 0], [0, 1, 0], [0, 0, -2]],
            [[1, 0, 0], [0, -2, 0], [0, 0, 1]],
            [[0, 1, 0], [1, 0, 0], [0, 0, 0]],
            [[0, 0, 1], [0, 0, 0], [1, 0, 0]],
            [[0, 0, 0], [0, 0, 1], [0, 1, 0]],
        ],
        dtype=np.float64,
    ),
}


def _regressors(d: int) -> Array:
    """Rows take the moments' w = (u, u_i u_j) to the regressors u' A_k u and 2 u, and to |u|^2 last."""
    forms = _FORMS[d]
    out = np.zeros((len(forms) + d + 1, d + d * (d + 1) // 2))
    for k, form in enumerate(forms):
        out[k, d:] = quadratic(form)
    out[len(forms) : -1, :d] = 2.0 * np.eye(d)
    out[-1, d:] = quadratic(np.eye(d))
    return out


_REGRESSORS = {d: _regressors(d) for d in _FORMS}


def conic_fit(m: Moments, least: int, independent: float = 1.0) -> Fit | Refusal:
    """Ellipse or ellipsoid of the points taken. An ellipse wants half a turn, and says weak under three quarters.

    least : fewest points.  independent : share of the samples whose errors are independent, 0 to 1.
    Noise in the regressors biases the answer whatever the number of points; the claimed covariance has that in it, and
    where noise alone could bend the shape by 0.1 (3 degrees of heading) there is no answer.
    """
    d = m.dimensions
    forms = _FORMS[d]
    size = len(forms) + d
    if m.samples < least or m.effective < size + 2:
        return Refusal.TOO_FEW
    if not m.spreads():
        return Refusal.NO_ROTATION
    middle = m.mean[:d]
    mean_w, scatter_w = m.moved(-middle)
    spread = scatter_w[:d, :d] / m.weight
    reach = np.linalg.eigvalsh(spread)
    if not reach[0] > _FLAT * reach[-1]:
        return Refusal.PLANAR if reach[-2] > _FLAT * reach[-1] else Refusal.COLLINEAR
    rows = _REGRESSORS[d]
    mean, moments = rows @ mean_w, rows @ (scatter_w / m.weight) @ rows.T
    unit = np.sqrt(np.diag(moments)[:size])
    if not unit.min() > 0.0:
        return Refusal.ARC_TOO_SHORT
    correlation = moments[:size, :size] / np.outer(unit, unit)
    if np.linalg.eigvalsh(correlation)[0] < _NO_RANK:
        return Refusal.ARC_TOO_SHORT
    p = np.linalg.solve(correlation, moments[:size, size] / unit) / unit
    shape, linear = p[: len(forms)], p[len(forms) :]
    G = np.eye(d) - np.tensordot(shape, forms, 1)
    stiffness, axes = np.linalg.eigh(G)
    if not stiffness[0] > 0.0:
        return Refusal.NOT_AN_ELLIPSE
    centre = np.linalg.solve(G, linear)
    k = float(mean[size] - p @ mean[:size] + centre @ G @ centre)
    if not k > 0.0 or stiffness[-1] > _LONGEST**2 * stiffness[0]:
        return Refusal.NOT_AN_ELLIPSE
    half = np.sqrt(k / stiffness)
    radius = float(np.prod(half)) ** (1.0 / d)
    matrix = axes @ np.diag(radius / half) @ axes.T
    misfit = max(float(moments[size, size] - 2.0 * p @ moments[:size, size] + p @ moments[:size, :size] @ p), 0.0)
    slope2 = 4.0 * float(np.trace(G @ (spread + np.outer(centre, centre)) @ G))
    own_misfit = misfit * m.effective / (m.effective - size - 1.0)
    noise2 = own_misfit / slope2
    if noise2 > (NO_CIRCLE * radius) ** 2:
        return Refusal.NO_ROTATION
    covariance = _covariance(correlation, unit, own_misfit, m.effective * independent)
    gain, right = _noise(forms, spread, noise2)
    bias = np.linalg.solve(correlation, (right - gain @ p) / unit) / unit
    covariance = covariance + np.outer(bias, bias)
    n = len(forms)
    if float(np.linalg.eigvalsh(covariance[:n, :n])[-1]) > _SHAPE**2:
        return Refusal.ARC_TOO_SHORT
    rounded = np.linalg.eigvalsh(matrix @ spread @ matrix)
    roundness = float(rounded[0] / rounded[-1])
    if roundness < (WEAK_ARC if d == 2 else SHORT_ARC):
        return Refusal.ARC_TOO_SHORT
    if _share(correlation, gain / np.outer(unit, unit)) > _NOTHING_BUT_NOISE:
        return Refusal.FEW_HEADINGS
    # G c = l, so G dc = dl + sum_k dp_k A_k c.
    to_centre = np.linalg.solve(G, np.hstack(((forms @ centre).T, np.eye(d))))
    shift = m.shift if m.shift is not None else np.zeros(d)
    return Fit(
        centre=shift + m.scale * (middle + centre),
        radius=m.scale * radius,
        residual=m.scale * math.sqrt(misfit / slope2),
        covariance=to_centre @ covariance @ to_centre.T * m.scale**2,
        seen=np.eye(d),
        matrix=matrix,
        roundness=roundness,
        weak=roundness < (_THREE_QUARTERS if d == 2 else WEAK_ARC),
        samples=m.samples,
    )


def _covariance(correlation: Array, unit: Array, misfit2: float, effective: float) -> Array:
    out: Array = np.linalg.inv(correlation) / np.outer(unit, unit) * (misfit2 / max(effective, 1.0))
    return out


def _noise(forms: Array, spread: Array, noise2: float) -> tuple[Array, Array]:
    """What noise of variance ``noise2`` in u adds to the moments of the regressors, N, and with |u|^2, n.

    To first order it then moves p by C^-1 (n - N p). N is the mean of J J' and n that of J j', with J and j the
    gradients of regressors and of |u|^2: 2 A_k u, 2 e_i, 2 u. Origin at the mean of u, so its second moments are
    ``spread``.
    """
    n, d = len(forms), len(spread)
    gain, right = np.zeros((n + d, n + d)), np.zeros(n + d)
    gain[:n, :n] = np.einsum("aij,jk,bki->ab", forms, spread, forms)
    gain[n:, n:] = np.eye(d)
    right[:n] = np.einsum("aij,ji->a", forms, spread)
    return 4.0 * noise2 * gain, 4.0 * noise2 * right


def _share(correlation: Array, gain: Array) -> float:
    """The share of noise in the combination of regressors that has most of it, 0 to about 1."""
    root = np.linalg.inv(np.linalg.cholesky(correlation))
    return float(np.linalg.eigvalsh(root @ gain @ root.T)[-1])
