"""Did the values outlive the reboot? Read again what was written, once the autopilot has started anew (AT-4c).

An autopilot may answer for a value from its memory and lose it with the power: ArduPilot saves in the background, PX4
when it finds the time. That it rebooted is told by its own clock alone (see boot_clock), which then shows less than
when the write ended: ours may jump, and a companion usually loses power together with the autopilot.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum

from magmav.mavlink.autopilot.adapter import Adapter
from magmav.mavlink.boot_clock import BACK_MS
from magmav.mavlink.codec import Message, Outgoing
from magmav.mavlink.dialogue import Dialogue
from magmav.mavlink.float32 import same
from magmav.mavlink.presence import Presence

_SECOND = 1_000_000_000
_SETTLE_NS = 3 * _SECOND  # parameters are loaded, and packets from before have arrived
_RETRY_NS = _SECOND
_TRIES = 30


class Keeping(Enum):
    """What a reboot left of a write; the text is for people."""

    PERSISTED = "written values outlived the reboot"
    LOST = "written values were gone after the reboot: upload again"
    CHANGED = "somebody else, or the autopilot itself, wrote other values since"


class Kept:
    """Waits for a reboot after one finished write, then reads its names.

    written : what must be there.  before : what was there before the write; anything else is somebody else's.
    boot_ms : the autopilot's boot clock when the write ended.  found : None until it is known.
    given_up : it rebooted and then did not answer; a later companion may try.
    """

    def __init__(
        self,
        adapter: Adapter,
        presence: Presence,
        written: Mapping[str, float],
        before: Mapping[str, float],
        boot_ms: int,
    ) -> None:
        self.found: Keeping | None = None
        self.given_up = False
        self._adapter = adapter
        self._presence = presence
        self._written = dict(written)
        self._before = dict(before)
        self._boot_ms = boot_ms
        self._boots = presence.clock.boots
        self._rebooted_ns: int | None = None
        self._talk: Dialogue | None = None

    def on_message(self, message: Message, route: str, now_ns: int) -> None:
        """Watch the autopilot's clock, then take its values. ``presence`` has heard the message before."""
        autopilot = self._presence.autopilot
        sender = message.get_srcSystem(), message.get_srcComponent(), route
        if autopilot is None or sender != autopilot.pin:
            return
        clock = self._presence.clock
        if self._rebooted_ns is None and clock.ms is not None:
            if clock.boots != self._boots or clock.ms < self._boot_ms - BACK_MS:
                self._rebooted_ns = now_ns
            else:
                self._boot_ms = max(self._boot_ms, clock.ms)
        if self._talk is not None and message.get_type() == "PARAM_VALUE":
            self._talk.heard(message, None)

    def poll(self, now_ns: int) -> list[Outgoing]:
        """Read once it has rebooted; say what is there once all is heard."""
        autopilot = self._presence.autopilot
        if autopilot is None or self.found is not None or self.given_up or self._rebooted_ns is None:
            return []
        if self._talk is None:
            if now_ns - self._rebooted_ns < _SETTLE_NS:
                return []
            self._talk = Dialogue(self._adapter, autopilot.pin, self._written)
            self._talk.turn_to(self._written, _RETRY_NS, _TRIES)
        if not self._talk.asking.open:
            self.found = self._judged(self._talk.stored)
            return []
        self.given_up = self._talk.asking.spent(now_ns)
        return [] if self.given_up else self._talk.read(now_ns)

    def _judged(self, stored: Mapping[str, float]) -> Keeping:
        if all(same(stored[n], v) for n, v in self._written.items()):
            return Keeping.PERSISTED
        ours = all(same(stored[n], v) or same(stored[n], self._before[n]) for n, v in self._written.items())
        # Zero is what a table without the value starts from.
        return Keeping.LOST if ours or not any(stored.values()) else Keeping.CHANGED
