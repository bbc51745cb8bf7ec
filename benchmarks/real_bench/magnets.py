"""How soon the heading is right again after a real magnet was attached, and after it was taken off.

Two measures of a calibration, in degrees, both beyond what the optical-truth offset gives. ``level``: the RMS of the
heading error over all level headings in the room's field, with the hard and soft iron that the optics found, as in the
simulated flights; this one has targets. ``flown``: the RMS of the heading against the optical one over the samples of
that stretch (magnet on, or off again) tilted up to 60 degrees, reference errors included. One mG of offset is a third
of a degree: the room's level field is 150 mG only.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from estimator_bench.score import HEADINGS_RAD, heading_rms_deg
from numpy.typing import NDArray

from magmav.core.types import AttitudeReading, Reading, State
from magmav.logs import Recording
from magmav.recording import open_recording
from magmav.reference import shortest_rad
from magmav.score import magnetic_heading_rad
from real_bench.optical import Iron, Moved, Room, Truth, lagged, read, room, truth
from real_bench.running import Make, Moment, run
from real_bench.tapes import DATA, Tape, tapes

Floats = NDArray[np.float64]
UNDISTURBED = "broad02"
MAGNETS = ("broad32", "broad34", "broad36")
WAYS = ("own tilt", "optical tilt")
WITHIN_DEG, WRONG_DEG, MOST_TILT_DEG = 1.0, 3.0, 60.0
NOTHING_DEG = 180.0 / math.sqrt(3.0)


class WithAttitude:
    """A recording whose vehicle also sends ATTITUDE: the optical one. Satisfies magmav.logs.Recording."""

    def __init__(self, inner: Recording, moved: Moved) -> None:
        self.name = inner.name
        self.unix_offset_ns = inner.unix_offset_ns
        self.heard: Counter[str] = inner.heard
        self._inner = inner
        self._at = {round(t * 1e9): i for i, t in enumerate(moved.boot_s) if moved.valid[i]}
        self._moved = moved

    @property
    def counts(self) -> Counter[str]:
        """Of the recording itself."""
        return self._inner.counts

    def readings(self) -> Iterator[tuple[int, Reading]]:
        """Its readings; before those of an IMU message, the attitude of that time."""
        told = 0
        rates = self._moved.rate_b_rads
        for t_ns, reading in self._inner.readings():
            boot_ns = getattr(reading, "boot_ns", 0)
            i = self._at.get(boot_ns)
            if i is not None and boot_ns > told:
                told = boot_ns
                roll, pitch, yaw = euler(self._moved.body_from_room[i])
                yield t_ns, AttitudeReading(reading.system, "ATTITUDE", boot_ns, roll, pitch, yaw, rates[i])
            yield t_ns, reading

    def in_runs(self) -> Iterator[tuple[int, Reading]]:
        """The same: an attitude comes with every reading of the IMU."""
        return self.readings()

    def close(self) -> None:
        """Let go."""
        self._inner.close()


def euler(body_from_earth: Floats) -> tuple[float, float, float]:
    """Roll, pitch and yaw of a matrix, rad."""
    c = body_from_earth
    pitch = math.asin(max(-1.0, min(1.0, -float(c[0, 2]))))
    return math.atan2(c[1, 2], c[2, 2]), pitch, math.atan2(c[0, 1], c[0, 0])


@dataclass(frozen=True, slots=True)
class Spell:
    """A stretch with one iron: the magnet on, off again, or never there.

    turned_before_s : seconds of motion in the stretch before.  level_s, flown_s : from its begin, or from the first
    motion in it if that is later, until the excess over the optical offset is under one degree for good; None for
    never.  *_best_deg : what the optical offset gives.  *_deg : the excess at the end.
    """

    what: str
    from_s: float
    turning_from_s: float
    to_s: float
    turned_before_s: float
    level_s: float | None
    flown_s: float | None
    level_best_deg: float
    flown_best_deg: float
    level_deg: float
    flown_deg: float
    iron_error_mg: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class MagnetRow:
    """One estimator on one recording.

    ready_wrong_s : seconds READY while wrong at level by more than WRONG_DEG (all of it, not only the excess).
    odd_wrong_s : of the times when the field was neither's: the magnet on its way, or something else near.
    wrongs : boot times (from, to) of both.
    """

    file: str
    way: str
    estimator: str
    on_s: tuple[float, float] | None
    off_s: tuple[float, float] | None
    step_mg: tuple[float, float, float]
    spells: list[Spell]
    ready_s: float
    ready_wrong_s: float
    odd_wrong_s: float
    wrongs: list[tuple[float, float]]


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """A recording, its truth, and its tape in each way."""

    name: str
    truth: Truth
    tapes: dict[str, Tape]


def trials(
    folder: Path = DATA / "flights",
    names: Sequence[str] = (UNDISTURBED, *MAGNETS),
    ways: Sequence[str] = WAYS,
) -> Iterator[Trial]:
    """Those of the names that are there; none without the undisturbed one, whose field all others need."""
    files = {n: (folder / f"{n}_imu.tlog", folder / f"{n}_truth.csv") for n in {UNDISTURBED, *names}}
    if not all(f.is_file() for f in files[UNDISTURBED]):
        return
    undisturbed = read(*files[UNDISTURBED])
    here: Room = room(undisturbed)
    for name in names:
        if not all(f.is_file() for f in files[name]):
            continue
        moved = undisturbed if name == UNDISTURBED else read(*files[name])
        known = truth(moved, here, name in MAGNETS)
        yield Trial(name, known, {way: _tape(files[name][0], moved, way) for way in ways})


def _tape(path: Path, moved: Moved, way: str) -> Tape:
    recording: Recording = open_recording(path)
    try:
        (tape,) = tapes(WithAttitude(recording, moved) if way == "optical tilt" else recording, path.name)
    finally:
        recording.close()
    return tape


class _Flown:
    """Heading RMS over one stretch of a recording, for any calibration."""

    def __init__(self, known: Truth, from_s: float, to_s: float) -> None:
        moved = known.moved
        attitude = lagged(moved, known.room.lag_s)
        tilt_ok = attitude[:, 2, 2] >= math.cos(math.radians(MOST_TILT_DEG))
        some = moved.valid & tilt_ok & ~known.odd & (moved.boot_s >= from_s) & (moved.boot_s <= to_s)
        self._mag = moved.mag_b_mg[some]
        angles = np.array([euler(c) for c in attitude[some]]).reshape(-1, 3)
        self._roll, self._pitch = angles[:, 0], angles[:, 1]
        north, east, _ = known.room.field_n_mg
        self._heading = angles[:, 2] - math.atan2(east, north)

    def rms_deg(self, iron_b_mg: Floats, soft_iron_b: Floats) -> float:
        """Against the optical heading."""
        field = (self._mag - iron_b_mg) @ soft_iron_b.T
        off = shortest_rad(magnetic_heading_rad(field, self._roll, self._pitch) - self._heading)
        return math.degrees(float(np.sqrt(np.mean(off**2))))


def level_deg(room: Room, truth: Iron, iron_b_mg: Floats, soft_iron_b: Floats) -> float:
    """Heading error over all level headings of a calibration: soft_iron_b @ (reading - iron_b_mg)."""
    north, east, down = room.field_n_mg
    h = math.hypot(north, east)
    level = np.stack((h * np.cos(HEADINGS_RAD), -h * np.sin(HEADINGS_RAD), np.full(len(HEADINGS_RAD), down)), 1)
    return heading_rms_deg((level @ truth.soft_b.T + truth.hard_b_mg - iron_b_mg) @ soft_iron_b.T)


def judge(trial: Trial, way: str, estimator: str, make: Make | str) -> MagnetRow:
    """One estimator on one recording."""
    known = trial.truth
    moments = run(trial.tapes[way], make)[1]
    end_s = float(known.moved.boot_s[known.moved.valid][-1])
    wrong_s = {True: 0.0, False: 0.0}
    wrongs: list[tuple[float, float]] = []
    ready_s = 0.0
    for m, until_s in zip(moments, [*(n.boot_s for n in moments[1:]), moments[-1].boot_s], strict=True):
        if m.state is not State.READY:
            continue
        ready_s += until_s - m.boot_s
        if _level(known, m) > WRONG_DEG:
            wrong_s[known.odd_at(m.boot_s)] += until_s - m.boot_s
            joins = wrongs and wrongs[-1][1] == m.boot_s
            wrongs[-1:] = [(wrongs[-1][0], until_s)] if joins else [*wrongs[-1:], (m.boot_s, until_s)]
    if known.magnet is None:
        stretches = [("none", float(moments[0].boot_s), end_s, 0.0)]
    else:
        (a, b), (c, d) = known.magnet
        stretches = [("on", b, c, known.turned_s(0.0, a)), ("off", d, end_s, known.turned_s(b, c))]
    step = np.zeros(3) if known.with_magnet is None else known.with_magnet.offset_b_mg - known.iron.offset_b_mg
    x, y, z = step.tolist()
    return MagnetRow(
        file=trial.name,
        way=way,
        estimator=estimator,
        on_s=None if known.magnet is None else known.magnet.on_s,
        off_s=None if known.magnet is None else known.magnet.off_s,
        step_mg=(x, y, z),
        spells=[_spell(known, moments, *s) for s in stretches],
        ready_s=ready_s,
        ready_wrong_s=wrong_s[False],
        odd_wrong_s=wrong_s[True],
        wrongs=wrongs,
    )


def _level(known: Truth, m: Moment) -> float:
    if not m.known:
        return NOTHING_DEG
    return level_deg(known.room, known.iron_at(m.boot_s), m.estimate.hard_iron_b_mg, m.estimate.soft_iron_b)


def _spell(known: Truth, moments: list[Moment], what: str, from_s: float, to_s: float, before_s: float) -> Spell:
    iron = known.iron_at(0.5 * (from_s + to_s))
    flown = _Flown(known, from_s, to_s)
    flown_best = flown.rms_deg(iron.offset_b_mg, np.eye(3))
    level_best = level_deg(known.room, iron, iron.offset_b_mg, np.eye(3))
    within = [m for m in moments if from_s <= m.boot_s <= to_s and not known.odd_at(m.boot_s)]
    level, air = [], []
    for m in within:
        level.append((m.boot_s, _level(known, m) - level_best))
        rms = flown.rms_deg(m.estimate.hard_iron_b_mg, m.estimate.soft_iron_b) if m.known else NOTHING_DEG
        air.append((m.boot_s, rms - flown_best))
    turning = known.turning_from(from_s)
    x, y, z = (within[-1].estimate.hard_iron_b_mg - iron.offset_b_mg).tolist()
    return Spell(
        what=what,
        from_s=from_s,
        turning_from_s=turning,
        to_s=to_s,
        turned_before_s=before_s,
        level_s=_settled(level, turning),
        flown_s=_settled(air, turning),
        level_best_deg=level_best,
        flown_best_deg=flown_best,
        level_deg=level[-1][1],
        flown_deg=air[-1][1],
        iron_error_mg=(x, y, z),
    )


def _settled(errors: list[tuple[float, float]], from_s: float) -> float | None:
    """Seconds from a time until the error is under WITHIN_DEG for good; None for never, 0 where it was before."""
    when = None
    for t, deg in reversed(errors):
        if deg >= WITHIN_DEG:
            break
        when = t
    return None if when is None else max(0.0, when - from_s)
