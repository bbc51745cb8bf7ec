"""Which stretches of a recording are left out of a fit, and what each is called.

The pipeline already teaches nothing on the ground, after a crash and while a correction changes; here those get their
names, and what shows only afterwards is found: the tumble that led to the crash, a sensor at the end of its range, and
steel below the take-off.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magmav.comparison import Columns
from magmav.core.phase import Phase

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

_UPRIGHT = math.cos(math.radians(60.0))
_TUMBLE_S = 10.0  # so long before the crash was noticed it may have begun
_RAIL_MG, _RAIL_SPREAD_MG, _RAIL_MOVES_MG, _RAIL_RUN = 1000.0, 0.5, 20.0, 5
_NEAR_GROUND_S = 30.0
_WINDOW_S = 2.0
_STRANGE_MG, _STRANGE_TIMES = 40.0, 4.0
_LEAST_LEFT_S = 20.0  # of flight beside what is cut

TEXTS = {
    "GROUND": "on the ground: steel and concrete teach nothing about a compass",
    "LOW": "within 5 m of the ground, or not known to be higher",
    "HANDS": "turned by hand before the flight: the flight teaches better",
    "CRASHED": "after the crash",
    "TUMBLE": "tumbling before the crash: tilted beyond 60 degrees",
    "SATURATED": "sensor at the end of its range",
    "TAKEOFF_ANOMALY": "field differs from the rest of the flight after take-off: steel below the place",
    "LANDING_ANOMALY": "field differs from the rest of the flight before landing: steel below the place",
    "SETTLING": "just after a change of compass parameters",
}


@dataclass(frozen=True, slots=True)
class Span:
    """Left out, boot times in seconds, ends included."""

    from_s: float
    to_s: float
    code: str

    @property
    def text(self) -> str:
        """In words."""
        return TEXTS[self.code]

    def as_json(self) -> dict[str, object]:
        """For a result."""
        return {"from_s": round(self.from_s, 3), "to_s": round(self.to_s, 3), "code": self.code, "text": self.text}


def before_the_fit(c: Columns, phase: Phase, by_hand: Flags, settling: Flags) -> tuple[Flags, list[Span]]:
    """What may teach, (N,), and the spans that may not.

    by_hand : turned by hand before a flight.  settling : just after a compass parameter changed.
    """
    labels = np.full(len(c.boot_s), "", dtype=object)
    labels[~c.learn] = "LOW" if phase.flyer else "SETTLING"
    flown = [f for f in phase.flights if f.takeoff_ns is not None]
    if phase.flyer and flown:
        aloft = np.zeros(len(c.boot_s), dtype=bool)
        for f in flown:
            down_ns = f.landed_ns if f.landed_ns is not None else f.disarmed_ns
            end_s = math.inf if down_ns is None else down_ns / 1e9
            aloft |= (c.boot_s >= (f.takeoff_ns or 0) / 1e9) & (c.boot_s <= end_s)
        labels[~c.learn & ~aloft] = "GROUND"
    elif phase.flyer:
        labels[~c.learn] = "GROUND"
    labels[~c.learn & settling] = "SETTLING"
    labels[by_hand] = "HANDS"
    crashes = [f.crash_ns / 1e9 for f in phase.flights if f.crash_ns is not None]
    if phase.crash_ns is not None:
        crashes.append(phase.crash_ns / 1e9)
    for crash_s in sorted(set(crashes)):
        begin_s = _tumble_s(c, crash_s)
        labels[(c.boot_s >= begin_s) & (c.boot_s < crash_s)] = "TUMBLE"
        labels[(c.boot_s >= crash_s) & ~c.learn] = "CRASHED"
    labels[saturated(c.sensor_b_mg)] = "SATURATED"
    return labels == "", spans(c.boot_s, labels)


def _tumble_s(c: Columns, crash_s: float) -> float:
    """When it last flew upright before the crash."""
    upright = np.cos(c.roll_rad) * np.cos(c.pitch_rad) >= _UPRIGHT
    before = upright & (c.boot_s < crash_s) & (c.boot_s >= crash_s - _TUMBLE_S)
    return float(c.boot_s[before][-1]) + 1e-3 if before.any() else crash_s


def saturated(sensor_b_mg: Floats) -> Flags:
    """(N,): one axis stands at its largest value of the recording, beyond what the Earth gives, while others move."""
    out = np.zeros(len(sensor_b_mg), dtype=bool)
    for axis in range(3):
        value = sensor_b_mg[:, axis]
        for sign in (1.0, -1.0):
            top = float((sign * value).max(initial=0.0))
            if top < _RAIL_MG:
                continue
            here = sign * value > top - _RAIL_SPREAD_MG
            for begin, end in runs(here):
                others = np.delete(sensor_b_mg[begin:end], axis, axis=1)
                if end - begin >= _RAIL_RUN and np.ptp(others, axis=0).max() > _RAIL_MOVES_MG:
                    out[begin:end] = True
    return out


def near_ground(boot_s: Floats, misfit_mg: Floats, keep: Flags, phase: Phase) -> tuple[Flags, list[Span]]:
    """After a first fit: what still may teach, and the spans near take-off and landing whose field is another one.

    misfit_mg : (N,) how far each sample is from the fit, without heading.
    """
    keep = keep.copy()
    labels = np.full(len(boot_s), "", dtype=object)
    taught = boot_s[keep]
    if not phase.flyer or len(taught) == 0 or taught[-1] - taught[0] < _LEAST_LEFT_S + _NEAR_GROUND_S:
        return keep, []
    usual = max(_STRANGE_MG, _STRANGE_TIMES * float(np.median(misfit_mg[keep])))
    for f in phase.flights:
        if f.takeoff_ns is not None:
            since = keep & (boot_s >= f.takeoff_ns / 1e9) & (boot_s < f.takeoff_ns / 1e9 + _NEAR_GROUND_S)
            labels[_lasting(boot_s, misfit_mg, np.flatnonzero(since), usual)] = "TAKEOFF_ANOMALY"
        if f.landed_ns is not None:
            until = keep & (boot_s > f.landed_ns / 1e9 - _NEAR_GROUND_S) & (boot_s <= f.landed_ns / 1e9)
            labels[_lasting(boot_s, misfit_mg, np.flatnonzero(until)[::-1], usual)] = "LANDING_ANOMALY"
    found = labels != ""
    if float(np.count_nonzero(keep & ~found)) < 0.5 * float(np.count_nonzero(keep)):
        return keep, []
    return keep & ~found, spans(boot_s, labels)


def _lasting(boot_s: Floats, misfit_mg: Floats, order: NDArray[np.intp], usual_mg: float) -> NDArray[np.intp]:
    """From the ground outwards: up to the end of the last window that is strange, where the first one is."""
    end = 0
    while end < len(order):
        window = [i for i in order[end:] if abs(boot_s[i] - boot_s[order[end]]) < _WINDOW_S]
        if float(np.sqrt(np.mean(misfit_mg[window] ** 2))) < usual_mg:
            break
        end += len(window)
    return order[:end]


def runs(flags: Flags) -> list[tuple[int, int]]:
    """Where flags hold without a break: (first, one past the last)."""
    edge = np.diff(np.concatenate(([0], flags.astype(np.int8), [0])))
    return list(zip(np.flatnonzero(edge == 1).tolist(), np.flatnonzero(edge == -1).tolist(), strict=True))


def spans(boot_s: Floats, labels: NDArray[np.object_]) -> list[Span]:
    """Samples with a name, as stretches of time."""
    out = []
    for code in TEXTS:
        out += [Span(float(boot_s[a]), float(boot_s[b - 1]), code) for a, b in runs(labels == code)]
    return sorted(out, key=lambda s: s.from_s)


def merged(*parts: Sequence[Span]) -> list[Span]:
    """All of them in order of time."""
    return sorted((s for part in parts for s in part), key=lambda s: (s.from_s, s.code))
