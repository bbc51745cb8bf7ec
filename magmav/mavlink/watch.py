"""What the vehicle is doing, as far as it matters for writing: armed, landed, still, calibrating itself.

Only the latched autopilot over its pinned route counts, with one exception: armed is believed from any route.
Feed it from the first message on: what it has seen for longer need not be waited for later.
"""

from __future__ import annotations

import math

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.core.types import Landed
from magmav.mavlink.codec import Message
from magmav.mavlink.presence import Presence
from magmav.mavlink.values import says_bytewise

_SECOND = 1_000_000_000
STILL_RADS = 0.05  # a gyro at rest stays under 0.02; a vehicle that is carried does not
SLOW_MPS = 0.5
STILL_NS = 5 * _SECOND
_GAP_NS = 3 * _SECOND  # silence longer than this proves nothing about the time in between
_LANDED_NS = 5 * _SECOND
_CALIBRATING_NS = 10 * _SECOND
_ARMED_NS = 5 * _SECOND
_STALL_NS = _SECOND // 2  # ticks come every 0.05 s: after so long a pause of ours, what comes next has waited
_IMU = ("RAW_IMU", "SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3")


class Watch:
    """Evidence about the vehicle of ``presence``. Times are arrival times, None for never.

    heartbeat_ns, disarmed : the last heartbeat over the pinned route.  heard_ns : the last message of any
    kind.
    since_ns : when watching this very autopilot began.  bytewise : how it says that it encodes integers, if it does.
    """

    def __init__(self, presence: Presence) -> None:
        self.presence = presence
        self._pin: tuple[int, int, str, int] | None = None
        self.bytewise: bool | None = None
        self._looked_ns: int | None = None
        self._drained_ns = 0
        self._forget()

    def _forget(self) -> None:
        self.since_ns: int | None = None
        self.heard_ns: int | None = None
        self.heartbeat_ns: int | None = None
        self.disarmed = False
        self._armed_elsewhere_ns: int | None = None
        self._landed: tuple[int, int] | None = None  # state, when
        self._speed_ns: int | None = None
        self._gyro_ns: int | None = None
        self._slow_since_ns: int | None = None
        self._still_since_ns: int | None = None
        self._calibrating_ns: int | None = None

    def tick(self, now_ns: int) -> None:
        """Call it often. Where we ourselves stood still (a slow disk, a sleeping machine), messages waited meanwhile:
        until they are through, none that says disarmed is fresh (S1)."""
        paused_ns = 0 if self._looked_ns is None else now_ns - self._looked_ns
        if paused_ns > _STALL_NS:
            self._drained_ns = now_ns + _STALL_NS + min(paused_ns * 3 // 10, 5 * _SECOND)
        self._looked_ns = now_ns

    def on_message(self, message: Message, route: str, now_ns: int) -> None:
        """Note one message. Being told twice does no harm."""
        self.tick(now_ns)
        autopilot = self.presence.autopilot
        if autopilot is None:
            return
        pin = (*autopilot.pin, self.presence.boots)  # what was seen before a reboot says nothing of after it
        if self._pin != pin:
            if self._pin is None or self._pin[:3] != pin[:3]:
                self.bytewise = None
            self._pin = pin
            self._forget()
        kind = message.get_type()
        if (message.get_srcSystem(), message.get_srcComponent()) != autopilot.pin[:2]:
            return
        armed = kind == "HEARTBEAT" and bool(message.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)
        if route != autopilot.route:
            if armed:
                self._armed_elsewhere_ns = now_ns
            return
        self.since_ns = now_ns if self.since_ns is None else self.since_ns
        self.heard_ns = now_ns
        if kind == "HEARTBEAT":
            if armed or now_ns >= self._drained_ns:
                self.heartbeat_ns, self.disarmed = now_ns, not armed
        elif kind == "EXTENDED_SYS_STATE":
            self._landed = message.landed_state, now_ns
        elif kind == "AUTOPILOT_VERSION":
            self.bytewise = says_bytewise(message.capabilities)
        elif kind == "MAG_CAL_PROGRESS":
            self._calibrating_ns = now_ns
        elif kind == "GLOBAL_POSITION_INT":
            self._speed(math.hypot(message.vx, message.vy) / 100.0, now_ns)
        elif kind == "VFR_HUD":
            self._speed(message.groundspeed, now_ns)
        elif kind in _IMU:
            self._gyro(max(abs(message.xgyro), abs(message.ygyro), abs(message.zgyro)) / 1000.0, now_ns)
        elif kind == "HIGHRES_IMU":  # rad/s here, thousandths there
            self._gyro(max(abs(message.xgyro), abs(message.ygyro), abs(message.zgyro)), now_ns)

    def armed(self, now_ns: int) -> bool:
        """The last heartbeat over the pinned route says so, or another route did in the last five seconds."""
        here = self.heartbeat_ns is not None and not self.disarmed
        return here or _within(self._armed_elsewhere_ns, now_ns, _ARMED_NS)

    def heartbeat_age_ns(self, now_ns: int) -> int | None:
        """Age of the last heartbeat over the pinned route."""
        return None if self.heartbeat_ns is None else now_ns - self.heartbeat_ns

    def silent_ns(self, now_ns: int) -> int | None:
        """How long nothing at all has come from the autopilot."""
        return None if self.heard_ns is None else now_ns - self.heard_ns

    def calibrating(self, now_ns: int) -> bool:
        """The autopilot runs its own compass calibration."""
        return _within(self._calibrating_ns, now_ns, _CALIBRATING_NS)

    def still(self, now_ns: int, for_ns: int = 0) -> bool:
        """No rotation to speak of, up to now and for at least this long."""
        return _lasts(self._still_since_ns, self._gyro_ns, now_ns, for_ns)

    def moving(self, now_ns: int) -> bool:
        """It turns right now; False also where no gyro is heard."""
        return self._still_since_ns is None and _within(self._gyro_ns, now_ns, _GAP_NS)

    def in_air(self, now_ns: int) -> bool:
        """The autopilot says in so many words that it is not on the ground."""
        flying = (Landed.IN_AIR, Landed.TAKING_OFF, Landed.LANDING)
        return self._landed is not None and self._knows_landed(now_ns) and self._landed[0] in flying

    def landed(self, now_ns: int) -> bool:
        """On the ground as the autopilot says; where it does not say, slow and still for five seconds."""
        if self._landed is not None and self._knows_landed(now_ns):
            return self._landed[0] == Landed.ON_GROUND
        slow = _lasts(self._slow_since_ns, self._speed_ns, now_ns, STILL_NS)
        return slow and self.still(now_ns, STILL_NS)

    def _knows_landed(self, now_ns: int) -> bool:
        held = self._landed
        return held is not None and held[0] != 0 and _within(held[1], now_ns, _LANDED_NS)

    def _speed(self, mps: float, now_ns: int) -> None:
        fresh = _within(self._speed_ns, now_ns, _GAP_NS)
        if not mps < SLOW_MPS:
            self._slow_since_ns = None
        elif self._slow_since_ns is None or not fresh:
            self._slow_since_ns = now_ns
        self._speed_ns = now_ns

    def _gyro(self, rads: float, now_ns: int) -> None:
        fresh = _within(self._gyro_ns, now_ns, _GAP_NS)
        if not rads <= STILL_RADS:
            self._still_since_ns = None
        elif self._still_since_ns is None or not fresh:
            self._still_since_ns = now_ns
        self._gyro_ns = now_ns


def _within(then_ns: int | None, now_ns: int, span_ns: int) -> bool:
    return then_ns is not None and now_ns - then_ns <= span_ns


def _lasts(since_ns: int | None, last_ns: int | None, now_ns: int, for_ns: int) -> bool:
    return since_ns is not None and _within(last_ns, now_ns, _GAP_NS) and now_ns - since_ns >= for_ns
