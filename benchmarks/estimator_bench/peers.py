"""Methods of other people, written here from their published equations, correct: what the estimators must beat.

    twostep_batch  Alonso and Shuster 2002, TWOSTEP; hard iron from the field's length alone
    twostep_win  the same over the last 40 s, with the worst tenth of the values taken out, twice
    sar_ls, sar_kf, sar_aid    Troni and Whitcomb 2019, hard iron from x' = -w x (x - b)

The packages that ship SAR-LS, SAR-KF, SAR-AID and TWOSTEP have errors; ``shipped`` spells them out, so that the
difference can be pinned: magyc 1.0.0 squares the skew matrix element by element (SAR-LS), reshapes where it should
transpose (SAR-KF, SAR-AID), and centres the reference instead of the measurement (TWOSTEP).

All take fields (N, 3) in mG; they return the hard iron (3,) mG, or None where the data do not say.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from estimator_bench.motions import Array
from estimator_bench.running import Heard

NOISE_MG = 5.0
WINDOW_S, TRIMMED = 40.0, 0.1
_LEAST = 20
_ROUNDS = 30


class Columns(NamedTuple):
    """The Samples that teach, as arrays. field_mg: length of the model's field, None where no position was known."""

    t_s: Array
    mag_mg: Array
    rate_rads: Array
    roll_rad: Array
    pitch_rad: Array
    field_mg: float | None

    def between(self, from_s: float, to_s: float) -> Columns:
        """Those of from_s < t <= to_s."""
        some = (self.t_s > from_s) & (self.t_s <= to_s)
        t_s, mag, rate, roll, pitch = (v[some] for v in self[:5])
        return Columns(t_s, mag, rate, roll, pitch, self.field_mg)


def columns(heard: list[Heard]) -> Columns:
    """Of a tape; times are those of measurement as the assembler believes them."""
    some = [h for h in heard if h.sample.learn]
    expected = some[-1].circumstances.expected if some else None
    return Columns(
        np.array([h.t_s - h.sample.age_s for h in some]),
        np.array([h.sample.mag_b_mg for h in some]).reshape(-1, 3),
        np.array([h.sample.rate_b_rads for h in some]).reshape(-1, 3),
        np.array([h.sample.roll_rad for h in some]),
        np.array([h.sample.pitch_rad for h in some]),
        None if expected is None else expected.total_mg,
    )


# ---------------------------------------------------------------- TWOSTEP


def twostep(mag_mg: Array, field_mg: float | None, noise_mg: float = NOISE_MG) -> Array | None:
    """TWOSTEP. field_mg None: the length is not known, and the first step (which never needs it) is the answer.

    z = |B|^2 - |F|^2 = 2 B.b - |b|^2 + v,  v of mean -3 s^2 and variance 4 s^2 |F|^2 + 6 s^4 (their eq. 5 to 7). Step
    one: z and B less their means, linear in b (33). Step two: Gauss-Newton with the mean's own equation as well
    (eq. 39 and after). DEVIATES: the variance is taken the same for all values, at the field's length; no data are
    weighted by a bias not yet known.
    """
    if len(mag_mg) < _LEAST:
        return None
    centre = mag_mg.mean(axis=0)
    away = mag_mg - centre
    square = np.einsum("ij,ij->i", mag_mg, mag_mg)
    length2 = float(square.mean()) if field_mg is None else field_mg**2
    variance = 4.0 * noise_mg**2 * length2 + 6.0 * noise_mg**4
    F = 4.0 * away.T @ away / variance
    if np.linalg.cond(F) > 1e12:
        return None
    right = 2.0 * away.T @ (square - square.mean()) / variance
    b = np.linalg.solve(F, right)
    if field_mg is None:
        return np.asarray(b)
    z_bar = float(square.mean()) - length2 + 3.0 * noise_mg**2
    mean_variance = variance / len(mag_mg)
    for _ in range(_ROUNDS):
        slope = 2.0 * (centre - b)
        miss = z_bar - 2.0 * float(centre @ b) + float(b @ b)
        full = F + np.outer(slope, slope) / mean_variance
        step = np.linalg.solve(full, right - F @ b + slope * miss / mean_variance)
        b = b + step
        if float(np.abs(step).max()) < 1e-6:
            break
    return np.asarray(b) if np.isfinite(b).all() else None


def twostep_windowed(mag_mg: Array, field_mg: float | None, noise_mg: float = NOISE_MG) -> Array | None:
    """TWOSTEP, then without the tenth of the values whose length is worst, twice over. The caller cuts the window."""
    kept = mag_mg
    b = twostep(kept, field_mg, noise_mg)
    for _ in range(2):
        if b is None:
            return None
        length = np.linalg.norm(mag_mg - b, axis=1)
        off = np.abs(length - (float(np.median(length)) if field_mg is None else field_mg))
        kept = mag_mg[off <= np.quantile(off, 1.0 - TRIMMED)]
        b = twostep(kept, field_mg, noise_mg)
    return b


# ---------------------------------------------------------------- SAR: from turning alone


def skew(v: Array) -> Array:
    """[v]x of (N, 3), (N, 3, 3)."""
    x, y, z = v.T
    nil = np.zeros_like(x)
    return np.moveaxis(np.array([[nil, -z, y], [z, nil, -x], [-y, x, nil]]), 2, 0)


def sar_ls(t_s: Array, mag_mg: Array, rate_rads: Array, shipped: bool = False) -> Array | None:
    """SAR-LS (section IV.A): b = (sum W W)^-1 sum W (x' + w x x), W = [w]x; x' by differences.

    shipped : with the error of magyc 1.0.0, squares element by element for W W.
    """
    if len(mag_mg) < _LEAST:
        return None
    W = skew(rate_rads)
    slope = np.vstack((np.zeros((1, 3)), np.diff(mag_mg, axis=0) / np.diff(t_s)[:, None]))
    square = W**2 if shipped else W @ W
    right = np.einsum("nij,nj->i", W, slope + np.cross(rate_rads, mag_mg))
    total = square.sum(axis=0)
    return None if np.linalg.cond(total) > 1e12 else np.asarray(np.linalg.solve(total, right))


def sar_kf(
    t_s: Array, mag_mg: Array, rate_rads: Array, noise_mg: float = NOISE_MG, rate_noise_rads: float = 0.02
) -> Array | None:
    """SAR-KF (IV.B): Kalman filter of field and bias, x' = -w x (x - b); exact turning over a step.

    DEVIATES: gains are what noise asks for; the paper gives none for this unit. The last fifth is averaged, as shipped.
    """
    if len(mag_mg) < _LEAST:
        return None
    x = np.concatenate((mag_mg[0], np.zeros(3)))
    P = np.diag([noise_mg**2] * 3 + [300.0**2] * 3)
    R = np.eye(3) * noise_mg**2
    past = np.empty((len(mag_mg), 3))
    smear = (rate_noise_rads * 500.0) ** 2
    for i, m in enumerate(mag_mg):
        dt = float(t_s[i] - t_s[i - 1]) if i else 0.0
        turned = _turned(0.5 * (rate_rads[i] + rate_rads[max(i - 1, 0)]) * dt)
        F = np.block([[turned, np.eye(3) - turned], [np.zeros((3, 3)), np.eye(3)]])
        x, P = F @ x, F @ P @ F.T
        P[:3, :3] += np.eye(3) * smear * dt * dt
        gain = P[:, :3] @ np.linalg.inv(P[:3, :3] + R)
        x = x + gain @ (m - x[:3])
        P = P - gain @ P[:3, :]
        past[i] = x[3:]
    return np.asarray(past[-max(round(0.2 * len(past)), 1) :].mean(axis=0))


def sar_aid(t_s: Array, mag_mg: Array, rate_rads: Array, gains: tuple[float, float] = (1.0, 1.0)) -> Array | None:
    """SAR-AID (IV.C, eq. 5): x^' = -w x (x^ - b^) - k1 (x^ - x), b^' = -k2 [w]x^T (x^ - x); the last fifth averaged."""
    if len(mag_mg) < _LEAST:
        return None
    W = skew(rate_rads)
    field, b = mag_mg[0].copy(), np.zeros(3)
    past = np.empty((len(mag_mg), 3))
    for i, m in enumerate(mag_mg):
        dt = float(t_s[i] - t_s[i - 1]) if i else 0.0
        off = field - m
        field, b = field + dt * (-W[i] @ (field - b) - gains[0] * off), b - dt * gains[1] * W[i].T @ off
        past[i] = b
    return np.asarray(past[-max(round(0.2 * len(past)), 1) :].mean(axis=0))


def _turned(v: Array) -> Array:
    """exp(-[v]x), (3, 3)."""
    angle = float(np.linalg.norm(v))
    if angle < 1e-12:
        return np.eye(3)
    K = skew(v[None])[0] / angle
    return np.asarray(np.eye(3) - np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K)


# ---------------------------------------------------------------- the list


def answers(name: str, c: Columns, t_s: float) -> Array | None:
    """Hard iron by a method's name from all values up to a time. ValueError for a name that does not exist."""
    so_far = c.between(-np.inf, t_s)
    match name:
        case "twostep_batch":
            return twostep(so_far.mag_mg, c.field_mg)
        case "twostep_win":
            return twostep_windowed(c.between(t_s - WINDOW_S, t_s).mag_mg, c.field_mg)
        case "sar_ls":
            return sar_ls(*so_far[:3])
        case "sar_kf":
            return sar_kf(*so_far[:3])
        case "sar_aid":
            return sar_aid(*so_far[:3])
    raise ValueError(f"no peer called {name!r}")


EVERY_SECOND = ("twostep_batch", "twostep_win")  # cheap enough to be asked all along
AT_CHECKPOINTS = ("sar_ls", "sar_kf", "sar_aid")
