"""Heading smoothed: a Kalman filter live, RTS after the flight, and the same with a fixed lag (Sytnyk et al. 2014).

The paper names the filter and the smoother but gives no model. DEVIATES: defined here (seed-methods.md Y7): state
(psi, rate), F = [[1, dt], [0, 1]], Q = q [[dt^3/3, dt^2/2], [dt^2/2, dt]], measurement psi. The state is never
wrapped: the filter is given x + wrap(z - x), and only what comes out is folded to [0, 2 pi).

Smoothing takes out noise. It does not take out deviation (hard and soft iron), which turns with the heading.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from magmav.core.azimuth import finite
from magmav.core.rotation import wrap_pi, wrap_tau

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Motion:
    """How a vehicle is taken to turn.

    q_rad2ps3 : how fast the variance of the turn rate grows, (rad/s)^2 per s. The default is (4 deg/s)^2 per s: turns
    of 20 deg/s begun within seconds.  rate_sigma_rads : of the rate before anything is known.
    gap_s : after a longer silence the filter begins again, since what came between may be any number of turns.
    """

    q_rad2ps3: float = math.radians(4.0) ** 2
    rate_sigma_rads: float = math.radians(60.0)
    gap_s: float = 2.0

    def __post_init__(self) -> None:
        for name in ("q_rad2ps3", "rate_sigma_rads", "gap_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name}: want a number above 0, got {value!r}")


class Smoothed(NamedTuple):
    """A heading in [0, 2 pi) at a time of the vehicle's clock, its rate, and one sigma of the heading."""

    boot_s: float
    heading_rad: float
    rate_rads: float
    sigma_rad: float


class _Step(NamedTuple):
    """One step of the filter: unwrapped state (2,), covariance (2, 2), and F and Q that led here (None: begun anew)."""

    boot_s: float
    x: Array
    p: Array
    f: Array | None
    q: Array | None

    def out(self) -> Smoothed:
        return _smoothed(self.boot_s, self.x, float(self.p[0, 0]))


def _smoothed(boot_s: float, x: Array, variance: float) -> Smoothed:
    return Smoothed(boot_s, wrap_tau(float(x[0])), float(x[1]), math.sqrt(max(variance, 0.0)))


def _kalman_filter(states: int, measures: int) -> Any:
    """filterpy's. It takes a second to load: only who smooths shall wait for it."""
    from filterpy.kalman import KalmanFilter

    return KalmanFilter(dim_x=states, dim_z=measures)


class HeadingFilter:
    """Kalman filter of heading and turn rate, live. A copy or pickle of it goes on to the same bits."""

    def __init__(self, motion: Motion | None = None) -> None:
        self.motion = motion or Motion()
        self._filter = _kalman_filter(2, 1)
        self._filter.H = np.array([[1.0, 0.0]])
        self._boot_s: float | None = None

    def step(self, boot_s: float, heading_rad: float, sigma_rad: float) -> Smoothed:
        """One heading and its sigma (that of the field's noise over H). Time that jumps back begins anew.

        ValueError unless all are finite and sigma is above 0.
        """
        return self._advance(boot_s, heading_rad, sigma_rad).out()

    def _advance(self, boot_s: float, heading_rad: float, sigma_rad: float) -> _Step:
        finite(boot_s=boot_s, heading_rad=heading_rad, sigma_rad=sigma_rad)
        if sigma_rad <= 0.0:
            raise ValueError(f"sigma_rad: want a number above 0, got {sigma_rad!r}")
        kf, before, self._boot_s = self._filter, self._boot_s, boot_s
        variance = sigma_rad * sigma_rad
        if before is None or not 0.0 <= boot_s - before <= self.motion.gap_s:
            kf.x = np.array([heading_rad, 0.0])
            kf.P = np.diag([variance, self.motion.rate_sigma_rads**2])
            return _Step(boot_s, kf.x, kf.P, None, None)
        dt = boot_s - before
        f = np.array([[1.0, dt], [0.0, 1.0]])
        q = self.motion.q_rad2ps3 * np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
        kf.predict(F=f, Q=q)
        psi = float(kf.x[0])
        kf.update(psi + wrap_pi(heading_rad - psi), R=variance)
        return _Step(boot_s, kf.x, kf.P, f, q)


class FixedLagSmoother:
    """The heading as it is known ``lag`` steps later: exactly RTS over the last lag + 1 states, O(lag) per step.

    Beside each state j of the window stands C_j, its covariance with the newest: predict C_j <- C_j F'; update
    x_j <- x_j + C_j H' y / S and C_j <- C_j (I - K H)'. filterpy's own FixedLagSmoother is not exact.
    """

    def __init__(self, lag: int, motion: Motion | None = None) -> None:
        if lag < 1:
            raise ValueError(f"lag: want 1 step or more, got {lag!r}")
        self.lag = lag
        self._heading = HeadingFilter(motion)
        self._boot_s: list[float] = []
        self._clear()

    def _clear(self) -> None:
        self._boot_s.clear()
        self._x = np.empty((0, 2))
        self._cross = np.empty((0, 2, 2))
        self._variance = np.empty(0)

    def step(self, boot_s: float, heading_rad: float, sigma_rad: float) -> list[Smoothed]:
        """Take one heading; hand out what is final.

        That is nothing while the window fills, then one value a step; when the filter begins anew (gap, reboot), all
        that was left. Every heading taken comes out once, in order, the last ones by ``finish``.
        """
        kf = self._heading._filter
        got = self._heading._advance(boot_s, heading_rad, sigma_rad)
        out: list[Smoothed] = []
        if got.f is None:
            out = self.finish()
        elif self._boot_s:
            cross = self._cross @ got.f.T
            to_z = cross[:, :, 0]
            s = float(kf.S[0, 0])
            self._x = self._x + to_z * (float(kf.y[0]) / s)
            self._variance = self._variance - to_z[:, 0] ** 2 / s
            self._cross = cross @ (np.eye(2) - kf.K @ kf.H).T
        self._boot_s.append(boot_s)
        self._x = np.vstack([self._x, got.x])
        self._cross = np.concatenate([self._cross, got.p[None]])
        self._variance = np.append(self._variance, got.p[0, 0])
        if len(self._boot_s) > self.lag + 1:
            del self._boot_s[0]
            self._x, self._cross, self._variance = self._x[1:], self._cross[1:], self._variance[1:]
        if len(self._boot_s) == self.lag + 1:
            out.append(_smoothed(self._boot_s[0], self._x[0], float(self._variance[0])))
        return out

    def window(self) -> list[Smoothed]:
        """All states of the window as they are known now, oldest first; the last is the filter's own."""
        rows = zip(self._boot_s, self._x, self._variance.tolist(), strict=True)
        return [_smoothed(t, x, variance) for t, x, variance in rows]

    def finish(self) -> list[Smoothed]:
        """What has not been handed out. The window is empty afterwards; the filter goes on."""
        left = self.window()
        left = left[1:] if len(left) == self.lag + 1 else left
        self._clear()
        return left


def smooth(
    boot_s: Sequence[float] | Array,
    heading_rad: Sequence[float] | Array,
    sigma_rad: Sequence[float] | Array,
    motion: Motion | None = None,
) -> list[Smoothed]:
    """After the flight: every heading with all of the flight known (Rauch-Tung-Striebel). Three sequences of length n.

    Each stretch between gaps is smoothed on its own. ValueError for lengths that differ and what step() refuses.
    """
    if not len(boot_s) == len(heading_rad) == len(sigma_rad):
        raise ValueError(f"lengths differ: {len(boot_s)} times, {len(heading_rad)} headings, {len(sigma_rad)} sigmas")
    heading = HeadingFilter(motion)
    rows = zip(boot_s, heading_rad, sigma_rad, strict=True)
    steps = [heading._advance(float(t), float(z), float(s)) for t, z, s in rows]
    starts = [i for i, step in enumerate(steps) if step.f is None] + [len(steps)]
    return [one for i, j in pairwise(starts) for one in _smooth_stretch(heading, steps[i:j])]


def _smooth_stretch(heading: HeadingFilter, steps: list[_Step]) -> list[Smoothed]:
    """filterpy's method takes Fs[k + 1] for the way from k to k + 1, its function of the same name Fs[k].

    Here f and q stand beside the state they led to, which is what the method wants. The first is never read.
    """
    unread = np.eye(2)
    x, p, _, _ = heading._filter.rts_smoother(
        np.array([s.x for s in steps]),
        np.array([s.p for s in steps]),
        Fs=[unread if s.f is None else s.f for s in steps],
        Qs=[unread if s.q is None else s.q for s in steps],
    )
    return [_smoothed(s.boot_s, x[k], float(p[k, 0, 0])) for k, s in enumerate(steps)]


def noise_reduction(factor: float) -> tuple[float, float]:
    """(K, Q/R) with which a random-walk filter makes noise ``factor`` times smaller on a constant input.

    K = 2 / (1 + factor^2), Q/R = K^2 / (1 - K). So the paper's "2.5 times less noise" is a choice (K = .276, Q/R =
    .105), not a property of the filter: it is paid for in lag. ValueError unless above 1.
    """
    if not (math.isfinite(factor) and factor > 1.0):
        raise ValueError(f"factor: want a number above 1, got {factor!r}")
    k = 2.0 / (1.0 + factor * factor)
    return k, k * k / (1.0 - k)


class ChannelFilter:
    """The paper's other way: the two levelled channels through a random-walk filter each, then the angle.

    Nothing wraps, but it lags: by (1 - K) / K steps of whatever the heading does (2.6 degrees at 10 deg/s and 10 Hz for
    a factor of 2.5), and a turning field comes out shorter. ``HeadingFilter`` knows the rate and does not lag.

    factor : noise reduction wanted.  sigma_mg : noise of one channel. Steps are taken to be even.
    """

    def __init__(self, sigma_mg: float, factor: float = 2.5) -> None:
        if not (math.isfinite(sigma_mg) and sigma_mg > 0.0):
            raise ValueError(f"sigma_mg: want a number above 0, got {sigma_mg!r}")
        self._filter = _kalman_filter(2, 2)
        self._filter.H = np.eye(2)
        self._filter.R = np.eye(2) * sigma_mg**2
        self._filter.Q = self._filter.R * noise_reduction(factor)[1]
        self._begun = False

    def step(self, ahead_mg: float, right_mg: float) -> float | None:
        """The levelled field, mG; the magnetic heading in [0, 2 pi), None where the filtered field is zero."""
        finite(ahead_mg=ahead_mg, right_mg=right_mg)
        kf, z = self._filter, np.array([ahead_mg, right_mg])
        if self._begun:
            kf.predict()
            kf.update(z)
        else:
            self._begun, kf.x, kf.P = True, z, kf.R.copy()
        ahead, right = kf.x.tolist()
        return None if ahead == 0.0 and right == 0.0 else wrap_tau(math.atan2(-right, ahead))

    @property
    def field_mg(self) -> tuple[float, float]:
        """The filtered field ahead and to the right, mG."""
        ahead, right = self._filter.x.ravel().tolist()
        return ahead, right
