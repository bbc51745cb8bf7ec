"""The fit behind the causes: how a compass is turned, scaled, driven by power and drifted past, all with sigmas.

Maximum a posteriori on the sums of causes_blocks. Unknowns: gain, soft iron (symmetric, traceless), mounting (a
rotation), hard iron, what power adds, the Earth's field h and v, the gyro's drift w, and per block the azimuth a of
magnetic north in the gyro's own frame. Priors keep what the motion did not show at nothing, and its sigma wide, so one
model serves every flight. The autopilot's yaw is not used.

The mounting is first looked for among the 24 right-angled ones, each by a linear fit, then turned by Gauss-Newton.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magmav.core.causes_blocks import AMPERE, DOWN, FEATURES, ONE, THROTTLE, TOP, Block
from magmav.core.causes_linear import FIELD_MG, IRON_MG, POWER_MG, Problem, linear, right_angles
from magmav.core.field import MODEL_SIGMA_MG, ExpectedField

Array = NDArray[np.float64]

_GAIN, _SOFT, _TURN = 0.5, 0.03, math.radians(60.0)
_DRIFT = math.radians(2.0)  # rad/s
_HOP = math.radians(4.0)  # what the gyro may lose from block to block beyond a constant drift: scale, walk
_TILT = math.radians(0.3)  # what the attitude's slow error leaves in the turn, however long the flight
_TILT_ERR = math.radians(0.5)  # of the attitude about each level axis; another one every block
_LEAST_MG = 3.0  # no fit is believed to be better than this
_STEPS, _DONE = 14, 0.01  # Gauss-Newton stops when no unknown moves by more of its sigma
_BETTER = 60.0  # by so much, in chi-squared, a right-angled mounting must beat none

GAIN, SOFT, TURN, IRON, POWER = 0, slice(1, 6), slice(6, 9), slice(9, 12), slice(12, 15)
LEVEL, DOWNWARD, DRIFT, STEP = 15, 16, 17, slice(18, 21)
TOLD, SHARED = 21, 30  # Fit tells of so many; then what tilting shows beyond, mG by component of g and sensor axis

_SOFT_BASIS = np.array(
    [
        np.diag([1.0, -1.0, 0.0]),
        np.diag([1.0, 1.0, -2.0]) / math.sqrt(3.0),
        [[0, 1, 0], [1, 0, 0], [0, 0, 0]],
        [[0, 0, 1], [0, 0, 0], [1, 0, 0]],
        [[0, 0, 0], [0, 0, 1], [0, 1, 0]],
    ]
)
_CROSS = np.array(
    [
        [[0, 0, 0], [0, 0, -1], [0, 1, 0]],
        [[0, 0, 1], [0, 0, 0], [-1, 0, 0]],
        [[0, -1, 0], [1, 0, 0], [0, 0, 0]],
    ]
)


def turn_by(vector_rad: Array) -> Array:
    """Rotation matrix of a rotation vector, (3, 3)."""
    angle = float(np.linalg.norm(vector_rad))
    if angle < 1e-12:
        return np.eye(3)
    k = np.einsum("i,ijk->jk", vector_rad / angle, _CROSS)
    out: Array = np.eye(3) + math.sin(angle) * k + (1.0 - math.cos(angle)) * (k @ k)
    return out


def turn_of(matrix: Array) -> Array:
    """Rotation vector of a rotation matrix, (3,) rad, at most pi long."""
    cosine = min(max((float(np.trace(matrix)) - 1.0) / 2.0, -1.0), 1.0)
    angle = math.acos(cosine)
    skew = np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]) / 2.0
    if angle < math.pi - 1e-3:
        out: Array = skew if angle < 1e-6 else skew * (angle / math.sin(angle))
        return out
    axis = np.linalg.eigh(matrix + matrix.T)[1][:, -1]
    return axis * angle * (1.0 if float(axis @ skew) >= 0.0 else -1.0)


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """What one stretch of flight says of a compass. Field in mG, angles in rad, body axes.

    turn : (3, 3) takes the field in true body axes to what the compass gives for it (before gain and soft iron).
    step_b_mg : what came to the hard iron from the given block on; 0 where none was given.
    covariance : (21, 21) of gain, soft iron (5), turn (3, small rotation), iron (3), power (3), h, v, drift, step (3).
    rms_mg : of the residual; plain_mg : the same with hard iron and power alone fitted.
    """

    gain: float
    soft: Array
    turn: Array
    iron_b_mg: Array
    power_b_mg: Array
    power_by: int  # AMPERE, THROTTLE, or 0 where neither is known
    power_span: float  # standard deviation of it
    level_mg: float
    down_mg: float
    drift_rads: float
    step_b_mg: Array
    azimuth_rad: Array
    covariance: Array
    rms_mg: float
    plain_mg: float
    samples: int

    def sigma(self, which: int) -> float:
        """One sigma of one of the shared unknowns."""
        return math.sqrt(max(float(self.covariance[which, which]), 0.0))


class _State:
    """Where Gauss-Newton stands."""

    def __init__(self, turn: Array, shared: Array, level: Array, gain: float, late: Array, down: Array) -> None:
        self.start, self.turn, self.late, self.down = turn, turn, late, down
        strength = np.hypot(level[:, 0], level[:, 1])
        self.shared = np.zeros(SHARED)
        self.shared[GAIN] = gain
        self.shared[IRON], self.shared[POWER], self.shared[STEP] = shared[1:4], shared[4:7], shared[7:10]
        self.shared[LEVEL], self.shared[DOWNWARD] = float(np.median(strength)) / gain, shared[0] / gain
        self.azimuth = np.unwrap(np.arctan2(level[:, 1], level[:, 0]))

    def moved(self, by: Array) -> _State:
        """A step away."""
        out = object.__new__(_State)
        out.start, out.late, out.down, out.turn = self.start, self.late, self.down, turn_by(by[TURN]) @ self.turn
        out.shared, out.azimuth = self.shared + by[:SHARED], self.azimuth + by[SHARED:]
        out.shared[TURN] = turn_of(out.turn @ out.start.T)
        return out

    def matrix(self) -> Array:
        """D, (3, 3)."""
        out: Array = self.shared[GAIN] * self.bend() @ self.turn
        return out

    def bend(self) -> Array:
        """I plus soft iron."""
        out: Array = np.eye(3) + np.einsum("i,ijk->jk", self.shared[SOFT], _SOFT_BASIS)
        return out

    def theta(self, power_by: int) -> Array:
        """(J, F, 3)."""
        j = len(self.azimuth)
        out = np.zeros((j, FEATURES, 3))
        out[:, :TOP] = np.einsum("jc,rs->jcsr", self.weights(), self.matrix()).reshape(j, TOP, 3)
        beyond = self.shared[TOLD:].reshape(3, 3)
        out[:, DOWN] += beyond
        out[:, ONE] = self.shared[IRON] + self.late[:, None] * self.shared[STEP] - self.down @ beyond
        if power_by:
            out[:, power_by] = self.shared[POWER]
        return out

    def weights(self) -> Array:
        """(J, 5): how much of g, p, q, t p, t q is in the field."""
        h, w = self.shared[LEVEL], self.shared[DRIFT]
        c, s = np.cos(self.azimuth), np.sin(self.azimuth)
        return np.stack([np.full(len(c), self.shared[DOWNWARD]), h * c, h * s, -h * w * s, h * w * c], axis=1)

    def derivatives(self, power_by: int) -> Array:
        """(J, SHARED + 1, F, 3); the last is by the block's own azimuth."""
        j, d = len(self.azimuth), self.matrix()
        out = np.zeros((j, SHARED + 1, FEATURES, 3))
        weights, h, w = self.weights(), self.shared[LEVEL], self.shared[DRIFT]
        c, s = np.cos(self.azimuth), np.sin(self.azimuth)
        zero = np.zeros(j)

        def top(weight: Array, matrix: Array) -> Array:
            made: Array = np.einsum("jc,rs->jcsr", weight, matrix).reshape(j, TOP, 3)
            return made

        gain = self.shared[GAIN]
        out[:, GAIN, :TOP] = top(weights, d / gain)
        for i in range(5):
            out[:, 1 + i, :TOP] = top(weights, gain * _SOFT_BASIS[i] @ self.turn)
        for i in range(3):
            out[:, 6 + i, :TOP] = top(weights, gain * self.bend() @ _CROSS[i] @ self.turn)
            out[:, 9 + i, ONE, i] = 1.0
            out[:, 18 + i, ONE, i] = self.late
            if power_by:
                out[:, 12 + i, power_by, i] = 1.0
        out[:, LEVEL, :TOP] = top(np.stack([zero, c, s, -w * s, w * c], axis=1), d)
        out[:, DOWNWARD, :TOP] = top(np.tile([1.0, 0, 0, 0, 0], (j, 1)), d)
        for i in range(9):
            out[:, TOLD + i, i // 3, i % 3] = 1.0
            out[:, TOLD + i, ONE, i % 3] = -self.down[i // 3]
        out[:, DRIFT, :TOP] = top(np.stack([zero, zero, zero, -h * s, h * c], axis=1), d)
        out[:, SHARED, :TOP] = top(np.stack([zero, -h * s, h * c, -h * w * c, -h * w * s], axis=1), d)
        return out


def _prior(p: Problem, state: _State) -> tuple[Array, Array]:
    """Information (P, P) and right side (P,) of what is known beforehand, P = SHARED + J."""
    j = p.blocks
    earth = p.expected
    middle, sigma = np.zeros(SHARED), np.ones(SHARED)
    middle[GAIN], sigma[GAIN], sigma[SOFT], sigma[TURN] = 1.0, _GAIN, _SOFT, _TURN
    sigma[IRON], sigma[POWER], sigma[DRIFT] = IRON_MG, POWER_MG.get(p.power_by, 1e-3), _DRIFT
    sigma[STEP] = IRON_MG if p.late.any() else 1e-3
    if earth is None:  # without a position nothing tells gain from field
        sigma[GAIN] = 1e-3
        middle[LEVEL], sigma[LEVEL], sigma[DOWNWARD] = 230.0, FIELD_MG, 2.0 * FIELD_MG
    else:
        middle[LEVEL], middle[DOWNWARD] = earth.horizontal_mg, earth.down_mg
        sigma[LEVEL] = sigma[DOWNWARD] = MODEL_SIGMA_MG
    information = np.zeros((SHARED + j, SHARED + j))
    side = np.zeros(SHARED + j)
    information[range(TOLD), range(TOLD)] = sigma[:TOLD] ** -2.0
    information[TOLD:SHARED, TOLD:SHARED] = _tilting(p, state)
    side[:SHARED] = information[:SHARED, :SHARED] @ (middle - state.shared)
    after = np.flatnonzero(p.chained[1:]) + 1
    dt = p.middle_s[after] - p.middle_s[after - 1]
    off = state.azimuth[after] - state.azimuth[after - 1] - state.shared[DRIFT] * dt
    off = (off - math.tau * np.rint(off / math.tau)) / _HOP**2
    here, before = SHARED + after, SHARED + after - 1
    information[DRIFT, DRIFT] += dt @ dt / _HOP**2
    side[DRIFT] += dt @ off
    for place, sign in ((before, 1.0), (here, -1.0)):  # no place comes twice
        information[place, place] += _HOP**-2.0
        information[DRIFT, place] += sign * dt / _HOP**2
        information[place, DRIFT] += sign * dt / _HOP**2
        side[place] += sign * off
    information[here, before] -= _HOP**-2.0
    information[before, here] -= _HOP**-2.0
    return information, side


def _tilting(p: Problem, state: _State) -> Array:
    """Information (9, 9) on what tilting seems to show beyond the field's own change.

    Where the attitude errs by e, the field's response to tilts of variance m comes out wrong by the share e^2 / m, as
    slopes over a noisy abscissa do (Fuller 1987, section 1.1), and at random by e / sqrt(m n) for n errors in turn.
    """
    variance, axes = np.linalg.eigh(p.tilts)
    share = _TILT_ERR**2 / np.maximum(variance, 0.1 * _TILT_ERR**2)
    field = state.shared[GAIN] * math.hypot(state.shared[LEVEL], state.shared[DOWNWARD])
    sigma = field * np.sqrt(np.minimum(share**2 + share / p.blocks, 4.0))
    return np.kron((axes * sigma**-2.0) @ axes.T, np.eye(3))


def _turn_about_down(p: Problem) -> float:
    """Variance, rad^2, of a turn about the down axis: only tilting shows it, and tilts err."""
    shown = max(0.5 * float(np.trace(p.tilts)) - _TILT_ERR**2, 0.05 * _TILT_ERR**2)
    return _TILT_ERR**2 / (shown * p.blocks)


def fit(blocks: Sequence[Block], expected: ExpectedField | None, step_at: int | None = None) -> Fit:
    """The best account of these blocks (at least one).

    expected : None without a position; then gain is taken as 1. step_at : from this block on there may be other iron.
    """
    p = Problem(blocks, expected, step_at)
    candidates = right_angles()
    variance = 36.0 * max(0.1 * p.n / p.blocks, 1.0)
    held = linear(p, np.array(candidates), variance)
    plain, which = float(held.misfit[0]), int(np.argmin(held.misfit))
    best = float(held.misfit[which])
    floor = max(best / (3.0 * p.n), _LEAST_MG**2) * max(0.1 * p.n / p.blocks, 1.0)
    if (plain - best) / floor < _BETTER:
        which = 0
    turn, shared, level = candidates[which], held.shared[which], held.level_mg[which]
    gain = 1.0
    if expected is not None:
        strength = float(np.median(np.hypot(level[:, 0], level[:, 1])))
        gain = min(max(strength / max(expected.horizontal_mg, 50.0), 0.4), 2.0)
    state = _State(turn, shared, level, gain, p.late, p.down)
    theta = state.theta(p.power_by)
    for _ in range(_STEPS):
        variance = max(p.misfit(theta) / (3.0 * p.n), _LEAST_MG**2)
        worth = variance * p.inflation(theta, variance)
        matrix, right = p.normal(state.derivatives(p.power_by), theta)
        information, side = _prior(p, state)
        information[:SHARED, :SHARED] += matrix[:, :SHARED, :SHARED].sum(axis=0) / worth
        side[:SHARED] += right[:, :SHARED].sum(axis=0) / worth
        information[:SHARED, SHARED:] += matrix[:, :SHARED, SHARED].T / worth
        information[SHARED:, :SHARED] += matrix[:, SHARED, :SHARED] / worth
        np.einsum("ii->i", information)[SHARED:] += matrix[:, SHARED, SHARED] / worth
        side[SHARED:] += right[:, SHARED] / worth
        covariance: Array = np.linalg.inv(information).astype(np.float64)
        step = covariance @ side
        step *= min(1.0, 0.5 / max(float(np.abs(step[TURN]).max()), float(np.abs(step[SHARED:]).max()), 1e-9))
        state = state.moved(step)
        theta = state.theta(p.power_by)
        if float(np.abs(step / np.sqrt(np.diag(covariance))).max()) < _DONE:
            break
    x = state.shared
    upright = state.turn @ (p.down / np.linalg.norm(p.down))
    covariance[TURN, TURN] += np.eye(3) * _TILT**2 + _turn_about_down(p) * np.outer(upright, upright)
    return Fit(
        gain=float(x[GAIN]),
        soft=state.bend() - np.eye(3),
        turn=state.turn,
        iron_b_mg=x[IRON],
        power_b_mg=x[POWER],
        power_by=p.power_by,
        power_span=p.span,
        level_mg=float(x[LEVEL]),
        down_mg=float(x[DOWNWARD]),
        drift_rads=float(x[DRIFT]),
        step_b_mg=x[STEP],
        azimuth_rad=state.azimuth,
        covariance=covariance[:TOLD, :TOLD],
        rms_mg=math.sqrt(max(p.misfit(theta), 0.0) / (3.0 * p.n)),
        plain_mg=math.sqrt(max(plain, 0.0) / (3.0 * p.n)),
        samples=round(p.n),
    )


def power_name(power_by: int) -> str:
    """What the power's field is counted by."""
    return {AMPERE: "ampere", THROTTLE: "full throttle"}.get(power_by, "")
