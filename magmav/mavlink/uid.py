"""Which very vehicle is this? Its own number, from AUTOPILOT_VERSION, besides the system id that anybody can have.

Two vehicles of one make have the same system id and the same compass device ids, so those alone do not tell them
apart (S19). uid2 is the full number of the processor, uid its older short form; an autopilot that has neither sends
zeros. It is asked for by REQUEST_MESSAGE, and every other time by the command of older releases.
"""

from __future__ import annotations

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.mavlink.codec import Message, Outgoing
from magmav.mavlink.presence import Presence

_SECOND = 1_000_000_000
_RETRY_NS = 3 * _SECOND // 2
TRIES = 6


def key(system: int, uid: str) -> str:
    """The vehicle as the store knows it: "1", or "1 uid 0123abcd" where its number is known."""
    return f"{system} uid {uid}" if uid else f"{system}"


def has_uid(vehicle: str) -> bool:
    """Does this key name one very vehicle?"""
    return bool(_parts(vehicle)[1])


def may_be_same(one: str, other: str) -> bool:
    """False when two keys are of two vehicles for certain. What is not known speaks against nothing."""
    (a, uid_a), (b, uid_b) = (_parts(text) for text in (one, other))
    return (not a or not b or a == b) and (not uid_a or not uid_b or uid_a == uid_b)


def _parts(text: str) -> tuple[str, str]:
    system, _, uid = text.partition(" uid ")
    return system, uid


class Uid:
    """Asks the latched autopilot, again after a reboot or on another route. ``uid`` is "" while it is not known."""

    def __init__(self, presence: Presence) -> None:
        self.uid = ""
        self._presence = presence
        self._asked: tuple[int, int, str, int] | None = None
        self._tries = 0
        self._due_ns = 0
        self._answered = False

    @property
    def key(self) -> str:
        """The latched vehicle's key, see ``key``."""
        return key(self._presence.system, self.uid)

    @property
    def settled(self) -> bool:
        """It has answered, or was asked often enough."""
        return self._asked is not None and (self._answered or self._tries >= TRIES)

    def on_message(self, message: Message, route: str) -> None:
        """Take the number from AUTOPILOT_VERSION over the pinned route."""
        autopilot = self._presence.autopilot
        if autopilot is None or message.get_type() != "AUTOPILOT_VERSION":
            return
        if (message.get_srcSystem(), message.get_srcComponent(), route) != autopilot.pin:
            return
        long = bytes(message.uid2).rstrip(b"\0")
        self.uid = long.hex() if long else f"{message.uid:016x}" if message.uid else ""
        self._answered = True

    def poll(self, now_ns: int) -> list[Outgoing]:
        """The question, while it has no answer."""
        autopilot = self._presence.autopilot
        if autopilot is None:
            return []
        place = (*autopilot.pin, self._presence.boots)
        if place != self._asked:
            if self._asked is not None and place[0] != self._asked[0]:
                self.uid = ""
            self._asked, self._tries, self._answered, self._due_ns = place, 0, False, now_ns
        if self.settled or now_ns < self._due_ns:
            return []
        self._tries += 1
        self._due_ns = now_ns + _RETRY_NS
        modern = self._tries % 2 == 1
        command = dialect.MAV_CMD_REQUEST_MESSAGE if modern else dialect.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES
        what = dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION if modern else 1
        ask = dialect.MAVLink_command_long_message(*autopilot.pin[:2], command, 0, what, 0, 0, 0, 0, 0, 0)
        return [Outgoing(ask, autopilot.route)]
