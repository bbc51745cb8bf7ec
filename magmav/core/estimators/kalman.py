"""A linear Kalman filter that uses attitude: the levelled field turns with the vehicle and is otherwise constant.

State (10,), mG: b hard iron in the sensor's axes; h the Earth's field in levelled axes, (H cos psi, -H sin psi, V);
d a short-lived disturbance in levelled axes (tilt error, motors), first-order Gauss-Markov.

Process: when the gyro says the heading grew by a, h <- Rz(a) h; the gyro's own error is noise along the horizontal
circle. b walks slowly. Measurement, with A and e the autopilot's own matrix and motor term:
    A m + e = A b + Rot(w t) R_bl (h + d) + n            Rot(w t) f: the field f as it was t earlier, at body rate w
A two-axis compass gives the first two rows of it; b's third entry then stays unknown and harms nothing.
Linear in all but t, and t is small, so no start value is needed and none can be wrong.
The autopilot's yaw is never a measurement: it follows the compass being judged (estimation.md section 7.1).

All noise is known only up to one common factor, which does not change the gains but scales the covariance; it is
estimated from the innovations as in geodesy (variance of unit weight). The world model is not mixed into the state:
it is fused at the moment of asking, so that what motion alone has shown stays visible (own_sigma_mg).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from filterpy.kalman import predict, update
from numpy.typing import NDArray

from magmav.core.field import ExpectedField
from magmav.core.rotation import level_from_body, rotation
from magmav.core.types import Estimate, Mat3, Sample, vec3

Array = NDArray[np.float64]
_B, _H, _D, _T = slice(0, 3), slice(3, 6), slice(6, 9), 9
_SIZE = 10
_B_DIAGONAL, _D_DIAGONAL = [0, 11, 22], [66, 77, 88]
_EYE3, _EYE = np.eye(3), np.eye(_SIZE)


@dataclass(frozen=True, slots=True)
class Noise:
    """What is assumed of sensor, motion and surroundings. Units as named."""

    prior_iron_mg: float = 500.0
    prior_field_mg: float = 600.0
    reading_mg: float = 5.0  # sensor noise and rounding
    sync_s: float = 0.02  # mismatch in time between field and attitude: turns rate into error
    disturbance_mg: float = 8.0  # of the levelled field: a degree of tilt in 500 mG
    disturbance_tau_s: float = 10.0
    delay_s: float = 0.05  # one sigma of what is not known of the compass's delay
    delay_walk_s: float = 0.0005  # per square root of a second: a telemetry stream changes its phase
    iron_walk_mg: float = 0.1  # per square root of a second
    gyro_walk_rad: float = math.radians(0.15)  # per square root of a second
    own_gyro_walk_rad: float = math.radians(0.6)  # the same for a gyro nobody has corrected
    gyro_scale: float = 0.01
    least_tilt_rad: float = math.radians(2.0)  # RMS per axis; tilting less than this may be the attitude's own noise
    tilt_memory_s: float = 30.0
    doubt_nis: float = 11.2  # beyond this (3 degrees of freedom) a reading is trusted less, not thrown away
    outlier_nis: float = 16.0  # and it counts for no more than this in the statistics
    model_mg: float = 8.0  # world model against the real local field
    factor_lo: float = 0.25  # bounds of the common factor on all sigmas, squared
    factor_hi: float = 25.0
    change_nis: float = 8.0  # per axis, kept up for change_s: the iron itself has changed
    change_s: float = 1.5
    change_hold_s: float = 3.0


class _Way(NamedTuple):
    """From the last sample that taught to this one: time, turn, the turn's variance, and whether it is lost."""

    dt_s: float
    turn_rad: float
    turn_rad2: float
    lost: bool

    def after(self, s: Sample, n: Noise) -> _Way:
        """The same and one sample more."""
        dt = max(s.dt_s, 0.0)
        walk = n.gyro_walk_rad if s.tilt_from == "ATTITUDE" else n.own_gyro_walk_rad
        variance = walk**2 * dt + (n.gyro_scale * s.yaw_step_rad) ** 2
        return _Way(self.dt_s + dt, self.turn_rad + s.yaw_step_rad, self.turn_rad2 + variance, self.lost or s.gap)


_STILL = _Way(0.0, 0.0, 0.0, False)


class _Tilt:
    """Calms the tilt: what may be nothing but the attitude's own noise must not count as tilting.

    A noisy regressor makes a regression see too little of what it multiplies, and too sure of it: a level rover with
    0.3 degrees of noise "proved" its down axis 430 mG wrong. While the vehicle tilts less than noise might, its tilt is
    taken to be the slow mean and the difference counts as error of the reading. A share of the tilt would bias the
    down axis the other way wherever the attitude is better than feared (SITL: 14 mG).
    """

    def __init__(self) -> None:
        self._mean_b: tuple[float, float, float] | None = None  # of the down direction
        self._variance_rad2 = 0.0
        self._n = 0

    def calmed(self, s: Sample, n: Noise) -> tuple[float, float, float]:
        """Roll and pitch to reckon with, and the angle that was taken away, rad."""
        cp = math.cos(s.pitch_rad)
        down = (-math.sin(s.pitch_rad), math.sin(s.roll_rad) * cp, math.cos(s.roll_rad) * cp)
        if self._mean_b is None:
            self._mean_b = down
        self._n += 1
        weight = max(min(max(s.dt_s, 0.0) / n.tilt_memory_s, 0.2), 1.0 / self._n)
        mean = self._mean_b
        away = (down[0] - mean[0], down[1] - mean[1], down[2] - mean[2])
        off = math.hypot(*away)
        self._mean_b = (mean[0] + weight * away[0], mean[1] + weight * away[1], mean[2] + weight * away[2])
        self._variance_rad2 += weight * (off * off - self._variance_rad2)
        if self._variance_rad2 > 2.0 * n.least_tilt_rad**2 or off > 2.0 * n.least_tilt_rad:
            return s.roll_rad, s.pitch_rad, 0.0
        x, y, z = self._mean_b
        return math.atan2(y, z), math.atan2(-x, math.hypot(y, z)), off


class KalmanEstimator:
    """One compass's filter. ``noise`` holds every number that was chosen."""

    def __init__(self, noise: Noise | None = None) -> None:
        self.noise = noise or Noise()
        n = self.noise
        self._x: Array = np.zeros(_SIZE)
        self._P: Array = np.diag(
            [n.prior_iron_mg**2] * 3 + [n.prior_field_mg**2] * 3 + [n.disturbance_mg**2] * 3 + [n.delay_s**2]
        ).astype(np.float64)
        self._idle = _STILL  # time that taught nothing is made up for when something does again
        self._tilt = _Tilt()
        self._samples = 0
        self._nis_sum = 0.0  # clipped NIS per axis, and how many
        self._recent_nis = 1.0
        self._residual_mg2 = 0.0
        self._residual_n = 0  # since the last sudden change: what it tore open is no misfit of what came after
        self._bad_s = 0.0
        self._since_change_s = 1e9
        self._innovation_mg = np.zeros(3)
        self._axes = 3

    def step(self, sample: Sample) -> None:
        """Carry the state to this sample's time and, where the time teaches, learn from it."""
        self._since_change_s += max(sample.dt_s, 0.0)
        if not sample.learn:
            self._idle = self._idle.after(sample, self.noise)
            return
        self._turn(self._idle.after(sample, self.noise))
        self._idle = _STILL
        self._learn(sample)

    # ------------------------------------------------------------ process

    def _turn(self, way: _Way) -> None:
        n = self.noise
        fade = math.exp(-way.dt_s / n.disturbance_tau_s)
        F = _EYE.copy()
        F[6, 6] = F[7, 7] = F[8, 8] = fade
        c, si = math.cos(way.turn_rad), math.sin(way.turn_rad)
        F[3:5, 3:5] = ((c, si), (-si, c))
        Q = np.zeros((_SIZE, _SIZE))
        Q.flat[_B_DIAGONAL] = n.iron_walk_mg**2 * way.dt_s
        Q.flat[_D_DIAGONAL] = n.disturbance_mg**2 * (1.0 - fade * fade)
        Q[_T, _T] = n.delay_walk_s**2 * way.dt_s
        if way.lost:
            # Nobody knows how far the vehicle turned: the horizontal field may point anywhere.
            self._forget_direction(F)
        else:
            ahead, right = F[3:5, 3:5] @ self._x[3:5]
            along = np.array((right, -ahead))
            unsure = (self._P[3, 3] + self._P[4, 4]) / 2.0
            Q[3:5, 3:5] = way.turn_rad2 * (along[:, None] * along + ((unsure, 0.0), (0.0, unsure)))
        self._x, self._P = predict(self._x, self._P, F, Q)

    def _forget_direction(self, F: Array) -> None:
        prior = self.noise.prior_field_mg**2
        self._x[3:5] = 0.0
        F[3:5, :] = 0.0
        self._P[3:5, :] = 0.0
        self._P[:, 3:5] = 0.0
        F[3, 3] = F[4, 4] = 1.0
        self._P[3, 3] = self._P[4, 4] = prior

    # ------------------------------------------------------------ measurement

    def _learn(self, s: Sample) -> None:
        n = self.noise
        roll, pitch, removed = self._tilt.calmed(s, n)
        body_from_level = level_from_body(roll, pitch).T
        level_field = self._x[_H] + self._x[_D]
        k = self._axes = s.axes
        predicted, H = measurement(s, body_from_level, self._x[_B], level_field, float(self._x[_T]))
        predicted, H = predicted[:k], H[:k]
        z = (s.shaping.matrix @ s.mag_b_mg + s.shaping.motor_b_mg)[:k]
        total = min(max(math.hypot(*self._x[_H]), 200.0), 700.0)
        smear = n.sync_s * math.hypot(*s.rate_b_rads) * total
        R = _EYE3[:k, :k] * (n.reading_mg**2 + smear * smear + (removed * total) ** 2)
        innovation = z - predicted
        S = H @ self._P @ H.T + R
        nis = float(innovation @ np.linalg.solve(S, innovation))
        self._judge(nis / k, innovation, s.dt_s)
        limit = n.doubt_nis * (k / 3.0) * self._factor()
        if nis > limit:
            R = R + S * (nis / limit - 1.0)
        linear = innovation + H @ self._x  # filterpy subtracts H x again
        self._x, self._P = update(self._x, self._P, linear, R, H)
        self._samples += 1
        left = linear - H @ self._x + (body_from_level @ self._x[_D])[:k]
        self._residual_n += 1
        self._residual_mg2 += (float(left @ left) / k - self._residual_mg2) / min(self._residual_n, 500)

    def _judge(self, nis: float, innovation: Array, dt_s: float) -> None:
        """Keep the innovation statistics; accept that the iron has changed when they stay bad."""
        n = self.noise
        clipped = min(nis, n.outlier_nis)
        if self._samples >= 10:
            self._nis_sum += clipped
        weight = min(dt_s / 2.0, 0.2)
        self._recent_nis += weight * (clipped - self._recent_nis)
        whole = np.append(innovation, 0.0) if len(innovation) == 2 else innovation
        self._innovation_mg += weight * (whole - self._innovation_mg)
        bad = nis > n.change_nis * self._factor() and self._samples > 30
        self._bad_s = max(0.0, self._bad_s + (dt_s if bad else -dt_s))
        if self._bad_s >= n.change_s and self._since_change_s >= n.change_hold_s:
            jump = max(80.0, 1.5 * float(np.linalg.norm(self._innovation_mg)))
            self._P[_B, _B] += np.eye(3) * jump**2
            self._bad_s = self._since_change_s = 0.0
            self._residual_n = 0

    def _factor(self) -> float:
        """Variance of unit weight, pulled to 1 while few samples speak."""
        n = self.noise
        return min(max((self._nis_sum + 50.0) / (max(self._samples - 10, 0) + 50.0), n.factor_lo), n.factor_hi)

    # ------------------------------------------------------------ answer

    def estimate(self, expected: ExpectedField | None) -> Estimate | None:
        """Belief now, with the world model's field fused in where a position gives it."""
        if self._samples < 10:
            return None
        factor = self._factor()
        own = np.sqrt(np.diag(self._P)[_B] * factor)
        x, P = self._x, self._P * factor
        if expected is not None:
            x, P = self._with_model(x, P, expected)
        covariance: Mat3 = P[_B, _B].copy()
        return Estimate(
            hard_iron_b_mg=vec3(x[_B], "hard iron"),
            covariance_mg2=covariance,
            own_sigma_mg=vec3(own, "sigma"),
            horizontal_mg=math.hypot(x[3], x[4]),
            down_mg=float(x[5]),
            residual_mg=math.sqrt(self._residual_mg2),
            step_nis=self._recent_nis,
            samples=self._samples,
            delay_s=float(self._x[_T]),
            changed_ago_s=self._since_change_s,
            says_b=(True, True, self._axes == 3),
        )

    def _with_model(self, x: Array, P: Array, expected: ExpectedField) -> tuple[Array, Array]:
        """Two scalar measurements: the downward field and, once its direction is known, the horizontal strength."""
        R = np.array([[self.noise.model_mg**2]])
        down = np.zeros((1, _SIZE))
        down[0, 5] = 1.0
        x, P = update(x, P, np.array([expected.down_mg]), R, down)
        strength = math.hypot(x[3], x[4])
        if strength > 0.0 and math.sqrt(P[3, 3] + P[4, 4]) < strength / 3.0:
            along = np.zeros((1, _SIZE))
            along[0, 3:5] = x[3:5] / strength
            x, P = update(x, P, np.array([expected.horizontal_mg]), R, along)
        return x, P


def measurement(
    s: Sample, body_from_level: Array, iron_b_mg: Array, field_l_mg: Array, delay_s: float
) -> tuple[Array, Array]:
    """Predicted A m + e, (3,) mG, and its Jacobian (3, 10) in (b, h, d, t).

    ``field_l_mg`` is h + d. The body turned by w t since the value was measured, and a fixed field turns the other way.
    """
    A = s.shaping.matrix
    earlier = rotation(s.rate_b_rads * delay_s) @ body_from_level
    field_b = earlier @ field_l_mg
    H = np.empty((3, _SIZE))
    H[:, _B] = A
    H[:, _H] = H[:, _D] = earlier
    wx, wy, wz = s.rate_b_rads
    fx, fy, fz = field_b
    H[:, _T] = (wy * fz - wz * fy, wz * fx - wx * fz, wx * fy - wy * fx)
    return A @ iron_b_mg + field_b, H
