"""PX4's compass parameters by name, and what a writer must know of them (autopilots.md sections 4.1 to 4.6).

CAL_MAGn_XOFF and its kin: gauss, subtracted, in the sensor's own axes. The number n is a slot and says nothing of which
compass is in it; CAL_MAGn_ID does.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.core.types import Change
from magmav.mavlink.autopilot.allowed import allowed
from magmav.mavlink.codec import Message
from magmav.mavlink.float32 import same
from magmav.mavlink.values import bytewise, set_bytewise

SLOTS = (0, 1, 2, 3)
AXES = ("X", "Y", "Z")
MG_PER_GAUSS = 1000.0
AUTOCAL = "SENS_MAG_AUTOCAL"
COMMON = ("SENS_BOARD_ROT", "SENS_BOARD_X_OFF", "SENS_BOARD_Y_OFF", "SENS_BOARD_Z_OFF", "CAL_MAG_COMP_TYP")
_OF_SLOT = (
    "ID", "ROT", "PRIO", *(f"{a}{what}" for what in ("OFF", "SCALE", "ODIAG", "COMP") for a in AXES), "ROLL", "PITCH",
    "YAW",
)  # fmt: skip
_OFFSET = re.compile(r"CAL_MAG([0-3])_[XYZ]OFF")
_DEVICE = re.compile(r"CAL_MAG([0-3])_ID")


def slot_names(n: int) -> tuple[str, ...]:
    """Every parameter of slot n that is read."""
    return tuple(f"CAL_MAG{n}_{what}" for what in _OF_SLOT)


def offsets_of(n: int) -> tuple[str, str, str]:
    """Offsets of slot n."""
    return f"CAL_MAG{n}_XOFF", f"CAL_MAG{n}_YOFF", f"CAL_MAG{n}_ZOFF"


class Px4:
    """Adapter for MAV_AUTOPILOT_PX4: gauss, subtracted, sensor axes; numbers byte-wise; no stream proves a write.

    A change of 10 mG or less PX4 takes up on restart only (older releases; newer ones 5 mG).
    """

    kind = int(dialect.MAV_AUTOPILOT_PX4)
    least_step_mg = 10.0
    unit_mg = MG_PER_GAUSS
    compass_streams: tuple[str, ...] = ("SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3")  # there is no RAW_IMU
    unproven = "no stream of PX4 shows their effect: SCALED_IMU has no offsets in it, HIGHRES_IMU not EKF2's own bias"
    slow_streams: tuple[str, ...] = ("MAG_CAL_REPORT",)  # which slot a compass uses; sent when parameters change

    def names(self, compasses: Iterable[int], answered: Collection[str] = ()) -> tuple[str, ...]:
        """All slots, whichever compasses are asked for: a compass may be in any."""
        ids = self.whose(answered)  # first: they say which slots count
        return tuple(dict.fromkeys([*ids, *(name for n in SLOTS for name in slot_names(n)), *COMMON, AUTOCAL]))

    def whose(self, answered: Collection[str]) -> tuple[str, ...]:
        """The device ids of all slots."""
        return tuple(f"CAL_MAG{n}_ID" for n in SLOTS)

    def offset_names(self, compass: int) -> tuple[str, str, str]:
        """Offsets of the slot a vehicle with its compasses in order would use."""
        return offsets_of(_slot(compass))

    def device_name(self, compass: int) -> str:
        """CAL_MAGn_ID of that slot."""
        return f"CAL_MAG{_slot(compass)}_ID"

    def checked(self, change: Change) -> Change:
        """The same change in exact 32-bit floats. ValueError names what may not be written or does not fit."""
        return allowed(change, _OFFSET, _DEVICE)

    def triple(self, change: Change) -> tuple[str, str, str]:
        """All three offset names of this slot."""
        stem = change.names[0][: len("CAL_MAG0_")]
        return f"{stem}XOFF", f"{stem}YOFF", f"{stem}ZOFF"

    def reads(self, change: Change) -> tuple[str, ...]:
        """Offsets, the device ids of all slots (its own first), and who else writes."""
        own = change.device_name
        others = [f"CAL_MAG{n}_ID" for n in SLOTS if f"CAL_MAG{n}_ID" != own]
        return (*self.triple(change), own, *others, AUTOCAL)

    def second_writer(self, stored: Mapping[str, float]) -> bool:
        """SENS_MAG_AUTOCAL is anything but 0: PX4 moves offsets by itself after a landing (AT-18a)."""
        return not same(stored.get(AUTOCAL, 0.0), 0.0)

    def ambiguous(self, change: Change, stored: Mapping[str, float]) -> bool:
        """Another slot that was heard holds the same device id."""
        others = (f"CAL_MAG{n}_ID" for n in SLOTS)
        return any(n in stored and n != change.device_name and same(stored[n], change.device_id) for n in others)

    def most_mg(self, stored: Mapping[str, float]) -> float | None:
        """1300 mG: above it PX4's own calibration warns (mag_calibration.cpp, autopilots.md section 4.5)."""
        return 1300.0

    def value_of(self, message: Message) -> float | None:
        """PX4 sends the bytes of an int32: -1 looks like a NaN and is -1.0 here."""
        return bytewise(message)

    def set_message(self, system: int, component: int, name: str, value: float, param_type: int) -> Message:
        """PARAM_SET with the bytes of the type."""
        return set_bytewise(system, component, name, value, param_type)

    def proof_streams(self, compass: int) -> tuple[str, ...]:
        """None: SCALED_IMU knows no offsets, and from HIGHRES_IMU EKF2 takes a bias that it learns anew when they move.

        How much that bias was before and is after, no message tells, so what HIGHRES_IMU moves by is no proof (S11).
        So a write ends WRITTEN_UNPROVEN and stays it; a reboot is advised, after which its values are read again.
        """
        return ()


def _slot(compass: int) -> int:
    if compass not in (1, 2, 3):
        raise ValueError(f"compass: want 1, 2 or 3, got {compass}")
    return compass - 1
