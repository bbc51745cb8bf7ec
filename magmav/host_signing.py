"""Signing on a link that a host owns and signs, such as MAVProxy's: we sign with its key, and judge with it ourselves.

What a host hands to its modules was checked by its own rules, which may let unsigned or wrongly signed packets pass
(MAVProxy's allow_unsigned). Here only what is signed with the key passes, and comes out plain, for whoever reads on has
no key. What we send becomes a stream of its own: our system and component on the host's link id. With no key nothing is
touched: who reads on then sees that the vehicle signs, and only listens (LINK_SIGNED_READ_ONLY).
"""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

from magmav.mavlink.codec import Codec, number_of
from magmav.mavlink.signing import Signing, unix_ns_of


class HostKey(NamedTuple):
    """How a host signs one of its links. stamp : its timestamp, 10 us since 2015-01-01."""

    key: bytes
    link_id: int
    stamp: int

    def __repr__(self) -> str:
        return f"HostKey(link_id={self.link_id})"  # never the key (S17)


class HostSigning:
    """One link of the host. counts : as signing.Signing; nothing is counted without a key."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._codec = Codec()
        self._held: tuple[bytes, int] | None = None
        self._signing: Signing | None = None

    def heard(self, frame: bytes, host: HostKey | None) -> bytes | None:
        """What to read on: the frame itself without a key; plain where it is to be believed, None where not."""
        signing = self._with(host)
        if signing is None:
            return frame
        good = signing.good(frame, number_of(frame))
        return self._codec.plain(frame) if good else None

    def sent(self, frame: bytes, host: HostKey | None) -> bytes:
        """What to put on the host's link for an unsigned MAVLink 2 frame of ours."""
        signing = self._with(host)
        return frame if signing is None else self._codec.signed(frame, signing)

    def _with(self, host: HostKey | None) -> Signing | None:
        if host is None:
            self._held = self._signing = None
        elif self._held != (host.key, host.link_id):
            self._held = host.key, host.link_id
            self._signing = Signing(host.key, host.link_id)
            self._signing.counts = self.counts
        if self._signing is not None and host is not None:
            self._signing.tick(unix_ns_of(host.stamp))
        return self._signing
