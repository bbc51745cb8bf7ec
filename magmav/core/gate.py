"""May this estimate be written to a vehicle? The one place that decides, and it always says why.

An axis counts as OBSERVED when motion alone has brought its sigma under the line, FROM_MODEL when it needed the field
model for that, else NOT_OBSERVED. READY wants the forward and right axes known, a field like the Earth's, a fit
without structure, an estimate that stands still, and stored values that are known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from magmav.core.field import ExpectedField
from magmav.core.types import AxisState, Estimate, Reason, State, Vec3, Verdict

_WEAK_HORIZONTAL_MG = 100.0
_EARTH_MG = (150.0, 950.0)
_EARTH_LEVEL_MG = (_WEAK_HORIZONTAL_MG / 2.0, 450.0)  # horizontally, all that two axes show without a position
_FROZEN_S = 3.0
_SLACK = 1.25  # a verdict once reached is kept until a line is crossed by this much: no flicker
_HEADING_SECTORS = 3
_APART, _APART_BLIND = 4.0, 2.2  # sigmas between two opinions; closer where no field model ties either of them down
_STRANGE_NIS = 5.0  # over the last second: something is going on that no estimate has caught up with


@dataclass(frozen=True, slots=True)
class Limits:
    """Lines an estimate must keep; values come from the settings table."""

    axis_sigma_mg: float
    heading_sigma_rad: float
    residual_mg: float
    field_share: float
    change_s: float
    samples: int


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Everything a verdict rests on, for one compass at one moment."""

    estimate: Estimate | None
    expected: ExpectedField | None
    sigma_mg: Vec3
    offsets_heading_sigma_rad: float
    field_mg: float  # mean strength after correction
    level_mg: float  # and of its horizontal part
    steady: bool
    sectors: int
    frozen_s: float
    has_attitude: bool
    relative: bool
    assumed: bool
    parameters_changed: bool
    grounded: bool  # a flying vehicle that has not flown yet, and nobody said that the bench will do
    apart: float = 0.0  # sigmas between two opinions, as they lately were
    left_mg: float = 0.0  # level field that a down axis not written leaves wrong, at the tilt flown
    worse: bool = False  # the readings fit worse than they lately did
    axes: int = 3  # 2: the third component of the field comes from the dip, or is missing without a position


_Z_NOTE: dict[AxisState, tuple[Reason, ...]] = {
    AxisState.OBSERVED: (),
    AxisState.FROM_MODEL: (Reason.Z_FROM_MODEL,),
    AxisState.NOT_OBSERVED: (Reason.Z_NOT_OBSERVED,),
}
NOTHING = Verdict(State.NO_DATA, (AxisState.NOT_OBSERVED,) * 3, (Reason.NO_COMPASS,))


def axis_states(own_sigma_mg: Vec3, sigma_mg: Vec3, limit_mg: float) -> tuple[AxisState, AxisState, AxisState]:
    """State of each axis from its sigma by motion alone and with the model."""
    both = zip(own_sigma_mg.tolist(), sigma_mg.tolist(), strict=True)
    x, y, z = [_axis_state(own, all_in, limit_mg) for own, all_in in both]
    return x, y, z


def _axis_state(own_mg: float, all_in_mg: float, limit_mg: float) -> AxisState:
    if own_mg <= limit_mg:
        return AxisState.OBSERVED
    return AxisState.FROM_MODEL if all_in_mg <= limit_mg else AxisState.NOT_OBSERVED


def judge(e: Evidence, limits: Limits, was: State) -> Verdict:
    """The verdict. ``was`` is the state before: READY is left a little later than it was entered."""
    if e.estimate is None:
        reason = Reason.NOT_FLYING if e.grounded else Reason.TOO_LITTLE_DATA
        relative = (Reason.RELATIVE_ONLY,) if e.relative else ()
        return Verdict(State.LEARNING, NOTHING.axes, (reason, *relative, *_notes(e)))
    slack = _SLACK if was is State.READY else 1.0
    axes = axis_states(e.estimate.own_sigma_mg, e.sigma_mg, limits.axis_sigma_mg)
    notes = (_Z_NOTE[axes[2]] if e.axes == 3 else (Reason.TWO_AXES,)) + _notes(e)
    wrong = _wrong(e, e.estimate, axes, limits, slack)
    missing = _missing(e, e.estimate, axes, limits, slack)
    if wrong:
        return Verdict(State.REFUSED, axes, wrong + missing + notes)
    if missing:
        return Verdict(State.LEARNING, axes, tuple(dict.fromkeys(missing + notes)))
    return Verdict(State.READY, axes, notes)


def _wrong(
    e: Evidence, estimate: Estimate, axes: tuple[AxisState, ...], limits: Limits, slack: float
) -> tuple[Reason, ...]:
    """Findings that more data will not heal."""
    out = []
    if e.frozen_s > _FROZEN_S:
        out.append(Reason.FROZEN)
    earthlike = _earthlike(e, axes[2] is not AxisState.NOT_OBSERVED, limits.field_share * slack)
    if not earthlike and estimate.samples >= limits.samples:
        out.append(Reason.FIELD_NOT_EARTHLIKE)
    if estimate.residual_mg > limits.residual_mg * slack and estimate.samples >= limits.samples:
        out.append(Reason.RESIDUAL_TOO_LARGE)
    return tuple(out)


def _earthlike(e: Evidence, down_known: bool, share: float) -> bool:
    """Is the corrected field as strong as the Earth's? Where the down axis is not known, only its horizontal part."""
    if e.expected is not None:
        off = e.field_mg - e.expected.total_mg if down_known or e.axes == 2 else e.level_mg - e.expected.horizontal_mg
        return abs(off) <= share * e.expected.total_mg
    least, most = _EARTH_MG if down_known else _EARTH_LEVEL_MG
    return least <= (e.field_mg if down_known else e.level_mg) <= most


def _missing(
    e: Evidence, estimate: Estimate, axes: tuple[AxisState, ...], limits: Limits, slack: float
) -> tuple[Reason, ...]:
    """What more flying, or more knowledge of the vehicle, would bring."""
    out = []
    if e.grounded:  # what was learnt in somebody's hands is an answer, but nothing to write unless asked (--bench)
        out.append(Reason.NOT_FLYING)
    if estimate.samples < limits.samples:
        out.append(Reason.TOO_LITTLE_DATA)
    names = (Reason.X_NOT_OBSERVED, Reason.Y_NOT_OBSERVED)
    out += [n for n, axis in zip(names, axes, strict=False) if axis is AxisState.NOT_OBSERVED]
    if e.offsets_heading_sigma_rad > limits.heading_sigma_rad * slack or e.sectors < _HEADING_SECTORS:
        out.append(Reason.HEADING_UNSURE)
    if e.apart > (_APART_BLIND if e.expected is None else _APART) * slack:
        out.append(Reason.OPINIONS_DIFFER)
    if estimate.changed_ago_s < limits.change_s or estimate.step_nis > _STRANGE_NIS or e.worse:
        out.append(Reason.JUST_CHANGED)
    if not e.steady:
        out.append(Reason.STILL_MOVING)
    if e.relative:
        out.append(Reason.RELATIVE_ONLY)
    if not out and e.left_mg > limits.heading_sigma_rad * slack * _horizontal(e, estimate):
        out.append(Reason.Z_NOT_OBSERVED)
    return tuple(out)


def _horizontal(e: Evidence, estimate: Estimate) -> float:
    return estimate.horizontal_mg if e.expected is None else e.expected.horizontal_mg


def _notes(e: Evidence) -> tuple[Reason, ...]:
    """What a reader must know even where nothing is refused."""
    out = []
    if e.expected is None:
        out.append(Reason.NO_POSITION)
    elif e.expected.horizontal_mg < _WEAK_HORIZONTAL_MG:
        out.append(Reason.HORIZONTAL_WEAK)
    if not e.has_attitude:
        out.append(Reason.NO_ATTITUDE)
    if e.assumed:
        out.append(Reason.ASSUMED_DEFAULT)
    if e.parameters_changed:
        out.append(Reason.PARAMETERS_CHANGED)
    return tuple(out)


def floored(estimate: Estimate) -> Vec3:
    """Claimed sigma per axis, mG: never under what no field test has ever shown (estimation.md, upload rule)."""
    variances = estimate.covariance_mg2.diagonal().tolist()
    own = [math.hypot(math.sqrt(max(v, 0.0)), f) for v, f in zip(variances, estimate.floor_mg, strict=True)]
    out = np.array(own)
    out.setflags(write=False)
    return out
