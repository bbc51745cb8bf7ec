"""The messages of a DataFlash log as ArduPilot 4.5 lays them out: what the log's own FMT, FMTU, UNIT and MULT say."""

from __future__ import annotations

from typing import NamedTuple


class Layout(NamedTuple):
    """One message: its number, and per column a format letter, a name, a unit letter and a multiplier letter."""

    number: int
    name: str
    format: str
    columns: str
    units: str
    multipliers: str


STRUCT = {
    "b": "b", "B": "B", "h": "h", "H": "H", "i": "i", "I": "I", "q": "q", "Q": "Q", "f": "f", "d": "d", "M": "B",
    "c": "h", "C": "H", "e": "i", "E": "I", "L": "i", "n": "4s", "N": "16s", "Z": "64s",
}  # fmt: skip
"""Format letter to the letter of Python's struct, little-endian and unpadded."""

SCALE = {"c": 100, "C": 100, "e": 100, "E": 100, "L": 10_000_000}
"""Format letters that hold whole numbers of a fraction: how many make one."""

UNITS = {
    "-": "", "?": "UNKNOWN", "#": "instance", "%": "%", "A": "A", "D": "deglatitude", "E": "rad/s", "G": "Gauss",
    "O": "degC", "P": "Pa", "S": "satellites", "U": "deglongitude", "X": "W.h", "Y": "us", "a": "Ah", "b": "B",
    "d": "deg", "h": "degheading", "k": "deg/s", "m": "m", "n": "m/s", "o": "m/s/s", "s": "s", "v": "V", "w": "Ohm",
    "z": "Hz",
}  # fmt: skip

MULTIPLIERS = {"-": 0.0, "?": 1.0, "0": 1.0, "A": 1e-1, "B": 1e-2, "C": 1e-3, "F": 1e-6, "G": 1e-7}

_COMMON = (
    Layout(128, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns", "-b---", "-----"),
    Layout(161, "UNIT", "QbZ", "TimeUS,Id,Label", "s--", "F--"),
    Layout(160, "FMTU", "QBNN", "TimeUS,FmtType,UnitIds,MultIds", "s---", "F---"),
    Layout(162, "MULT", "Qbd", "TimeUS,Id,Mult", "s--", "F--"),
    Layout(64, "PARM", "QNff", "TimeUS,Name,Value,Default", "s---", "F---"),
    Layout(91, "MSG", "QZ", "TimeUS,Message", "s-", "F-"),
    Layout(127, "MODE", "QMBB", "TimeUS,Mode,ModeNum,Rsn", "s---", "F---"),
    Layout(185, "ARM", "QBIBB", "TimeUS,ArmState,ArmChecks,Forced,Method", "s----", "F----"),
    Layout(180, "EV", "QB", "TimeUS,Id", "s-", "F-"),
    Layout(
        117, "MAG", "QBhhhhhhhhhBI", "TimeUS,I,MagX,MagY,MagZ,OfsX,OfsY,OfsZ,MOX,MOY,MOZ,Health,S",
        "s#GGGGGGGGG-s", "F-CCCCCCCCC-F",
    ),
    Layout(
        146, "IMU", "QBffffffIIfBBHH", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz",
        "s#EEEooo--O--zz", "F-000000-----00",
    ),
    Layout(
        105, "ATT", "QccccCCCCB", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw,ErrRP,ErrYaw,AEKF",
        "sddddhhdh-", "FBBBBBBBB-",
    ),
    Layout(
        77, "XKF1", "QBccCfffffffccce", "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD,dPD,PN,PE,PD,GX,GY,GZ,OH",
        "s#ddhnnnnmmmkkkm", "F-BBB0000000BBBB",
    ),
    Layout(
        119, "GPS", "QBBIHBcLLeffffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U",
        "s#-s-S-DUmnhnh-", "F--C-0BGGB000--",
    ),
    Layout(107, "POS", "QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt", "sDUmmm", "FGG000"),
    Layout(
        115, "BAT", "QBfffffcfB", "TimeUS,Inst,Volt,VoltR,Curr,CurrTot,EnrgTot,Temp,Res,RemPct",
        "s#vvAaXOw%", "F-000C0?00",
    ),
    Layout(
        95, "RCOU", "QHHHHHHHHHHHHHH", "TimeUS,C1,C2,C3,C4,C5,C6,C7,C8,C9,C10,C11,C12,C13,C14",
        "sYYYYYYYYYYYYYY", "F--------------",
    ),
    Layout(
        97, "BARO", "QBffcfIffB", "TimeUS,I,Alt,Press,Temp,CRt,SMS,Offset,GndTemp,Health",
        "s#mPOnsmO-", "F-00B0C?0-",
    ),
)  # fmt: skip

_COPTER = Layout(
    0, "CTUN", "Qffffffefffhh", "TimeUS,ThI,ABst,ThO,ThH,DAlt,Alt,BAlt,DSAlt,SAlt,TAlt,DCRt,CRt",
    "s----mmmmmmnn", "F----00B000BB",
)  # fmt: skip
_PLANE = (
    Layout(
        0, "CTUN", "QccccffffBffi", "TimeUS,NavRoll,Roll,NavPitch,Pitch,ThO,RdO,ThD,As,AsT,SAs,E2T,GU",
        "sdddd---n-n-n", "FBBBB---000-B",
    ),
    Layout(
        1, "STAT", "QBfBBBBBB", "TimeUS,isFlying,isFlyProb,Armed,Safety,Crash,Still,Stage,Hit",
        "s--------", "F--------",
    ),
)  # fmt: skip

LAYOUTS = {
    True: {layout.name: layout for layout in (*_COMMON, _COPTER)},
    False: {layout.name: layout for layout in (*_COMMON, *_PLANE)},
}
"""Name to layout, for a copter (True) and for a plane."""
