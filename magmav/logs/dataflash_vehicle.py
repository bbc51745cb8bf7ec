"""Where the vehicle of a DataFlash log was, how it moved, what it drew and what time it was, as readings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magmav.core.types import (
    CurrentReading,
    MotionReading,
    PositionReading,
    Reading,
    ThrottleReading,
    TimeReading,
)
from magmav.logs.columns import Floats, Ints
from magmav.logs.dataflash_clock import Moments
from magmav.logs.dataflash_series import Log, Pick, Series, Stream, chosen

_FIX_3D = 3
_PLACE = (Pick(("Lat",), 1.0, whole=1e-7, most=90.0), Pick(("Lng",), 1.0, whole=1e-7, most=180.0))
_ALT = Pick(("Alt",), most=1e5)
_FIX = Pick(("Status",), missing=3.0)
_COURSE = (Pick(("Spd",), most=1e3), Pick(("GCrs",), most=400.0))
_VELOCITY = (Pick(("VN",), most=1e3), Pick(("VE",), most=1e3))
# Best first. GPS.RelAlt hangs on a home that old firmware moved with its drift: 1.5 m low throughout log171.bin.
_HEIGHTS = (("POS", "RelHomeAlt"), ("CTUN", "Alt"), ("GPS", "RelAlt"), ("BARO", "Alt"))
_STALE_NS = 2_000_000_000  # a height older than this is not the vehicle's now
_WEEK = Pick(("GWk", "Week"), most=5000.0)
_OF_WEEK = Pick(("GMS", "TimeMS"), 1e-3, per=1e3, most=604_800_000.0)  # milliseconds
_GPS_EPOCH_S, _WEEK_S = 315_964_800, 604_800
_LEAPS = ((1025136015, 16), (1119744016, 17), (1167264017, 18))  # GPS second from which on UTC is so many behind
_TIME_EVERY_NS = 5_000_000_000
_FULL_PWM, _IDLE_PWM = 2000.0, 1000.0
_MOTORS = 4
_PLANE_KINDS = (1, 10, 11, 12, 22)  # CTUN.ThrOut and THR.ThrOut of these are per cent


def positions(log: Log, system: int) -> list[Stream]:
    """Where the vehicle is: its own estimate (POS), or GPS with a 3-D fix."""
    for name in ("POS", "GPS"):
        series = log.series(name, (*_PLACE, _ALT, _FIX), 0)
        place = series.values[:, :2].any(axis=1)
        log.counts[f"{name}: no position"] += int((~place).sum())
        series = chosen(series, place & (series.values[:, 3] >= _FIX_3D))
        if len(series):
            break
    rows, ns, source = series.values.tolist(), series.when.ns.tolist(), name

    def make(i: int) -> Reading:
        return PositionReading(system, source, ns[i], *rows[i][:3])

    return [Stream(series.when, make)]


def motions(log: Log, system: int) -> list[Stream]:
    """Velocity over ground from GPS, or from the filter where there is no GPS, with the height above home."""
    gps = log.series("GPS", (_FIX, *_COURSE), 0)
    gps = chosen(gps, gps.values[:, 0] >= _FIX_3D)
    course = np.radians(gps.values[:, 2])
    moving = Series(gps.when, np.stack((np.cos(course), np.sin(course)), axis=1) * gps.values[:, 1:2])
    for name in ("XKF1", "NKF1", "EKF1"):
        moving = moving if len(moving) else log.series(name, _VELOCITY, 0)
    heights = _heights(log)
    if not len(moving) or not len(heights):
        return []
    up, fresh = held_at(heights, moving.when)
    moving, ups = chosen(moving, fresh), up[fresh].tolist()
    rows, ns = moving.values.tolist(), moving.when.ns.tolist()

    def make(i: int) -> Reading:
        return MotionReading(system, ns[i], rows[i][0], rows[i][1], ups[i])

    return [Stream(moving.when, make)]


def _heights(log: Log) -> Series:
    """Height above home, m, (n, 1), from the best message that has it."""
    for name, label in _HEIGHTS:
        if any(label in t for t in log.tables.of(name)):
            series = log.series(name, (Pick((label,), most=1e5),), 0)
            if len(series):
                return series
    return log.series("", (Pick(("",)),))


def held_at(series: Series, when: Moments) -> tuple[Floats, NDArray[np.bool_]]:
    """(n,) the first column's latest value at each moment, and (n,) whether it is fresh and of the same boot."""
    have, want = (m.boot * np.int64(1 << 50) + m.ns // 1000 for m in (series.when, when))
    before = np.maximum(np.searchsorted(have, want, side="right") - 1, 0)
    age: Ints = when.ns - series.when.ns[before]
    fresh = (series.when.boot[before] == when.boot) & (age >= -_STALE_NS) & (age <= _STALE_NS)
    return series.values[before, 0], fresh


def currents(log: Log, system: int) -> list[Stream]:
    """Current of the first battery, A. Integers without a stated unit are hundredths, as logs before 2016 have it."""
    for name in ("BAT", "CURR"):
        series = log.series(name, (Pick(("Curr",), 1.0, whole=0.01, most=1e4),), 0)
        if len(series):
            break
    amperes, source = series.values[:, 0].tolist(), name

    def make(i: int) -> Reading:
        return CurrentReading(system, source, amperes[i])

    return [Stream(series.when, make)]


def throttle(log: Log, kind: int) -> Series:
    """(n, 1) throttle as a share of full, 0 to 1.

    Copters log a share, or thousandths in whole numbers (up to 3.3); planes, rovers and boats per cent. Where there
    is none, the mean of the motor outputs between 1000 and 2000 us.
    """
    per_cent = kind in _PLANE_KINDS
    pick = Pick(("ThO", "ThrOut"), 1.0, whole=1.0 if per_cent else 1e-3, per=0.01 if per_cent else 1.0)
    for name in ("CTUN", "THR"):
        if any(label in t for t in log.tables.of(name) for label in pick.labels):
            series = log.series(name, (pick,), 0)
            if len(series):
                share = np.abs(series.values)
                return chosen(Series(series.when, np.minimum(share, 1.0)), share[:, 0] <= 1.5)
    if per_cent:
        return log.series("", (Pick(("",)),))
    outputs = log.series("RCOU", [Pick((f"C{i}", f"Ch{i}"), most=3000.0, missing=0.0) for i in range(1, _MOTORS + 1)])
    share = (outputs.values.mean(axis=1, keepdims=True) - _IDLE_PWM) / (_FULL_PWM - _IDLE_PWM)
    return Series(outputs.when, np.clip(share, 0.0, 1.0))


def throttles(log: Log, system: int, kind: int) -> list[Stream]:
    """Throttle readings, see ``throttle``."""
    series = throttle(log, kind)
    shares = series.values[:, 0].tolist()

    def make(i: int) -> Reading:
        return ThrottleReading(system, shares[i])

    return [Stream(series.when, make)]


def unix_times(log: Log, system: int) -> tuple[list[Stream], int]:
    """UNIX time from GPS week and time of week, every few seconds; and what takes the first boot's time to UNIX time,
    0 where no fix told the date. GPS time is ahead of UTC by the leap seconds of its day."""
    series = log.series("GPS", (_FIX, _WEEK, _OF_WEEK), 0)
    series = chosen(series, (series.values[:, 0] >= _FIX_3D) & (series.values[:, 1] > 0))
    gps_ms = series.values[:, 1].astype(np.int64) * (_WEEK_S * 1000) + series.values[:, 2].astype(np.int64)
    leap = np.full(len(series), 15, dtype=np.int64)
    for since_s, behind in _LEAPS:
        leap[gps_ms >= since_s * 1000] = behind
    unix_ns = (gps_ms - leap * 1000 + _GPS_EPOCH_S * 1000) * 1_000_000
    first = unix_ns[series.when.boot == 0] - series.when.ns[series.when.boot == 0]
    offset = int(np.sort(first)[len(first) // 2]) if len(first) else 0
    slot = series.when.boot * np.int64(1 << 40) + series.when.ns // _TIME_EVERY_NS
    _, seldom = np.unique(slot, return_index=True)
    when, times = series.when.only(seldom), unix_ns[seldom].tolist()
    ns = when.ns.tolist()

    def make(i: int) -> Reading:
        return TimeReading(system, ns[i], times[i])

    return [Stream(when, make)], offset
