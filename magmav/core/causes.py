"""Why a compass is wrong, in plain words, each with the figure that says so.

Causes watches one vehicle: every Sample of every compass with its Estimate and the power at that time, kept as sums of
products (causes_blocks), and fitted now and then, or when asked (causes_fit). A cause is named only where its figure is
both large enough to matter and several of its own sigmas; the lines were drawn by flights with and without the fault
(docs/causes.md).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from magmav.core.causes_blocks import AMPERE, ONE, Block, Blocks, Vector, shaped
from magmav.core.causes_fit import (
    DRIFT,
    GAIN,
    IRON,
    POWER,
    STEP,
    TURN,
    Array,
    Fit,
    fit,
    power_name,
    turn_of,
)
from magmav.core.causes_linear import right_angles
from magmav.core.field import ExpectedField
from magmav.core.orientation import MAVLINK, rotation
from magmav.core.types import Estimate, Reason, Sample, Vec3

EARTH_MG = (150.0, 950.0)
_STRANGE_SAMPLES, _ORDINARY_MG = 10, 300.0
_SIGMAS = 5.0
_LEAST_BLOCKS, _LEAST_SAMPLES = 3, 100
_TURN_RAD, _NEAR_RAD, _REFUSED_TURN_RAD = math.radians(8.0), math.radians(15.0), math.radians(15.0)
_GAIN_OFF, _GAIN_SIGMAS, _GAIN_REFUSED = 0.08, 4.0, (0.8, 1.2)  # its sigma is mostly the field model's own doubt
_DRIFT_RADS = math.radians(0.6)
_LOST_RADS = math.radians(1.5)  # a gyro worse than this, on all axes, bends turn and gain: mend it first
_POWER_MG = 8.0  # over two standard deviations of the power that was drawn
_POWER_CHI2 = 40.0
_GROUND_MG, _AZIMUTH_RAD = 40.0, math.radians(4.0)
_JUMP_MG, _JUMP_CHI2, _JUMP_FLOOR_MG = 30.0, 50.0, 2.0
_BAD_MG, _BAD_TIMES = 15.0, 2.5
_SEARCHES_S = 15.0
_FITS_MG = 30.0  # of residual: more is no fit
_FIT_AT = (3, 6, 12, 24)  # blocks; later every 15


@dataclass(frozen=True, slots=True)
class Cause:
    """One thing that is wrong. code : stable name; text : a sentence; figure : numbers by name and unit."""

    code: str
    text: str
    figure: Mapping[str, float | str]

    def as_json(self) -> dict[str, object]:
        """For a result; numbers rounded to what they are worth."""
        figure = {k: v if isinstance(v, str) else round(v, 4) for k, v in self.figure.items()}
        return {"code": self.code, "text": self.text, "figure": figure}


@dataclass(slots=True)
class _Watched:
    """One compass."""

    blocks: Blocks = field(default_factory=Blocks)
    era: int = 0
    strange: int = 0
    magnet: Cause | None = None
    expected: ExpectedField | None = None
    fitted: Fit | None = None
    fitted_at: tuple[int, int] = (0, 0)
    found: tuple[Cause, ...] = ()
    changed_ago_s: float = 0.0
    residual_mg: float = 0.0


class Causes:
    """The cause finder of one vehicle. ``step`` for every sample; ``of`` for what is wrong with a compass."""

    def __init__(self) -> None:
        self._watched: dict[int, _Watched] = {}
        self._ampere: float | None = None
        self._share: float | None = None

    def current(self, ampere: float) -> None:
        """Take the battery current, A."""
        self._forget_powerless(self._ampere)
        self._ampere = ampere

    def throttle(self, share: float) -> None:
        """Take the throttle, 0 to 1."""
        self._forget_powerless(self._share)
        self._share = share

    def _forget_powerless(self, was: float | None) -> None:
        """Samples from before the power was known would say that it was nothing then."""
        if was is None:
            for w in self._watched.values():
                w.blocks = Blocks()

    def restart(self, compass: int) -> None:
        """What the autopilot does to this compass has changed: begin again."""
        self._watched.pop(compass, None)

    def step(self, s: Sample, e: Estimate, expected: ExpectedField | None, used_b_mg: Vec3, grounded: bool) -> None:
        """Take one sample. e : the estimate after it; used_b_mg : (3,) the field as the autopilot uses it."""
        if s.axes != 3:
            return
        w = self._watched.get(s.compass)
        if w is None:
            w = self._watched[s.compass] = _Watched()
        w.expected, z_b_mg = expected, shaped(s)
        self._strange(w, z_b_mg, used_b_mg)
        self._changes(w, e)
        power = (self._ampere or 0.0, self._share or 0.0)
        w.blocks.step(s, z_b_mg, min(max(e.delay_s, -0.2), 0.2), power, w.era, grounded)
        closed = w.blocks.closed
        if closed != w.fitted_at[0] and (closed in _FIT_AT or closed % 15 == 0):
            self._fit(w)

    def latest(self, compass: int) -> tuple[Cause, ...]:
        """As of the last fit, which may be minutes ago; costs nothing. The field's strength is judged at once."""
        w = self._watched.get(compass)
        if w is None:
            return ()
        if w.magnet is None:
            return w.found
        # Ordinary iron against a weak field of the Earth can add up to a strange one; once it is known it is no magnet.
        ordinary = w.fitted is not None and float(np.linalg.norm(w.fitted.iron_b_mg)) < _ORDINARY_MG
        return w.found if ordinary and w.strange < _STRANGE_SAMPLES else (w.magnet, *w.found)

    def of(self, compass: int) -> tuple[Cause, ...]:
        """Everything that is known to be wrong with a compass, from all data so far. Some 30 ms per compass."""
        for w in self._watched.values():
            self._fit(w)
        return (*self.latest(compass), *self._against_others(compass))

    def refuses(self, compass: int) -> Reason | None:
        """The reason not to write offsets that rest on a wrong mounting or scale; None where there is none."""
        w = self._watched.get(compass)
        if w is None or w.fitted is None:
            return None
        for cause in w.found:
            if cause.code.startswith("MOUNTED") and float(cause.figure["turn_deg"]) > math.degrees(_REFUSED_TURN_RAD):
                return Reason.MOUNTING_WRONG
            if cause.code == "SCALE_WRONG" and not _GAIN_REFUSED[0] <= w.fitted.gain <= _GAIN_REFUSED[1]:
                return Reason.SCALE_WRONG
        return None

    # ------------------------------------------------------------ at once

    def _strange(self, w: _Watched, z_b_mg: Vector, used_b_mg: Vec3) -> None:
        """Both as the autopilot uses it and, once the iron is known, without it."""
        strength = math.hypot(*used_b_mg.tolist())
        fine = _earthlike(strength) or (
            w.fitted is not None and _earthlike(math.dist(z_b_mg, w.fitted.iron_b_mg.tolist()))
        )
        w.strange = 0 if fine else w.strange + 1
        if w.strange >= _STRANGE_SAMPLES:
            text = f"field of {strength:.0f} mG, the Earth's is 150 to 950 mG: magnet or steel near compass"
            w.magnet = Cause("MAGNET_NEARBY", text, {"field_mg": strength})

    def _changes(self, w: _Watched, e: Estimate) -> None:
        """The estimator says that the iron changed suddenly: what came before may be another compass's story.

        Said again soon after, or where nothing fitted before either, it is the estimator that searches: of a compass
        turned on its mount it finds no end.
        """
        settled = w.changed_ago_s > _SEARCHES_S and w.residual_mg < _FITS_MG
        if e.changed_ago_s < w.changed_ago_s - 1.0 and settled:
            w.era += 1
        w.changed_ago_s, w.residual_mg = e.changed_ago_s, e.residual_mg

    # ------------------------------------------------------------ by the fit

    def _fit(self, w: _Watched) -> None:
        blocks = w.blocks.all()
        at = (w.blocks.closed, round(sum(b.n for b in blocks)))
        if at == w.fitted_at or len(blocks) < _LEAST_BLOCKS or at[1] < _LEAST_SAMPLES:
            return
        w.fitted_at = at
        blocks, step_at = _since_the_last_change(blocks)
        # What stands around while it is turned by hand makes the field another than the world model's.
        expected = None if w.blocks.by_hand else w.expected
        now = fit(blocks, expected, step_at)
        w.fitted = now
        ground = None if w.blocks.ground is None else _ground(now, blocks, w.blocks.ground)
        found = (_changed(now), _mounting(now), _scale(now, expected), _power(now), _gyro(now), ground)
        w.found = tuple(c for c in found if c is not None)

    def _against_others(self, compass: int) -> tuple[Cause, ...]:
        misfit = {c: w.fitted.plain_mg for c, w in self._watched.items() if w.fitted is not None}
        if len(misfit) < 2 or compass not in misfit:
            return ()
        best = min(misfit, key=lambda c: misfit[c])
        bad = {c: mg for c, mg in misfit.items() if mg > max(_BAD_MG, _BAD_TIMES * misfit[best])}
        out = []
        if compass in bad:
            text = (
                f"this compass is the bad one: {misfit[compass]:.0f} mG off what gyro and attitude say, "
                f"compass {best} only {misfit[best]:.0f}"
            )
            out.append(Cause("COMPASS_BAD", text, {"misfit_mg": misfit[compass], "best_mg": misfit[best]}))
        for other, mg in bad.items() if compass not in bad else ():
            own = misfit[compass]
            text = f"compass {other} is the bad one: {mg:.0f} mG off what gyro and attitude say, this one {own:.0f}"
            figure = {"compass": float(other), "misfit_mg": mg, "own_misfit_mg": own}
            out.append(Cause("OTHER_COMPASS_BAD", text, figure))
        return tuple(out)


def _earthlike(strength_mg: float) -> bool:
    return EARTH_MG[0] <= strength_mg <= EARTH_MG[1]


def _since_the_last_change(blocks: list[Block]) -> tuple[list[Block], int | None]:
    """The time before the last sudden change and the time since, and where the second begins (None: no change).

    An estimator that searches says several times that the iron changed: what lies between is the search.
    """
    eras: dict[int, list[Block]] = {}
    for b in blocks:
        eras.setdefault(b.era, []).append(b)
    long = [part for part in eras.values() if sum(b.n for b in part) >= _LEAST_SAMPLES]
    if len(eras) == 1 or not long or long[-1][-1].era != blocks[-1].era:
        return blocks, None
    before = long[-2] if len(long) > 1 else []
    return [*before, *long[-1]], len(before) or None


def _changed(f: Fit) -> Cause | None:
    """Something magnetic came or went: before and after are told apart by one fit that shares all but the iron."""
    moved, spread = f.step_b_mg, f.covariance[STEP, STEP]
    size = float(np.linalg.norm(moved))
    if size < _JUMP_MG or float(moved @ np.linalg.solve(spread, moved)) < _JUMP_CHI2:
        return None
    sigma = math.hypot(math.sqrt(float(moved @ spread @ moved)) / size, _JUMP_FLOOR_MG)
    text = f"iron on board changed suddenly by {size:.0f} +- {sigma:.0f} mG: something was moved or attached"
    return Cause("IRON_CHANGED", text, {"change_mg": size, "sigma_mg": sigma})


def _mounting(f: Fit) -> Cause | None:
    """Turned against the vehicle: by right angles, or by some degrees."""
    vector = turn_of(f.turn.T)  # how the sensor itself is turned
    angle = float(np.linalg.norm(vector))
    if angle < _TURN_RAD or abs(f.drift_rads) > _LOST_RADS:
        return None
    sigma = _turn_sigma(f, vector / angle)
    if angle < _SIGMAS * sigma:
        return None
    degrees, spread = math.degrees(angle), math.degrees(sigma)
    about = dict(zip(("roll_deg", "pitch_deg", "yaw_deg"), np.degrees(vector).tolist(), strict=True))
    figure: dict[str, float | str] = {"turn_deg": degrees, "sigma_deg": spread, **about}
    nearest = max(right_angles(), key=lambda m: float(np.trace(m @ f.turn)))
    off = float(np.linalg.norm(turn_of(nearest @ f.turn)))
    if off < _NEAR_RAD and not np.array_equal(nearest, np.eye(3)):
        name = _orientation(nearest)
        how = f"{degrees:.0f} +- {spread:.0f} degrees"
        text = f"compass is mounted turned by {how}: it fits as {name} on top of what is set"
        return Cause("MOUNTED_WRONG", text, {**figure, "orientation": name})
    axis = int(np.argmax(np.abs(vector)))
    name = ("forward", "right", "down")[axis]
    text = f"compass is mounted crooked: turned by {degrees:.0f} +- {spread:.0f} degrees, mostly about the {name} axis"
    return Cause("MOUNTED_CROOKED", text, figure)


def _turn_sigma(f: Fit, axis: Array) -> float:
    """One sigma of the turn about its own axis, rad. The small rotation acts in the sensor's turned axes."""
    along = f.turn @ axis
    return math.sqrt(max(float(along @ f.covariance[TURN, TURN] @ along), 0.0))


def _orientation(turn: Array) -> str:
    """MAVLink's name of a right-angled mounting."""
    return next(o.name for n, o in MAVLINK.items() if np.allclose(rotation(n), turn, atol=1e-6))


def _scale(f: Fit, expected: ExpectedField | None) -> Cause | None:
    sigma, off = f.sigma(GAIN), abs(f.gain - 1.0)
    if expected is None or abs(f.drift_rads) > _LOST_RADS or off < max(_GAIN_OFF, _GAIN_SIGMAS * sigma):
        return None
    text = f"scale is wrong: it shows {f.gain:.2f} +- {sigma:.2f} times the Earth's field"
    return Cause("SCALE_WRONG", text, {"gain": f.gain, "sigma": sigma})


def _power(f: Fit) -> Cause | None:
    size = float(np.linalg.norm(f.power_b_mg))
    if not f.power_by or 2.0 * f.power_span * size < _POWER_MG:
        return None
    spread = f.covariance[POWER, POWER]
    if float(f.power_b_mg @ np.linalg.solve(spread, f.power_b_mg)) < _POWER_CHI2:
        return None
    sigma = math.sqrt(float(f.power_b_mg @ spread @ f.power_b_mg)) / size
    current = f.power_by == AMPERE
    code, what = ("FOLLOWS_CURRENT", "the battery current") if current else ("FOLLOWS_THROTTLE", "throttle")
    each = ", ".join(f"{v:+.1f}" for v in f.power_b_mg)
    text = f"field follows {what}: {size:.1f} +- {sigma:.1f} mG per {power_name(f.power_by)} ({each} in x, y, z)"
    x, y, z = f.power_b_mg.tolist()
    return Cause(code, text, {"size_mg": size, "sigma_mg": sigma, "x_mg": x, "y_mg": y, "z_mg": z})


def _gyro(f: Fit) -> Cause | None:
    sigma = f.sigma(DRIFT)
    if abs(f.drift_rads) < max(_DRIFT_RADS, _SIGMAS * sigma):
        return None
    drift, spread = math.degrees(f.drift_rads), math.degrees(sigma)
    text = f"gyro bias: the gyro's yaw runs away by {drift:+.2f} +- {spread:.2f} deg/s; the compass is not to blame"
    return Cause("GYRO_BIAS", text, {"bias_degs": drift, "sigma_degs": spread})


def _ground(f: Fit, blocks: list[Block], ground: Block) -> Cause | None:
    """The field before take-off against that in the air, levelled. Its direction is compared by gyro."""
    first = blocks[0]
    if ground.n < 10 or not first.chained or first.begin_s < ground.begin_s:
        return None
    dt = first.middle_s - ground.middle_s
    azimuth = float(f.azimuth_rad[0]) - f.drift_rads * dt
    mean = ground.sums[ONE] / ground.n
    left = mean[18:] - f.iron_b_mg - (f.power_b_mg * mean[f.power_by] if f.power_by else 0.0)
    earth = np.linalg.solve(f.gain * (np.eye(3) + f.soft) @ f.turn, left)
    there = np.array([earth @ mean[3:6], earth @ mean[6:9], earth @ mean[0:3]])
    here = np.array([f.level_mg * math.cos(azimuth), f.level_mg * math.sin(azimuth), f.down_mg])
    off = float(np.linalg.norm(there - here))
    turned = math.hypot(_AZIMUTH_RAD, 0.3 * math.radians(dt) ** 0.5, f.sigma(DRIFT) * dt)
    powered = f.covariance[POWER, POWER] * (mean[f.power_by] ** 2 if f.power_by else 0.0)
    doubt = float(np.trace(f.covariance[IRON, IRON] + powered)) / 3.0
    sigma = math.sqrt((turned * f.level_mg) ** 2 / 2.0 + doubt + 25.0)
    if off < max(_GROUND_MG, 4.0 * sigma):
        return None
    text = f"ground is disturbed: {off:.0f} +- {sigma:.0f} mG of steel or current below before take-off, not in the air"
    return Cause("GROUND_DISTURBED", text, {"off_mg": off, "sigma_mg": sigma})
