"""What a report draws: a flight as some hundred points, and the directions of the field that were seen."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magmav.comparison import Columns
from magmav.core.after_flight import AfterFlight
from magmav.reference import Reference
from magmav.score import magnetic_heading_rad

Floats = NDArray[np.float64]
Result = dict[str, Any]
POINTS = 600
DIRECTIONS = 60
_GOLDEN = math.pi * (3.0 - math.sqrt(5.0))


def rounded(values: Floats, digits: int = 2) -> list[Any]:
    """Numbers for JSON; NaN becomes None."""
    flat = np.round(np.asarray(values, dtype=np.float64), digits) + 0.0
    return [
        rounded(row, digits) if isinstance(row, np.ndarray) else (float(row) if math.isfinite(row) else None)
        for row in flat
    ]


def directions() -> Floats:
    """(DIRECTIONS, 3) unit vectors, about evenly over the sphere (Fibonacci lattice)."""
    n = np.arange(DIRECTIONS)
    down = 1.0 - (2.0 * n + 1.0) / DIRECTIONS
    level = np.sqrt(1.0 - down**2)
    return np.column_stack([level * np.cos(n * _GOLDEN), level * np.sin(n * _GOLDEN), down])


def coverage(field_b_mg: Floats) -> Result:
    """Directions of the corrected field (N, 3) in body axes, and how many samples are nearest to each."""
    there = directions()
    length = np.linalg.norm(field_b_mg, axis=1, keepdims=True)
    unit = field_b_mg / np.maximum(length, 1e-9)
    counts = np.bincount(np.argmax(unit @ there.T, axis=1), minlength=DIRECTIONS) if len(unit) else np.zeros(DIRECTIONS)
    rows = [
        {
            "azimuth_deg": round(math.degrees(math.atan2(y, x)) % 360.0, 1),
            "elevation_deg": round(math.degrees(math.asin(z)), 1),
            "n": int(n),
        }
        for (x, y, z), n in zip(there.tolist(), counts.tolist(), strict=True)
    ]
    return {"directions": rows, "share": round(float(np.count_nonzero(counts)) / DIRECTIONS, 3)}


def series(
    c: Columns,
    before_b_mg: Floats | None,
    after_b_mg: Floats,
    known: AfterFlight,
    reference: Reference | None,
    ampere: Floats | None,
    model_mg: Floats,
) -> Result:
    """At most POINTS moments of the whole tape, and of the offsets over time.

    before_b_mg, after_b_mg : (N, 3) corrected fields. model_mg : (N,) the world model's strength, NaN unknown.
    """
    thin = _thin(len(c.boot_s))
    declination = np.where(np.isfinite(c.declination_rad), c.declination_rad, 0.0)
    heading = magnetic_heading_rad(after_b_mg, c.roll_rad, c.pitch_rad) + declination
    at = None if reference is None else reference.interpolate(c.boot_s[thin])
    few = _thin(len(known.boot_ns))
    moments = [known.estimates[i] for i in few]
    return {
        "t_s": rounded(c.boot_s[thin], 3),
        "field_before_mg": None if before_b_mg is None else rounded(np.linalg.norm(before_b_mg[thin], axis=1)),
        "field_after_mg": rounded(np.linalg.norm(after_b_mg[thin], axis=1)),
        "model_mg": rounded(model_mg[thin]) if np.isfinite(model_mg).any() else None,
        "current_a": None if ampere is None else rounded(ampere[thin], 3),
        "throttle": rounded(c.throttle[thin], 3) if np.isfinite(c.throttle).any() else None,
        "offsets_t_s": rounded(known.boot_ns[few] / 1e9, 3),
        "offsets_mg": rounded(np.array([-e.hard_iron_b_mg for e in moments])),
        "offsets_sigma_mg": rounded(np.array([np.sqrt(np.diag(e.covariance_mg2)) for e in moments])),
        "heading_deg": rounded(np.degrees(heading[thin]) % 360.0),
        "reference_deg": None if at is None else rounded(np.degrees(at.yaw_true_rad) % 360.0),
    }


def _thin(n: int) -> NDArray[np.intp]:
    return np.unique(np.linspace(0, max(n - 1, 0), min(n, POINTS)).round().astype(np.intp))
