"""The forward pass: the estimator that flies, over the nodes. It finds north, and notices sudden changes.

What it believes is where the smoother begins.
"""

from __future__ import annotations

import copy
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magmav.core.estimators.adaptive import AdaptiveEstimator
from magmav.core.estimators.adaptive import layout as at
from magmav.core.estimators.adaptive.bank import Bank
from magmav.core.estimators.adaptive.layout import Array
from magmav.core.estimators.adaptive.tuning import Tuning
from magmav.core.smoother.columns import Columns
from magmav.core.smoother.nodes import Nodes
from magmav.core.types import Estimate


class Notice(NamedTuple):
    """The iron changed suddenly between these two times."""

    from_ns: int
    to_ns: int


class Forth(AdaptiveEstimator):
    """The estimator fed with nodes.

    boot_ns (n,), believed (n, SIZE) : by the best hypothesis after each.
    """

    def __init__(self, c: Columns, tuning: Tuning) -> None:
        super().__init__(tuning, second=False)
        self.boot_ns: NDArray[np.int64] = np.empty(0, dtype=np.int64)
        self.believed: Array = np.empty((0, at.SIZE))
        self.notices: list[Notice] = []
        first = c.samples[int(np.flatnonzero(c.take)[0])]
        row = int(np.flatnonzero(c.take)[0])
        self.field = self._prior(first, c.z[row], c.body_from_own[row][:, 2])
        self._bank = self._begun(self.field)
        self._samples = int(c.take.sum())
        self._level = c.level
        every_s = [s.tilt_every_s for s, t in zip(c.samples, c.take.tolist(), strict=True) if t]
        self._tilt_every_s = float(np.mean(every_s))
        self._drive, self._drive2 = c.driven

    def go(self, nodes: Nodes, late_ns: int) -> None:
        """Over a stretch. late_ns : a change is noticed within so long."""
        believed, self.boot_ns = [], nodes.boot_ns
        for i, block in enumerate(nodes.blocks()):
            since_s = self._change.since_s
            self._lost = i > 0 and bool(nodes.lost[i - 1])
            self._take_in(block)
            if self._change.since_s < since_s:
                self.notices.append(Notice(int(self.boot_ns[i]) - late_ns, int(self.boot_ns[i])))
            assert self._bank is not None
            believed.append(self._bank.x[int(self._bank.log_weight.argmax())].copy())
        self.believed = np.array(believed)

    def at(self, boot_ns: int) -> Array:
        """What was believed by then, (SIZE,)."""
        return np.asarray(self.believed[max(int(np.searchsorted(self.boot_ns, boot_ns, side="right")) - 1, 0)])

    def first(self, nodes: Nodes) -> Forth:
        """As it was at the end of these, the first ones of the stretch."""
        out, end_ns = copy.copy(self), int(nodes.boot_ns[-1])
        count = max(int(np.searchsorted(self.boot_ns, end_ns, side="right")), 1)
        out.boot_ns, out.believed = self.boot_ns[:count], self.believed[:count]
        out.notices = [notice for notice in self.notices if notice.to_ns <= end_ns]
        out._samples = int(nodes.there.sum())
        drive = nodes.columns.drive[nodes.rows[nodes.there]]
        out._drives = float(drive.mean()), float(drive.var())
        return out

    def says(self, bank: Bank, changed_ago_s: float, residual_mg: float, step_nis: float) -> Estimate | None:
        """The estimate, had this been believed."""
        like = copy.copy(self)
        like._bank, like._answered = bank, None
        like._structure_mg2, like._residual_mg2, like._nis = 0.0, residual_mg**2, step_nis
        like._change = copy.copy(self._change)
        like._change.since_s = changed_ago_s
        return like._answer(bank, None, self._level)(samples=self._samples) if self._samples >= 10 else None
