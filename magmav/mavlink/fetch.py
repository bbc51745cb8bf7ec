"""Read the parameters we need by name, a few at a time; never the vehicle's full list (S14).

ArduPilot 4.5 says nothing about a name it does not have, newer ones send PARAM_ERROR. Silence after four
requests means absent, with late chances ever further apart, since silence may also have been the link: with 30 %
loss each way, one name in fifteen gets no answer to four requests, and without its offsets a compass stays unusable.
Who answered for one of three axes has the other two: for those, silence was the link's.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.mavlink.codec import Message, Outgoing
from magmav.mavlink.presence import Presence

_SECOND = 1_000_000_000
SPACING_NS = _SECOND // 10
RETRY_NS = _SECOND
TRIES = 4
LATE_NS = 5 * _SECOND  # after that twice as long, and so on
LAST_PAUSE_NS = 480 * _SECOND
KIN_PAUSE_NS, KIN_TRIES = 2 * _SECOND, 16
_AXIS = re.compile(r"_[XYZ](?=[A-Z]*$)")  # COMPASS_OFS2_X, CAL_MAG0_XOFF


@dataclass(slots=True)
class _Name:
    heard: bool = False
    absent: bool = False
    denied: bool = False  # the vehicle itself said that it has no such name
    tries: int = 0
    due_ns: int = 0


class ParamFetch:
    """names : parameters of the autopilot. The values themselves are for whoever decodes PARAM_VALUE.

    room : whether something may be asked now; it is asked when something is due.
    """

    def __init__(
        self, names: Sequence[str], presence: Presence, room: Callable[[int], bool] = lambda now_ns: True
    ) -> None:
        for name in names:
            if not 1 <= len(name) <= 16 or not name.isascii():
                raise ValueError(f"names: {name!r} is no parameter name of 1 to 16 characters")
        self._presence = presence
        self._room = room
        self._state = {name: _Name() for name in names}
        self._next_ns = 0
        self._key: tuple[int, int, str, int] | None = None

    @property
    def heard(self) -> frozenset[str]:
        """Names whose value was seen since the last start."""
        return frozenset(name for name, state in self._state.items() if state.heard)

    @property
    def absent(self) -> frozenset[str]:
        """Names the vehicle does not seem to have."""
        return frozenset(name for name, state in self._state.items() if state.absent)

    @property
    def done(self) -> bool:
        """Everything is either heard or absent."""
        return self.settled(self._state)

    def settled(self, names: Iterable[str]) -> bool:
        """Each of these is either heard or absent. A name that was never wanted is neither."""
        states = map(self._state.get, names)
        return all(state is not None and (state.heard or state.absent) for state in states)

    def restart(self) -> None:
        """Read all again: the vehicle rebooted, its offsets may be others now."""
        self.again(tuple(self._state))

    def again(self, names: Iterable[str]) -> None:
        """Read these again, and add those that were not wanted before."""
        for name in names:
            self._state[name] = _Name()

    def want(self, names: Sequence[str]) -> None:
        """These names from now on; what was heard of them stays heard."""
        if tuple(self._state) != tuple(names):
            self._state = {name: self._state.get(name) or _Name() for name in names}

    def on_message(self, message: Message, route: str, now_ns: int) -> list[Outgoing]:
        """Tick off what the autopilot says, asked for or not."""
        autopilot = self._presence.autopilot
        sender = message.get_srcSystem(), message.get_srcComponent(), route
        if autopilot is None or sender != autopilot.pin:
            return []
        kind = message.get_type()
        if kind in ("PARAM_VALUE", "PARAM_ERROR") and message.param_id in self._state:
            state = self._state[message.param_id]
            if kind == "PARAM_VALUE":
                state.heard, state.absent, state.denied = True, False, False
            elif message.error == dialect.MAV_PARAM_ERROR_DOES_NOT_EXIST and not state.heard:
                state.absent = state.denied = True
        return self.poll(now_ns)

    def poll(self, now_ns: int) -> list[Outgoing]:
        """At most one request, and at most ten a second."""
        autopilot = self._presence.autopilot
        if autopilot is None:
            return []
        key = (*autopilot.pin, self._presence.boots)
        if self._key is not None and key[3] != self._key[3]:
            self.restart()
        self._key = key
        if now_ns < self._next_ns:
            return []
        for name, state in self._state.items():
            if state.heard or state.denied or now_ns < state.due_ns:
                continue
            kin = TRIES <= state.tries < KIN_TRIES and self._has_kin(name)
            if state.tries >= TRIES and not state.absent and not kin:
                state.absent, state.due_ns = True, now_ns + LATE_NS
                continue
            if not self._room(now_ns):
                return []
            state.tries += 1
            late = state.tries - TRIES
            pause_ns = RETRY_NS if late <= 0 else KIN_PAUSE_NS if kin else min(LATE_NS << late, LAST_PAUSE_NS)
            state.due_ns = now_ns + pause_ns
            self._next_ns = now_ns + SPACING_NS
            message = dialect.MAVLink_param_request_read_message(
                autopilot.system, autopilot.component, name.encode("ascii"), -1
            )
            return [Outgoing(message, autopilot.route)]
        return []

    def _has_kin(self, name: str) -> bool:
        """Has the vehicle answered for another axis of the same three?"""
        three = _AXIS.sub("_#", name)
        return three != name and any(state.heard and _AXIS.sub("_#", n) == three for n, state in self._state.items())
