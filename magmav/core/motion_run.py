"""Attitudes (and accelerometer with gyro) that a recording holds one after another, taken all at once.

A flight's attitudes are most of what a recording says, and what each of them adds to turning depends on its neighbour
alone. So where a whole file is at hand that is reckoned in columns, and a stretch of it is handed on as one run. The
law: a run leaves Motion as its readings one by one would have left it (to rounding).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magmav.core.types import AttitudeReading, Reading

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]

RATES_HOLD_S = 0.25
"""Between attitudes further apart, rates say nothing of the turn: take the yaw step itself."""
_HOLD_NS = round(RATES_HOLD_S * 1e9)
_OPPOSITE = -0.99  # no run goes over what own_frame.levelled leaves alone
_UPRIGHT_RAD = 0.5 * np.pi  # beyond lies the crash watch, which looks at every attitude
_LEAST_COSINE = 0.05  # as in rotation.euler_rates_at


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeColumns:
    """N attitudes of one message in the order they came, and what they add up to.

    rate_b_rads : (N, 3), read-only.  rows : (N, 14) roll, pitch, yaw; rates of roll, pitch, yaw, rad/s; body rates;
    the own frame (w, x, y, z) as core.own_frame has it; what rates of yaw add up to from the first.
    fine : (N,) whether a run may begin there.  joined : (N,) whether it may go on there from the one before.
    """

    source: str
    boot_ns: list[int]
    rate_b_rads: Floats
    rows: Floats
    fine: Flags
    joined: Flags

    def reading(self, i: int, system: int) -> AttitudeReading:
        """One of them."""
        roll, pitch, yaw = self.rows[i, :3].tolist()
        return AttitudeReading(system, self.source, self.boot_ns[i], roll, pitch, yaw, self.rate_b_rads[i])


def attitude_columns(
    source: str, boot_ns: Ints, angles_rad: Floats, rate_b_rads: Floats, good: Flags, sender: Ints
) -> AttitudeColumns:
    """From boot times (N,), roll, pitch, yaw (N, 3), and body rates (N, 3), read-only.

    good : (N,) whether a row means anything.  sender : (N,) of which vehicle: no run goes over a change.

    What the own frame does between two of them: it is carried on by the mean of their body rates, then made level
    with the second by the shortest way. A frame that is level is the attitude's tilt after a turn about the vertical,
    and both steps act from the left, so that turn is all that adds up.
    """
    angles = np.where(good[:, None], angles_rad, 0.0)
    rates = np.where(good[:, None], rate_b_rads, 0.0)
    roll, pitch = angles[:, 0], angles[:, 1]
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    p, q, r = rates.T
    safe = np.copysign(np.maximum(np.abs(cp), _LEAST_COSINE), cp)
    turn = q * sr + r * cr
    euler = np.stack([p + turn * sp / safe, q * cr - r * sr, turn / safe], axis=1)
    down = np.stack([-sp, cp * sr, cp * cr])
    fine = good & (np.abs(roll) < _UPRIGHT_RAD) & (np.abs(pitch) < _UPRIGHT_RAD)
    step_ns = np.diff(boot_ns, prepend=boot_ns[:1])
    joined = fine & (step_ns > 0) & (step_ns <= _HOLD_NS)
    joined[1:] &= fine[:-1] & (sender[1:] == sender[:-1])
    joined[:1] = False
    dt = np.where(joined, step_ns / 1e9, 0.0)
    level, mean = _level(roll, pitch), 0.5 * (rates[1:] + rates[:-1]) * dt[1:, None]
    came, along = _levelled(_carried(level[:, :-1], mean.T), down[:, 1:])
    joined[1:] &= along > _OPPOSITE
    w, x, y, z = level[:, 1:]
    cw, cx, cy, cz = came
    half = np.zeros(len(roll))  # of the turns about the vertical, level^-1 came
    half[1:] = np.arctan2(w * cz - x * cy + y * cx - z * cw, w * cw + x * cx + y * cy + z * cz)
    half = np.cumsum(np.where(joined, half, 0.0))
    c, s = np.cos(half), np.sin(half)
    w, x, y, z = level
    frame = np.stack([w * c - z * s, x * c + y * s, y * c - x * s, w * s + z * c], axis=1)
    turned = np.zeros(len(roll))
    turned[1:] = np.cumsum(0.5 * (euler[1:, 2] + euler[:-1, 2]) * np.where(joined, dt, 0.0)[1:])
    rows = np.concatenate([angles, euler, rates, frame, turned[:, None]], axis=1)
    return AttitudeColumns(source, boot_ns.tolist(), rate_b_rads, rows, fine, joined)


def _level(roll_rad: Floats, pitch_rad: Floats) -> Floats:
    """own_frame.of_attitude at yaw 0, (4, N)."""
    cr, sr = np.cos(0.5 * roll_rad), np.sin(0.5 * roll_rad)
    cp, sp = np.cos(0.5 * pitch_rad), np.sin(0.5 * pitch_rad)
    return np.stack([cr * cp, -sr * cp, -cr * sp, sr * sp])


def _carried(frame: Floats, turn_b_rad: Floats) -> Floats:
    """own_frame.carried, (4, N), by turns (3, N)."""
    (x, y, z), (a, b, c, d) = turn_b_rad, frame
    angle = np.sqrt(x * x + y * y + z * z)
    w, by = np.cos(0.5 * angle), -0.5 * np.sinc(0.5 * angle / np.pi)
    x, y, z = by * x, by * y, by * z
    return np.stack([
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    ])  # fmt: skip


def _levelled(frame: Floats, down_b: Floats) -> tuple[Floats, Floats]:
    """own_frame.levelled, (4, N), not of length 1, and the cosine it turned by, (N,); down_b : (3, N)."""
    (w, x, y, z), (bx, by, bz) = frame, down_b
    ax, ay, az = 2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)
    along = ax * bx + ay * by + az * bz
    a, p, q, r = 1.0 + along, ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    turned = np.stack([
        a * w - p * x - q * y - r * z,
        a * x + p * w + q * z - r * y,
        a * y - p * z + q * w + r * x,
        a * z + p * y - q * x + r * w,
    ])  # fmt: skip
    return turned, along


class MotionRun(NamedTuple):
    """Attitudes ``begin`` to ``end``, at least one, each following the one before it without a break.

    first_ns, last_ns : boot times of the first and the last.
    inertial_ns : of the last two readings of accelerometer and gyro among them, the later first; -1 where there are
    fewer.  before_inertial : the attitude that was the newest when the last of those came.
    one_by_one : the same readings, each with its time of arrival.
    """

    system: int
    attitudes: AttitudeColumns
    begin: int
    end: int
    first_ns: int
    last_ns: int
    one_by_one: Callable[[], Iterator[tuple[int, Reading]]]
    inertial_ns: tuple[int, int] = (-1, -1)
    before_inertial: int = -1


def run_ends(attitudes: AttitudeColumns, attitude: Ints, inertial_ns: Ints) -> Ints:
    """(P,) for readings in the order they are to be played: where a run that begins there ends, 0 where none does.

    attitude : (P,) the row of ``attitudes`` that stands there, -1 where none does.  inertial_ns : (P,) the boot time of
    the accelerometer and gyro that stand there, -1 where none do.
    """
    here = np.arange(len(attitude))
    is_attitude, is_inertial = attitude >= 0, inertial_ns >= 0
    before = previous(is_attitude)
    known = before >= 0
    row, last = attitude[is_attitude], attitude[np.maximum(before, 0)]
    goes_on = np.zeros(len(attitude), dtype=bool)
    goes_on[is_attitude] = attitudes.joined[row] & known[is_attitude] & (last[is_attitude] == row - 1)
    # An inertial reading goes on where its attitude is fresh, and later than the one before it.
    earlier = previous(is_inertial)
    later = (earlier < 0) | (inertial_ns > inertial_ns[np.maximum(earlier, 0)])
    boot_ns = np.array([*attitudes.boot_ns, 0], dtype=np.int64)  # one more, so that -1 is a place
    away = inertial_ns - boot_ns[last]
    goes_on |= is_inertial & known & later & (np.abs(away) <= _HOLD_NS)
    breaks = np.where(goes_on, len(attitude), here)
    following = np.minimum.accumulate(breaks[::-1])[::-1]
    ends = np.zeros(len(attitude), dtype=np.int64)
    begins = is_attitude.copy()
    begins[is_attitude] = attitudes.fine[row]
    ends[:-1][begins[:-1]] = following[1:][begins[:-1]]
    ends[-1:][begins[-1:]] = len(attitude)
    return ends


def previous(flag: Flags) -> Ints:
    """(P,) the last place before each where the flag is set; -1 where none is."""
    latest = np.maximum.accumulate(np.where(flag, np.arange(len(flag)), -1))
    return np.concatenate(([-1], latest))[: len(flag)]
