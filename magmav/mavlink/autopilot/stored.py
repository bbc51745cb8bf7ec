"""What every autopilot's stored compass calibration must answer, whatever it calls it and however it counts."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from magmav.core.types import NO_SHAPING, CalibrationReading, ParamReading, Reason, Shaping, Vec3

_MOST_MG = 32767.0  # what RAW_IMU can carry
_LEAST_GAIN, _MOST_GAIN = 0.05, 20.0
"""Of a matrix worth undoing, in every direction. Real ones lie within 0.5 to 1.5; at 0.05 noise grows twentyfold."""


def invertible(offset_b_mg: Vec3, shaping: Shaping) -> bool:
    """False for a correction that throws a direction away, or is larger than a stream could carry."""
    if max(abs(offset_b_mg).max(), abs(shaping.motor_b_mg).max()) > _MOST_MG:
        return False
    values = np.linalg.svd(shaping.matrix, compute_uv=False) if shaping is not NO_SHAPING else (1.0,)
    return bool(values[0] < _MOST_GAIN and values[-1] > _LEAST_GAIN)


def only_offsets_moved(before: tuple[object, ...], after: tuple[object, ...]) -> bool:
    """Of two corrections, offsets first: both know them (None: not), they differ, and nothing else does."""
    return None not in (before[0], after[0]) and before[0] != after[0] and before[1:] == after[1:]


class Wish(NamedTuple):
    """New offsets of one compass in the autopilot's own names, units, sign and axes, exact 32-bit floats.

    left_b_mg : (3,) the offsets in body axes, to be added, as they will be with these 32-bit values.
    """

    device_name: str
    names: tuple[str, ...]
    old: tuple[float, ...]
    new: tuple[float, ...]
    left_b_mg: Vec3


@dataclass(frozen=True, slots=True, eq=False)
class Standing:
    """What StoredCalibrations answer of one compass, the same object until something is heard that may change it."""

    epoch: int
    known: bool
    assumed: bool
    changed: bool
    refuses: Reason | None
    device_id: int
    offsets: Vec3 | None
    shaping: Shaping
    undoable: bool


def standing_of(held: StoredCalibrations, compass: int) -> Standing:
    """Asked one by one."""
    return Standing(
        held.epoch(compass),
        held.known(compass),
        held.assumed(compass),
        held.changed(compass),
        held.refuses(compass),
        held.device_id(compass),
        held.offsets(compass),
        held.shaping(compass),
        held.undoable(compass),
    )


class StoredCalibrations(Protocol):
    """What one vehicle holds for its compasses, as far as it has been heard, and how to undo it.

    Inside, the autopilot's own names, units, signs and axes; outside, offsets to be added, mG, body axes, with
    truth = shaping.matrix @ (sensor + offsets) + shaping.motor_b_mg, where sensor is the sensor's own field turned
    into body axes. ``epoch(compass)`` grows whenever data before and after must not be mixed; a change of offsets that
    were known is undone exactly and does not count.
    """

    def param(self, r: ParamReading) -> tuple[int, ...]:
        """Take one parameter; the compasses whose correction it changed."""
        ...

    def report(self, r: CalibrationReading) -> tuple[int, ...]:
        """Take what the autopilot says it applies; the compasses whose correction we see otherwise now."""
        ...

    def sensor(self, compass: int, device_id: int, source: str) -> bool:
        """This compass's readings come from this device (0: not said), through this message.

        False: another message tells the same better, and this one is to be left alone.
        """
        ...

    def standing(self, compass: int) -> Standing:
        """All that the questions below answer, kept: for who asks at every sample."""
        ...

    def armed(self, armed: bool) -> None:
        """Take the arm state."""
        ...

    def throttle(self, share: float) -> None:
        """Take the throttle, 0 to 1."""
        ...

    def current(self, ampere: float) -> None:
        """Take the battery current."""
        ...

    def expect(self, names: Iterable[str], values: Iterable[float]) -> None:
        """These coming values are our own doing: undone exactly, nothing need be learnt again."""
        ...

    def known(self, compass: int) -> bool:
        """True when stored offsets and device id were heard, so that results are absolute."""
        ...

    def assumed(self, compass: int) -> bool:
        """True when scale, matrix or motor terms (or what drives the motor term) are the autopilot's defaults."""
        ...

    def epoch(self, compass: int) -> int:
        """Number of the stretch of data over which this compass was corrected in one way."""
        ...

    def changed(self, compass: int) -> bool:
        """True when somebody changed the correction after it was known."""
        ...

    def refuses(self, compass: int) -> Reason | None:
        """Why nothing may be written though values are known: it is not clear whose they are (S6). None: clear."""
        ...

    def names(self, compass: int) -> tuple[str, str, str, str]:
        """Offsets X, Y, Z and device id, as this vehicle calls them, as far as it is known."""
        ...

    def wish(self, compass: int, offsets_b_mg: Vec3, write: tuple[bool, bool, bool]) -> Wish:
        """What must be stored for these offsets, by names that the body axes in ``write`` have a part in.

        Only where ``known``.
        """
        ...

    @property
    def unit_mg(self) -> float:
        """One unit of a stored offset, mG."""
        ...

    def device_id(self, compass: int) -> int:
        """Device id, 0 when not known."""
        ...

    def offsets(self, compass: int) -> Vec3 | None:
        """Stored offsets as ArduPilot would add them, mG, body axes, or None."""
        ...

    def stored(self, compass: int) -> dict[str, float]:
        """Every value heard for this compass, in the autopilot's own names and units."""
        ...

    def value(self, name: str) -> float | None:
        """One value as heard."""
        ...

    def shaping(self, compass: int) -> Shaping:
        """What the autopilot does after its offsets."""
        ...

    def undoable(self, compass: int) -> bool:
        """False where what is stored cannot be undone."""
        ...

    def undo(self, compass: int, sent_mg: Vec3, /, source: str = "") -> Vec3:
        """The sensor's own field, mG, body axes, from the field as sent. ValueError for a singular stored matrix."""
        ...

    def corrected(self, compass: int, sent_mg: Vec3, /, source: str = "") -> Vec3:
        """The field as the autopilot uses it, mG, body axes, from the field as sent."""
        ...
