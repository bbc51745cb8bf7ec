"""The fit behind the causes: how a compass is turned, scaled, driven by power and drifted past, all with sigmas.

Maximum a posteriori on the sums of causes_blocks. Unknowns: gain, soft iron (symmetric, traceless), mounting (a
rotation), hard iron, what power adds, the Earth's field h and v, the gyro's drift w, and per block the azimuth a of
magnetic north in the gyro's own frame. Priors keep what the motion did not show at nothing, and its sigma wide, so one
model serves every flight. The autopilot's yaw is not used.

The mounting is first looked for among the 24 right-angled ones, each by a linear fit, then turned by Gauss-Newton.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magmav.core.causes_blocks import AMPERE, DOWN, FEATURES, ONE, THROTTLE, TOP, Block
from magmav.core.field import MODEL_SIGMA_MG, ExpectedField

Array = NDArray[np.float64]

_IRON_MG, _FIELD_MG = 1000.0, 300.0
_GAIN, _SOFT, _TURN = 0.5, 0.03, math.radians(60.0)
_POWER = {AMPERE: 10.0, THROTTLE: 200.0}  # mG per ampere, and per full throttle
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


def right_angles() -> list[Array]:
    """The 24 rotations that take axes to axes, the identity first."""
    out = [
        np.array([[signs[i] if j == order[i] else 0.0 for j in range(3)] for i in range(3)])
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1.0, -1.0), repeat=3)
    ]
    proper = [m for m in out if np.linalg.det(m) > 0.0]
    return sorted(proper, key=lambda m: -float(np.trace(m)))


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


class _Problem:
    """The blocks of one fit, stacked: sums (J, F, F), products with z (J, F, 3)."""

    def __init__(self, blocks: Sequence[Block], expected: ExpectedField | None, step_at: int | None) -> None:
        self.late = np.array([float(step_at is not None and i >= step_at) for i in range(len(blocks))])
        sums = np.array([b.sums for b in blocks])
        self.x, self.y = sums[:, :FEATURES, :FEATURES], sums[:, :FEATURES, FEATURES:]
        self.square = float(np.einsum("jrr->", sums[:, FEATURES:, FEATURES:]))
        self.n = float(self.x[:, ONE, ONE].sum())
        self.middle_s = np.array([b.middle_s for b in blocks])
        self.chained = np.array([b.chained for b in blocks])
        self.expected = expected
        self.power_by, self.span = self._power()
        self.blocks = len(blocks)
        x = self.x.sum(axis=0) / self.n
        self.down = x[ONE, DOWN]
        self.tilts = x[DOWN, DOWN] - np.outer(self.down, self.down)

    def _power(self) -> tuple[int, float]:
        """What drives the motor term: the battery's ampere where they are known and change, else the throttle."""
        for column, least in ((AMPERE, 0.3), (THROTTLE, 0.02)):
            mean = self.x[:, ONE, column].sum() / self.n
            spread = math.sqrt(max(self.x[:, column, column].sum() / self.n - mean * mean, 0.0))
            if spread > least:
                return column, spread
        return 0, 0.0

    def misfit(self, theta: Array) -> float:
        """Sum of squared residuals, mG^2; theta (J, F, 3)."""
        return self.square - float(theta.ravel() @ (2.0 * self.y - self.x @ theta).ravel())

    def normal(self, by: Array, theta: Array) -> tuple[Array, Array]:
        """Normal matrices (J, P, P) and right sides (J, P), from derivatives by (J, P, F, 3)."""
        j, p, f, axes = by.shape
        through = (self.x @ by.transpose(0, 2, 1, 3).reshape(j, f, p * axes)).reshape(j, f, p, axes)
        flat, left = by.reshape(j, p, f * axes), self.y - self.x @ theta
        matrix = flat @ through.transpose(0, 1, 3, 2).reshape(j, f * axes, p)
        return matrix, (flat @ left.reshape(j, f * axes, 1))[:, :, 0]

    def inflation(self, theta: Array, variance: float) -> float:
        """How many samples are worth one: residuals that go one way through a block are no separate news."""
        left = (self.y - self.x @ theta)[:, [ONE, 0, 1, 3, 4, 6, 7]]
        power = np.maximum(np.einsum("jff->jf", self.x)[:, [ONE, 0, 1, 3, 4, 6, 7]], 1e-9)
        each = (left**2).sum(axis=2) / power / 3.0
        weight = power / power.sum()
        per_block = self.n / self.blocks
        return float(min(max((each * weight).sum() / variance, 0.1 * per_block, 1.0), per_block))


def _linear(p: _Problem, turn: Array, variance: float) -> tuple[float, Array, Array]:
    """The mounting held: v, b, k, step shared and the level field of every block, all linear.

    Misfit in mG^2, the shared unknowns (10,), the level fields (J, 2).
    """
    j = p.blocks
    by = np.zeros((j, 12, FEATURES, 3))
    by[:, 0, 0:3] = by[:, 10, 3:6] = by[:, 11, 6:9] = turn.T
    for axis in range(3):
        by[:, 1 + axis, ONE, axis] = 1.0
        by[:, 7 + axis, ONE, axis] = p.late
        if p.power_by:
            by[:, 4 + axis, p.power_by, axis] = 1.0
    matrix, right = p.normal(by, np.zeros((j, FEATURES, 3)))
    size = 10 + 2 * j
    whole, side = np.zeros((size, size)), np.zeros(size)
    whole[:10, :10], side[:10] = matrix[:, :10, :10].sum(axis=0), right[:, :10].sum(axis=0)
    whole[:10, 10:] = matrix[:, :10, 10:].transpose(1, 0, 2).reshape(10, 2 * j)
    whole[10:, :10], side[10:] = whole[:10, 10:].T, right[:, 10:].ravel()
    level = np.zeros((j, 2, j, 2))
    np.einsum("iaib->iab", level)[:] = matrix[:, 10:, 10:]
    whole[10:, 10:] = level.reshape(2 * j, 2 * j)
    v, v_sigma = (0.0, _FIELD_MG * 2.0) if p.expected is None else (p.expected.down_mg, 0.3 * p.expected.total_mg)
    k_sigma = _POWER.get(p.power_by, 1.0)
    sigmas = [v_sigma, *[_IRON_MG] * 3, *[k_sigma] * 3, *[_IRON_MG] * 3, *[_FIELD_MG] * (2 * j)]
    weights = np.array(sigmas) ** -2.0
    prior = np.zeros(size)
    prior[0] = v
    answer = np.linalg.solve(whole / variance + np.diag(weights), side / variance + weights * prior)
    fields = np.array(answer[10:], dtype=np.float64).reshape(j, 2)
    return p.square - float(answer @ (2.0 * side - whole @ answer)), np.array(answer[:10], dtype=np.float64), fields


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


def _prior(p: _Problem, state: _State) -> tuple[Array, Array]:
    """Information (P, P) and right side (P,) of what is known beforehand, P = SHARED + J."""
    j = p.blocks
    here = p.expected
    middle, sigma = np.zeros(SHARED), np.ones(SHARED)
    middle[GAIN], sigma[GAIN], sigma[SOFT], sigma[TURN] = 1.0, _GAIN, _SOFT, _TURN
    sigma[IRON], sigma[POWER], sigma[DRIFT] = _IRON_MG, _POWER.get(p.power_by, 1e-3), _DRIFT
    sigma[STEP] = _IRON_MG if p.late.any() else 1e-3
    if here is None:  # without a position nothing tells gain from field
        sigma[GAIN] = 1e-3
        middle[LEVEL], sigma[LEVEL], sigma[DOWNWARD] = 230.0, _FIELD_MG, 2.0 * _FIELD_MG
    else:
        middle[LEVEL], middle[DOWNWARD] = here.horizontal_mg, here.down_mg
        sigma[LEVEL] = sigma[DOWNWARD] = MODEL_SIGMA_MG
    information = np.zeros((SHARED + j, SHARED + j))
    side = np.zeros(SHARED + j)
    information[range(TOLD), range(TOLD)] = sigma[:TOLD] ** -2.0
    information[TOLD:SHARED, TOLD:SHARED] = _tilting(p, state)
    side[:SHARED] = information[:SHARED, :SHARED] @ (middle - state.shared)
    for i in range(1, j):
        if not p.chained[i]:
            continue
        dt = p.middle_s[i] - p.middle_s[i - 1]
        row = np.zeros(SHARED + j)
        row[DRIFT], row[SHARED + i - 1], row[SHARED + i] = dt, 1.0, -1.0
        off = math.remainder(state.azimuth[i] - state.azimuth[i - 1] - state.shared[DRIFT] * dt, math.tau)
        information += np.outer(row, row) / _HOP**2
        side += row * off / _HOP**2
    return information, side


def _tilting(p: _Problem, state: _State) -> Array:
    """Information (9, 9) on what tilting seems to show beyond the field's own change.

    Where the attitude errs by e, the field's response to tilts of variance m comes out wrong by the share e^2 / m, as
    slopes over a noisy abscissa do (Fuller 1987, section 1.1), and at random by e / sqrt(m n) for n errors in turn.
    """
    variance, axes = np.linalg.eigh(p.tilts)
    share = _TILT_ERR**2 / np.maximum(variance, 0.1 * _TILT_ERR**2)
    field = state.shared[GAIN] * math.hypot(state.shared[LEVEL], state.shared[DOWNWARD])
    sigma = field * np.sqrt(np.minimum(share**2 + share / p.blocks, 4.0))
    return np.kron((axes * sigma**-2.0) @ axes.T, np.eye(3))


def _turn_about_down(p: _Problem) -> float:
    """Variance, rad^2, of a turn about the down axis: only tilting shows it, and tilts err."""
    shown = max(0.5 * float(np.trace(p.tilts)) - _TILT_ERR**2, 0.05 * _TILT_ERR**2)
    return _TILT_ERR**2 / (shown * p.blocks)


def fit(blocks: Sequence[Block], expected: ExpectedField | None, step_at: int | None = None) -> Fit:
    """The best account of these blocks (at least one).

    expected : None without a position; then gain is taken as 1. step_at : from this block on there may be other iron.
    """
    p = _Problem(blocks, expected, step_at)
    candidates = right_angles()
    variance = 36.0 * max(0.1 * p.n / p.blocks, 1.0)
    tried = [(_linear(p, turn, variance), turn) for turn in candidates]
    plain = tried[0][0][0]
    (best, shared, level), turn = min(tried, key=lambda t: t[0][0])
    floor = max(best / (3.0 * p.n), _LEAST_MG**2) * max(0.1 * p.n / p.blocks, 1.0)
    if (plain - best) / floor < _BETTER:
        (best, shared, level), turn = tried[0]
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
