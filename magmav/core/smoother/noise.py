"""Noise as it shows in what a fit leaves over: of single readings, of what a node shares, of what neighbours share."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from magmav.core.estimators.adaptive import layout as at
from magmav.core.estimators.adaptive.layout import Array
from magmav.core.estimators.adaptive.robust import MEDIAN_TO_VARIANCE
from magmav.core.estimators.adaptive.tuning import Tuning
from magmav.core.smoother.nodes import Nodes

_MAD_TO_SIGMA = 1.4826  # of a normal value
_LEAST = 20  # readings, before their scatter is believed
_WILD = 4.0  # sigmas: more of one node's mean does not count as more


@dataclass(frozen=True, slots=True)
class Noise:
    """white_mg2 : variance of one reading.  common_mg2 : of what a node's readings share.  disturbance_mg : sigma."""

    white_mg2: float
    common_mg2: float
    disturbance_mg: float

    @classmethod
    def first(cls, n: Tuning) -> Noise:
        """Before anything is seen."""
        return cls(n.white_mg**2, n.common_mg**2, n.disturbance_mg)

    def seen(self, nodes: Nodes, left: Array, x: Array, n: Tuning) -> Noise:
        """As it shows: left (N, m, 3) is what the path x (N, SIZE) leaves over.

        The disturbance is added to that again: it is noise to everything else. White noise is the scatter within
        nodes; of their means, what neighbours share is disturbance, and the rest is common.
        """
        k, there = nodes.columns.axes, nodes.there
        whole = (left + x[:, None, at.D])[..., :k]
        size = there.sum(1)
        mean = (whole * there[..., None]).sum(1) / size[:, None]
        spread = np.abs(whole - mean[:, None]) / np.sqrt(1.0 - 1.0 / np.maximum(size, 2))[:, None, None]
        inside = spread[there & (size > 2)[:, None]]
        white = self.white_mg2
        if len(inside) >= _LEAST:
            white = _within(MEDIAN_TO_VARIANCE * float(np.median(inside)) ** 2, n.white_lo_mg**2, n.white_hi_mg**2)
        most = _WILD * _MAD_TO_SIGMA * float(np.median(np.abs(mean)))
        mean = np.clip(mean, -most, most)
        near = (nodes.dt_s < 3.0 * float(np.median(nodes.dt_s, axis=None)) + 1e-9) & ~nodes.lost
        square, alike = float((mean * mean).mean()), 0.0
        if near.any():
            lasts = float(np.exp(-nodes.dt_s[near] / n.disturbance_tau_s).mean())
            alike = max(float((mean[1:] * mean[:-1])[near].mean()), 0.0) / lasts
        disturbance = _within(math.sqrt(alike), n.disturbance_lo_mg, n.disturbance_hi_mg)
        common = square - disturbance**2 - white / float(size.mean())
        return Noise(white, _within(common, n.common_lo_mg**2, n.common_hi_mg**2), disturbance)


def _within(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)
