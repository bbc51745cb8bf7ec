"""The adaptive estimator: a small bank of error-state filters over headings and models, on one measurement equation.

layout       what the state holds
process      how time passes
measurement  the one equation and its Jacobian
bank         hypotheses and weights
change       a sudden change of the iron
tuning       every chosen number
"""

from __future__ import annotations

import math

import numpy as np

from magmav.core.estimators.adaptive import layout as at
from magmav.core.estimators.adaptive.bank import Bank, field_covariance
from magmav.core.estimators.adaptive.change import ChangeWatch
from magmav.core.estimators.adaptive.layout import Array
from magmav.core.estimators.adaptive.measurement import Equation, noise, soft_matrix
from magmav.core.estimators.adaptive.process import advance
from magmav.core.estimators.adaptive.tuning import MODELS, Tuning
from magmav.core.field import ExpectedField
from magmav.core.rotation import body_from_earth
from magmav.core.types import Estimate, Sample, mat3, vec3

_EYE3 = np.eye(3)


class AdaptiveEstimator:
    """One compass's bank."""

    def __init__(self, tuning: Tuning | None = None) -> None:
        self.tuning = tuning or Tuning()
        self._bank: Bank | None = None
        self._own_yaw_rad = 0.0
        self._idle_s = 0.0
        self._idle_down = np.zeros(3)
        self._idle_turn_rad2 = 0.0
        self._lost = False
        self._drive = 0.0  # mean of what k is multiplied with
        self._samples = 0
        self._residual_mg2 = 0.0
        self._nis = 1.0
        self._change = ChangeWatch(self.tuning)
        self._residual_n = 0
        self._axes = 3
        self._equation = Equation(0)
        self._model_mg: tuple[float, float] | None = None

    # ------------------------------------------------------------ time

    def step(self, s: Sample) -> None:
        """Learn from one sample, or carry time forward."""
        n = self.tuning
        self._own_yaw_rad += s.yaw_step_rad
        body_from_own = s.body_from_own
        if body_from_own is None:
            body_from_own = body_from_earth(s.roll_rad, s.pitch_rad, self._own_yaw_rad)
        dt = max(s.dt_s, 0.0)
        self._idle_s += dt
        self._idle_down += dt * body_from_own[:, 2]
        walk = n.turn_walk_rad if s.tilt_from == "ATTITUDE" else 4.0 * n.turn_walk_rad
        about_down = float(s.rate_b_rads @ body_from_own[:, 2]) * dt
        self._idle_turn_rad2 += walk**2 * dt + (n.turn_scale * about_down) ** 2
        self._lost = self._lost or s.gap
        if not s.learn:
            return
        self._axes = s.axes
        z = s.shaping.matrix @ s.mag_b_mg + s.shaping.motor_b_mg
        if self._bank is None:
            self._bank = Bank.begun(self._prior(s, z, body_from_own), n)
            self._forget_idle()
        bank = self._bank
        if self._lost:
            bank.lose_heading(n)
        if self._model_mg is None and s.model_mg is not None:
            self._model_mg = s.model_mg
            bank.tell_field(*s.model_mg, n)
        tilt = n.tilt_rad if s.tilt_from == "ATTITUDE" else n.own_tilt_rad
        if self._idle_s > 0.0:
            advance(
                bank.x,
                bank.p,
                self._idle_s,
                self._idle_down,
                self._idle_turn_rad2,
                tilt,
                bank.walk_mg,
                bank.disturbance_mg,
                n,
            )
        self._update(bank, s, z, body_from_own, self._idle_s)
        self._forget_idle()
        self._samples += 1
        if self._samples % n.prune_every == 0 and len(bank) > len(MODELS):
            bank.tidy(n)

    def _prior(self, s: Sample, z: Array, body_from_own: Array) -> tuple[float, float, float, float]:
        n = self.tuning
        self._model_mg = s.model_mg
        if s.model_mg is not None:
            return s.model_mg[0], n.model_mg, s.model_mg[1], n.model_mg
        return (*n.blind_h_mg, float(z @ body_from_own[:, 2]), n.blind_v_mg)

    def _forget_idle(self) -> None:
        self._lost = False
        self._idle_s = self._idle_turn_rad2 = 0.0
        self._idle_down = np.zeros(3)

    # ------------------------------------------------------------ learning

    def _update(self, bank: Bank, s: Sample, z: Array, body_from_own: Array, dt_s: float) -> None:
        n, k = self.tuning, s.axes
        if len(self._equation) != len(bank):
            self._equation = Equation(len(bank))
        drive = 0.0 if s.throttle is None else s.throttle - 0.5
        self._drive += (drive - self._drive) / min(self._samples + 1, 2000)
        y, j, u = self._equation(bank.x, body_from_own, s.shaping.matrix, s.rate_b_rads, drive)
        smear = (n.sync_s * math.hypot(*s.rate_b_rads)) ** 2
        r = noise(u, n.reading_mg**2 * bank.scale, smear)
        y, j, r = y[:, :k], j[:, :k], r[:, :k, :k]
        nu = z[:k] - y
        pj = bank.p @ j.transpose(0, 2, 1)
        expected = j @ pj + r
        inverse = np.linalg.inv(expected)
        pull = (inverse @ nu[:, :, None])[:, :, 0]
        nis = (nu * pull).sum(1)
        log_likelihood = -0.5 * (np.minimum(nis, n.doubt_nis) - np.log(np.linalg.det(inverse)))
        doubt = np.minimum(n.doubt_nis / np.maximum(nis, 1e-9), 1.0)
        if doubt.min() < 1.0:
            inverse = inverse * doubt[:, None, None]
            pull = pull * doubt[:, None]
        gain = pj @ inverse
        bank.x += (pj @ pull[:, :, None])[:, :, 0]
        bank.p -= gain @ pj.transpose(0, 2, 1)
        bank.p = 0.5 * (bank.p + bank.p.transpose(0, 2, 1))  # rounding must not grow into asymmetry
        bank.weigh(log_likelihood, dt_s, n)
        best = int(np.argmax(bank.log_weight))
        white = self._adapt(bank, nu, expected, dt_s, k)
        push = bank.x[best, at.D] / bank.disturbance_mg[best]
        like = float(bank.product[best] / max(bank.square[best], 0.1))
        if self._samples > 30 and self._change.step(white[best], nu[best], like, float(push @ push), dt_s):
            self._change.open(bank)
            self._residual_n = 0
        self._nis += min(dt_s / 2.0, 0.2) * (min(float(nis[best]), 40.0) / k - self._nis)
        left = nu[best] - j[best] @ (pj[best] @ pull[best]) + bank.x[best, at.D][:k]
        self._residual_n += 1
        weight = 1.0 / min(self._residual_n, 500)
        self._residual_mg2 += weight * (float(left @ left) / k - self._residual_mg2)

    def _adapt(self, bank: Bank, nu: Array, expected: Array, dt_s: float, k: int) -> Array:
        """Noise as it shows: white noise scales the reading's variance, coloured noise the disturbance.

        The whitened innovations (K, k), clipped.
        """
        n = self.tuning
        white = nu / np.sqrt(expected.reshape(len(bank), k * k)[:, :: k + 1])
        np.maximum(white, -4.0, out=white)
        np.minimum(white, 4.0, out=white)
        if self._samples > 20:
            weight = min(dt_s / 5.0, 0.05)
            bank.square += weight * ((white * white).sum(1) / k - bank.square)
            bank.product += weight * ((white * bank.last[:, :k]).sum(1) / k - bank.product)
        bank.last[:, :k] = white
        if self._samples % n.adapt_every or self._samples <= 60:
            return white
        rate = min(n.adapt_every * dt_s / 10.0, 0.2)
        bank.scale = np.clip(bank.scale * np.exp(rate * np.clip(bank.square - 1.0, -1.0, 2.0)), n.scale_lo, n.scale_hi)
        like = np.clip(bank.product / np.maximum(bank.square, 0.1), -1.0, 1.0)
        bank.disturbance_mg = np.clip(
            bank.disturbance_mg * np.exp(rate * np.clip(4.0 * (like - 0.1), -1.0, 2.0)),
            n.disturbance_lo_mg,
            n.disturbance_hi_mg,
        )
        return white

    # ------------------------------------------------------------ answer

    def estimate(self, expected: ExpectedField | None) -> Estimate | None:
        """Belief now."""
        if self._bank is None or self._samples < 10:
            return None
        mean, covariance = self._bank.mixture()
        soft = _EYE3 + soft_matrix(mean[at.S])
        take = np.zeros((3, at.SIZE))  # iron at mean throttle
        take[:, at.B], take[:, at.K] = _EYE3, self._drive * _EYE3
        own = covariance
        if self._model_mg is not None:
            own = without_prior(covariance, *self._model_mg, self.tuning)
        return Estimate(
            hard_iron_b_mg=vec3(take @ mean, "hard iron"),
            covariance_mg2=take @ covariance @ take.T,
            own_sigma_mg=vec3(np.sqrt(np.diag(take @ own @ take.T)), "sigma"),
            horizontal_mg=float(mean[at.H]),
            down_mg=float(mean[at.V]),
            residual_mg=math.sqrt(self._residual_mg2),
            step_nis=self._nis,
            samples=self._samples,
            changed_ago_s=self._change.since_s,
            delay_s=float(mean[at.T]),
            soft_iron_b=mat3(np.linalg.inv(soft), "soft iron"),
            says_b=(True, True, self._axes == 3),
        )


def without_prior(covariance: Array, h_mg: float, v_mg: float, n: Tuning) -> Array:
    """The covariance had the field not been known beforehand, (n, n): the prior on (H, V) taken out, a wide one put in.

    A prior is a measurement, and a measurement can be taken back: P + P C' (R - C P C')^-1 C P, with R^-1 the
    difference of the two priors' information.
    """
    known = np.linalg.inv(field_covariance(h_mg, v_mg, n))
    wide = np.diag((1.0 / n.blind_h_mg[1] ** 2, 1.0 / n.blind_v_mg**2))
    now = covariance[at.H : at.V + 1, at.H : at.V + 1]
    left = np.linalg.inv(known - wide) - now
    left = 0.5 * (left + left.T)
    least = np.linalg.eigvalsh(left)[0]
    if least < 1e-3:  # nothing but the prior is known of it
        left = left + (1e-3 - least) * np.eye(2)
    columns = covariance[:, at.H : at.V + 1]
    out: Array = covariance + columns @ np.linalg.solve(left, columns.T)
    return out
