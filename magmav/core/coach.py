"""The motion that would teach most next, from the doubt that is left, in at most 50 characters.

In the levelled-field model a reading is z = b + C h: hard iron, and the Earth's field turned into body axes. The sum at
the present attitude is what every reading shows, so it is known; only how it divides is not. Whatever error e is left
in b is made up for in h, and at an attitude turned by D from the present one the reading is off by

    (I - D) e,        so that attitude tells (I - D)' (I - D) / r^2 of b

which is 2 (1 - cos s) (I - a a') / r^2 for a turn by s about the axis a.

A motion's worth is the sum over the attitudes it passes through. Every motion gets the same time, so the one that
leaves the least doubt in the worst axis is also the fastest. What no motion of this kind of vehicle could show is not
asked for.

Which axes count is the gate's to say: as long as it wants a better heading, or a forward or right axis, the down axis
waits, for without it a compass may be ready all the same. Of few headings the gate believes no sigma, however small, so
then a small one is no reason to be silent.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magmav.core import gate
from magmav.core.rotation import body_from_earth
from magmav.core.types import Estimate, Reason, State, Verdict

Array = NDArray[np.float64]

LONGEST = 50  # characters of a STATUSTEXT
_READING_MG = 8.0  # of one second: mostly tilt error, which does not average out faster
_SECONDS = 12
_HELPS = 0.9  # a motion that leaves more than this share of a sigma is not worth asking for
_TIE = 1.01
_LEVEL = frozenset({Reason.X_NOT_OBSERVED, Reason.Y_NOT_OBSERVED, Reason.HEADING_UNSURE})

_PLANE = frozenset({1})
_ROTARY = frozenset({2, 3, 4, 13, 14, 15, 29, 35})  # copters of 1 to 12 rotors
_VTOL = frozenset({19, 20, 21, 22, 23, 24, 25})
_SUBMARINE = frozenset({12})


@dataclass(frozen=True, slots=True)
class Motion:
    """One thing to ask for: roll and pitch to go to, and how far to turn, degrees.

    to_roll, to_pitch : None stays as it is. back_and_forth : bank one way, then the other.
    """

    text: str
    turn_deg: float = 0.0
    to_roll_deg: float | None = None
    to_pitch_deg: float | None = None
    back_and_forth: bool = False


_YAWS = tuple(
    Motion(f"yaw {side} {deg} degrees", sign * deg)
    for deg in (180, 120, 60)
    for side, sign in (("right", 1.0), ("left", -1.0))
)
_TILTS = (
    Motion("bank 15 degrees right", to_roll_deg=15.0),
    Motion("bank 15 degrees left", to_roll_deg=-15.0),
    Motion("pitch up 10 degrees", to_pitch_deg=10.0),
    Motion("pitch down 10 degrees", to_pitch_deg=-10.0),
)
_TURNS = (
    Motion("turn right 180 degrees, 30 of bank", 180.0, to_roll_deg=30.0),
    Motion("turn left 180 degrees, 30 of bank", -180.0, to_roll_deg=-30.0),
    Motion("turn right 90 degrees, 20 of bank", 90.0, to_roll_deg=20.0),
    Motion("turn left 90 degrees, 20 of bank", -90.0, to_roll_deg=-20.0),
    Motion("fly a figure eight", 240.0, to_roll_deg=30.0, back_and_forth=True),
    Motion("bank 30 degrees left and right", 0.0, to_roll_deg=30.0, back_and_forth=True),
    Motion("climb 10 degrees", to_pitch_deg=10.0),
)


def motions(kind: int | None) -> tuple[Motion, ...]:
    """What a vehicle of this MAV_TYPE can do. Of one that is not known only level turns are asked."""
    if kind in _PLANE:
        return _TURNS
    if kind in _VTOL:
        return (*_YAWS, *_TURNS)
    if kind in _ROTARY or kind in _SUBMARINE:
        return (*_YAWS, *_TILTS)
    return _YAWS


def attitudes(m: Motion, roll_rad: float, pitch_rad: float) -> list[Array]:
    """The attitudes a motion passes through, one a second for _SECONDS: rotations (3, 3) from level to body axes.

    A tilt or a turn takes the first half and is held for the second; back and forth needs all the time.
    """
    out = []
    for second in range(1, _SECONDS + 1):
        way = min(2.0 * second / _SECONDS, 1.0)
        roll = roll_rad if m.to_roll_deg is None else roll_rad + way * (math.radians(m.to_roll_deg) - roll_rad)
        pitch = pitch_rad if m.to_pitch_deg is None else pitch_rad + way * (math.radians(m.to_pitch_deg) - pitch_rad)
        yaw = way * math.radians(m.turn_deg)
        if m.back_and_forth:
            through = 2.0 * math.pi * second / _SECONDS
            roll = math.radians(m.to_roll_deg or 0.0) * math.sin(through)
            yaw = math.radians(m.turn_deg) * 0.5 * (1.0 - math.cos(through))
        out.append(body_from_earth(roll, pitch, yaw))
    return out


def sigma_after(m: Motion, covariance_mg2: Array, roll_rad: float, pitch_rad: float) -> Array:
    """(3,) mG: one sigma of each axis of the hard iron once the motion is done, from its covariance before."""
    now = body_from_earth(roll_rad, pitch_rad, 0.0)
    information = np.zeros((3, 3))
    for then in attitudes(m, roll_rad, pitch_rad):
        seen = np.eye(3) - then @ now.T
        information += seen.T @ seen / _READING_MG**2
    left = covariance_mg2 @ np.linalg.inv(np.eye(3) + information @ covariance_mg2)
    out: Array = np.sqrt(np.maximum(np.diag(left), 0.0))
    return out


def advise(
    e: Estimate,
    roll_rad: float,
    pitch_rad: float,
    heading_rad: float | None,
    kind: int | None,
    limit_mg: float = 10.0,
    reasons: Collection[Reason] = (),
) -> str:
    """The motion that would shrink the worst sigma most, at most LONGEST characters; "" where nothing need be done.

    kind : MAV_TYPE, None where it is not known. limit_mg : the gate's line; an axis under it needs nothing. reasons :
    the verdict's; where one of them is about heading or a level axis, only those two axes count, the line does not.
    The advice is relative, so heading_rad (None where unknown) changes nothing: turning is worth the same from any
    heading.
    """
    before = np.asarray(gate.floored(e))
    axes, limit_mg = ((0, 1), 0.0) if _LEVEL.intersection(reasons) else ((0, 1, 2), limit_mg)
    wanted = [i for i in axes if before[i] > limit_mg and e.says_b[i]]
    if not wanted:
        return ""
    own = np.sqrt(np.maximum(np.diag(e.covariance_mg2), 1e-12))
    after = [(m, sigma_after(m, e.covariance_mg2, roll_rad, pitch_rad)) for m in motions(kind)]
    wanted = [i for i in wanted if any(left[i] < _HELPS * own[i] for _, left in after)]
    if not wanted:
        return ""
    worst = max(wanted, key=lambda i: float(before[i]))
    least = min(left[worst] for _, left in after)
    after = [(m, left) for m, left in after if left[worst] <= _TIE * least]
    # As good for the worst axis: the one that is best for all, and of those the first.
    least = min(float(np.linalg.norm(left[wanted])) for _, left in after)
    return next(m.text for m, left in after if float(np.linalg.norm(left[wanted])) <= _TIE * least)


_HINTS = {
    Reason.NO_COMPASS: "check that compass messages come in",
    Reason.NOT_FLYING: "take off: the ground teaches nothing",
    Reason.FROZEN: "compass is stuck: power it off and on",
    Reason.FIELD_NOT_EARTHLIKE: "look for magnet or steel near the compass",
    Reason.RESIDUAL_TOO_LARGE: "check mount, wires and motor currents",
    Reason.MOUNTING_WRONG: "set the orientation of the compass right",
    Reason.SCALE_WRONG: "set the scale of the compass right",
    Reason.JUST_CHANGED: "keep moving: the iron has just changed",
    Reason.RELATIVE_ONLY: "let the autopilot send its parameters",
    Reason.X_NOT_OBSERVED: "turn a full circle",
    Reason.Y_NOT_OBSERVED: "turn a full circle",
    Reason.HEADING_UNSURE: "turn through more headings",
    Reason.TOO_LITTLE_DATA: "keep moving: too little data yet",
    Reason.STILL_MOVING: "keep moving: not settled yet",
}


def next_step(verdict: Verdict, advice: str) -> str:
    """What to do next in any state but READY (then ""), at most LONGEST characters.

    What no motion heals comes first, then the advice, then the rest.
    """
    if verdict.state is State.READY:
        return ""
    hints = [_HINTS[r] for r in _HINTS if r in verdict.reasons]
    if verdict.state is not State.LEARNING or Reason.NOT_FLYING in verdict.reasons:
        return hints[0] if hints else "see the reasons"
    return advice or (hints[0] if hints else "keep moving: turn, then bank")
