"""Soft iron, scale and motor terms: only when asked, and only when the flight has earned them.

A term is earned when it is many of its own sigmas, and when, learnt from the first half alone, it makes the second half
fit better (no heading is used for that). What is not earned is not written, and says why.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magmav.core.causes_fit import GAIN, POWER, SOFT
from magmav.fitting.case import Case
from magmav.fitting.why import Batch

Floats = NDArray[np.float64]
_SOFT_CHI2, _SOFT_LEAST = 35.0, 0.01
_SCALE_SIGMAS, _SCALE_LEAST = 4.0, 0.02
_BETTER = 0.97  # of the misfit of the second half


@dataclass(frozen=True, slots=True, eq=False)
class Terms:
    """truth = bend @ (A (sensor - iron) + e - per_unit * power), the iron then that of zero power.

    bend : (3, 3), soft iron and scale in one.  per_unit_mg : (3,) mG in body axes, as the stored matrix leaves it.
    """

    bend: Floats
    per_unit_mg: Floats
    of: str | None
    soft: dict[str, Any] | None
    scale: dict[str, Any] | None
    motor: dict[str, Any] | None

    @property
    def shapes(self) -> bool:
        """Does anything change but the offsets?"""
        return bool(np.any(self.bend != np.eye(3)) or self.of)


def unearned(t: Terms, why: str) -> Terms:
    """The same with nothing to be written, and why."""
    parts = [p if p is None or not p["earned"] else p | {"earned": False, "evidence": f"{p['evidence']}; {why}"}
             for p in (t.soft, t.scale, t.motor)]  # fmt: skip
    return Terms(np.eye(3), np.zeros(3), None, *parts)


def power_of(case: Case, of: str | None) -> Floats:
    """(N,) A or share of full; NaN as nothing."""
    series = case.ampere if of == "current" else case.columns.throttle
    return np.nan_to_num(series)


def mean_power(case: Case, of: str | None) -> float:
    """Over what taught."""
    return float(np.mean(power_of(case, of)[case.columns.learn]))


def terms(case: Case, b: Batch | None, soft_asked: bool, scale_asked: bool, motor_asked: bool) -> Terms:
    """What is known of each, and what of it is to be written."""
    none = np.zeros(3)
    if b is None:
        why = "too little was flown, or two axes only"
        told = {"earned": False, "asked": True, "evidence": why}
        parts = [dict(told) if asked else None for asked in (soft_asked, scale_asked, motor_asked)]
        return Terms(np.eye(3), none, None, *parts)
    f = b.whole
    soft_matrix, soft = _soft(case, b) if soft_asked else (np.eye(3), None)
    gain, scale = _scale(case, b) if scale_asked else (1.0, None)
    motor = None
    per_unit, of = none, None
    if b.power is not None and (motor_asked or b.power_counts()):
        earned, evidence = _motor(case, b)
        sigma = np.sqrt(np.maximum(np.diag(f.covariance[POWER, POWER]), 0.0))
        motor = {
            "mg_per_unit": [round(float(v), 4) for v in f.power_b_mg],
            "sigma": [round(float(v), 4) for v in sigma],
            "of": b.power,
            "correlation": round(b.correlation, 3),
            "earned": earned,
            "asked": motor_asked,
            "evidence": evidence,
        }
        if earned and motor_asked:
            per_unit, of = f.power_b_mg, b.power
    elif motor_asked:
        motor = {"earned": False, "asked": True, "evidence": "neither current nor throttle is known and changes"}
    return Terms(soft_matrix / gain, per_unit, of, soft, scale, motor)


def _second_half(case: Case, bend: Floats, power_mg: Floats | None = None) -> float:
    """RMS misfit of the second half with the iron of the first, mG."""
    first = case.known.foretold
    if first is None or not case.later.any():
        return float("nan")
    z = (case.columns.sensor_b_mg - first.hard_iron_b_mg) @ case.matrix.T
    if power_mg is not None:
        z = z - power_mg
    off = case.misfit(z @ bend.T, first)[case.later]
    # A constant is the iron's own affair, level field and downward alike.
    return float(np.sqrt(np.mean((off - off.mean(axis=0)) ** 2)))


def _soft(case: Case, b: Batch) -> tuple[Floats, dict[str, Any]]:
    """Traceless: what it shares with the scale is the scale's."""
    s, spread = b.whole.soft, b.whole.covariance[SOFT, SOFT]
    vector = np.array([0.5 * (s[0, 0] - s[1, 1]), -0.5 * np.sqrt(3.0) * s[2, 2], s[0, 1], s[0, 2], s[1, 2]])
    chi2 = float(vector @ np.linalg.solve(spread, vector))
    bend: Floats = np.linalg.inv(np.eye(3) + s).astype(np.float64)
    first = None if b.halves is None else np.linalg.inv(np.eye(3) + b.halves[0].soft).astype(np.float64)
    plain = _second_half(case, np.eye(3))
    better = plain if first is None else _second_half(case, first)
    large = float(np.abs(s).max())
    earned = chi2 > _SOFT_CHI2 and large > _SOFT_LEAST and better < _BETTER * plain
    sigma = float(np.sqrt(np.mean(np.diag(spread))))
    evidence = (
        f"largest element {large:.3f}, sigma {sigma:.3f}, chi squared {chi2:.0f} of 5 (wants {_SOFT_CHI2:.0f}); "
        f"second half {plain:.1f} mG without, {better:.1f} mG with that of the first"
    )
    told = {"matrix": bend.round(6).tolist(), "sigma": round(sigma, 5), "earned": earned, "asked": True}
    return (bend if earned else np.eye(3)), told | {"evidence": evidence}


def _scale(case: Case, b: Batch) -> tuple[float, dict[str, Any]]:
    gain, sigma = b.whole.gain, b.whole.sigma(GAIN)
    alike = b.halves is None or abs(b.halves[0].gain - b.halves[1].gain) < max(3.0 * sigma, 0.03)
    earned = case.expected is not None and abs(gain - 1.0) > max(_SCALE_LEAST, _SCALE_SIGMAS * sigma) and alike
    evidence = f"shows {gain:.3f} +- {sigma:.3f} times the world model's field"
    if case.expected is None:
        evidence = "no position: nothing tells the scale from the field"
    elif b.halves is not None:
        evidence += f"; halves {b.halves[0].gain:.3f} and {b.halves[1].gain:.3f}"
    told = {"factor": round(1.0 / gain, 5), "sigma": round(sigma, 5), "earned": earned, "asked": True}
    return (gain if earned else 1.0), told | {"evidence": evidence}


def _motor(case: Case, b: Batch) -> tuple[bool, str]:
    f = b.halves[0] if b.halves is not None else b.whole
    power = power_of(case, b.power)
    plain = _second_half(case, np.eye(3))
    with_it = _second_half(case, np.eye(3), (power - power.mean())[:, None] * f.power_b_mg)
    earned = b.power_counts() and with_it < _BETTER * plain
    evidence = (
        f"r = {b.correlation:.2f} with {b.power}; second half {plain:.1f} mG without, {with_it:.1f} mG with that of "
        "the first"
    )
    return earned, evidence
