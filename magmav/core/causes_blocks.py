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
from dataclasses import dataclass, field
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
_BATCH = 32
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


def field_of_sample(s: Sample) -> Array:
    """z = A m + e, (3,) mG: the field as the autopilot shapes it, its offsets not applied."""
    if s.shaping is NO_SHAPING:
        return s.mag_b_mg
    out: Array = s.shaping.matrix @ s.mag_b_mg + s.shaping.motor_b_mg
    return out


def _turned(v: Vector, rate_rads: list[float], dt_s: float) -> Vector:
    """v + rate dt x v."""
    (x, y, z), (p, q, r) = v, rate_rads
    return x + dt_s * (q * z - r * y), y + dt_s * (r * x - p * z), z + dt_s * (p * y - q * x)


class Where(Enum):
    """What a block was measured in."""

    GROUND = "at rest before take-off"
    HANDS = "turned by hand before take-off"
    AIR = "teaching"


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
        self._where = Where.AIR
        self._rows: list[tuple[float, ...]] = []
        self._yaw_rad = 0.0
        self._chained = False
        self._was: Vector | None = None
        self._jumps = 0
        self._dt_s = 0.0

    def step(self, s: Sample, delay_s: float, power: tuple[float, float], era: int, grounded: bool) -> None:
        """Take one sample. power: ampere and throttle, 0 where unknown; era grows when the iron suddenly changed."""
        self._yaw_rad = math.remainder(self._yaw_rad + s.yaw_step_rad, math.tau)
        if s.gap:
            self._close()
            self._chained, self._was, self._dt_s = False, None, 0.0
        self._dt_s += max(s.dt_s, 0.0)
        where = Where.HANDS if s.by_hand else Where.GROUND if grounded else Where.AIR
        flown = bool(self.teaching) and not self.by_hand
        if not (s.learn or grounded) or (where is Where.HANDS and flown):
            self._close()
            return
        if self._now is not None and self._where is not where:
            self._close()
        x, y, w = field_of_sample(s).tolist()
        z = (x, y, w)
        if self._jumped(z, s):
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
        self._row(self._now, s, z, delay_s, power, boot_s)

    def _begin(self, where: Where) -> None:
        """Forget what another place has said."""
        if where is Where.HANDS:
            self._standing, self.ground, self.by_hand = [], None, True
        elif where is Where.AIR and self.by_hand:
            self.teaching.clear()
            self.by_hand, self.closed = False, 0

    def _jumped(self, z: Vector, s: Sample) -> bool:
        """A lone outlier: far from the value before, and not followed by others like it."""
        was, dt = self._was, self._dt_s
        far = (
            was is not None
            and dt < 0.5
            and math.dist(z, was) > _JUMP_MG + _JUMP_SHARE * math.hypot(*z) * (math.hypot(*s.rate_b_rads.tolist()) * dt)
        )
        if far and self._jumps < _MOST_JUMPS:
            self._jumps += 1
            return True
        self._was, self._jumps, self._dt_s = z, 0, 0.0
        return False

    def _row(
        self, block: Block, s: Sample, z: Vector, delay_s: float, power: tuple[float, float], boot_s: float
    ) -> None:
        cr, sr, cp, sp = math.cos(s.roll_rad), math.sin(s.roll_rad), math.cos(s.pitch_rad), math.sin(s.pitch_rad)
        c, si = math.cos(self._yaw_rad), math.sin(self._yaw_rad)
        down = (-sp, cp * sr, cp * cr)
        first = (cp * c, sp * sr * c - cr * si, sp * cr * c + sr * si)
        second = (cp * si, sp * sr * si + cr * c, sp * cr * si - sr * c)
        if delay_s:  # the body turned on by w d since: a fixed direction was seen turned the other way
            turn = s.rate_b_rads.tolist()
            down, first, second = (_turned(v, turn, delay_s) for v in (down, first, second))
        level, t = (*first, *second), boot_s - block.middle_s
        self._rows.append((*down, *level, *[t * v for v in level], 1.0, *power, *z))
        if len(self._rows) == _BATCH:
            self._flush()

    def _flush(self) -> None:
        if self._now is not None and self._rows:
            rows = np.array(self._rows)
            self._now.sums += rows.T @ rows
        self._rows = []

    def _close(self) -> None:
        self._flush()
        block, self._now = self._now, None
        if block is None:
            return
        if self._where is Where.GROUND:
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
        """Every block, the unfinished one too when it holds enough."""
        self._flush()
        now = self._now
        more = [now] if now is not None and self._where is not Where.GROUND and now.n >= 10 else []
        return [*self.teaching, *more]
