"""PX4's parameters, as far as a compass and its companions look: two types, names in alphabetical order."""

from __future__ import annotations

from collections.abc import Iterator

from magmav_sim.parameters import INT32, REAL32

SLOTS = 4
UNSET = -1


def _slot(n: int) -> Iterator[tuple[str, int, float]]:
    name = f"CAL_MAG{n}_"
    for stem, default in (("OFF", 0.0), ("SCALE", 1.0), ("ODIAG", 0.0), ("COMP", 0.0)):
        for axis in "XYZ":
            yield f"{name}{axis}{stem}", REAL32, default
    yield name + "ID", INT32, 0
    yield name + "ROT", INT32, UNSET
    yield name + "PRIO", INT32, UNSET
    for angle in ("ROLL", "PITCH", "YAW"):
        yield name + angle, REAL32, 0.0


_OTHERS: tuple[tuple[str, int, float], ...] = (
    ("MAV_SYS_ID", INT32, 1), ("MAV_COMP_ID", INT32, 1), ("MAV_TYPE", INT32, 2), ("SYS_AUTOSTART", INT32, 4001),
    ("SYS_HAS_MAG", INT32, 1), ("CAL_MAG_COMP_TYP", INT32, 0), ("CAL_MAG_SIDES", INT32, 63),
    ("CAL_MAG_ROT_AUTO", INT32, 1), ("SENS_MAG_AUTOCAL", INT32, 1), ("SENS_MAG_MODE", INT32, 1),
    ("SENS_MAG_RATE", REAL32, 15.0), ("SENS_BOARD_ROT", INT32, 0), ("SENS_BOARD_X_OFF", REAL32, 0.0),
    ("SENS_BOARD_Y_OFF", REAL32, 0.0), ("SENS_BOARD_Z_OFF", REAL32, 0.0), ("EKF2_MAG_TYPE", INT32, 0),
    ("EKF2_MAG_DECL", REAL32, 0.0), ("EKF2_DECL_TYPE", INT32, 7), ("EKF2_MAG_GATE", REAL32, 3.0),
    ("EKF2_MAG_NOISE", REAL32, 0.05), ("MBE_ENABLE", INT32, 1), ("MBE_LEARN_GAIN", REAL32, 18.0),
    ("COM_DISARM_PRFLT", REAL32, 10.0), ("COM_DISARM_LAND", REAL32, 2.0), ("COM_ARM_MAG_ANG", INT32, 60),
    ("BAT1_CAPACITY", REAL32, 5200.0), ("BAT1_N_CELLS", INT32, 4), ("COM_RC_IN_MODE", INT32, 3),
    ("NAV_DLL_ACT", INT32, 0), ("NAV_RCL_ACT", INT32, 2), ("RTL_RETURN_ALT", REAL32, 60.0),
    ("MPC_XY_VEL_MAX", REAL32, 12.0), ("MPC_THR_HOVER", REAL32, 0.5), ("SDLOG_MODE", INT32, 0),
)  # fmt: skip


def rows() -> list[tuple[str, int, float]]:
    """(name, MAV_PARAM_TYPE, default), sorted by name as PX4 lists them."""
    return sorted([*_OTHERS, *(row for n in range(SLOTS) for row in _slot(n))])
