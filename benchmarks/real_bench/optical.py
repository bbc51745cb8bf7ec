"""Hand-moved recordings with an optical attitude: the room's field, the compass's offset, when a magnet came and went.

The optical attitude comes at 10 Hz and is carried from each row to the next with the recorded gyro. The room's field
(level north, east, down of the optical frame) is the least-squares fit to the undisturbed recording, together with
that recording's offset and the lag of the magnetometer behind the optical attitude. The offset in any stretch of
another recording is then the mean of what the field does not explain, over the samples in which it was turned; a fit
with soft iron stands beside it. A magnet came when the field left the level without it, and was in place when it
stayed at the level with it.
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from magmav.core.rotation import body_from_earth, rotation
from magmav.core.types import InertialReading, MagReading
from magmav.recording import open_recording

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
_ROW_S = 0.15  # rows of truth further apart are not bridged
_MOVING_RADS = math.radians(20.0)
_BIN_S = 1.0
_APART_S = 5.0  # nothing this near a step tells of the levels
_ODD_MG, _ODD_SHARE = 18.0, 0.05  # further from its level than this and that share of the step: magnet on its way


@dataclass(frozen=True, slots=True, eq=False)
class Moved:
    """One recording with its optical attitude at the times of its IMU readings.

    boot_s : (N,).  mag_b_mg, rate_b_rads : (N, 3).  body_from_room : (N, 3, 3), carried on over gaps of the truth that
    are no longer than _ROW_S; valid : (N,).
    """

    name: str
    boot_s: Floats
    mag_b_mg: Floats
    rate_b_rads: Floats
    body_from_room: Floats
    valid: Flags


class Room(NamedTuple):
    """The room's field, (3,) mG in the optical frame, the offset it was found with, lag in s, RMS of the fit in mG."""

    field_n_mg: Floats
    offset_b_mg: Floats
    lag_s: float
    rms_mg: float


class Magnet(NamedTuple):
    """A magnet on a recording: boot times at which it began and ended to come, and to go."""

    on_s: tuple[float, float]
    off_s: tuple[float, float]


class Iron(NamedTuple):
    """What the compass carries: ``offset`` alone, as an upload would have it, and with soft iron (3, 3) its own."""

    offset_b_mg: Floats
    hard_b_mg: Floats
    soft_b: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """The iron over time. iron : with no magnet on; with_magnet : with it, None where there is none.

    spinning : (N,) where it was turned.  odd : (N,) where the field was that of neither: the magnet coming, going, or
    something else held near.
    """

    moved: Moved
    room: Room
    magnet: Magnet | None
    iron: Iron
    with_magnet: Iron | None
    spinning: Flags
    odd: Flags

    def iron_at(self, boot_s: float) -> Iron:
        """The magnet counts from the middle of its coming to the middle of its going."""
        if self.magnet is None or self.with_magnet is None:
            return self.iron
        (a, b), (c, d) = self.magnet
        return self.with_magnet if a + b <= 2.0 * boot_s < c + d else self.iron

    def odd_at(self, boot_s: float) -> bool:
        """Is the field that of neither?"""
        return bool(self.odd[min(int(np.searchsorted(self.moved.boot_s, boot_s)), len(self.odd) - 1)])

    def turned_s(self, from_s: float, to_s: float) -> float:
        """Seconds of motion between two times."""
        t = self.moved.boot_s
        step_s = np.diff(t, append=t[-1])
        return float(step_s[self.spinning & (t >= from_s) & (t < to_s)].sum())

    def turning_from(self, from_s: float) -> float:
        """The first time of motion from then on."""
        t = self.moved.boot_s
        return float(t[self.spinning & (t >= from_s)][0])


def read(path: Path, truth_csv: Path) -> Moved:
    """A recording and its truth file."""
    recording = open_recording(path)
    mags, rates = {}, {}
    try:
        for _, reading in recording.readings():
            if isinstance(reading, MagReading):
                mags[reading.boot_ns] = reading.field_b_mg
            elif isinstance(reading, InertialReading):
                rates[reading.boot_ns] = reading.rate_b_rads
    finally:
        recording.close()
    times = sorted(set(mags) & set(rates))
    boot_s = np.array(times) / 1e9
    rate = np.array([rates[t] for t in times])
    attitude, valid = _carried(boot_s, rate, truth_csv)
    return Moved(path.name, boot_s, np.array([mags[t] for t in times]), rate, attitude, valid)


def _carried(boot_s: Floats, rate_b_rads: Floats, truth_csv: Path) -> tuple[Floats, Flags]:
    with truth_csv.open(newline="") as file:
        rows = np.array([[float(r[k]) for k in ("boot_time_s", "roll_deg", "pitch_deg", "heading_true_deg")]
                         for r in csv.DictReader(file)])  # fmt: skip
    seen = [body_from_earth(*np.radians(row[1:])) for row in rows]
    row_rates = np.stack([np.interp(rows[:, 0], boot_s, rate_b_rads[:, axis]) for axis in range(3)], axis=1)
    latest = np.searchsorted(rows[:, 0], boot_s, side="right") - 1
    out = np.broadcast_to(np.eye(3), (len(boot_s), 3, 3)).copy()
    valid = (latest >= 0) & (boot_s - rows[latest, 0] <= _ROW_S)
    for i in np.flatnonzero(valid):
        k = latest[i]
        on = i > 0 and valid[i - 1] and latest[i - 1] == k  # from the sample before, or from the row itself
        begin_s, rate, attitude = (
            (boot_s[i - 1], rate_b_rads[i - 1], out[i - 1]) if on else (rows[k, 0], row_rates[k], seen[k])
        )
        out[i] = rotation(-(boot_s[i] - begin_s) * 0.5 * (rate + rate_b_rads[i])) @ attitude
    return out, valid


def lagged(m: Moved, lag_s: float) -> Floats:
    """Attitude at the times the magnetometer means, (N, 3, 3)."""
    turned: Floats = Rotation.from_rotvec(lag_s * m.rate_b_rads).as_matrix() @ m.body_from_room
    return turned


def room(undisturbed: Moved) -> Room:
    """The room's field from a recording without a magnet."""
    mag = undisturbed.mag_b_mg[undisturbed.valid]

    def fitted(lag_s: float) -> tuple[Floats, float]:
        turned = lagged(undisturbed, lag_s)[undisturbed.valid]
        design = np.concatenate([turned, np.broadcast_to(np.eye(3), turned.shape)], axis=2).reshape(-1, 6)
        x = np.linalg.lstsq(design, mag.reshape(-1), rcond=None)[0]
        return x, float(np.sqrt(np.mean((design @ x - mag.reshape(-1)) ** 2)))

    lag_s = float(minimize_scalar(lambda t: fitted(t)[1], bounds=(-0.05, 0.1), method="bounded").x)
    x, rms_mg = fitted(lag_s)
    return Room(x[:3], x[3:], lag_s, rms_mg)


def truth(moved: Moved, r: Room, with_magnet: bool) -> Truth:
    """When a magnet came and went, and the iron without it and with it."""
    t, attitude = moved.boot_s, lagged(moved, r.lag_s)
    field = attitude @ r.field_n_mg
    left = moved.mag_b_mg - field
    spinning = moved.valid & (np.linalg.norm(moved.rate_b_rads, axis=1) > _MOVING_RADS)
    nothing = np.zeros(len(t), dtype=bool)
    if not with_magnet:
        (iron,) = _irons(field, moved.mag_b_mg, [spinning])
        return Truth(moved, r, None, iron, None, spinning, nothing)
    up, down = _steps(t[moved.valid], left[moved.valid])
    on = (t > up + _APART_S) & (t < down - _APART_S)
    away = (t < up - _APART_S) | (t > down + _APART_S)
    iron, its = _irons(field, moved.mag_b_mg, [spinning & away, spinning & on])
    step = its.offset_b_mg - iron.offset_b_mg
    tolerance = _ODD_MG + _ODD_SHARE * float(np.linalg.norm(step))
    smooth = _smoothed(t, left)
    from_without, from_with = (np.linalg.norm(smooth - x.offset_b_mg, axis=1) > tolerance for x in (iron, its))
    a = _last(t, ~from_without & (t < up + _APART_S))
    b = _first_held(t, ~from_with & (t > a))
    c = _last(t, ~from_with & (t < down + _APART_S))
    d = _first_held(t, ~from_without & (t > c))
    odd = np.where((t > 0.5 * (a + b)) & (t < 0.5 * (c + d)), from_with, from_without)
    odd &= moved.valid
    odd |= ((t >= a) & (t <= b)) | ((t >= c) & (t <= d))
    return Truth(moved, r, Magnet((a, b), (c, d)), iron, its, spinning, odd)


def _irons(field: Floats, mag: Floats, stretches: list[Flags]) -> list[Iron]:
    """Iron in each stretch, from body fields (N, 3) and readings; soft iron is the same in all.

    mag = (1 + G) field + hard. Only the symmetric part of G is iron: the rest is how the sensor sits in the frame that
    the optics saw, and no calibration of the compass tells it from heading.
    """
    count = len(stretches)
    designs, values = [], []
    for k, some in enumerate(stretches):
        which = np.zeros((int(some.sum()), count))
        which[:, k] = 1.0
        designs.append(np.concatenate([field[some], which], axis=1))
        values.append(mag[some] - field[some])
    fit = np.linalg.lstsq(np.concatenate(designs), np.concatenate(values), rcond=None)[0]
    g = fit[:3].T
    return [
        Iron((mag[some] - field[some]).mean(0), fit[3 + k], np.eye(3) + 0.5 * (g + g.T))
        for k, some in enumerate(stretches)
    ]


def _steps(t: Floats, left_mg: Floats) -> tuple[float, float]:
    """Roughly when a magnet came and went: two steps between two levels, least squares on means over a second."""
    number = ((t - t[0]) / _BIN_S).astype(int)
    bins = np.unique(number)
    mean = np.array([left_mg[number == n].mean(0) for n in bins])
    at = t[0] + (bins + 0.5) * _BIN_S

    def misfit(up: int, down: int) -> float:
        on = np.zeros(len(at), dtype=bool)
        on[up:down] = True
        spread = [((mean[some] - mean[some].mean(0)) ** 2).sum() for some in (on, ~on)]
        return float(sum(spread))

    count, least = len(at), round(10.0 / _BIN_S)
    _, up, down = min((misfit(u, v), u, v) for u in range(5, count - 5) for v in range(u + least, count - 5))
    return float(at[up]), float(at[down])


def _smoothed(t: Floats, values: Floats) -> Floats:
    """Means over the 0.4 s around each time, (N, 3)."""
    lo, hi = np.searchsorted(t, t - 0.2), np.searchsorted(t, t + 0.2)
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(values, axis=0)])
    out: Floats = (total[hi] - total[lo]) / (hi - lo)[:, None]
    return out


def _last(t: Floats, flags: Flags) -> float:
    """The last time at which it holds."""
    return float(t[np.flatnonzero(flags)[-1]])


def _first_held(t: Floats, flags: Flags) -> float:
    """The first time from which it holds for a second."""
    bad = np.flatnonzero(~flags)
    for i in np.flatnonzero(flags):
        later = bad[bad > i]
        if len(later) == 0 or t[later[0]] - t[i] > 1.0:
            return float(t[i])
    return math.inf
