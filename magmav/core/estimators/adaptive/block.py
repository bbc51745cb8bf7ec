"""A few samples in a row, taken in together: one update of every hypothesis costs as much for five as for one.

Times inside a block count from its end, where the state stands: a sample's heading is alpha less what the gyro's bias
turned since.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magmav.core.estimators.adaptive.layout import SIZE, Array, B, D, K
from magmav.core.types import Sample, Shaping

_EYE3 = np.eye(3)
_REST_RAD = 0.02  # what stood still may have turned: the field would hardly show less


@dataclass(frozen=True, slots=True, eq=False)
class Readings:
    """n samples in arrays; body axes, mG, s, rad. Or n samples of each of many blocks: one more axis in front of all.

    z (n, 3) : A m + e.  body_from_own (n, 3, 3).  rate_rads2 (n,) : square of the turn rate.
    turns_b (n, 3, 6) : about what each of the states layout.TURNS turns the field.
    calmed_rad (n,) : tilt taken out of the attitude, where it may be noise.
    same (n, 3, SIZE) : the part of the Jacobian that depends on no state: iron, disturbance and throttle.
    ahead_s (n, 3) : integral of down_b from the sample to the block's end.
    """

    z: Array
    body_from_own: Array
    rate_rads2: Array
    turns_b: Array
    calmed_rad: Array
    same: Array
    ahead_s: Array


@dataclass(frozen=True, slots=True, eq=False)
class Block(Readings):
    """n samples taken in together, and the time since the block before.

    own_tilt_rad : sigma of the tilt where it is that of gyro and accelerometer alone, None where it is the autopilot's.
    dt_s, down_s (3,), turn_rad2 : time, integral of down_b and variance of the turn since the block before.
    turned_rad : what the own frame turned about its down while the vehicle stood still.
    """

    dt_s: float
    down_s: Array
    turn_rad2: float
    turned_rad: float
    shaping: Shaping
    axes: int
    own_tilt_rad: float | None

    def __len__(self) -> int:
        return len(self.z)


def fixed_parts(bodies: Array, rates: Array, matrix: Array, drives: Array) -> tuple[Array, Array]:
    """Readings.turns_b and Readings.same.

    bodies (..., 3, 3), rates (..., 3), drives (...) : throttle less a half.  matrix (3, 3), or (..., 3, 3).
    """
    turns = np.zeros((*drives.shape, 3, 6))
    turns[..., :2] = bodies[..., :2]
    turns[..., 2] = rates
    turns[..., 0, 3], turns[..., 1, 3] = -bodies[..., 1, 2], bodies[..., 0, 2]
    turns[..., 0, 4] = turns[..., 1, 5] = 1.0
    same = np.zeros((*drives.shape, 3, SIZE))
    same[..., B], same[..., D] = matrix, _EYE3
    same[..., K] = drives[..., None, None] * _EYE3
    return turns, same


class Gathering:
    """Samples on their way into a block, and the time that has passed since the last one."""

    def __init__(self) -> None:
        self._last: Sample | None = None
        # A row each in plain numbers, small, saved or not: z, integral of down_b up to it, rate, body_from_own, calmed
        # tilt, drive.
        self._rows: list[list[float]] = []
        self._dt_s = 0.0
        self._down_s: Array = np.zeros(3)
        self._turn_rad2 = self._turned_rad = 0.0
        self._rested = False
        self._first_s = 0.0

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def span_s(self) -> float:
        """Time from the first sample to now."""
        return self._dt_s - self._first_s

    def fits(self, s: Sample) -> bool:
        """Can this sample share a block with those already here?"""
        last = self._last
        if last is None:
            return True
        if s.axes != last.axes or s.tilt_from != last.tilt_from:
            return False
        a, b = s.shaping.matrix, last.shaping.matrix
        return a is b or bool((a == b).all())

    def rests(self, dt_s: float, turned_rad: float) -> None:
        """Time goes by and nothing turns but, by a gyro's error, the own frame about its down."""
        if not self._rested:
            self._rested, self._turn_rad2 = True, self._turn_rad2 + _REST_RAD**2
        self._dt_s += dt_s
        self._turned_rad += turned_rad

    def passes(self, dt_s: float, down_b: Array, turn_rad2: float) -> None:
        """Time goes by."""
        self._dt_s += dt_s
        self._down_s = self._down_s + dt_s * down_b
        self._turn_rad2 += turn_rad2

    def add(self, s: Sample, z: Array, body_from_own: Array, calmed_rad: float, drive: float) -> None:
        """Take one sample. calmed_rad : tilt that was taken out of its attitude."""
        if not self._rows:
            self._first_s = self._dt_s
        self._last = s
        vectors = z.tolist() + self._down_s.tolist() + s.rate_b_rads.tolist()
        self._rows.append([*vectors, *body_from_own.ravel().tolist(), calmed_rad, drive])

    def close(self) -> Block:
        """All of them as one block, and begin anew."""
        rows, last = np.array(self._rows), self._last
        assert last is not None  # nobody closes an empty one
        rates, bodies = rows[:, 6:9], rows[:, 9:18].reshape(-1, 3, 3)
        turns, same = fixed_parts(bodies, rates, last.shaping.matrix, rows[:, 19])
        out = Block(
            z=rows[:, :3],
            body_from_own=bodies,
            rate_rads2=(rates * rates).sum(1),
            turns_b=turns,
            calmed_rad=rows[:, 18],
            same=same,
            ahead_s=self._down_s - rows[:, 3:6],
            dt_s=self._dt_s,
            down_s=self._down_s,
            turn_rad2=self._turn_rad2,
            turned_rad=self._turned_rad,
            shaping=last.shaping,
            axes=last.axes,
            own_tilt_rad=None if last.tilt_from == "ATTITUDE" else last.own_tilt_rad,
        )
        self.__init__()  # type: ignore[misc]
        return out
