"""Circle and sphere by Sawicki 2017's methods II and III and by Taubin, from one accumulator.

II (Kasa, eq. 11-15) and III (Bullock, eq. 16-23) minimise the same sum, so they give the same answer to rounding
(seed-methods.md section 1 has the proof). Both see too small a circle where the arc is short and noisy; Taubin does
not. The identical equations hold in three dimensions.

The noise in the points is noise in the regressors: with C the covariance of the true points and s^2 that of the noise,
II and III draw the centre to the mean of the points by the share s^2 / (C + s^2), direction by direction. That error
does not shrink with more samples, so the claimed covariance has it in it, and directions in which it is large are not
seen at all: in three dimensions the fit then falls back to the plane of the points.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from magmav.core.estimators.fit import Array, Fit, Refusal
from magmav.core.estimators.moments import Moments, Scatter

SHORT_ARC = 0.02  # lmin / lmax of the points' covariance: an arc of 60 degrees
_SHALLOW = 0.001  # the same of a band on a sphere, which is no arc: honest while it is thicker than the noise
WEAK_ARC = 0.19  # half a circle
NO_CIRCLE = 0.2  # residual / radius: a blob of noise has .41 to .50, a compass .02
_LINE = 1e-9  # lmin / lmax: rounding


@dataclass(frozen=True, slots=True)
class Round:
    """One way to find centre (k,) and squared radius in the accumulator's scaled coordinates.

    curvature: least ratio of the points' smallest variance to the noise's. 1 is a noisy line. For II and III its
    inverse is the share of the radius by which the centre is off; Taubin has no such error.
    """

    solve: Callable[[Scatter], tuple[Array, float]]
    biased: bool
    curvature: float


def kasa(s: Scatter) -> tuple[Array, float]:
    """Method II, eq. (11)-(15): least squares of 2 v . c + w = |v|^2, radius^2 = w + |c|^2.

    DEVIATES: eq. (14) speaks of inverting the rectangular matrix A; x = (A'A)^-1 A' c is meant, and solved here on
    data shifted to the first point and scaled, which the print does not ask for and floating point does.
    """
    k = len(s.mean)
    normal = np.empty((k + 1, k + 1))
    normal[:k, :k] = 4.0 * (s.vv + np.outer(s.mean, s.mean))
    normal[:k, k] = normal[k, :k] = 2.0 * s.mean
    normal[k, k] = 1.0
    right = np.append(2.0 * (s.vz + s.mean * s.z_mean), s.z_mean)
    x = np.linalg.solve(normal, right)
    centre = x[:k]
    return centre, float(x[k] + centre @ centre)


def bullock(s: Scatter) -> tuple[Array, float]:
    """Method III, eq. (16)-(23): about the mean, [Suu Suv; Suv Svv] c = 1/2 [Suuu + Suvv; Svvv + Svuu].

    DEVIATES: s_uv, which eq. (19) does not list though (20) needs it, is the sum of u v. The third moments about the
    mean come from those about the first point: Cov(u, |u - m|^2) = Cov(u, |u|^2) - 2 Cov(u) m.
    """
    third = s.vz - 2.0 * s.vv @ s.mean
    centre = np.linalg.solve(s.vv, 0.5 * third)
    return centre + s.mean, float(centre @ centre + np.trace(s.vv))


def taubin(s: Scatter) -> tuple[Array, float]:
    """Taubin's algebraic fit: least sum of A z + B . v + C squared where its mean squared gradient is 1.

    Nearly unbiased on short arcs: 90 degrees with 5 % noise shrink II and III by 22 % of the radius, this by 0.2 %
    (seed-methods.md S4). Not in the paper.
    """
    k = len(s.mean)
    lift = np.zeros((k + 1, k + 1))  # deviations of (v, z) -> those of (|v - m|^2, v)
    lift[0, :k], lift[0, k] = -2.0 * s.mean, 1.0
    lift[1:, :k] = np.eye(k)
    moments = np.empty((k + 1, k + 1))
    moments[:k, :k], moments[:k, k], moments[k, :k], moments[k, k] = s.vv, s.vz, s.vz, s.zz
    z_mean = float(np.trace(s.vv))
    shrink = np.ones(k + 1)
    shrink[0] = 0.5 / math.sqrt(z_mean)
    _, vectors = np.linalg.eigh(shrink[:, None] * (lift @ moments @ lift.T) * shrink)
    y = shrink * vectors[:, 0]
    if abs(y[0]) * math.sqrt(z_mean) < 1e-12:
        return s.mean, -1.0  # a straight line
    centre = -y[1:] / (2.0 * y[0])
    return centre + s.mean, float(centre @ centre) + z_mean


KASA = Round(kasa, biased=True, curvature=10.0)
BULLOCK = Round(bullock, biased=True, curvature=10.0)
TAUBIN = Round(taubin, biased=False, curvature=3.0)


def round_fit(m: Moments, method: Round, least: int, independent: float = 1.0) -> Fit | Refusal:
    """Circle (d = 2) or sphere (d = 3) of the points taken; of points in space that span but a plane, the circle in it.

    least : fewest points.  independent : share of the samples whose errors are independent, 0 to 1.
    Cov(centre) = r^2 s^2 (N C)^-1 (seed-methods.md S4) and the square of what noise has drawn it to the mean by.
    """
    d = m.dimensions
    if m.samples < least or m.effective < d + 2:
        return Refusal.TOO_FEW
    if not m.spreads():
        return Refusal.NO_ROTATION
    spread, axes = np.linalg.eigh(m.covariance())
    got = _in_directions(m, method, spread, axes, independent)
    if d == 3 and got in (Refusal.ARC_TOO_SHORT, Refusal.COLLINEAR):
        flat = _in_directions(m, method, spread[1:], axes[:, 1:], independent)
        # Banked turns are no circle in a plane; what is missing then is still the third direction.
        thin = got is Refusal.ARC_TOO_SHORT and flat is Refusal.NO_ROTATION
        return got if thin else flat
    return got


def _in_directions(m: Moments, method: Round, spread: Array, axes: Array, independent: float) -> Fit | Refusal:
    roundness = float(spread[0] / spread[-1])
    if not roundness > _LINE:
        return Refusal.COLLINEAR
    s, k = m.within(axes), axes.shape[1]
    shortest, weak = (SHORT_ARC, WEAK_ARC) if k == 2 else (_SHALLOW, SHORT_ARC)
    if roundness < shortest:
        return Refusal.ARC_TOO_SHORT
    centre, square = method.solve(s)
    if not (math.isfinite(square) and square > 0.0):
        return Refusal.NO_ROTATION
    misfit = max(s.zz - 4.0 * float(centre @ s.vz) + 4.0 * float(centre @ s.vv @ centre), 0.0)
    residual2 = misfit / (4.0 * square)
    noise2 = residual2 * m.effective / (m.effective - k - 1.0)
    if noise2 > NO_CIRCLE**2 * square:
        return Refusal.NO_ROTATION
    if float(spread[0]) < method.curvature * noise2:
        return Refusal.ARC_TOO_SHORT
    shift = m.shift if m.shift is not None else np.zeros(m.dimensions)
    middle = axes @ (axes.T @ shift + m.scale * centre)
    if m.directions(axes, middle, m.scale * math.sqrt(square)) < k + 2:
        return Refusal.FEW_HEADINGS  # as many as there are unknowns: any values fit, and look as good as exact
    inverse = np.linalg.inv(s.vv - noise2 * np.eye(k))
    covariance = inverse * (square * noise2 / max(m.effective * independent, 1.0))
    if method.biased:
        drawn = noise2 * (inverse @ (centre - s.mean))
        covariance = covariance + np.outer(drawn, drawn)
    return Fit(
        centre=middle,
        radius=m.scale * math.sqrt(square),
        residual=m.scale * math.sqrt(residual2),
        covariance=axes @ covariance @ axes.T * m.scale**2,
        seen=axes,
        matrix=np.eye(m.dimensions),
        roundness=roundness,
        weak=roundness < weak,
        samples=m.samples,
    )
