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

import numpy as np
from numpy.typing import NDArray

from magmav.core.rotation import level_from_body
from magmav.core.types import Sample

Array = NDArray[np.float64]

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
    out: Array = s.shaping.matrix @ s.mag_b_mg + s.shaping.motor_b_mg
    return out


class Blocks:
    """The last BLOCKS blocks of what teaches, and the last whole one on the ground before take-off."""

    def __init__(self) -> None:
        self.air: deque[Block] = deque(maxlen=BLOCKS)
        self.ground: Block | None = None
        self.closed = 0
        self._standing: list[Block] = []
        self._now: Block | None = None
        self._standing_now = False
        self._rows = np.zeros((_BATCH, WIDTH))
        self._filled = 0
        self._yaw_rad = 0.0
        self._chained = False
        self._was: Array | None = None
        self._jumps = 0
        self._dt_s = 0.0

    def step(self, s: Sample, delay_s: float, power: tuple[float, float], era: int, grounded: bool) -> None:
        """Take one sample. power: ampere and throttle, 0 where unknown; era grows when the iron suddenly changed."""
        self._yaw_rad = math.remainder(self._yaw_rad + s.yaw_step_rad, math.tau)
        if s.gap:
            self._close()
            self._chained, self._was, self._dt_s = False, None, 0.0
        self._dt_s += max(s.dt_s, 0.0)
        if not (s.learn or grounded):
            self._close()
            return
        if self._now is not None and self._standing_now is not grounded:
            self._close()
        z = field_of_sample(s)
        if self._jumped(z, s):
            return
        boot_s = s.boot_ns / 1e9
        if self._now is not None and self._now.era != era:
            self._drop(boot_s)
        elif self._now is not None and boot_s - self._now.begin_s >= BLOCK_S:
            self._close()
        if self._now is None:
            self._now, self._standing_now = Block(boot_s, self._chained, era), grounded
            self._chained = True
        self._row(self._now, s, z, delay_s, power, boot_s)

    def _jumped(self, z: Array, s: Sample) -> bool:
        """A lone outlier: far from the value before, and not followed by others like it."""
        was, dt = self._was, self._dt_s
        far = (
            was is not None
            and dt < 0.5
            and math.dist(z, was) > _JUMP_MG + _JUMP_SHARE * math.hypot(*z) * (math.hypot(*s.rate_b_rads) * dt)
        )
        if far and self._jumps < _MOST_JUMPS:
            self._jumps += 1
            return True
        self._was, self._jumps, self._dt_s = z, 0, 0.0
        return False

    def _row(
        self, block: Block, s: Sample, z: Array, delay_s: float, power: tuple[float, float], boot_s: float
    ) -> None:
        level = level_from_body(s.roll_rad, s.pitch_rad)
        c, si = math.cos(self._yaw_rad), math.sin(self._yaw_rad)
        first, second, down = level[0] * c - level[1] * si, level[0] * si + level[1] * c, level[2]
        row = self._rows[self._filled]
        row[DOWN], row[FIRST], row[SECOND] = down, first, second
        if delay_s:  # the body turned on by w d since: a fixed direction was seen turned the other way
            wx, wy, wz = (s.rate_b_rads * delay_s).tolist()
            turned = np.array(((0.0, -wz, wy), (wz, 0.0, -wx), (-wy, wx, 0.0)))
            row[:9] += (turned @ row[:9].reshape(3, 3).T).T.ravel()
        row[9:15] = (boot_s - block.middle_s) * row[3:9]
        row[ONE], row[AMPERE], row[THROTTLE] = 1.0, power[0], power[1]
        row[FEATURES:] = z
        self._filled += 1
        if self._filled == _BATCH:
            self._flush()

    def _flush(self) -> None:
        if self._now is not None and self._filled:
            rows = self._rows[: self._filled]
            self._now.sums += rows.T @ rows
        self._filled = 0

    def _close(self) -> None:
        self._flush()
        block, self._now = self._now, None
        if block is None:
            return
        if self._standing_now:
            # The last one before take-off may already be climbing; the one before it is the ground.
            self._standing = [*self._standing[-1:], block]
            self.ground = self._standing[0]
        elif block.n >= 10:
            self.air.append(block)
            self.closed += 1

    def _drop(self, boot_s: float) -> None:
        """The iron had changed some time before it was noticed: that time belongs to neither side."""
        self._filled, self._now = 0, None
        if self.air and boot_s - self.air[-1].begin_s < BLOCK_S + _NOTICED_S:
            self.air.pop()

    def all(self) -> list[Block]:
        """Every block, the unfinished one too when it holds enough."""
        self._flush()
        now = self._now
        more = [now] if now is not None and not self._standing_now and now.n >= 10 else []
        return [*self.air, *more]
