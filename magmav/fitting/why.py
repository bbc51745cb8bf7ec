"""What is wrong with a compass and what to do about it: the causes, asked again with all of the flight known.

The causes found here rest on the same Samples as the fit, with the battery's current at each of them. A batch fit of
the whole flight (core.causes_fit) says what follows power, and how sure scale, soft iron and mounting are.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magmav.core.causes import Cause, Causes
from magmav.core.causes_blocks import AMPERE, Block, Blocks
from magmav.core.causes_fit import POWER, Fit
from magmav.core.causes_fit import fit as batch_fit
from magmav.core.types import Estimate
from magmav.fitting.case import Case

Floats = NDArray[np.float64]
_LEAST_BLOCKS = 3
_STRONG_R = 0.7  # AT-10c
_STORED_DEG, _STORED_TIMES = 8.0, 2.0
_STORED_CHI2 = 30.0


def asked(cases: Sequence[Case]) -> tuple[dict[int, tuple[Cause, ...]], Causes]:
    """Causes of each compass of one vehicle, and the finder itself."""
    finder = Causes()
    for case in cases:
        moments, era = _moments(case)
        stored = case.told.boot.calibrations.offsets(case.compass)
        used = case.shaped_b_mg if stored is None else case.shaped_b_mg + case.matrix @ stored
        power = zip(case.ampere.tolist(), case.columns.throttle.tolist(), strict=True)
        each = zip(case.samples, case.tape.heard, era, used, power, strict=True)
        for s, (_, here), moment, used_b_mg, (ampere, throttle) in each:
            if math.isfinite(ampere):
                finder.current(ampere)
            if math.isfinite(throttle):
                finder.throttle(throttle)
            finder.step(s, moments[moment], here.expected, used_b_mg, here.grounded)
    return {case.compass: finder.of(case.compass) for case in cases}, finder


def _moments(case: Case) -> tuple[list[Estimate], list[int]]:
    """The estimate of every second as of its time, and which of them belongs to each sample."""
    known, out = case.known, []
    times = known.boot_ns.tolist()
    for t, e in zip(times, known.estimates, strict=True):
        since = min((t - c for c in known.changes_ns if c <= t), default=None)
        out.append(replace(e, changed_ago_s=1e9 if since is None else since / 1e9))
    last = len(out) - 1
    return out, np.minimum(np.searchsorted(times, [s.boot_ns for s in case.samples]), last).tolist()


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """One batch fit of the flight, and of each half of it."""

    whole: Fit
    halves: tuple[Fit, Fit] | None

    @property
    def power(self) -> str | None:
        """What drives the motors' field: current, throttle, or None where neither is known or changes."""
        if not self.whole.power_by:
            return None
        return "current" if self.whole.power_by == AMPERE else "throttle"

    @property
    def correlation(self) -> float:
        """Of the field that the rest does not explain with power, 0 to 1."""
        moved = float(np.linalg.norm(self.whole.power_b_mg)) * self.whole.power_span
        return moved / math.hypot(moved, self.whole.rms_mg, 1e-9)

    def power_counts(self) -> bool:
        """Is there more than chance, and more than does not matter? In both halves alike, where there are two."""
        if not _counts(self.whole):
            return False
        if self.halves is None or any(h.power_by != self.whole.power_by for h in self.halves):
            return True
        one, two = self.halves
        apart = one.power_b_mg - two.power_b_mg
        spread = one.covariance[POWER, POWER] + two.covariance[POWER, POWER]
        size = float(np.linalg.norm(self.whole.power_b_mg))
        return float(apart @ np.linalg.solve(spread, apart)) < 30.0 or float(np.linalg.norm(apart)) < 0.5 * size


def _counts(f: Fit) -> bool:
    spread = f.covariance[POWER, POWER]
    strong = 2.0 * f.power_span * float(np.linalg.norm(f.power_b_mg)) > 8.0
    return bool(f.power_by) and strong and float(f.power_b_mg @ np.linalg.solve(spread, f.power_b_mg)) > 40.0


def batch(case: Case) -> Batch | None:
    """None for two axes, or where too little was flown."""
    if case.columns.axes != 3:
        return None
    blocks = Blocks()
    blocks.teaching = deque()  # all of the flight, not its last minutes
    delay_s = min(max(case.estimate.delay_s, -0.2), 0.2)
    ampere, throttle = np.nan_to_num(case.ampere), np.nan_to_num(case.columns.throttle)
    power = zip(ampere.tolist(), throttle.tolist(), strict=True)
    for s, z_b_mg, of_it in zip(case.samples, case.shaped_b_mg.tolist(), power, strict=True):
        blocks.step(s, z_b_mg, delay_s, of_it, 0, False)
    all_of_them = blocks.all()
    if len(all_of_them) < _LEAST_BLOCKS:
        return None
    expected = None if blocks.by_hand else case.expected
    parts: list[list[Block]] = [[], []]
    for b in all_of_them:
        parts[b.middle_s >= case.split_s].append(b)
    halves = None
    if min(len(p) for p in parts) >= _LEAST_BLOCKS:
        halves = (batch_fit(parts[0], expected), batch_fit(parts[1], expected))
    return Batch(batch_fit(all_of_them, expected), halves)


def stored_wrong(
    stored_mg: Floats, change_mg: Floats, sigma_mg: Floats, worst_deg: float, before: float | None, after: float | None,
    reference: str | None,
) -> Cause | None:  # fmt: skip
    """Is what is stored wrong? Beyond its doubt, by many degrees, and worse than what is new where that is scored."""
    chi2 = float(np.sum((change_mg / sigma_mg) ** 2))
    if chi2 < _STORED_CHI2 or worst_deg < _STORED_DEG:
        return None
    if before is not None and after is not None and before < _STORED_TIMES * after:
        return None
    never = not stored_mg.any()
    what = "was never calibrated: its stored offsets are zero, and" if never else "has a wrong calibration stored:"
    text = f"this compass {what} heading is off by up to {worst_deg:.0f} degrees"
    figure: dict[str, float | str] = {"worst_deg": worst_deg, "change_mg": float(np.linalg.norm(change_mg))}
    if before is not None and after is not None and reference is not None:
        text += f" ({before:.1f} RMS against {reference}, {after:.1f} with the new offsets)"
        figure |= {"before_rms_deg": before, "after_rms_deg": after, "reference": reference}
    return Cause("NEVER_CALIBRATED" if never else "STORED_WRONG", text, figure)


_ADVICE = {
    "MOUNTED_WRONG": "set the compass orientation as named, restart and fly again: nothing is written",
    "MOUNTED_CROOKED": "straighten the compass or set its angles as a custom orientation: no offset can mend this",
    "MAGNET_NEARBY": "look for magnets, steel screws and speakers near the compass, and move one or the other",
    "FOLLOWS_CURRENT": "move the compass away from power wires, twist them, or use motor compensation (--motor)",
    "FOLLOWS_THROTTLE": "move the compass away from power wires, twist them, or use motor compensation (--motor)",
    "SCALE_WRONG": "check the sensor, then fit its scale (--scale)",
    "GYRO_BIAS": "calibrate the gyro: the compass is not to blame",
    "IRON_CHANGED": "find out what was moved or attached; the new offsets are those of the end of the flight",
    "GROUND_DISTURBED": "do not calibrate or arm on this place: there is steel in the ground",
    "COMPASS_BAD": "switch this compass off or mount it elsewhere until it agrees with the other",
    "STORED_WRONG": "load the parameter file, or calibrate this compass anew",
    "NEVER_CALIBRATED": "load the parameter file, or calibrate this compass, or switch it off",
}


_IN_THE_FILE = ("STORED_WRONG", "NEVER_CALIBRATED")


def advice(found: Sequence[Cause], b: Batch | None, relative: bool, ready: bool) -> list[str]:
    """What to do, most important first."""
    codes = [c.code for c in found if ready or c.code not in _IN_THE_FILE]
    out = list(dict.fromkeys(_ADVICE[code] for code in codes if code in _ADVICE))
    if len(codes) < len(found):
        out.append("calibrate this compass, or switch it off until it is")
    if relative:
        out.append(
            "the stored offsets are not in this recording, so only the change is known; add it to what the vehicle "
            "holds, or give a recording with its parameters"
        )
    if b is None or b.power is None:
        out.append(
            "no current and no throttle that changes: whether the field follows power could not be tested, and the "
            "hard iron is that at average power"
        )
    elif b.power_counts() and b.correlation > _STRONG_R:
        out.append(f"moves with {b.power}: fix wiring or use motor compensation (r = {b.correlation:.2f})")
    if not ready:
        out.append("not ready: see the reasons before you load anything")
    return out
