"""The autopilot's parameter table: names, types and manners of storing a value; ArduPilot's rows, old names or new."""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterable, Iterator

INT8, INT16, INT32, REAL32 = 2, 4, 6, 9
_BIGGEST_FLOAT32 = 3.4028234663852886e38
_RANGE = {INT8: (-128, 127), INT16: (-32768, 32767), INT32: (-2147483648, 2147483647)}


def compass_name(stem: str, compass: int, axis: str = "") -> str:
    """ArduPilot's name for a compass parameter, e.g. ("OFS", 2, "X") is COMPASS_OFS2_X."""
    if stem == "EXTERNAL":
        return "COMPASS_EXTERNAL" if compass == 1 else f"COMPASS_EXTERN{compass}"
    number = "" if compass == 1 else str(compass)
    return f"COMPASS_{stem}{number}{'_' + axis if axis else ''}"


def _compass_rows() -> Iterator[tuple[str, int, float]]:
    for n in (1, 2, 3):
        for stem, default in (("OFS", 0.0), ("DIA", 1.0), ("ODI", 0.0), ("MOT", 0.0)):
            for axis in "XYZ":
                yield compass_name(stem, n, axis), REAL32, default
        yield compass_name("SCALE", n), REAL32, 0.0
        yield compass_name("USE", n), INT8, 1
        yield compass_name("ORIENT", n), INT8, 0
        yield compass_name("EXTERNAL", n), INT8, 0
        yield compass_name("DEV_ID", n), INT32, 0
        yield f"COMPASS_PRIO{n}_ID", INT32, 0
    for name, kind, value in (
        ("ENABLE", INT8, 1), ("DEC", REAL32, 0), ("AUTODEC", INT8, 1), ("LEARN", INT8, 0), ("MOTCT", INT8, 0),
        ("PMOT_EN", INT8, 0), ("PMOT_EXP", REAL32, 0), ("CAL_FIT", REAL32, 16), ("OFFS_MAX", INT16, 1800),
        ("AUTO_ROT", INT8, 2), ("FLTR_RNG", INT8, 0), ("DISBLMSK", INT32, 0), ("OPTIONS", INT16, 0),
    ):  # fmt: skip
        yield f"COMPASS_{name}", kind, value


_OTHERS: tuple[tuple[str, int, float], ...] = (
    ("SYSID_THISMAV", INT16, 1), ("SYSID_MYGCS", INT16, 255), ("SYSID_ENFORCE", INT8, 0),
    ("ARMING_CHECK", INT32, 0), ("ARMING_REQUIRE", INT8, 1), ("ARMING_MAGTHRESH", INT16, 100),
    ("AHRS_ORIENTATION", INT8, 0), ("AHRS_EKF_TYPE", INT8, 3), ("AHRS_GPS_USE", INT8, 1), ("AHRS_YAW_P",
    REAL32, 0.2), ("AHRS_RP_P", REAL32, 0.2), ("AHRS_TRIM_X", REAL32, 0), ("AHRS_TRIM_Y", REAL32, 0),
    ("AHRS_TRIM_Z", REAL32, 0), ("BATT_MONITOR", INT8, 4), ("BATT_CAPACITY", INT32, 5200),
    ("BATT_AMP_PERVLT", REAL32, 17), ("BATT_AMP_OFFSET", REAL32, 0), ("BATT_VOLT_MULT", REAL32, 10.1),
    ("BATT_LOW_VOLT", REAL32, 10.5), ("BATT_CRT_VOLT", REAL32, 10.0), ("BATT_FS_LOW_ACT", INT8, 0),
    ("BATT_ARM_VOLT", REAL32, 0), ("EK3_ENABLE", INT8, 1), ("EK3_IMU_MASK", INT8, 3), ("EK3_MAG_CAL", INT8,
    3), ("EK3_SRC1_YAW", INT8, 1), ("EK3_MAG_I_GATE", INT16, 300), ("EK3_MAG_M_NSE", REAL32, 0.05),
    ("EK3_MAGB_P_NSE", REAL32, 0.0001), ("EK3_MAGE_P_NSE", REAL32, 0.001), ("EK3_MAG_MASK", INT8, 0),
    ("FS_THR_ENABLE", INT8, 1), ("FS_GCS_ENABLE", INT8, 0), ("FS_EKF_ACTION", INT8, 1), ("FS_EKF_THRESH",
    REAL32, 0.8), ("DISARM_DELAY", INT8, 10), ("FRAME_CLASS", INT8, 1), ("FRAME_TYPE", INT8, 1),
    ("GPS_TYPE", INT8, 1), ("GPS_TYPE2", INT8, 0), ("INS_ENABLE_MASK", INT8, 127), ("INS_GYRO_FILTER",
    INT16, 20), ("INS_ACCEL_FILTER", INT16, 20), ("INS_GYROFFS_X", REAL32, 0.00123), ("INS_GYROFFS_Y",
    REAL32, -0.00211), ("INS_GYROFFS_Z", REAL32, 0.00047), ("LOG_BITMASK", INT32, 176126), ("LOG_DISARMED",
    INT8, 0), ("LOG_BACKEND_TYPE", INT8, 1), ("MOT_THST_HOVER", REAL32, 0.41), ("MOT_SPIN_MIN", REAL32, 0.15),
    ("MOT_SPIN_ARM", REAL32, 0.1), ("RTL_ALT", INT16, 1500), ("LAND_SPEED", INT16, 50), ("WPNAV_SPEED",
    REAL32, 500), ("SR0_RAW_SENS", INT16, 0), ("SR0_EXT_STAT", INT16, 0), ("SR0_POSITION", INT16, 0),
    ("SR0_EXTRA1", INT16, 0), ("SR0_EXTRA2", INT16, 0), ("SR0_EXTRA3", INT16, 0), ("SERIAL0_BAUD", INT32,
    115), ("SERIAL0_PROTOCOL", INT8, 2), ("BRD_SAFETY_MASK", INT32, 0), ("SCHED_LOOP_RATE", INT16, 400),
("STAT_BOOTCNT", INT16, 17), )  # fmt: skip


_NUMBERED = re.compile(
    r"COMPASS_(?P<stem>OFS|DIA|ODI|MOT|SCALE|USE|ORIENT|DEV_ID|EXTERN)(?P<number>[23]?)(?P<axis>_[XYZ])?"
)


def new_name(name: str) -> str:
    """The name in the newer scheme: COMPASS2_OFS_X for COMPASS_OFS2_X; what is not of one compass keeps its name."""
    if name == "COMPASS_EXTERNAL":
        return "COMPASS1_EXTERN"
    found = _NUMBERED.fullmatch(name)
    return name if found is None else f"COMPASS{found['number'] or 1}_{found['stem']}{found['axis'] or ''}"


class Parameters:
    """Name to (type, value), in list order. Values are what fits the type: float32, or a whole number in
    range.

    rows : (name, type, default); ArduPilot's where none are given.  renamed : say ArduPilot's names in the newer
    scheme. Inside the simulator the old names find the values all the same; ``in`` knows only what is said.
    """

    def __init__(self, rows: Iterable[tuple[str, int, float]] | None = None, *, renamed: bool = False) -> None:
        self._kinds: dict[str, int] = {}
        self._values: dict[str, float] = {}
        self._said: dict[str, str] = {}
        for old, kind, value in (*_OTHERS, *_compass_rows()) if rows is None else rows:
            name = new_name(old) if renamed else old
            self._said[old] = name
            self._kinds[name] = kind
            self.put(name, value)
        self.names = list(self._kinds)
        self._index = {name: i for i, name in enumerate(self.names)}

    def __contains__(self, name: object) -> bool:
        return name in self._kinds

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, name: str) -> float:
        return self._values[self._said.get(name, name)]

    def said(self, name: str) -> str:
        """What this parameter is called on the wire."""
        return self._said.get(name, name)

    def kind(self, name: str) -> int:
        """MAV_PARAM_TYPE."""
        return self._kinds[self._said.get(name, name)]

    def index(self, name: str) -> int:
        """Place in the list."""
        return self._index[name]

    def put(self, name: str, value: float) -> None:
        """Store a value as ArduPilot does, without any check of range. ValueError on an unknown name or
        NaN."""
        name = self._said.get(name, name)
        kind = self._kinds.get(name)
        if kind is None:
            raise ValueError(f"parameters: no parameter {name!r}")
        if not abs(value) <= _BIGGEST_FLOAT32:
            raise ValueError(f"parameters: {name} must be a finite float32, got {value}")
        if kind == REAL32:
            self._values[name] = struct.unpack("<f", struct.pack("<f", value))[0]
        else:
            least, most = _RANGE[kind]
            self._values[name] = float(max(least, min(most, int(value + math.copysign(0.01, value)))))

    def vector(self, stem: str, compass: int) -> tuple[float, float, float]:
        """The three axes of a compass parameter."""
        x, y, z = (self[compass_name(stem, compass, axis)] for axis in "XYZ")
        return x, y, z
