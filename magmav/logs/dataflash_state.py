"""What the vehicle of a DataFlash log is, what it holds, and whether it was armed and flying, as readings."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from magmav.core.types import Landed, LandedReading, ParamReading, Reading, VehicleReading
from magmav.logs.columns import Ints
from magmav.logs.dataflash_clock import Moments
from magmav.logs.dataflash_series import Log, Pick, Series, Stream, chosen

_COMPONENT, _ECHO, _ARDUPILOT = 1, 65535, 3
_STANDBY, _ACTIVE = 3, 4  # MAV_STATE
_NAME = re.compile(r"[A-Z0-9_]{1,16}\Z")
_BEAT_NS = 1_000_000_000
# Events of ArduPilot (AP_Logger.h, LogEvent). LAND_COMPLETE_MAYBE (17) is a guess and says nothing.
_ARMED, _DISARMED, _AUTO_ARMED, _LANDED, _NOT_LANDED = 10, 11, 15, 18, 28
_TURNING = 0.05  # share of full throttle at which motors certainly turn

_GENERIC, _PLANE, _HELI, _TRACKER, _AIRSHIP, _ROVER, _BOAT, _SUB, _VTOL = 0, 1, 4, 5, 7, 10, 11, 12, 22
_QUAD = 2
_COPTER_FRAMES = {1: 2, 2: 13, 3: 14, 4: 14, 5: 13, 6: 4, 7: 15, 8: 3, 9: 3, 10: 3, 11: 4, 12: 29, 13: 4, 14: 35}
"""FRAME_CLASS of ArduCopter to MAV_TYPE."""
_OLD_FRAMES = {
    "QUAD": 2,
    "TRI": 15,
    "HEXA": 13,
    "Y6": 13,
    "OCTA": 14,
    "OCTA_QUAD": 14,
    "HELI": 4,
    "SINGLE": 3,
    "COAX": 3,
}
_FIRMWARE = (
    (re.compile(r"Copter"), _QUAD),
    (re.compile(r"Plane"), _PLANE),
    (re.compile(r"Rover|APMrover"), _ROVER),
    (re.compile(r"ArduSub|APM:Sub"), _SUB),
    (re.compile(r"AntennaTracker"), _TRACKER),
    (re.compile(r"Blimp"), _AIRSHIP),
)


def parameters(log: Log) -> list[tuple[Moments, list[str], list[float]]]:
    """(when, names, values) of every PARM record, damage dropped and counted."""
    out = []
    for table in log.tables.of("PARM"):
        if not table.has_text("Name") or "Value" not in table:
            continue
        when, good = log.clock.moments(table)
        names, values = table.texts("Name"), table.base("Value")
        named = np.array([bool(_NAME.match(n)) for n in names], dtype=bool) & np.isfinite(values)
        log.counts["PARM: not believable"] += int((~named).sum())
        rows = np.flatnonzero(good & named)
        out.append((when.only(rows), [names[i] for i in rows.tolist()], values[rows].tolist()))
    return out


def last_values(parameters: list[tuple[Moments, list[str], list[float]]]) -> dict[str, float]:
    """Name -> value at the end of the file."""
    return {n: v for _, names, values in parameters for n, v in zip(names, values, strict=True)}


def param_streams(
    parameters: list[tuple[Moments, list[str], list[float]]], system: int, heard_ns: Mapping[int, int]
) -> list[Stream]:
    """Stored values as they became known, before the readings of that time.

    heard_ns : for boots after the first, the time by which a listener has noticed the reboot; what came before would be
    forgotten with the former boot's values, so it is told then.
    """
    return [_params(*part, system, heard_ns) for part in parameters]


def _params(when: Moments, names: list[str], values: list[float], system: int, heard_ns: Mapping[int, int]) -> Stream:
    floor = np.array([heard_ns.get(b, 0) for b in when.boot.tolist()], dtype=np.int64)
    late = Moments(when.at, when.boot, np.maximum(when.ns, floor))

    def make(i: int) -> Reading:
        return ParamReading(system, _COMPONENT, names[i], values[i], _ECHO, 0)

    return Stream(late, make, rank=0)


def system_of(held: Mapping[str, float]) -> int:
    """The vehicle's MAVLink system id, 1 where the log does not say."""
    value = held.get("SYSID_THISMAV", held.get("MAV_SYSID", 1.0))
    return int(value) if 1.0 <= value <= 255.0 else 1


def kind_of(log: Log, held: Mapping[str, float]) -> int:
    """MAV_TYPE, from the firmware's name in MSG or VER and from the frame parameters; 0 (generic) where unknown."""
    sources = [(t, label) for name, label in (("MSG", "Message"), ("VER", "FWS")) for t in log.tables.of(name)]
    said = [text for table, label in sources if table.has_text(label) for text in table.texts(label)]
    base = next((kind for text in said for pattern, kind in _FIRMWARE if pattern.search(text)), _GENERIC)
    frame = int(held.get("FRAME_CLASS", 0.0))
    if base == _PLANE:
        chosen_kind = int(held.get("Q_MAV_TYPE", 0.0))
        return (chosen_kind or _VTOL) if held.get("Q_ENABLE", 0.0) >= 1.0 else _PLANE
    if base == _ROVER:
        return _BOAT if frame == 2 else _ROVER
    if base != _QUAD:
        return base
    old = next((m.group(1) for t in said if (m := re.match(r"Frame: (\w+)", t))), "")
    return _COPTER_FRAMES.get(frame) or _OLD_FRAMES.get(old.upper()) or (_HELI if "H_SW_TYPE" in held else _QUAD)


def arming(log: Log, held: Mapping[str, float], throttle: Series) -> Series:
    """(n, 1) 1 where the vehicle was armed from then on, 0 where it was disarmed.

    Said by ARM, else by EV, else by STAT (planes). Where none of them is in the log: a vehicle that logs only while
    armed (LOG_DISARMED 0) was armed throughout; else it was from the first to the last time its throttle was open.
    """
    arm = log.series("ARM", (Pick(("ArmState",)),))
    if len(arm):
        return Series(arm.when, (arm.values > 0).astype(float))
    events = log.series("EV", (Pick(("Id",)),))
    armed, told = (
        np.isin(events.values[:, 0], ids) for ids in ((_ARMED, _AUTO_ARMED), (_ARMED, _AUTO_ARMED, _DISARMED))
    )
    if told.any():
        return Series(events.when.only(told), armed[told][:, None].astype(float))
    stat = log.series("STAT", (Pick(("Armed",)),))
    if len(stat):
        return Series(stat.when, (stat.values > 0).astype(float))
    log.counts["arming not logged: judged by what else there is"] += 1
    if held.get("LOG_DISARMED") == 0.0:
        firsts = np.array(log.clock.first_ns, dtype=np.int64)
        boots = np.arange(log.clock.boots)
        return Series(Moments(np.zeros_like(boots), boots, firsts), np.ones((len(boots), 1)))
    open_ = throttle.values[:, 0] > _TURNING
    picks: list[int] = []
    for boot in range(log.clock.boots):
        rows = np.flatnonzero(open_ & (throttle.when.boot == boot))
        picks += [int(rows[0]), int(rows[-1])] if len(rows) > 1 else []
    out = np.tile([[1.0], [0.0]], (len(picks) // 2, 1))
    return Series(throttle.when.only(np.array(picks, dtype=np.int64)), out)


def vehicle_stream(log: Log, system: int, kind: int, armed: Series) -> list[Stream]:
    """A heartbeat a second, and one whenever arming changed. Before a boot's first change the opposite held."""
    out = []
    for boot in range(log.clock.boots):
        here = chosen(armed, armed.when.boot == boot)
        beats = np.arange(log.clock.first_ns[boot], log.clock.last_ns[boot] + 1, _BEAT_NS, dtype=np.int64)
        ns: Ints = np.union1d(beats, here.when.ns)
        after = np.searchsorted(here.when.ns, ns, side="right") - 1
        first = 1.0 - here.values[0, 0] if len(here) else 0.0
        now = np.where(after >= 0, here.values[np.maximum(after, 0), 0], first) if len(here) else np.zeros(len(ns))
        flags = (now > 0.0).tolist()
        nowhere = np.full(len(ns), -1, dtype=np.int64)

        def make(i: int, flags: list[bool] = flags) -> Reading:
            state = _ACTIVE if flags[i] else _STANDBY
            return VehicleReading(system, _COMPONENT, _ARDUPILOT, kind, flags[i], state)

        out.append(Stream(Moments(nowhere, np.full(len(ns), boot, dtype=np.int64), ns), make, rank=1))
    return out


def landed_stream(log: Log, system: int) -> list[Stream]:
    """On the ground or in the air, where the log says so: events of copters, STAT of planes."""
    events = log.series("EV", (Pick(("Id",)),))
    events = chosen(events, np.isin(events.values[:, 0], (_LANDED, _NOT_LANDED)))
    air = events.values[:, 0] == _NOT_LANDED
    when = events.when
    if not len(events):
        stat = log.series("STAT", (Pick(("isFlying",)),))
        flying = stat.values[:, 0] > 0
        news = np.ones(len(stat), dtype=bool)
        news[1:] = (flying[1:] != flying[:-1]) | (stat.when.boot[1:] != stat.when.boot[:-1])
        when, air = stat.when.only(news), flying[news]
    states = [Landed.IN_AIR if a else Landed.ON_GROUND for a in air.tolist()]

    def make(i: int) -> Reading:
        return LandedReading(system, states[i])

    return [Stream(when, make)]
