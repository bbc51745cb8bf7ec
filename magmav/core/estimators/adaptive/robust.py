"""What keeps single readings from deceiving the bank: a gate for wild ones, doubt for strange ones, noise as it shows.

White noise shows as scatter inside a block; what all readings of a block share shows in its mean; what neighbouring
blocks share shows as likeness of their means.
"""

from __future__ import annotations

import math
from collections import deque
from operator import mul

import numpy as np

from magmav.core.estimators.adaptive.bank import Bank
from magmav.core.estimators.adaptive.layout import Array
from magmav.core.estimators.adaptive.tuning import Tuning
from magmav.core.rotation import rotation

WILD_MG, WILD_MG_PER_RAD = 50.0, 330.0
WILD_OF = 5
_TILTS, _TILTS_LEAST = 3000, 100  # readings remembered, and wanted before anything is made of them
STILL_RADS, _STILL_MG = 0.02, 4.0  # slower than the bias of a bad gyro, and less change than noise leaves
STILL_MEAN_S, STILL_S = 1.0, 3.0
MEDIAN_TO_VARIANCE = 2.2  # variance of a normal value over the squared median of its size


class WildGate:
    """Is a reading far from the middle of the last five, more than turning explains? (estimation.md section 5)"""

    def __init__(self) -> None:
        self._last: deque[tuple[float, float, float]] = deque(maxlen=WILD_OF)
        self._turns: deque[float] = deque(maxlen=WILD_OF)

    def step(self, z: Array, turn_rad: float) -> bool:
        """Take a reading (3,) and how far the vehicle turned since the one before."""
        x, y, w = z.tolist()
        self._last.append((x, y, w))
        self._turns.append(turn_rad)
        if len(self._last) < 3:
            return False
        middle = [sorted(axis)[len(self._last) // 2] for axis in zip(*self._last, strict=True)]
        off: float = max(abs(x - middle[0]), abs(y - middle[1]), abs(w - middle[2]))
        return bool(off > WILD_MG + WILD_MG_PER_RAD * sum(self._turns))


class Stillness:
    """Does the vehicle stand still? The same reading again and again says nothing new.

    Taken in as if it did, a linear filter finds information in the changes of its own Jacobian: a minute on a table
    talked the bank into a level field of nothing.
    """

    def __init__(self) -> None:
        self._anchor: tuple[float, float, float] | None = None
        self._mean = (0.0, 0.0, 0.0)
        self._rate2 = 0.0
        self._still_s = 2.0 * STILL_S  # until it is seen to move

    def step(self, z: Array, rate_rads: float, dt_s: float) -> bool:
        """Take a reading (3,), how fast it turns, and the time since the one before."""
        weight = 1.0 - math.exp(-dt_s / STILL_MEAN_S)
        self._rate2 += weight * (rate_rads * rate_rads - self._rate2)
        x, y, w = z.tolist()
        a, b, c = self._mean
        if self._anchor is None:
            self._anchor = a, b, c = x, y, w
        self._mean = a, b, c = a + weight * (x - a), b + weight * (y - b), c + weight * (w - c)
        far = max(abs(a - self._anchor[0]), abs(b - self._anchor[1]), abs(c - self._anchor[2]))
        if far > _STILL_MG or self._rate2 > STILL_RADS**2 or dt_s > 1.0:
            self._anchor, self._still_s = self._mean, 0.0
        self._still_s += dt_s
        return self._still_s > STILL_S


class Tilting:
    """How much the vehicle tilts this way and that, against its own mean.

    A noisy regressor makes a regression see too little of what it multiplies, and too sure of it: a level rover with
    0.3 degrees of noise in its attitude "proves" a down axis that is hundreds of mG wrong.
    """

    def __init__(self) -> None:
        self._n = 0
        self._x = self._y = self._square = 0.0

    def calmed(self, body_from_own: Array, least_rad: float) -> tuple[Array, float]:
        """The attitude with the tilt at its mean where it may be nothing but noise, and by how much it was off, rad."""
        if self.rms_rad >= least_rad or self._n < _TILTS_LEAST:
            return body_from_own, 0.0
        x, y, z = body_from_own[:, 2].tolist()
        # A small turn of the body takes down to its mean, if that is near at all.
        wx, wy = (y - self._y) * math.copysign(1.0, z), (self._x - x) * math.copysign(1.0, z)
        off = math.hypot(wx, wy)
        if off > 3.0 * least_rad:
            return body_from_own, 0.0
        return rotation(np.array((wx, wy, 0.0))) @ body_from_own, off

    def step(self, down_b: Array) -> None:
        """Take where down is, (3,)."""
        x, y, _ = down_b.tolist()
        self._n = min(self._n + 1, _TILTS)
        self._x += (x - self._x) / self._n
        self._y += (y - self._y) / self._n
        self._square += ((x - self._x) ** 2 + (y - self._y) ** 2 - self._square) / self._n

    @property
    def rms_rad(self) -> float:
        """Per axis."""
        return math.sqrt(0.5 * self._square)


def between(values: Array, low: float, high: float) -> Array:
    """numpy's clip, in a third of its time for small arrays."""
    return np.minimum(np.maximum(values, low), high)


def squares(expected: Array, nu: Array) -> Array:
    """Of innovations (..., n, k), normalised by what is expected of each, (..., n, k, k): (..., n)."""
    return np.asarray((nu * np.linalg.solve(expected, nu[..., None])[..., 0]).sum(-1))


def doubted(expected: Array, nu: Array, least_mg2: Array, doubt_nis: float) -> Array | None:
    """Make what is expected of a strange reading as wide as it is strange, in place (Huber's weights).

    expected (K, n, k, k) : each reading's own part of the innovation's covariance, in no direction less than least_mg2
    (K,).  nu (K, n, k).  Their normalised squares before that, (K, n), or None where that alone says that none is.
    """
    if not ((nu * nu).sum(2).max(1) > doubt_nis * least_mg2).any():
        return None
    nis = squares(expected, nu)
    if nis.max() > doubt_nis:
        expected *= np.maximum(nis / doubt_nis, 1.0)[..., None, None]
    return nis


def adapt(bank: Bank, inside: Array, mean_white: Array, mean_share: Array, dt_s: float, n: Tuning) -> None:
    """Noise as it shows.

    inside (K, n, k) : innovations less their mean over the block.  mean_white (K, k) : that mean, whitened, clipped.
    mean_share (K, k) : how much of that mean's variance is the block's own noise.
    """
    weight, (size, k) = min(dt_s / 5.0, 0.2), inside.shape[1:]
    bank.seen_s += dt_s
    rate = min(dt_s / min(max(0.5 * bank.seen_s, n.adapt_first_s), n.adapt_s), 0.3)
    if size > 2:
        apart = np.abs(inside).reshape(len(inside), -1)
        apart.sort(axis=1)
        middle = 0.5 * (apart[:, size * k // 2] + apart[:, (size * k - 1) // 2])
        scatter = middle * middle * (MEDIAN_TO_VARIANCE * size / (size - 1))
        bank.white_mg2 += rate * (between(scatter, n.white_lo_mg**2, n.white_hi_mg**2) - bank.white_mg2)
    # The rest one hypothesis after the other: to numpy three numbers cost as much as three hundred.
    own = (mean_white, bank.last, mean_share, bank.square, bank.product, bank.common_mg2, bank.disturbance_mg)
    out = []
    for white, last, share, square, product, common, disturbance in zip(*(v.tolist() for v in own), strict=True):
        squares = [v * v for v in white]
        square += weight * (sum(squares) / k - square)
        product += weight * (sum(map(mul, white, last)) / k - product)
        push = (sum(map(mul, share, squares)) - sum(share)) / k
        common *= math.exp(rate * within(push, -1.0, 2.0))
        like = within(product / max(square, 0.1), -1.0, 1.0)
        disturbance *= math.exp(rate * within(4.0 * (like - 0.1), -1.0, 2.0))
        common = within(common, n.common_lo_mg**2, n.common_hi_mg**2)
        out.append((square, product, common, within(disturbance, n.disturbance_lo_mg, n.disturbance_hi_mg)))
    bank.square, bank.product, bank.common_mg2, bank.disturbance_mg = map(np.array, zip(*out, strict=True))
    bank.last[:, :k] = mean_white


def within(value: float, low: float, high: float) -> float:
    """``between`` for one number."""
    return min(max(value, low), high)
