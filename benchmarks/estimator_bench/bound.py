"""Posterior Cramer-Rao bound: how well anybody could know the calibration, given this flight's motion and noise.

The recursion of an extended Kalman filter's covariance, but with every Jacobian taken at the truth and every noise at
its true size (Van Trees; Tichavsky 1998 for the recursive form): the posterior bound of a nonlinear problem with
Gaussian noise. Own algebra throughout; nothing of magmav.core.

State, errors of: yaw (1, rad about earth's down), tilt (2, rad, level earth axes, Gauss-Markov), how far acceleration
misleads the tilt (1, rad per g), gyro bias (3, rad/s), iron (3, mG), field (3, mG: magnetic north and east, down),
delay of the compass (1, s: nobody is told of it), and where the scenario has them soft iron (6), throttle coupling
(3, mG) and drift (3, mG/s).

    sensor = (I + S) C_bn B + b + k throttle + noise
The attitude is known but for yaw and tilt; yaw is carried by a gyro with a bias. Where no attitude is sent, the tilt
is taken to be as good as the autopilot's would be, so the bound stays a bound. Outliers and lost values bring nothing;
neither does the time on or near the ground. The moment of a step, and that drift is steady, are taken as known: nobody
knows that in flight, so in those two scenarios nobody comes near.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from estimator_bench import telemetry as sent
from estimator_bench.flights import STEP_S, followed
from estimator_bench.motions import GRAVITY_MSS, Array
from estimator_bench.scenarios import STEP_AT_S
from estimator_bench.score import CHECKPOINTS_S, HEADINGS_RAD, level_field
from estimator_bench.telemetry import Flight

_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
_BLIND_FIELD_MG = 120.0  # without a position: the Earth's field is somewhere in its range
_LATE_S = 0.03
_ALOFT_M = 5.0


class Layout(NamedTuple):
    """Where each unknown stands; empty slices for what the scenario does not have."""

    yaw: int
    tilt: slice
    misled: int
    gyro: slice
    iron: slice
    field: slice
    late: int
    soft: slice
    throttle: slice
    drift: slice
    size: int


def layout(flight: Flight) -> Layout:
    """The unknowns of a flight."""
    c = flight.scenario.compass
    widths = (1, 2, 1, 3, 3, 3, 1, 6 if c.soft else 0, 3 if c.throttle_mg else 0, 3 if c.drift_mgps else 0)
    ends = np.cumsum(widths).tolist()
    begins = [0, *ends[:-1]]
    s = [slice(a, b) for a, b in zip(begins, ends, strict=True)]
    return Layout(0, s[1], begins[2], s[3], s[4], s[5], begins[6], s[7], s[8], s[9], ends[-1])


def prior(flight: Flight, at: Layout) -> Array:
    """What is known before the first value, (n, n)."""
    c = flight.scenario.compass
    sigma = np.zeros(at.size)
    sigma[at.yaw] = math.pi / math.sqrt(3.0)
    sigma[at.tilt] = sent.TILT_SIGMA_RAD
    sigma[at.misled] = sent.MISLED_RAD_PER_G
    sigma[at.gyro] = sent.GYRO_BIAS_RADS
    sigma[at.iron] = c.bias_mg if c.bias_length_mg is None else c.bias_length_mg / math.sqrt(3.0)
    sigma[at.field] = sent.MODEL_ERROR_MG if flight.scenario.link.gps else _BLIND_FIELD_MG
    sigma[at.late] = _LATE_S
    if c.soft:
        sigma[at.soft] = [c.soft] * 3 + [c.soft / math.sqrt(2.0)] * 3
    sigma[at.throttle] = c.throttle_mg / math.sqrt(3.0)
    sigma[at.drift] = c.drift_mgps / math.sqrt(3.0)
    return np.diag(sigma**2)


def jacobian(
    C_bn: Array, rate_b: Array, field_n: Array, soft: Array, throttle: float, felt_g: Array, t_s: float, at: Layout
) -> Array:
    """Of one value in all unknowns, (3, n). felt_g: (2,) horizontal acceleration that misleads the tilt, g."""
    H = np.zeros((3, at.size))
    A = np.eye(3) + soft
    x, y, z = field_n
    # A small turn v of the earth's axes moves the field by v x B.
    about = np.array(((0.0, z, -y), (-z, 0.0, x), (y, -x, 0.0)))  # columns: e_i x B
    turned = A @ C_bn @ about
    H[:, at.yaw] = turned[:, 2]
    H[:, at.tilt] = turned[:, :2]
    H[:, at.misled] = turned[:, 0] * -felt_g[1] + turned[:, 1] * felt_g[0]
    H[:, at.iron] = np.eye(3)
    H[:, at.field] = A @ C_bn
    body = C_bn @ field_n
    H[:, at.late] = A @ np.cross(
        rate_b, body
    )  # a fixed field turns the other way in body axes; earlier is against that
    if at.soft.stop > at.soft.start:
        for k, (i, j) in enumerate(_PAIRS):
            H[i, at.soft.start + k] += body[j]
            if i != j:
                H[j, at.soft.start + k] += body[i]
    if at.throttle.stop > at.throttle.start:
        H[:, at.throttle] = throttle * np.eye(3)
    if at.drift.stop > at.drift.start:
        H[:, at.drift] = t_s * np.eye(3)
    return H


def heading_map(flight: Flight, t_s: float, at: Layout) -> Array:
    """What each unknown's error does to the heading at HEADINGS_RAD, level, mean throttle, (24, n) rad per unit.

    Only the calibration counts: yaw, tilt and the field itself are no part of an uploaded offset.
    """
    level = level_field(flight)
    h = math.hypot(*flight.errors.field_n_mg[:2])
    across = np.stack((np.sin(HEADINGS_RAD), np.cos(HEADINGS_RAD), np.zeros(24)), 1) / h
    back = np.linalg.inv(np.eye(3) + flight.errors.soft)
    out = np.zeros((24, at.size))
    for n, (u, way) in enumerate(zip(level, across, strict=True)):
        row = jacobian(np.eye(3), np.zeros(3), u, flight.errors.soft, flight.mean_throttle, np.zeros(2), t_s, at)
        out[n] = way @ back @ row
    out[:, [at.yaw, at.misled, at.late]] = 0.0
    out[:, at.tilt] = out[:, at.field] = out[:, at.gyro] = 0.0
    return out


class Bound(NamedTuple):
    """At CHECKPOINTS_S: heading RMS over all level headings, degrees, and sigma of the iron per axis, mG."""

    heading_deg: tuple[float, ...]
    iron_mg: tuple[tuple[float, float, float], ...]


def bound(flight: Flight, checkpoints_s: tuple[float, ...] = CHECKPOINTS_S) -> Bound:
    """The bound of one flight."""
    at, truth, spec = layout(flight), flight.truth, flight.scenario.compass
    P = prior(flight, at)
    field = _magnetic(flight.errors.field_n_mg)
    turn = _to_magnetic(flight.errors.field_n_mg)
    felt = followed(truth.accel_n_mss[:, :2], sent.MISLED_TAU_S) / GRAVITY_MSS
    felt = felt @ turn[:2, :2].T
    R = np.eye(3) * (flight.errors.noise_mg**2 + 1.0 / 12.0)
    gyro_rad2ps = sent.GYRO_NOISE_RADS**2 / max(flight.scenario.link.attitude_hz, flight.scenario.link.imu_hz)
    heard = [i for i in flight.heard.tolist() if truth.height_m[i] >= _ALOFT_M or not truth.flies]
    if spec.averaged_s:
        heard = sorted(set(heard))  # a held value comes again and again, and is news once
    left = list(checkpoints_s)
    headings: list[float] = []
    irons: list[tuple[float, float, float]] = []
    before_s, stepped = 0.0, not spec.step_mg

    def read(t_s: float) -> None:
        J = heading_map(flight, t_s, at)
        headings.append(math.degrees(math.sqrt(float(np.einsum("ij,jk,ik->i", J, P, J).mean()))))
        x, y, z = np.sqrt(np.diag(_iron_now(P, at, t_s))).tolist()
        irons.append((x, y, z))

    for i in heard:
        t_s = i * STEP_S
        while left and t_s > left[0]:
            read(left.pop(0))
        C = truth.C_bn[i] @ turn.T
        _advance(P, at, C, t_s - before_s, gyro_rad2ps)
        before_s = t_s
        if not stepped and t_s >= STEP_AT_S:
            stepped = True
            P[at.iron, at.iron] += np.eye(3) * spec.step_mg**2 / 3.0
        H = jacobian(C, truth.rate_b_rads[i], field, flight.errors.soft, float(truth.throttle[i]), felt[i], t_s, at)
        gain = np.linalg.solve(H @ P @ H.T + R, H @ P).T
        keep = np.eye(at.size) - gain @ H
        P = keep @ P @ keep.T + gain @ R @ gain.T
    for t_s in left:
        read(t_s)
    return Bound(tuple(headings), tuple(irons))


def _to_magnetic(field_n: Array) -> Array:
    """Turns north-east-down to axes whose first is magnetic north, (3, 3)."""
    d = math.atan2(field_n[1], field_n[0])
    return np.array(((math.cos(d), math.sin(d), 0.0), (-math.sin(d), math.cos(d), 0.0), (0.0, 0.0, 1.0)))


def _magnetic(field_n: Array) -> Array:
    return np.asarray(_to_magnetic(field_n) @ field_n)


def _advance(P: Array, at: Layout, C_bn: Array, dt_s: float, gyro_rad2ps: float) -> None:
    """Time passes: yaw error grows by the gyro's bias about the vertical, tilt error fades."""
    if dt_s <= 0.0:
        return
    F = np.eye(len(P))
    F[at.yaw, at.gyro] = C_bn[:, 2] * dt_s
    fade = math.exp(-dt_s / sent.TILT_TAU_S)
    F[at.tilt, at.tilt] = np.eye(2) * fade
    P[:] = F @ P @ F.T
    P[at.yaw, at.yaw] += gyro_rad2ps * dt_s
    P[at.tilt, at.tilt] += np.eye(2) * sent.TILT_SIGMA_RAD**2 * (1.0 - fade * fade)


def _iron_now(P: Array, at: Layout, t_s: float) -> Array:
    """Covariance of the iron at a time: at the start, and what has drifted in since."""
    J = np.zeros((3, at.size))
    J[:, at.iron] = np.eye(3)
    if at.drift.stop > at.drift.start:
        J[:, at.drift] = t_s * np.eye(3)
    return np.asarray(J @ P @ J.T)
