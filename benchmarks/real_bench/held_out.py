"""Heading error on the rest of a flight, of a calibration frozen S seconds after take-off.

The score is the replay's own (magmav.appraisal.scores), given the belief that a replay with --learn-for S would have
kept. Beside it stands r, what the best constant offset leaves on the same stretch: error of the reference, of tilt, of
soft iron, current and disturbances, none of which an offset can take away.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from magmav.appraisal import scores
from magmav.core.correction import covariance_of_field, field_of
from magmav.core.heading import heading_sigma
from magmav.core.rotation import body_from_earth
from magmav.core.types import Estimate, Vec3, vec3
from magmav.reference import shortest_rad
from magmav.score import Window, magnetic_heading_rad
from real_bench.running import Moment, before, offsets_to_store
from real_bench.tapes import Tape

Floats = NDArray[np.float64]
LEARN_FOR_S = (30.0, 60.0, *np.arange(80.0, 251.0, 10.0).tolist())
LEAST_REST_S = 10.0  # a shorter rest of a flight says nothing
_TILT_SIGMA_RAD, _OWN_TILT_SIGMA_RAD = math.radians(0.7), math.radians(2.0)  # as Channel has them


@dataclass(frozen=True, slots=True)
class HeldOut:
    """One compass frozen at one time. Degrees, None where nothing was known or nothing was left.

    sigma_deg : RMS of the heading sigma the service would publish over the stretch.  best_deg : r.
    """

    file: str
    compass: int
    estimator: str
    learn_for_s: float
    full_deg: float | None
    offsets_deg: float | None
    sigma_deg: float | None
    best_deg: float | None
    n: int
    hard_iron_mg: tuple[float, float, float] | None
    sigma_mg: tuple[float, float, float] | None
    state: str


class Judge:
    """One compass of a tape, ready to score calibrations on what is left of the flight."""

    def __init__(self, tape: Tape, compass: int) -> None:
        self.tape, self.compass = tape, compass
        log = tape.logs[compass]
        if tape.reference is None or log.last is None:
            raise ValueError(f"{tape.name}: compass {compass}: no reference to score against")
        self._log, self._last = log, log.last
        crash_ns = tape.boot.phase.crash_ns
        self.crash_s = math.inf if crash_ns is None else crash_ns / 1e9
        self._measured_s = np.array(log.boot_s) - np.array(log.age_s)
        self._sensor = np.array(log.sensor_b_mg).reshape(-1, 3)
        declination = np.array(log.declination_rad)
        if not np.isfinite(declination).any():
            declination = np.zeros(len(declination))
        self._at = at = tape.reference.interpolate(self._measured_s)
        tilt_ok = np.cos(at.roll_rad) * np.cos(at.pitch_rad) >= math.cos(math.radians(Window().tilt_deg))
        self._fine = at.valid & at.armed & at.airborne & tilt_ok & np.isfinite(declination)
        self._fine &= self._measured_s < self.crash_s
        self._magnetic_rad = at.yaw_true_rad - declination
        self._best: dict[float, float | None] = {}
        self._samples = list(tape.heard(compass))
        self._sample_s = np.array([h.sample.boot_ns / 1e9 for h in self._samples])

    def score(self, learn_for_s: float, e: Estimate, offsets_b_mg: Vec3) -> tuple[float | None, float | None, int]:
        """Heading RMS in degrees with the full model and with offsets only, and on how many samples."""
        frozen = replace(self._log, last=replace(self._last, estimate=e, offsets_mg=offsets_b_mg))
        full, offsets = scores(frozen, self.tape.boot, self.tape.reference, learn_for_s)
        assert full is not None and offsets is not None
        return full["rms_deg"], offsets["rms_deg"], full["n"]

    def rest_s(self, learn_for_s: float) -> float:
        """Seconds from the freeze to the last sample that counts."""
        taken = self._measured_s[self._taken(learn_for_s)]
        return float(taken[-1] - taken[0]) if len(taken) else 0.0

    def _taken(self, learn_for_s: float) -> NDArray[np.bool_]:
        return self._fine & (self._measured_s >= self.tape.started_s + learn_for_s)

    def best(self, learn_for_s: float) -> float | None:
        """r: RMS in degrees that the best constant offset leaves on the stretch, fitted on it; None of nothing.

        Least squares on the heading error itself, begun at the linear fit of offset and field with the reference's
        attitude.
        """
        if learn_for_s not in self._best:
            self._best[learn_for_s] = self._find_best(learn_for_s)
        return self._best[learn_for_s]

    def _find_best(self, learn_for_s: float) -> float | None:
        taken = np.flatnonzero(self._taken(learn_for_s))
        if len(taken) < 10:
            return None
        some = taken[:: max(1, len(taken) // 3000)]
        matrix = self.tape.boot.calibrations.shaping(self.compass).matrix
        at = self._at

        def error(iron: Floats) -> Floats:
            field = (self._sensor[some] - iron) @ matrix.T
            heading = magnetic_heading_rad(field, at.roll_rad[some], at.pitch_rad[some])
            return shortest_rad(heading - self._magnetic_rad[some])

        turned = np.array(
            [
                np.linalg.solve(matrix, body_from_earth(at.roll_rad[i], at.pitch_rad[i], self._magnetic_rad[i]))
                for i in some
            ]
        )
        design = np.concatenate([turned, np.broadcast_to(np.eye(3), turned.shape)], axis=2).reshape(-1, 6)
        begin = np.linalg.lstsq(design, self._sensor[some].reshape(-1), rcond=None)[0][3:]
        iron = least_squares(error, begin, x_scale=10.0).x
        _, rms_deg, _ = self.score(learn_for_s, self._last.estimate, vec3(-iron, "offsets"))
        return rms_deg

    def sigma_deg(self, learn_for_s: float, e: Estimate) -> float | None:
        """RMS over the stretch of the heading sigma that would be published with this estimate."""
        begin_s = self.tape.started_s + learn_for_s
        within = np.flatnonzero((self._sample_s >= begin_s) & (self._sample_s < self.crash_s))
        if len(within) == 0:
            return None
        squares = []
        for i in within[:: max(1, len(within) // 200)]:
            s, c = self._samples[i].sample, self._samples[i].circumstances
            h, v = field_of(e, c.expected)
            tilt = _TILT_SIGMA_RAD if s.tilt_from == "ATTITUDE" else max(_OWN_TILT_SIGMA_RAD, s.own_tilt_rad)
            squares.append(heading_sigma(covariance_of_field(s, e), h, v, s.roll_rad, s.pitch_rad, tilt) ** 2)
        return math.degrees(math.sqrt(float(np.mean(squares))))


def held_out(judge: Judge, estimator: str, moments: list[Moment], learn_for_s: float) -> HeldOut:
    """One row."""
    tape, compass = judge.tape, judge.compass
    m = before(moments, tape.started_s + learn_for_s)
    best = judge.best(learn_for_s)
    if m is None:
        return HeldOut(tape.name, compass, estimator, learn_for_s, *(None,) * 3, best, 0, None, None, "NO_DATA")
    e = m.estimate
    full, offsets, n = judge.score(learn_for_s, e, offsets_to_store(tape, compass, e))
    return HeldOut(
        file=tape.name,
        compass=compass,
        estimator=estimator,
        learn_for_s=learn_for_s,
        full_deg=full,
        offsets_deg=offsets,
        sigma_deg=judge.sigma_deg(learn_for_s, e),
        best_deg=best,
        n=n,
        hard_iron_mg=tuple(e.hard_iron_b_mg.tolist()),
        sigma_mg=tuple(m.sigma_mg.tolist()),
        state=m.state.name,
    )
