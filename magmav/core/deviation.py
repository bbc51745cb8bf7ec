"""The deviation card: by how much a compass's heading is off, on eight headings of a level vehicle.

A level vehicle on magnetic heading psi meets the field F = (H cos psi, -H sin psi, V), body axes. With A and e the
autopilot's matrix and motor term, b the hard iron and S the soft iron of an estimate, truth = S (A (m - b) + e), so the
sensor shows m = b + A^-1 (S^-1 F - e), and of that stored offsets o make

    c = A (m + o) + e = S^-1 F + A (b + o),    error = atan2(-c_y, c_x) - psi = shown minus true.

Where only (x, y) = b + o is left over, tan(error) = -(y cos psi + x sin psi) / (H + x cos psi - y sin psi): the
mariner's semicircular deviation. With the full model c = F and the error is nothing but its sigma.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from magmav.core.rotation import TAU, wrap_pi
from magmav.core.types import Estimate, Mat3, Vec3

NAMES = ("N", "NE", "E", "SE", "S", "SW", "W", "NW")
_WEAKEST_MG = 20.0  # a horizontal field under this shows no heading


@dataclass(frozen=True, slots=True)
class Error:
    """Shown minus true heading and its one sigma, rad; the sigma is that of the hard iron."""

    error_rad: float
    sigma_rad: float


@dataclass(frozen=True, slots=True)
class Deviation:
    """One row: a magnetic heading, and the error on it. None where so little field is left that no heading shows."""

    name: str
    heading_rad: float
    before: Error | None  # with the stored offsets
    after: Error | None  # with the new ones
    full: Error | None  # with the soft iron as well


def deviation_card(
    e: Estimate, covariance_mg2: Mat3, matrix: Mat3, stored_b_mg: Vec3, offsets_b_mg: Vec3
) -> tuple[Deviation, ...]:
    """Eight rows, N to NW; none where the estimate has no horizontal field.

    covariance_mg2 : (3, 3) of the hard iron. matrix : (3, 3), what the autopilot multiplies with. stored_b_mg,
    offsets_b_mg : (3,) mG, added by the autopilot now, and to be added.
    """
    if not e.horizontal_mg >= _WEAKEST_MG:
        return ()
    a = np.array(matrix)
    if not e.says_b[2]:
        a[:2, 2] = 0.0  # of two axes: nothing is known of what the third would mix in
    bent, spread = np.linalg.inv(e.soft_iron_b), a @ covariance_mg2 @ a.T
    rows = []
    for i, name in enumerate(NAMES):
        psi = TAU * i / len(NAMES)
        field = np.array((e.horizontal_mg * math.cos(psi), -e.horizontal_mg * math.sin(psi), e.down_mg))
        before, after = (bent @ field + a @ (e.hard_iron_b_mg + o) for o in (stored_b_mg, offsets_b_mg))
        full = _error(field, psi, e.soft_iron_b @ spread @ e.soft_iron_b.T)
        rows.append(Deviation(name, psi, _error(before, psi, spread), _error(after, psi, spread), full))
    return tuple(rows)


def _error(field_b_mg: Vec3, psi_rad: float, covariance_mg2: Mat3) -> Error | None:
    """Of the heading this field shows: d psi = -(sin psi dx + cos psi dy) / h to first order, psi and h as shown."""
    x, y, _ = field_b_mg.tolist()
    level = math.hypot(x, y)
    if level < _WEAKEST_MG:
        return None
    across = np.array((-y, x)) / level  # (sin, cos) of the heading shown
    sigma = math.sqrt(max(float(across @ covariance_mg2[:2, :2] @ across), 0.0)) / level
    return Error(wrap_pi(math.atan2(-y, x) - psi_rad), min(sigma, math.pi))
