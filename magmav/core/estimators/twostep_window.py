"""What TWOSTEP remembers: which values it believes, and their sums over stretches of time that double as they age.

sieve   holds two values back and drops what its neighbours on both sides contradict: one wild value is seen as such
        without knowing any answer, so no wrong answer can defend itself
cell    a run of values that hardly moved, as its mean. The equation is linear in (y, |y|^2), so means obey it as values
        do, with less noise in the regressors
block   sums over the cells of a second; two blocks of a second, two of two, two of four ...: a fixed number of them
        reaches back for minutes, the last for ever
"""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from magmav.core.packing import upper, whole

Array = NDArray[np.floating[Any]]
Point = tuple[float, float, float]

UNIT_MG = 500.0
"""Sums are kept in this unit, about the length of the field: all their entries are then of one size."""
PAIRS_I, PAIRS_J = np.array((0, 1, 2, 0, 0, 1)), np.array((0, 1, 2, 1, 2, 2))
_PAIRS_I, _PAIRS_J = 1 + PAIRS_I, 1 + PAIRS_J  # of w
SIZE = 11
"""Length of w = (1, y, |y|^2, y_i y_j over PAIRS), what a cell says."""

_BACK = 2
_STEP_MG, _SPREADS = 40.0, 3.0  # from one value to the next nobody doubts; beyond it, in spreads of the neighbours
_CELL_MG, _CELL_S, _BLOCK_S = 40.0, 1.0, 1.0
_MOST_CELLS = 100
LEVELS, PER_LEVEL = 9, 2  # the oldest block but one lasts 2^8 s, the oldest is all before


class Sieve:
    """Drops wild values. What comes out is what came in two values ago, or None."""

    def __init__(self) -> None:
        self._held: deque[tuple[float, Point]] = deque(maxlen=2 * _BACK + 1)
        self._last: Point = (0.0, 0.0, 0.0)

    def step(self, t_s: float, point_mg: Point) -> tuple[float, Point] | None:
        """Take one value and its time; the time and value that passed, or None."""
        held = self._held
        held.append((t_s, point_mg))
        if len(held) <= 2 * _BACK:
            return None
        out = held[_BACK]
        x, y, z = out[1]
        a, b, c = self._last
        if abs(x - a) >= _STEP_MG or abs(y - b) >= _STEP_MG or abs(z - c) >= _STEP_MG:
            for axis, value in enumerate(out[1]):
                around = [p[axis] for _, p in held]
                middle = sorted(around)[_BACK]
                spread = sorted([abs(v - middle) for v in around])[_BACK]
                if abs(value - middle) > _STEP_MG + _SPREADS * spread:
                    return None
        self._last = out[1]
        return out


class Cells(NamedTuple):
    """The cells of one block: how many values each holds (C,), and their means of w (C, 11)."""

    weight: Array
    mean: Array


class Blocks:
    """Sums of n w w' over cells of n values, a block each, oldest first.

    sums (J, 11, 11); cells, J numbers: how many made each; begun_s, J times.
    """

    def __init__(self) -> None:
        self.sums: Array = np.zeros((0, SIZE, SIZE))
        self.cells: list[float] = []
        self.begun_s: list[float] = []
        self._level: list[int] = []
        self._rows: list[tuple[float, float, float, float, float]] = []
        self._n = 0
        self._x = self._y = self._z = self._q = 0.0
        self._first: Point = (0.0, 0.0, 0.0)
        self._cell_s = self._block_s = 0.0

    def __getstate__(self) -> dict[str, Any]:
        """The sums are symmetric to the last bit."""
        return self.__dict__ | {"sums": upper(self.sums)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.sums = whole(state["sums"], SIZE)

    def add(self, t_s: float, point_mg: Point) -> Cells | None:
        """Take one value; the cells of the block before it if that ended here."""
        x, y, z = point_mg
        closed = None
        if self._n:
            a, b, c = self._first
            moved = abs(x - a) > _CELL_MG or abs(y - b) > _CELL_MG or abs(z - c) > _CELL_MG
            if moved or not 0.0 <= t_s - self._cell_s < _CELL_S:
                self._close_cell()
                if not 0.0 <= t_s - self._block_s < _BLOCK_S or len(self._rows) >= _MOST_CELLS:
                    closed = self._close_block()
        if not self._n:
            self._first, self._cell_s = point_mg, t_s
            if not self._rows:
                self._block_s = t_s
        self._n += 1
        self._x += x
        self._y += y
        self._z += z
        self._q += x * x + y * y + z * z
        return closed

    def _close_cell(self) -> None:
        n, f = self._n, 1.0 / (self._n * UNIT_MG)
        self._rows.append((float(n), self._x * f, self._y * f, self._z * f, self._q * f / UNIT_MG))
        self._n = 0
        self._x = self._y = self._z = self._q = 0.0

    def _close_block(self) -> Cells:
        rows = np.array(self._rows)
        weight = rows[:, 0].copy()
        mean = np.empty((len(rows), SIZE))
        mean[:, :5] = rows
        mean[:, 0] = 1.0
        mean[:, 5:] = rows[:, _PAIRS_I] * rows[:, _PAIRS_J]
        self._rows = []
        sums = mean.T @ (mean * weight[:, None])
        self.sums = np.concatenate((self.sums, (0.5 * (sums + sums.T))[None]))
        self.cells.append(float(len(rows)))
        self.begun_s.append(self._block_s)
        self._level.append(0)
        self._merge()
        return Cells(weight, mean)

    def _merge(self) -> None:
        """Wherever there is one too many of a length, the two oldest become one of twice the length.

        Those of the greatest length become one as well: what is forgotten is for whoever asks to choose.
        """
        for level in range(LEVELS):
            if self._level.count(level) <= PER_LEVEL:
                return
            i = self._level.index(level)
            self.sums[i + 1] += self.sums[i]
            self.cells[i + 1] += self.cells[i]
            self.begun_s[i + 1] = self.begun_s[i]
            self._level[i + 1] = min(level + 1, LEVELS - 1)
            self.sums = np.concatenate((self.sums[:i], self.sums[i + 1 :]))
            del self.cells[i], self.begun_s[i], self._level[i]
