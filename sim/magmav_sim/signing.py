"""MAVLink 2 signing on the vehicle's side: packed by pymavlink, checked by the protocol's own page.

signature = first 48 bits of SHA-256(key, frame, link id, time); the time counts 10 us since 2015 and only grows per
sender and link; a sender not heard before may be a minute behind.
"""

from __future__ import annotations

import hashlib
import hmac
from collections import Counter
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

_2015_S = 1_420_070_400
_MINUTE = 6_000_000
_TAIL = 13


class Signer:
    """One key. ``counts`` says what was not believed: "unsigned", "forged", "old"."""

    def __init__(self, key: bytes, link_id: int) -> None:
        self._key = key
        self._mav = dialect.MAVLink(None)
        self._mav.signing.secret_key = key
        self._mav.signing.link_id = link_id
        self._mav.signing.sign_outgoing = True
        self._last: dict[tuple[int, int, int], int] = {}
        self._next = 0
        self.counts: Counter[str] = Counter()

    def pack(self, message: Any, system: int, component: int, unix_ns: int) -> bytes:
        """One signed frame."""
        mav = self._mav
        mav.srcSystem, mav.srcComponent = system, component
        mav.signing.timestamp = self._next = max(self._next, stamp(unix_ns))
        frame = bytes(message.pack(mav))
        self._next += 1
        mav.seq = (mav.seq + 1) & 0xFF
        return frame

    def believes(self, message: Any, unix_ns: int) -> bool:
        """Whether a received message is signed with the key and new."""
        frame = bytes(message.get_msgbuf())
        if frame[0] != 0xFD or not frame[2] & 1:
            self.counts["unsigned"] += 1
            return False
        if not hmac.compare_digest(hashlib.sha256(self._key + frame[:-6]).digest()[:6], frame[-6:]):
            self.counts["forged"] += 1
            return False
        when = int.from_bytes(frame[-_TAIL + 1 : -6], "little")
        sender = frame[5], frame[6], frame[-_TAIL]
        last = self._last.get(sender, stamp(unix_ns) - _MINUTE - 1)
        if when <= last:
            self.counts["old"] += 1
            return False
        self._last[sender] = when
        return True


def stamp(unix_ns: int) -> int:
    """10 us since 2015-01-01."""
    return (unix_ns - _2015_S * 10**9) // 10_000
