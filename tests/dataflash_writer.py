"""Writes DataFlash logs, binary and text, from rows of values. It shares nothing with the reader."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

SIZES = {c: c for c in "bBhHiIqQfd"} | {"M": "B", "g": "e", "n": "4s", "N": "16s", "Z": "64s"}
SIZES |= {"c": "h", "C": "H", "e": "i", "E": "I", "L": "i"}
PARTS = {"c": 100, "C": 100, "e": 100, "E": 100, "L": 10_000_000}
MULTS = {"-": 0.0, "?": 1.0, "0": 1.0, "A": 1e-1, "B": 1e-2, "C": 1e-3, "F": 1e-6, "G": 1e-7}


@dataclass(frozen=True)
class Message:
    """One message: number, name, format letters, labels, and FMTU's unit and multiplier letters where it has any."""

    number: int
    name: str
    letters: str
    labels: str
    units: str = ""
    mults: str = ""

    def body(self, values: Sequence[Any]) -> bytes:
        """One record. Values are in the units a reader shows: degrees, not hundredths."""
        packed = [self._whole(c, v) for c, v in zip(self.letters, values, strict=True)]
        return struct.pack("<BBB" + "".join(SIZES[c] for c in self.letters), 0xA3, 0x95, self.number, *packed)

    @staticmethod
    def _whole(letter: str, value: Any) -> Any:
        if letter in PARTS:
            return round(value * PARTS[letter])
        return value.encode() if isinstance(value, str) else value

    @property
    def size(self) -> int:
        return 3 + struct.calcsize("<" + "".join(SIZES[c] for c in self.letters))


FMT = Message(128, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")
FMTU = Message(200, "FMTU", "QBNN", "TimeUS,FmtType,UnitIds,MultIds")
MULT = Message(201, "MULT", "Qbd", "TimeUS,Id,Mult")

MAG = Message(
    50, "MAG", "QBhhhhhhhhhBI", "TimeUS,I,MagX,MagY,MagZ,OfsX,OfsY,OfsZ,MOX,MOY,MOZ,Health,S", "s#GGGGGGGGG-s",
    "F-CCCCCCCCC-F",
)  # fmt: skip
IMU = Message(51, "IMU", "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ", "s#EEEooo", "F-000000")
ATT = Message(52, "ATT", "QccccCC", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw", "sddddhh", "FBBBBBB")
GPS = Message(
    53, "GPS", "QBBIHBcLLefff", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ", "s#-s-S-DUmnhn",
    "F--C-0BGGB000",
)  # fmt: skip
POS = Message(54, "POS", "QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt", "sDUmmm", "FGG000")
BAT = Message(55, "BAT", "QBff", "TimeUS,Instance,Volt,Curr", "s#vA", "F-00")
CTUN = Message(56, "CTUN", "Qff", "TimeUS,ThI,ThO", "s--", "F--")
PARM = Message(57, "PARM", "QNff", "TimeUS,Name,Value,Default", "s---", "F---")
MSG = Message(58, "MSG", "QZ", "TimeUS,Message", "s-", "F-")
ARM = Message(59, "ARM", "QBI", "TimeUS,ArmState,ArmChecks", "s--", "F--")
EV = Message(60, "EV", "QB", "TimeUS,Id", "s-", "F-")

Row = tuple[Message, tuple[Any, ...]]


@dataclass
class Log:
    """Rows in the order of writing. ``binary`` and ``text`` are the same log."""

    rows: list[Row] = field(default_factory=list)

    def add(self, message: Message, *values: Any) -> None:
        self.rows.append((message, values))

    def head(self) -> list[Row]:
        """FMT of all, then the multipliers, then FMTU."""
        kinds = dict.fromkeys(m for m, _ in self.rows)
        with_units = [m for m in kinds if m.units]
        own = (FMT, MULT, FMTU) if with_units else (FMT,)
        out: list[Row] = [(FMT, (m.number, m.size, m.name, m.letters, m.labels)) for m in (*own, *kinds)]
        if with_units:
            began = next(v[0] for m, v in self.rows if m.labels.startswith("TimeUS"))
            out += [(MULT, (began, ord(c), v)) for c, v in MULTS.items()]
            out += [(FMTU, (began, m.number, m.units, m.mults)) for m in with_units]
        return out

    def pieces(self) -> list[bytes]:
        """Every record by itself."""
        return [m.body(v) for m, v in (*self.head(), *self.rows)]

    def binary(self) -> bytes:
        return b"".join(self.pieces())

    def text(self) -> str:
        return "".join(f"{m.name}, {', '.join(_shown(m, v))}\n" for m, v in (*self.head(), *self.rows))


def _shown(message: Message, values: Iterable[Any]) -> Iterable[str]:
    for letter, value in zip(message.letters, values, strict=True):
        if letter in PARTS:
            yield f"{round(value * PARTS[letter]) / PARTS[letter]:.7f}"
        elif letter == "f":
            yield repr(struct.unpack("<f", struct.pack("<f", value))[0])
        else:
            yield str(value)


def flight(seconds: float = 20.0, *, start_s: float = 5.0, offset_mg: float = 10.0, turn_rads: float = 0.4) -> Log:
    """A copter that turns steadily at 30 m: the new scheme, two compasses, 50 Hz IMU, 10 Hz of the rest."""
    log = Log()
    start = round(start_s * 1e6)
    log.add(MSG, start, "ArduCopter V4.5.1 (abcdef)")
    params = {"SYSID_THISMAV": 7.0, "FRAME_CLASS": 1.0, "COMPASS_DEV_ID": 97539.0, "COMPASS_DEV_ID2": 131874.0}
    params |= {f"COMPASS_OFS{n}_{a}": offset_mg for n in ("", "2") for a in "XYZ"}
    for name, value in params.items():
        log.add(PARM, start, name, value, 0.0)
    log.add(ARM, start + 10, 1, 0)
    for k in range(round(seconds * 50)):
        t, us = k / 50, start + 1000 + k * 20_000
        log.add(IMU, us, 0, 0.0, 0.0, turn_rads, 0.0, 0.0, -9.80665)
        log.add(IMU, us, 1, 0.5, 0.5, turn_rads, 0.0, 0.0, -9.0)
        if k % 5:
            continue
        yaw = turn_rads * t
        log.add(ATT, us + 100, 0.0, 0.0, 0.0, 0.0, 0.0, math.degrees(yaw) % 360.0)
        for i in (0, 1):
            field_mg = (200 * math.cos(yaw), -200 * math.sin(yaw), 430.0)
            log.add(MAG, us + 200, i, *(round(f) for f in field_mg), *(0,) * 6, 1, us)
        log.add(GPS, us + 300, 0, 3, 86_400_000 + round(t * 1000), 2300, 12, 0.8, 47.4, 8.55, 500.0, 3.0, 90.0, 0.0)
        log.add(POS, us + 300, 47.4, 8.55, 500.0, 30.0, 30.0)
        log.add(BAT, us + 400, 0, 15.0, 12.5)
        log.add(CTUN, us + 500, 0.5, 0.45)
    return log
