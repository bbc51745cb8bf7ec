"""A stretch cut into nodes: a few readings in a row each, and how time passes from one node to the next.

A node is what a block is to the estimator that flies (adaptive.block). In a long flight nodes are longer, so that there
are about tuning.nodes_most of them at most.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from magmav.core.estimators.adaptive.block import Block, Readings, fixed_parts
from magmav.core.estimators.adaptive.layout import Array
from magmav.core.estimators.adaptive.tuning import Tuning
from magmav.core.smoother.columns import Columns, Flags

_ROUNDING_S = 1e-6  # of times added up
_AT_ONCE = 512  # nodes: what is laid out for each is some kilobytes
_OF_READINGS = tuple(f.name for f in fields(Readings))


@dataclass(frozen=True, slots=True, eq=False)
class Nodes:
    """n nodes of at most m readings. Times within a node count from its last reading.

    rows (n, m) : of the columns; the last one again and again where a node has fewer.  there (n, m) : is it a reading?
    dt_s, down_s, turn_rad2, turned_rad (n - 1, ...) : from one node to the next.  lost (n - 1,) : a gap lies between.
    """

    columns: Columns
    rows: NDArray[np.intp]
    there: Flags
    ahead_s: Array
    dt_s: Array
    down_s: Array
    turn_rad2: Array
    turned_rad: Array
    lost: Flags

    @classmethod
    def of(cls, c: Columns, n: Tuning) -> Nodes | None:
        """None where nothing is taken."""
        groups = _groups(c, n)
        if not groups:
            return None
        size = np.array([len(g) for g in groups])
        most = int(size.max())
        rows = np.array([g + g[-1:] * (most - len(g)) for g in groups], dtype=np.intp)
        downs = np.cumsum(c.downs_s, axis=0)

        def since(values: Array) -> Array:
            out: Array = np.diff(np.cumsum(values, axis=0)[rows[:, -1]], axis=0)
            return out

        return cls(
            columns=c,
            rows=rows,
            there=np.arange(most) < size[:, None],
            ahead_s=downs[rows[:, -1:]] - downs[rows],
            dt_s=since(c.dt_s),
            down_s=np.diff(downs[rows[:, -1]], axis=0),
            turn_rad2=since(c.turn_rad2),
            turned_rad=since(c.turned_rad),
            lost=since(c.gap.astype(np.float64)) > 0.0,
        )

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def last(self) -> NDArray[np.intp]:
        """Row of the last reading of each."""
        return self.rows[:, -1]

    @property
    def boot_ns(self) -> NDArray[np.int64]:
        """(n,), of the last reading."""
        return self.columns.boot_ns[self.last]

    def matrix(self, part: slice = slice(None)) -> Array:
        """(n, 3, 3), A."""
        c = self.columns
        return np.array([k.matrix for k in c.shapings])[c.shaping[self.last[part]]]

    def tilt(self, n: Tuning) -> tuple[Array, Array]:
        """Sigma of the tilt and how long it lasts, (n,) rad and s."""
        c, last = self.columns, self.last
        own = np.minimum(n.own_tilt_doubt * c.own_tilt_rad[last], n.own_tilt_most_rad)
        return np.where(c.own_tilt[last], own, n.tilt_rad), np.where(c.own_tilt[last], n.own_tilt_tau_s, n.tilt_tau_s)

    def readings(self, a: int, b: int) -> Readings:
        """Of nodes a to b, one axis in front of all."""
        c, rows = self.columns, self.rows[a:b]
        bodies, rates = c.body_from_own[rows], c.rates[rows]
        matrix = self.matrix(slice(a, b))[:, None]
        turns, same = fixed_parts(bodies, rates, matrix, c.drive[rows])
        return Readings(
            z=c.z[rows],
            body_from_own=bodies,
            rate_rads2=(rates * rates).sum(-1),
            turns_b=turns,
            calmed_rad=c.calmed_rad[rows],
            same=same,
            ahead_s=self.ahead_s[a:b],
        )

    def first(self, count: int) -> Nodes:
        """The first ones alone: nothing of what the compass says later is in them."""
        cut, between = slice(count), slice(max(count - 1, 0))
        own = {name: getattr(self, name)[cut] for name in ("rows", "there", "ahead_s")}
        times = {name: getattr(self, name)[between] for name in ("dt_s", "down_s", "turn_rad2", "turned_rad", "lost")}
        return replace(self, **own, **times)

    def blocks(self) -> Iterator[Block]:
        """One after the other, as the estimator that flies takes them in."""
        c = self.columns
        for a in range(0, len(self), _AT_ONCE):
            many = self.readings(a, a + _AT_ONCE)
            for i in range(a, min(a + _AT_ONCE, len(self))):
                m, last, since = int(self.there[i].sum()), self.rows[i, -1], max(i - 1, 0)
                yield Block(
                    **{name: getattr(many, name)[i - a, :m] for name in _OF_READINGS},
                    dt_s=float(self.dt_s[since]) if i else 0.0,
                    down_s=self.down_s[since],
                    turn_rad2=float(self.turn_rad2[since]),
                    turned_rad=float(self.turned_rad[since]),
                    shaping=c.shapings[c.shaping[last]],
                    axes=c.axes,
                    own_tilt_rad=float(c.own_tilt_rad[last]) if c.own_tilt[last] else None,
                )


def _groups(c: Columns, n: Tuning) -> list[list[int]]:
    """Rows of each node: as adaptive.block.Gathering would have them."""
    taken = np.flatnonzero(c.take)
    fly_s = float(c.dt_s.sum())
    block_s = max(n.block_s, fly_s / n.nodes_most)
    most = max(n.block_readings, math.ceil(len(taken) / n.nodes_most))
    other = np.zeros(len(c.dt_s), dtype=bool)
    other[1:] = (c.shaping[1:] != c.shaping[:-1]) | (c.own_tilt[1:] != c.own_tilt[:-1])
    part = np.cumsum(~c.learn | c.gap | other)
    part[~c.learn] = -1
    out: list[list[int]] = []
    now: list[int] = []
    first_s, of = 0.0, -1
    at_s = np.cumsum(c.dt_s)
    for i, t, dt, mine in zip(
        taken.tolist(), at_s[taken].tolist(), c.dt_s[taken].tolist(), part[taken].tolist(), strict=True
    ):
        if now and mine != of:
            out.append(now)
            now = []
        if not now:
            first_s, of = t, mine
        now.append(i)
        if len(now) == most or t - first_s + dt > block_s + _ROUNDING_S:
            out.append(now)
            now = []
    return [*out, now] if now else out
