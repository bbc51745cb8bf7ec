"""How good is a heading: against a named reference, on which samples, and how many were left out and why.

Numbers that are compared with one another are made on the same samples. Every sample is either scored or
counted under the first exclusion that holds for it, so ``n`` and the counts add up to what was given.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magmav.core.types import IDENTITY3, ZERO3
from magmav.reference import Attitude, Flags, Floats, Reference, TruthError, shortest_rad

__all__ = [
    "EVERYTHING",
    "Calibration",
    "HeadingScore",
    "Reference",
    "TruthError",
    "Window",
    "crash_s",
    "heading_error_rad",
    "magnetic_heading_rad",
    "score_field",
    "score_freeze",
    "score_heading",
    "score_headings",
    "shortest_rad",
]

CRASH_S = 3.0  # tilted beyond the limit for longer than this in flight: it will not fly on as before


@dataclass(frozen=True, slots=True)
class HeadingScore:
    """Heading error against ``reference``, degrees: RMS about zero, 95th percentile of size, circular mean.

    from_s and to_s are the boot times of the first and last scored sample. Where n is 0 the numbers are None.
    """

    reference: str
    rms_deg: float | None
    p95_deg: float | None
    bias_deg: float | None
    n: int
    from_s: float | None
    to_s: float | None
    excluded: dict[str, int]


class Window(NamedTuple):
    """Which samples count: boot times from_s <= t <= to_s, before crash_s, tilted no more than tilt_deg."""

    from_s: float = -math.inf
    to_s: float = math.inf
    crash_s: float = math.inf
    tilt_deg: float = 60.0


EVERYTHING = Window()


class Calibration(NamedTuple):
    """truth = matrix @ (sensor - hard iron). The hard iron is (3,), or (N, 3) where it follows current.

    down_mg : for a two-axis compass, the Earth's downward field that its third axis is reckoned from.
    """

    hard_iron_b_mg: ArrayLike = ZERO3
    matrix: ArrayLike = IDENTITY3
    down_mg: float | None = None


def magnetic_heading_rad(field_b_mg: ArrayLike, roll_rad: ArrayLike, pitch_rad: ArrayLike) -> Floats:
    """Tilt-compensated magnetic heading, (N,) rad in [-pi, pi], of body vectors (N, 3) at (N,) tilts.

    With the tilt undone the level field points ahead hx and to the right hy (Sawicki 2017 eq. 6,
    seed-methods.md S1); north lies at -heading from the nose, so heading = atan2(-hy, hx).
    """
    field, roll, pitch = _vectors(field_b_mg, "field_b_mg"), np.asarray(roll_rad), np.asarray(pitch_rad)
    mx, my, mz = field.T
    ahead = mx * np.cos(pitch) + np.sin(pitch) * (my * np.sin(roll) + mz * np.cos(roll))
    right = my * np.cos(roll) - mz * np.sin(roll)
    return np.asarray(np.arctan2(-right, ahead), dtype=np.float64)


def with_third_axis(field_b_mg: Floats, roll_rad: Floats, pitch_rad: Floats, down_mg: float) -> Floats:
    """Body fields (N, 3) with z as the dip demands it at (N,) tilts (Sytnyk et al. 2014, Z_ES)."""
    x, y, _ = field_b_mg.T
    level = np.cos(pitch_rad) * np.cos(roll_rad)
    z = (down_mg + x * np.sin(pitch_rad) - y * np.cos(pitch_rad) * np.sin(roll_rad)) / level
    return np.column_stack([x, y, z])


def heading_error_rad(boot_s: ArrayLike, heading_true_rad: ArrayLike, reference: Reference) -> Floats:
    """Heading minus reference, (N,) rad in [-pi, pi); NaN where either is not known."""
    return shortest_rad(np.asarray(heading_true_rad) - reference.interpolate(boot_s).yaw_true_rad)


def crash_s(reference: Reference, tilt_deg: float = 60.0) -> float | None:
    """Boot time of the first tilt beyond tilt_deg that outlasts CRASH_S while armed and airborne, or None.

    Only a vehicle that said it was flying can crash: a sensor turned over by hand has not.
    """
    if not reference.phases_known:
        return None
    over = _tilted(reference.roll_rad, reference.pitch_rad, tilt_deg) & reference.armed & reference.airborne
    edge = np.diff(np.concatenate(([0], over.astype(np.int8), [0])))
    starts, ends = np.flatnonzero(edge == 1), np.flatnonzero(edge == -1) - 1
    lasted = reference.boot_s[ends] - reference.boot_s[starts] > CRASH_S
    return float(reference.boot_s[starts[lasted][0]]) if lasted.any() else None


def score_headings(
    boot_s: ArrayLike,
    headings_true_rad: Mapping[str, ArrayLike],
    reference: Reference,
    window: Window = EVERYTHING,
    leave_out: Mapping[str, ArrayLike] | None = None,
) -> dict[str, HeadingScore]:
    """Scores of several headings, each (N,) rad and NaN where none was published, on the same samples.

    leave_out : more exclusions by name, each (N,) true where the sample does not count.
    """
    times = np.asarray(boot_s, dtype=np.float64)
    headings = {name: np.asarray(value, dtype=np.float64) for name, value in headings_true_rad.items()}
    for name, value in headings.items():
        if value.shape != times.shape:
            raise ValueError(f"{name}: want one heading per time, {times.shape}, got {value.shape}")
    at = reference.interpolate(times)
    left_out = _exclusions(times, at, window)
    for name, flags in (leave_out or {}).items():
        left_out[name] = np.broadcast_to(np.asarray(flags, dtype=bool), times.shape)
    unheard = np.any([~np.isfinite(h) for h in headings.values()], axis=0)
    left_out["no heading"] = unheard | left_out.get("no heading", False)
    keep, excluded = _count(left_out, len(times))
    return {
        name: _score(times[keep], shortest_rad(value[keep] - at.yaw_true_rad[keep]), reference.name, excluded)
        for name, value in headings.items()
    }


def score_heading(
    boot_s: ArrayLike,
    heading_true_rad: ArrayLike,
    reference: Reference,
    window: Window = EVERYTHING,
    leave_out: Mapping[str, ArrayLike] | None = None,
) -> HeadingScore:
    """Score of one heading, (N,) rad, true north."""
    return score_headings(boot_s, {"heading_true_rad": heading_true_rad}, reference, window, leave_out)[
        "heading_true_rad"
    ]


def score_field(
    boot_s: ArrayLike,
    field_b_mg: ArrayLike,
    declination_rad: ArrayLike,
    reference: Reference,
    window: Window = EVERYTHING,
    leave_out: Mapping[str, ArrayLike] | None = None,
) -> HeadingScore:
    """Score of corrected body fields (N, 3) mG, made into headings with the reference's own tilt."""
    at = reference.interpolate(boot_s)
    heading = magnetic_heading_rad(field_b_mg, at.roll_rad, at.pitch_rad) + np.asarray(declination_rad)
    # Without a reference there is no tilt either; call that missing reference, not missing heading.
    heading = np.where(at.valid, heading, 0.0)
    return score_heading(boot_s, heading, reference, window, leave_out)


def score_freeze(
    boot_s: ArrayLike,
    mag_b_mg: ArrayLike,
    calibrations: Mapping[str, Calibration],
    declination_rad: ArrayLike,
    reference: Reference,
    window: Window = EVERYTHING,
    leave_out: Mapping[str, ArrayLike] | None = None,
    uncalibrated: Calibration | None = None,
) -> dict[str, HeadingScore]:
    """Scores of frozen calibrations, and "uncalibrated", applied to the sensor's own field (N, 3) mG.

    Declination is scalar or (N,), rad. All are scored on the same samples with the reference's tilt.
    """
    raw, at = _vectors(mag_b_mg, "mag_b_mg"), reference.interpolate(boot_s)
    headings: dict[str, Floats] = {}
    for name, (hard_iron, matrix, down_mg) in {"uncalibrated": uncalibrated or Calibration(), **calibrations}.items():
        offset, shape = np.asarray(hard_iron, dtype=np.float64), np.asarray(matrix, dtype=np.float64)
        if offset.shape not in ((3,), raw.shape) or shape.shape != (3, 3):
            raise ValueError(f"{name}: want hard iron (3,) or {raw.shape} and a (3, 3) matrix")
        field = (raw - offset) @ shape.T
        if down_mg is not None:
            field = with_third_axis(field, at.roll_rad, at.pitch_rad, down_mg)
        heading = magnetic_heading_rad(field, at.roll_rad, at.pitch_rad)
        headings[name] = np.where(at.valid, heading + np.asarray(declination_rad), 0.0)
    return score_headings(boot_s, headings, reference, window, leave_out)


def _exclusions(times: Floats, at: Attitude, window: Window) -> dict[str, Flags]:
    return {
        "outside window": ~((times >= window.from_s) & (times <= window.to_s)),
        "after crash": times >= window.crash_s,
        "no reference": ~at.valid,
        "disarmed": ~at.armed,
        "not airborne": ~at.airborne,
        f"tilt over {window.tilt_deg:g} deg": _tilted(at.roll_rad, at.pitch_rad, window.tilt_deg),
    }


def _count(left_out: Mapping[str, Flags], total: int) -> tuple[Flags, dict[str, int]]:
    """What remains, and how many each exclusion took; the first that holds is the one that counts."""
    keep = np.ones(total, dtype=bool)
    counts: dict[str, int] = {}
    for name, flags in left_out.items():
        taken = int(np.count_nonzero(keep & flags))
        if taken:
            counts[name] = taken
        keep &= ~flags
    return keep, counts


def _score(times: Floats, error_rad: Floats, name: str, excluded: dict[str, int]) -> HeadingScore:
    if len(times) == 0:
        return HeadingScore(name, None, None, None, 0, None, None, dict(excluded))
    error_deg = np.degrees(error_rad)
    return HeadingScore(
        reference=name,
        rms_deg=float(np.sqrt(np.mean(error_deg**2))),
        p95_deg=float(np.percentile(np.abs(error_deg), 95.0)),
        bias_deg=math.degrees(math.atan2(float(np.mean(np.sin(error_rad))), float(np.mean(np.cos(error_rad))))),
        n=len(times),
        from_s=float(times.min()),
        to_s=float(times.max()),
        excluded=dict(excluded),
    )


def _tilted(roll_rad: Floats, pitch_rad: Floats, tilt_deg: float) -> Flags:
    return np.asarray(np.cos(roll_rad) * np.cos(pitch_rad) < math.cos(math.radians(tilt_deg)), dtype=bool)


def _vectors(value: ArrayLike, name: str) -> NDArray[np.float64]:
    out = np.asarray(value, dtype=np.float64)
    if out.ndim != 2 or out.shape[1] != 3:
        raise ValueError(f"{name}: want shape (N, 3), got {out.shape}")
    return out
