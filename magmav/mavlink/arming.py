"""Will ArduPilot arm with what was written? It wants a device id on its own record too, and only it can say (AT-7a).

Writing offsets does not commit COMPASS_DEV_ID: only a calibration does, so a compass that was never calibrated stays
"not calibrated" (autopilots.md section 2.3). The parameter reads as the detected id either way. So the autopilot is
asked to run its own checks and to say what they find; nothing is changed by that, and health is never faked (S9): the
step that commits the id is for the operator, who knows which compass this is.
"""

from __future__ import annotations

import re

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.core.types import Reason
from magmav.mavlink.codec import Message, Outgoing

MANUAL_STEP = (
    "disarmed, send MAV_CMD_PREFLIGHT_CALIBRATION with param2 = 76 (MAVProxy: forcecal compass) or calibrate once "
    "onboard; then reboot"
)
_SECOND = 1_000_000_000
_RETRY_NS = _SECOND
_TRIES = 3
_LISTEN_NS = 2 * _SECOND  # texts follow the acknowledgement, through the autopilot's own queue
_PATIENCE_NS = 6 * _SECOND
_COMPLAINT = re.compile(r"compass.*not calibrated", re.IGNORECASE)
_NO = (dialect.MAV_RESULT_UNSUPPORTED, dialect.MAV_RESULT_DENIED, dialect.MAV_RESULT_FAILED)


class ArmingCheck:
    """Asks once and listens. ``reason`` is None while nothing speaks against it.

    pin : the autopilot and its route.  were_zero : all three offsets were 0 before: never calibrated, as far as
    that shows, which is all there is where the autopilot does not know the command.
    """

    def __init__(self, pin: tuple[int, int, str], now_ns: int, *, were_zero: bool) -> None:
        self.reason: Reason | None = None
        self._pin = pin
        self._were_zero = were_zero
        self._begun_ns = self._due_ns = now_ns
        self._tries = 0
        self._answered_ns: int | None = None
        self._over = False

    def on_message(self, message: Message, now_ns: int) -> None:
        """A message of this autopilot, over its route."""
        kind = message.get_type()
        if kind == "STATUSTEXT" and _COMPLAINT.search(message.text):
            self.reason = Reason.NOT_COMMITTED
        elif kind == "COMMAND_ACK" and message.command == dialect.MAV_CMD_RUN_PREARM_CHECKS:
            self._over = message.result in _NO
            if not self._over and self._answered_ns is None:
                self._answered_ns = now_ns

    def poll(self, now_ns: int) -> list[Outgoing]:
        """The command, until it is answered."""
        if self._answered_ns is not None or self._tries >= _TRIES or now_ns < self._due_ns or self.done(now_ns):
            return []
        self._tries += 1
        self._due_ns = now_ns + _RETRY_NS
        command = dialect.MAVLink_command_long_message(
            *self._pin[:2], dialect.MAV_CMD_RUN_PREARM_CHECKS, 0, 0, 0, 0, 0, 0, 0, 0
        )
        return [Outgoing(command, self._pin[2])]

    def done(self, now_ns: int) -> bool:
        """Said, or heard out, or nobody answers."""
        heard_out = self._answered_ns is not None and now_ns - self._answered_ns >= _LISTEN_NS
        lost = self._answered_ns is None and now_ns - self._begun_ns >= _PATIENCE_NS
        if (self._over or lost) and self.reason is None and self._were_zero:
            self.reason = Reason.PERHAPS_NOT_COMMITTED
        return self.reason is not None or heard_out or self._over or lost
