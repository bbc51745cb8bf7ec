"""One stretch of one compass as arrays: what each reading says, and which of them may teach.

The same rules as the estimator that flies has (adaptive.robust), asked of the whole stretch at once: what stands still
says nothing new, what is far from its neighbours is wild, and a tilt that may be the attitude's own noise is calmed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magmav.core.estimators.adaptive.layout import Array
from magmav.core.estimators.adaptive.robust import (
    STILL_MEAN_S,
    STILL_RADS,
    STILL_S,
    WILD_MG,
    WILD_MG_PER_RAD,
    WILD_OF,
    Stillness,
)
from magmav.core.estimators.adaptive.tuning import Tuning
from magmav.core.rotation import rotation
from magmav.core.types import Sample, Shaping

Flags = NDArray[np.bool_]
_REST_RAD = 0.02  # what stood still may have turned
_TILTS_LEAST = 100  # readings, before their tilt is called noise


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """N samples; body axes, mG, s, rad.

    z (N, 3) : A m + e.  body_from_own (N, 3, 3).  take : it teaches.  drive (N,) : throttle less a half.
    downs_s (N, 3), turn_rad2, turned_rad : what each adds to the integral of down, to the variance of the turn, and
    to the turn while it stood still (adaptive.block).  level : the vehicle hardly tilts.
    """

    samples: Sequence[Sample]
    boot_ns: NDArray[np.int64]
    dt_s: Array
    gap: Flags
    learn: Flags
    take: Flags
    own_tilt: Flags
    own_tilt_rad: Array
    shaping: NDArray[np.intp]
    shapings: Sequence[Shaping]
    z: Array
    body_from_own: Array
    calmed_rad: Array
    rates: Array
    downs_s: Array
    turn_rad2: Array
    turned_rad: Array
    drive: Array
    driven: tuple[float, float]  # mean and variance of it
    level: bool
    axes: int

    @classmethod
    def of(cls, samples: Sequence[Sample], n: Tuning) -> Columns:
        """The columns of a stretch of which each sample has its own frame."""
        dt_s = np.maximum(np.array([s.dt_s for s in samples]), 0.0)
        learn = np.array([s.learn for s in samples], dtype=bool)
        own = np.array([s.tilt_from != "ATTITUDE" for s in samples], dtype=bool)
        body = np.array([s.body_from_own for s in samples])
        rates = np.array([s.rate_b_rads for s in samples])
        shapings, shaping = _kinds(samples)
        sensor = np.array([s.mag_b_mg for s in samples])
        z = (np.array([k.matrix for k in shapings])[shaping] @ sensor[:, :, None])[:, :, 0]
        z += np.array([k.motor_b_mg for k in shapings])[shaping]
        down, speed = body[:, :, 2], np.linalg.norm(rates, axis=1)
        turned = (rates * down).sum(1) * dt_s
        rest = still(z, speed, dt_s, learn)
        moving = np.flatnonzero(learn & ~rest)
        take = np.zeros(len(samples), dtype=bool)
        take[moving[~wild(z[moving], (speed * dt_s)[moving])]] = True
        walk = np.where(own, 4.0 * n.turn_walk_rad, n.turn_walk_rad)
        begins = rest & ~np.concatenate(([False], rest[:-1]))
        drive, driven = _drive(samples, learn)
        body, calmed, level = _calmed(body, take, n.least_tilt_rad)
        return cls(
            samples=samples,
            boot_ns=np.array([s.boot_ns for s in samples], dtype=np.int64),
            dt_s=dt_s,
            gap=np.array([s.gap for s in samples], dtype=bool),
            learn=learn,
            take=take,
            own_tilt=own,
            own_tilt_rad=np.array([s.own_tilt_rad for s in samples]),
            shaping=shaping,
            shapings=shapings,
            z=z,
            body_from_own=body,
            calmed_rad=calmed,
            rates=rates,
            downs_s=np.where(rest, 0.0, dt_s)[:, None] * down,
            turn_rad2=np.where(rest, begins * _REST_RAD**2, walk**2 * dt_s + (n.turn_scale * turned) ** 2),
            turned_rad=np.where(rest, turned, 0.0),
            drive=drive,
            driven=driven,
            level=level,
            axes=samples[-1].axes,
        )

    def thinned(self, most: int) -> Columns:
        """The same with about so many that teach, evenly."""
        taken = np.flatnonzero(self.take)
        take = np.zeros(len(self.take), dtype=bool)
        take[taken[:: math.ceil(len(taken) / most)]] = True
        return replace(self, take=take)


def _kinds(samples: Sequence[Sample]) -> tuple[list[Shaping], NDArray[np.intp]]:
    """The different shapings, and which each sample has."""
    kinds: list[Shaping] = []
    which, last, k = np.zeros(len(samples), dtype=np.intp), None, 0
    for i, s in enumerate(samples):
        if s.shaping is not last:
            last = s.shaping
            k = next((j for j, kind in enumerate(kinds) if _same(kind, last)), len(kinds))
            if k == len(kinds):
                kinds.append(last)
        which[i] = k
    return kinds, which


def _same(a: Shaping, b: Shaping) -> bool:
    return a is b or bool((a.matrix == b.matrix).all() and (a.motor_b_mg == b.motor_b_mg).all())


def still(z: Array, speed_rads: Array, dt_s: Array, learn: Flags) -> Flags:
    """As adaptive.robust.Stillness says of one after the other. It need not be asked of what is seen to move."""
    out, watch = np.zeros(len(z), dtype=bool), Stillness()
    taught = np.flatnonzero(learn)
    moves = surely_moves(speed_rads[taught], dt_s[taught])
    if len(moves):
        at_s = np.cumsum(dt_s[taught])
        ends = np.concatenate((at_s[moves], at_s[-1:]))
        if (np.diff(ends) < STILL_S).all():
            taught = taught[: moves[0]]
    for i in taught.tolist():
        out[i] = watch.step(z[i], speed_rads[i], dt_s[i])
    return out


def surely_moves(speed_rads: Array, dt_s: Array) -> NDArray[np.intp]:
    """Where a sample alone takes the mean square rate over what standing still may show: then it moves for STILL_S."""
    return np.flatnonzero((1.0 - np.exp(-dt_s / STILL_MEAN_S)) * speed_rads**2 > STILL_RADS**2)


def wild(z: Array, turn_rad: Array) -> Flags:
    """Of readings (N, 3) in a row: is each far from the middle of the last five, more than turning explains?

    turn_rad (N,) : since the one before.  As adaptive.robust.WildGate, all at once.
    """
    n, before = len(z), WILD_OF - 1
    if n < 3:
        return np.zeros(n, dtype=bool)
    filled = np.concatenate((np.full((before, 3), np.inf), z))  # what is not there yet sorts last
    rows = np.sort(np.lib.stride_tricks.sliding_window_view(filled, WILD_OF, axis=0), axis=2)
    seen = np.minimum(np.arange(n) + 1, WILD_OF)
    middle = np.take_along_axis(rows, (seen // 2)[:, None, None], axis=2)[:, :, 0]
    turns = np.concatenate((np.zeros(before), turn_rad))
    lately = np.lib.stride_tricks.sliding_window_view(turns, WILD_OF).sum(1)
    out: Flags = (np.abs(z - middle).max(1) > WILD_MG + WILD_MG_PER_RAD * lately) & (seen >= 3)
    return out


def _drive(samples: Sequence[Sample], learn: Flags) -> tuple[Array, tuple[float, float]]:
    """Throttle less a half, its mean where nobody says; mean and variance where it teaches."""
    said = np.array([math.nan if s.throttle is None else s.throttle for s in samples]) - 0.5
    heard = said[learn & np.isfinite(said)]
    mean, variance = (float(heard.mean()), float(heard.var())) if len(heard) else (0.0, 0.0)
    return np.where(np.isfinite(said), said, mean), (mean, variance)


def _calmed(body: Array, take: Flags, least_rad: float) -> tuple[Array, Array, bool]:
    """The attitudes with the tilt at its mean where it may be nothing but noise, by how much each was off, and is it?

    As adaptive.robust.Tilting, with the mean of all of them.
    """
    off_rad, down = np.zeros(len(body)), body[:, :, 2]
    if not take.any():
        return body, off_rad, False
    mean = down[take, :2].mean(0)
    level = math.sqrt(0.5 * float(((down[take, :2] - mean) ** 2).sum(1).mean())) < least_rad
    if not level or int(take.sum()) < _TILTS_LEAST:
        return body, off_rad, level
    upright = np.where(down[:, 2] < 0.0, -1.0, 1.0)
    turn = np.column_stack((down[:, 1] - mean[1], mean[0] - down[:, 0])) * upright[:, None]
    size = np.hypot(*turn.T)
    out = body.copy()
    for i in np.flatnonzero(take & (size <= 3.0 * least_rad)).tolist():
        out[i] = rotation(np.array((*turn[i], 0.0))) @ body[i]
        off_rad[i] = size[i]
    return out, off_rad, level
