"""Writes down at every landing what the flight taught of each compass, whether anybody uploads it or not."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping

from magmav.core.phase import Flight
from magmav.core.types import Change, Record
from magmav.learnt import learnt_live
from magmav.store import Store, StoreError
from magmav.vehicle import Vehicle

_log = logging.getLogger("magmav")


class Logbook:
    """One vehicle's. Ask after every packet; it writes once a flight.

    A flight of what flies ends with its landing, one of a rover or boat when it is disarmed. One that was under way
    when the service began or ended, or at whose end the vehicle lost its power, is written only if its end was heard.
    """

    def __init__(self, store: Store, unix_offset_ns: int, plan: Callable[[int], Change | None]) -> None:
        self._store = store
        self._unix_offset_ns = unix_offset_ns
        self._plan = plan
        self._written: tuple[int, int, int | None] | None = None

    def look(self, flown: Vehicle | None, records: Mapping[int, Record], vehicle: str) -> None:
        """Has a flight ended? records : the latest of each compass.  vehicle : its key in the store."""
        if flown is None or not flown.phase.flights or not records:
            return
        flight = flown.phase.flights[-1]
        began_ns = began(flight, flown.phase.flyer)
        place = flown.assembler.reboots, flight.armed_ns, flight.takeoff_ns
        if began_ns is None or place == self._written:
            return
        self._written = place
        rows = []
        for compass, record in sorted(records.items()):
            unix_ns = record.t_ns + self._unix_offset_ns - (record.boot_ns - began_ns)
            row = learnt_live(record, flown, self._plan(compass), vehicle, unix_ns)
            rows += [] if row is None else [row]
        try:
            self._store.learn(rows)
        except StoreError as error:
            _log.error("%s", error)


def began(flight: Flight, flyer: bool) -> int | None:
    """Boot time at which a flight that is over began; None for one that goes on, or never left the ground."""
    if flyer:
        return None if flight.landed_ns is None else flight.takeoff_ns
    return None if flight.disarmed_ns is None else flight.armed_ns
