"""ArduPilot's compass parameters by name, in both naming schemes, and what a writer must know of them.

COMPASS_OFS_X, COMPASS_OFS2_X, COMPASS_OFS3_X is what every release has; COMPASS1_OFS_X, COMPASS2_OFS_X is in the wild
(autopilots.md section 2.2). A vehicle speaks one of them, and which one shows in what it answers.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.core.types import Change
from magmav.mavlink.autopilot.allowed import COMPASSES, allowed
from magmav.mavlink.codec import Message
from magmav.mavlink.float32 import same
from magmav.mavlink.values import cast, set_cast

AXES = ("X", "Y", "Z")
LEARN, OFFS_MAX, MOTCT = "COMPASS_LEARN", "COMPASS_OFFS_MAX", "COMPASS_MOTCT"
# COMPASS_OFS_X, COMPASS_OFS2_X, COMPASS_OFS3_X, and the other naming scheme's COMPASS1_OFS_X and so on
_OFFSET = re.compile(r"COMPASS(?:_OFS([23]?)|([123])_OFS)_([XYZ])")
_DEVICE = re.compile(r"COMPASS(?:_DEV_ID([23]?)|([123])_DEV_ID)")
# The first seen of RAW_IMU and SCALED_IMU counts; on ArduPilot they say the same (autopilots.md section 1.1).
_STREAMS = {1: ("RAW_IMU", "SCALED_IMU"), 2: ("SCALED_IMU2",), 3: ("SCALED_IMU3",)}


@dataclass(frozen=True, slots=True)
class Scheme:
    """One way of naming. ``compass`` is 1, 2 or 3: the number in the name, see ``ardupilot.Calibrations.slot``."""

    numbered: bool  # COMPASS1_OFS_X rather than COMPASS_OFS_X

    def name(self, compass: int, what: str, axis: str = "") -> str:
        """Such as COMPASS_OFS2_X. ValueError for a compass that is not 1, 2 or 3."""
        if compass not in COMPASSES:
            raise ValueError(f"compass: want 1, 2 or 3, got {compass}")
        old = f"COMPASS_{what}{'' if compass == 1 else compass}"
        stem = f"COMPASS{compass}_{what}" if self.numbered else old
        return f"{stem}_{axis}" if axis else stem

    def offsets(self, compass: int) -> tuple[str, str, str]:
        """Offsets X, Y, Z."""
        return self.name(compass, "OFS", "X"), self.name(compass, "OFS", "Y"), self.name(compass, "OFS", "Z")

    def device(self, compass: int) -> str:
        """Device id."""
        return self.name(compass, "DEV_ID")

    def shaping(self, compass: int) -> tuple[str, ...]:
        """Scale, matrix and motor terms of this compass, in that order; then the one motor selector of all."""
        terms = [self.name(compass, group, axis) for group in ("DIA", "ODI", "MOT") for axis in AXES]
        return (self.name(compass, "SCALE"), *terms, MOTCT)


CLASSIC, NUMBERED = Scheme(False), Scheme(True)


FEELER = NUMBERED.offsets(1)[0]
"""Asked for where it is not known which scheme a vehicle speaks."""


def scheme_of(names: Collection[str]) -> Scheme:
    """The scheme of a vehicle that has these parameters. Classic where nothing says otherwise."""
    numbered = any(n in names for c in COMPASSES for n in NUMBERED.offsets(c))
    classic = any(n in names for c in COMPASSES for n in CLASSIC.offsets(c))
    return NUMBERED if numbered and not classic else CLASSIC


def priority_name(compass: int) -> str:
    """The parameter with the device id of the compass that is streamed as this one; alike in both schemes."""
    return f"COMPASS_PRIO{compass}_ID"


class ArduPilot:
    """Adapter for MAV_AUTOPILOT_ARDUPILOTMEGA: mG, added, body axes; numbers as floats; all streams corrected."""

    kind = int(dialect.MAV_AUTOPILOT_ARDUPILOTMEGA)
    unproven = ""
    least_step_mg = 0.0
    unit_mg = 1.0
    compass_streams: tuple[str, ...] = ("RAW_IMU", "SCALED_IMU2", "SCALED_IMU3")
    slow_streams: tuple[str, ...] = ()

    def names(self, compasses: Iterable[int], answered: Collection[str] = ()) -> tuple[str, ...]:
        """The classic names and one of the others as a feeler; all of the others once a vehicle answers for one."""
        scheme, wanted = scheme_of(answered), tuple(compasses)
        settled = any(name in answered for c in COMPASSES for each in (CLASSIC, NUMBERED) for name in each.offsets(c))
        names = [] if settled else [FEELER]
        names += self.whose(answered)  # what a vehicle may not have first: silence takes long
        for compass in wanted:
            names += [*scheme.offsets(compass), scheme.device(compass), *scheme.shaping(compass)]
        return tuple(dict.fromkeys(names))

    def whose(self, answered: Collection[str]) -> tuple[str, ...]:
        """The order of priority, and the device ids of all slots."""
        scheme = scheme_of(answered)
        return (*map(priority_name, COMPASSES), *map(scheme.device, COMPASSES))

    def offset_names(self, compass: int) -> tuple[str, str, str]:
        """COMPASS_OFS_X and its kin for this compass."""
        return CLASSIC.offsets(compass)

    def device_name(self, compass: int) -> str:
        """COMPASS_DEV_ID and its kin."""
        return CLASSIC.device(compass)

    def checked(self, change: Change) -> Change:
        """The same change in exact 32-bit floats. ValueError names what may not be written or does not fit."""
        return allowed(change, _OFFSET, _DEVICE)

    def triple(self, change: Change) -> tuple[str, str, str]:
        """All three offset names of this compass."""
        stem = change.names[0][:-1]
        return f"{stem}X", f"{stem}Y", f"{stem}Z"

    def reads(self, change: Change) -> tuple[str, ...]:
        """Offsets, device id, COMPASS_LEARN and COMPASS_OFFS_MAX."""
        return (*self.triple(change), change.device_name, LEARN, OFFS_MAX)

    def second_writer(self, stored: Mapping[str, float]) -> bool:
        """COMPASS_LEARN is anything but 0."""
        return not same(stored.get(LEARN, 0.0), 0.0)

    def ambiguous(self, change: Change, stored: Mapping[str, float]) -> bool:
        """Another COMPASS_DEV_ID that was heard is the same."""
        others = {scheme.device(c) for scheme in (CLASSIC, NUMBERED) for c in COMPASSES} - {change.device_name}
        return any(same(stored[name], change.device_id) for name in others if name in stored)

    def most_mg(self, stored: Mapping[str, float]) -> float | None:
        """COMPASS_OFFS_MAX: the length of the vector when the vehicle arms."""
        return stored.get(OFFS_MAX)

    def value_of(self, message: Message) -> float | None:
        """ArduPilot casts: an int32 of -1 comes as -1.0."""
        return cast(message)

    def set_message(self, system: int, component: int, name: str, value: float, param_type: int) -> Message:
        """PARAM_SET; ArduPilot ignores the type."""
        return set_cast(system, component, name, value, param_type)

    def proof_streams(self, compass: int) -> tuple[str, ...]:
        """RAW_IMU and SCALED_IMU for compass 1, SCALED_IMU2, SCALED_IMU3. ValueError for another compass."""
        if compass not in COMPASSES:
            raise ValueError(f"compass: want 1, 2 or 3, got {compass}")
        return _STREAMS[compass]
