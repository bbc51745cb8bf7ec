"""From which value on a stream carries newly stored offsets.

An estimator works on the sensor's own field, so new offsets are no news to it, as long as every value is undone with
the offsets it was made with. A parameter's echo and the first value made with it travel apart: the autopilot averages,
the link delays. For a while both offsets may be in the stream, and the value itself tells which: with C the attitude in
a frame level with the earth that the gyro carries along, A and e the autopilot's matrix and motor term, b the iron,

    h = mean C' (A (m - b) + e) over the last values before the change,    m = b + A^-1 (C h - e) to come.

An error in b is the less in the way the less the vehicle has turned since: (I - C C0') of it. Where that or the noise
could hide the difference, the echo is believed. Nothing is taught until only new offsets have been seen for a while.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace

import numpy as np

from magmav.core.types import Estimate, Sample, Vec3, vec3

_REMEMBERED = 8  # values before the change
_READING_MG = 10.0  # of noise, tilt and averaging in the value foretold
_SURE = 4.0  # offsets nearer to each other than so many sigmas are not told apart
_LONGEST_NS = 5_000_000_000  # after the last echo it is believed, whatever the values look like


class Handover:
    """One compass's change of stored offsets. Offsets are (3,) mG, body axes, to be added."""

    def __init__(self) -> None:
        self._before: deque[Sample] = deque(maxlen=_REMEMBERED)
        self._offsets: list[Vec3] = []  # all that may be in the stream, the newest last
        self._echo_ns = 0
        self._seen_ns = 0  # since when nothing but the newest has been seen

    def changed(self, old_b_mg: Vec3, new_b_mg: Vec3, boot_ns: int) -> None:
        """The autopilot says that it holds these now instead of those."""
        if not self._offsets:
            self._offsets.append(old_b_mg)
        self._offsets.append(new_b_mg)
        self._echo_ns = self._seen_ns = boot_ns

    def step(self, s: Sample, e: Estimate, settle_ns: int) -> Sample:
        """The sample undone with the offsets it was made with, and not taught from while that may be wrong.

        s : undone with the newest. e : what is believed of the hard iron before it.
        """
        if s.gap:
            self._before.clear()
        if self._offsets and s.boot_ns - self._echo_ns < _LONGEST_NS:
            carried = self._carried(s, e)
            if carried is not self._offsets[-1]:
                self._seen_ns = s.boot_ns
                s = replace(s, mag_b_mg=vec3(s.mag_b_mg + (self._offsets[-1] - carried), "field"))
            if s.boot_ns - self._seen_ns < settle_ns:
                return replace(s, learn=False)
        self._offsets.clear()
        self._before.append(s)
        return s

    def _carried(self, s: Sample, e: Estimate) -> Vec3:
        """Which of the offsets this value was made with; the newest where that cannot be told."""
        newest, now, iron_b_mg = self._offsets[-1], s.body_from_own, e.hard_iron_b_mg
        levels = [
            p.body_from_own.T @ (p.shaping.matrix @ (p.mag_b_mg - iron_b_mg) + p.shaping.motor_b_mg)
            for p in self._before
            if p.body_from_own is not None
        ]
        if now is None or not levels or s.axes != 3:
            return newest
        then = next(p.body_from_own for p in reversed(self._before) if p.body_from_own is not None)
        field_b = now @ np.mean(levels, axis=0)
        foretold = iron_b_mg + np.linalg.solve(s.shaping.matrix, field_b - s.shaping.motor_b_mg)
        turned = np.eye(3) - now @ then.T
        doubt = math.sqrt(_READING_MG**2 + max(float(np.trace(turned @ e.covariance_mg2 @ turned.T)), 0.0))
        away = [float(np.linalg.norm(s.mag_b_mg + (newest - o) - foretold)) for o in self._offsets]
        nearest = self._offsets[int(np.argmin(away))]
        apart = float(np.linalg.norm(newest - nearest))
        return nearest if apart >= _SURE * doubt else newest
