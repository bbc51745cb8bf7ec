"""The autopilot's own clock, and the reboots it shows: the one sure sign, for a reboot need not make it silent.

time_boot_ms and, where it counts from the boot, time_usec (autopilots.md 1.4: a clock that goes back is a reboot).
Packets overtake one another, so up to two seconds back is none, and neither is a single packet further off: a second
one has to go on from it, with none of the former time in between. A clock that went on by far less than the time that
passed was set back in the silence between: a reboot soon after the boot may show no smaller time than before.
Not seen: a reboot within the first two seconds after the boot.
"""

from __future__ import annotations

from magmav.mavlink.codec import Message

BACK_MS = 2000  # packets overtake one another by no more
AHEAD_MS = 10_000  # more than the time that passed: a clock that was set, or a packet that lies
LAG_MS = 5000  # a link that holds packets back holds them for less
_APART_MS, _LAG_APART_MS = 200, 2000  # between the first packet of another time and the one that confirms it
_NEAR_MS = 10_000
_MS, _US = 1_000_000, 1000
_LAST_BOOT_US = 10**15  # later is UNIX time
_BY_MS = frozenset({
    "SYSTEM_TIME", "ATTITUDE", "ATTITUDE_QUATERNION", "GLOBAL_POSITION_INT", "LOCAL_POSITION_NED", "SCALED_IMU",
    "SCALED_IMU2", "SCALED_IMU3",
})  # fmt: skip
_BY_US = frozenset({"RAW_IMU", "HIGHRES_IMU"})


def boot_ms_of(message: Message) -> int | None:
    """Time since the boot when it was made, ms; None where the message does not tell, or not for certain."""
    kind = message.get_type()
    if kind in _BY_MS:
        return int(message.time_boot_ms)
    if kind in _BY_US and message.time_usec < _LAST_BOOT_US:
        return int(message.time_usec) // _US
    return None


class BootClock:
    """Follows one autopilot's clock over one route. Feed it nobody else's messages.

    ms : the latest time of the boot, None until two messages agree.  boots : how often it was seen to reboot.
    """

    def __init__(self) -> None:
        self.ms: int | None = None
        self.boots = 0
        self._heard_ns = 0  # when ms came
        self._doubt: tuple[int, int] | None = None  # boot time and arrival of the first packet of another time

    def forget(self) -> None:
        """Another component or route speaks now: its time need not go on from the former one's."""
        self.ms = self._doubt = None

    def on_message(self, message: Message, now_ns: int) -> None:
        """Take its time, if it has one."""
        boot_ms = boot_ms_of(message)
        if boot_ms is None:
            return
        if self.ms is not None and self._goes_on(boot_ms, self.ms, now_ns):
            self._doubt = None
            if boot_ms > self.ms:
                self.ms, self._heard_ns = boot_ms, now_ns
        elif self._doubt is None or not -BACK_MS <= boot_ms - self._doubt[0] <= _NEAR_MS:
            self._doubt = boot_ms, now_ns
        elif self._confirms(boot_ms, now_ns, *self._doubt):
            if self.ms is not None and boot_ms - self.ms <= self._passed_ms(now_ns):
                self.boots += 1  # else it was set forward
            self.ms, self._heard_ns, self._doubt = boot_ms, now_ns, None

    def _goes_on(self, boot_ms: int, ms: int, now_ns: int) -> bool:
        ahead, passed = boot_ms - ms, self._passed_ms(now_ns)
        if ahead < 0:
            return ahead >= -BACK_MS and passed < LAG_MS
        return passed - LAG_MS <= ahead <= passed + AHEAD_MS

    def _passed_ms(self, now_ns: int) -> int:
        return (now_ns - self._heard_ns) // _MS

    def _confirms(self, boot_ms: int, now_ns: int, first_ms: int, first_ns: int) -> bool:
        """The same new time, far enough on. Where only the silence speaks, longer: held-back packets catch up."""
        apart_ms = (now_ns - first_ns) // _MS
        if self.ms is not None and -BACK_MS <= boot_ms - self.ms <= self._passed_ms(now_ns):
            return apart_ms >= _LAG_APART_MS
        # No clock runs ahead of the time that passed: such a packet lies, and what is true comes after it.
        return _APART_MS <= boot_ms - first_ms <= apart_ms + BACK_MS
