"""Ten seconds of one compass as sums of products: everything a fit of any length needs, in constant memory.

A sample is a row of features and the field it goes with. With g, p, q the earth's down, and the first and second level
axis of the gyro's own frame, all seen in body axes, and t the time from the middle of the block:

    z = D (v g + h cos(a + w t) p + h sin(a + w t) q) + b + k power

is linear in the products of the features (g, p, q, t p, t q, 1, ampere, throttle) with the unknowns, w t being small
within a block. So the sums of products tell every residual exactly, for any values of the unknowns (causes_fit).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from magmav.core.types import NO_SHAPING, Sample

Array = NDArray[np.float64]
Vector = tuple[float, float, float]

DOWN, FIRST, SECOND = slice(0, 3), slice(3, 6), slice(6, 9)
TOP = 15  # features that the matrix D stands before, three axes each
ONE, AMPERE, THROTTLE = 15, 16, 17
FEATURES = 18
WIDTH = FEATURES + 3

BLOCK_S = 10.0
BLOCKS = 30
_BATCH = 256  # samples that are put into the sums at once: more than a block of most compasses has
_JUMP_MG, _JUMP_SHARE = 60.0, 1.5  # a single value this far from its neighbour is none
_MOST_JUMPS = 3
_NOTICED_S = 3.0  # a sudden change is noticed no later


@dataclass(slots=True)
class Block:
    """Sums of products of [features, z] over up to BLOCK_S. z in mG, body axes; power in A and as a share.

    chained : the gyro carried the yaw here from the block before.
    """

    begin_s: float
    chained: bool
    era: int
    sums: Array = field(default_factory=lambda: np.zeros((WIDTH, WIDTH)))

    @property
    def n(self) -> float:
        """Number of samples."""
        return float(self.sums[ONE, ONE])

    @property
    def middle_s(self) -> float:
        """Boot time that t counts from."""
        return self.begin_s + 0.5 * BLOCK_S


def shaped(s: Sample) -> Vector:
    """z = A m + e, mG by body axis: the field as the autopilot shapes it, its offsets not applied."""
    z = s.mag_b_mg if s.shaping is NO_SHAPING else s.shaping.matrix @ s.mag_b_mg + s.shaping.motor_b_mg
    x, y, down = z.tolist()
    return x, y, down


def _products(raw: list[tuple[float, ...]]) -> Array:
    """Sums of products, (WIDTH, WIDTH), of samples as Blocks keeps them: time, attitude, rate, delay, power, z."""
    t, roll, pitch, yaw, p, q, r, delay, *rest = np.ascontiguousarray(np.array(raw).T)
    cr, sr, cp, sp, c, si = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch), np.cos(yaw), np.sin(yaw)
    down = (-sp, cp * sr, cp * cr)
    first = (cp * c, sp * sr * c - cr * si, sp * cr * c + sr * si)
    second = (cp * si, sp * sr * si + cr * c, sp * cr * si - sr * c)
    seen = np.array((down, first, second))
    if delay.any():  # the body turned on by w d since: a fixed direction was seen turned the other way
        x, y, z = seen[:, 0], seen[:, 1], seen[:, 2]
        seen = seen + delay * np.stack((q * z - r * y, r * x - p * z, p * y - q * x), axis=1)
    rows = np.vstack((seen.reshape(9, -1), (t * seen[1:]).reshape(6, -1), np.ones(len(t)), *rest))
    out: Array = rows @ rows.T
    return out


class Where(Enum):
    """What a block was measured in."""

    GROUND = "at rest before take-off"
    HANDS = "turned by hand before take-off"
    AIR = "teaching"


_GROUND, _HANDS, _AIR = Where


class Blocks:
    """The last BLOCKS blocks of what teaches, and the last whole one at rest on the ground before take-off.

    What was turned by hand teaches until it flies, and no longer: on the ground stands what does not fly along. Nor is
    it the ground's: the field there is compared at rest, and where it was put down again.
    """

    def __init__(self) -> None:
        self.teaching: deque[Block] = deque(maxlen=BLOCKS)
        self.by_hand = False  # all that teaches was turned by hand
        self.ground: Block | None = None
        self.closed = 0
        self._standing: list[Block] = []
        self._now: Block | None = None
        self._where = _AIR
        self._rows: list[tuple[float, ...]] = []
        self._yaw_rad = 0.0
        self._chained = False
        self._was: Vector | None = None
        self._jumps = 0
        self._dt_s = 0.0

    def step(
        self, s: Sample, z_b_mg: Vector, delay_s: float, power: tuple[float, float], era: int, grounded: bool
    ) -> None:
        """Take one sample and its field, see ``shaped``.

        power: ampere and throttle, 0 where unknown; era grows when the iron suddenly changed.
        """
        self._yaw_rad = math.remainder(self._yaw_rad + s.yaw_step_rad, math.tau)
        if s.gap:
            self._close()
            self._chained, self._was, self._dt_s = False, None, 0.0
        self._dt_s += max(s.dt_s, 0.0)
        where = _HANDS if s.by_hand else _GROUND if grounded else _AIR
        if not (s.learn or grounded) or (where is _HANDS and self.teaching and not self.by_hand):
            self._close()
            return
        if self._now is not None and self._where is not where:
            self._close()
        if self._jumped(z_b_mg, s):
            return
        boot_s = s.boot_ns / 1e9
        if self._now is not None and self._now.era != era:
            self._drop(boot_s)
        elif self._now is not None and boot_s - self._now.begin_s >= BLOCK_S:
            self._close()
        if self._now is None:
            self._begin(where)
            self._now, self._where = Block(boot_s, self._chained, era), where
            self._chained = True
        t, rate = boot_s - self._now.middle_s, s.rate_b_rads.tolist()
        self._rows.append((t, s.roll_rad, s.pitch_rad, self._yaw_rad, *rate, delay_s, *power, *z_b_mg))
        if len(self._rows) == _BATCH:
            self._flush()

    def _begin(self, where: Where) -> None:
        """Forget what another place has said."""
        if where is _HANDS:
            self._standing, self.ground, self.by_hand = [], None, True
        elif where is _AIR and self.by_hand:
            self.teaching.clear()
            self.by_hand, self.closed = False, 0

    def _jumped(self, z: Vector, s: Sample) -> bool:
        """A lone outlier: far from the value before, and not followed by others like it."""
        was, dt = self._was, self._dt_s
        far = was is not None and dt < 0.5 and (off := math.dist(z, was)) > _JUMP_MG
        if far:
            far = off > _JUMP_MG + _JUMP_SHARE * math.hypot(*z) * (math.hypot(*s.rate_b_rads.tolist()) * dt)
        if far and self._jumps < _MOST_JUMPS:
            self._jumps += 1
            return True
        self._was, self._jumps, self._dt_s = z, 0, 0.0
        return False

    def _flush(self) -> None:
        if self._now is not None and self._rows:
            self._now.sums += _products(self._rows)
        self._rows = []

    def _close(self) -> None:
        self._flush()
        block, self._now = self._now, None
        if block is None:
            return
        if self._where is _GROUND:
            # The last one before take-off may already be climbing; the one before it is the ground.
            self._standing = [*self._standing[-1:], block]
            self.ground = self._standing[0]
        elif block.n >= 10:
            self.teaching.append(block)
            self.closed += 1

    def _drop(self, boot_s: float) -> None:
        """The iron had changed some time before it was noticed: that time belongs to neither side."""
        self._rows, self._now = [], None
        if self.teaching and boot_s - self.teaching[-1].begin_s < BLOCK_S + _NOTICED_S:
            self.teaching.pop()

    def all(self) -> list[Block]:
        """Every block, the unfinished one too when it holds enough; asking changes no sum."""
        now = self._now
        if now is None or self._where is _GROUND:
            return [*self.teaching]
        if self._rows:
            now = replace(now, sums=now.sums + _products(self._rows))
        return [*self.teaching, now] if now.n >= 10 else [*self.teaching]
