"""What systemd is told: that we are ready, alive and stopping (sd_notify(3), systemd.service(5) Type=notify).

A datagram of text lines to the unix socket that $NOTIFY_SOCKET names. Outside systemd there is none, and
everything here does nothing. ``beat`` is called from the loop that does the work and from nowhere else, so the
watchdog bites when the work stops, whatever else the process still does.
"""

from __future__ import annotations

import os
import socket
from collections import Counter
from collections.abc import Mapping

_US = 1000


class Notifier:
    """Tells a service manager. What cannot be told is counted, never raised.

    address : of the socket; "" for nobody; a leading "@" is the abstract namespace.
    every_ns : how often to say that we are alive; 0 for never.
    counts : "sent", "send errors".
    """

    def __init__(self, address: str = "", every_ns: int = 0) -> None:
        if every_ns < 0:
            raise ValueError(f"every_ns: want 0 or more, got {every_ns!r}")
        self.counts: Counter[str] = Counter()
        self.every_ns = every_ns
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._beat_ns: int | None = None
        self._state = ""

    @classmethod
    def from_environment(cls, environ: Mapping[str, str] | None = None, pid: int | None = None) -> Notifier:
        """As systemd set it: half of $WATCHDOG_USEC, if $WATCHDOG_PID is this process or not given.

        Other kinds of address ($NOTIFY_SOCKET may name vsock) and a time that is no number count as none.
        """
        env = os.environ if environ is None else environ
        address = env.get("NOTIFY_SOCKET", "")
        if not address.startswith(("/", "@")) or len(address) < 2:
            return cls()
        wait = env.get("WATCHDOG_USEC", "")
        ours = env.get("WATCHDOG_PID", "") in ("", str(os.getpid() if pid is None else pid))
        usable = ours and wait.isascii() and wait.isdecimal()
        return cls(address, int(wait) * _US // 2 if usable else 0)

    def ready(self, status: str = "") -> None:
        """Start-up is over. Once; further calls say nothing."""
        if not self._state:
            self._state = "ready"
            self._tell("READY=1", *_status(status))

    def beat(self, now_ns: int) -> None:
        """Still at work, at this link time. The first call and then one each half of the watchdog's time is sent."""
        due = self._beat_ns is None or not 0 <= now_ns - self._beat_ns < self.every_ns
        if self.every_ns and due:
            self._beat_ns = now_ns
            self._tell("WATCHDOG=1")

    def stopping(self) -> None:
        """The end has begun: last words and closing files follow. Once."""
        if self._state != "stopping":
            self._state = "stopping"
            self._tell("STOPPING=1")

    def _tell(self, *lines: str) -> None:
        if not self._address:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
                # A manager that does not read must not hold up the work.
                sock.setblocking(False)
                sock.sendto("\n".join(lines).encode(), self._address)
        except OSError:
            self.counts["send errors"] += 1
        else:
            self.counts["sent"] += 1


def _status(text: str) -> tuple[str, ...]:
    line = " ".join(text.split())
    return (f"STATUS={line}",) if line else ()
