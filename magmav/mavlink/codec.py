"""Bytes to MAVLink messages and back, on pymavlink's generated ardupilotmega dialect.

The frame is cut here rather than by pymavlink's parser because that one discards the whole claimed length after a
false start byte (ecosystem survey, section 2): one stray 0xFD then costs seven messages. Here a frame that fails its
checksum costs one byte, and the search goes on behind it. Content and checksum are pymavlink's.
The wire is counted, never raises.
"""

from __future__ import annotations

from collections import Counter
from typing import Any, NamedTuple, Protocol

from fastcrc import crc16
from pymavlink.dialects.v20 import ardupilotmega as dialect

Message = Any
"""A message object of the generated dialect (pymavlink ships no types)."""

_V1, _V2 = 0xFE, 0xFD
_SIGNED = 0x01
_KNOWN_INCOMPAT = 0x01
_LONGEST = 10 + 255 + 2 + 13
_COMPONENT_METADATA = 397  # we send it, and the dialect lacks it: see metadata


class Outgoing(NamedTuple):
    """A message some machine wants sent. An empty route means every peer of the link that is no other vehicle.

    sender : system and component it comes from; None where the service knows only one.
    """

    message: Message
    route: str = ""
    sender: tuple[int, int] | None = None


class Signer(Protocol):
    """What signs our frames and judges others'; signing.Signing is one."""

    counts: Counter[str]

    def sign(self, frame: bytes) -> bytes:
        """The frame with its signature behind it."""
        ...

    def good(self, frame: bytes, number: int) -> bool:
        """Whether a frame of this message number is to be believed."""
        ...


def is_signed(message: Message) -> bool:
    """Whether it came with a signature, checked or not."""
    return bool(message.get_header().incompat_flags & _SIGNED)


def number_of(frame: bytes) -> int:
    """Message number of a whole frame."""
    return frame[7] | frame[8] << 8 | frame[9] << 16 if frame[0] == _V2 else frame[5]


class Codec:
    """Cuts frames per route, checks them, and packs our own messages.

    wanted : names of the messages to decode; others are checked, counted and left alone. None decodes all.
    signer : signs what is packed; what it does not call good is not decoded. None: signed frames are taken unchecked.
    counts : "messages", "skipped", "unknown", "bad crc", "garbage bytes", "bad content", "not believed".
    """

    def __init__(self, wanted: frozenset[str] | None = None, signer: Signer | None = None) -> None:
        self.counts: Counter[str] = Counter()
        self.signer = signer
        self._mav = dialect.MAVLink(None)
        self._rest: dict[str, bytes] = {}
        self._sequence: dict[tuple[int, int], int] = {}
        kinds = dialect.mavlink_map.items()
        self._seeds = {i: bytes((kind.crc_extra,)) for i, kind in kinds}  # the last byte of each message's checksum
        self._seeds[_COMPONENT_METADATA] = bytes((182,))
        # SETUP_SIGNING carries a key: nobody here has any business with it (S17).
        self._wanted = {i for i, k in kinds if (wanted is None or k.msgname in wanted) and k.msgname != "SETUP_SIGNING"}

    @property
    def seeds(self) -> dict[int, int]:
        """By message number the byte of its own that each checksum ends with."""
        return {number: seed[0] for number, seed in self._seeds.items()}

    def decode(self, data: bytes, route: str, *, whole: bool) -> list[Message]:
        """Messages completed by these bytes. ``whole``: a datagram, nothing is carried over to the next.

        A stream keeps at most one unfinished frame per route, so memory is bounded whatever arrives.
        """
        if not whole and route in self._rest:
            data = self._rest.pop(route) + data
        out: list[Message] = []
        at, end = 0, len(data)
        while at < end:
            if data[at] != _V2 and data[at] != _V1:
                start = _next_magic(data, at)
                self.counts["garbage bytes"] += start - at
                at = start
            size = _frame_size(data, at)
            if size == 0 or at + size > end:
                if not whole and end - at < _LONGEST and at < end:
                    self._rest[route] = data[at:]
                    break
                if at < end:
                    self.counts["garbage bytes"] += 1
                at += 1
                continue
            if self._frame(data[at : at + size], out):
                at += size
            else:
                self.counts["garbage bytes"] += 1
                at += 1
        return out

    def forget(self, route: str) -> None:
        """Drop what an earlier life of this route left unfinished."""
        self._rest.pop(route, None)

    def _frame(self, frame: bytes, out: list[Message]) -> bool:
        v2 = frame[0] == _V2
        number = number_of(frame)
        seed = self._seeds.get(number)
        if seed is None:
            # No checksum seed, so nothing proves this is a frame: step one byte and look again.
            self.counts["unknown"] += 1
            return False
        tail = 15 if v2 and frame[2] & _SIGNED else 2
        body = len(frame) - tail
        if crc16.mcrf4xx(frame[1:body] + seed) != frame[body] | frame[body + 1] << 8:
            self.counts["bad crc"] += 1
            return False
        if number not in self._wanted:
            self.counts["skipped"] += 1
            return True
        if self.signer is not None and not self.signer.good(frame, number):
            self.counts["not believed"] += 1
            return True
        try:
            message = self._mav.decode(bytearray(frame))
        except (dialect.MAVError, ValueError, UnicodeError):
            self.counts["bad content"] += 1
            return True
        self.counts["messages"] += 1
        out.append(message)
        return True

    def encode(self, message: Message, system: int, component: int) -> bytes:
        """One MAVLink 2 frame from the given identity, with its own running sequence number."""
        key = (system, component)
        mav = self._mav
        mav.srcSystem, mav.srcComponent = key
        mav.seq = self._sequence.get(key, 0)
        frame = bytes(message.pack(mav))
        self._sequence[key] = (mav.seq + 1) & 0xFF
        return frame if self.signer is None else self.signed(frame, self.signer)

    def signed(self, frame: bytes, signer: Signer) -> bytes:
        """An unsigned MAVLink 2 frame with a signature. KeyError for a message that is not known."""
        return signer.sign(self._flagged(frame, frame[2] | _SIGNED, frame[3:-2]))

    def plain(self, frame: bytes) -> bytes | None:
        """A whole frame without its signature; None where the message is not known."""
        if frame[0] != _V2 or not frame[2] & _SIGNED:
            return frame
        return self._flagged(frame, frame[2] & ~_SIGNED, frame[3:-15]) if number_of(frame) in self._seeds else None

    def _flagged(self, frame: bytes, flags: int, rest: bytes) -> bytes:
        """The checksum covers the flag that says signed, so it is made anew."""
        body = bytes((_V2, frame[1], flags)) + rest
        crc = crc16.mcrf4xx(body[1:] + self._seeds[number_of(frame)])
        return body + crc.to_bytes(2, "little")


def _next_magic(data: bytes, at: int) -> int:
    """Index of the next byte that may start a frame, or len(data)."""
    found = [i for i in (data.find(_V2, at), data.find(_V1, at)) if i >= 0]
    return min(found, default=len(data))


def _frame_size(data: bytes, at: int) -> int:
    """Length the frame at ``at`` claims, or 0 when the header itself is cut short or impossible.

    A header cut short is reported as a frame longer than the data, so that a stream waits for more.
    """
    left = len(data) - at
    if left == 0:
        return 0
    if data[at] == _V1:
        return 8 + data[at + 1] if left > 1 else _LONGEST
    if left < 3:
        return _LONGEST
    if data[at + 2] & ~_KNOWN_INCOMPAT:
        return 0
    return 12 + data[at + 1] + (13 if data[at + 2] & _SIGNED else 0)
