"""Compasses, inertial sensors and attitude of a DataFlash log, as readings."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magmav.core.motion_run import AttitudeColumns, attitude_columns
from magmav.core.types import AttitudeReading, InertialReading, MagReading, Reading
from magmav.logs.columns import Floats
from magmav.logs.dataflash_series import Log, Pick, Series, Stream, chosen, triples

# As in mavlink.decode: what lies beyond is damage, and would poison a filter.
_MOST_RADS, _MOST_DEG, _MOST_MSS, _MOST_MG = 100.0, 361.0, 1e4, 1e5
_COMPASSES = 3
_FIELD = tuple(Pick((f"Mag{a}",), 1e-3, per=1e3, most=_MOST_MG) for a in "XYZ")  # gauss times 1000
_MAG = (*_FIELD, Pick(("Health",), missing=1.0))
_GYRO = tuple(Pick((f"Gyr{a}",), most=_MOST_RADS) for a in "XYZ")
_FORCE = tuple(Pick((f"Acc{a}",), most=_MOST_MSS) for a in "XYZ")
_ANGLES = tuple(Pick((label,), most=_MOST_DEG) for label in ("Roll", "Pitch", "Yaw"))
_ATTITUDES = ("ATT", "XKF1", "NKF1", "EKF1", "AHR2")
_ENOUGH = 0.1  # of the samples of the fullest source make a better one preferable
_GAP_S = 0.5  # no gyro for so long says nothing of the rate in between


def mags(log: Log, system: int) -> list[Stream]:
    """The field of each compass as logged (corrected by the autopilot), mG, body axes.

    MAG with an instance, or MAG, MAG2 and MAG3. All zero, or said not to be healthy, is no reading.
    """
    sources = [(name, 0, int(name[3:] or 1)) for name in ("MAG2", "MAG3")]
    sources += [("MAG", i, i + 1) for i in range(_COMPASSES)]
    for table in log.tables.of("MAG"):
        log.counts["MAG: instance over 3"] += int((table.instance() >= _COMPASSES).sum())
    return [s for name, instance, compass in sources if (s := _mag(log, system, name, instance, compass)) is not None]


def _mag(log: Log, system: int, name: str, instance: int, compass: int) -> Stream | None:
    series = log.series(name, _MAG, instance)
    if not len(series):
        return None
    zero, ill = ~series.values[:, :3].any(axis=1), series.values[:, 3] == 0.0
    log.counts[f"{name}: no compass (all zero)"] += int(zero.sum())
    log.counts[f"{name}: not healthy"] += int((ill & ~zero).sum())
    good = chosen(series, ~zero & ~ill)
    fields, ns = triples(good.values[:, :3]), good.when.ns.tolist()

    def make(i: int) -> Reading:
        return MagReading(system, compass, name, ns[i], fields[i])

    return Stream(good.when, make)


def inertial(log: Log, system: int) -> list[Stream]:
    """Specific force (m/s^2) and rates (rad/s) of the first IMU, body axes."""
    series = log.series("IMU", (*_FORCE, *_GYRO), 0)
    forces, rates, ns = triples(series.values[:, :3]), triples(series.values[:, 3:]), series.when.ns.tolist()

    def make(i: int) -> Reading:
        return InertialReading(system, "IMU", ns[i], forces[i], rates[i])

    return [Stream(series.when, make, inertial=True)]


def attitude(log: Log, system: int) -> list[Stream]:
    """Attitude, from one message for the whole file, with body rates from the gyro.

    ATT is preferred, then the first core of the filter, then AHR2, unless it has less than a tenth of the samples of
    the fullest. Angles are logged unwrapped at times (a roll of -181 degrees), and come out in (-pi, pi].
    """
    found = {name: s for name in _ATTITUDES if len(s := log.series(name, _ANGLES, 0))}
    if not found:
        return []
    fullest = max(map(len, found.values()))
    name, series = next((n, s) for n, s in found.items() if len(s) >= _ENOUGH * fullest)
    rates, known = body_rates(log, series)
    log.counts[f"{name}: no body rates then"] += int((~known).sum())
    series = chosen(series, known)
    angles = -np.remainder(-np.radians(series.values) + math.pi, 2.0 * math.pi) + math.pi
    rows, vectors, ns = angles.tolist(), triples(rates[known]), series.when.ns.tolist()

    def make(i: int) -> Reading:
        roll, pitch, yaw = rows[i]
        return AttitudeReading(system, name, ns[i], roll, pitch, yaw, vectors[i])

    def columns() -> AttitudeColumns:
        held = np.array(vectors).reshape(-1, 3)
        return attitude_columns(name, series.when.ns, angles, held, np.ones(len(held), dtype=bool), series.when.boot)

    return [Stream(series.when, make, attitudes=columns)]


def body_rates(log: Log, attitudes: Series) -> tuple[Floats, NDArray[np.bool_]]:
    """(n, 3) body rates at these moments, rad/s, and (n,) where they are known.

    The gyro's mean over one interval of the attitude, centred: heading is integrated from these by trapezoid, and a
    snapshot ten times a second misses what the vehicle does in between. RATE is no substitute: its unit changed over
    the years (hundredths of a degree per second in 2015) and nothing in the log says which it is.
    """
    gyro = log.series("IMU", _GYRO, 0)
    out = np.zeros((len(attitudes), 3))
    known = np.zeros(len(attitudes), dtype=bool)
    for boot in range(log.clock.boots):
        here, there = attitudes.when.boot == boot, gyro.when.boot == boot
        if there.sum() >= 2:
            mean, fine = _box_mean(gyro.when.ns[there] / 1e9, gyro.values[there], attitudes.when.ns[here] / 1e9)
            out[here], known[here] = mean, fine
    return out, known


def _box_mean(t_s: Floats, values: Floats, at_s: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """(n, 3) mean of a sampled signal around each moment, over their usual interval; and where it is known."""
    t_s, first = np.unique(t_s, return_index=True)
    values = values[first]
    if len(t_s) < 2:
        return np.zeros((len(at_s), 3)), np.zeros(len(at_s), dtype=bool)
    steps = np.diff(t_s)
    sums = np.concatenate((np.zeros((1, 3)), np.cumsum(0.5 * (values[1:] + values[:-1]) * steps[:, None], axis=0)))
    own = np.diff(at_s)
    half = 0.5 * float(np.median(own[own > 0])) if (own > 0).any() else 0.05
    half = max(min(half, 0.5 * _GAP_S), 0.5 * float(np.median(steps)))
    begin, end = np.clip(at_s - half, t_s[0], t_s[-1]), np.clip(at_s + half, t_s[0], t_s[-1])
    length = np.maximum(end - begin, 1e-9)
    mean = np.stack([(np.interp(end, t_s, s) - np.interp(begin, t_s, s)) / length for s in sums.T], axis=1)
    next_one = np.clip(np.searchsorted(t_s, at_s), 1, len(t_s) - 1)
    fine = (t_s[next_one] - t_s[next_one - 1] <= _GAP_S) & (end - begin >= half)
    return mean, fine
