"""The gate's word on an answer that is known after the flight."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from magmav.channels import limits
from magmav.core import gate
from magmav.core.causes import Causes
from magmav.core.correction import covariance_of_field, field_of
from magmav.core.excitation import sectors_of
from magmav.core.heading import heading_sigma
from magmav.core.types import AxisState, State, Vec3, Verdict
from magmav.fitting.case import Case, misfit
from magmav.score import magnetic_heading_rad


def judged(case: Case, finder: Causes) -> tuple[Verdict, Vec3]:
    """May it be written, and why (not); and the claimed sigma of each axis, (3,) mG."""
    e, last, c = case.estimate, case.samples[-1], case.tape.heard[-1].circumstances
    settings, columns, taught = case.told.settings, case.columns, case.columns.learn
    sigma = gate.floored(e)
    horizontal, down = field_of(e, c.expected)
    corrected = (columns.sensor_b_mg - e.hard_iron_b_mg)[taught] @ (e.soft_iron_b @ case.matrix).T
    flown = replace(columns, roll_rad=columns.roll_rad[taught], pitch_rad=columns.pitch_rad[taught])
    headings = magnetic_heading_rad(corrected, flown.roll_rad, flown.pitch_rad)[corrected.any(axis=1)]
    level = float(np.mean(misfit(flown, corrected, e)[:, 0])) + horizontal if len(corrected) else 0.0
    states = gate.axis_states(e.own_sigma_mg, sigma, settings.gate.axis_sigma_mg)
    evidence = gate.Evidence(
        estimate=e,
        expected=c.expected,
        sigma_mg=sigma,
        offsets_heading_sigma_rad=heading_sigma(covariance_of_field(last, e), horizontal, down, 0.0, 0.0, 0.0),
        field_mg=float(np.mean(np.linalg.norm(corrected, axis=1))) if len(corrected) else 0.0,
        level_mg=level,
        apart=e.apart,
        left_mg=_left_mg(case, sigma),
        steady=_steady(case, sigma, states[2]),
        sectors=sectors_of(headings % math.tau),
        frozen_s=c.frozen_s if last.learn else 0.0,
        has_attitude=last.tilt_from == "ATTITUDE",
        relative=c.relative,
        assumed=c.assumed,
        parameters_changed=c.parameters_changed,
        grounded=c.grounded,
        axes=last.axes,
    )
    verdict = gate.judge(evidence, limits(settings), State.LEARNING)
    reason = case.told.boot.calibrations.refuses(case.compass) or finder.refuses(case.compass)
    if reason is not None:
        verdict = Verdict(State.REFUSED, verdict.axes, (reason, *verdict.reasons))
    return verdict, sigma


def _steady(case: Case, sigma_mg: Vec3, down: AxisState) -> bool:
    """Does the iron stand still over the last seconds, as all of the flight shows it?"""
    known, back_ns = case.known, case.told.settings.gate.steady_s * 1e9
    then = next(e for t, e in zip(known.boot_ns, known.estimates, strict=True) if known.boot_ns[-1] - t <= back_ns)
    moved = np.abs(case.estimate.hard_iron_b_mg - then.hard_iron_b_mg)
    return bool((moved <= 2.0 * sigma_mg + 3.0)[[True, True, down is not AxisState.NOT_OBSERVED]].all())


def _left_mg(case: Case, sigma_mg: Vec3) -> float:
    """What the tilt would make, level, of a down axis that stays as it is stored, mG; 0 where it is written."""
    stored = case.told.boot.calibrations.offsets(case.compass)
    if stored is None or sigma_mg[2] <= case.told.settings.gate.axis_sigma_mg or not case.columns.learn.any():
        return 0.0
    c = case.columns
    upright = (np.cos(c.roll_rad) * np.cos(c.pitch_rad))[c.learn]
    off = max(abs(float(stored[2] + case.estimate.hard_iron_b_mg[2])) - float(sigma_mg[2]), 0.0)
    return math.sqrt(float(np.mean(1.0 - upright**2))) * off
