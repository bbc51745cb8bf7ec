"""The forward pass: the estimator that flies, over the nodes. It finds north, and notices sudden changes.

What it believes is where the smoother begins.
"""

from __future__ import annotations

import copy
from typing import NamedTuple

import numpy as np

from magmav.core.estimators.adaptive import AdaptiveEstimator
from magmav.core.estimators.adaptive import layout as at
from magmav.core.estimators.adaptive.bank import Bank
from magmav.core.estimators.adaptive.layout import Array
from magmav.core.estimators.adaptive.tuning import Tuning
from magmav.core.smoother.columns import Columns
from magmav.core.smoother.nodes import Nodes
from magmav.core.types import Estimate


class Notice(NamedTuple):
    """The iron changed suddenly before this node, at most so many nodes before."""

    node: int
    lately: int


class Forth(AdaptiveEstimator):
    """The estimator fed with nodes. believed (n, SIZE) : by the best hypothesis after each."""

    def __init__(self, c: Columns, tuning: Tuning) -> None:
        super().__init__(tuning, second=False)
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

    def go(self, nodes: Nodes, late_s: float) -> None:
        """Over a stretch. late_s : a change is noticed within so long."""
        believed = []
        at_s = np.concatenate(([0.0], np.cumsum(nodes.dt_s)))
        for i, block in enumerate(nodes.blocks()):
            since_s = self._change.since_s
            self._lost = i > 0 and bool(nodes.lost[i - 1])
            self._take_in(block)
            if self._change.since_s < since_s:
                early = int(np.searchsorted(at_s, at_s[i] - late_s))
                self.notices.append(Notice(i, i - min(early, i - 1)))
            assert self._bank is not None
            believed.append(self._bank.x[int(self._bank.log_weight.argmax())])
        self.believed = np.array(believed)

    def first(self, nodes: Nodes) -> Forth:
        """As it was at the end of these, the first ones of those it went over."""
        out = copy.copy(self)
        out.believed = self.believed[: len(nodes)]
        out.notices = [notice for notice in self.notices if notice.node < len(nodes)]
        out._samples = int(nodes.there.sum())
        return out

    def says(self, bank: Bank, changed_ago_s: float, residual_mg: float, step_nis: float) -> Estimate | None:
        """The estimate, had this been believed."""
        like = copy.copy(self)
        like._bank, like._answered = bank, None
        like._structure_mg2, like._residual_mg2, like._nis = 0.0, residual_mg**2, step_nis
        like._change = copy.copy(self._change)
        like._change.since_s = changed_ago_s
        return like._answer(bank, None, self._level)(samples=self._samples) if self._samples >= 10 else None
