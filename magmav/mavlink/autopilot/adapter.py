"""What writing to an autopilot must know of it: names, units, encodings, and what it does behind our back.

One implementation per MAV_AUTOPILOT, each a table without memory; what a vehicle holds is for StoredCalibrations. A
stored mapping is always parameter name to value as heard, in the autopilot's own units.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Protocol

from magmav.core.types import Change
from magmav.mavlink.autopilot.ardupilot_names import ArduPilot
from magmav.mavlink.autopilot.px4_names import Px4
from magmav.mavlink.codec import Message


class Adapter(Protocol):
    """One autopilot. Facts and their sources: autopilots.md sections 2 (ArduPilot) and 4 (PX4)."""

    @property
    def kind(self) -> int:
        """MAV_AUTOPILOT."""
        ...

    @property
    def least_step_mg(self) -> float:
        """A change of the whole vector no longer than this the autopilot ignores until it restarts; 0: takes any."""
        ...

    @property
    def unit_mg(self) -> float:
        """What one unit of an offset parameter is in mG; its sign is not in it."""
        ...

    @property
    def compass_streams(self) -> tuple[str, ...]:
        """Messages that carry the compasses we learn from, and gyro and accelerometer with them."""
        ...

    @property
    def slow_streams(self) -> tuple[str, ...]:
        """Messages that are wanted now and then besides those every autopilot sends."""
        ...

    @property
    def unproven(self) -> str:
        """Why a write stays WRITTEN_UNPROVEN even when its values outlived a reboot; "" where a stream proves it."""
        ...

    def names(self, compasses: Iterable[int], answered: Collection[str] = ()) -> tuple[str, ...]:
        """Parameters to fetch for compasses (1, 2 or 3). ValueError for another number.

        answered : names the vehicle has answered for; where it has several naming schemes, they say which it speaks.
        """
        ...

    def whose(self, answered: Collection[str]) -> tuple[str, ...]:
        """Parameters that say which compass is in which slot. Before each was heard or is absent none is sure (S6).

        answered : as for ``names``, and among those.
        """
        ...

    def offset_names(self, compass: int) -> tuple[str, str, str]:
        """Offsets of this compass while nothing is known of the vehicle; a plan takes StoredCalibrations.names."""
        ...

    def device_name(self, compass: int) -> str:
        """Its device id, likewise."""
        ...

    def checked(self, change: Change) -> Change:
        """The allow-list (S5, S9): the same change in exact 32-bit floats.

        ValueError for anything that is no compass offset of one compass, naming it.
        """
        ...

    def triple(self, change: Change) -> tuple[str, str, str]:
        """All three offset names of this change's compass, written or not: their length counts for the limit."""
        ...

    def reads(self, change: Change) -> tuple[str, ...]:
        """Parameters to be read afresh before a write; without an answer for each of them nothing is written."""
        ...

    def second_writer(self, stored: Mapping[str, float]) -> bool:
        """Does somebody else write offsets by himself (S7)? A name that was not read says nothing; see ``reads``."""
        ...

    def ambiguous(self, change: Change, stored: Mapping[str, float]) -> bool:
        """Does another slot than the change's hold the same device id (S6, AT-6b)?"""
        ...

    def most_mg(self, stored: Mapping[str, float]) -> float | None:
        """The longest vector of offsets the autopilot takes, mG, or None where that is not known."""
        ...

    def value_of(self, message: Message) -> float | None:
        """The number in a PARAM_VALUE or PARAM_SET, from its payload bytes; None for a float that is not finite."""
        ...

    def set_message(self, system: int, component: int, name: str, value: float, param_type: int) -> Message:
        """PARAM_SET of this number, to that component. ValueError for a number the type cannot carry."""
        ...

    def proof_streams(self, compass: int) -> tuple[str, ...]:
        """Messages that show what the autopilot makes of this compass with new offsets; empty where none does."""
        ...


ADAPTERS: Mapping[int, Adapter] = {adapter.kind: adapter for adapter in (ArduPilot(), Px4())}
"""By MAV_AUTOPILOT."""


def adapter_of(kind: int) -> Adapter | None:
    """The adapter for this MAV_AUTOPILOT, None where offsets cannot be written."""
    return ADAPTERS.get(kind)
