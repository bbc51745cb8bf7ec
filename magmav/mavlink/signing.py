"""MAVLink 2 message signing: what we say is signed, what we hear is believed only when it is.

    signature = link id (1 byte), timestamp (6 bytes, little endian), first 6 bytes of
                SHA-256(key + header + payload + checksum + link id + timestamp)
(mavlink.io, message_signing; autopilots.md 6.4.) Timestamps count 10 us since 2015-01-01 and only grow, per stream:
(system, component, link id) of the sender. The hash is checked first and a stream's time is kept afterwards: the other
way round, one forged frame with a time far ahead locks the true sender out.

A key is never logged, never printed and never sent; SETUP_SIGNING, which carries one, is neither read nor recorded.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import json
import logging
import os
import stat
from collections import Counter
from pathlib import Path

from magmav.mavlink.codec import Message, is_signed

_log = logging.getLogger("magmav")
_EPOCH_NS = 1_420_070_400 * 10**9  # 2015-01-01
_UNIT_NS = 10_000
_SECOND = 10**9 // _UNIT_NS
MINUTE = 60 * _SECOND
AHEAD = 30 * _SECOND  # the bound on disk is set this far ahead, so that it need not be written for every frame
SIZE = 13
_HASHED = 6
_KEY = 32
_LAST = (1 << 48) - 1
_V2, _SIGNED = 0xFD, 0x01
_UNSIGNED_ALLOWED = frozenset({109, 166})  # RADIO_STATUS, RADIO: a radio has no key and says nothing of the vehicle
_MOST_STREAMS = 256
_MOST_FILE = 4096
_FORMS = "32 raw bytes, 64 hexadecimal digits, 32 bytes in base64, or one line passphrase:WORDS"

Stream = tuple[int, int, int]
"""System, component and link id of whoever signed."""


class SigningError(Exception):
    """A key or a file of timestamps that cannot be used; the text names the file and what to do, never the key."""


def read_key(path: Path) -> bytes:
    """The 32 bytes of a key file. SigningError when it cannot be read or is none of the forms.

    Forms: 32 raw bytes; 64 hexadecimal digits; base64 of 32 bytes; ``passphrase:WORDS``, whose SHA-256 is the key, as
    MAVProxy makes its own (mavproxy_signing.py; UTF-8, without the end of the line).
    """
    try:
        with path.open("rb") as file:
            data = file.read(_MOST_FILE + 1)
    except OSError as error:
        raise SigningError(f"{path}: key file cannot be read: {error.strerror}") from None
    key = _raw(data) or _text(data)
    if key is None:
        raise SigningError(f"{path}: no signing key; a key file holds {_FORMS}")
    if not any(key):
        raise SigningError(f"{path}: a key of zeros means no signing; leave the option out")
    return key


def _raw(data: bytes) -> bytes | None:
    printable = all(32 <= byte < 127 or byte in b"\r\n\t" for byte in data)
    return data if len(data) == _KEY and not printable else None


def _text(data: bytes) -> bytes | None:
    """A mistyped digit must not turn a key into a passphrase, so words say that they are words."""
    try:
        line = data.decode("utf-8-sig").strip("\r\n")
    except UnicodeDecodeError:
        return None
    if line.startswith("passphrase:"):
        words = line.removeprefix("passphrase:")
        return hashlib.sha256(words.encode()).digest() if words else None
    word = line.strip()
    try:
        got = bytes.fromhex(word) if len(word) == 2 * _KEY else base64.b64decode(word, validate=True)
    except (ValueError, binascii.Error):
        return None
    return got if len(got) == _KEY else None


def readable_by_others(path: Path) -> bool:
    """Whether other users of this machine may read the key."""
    return bool(path.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO))


def unix_ns_of(stamp: int) -> int:
    """UNIX time of a signing timestamp."""
    return _EPOCH_NS + stamp * _UNIT_NS


class StampFile:
    """Where the last timestamps are kept over restarts: a small file, replaced whole."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def load(self) -> tuple[int, dict[Stream, int]]:
        """A bound on what we sent, and each stream's last; nothing when there is no file. SigningError: damaged."""
        try:
            held = json.loads(self.path.read_bytes())
            streams = {(int(s), int(c), int(n)): int(t) for s, c, n, t in held["streams"]}
            return int(held["bound"]), streams
        except FileNotFoundError:
            return 0, {}
        except (OSError, ValueError, KeyError, TypeError):
            text = f"{self.path}: signing timestamps cannot be read; set the clock of this machine and remove the file"
            raise SigningError(text) from None

    def store(self, bound: int, streams: dict[Stream, int]) -> None:
        """On disk when it returns; the old content or the new, never a part. OSError when it cannot be kept."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        rows = [[*stream, at] for stream, at in streams.items()]
        beside = self.path.with_name(f"{self.path.name}.{os.getpid()}.tmp")
        with beside.open("w", encoding="ascii") as file:
            json.dump({"bound": bound, "streams": rows}, file)
            file.flush()
            os.fsync(file.fileno())
        beside.replace(self.path)


class Signing:
    """One key. Signs our frames on one link id and checks everybody's.

    counts : "signed" (good ones heard), "unsigned", "bad signature", "replayed" (not newer than its stream), "too old"
    (a new stream over a minute behind us), "unsigned radio" (let through), "not saved".
    Feed it the time with ``tick`` before anything else: without a clock, timestamps go on from the file.
    """

    def __init__(self, key: bytes, link_id: int, file: StampFile | None = None) -> None:
        if len(key) != _KEY:
            raise ValueError(f"key: want {_KEY} bytes, got {len(key)}")
        if not 0 <= link_id <= 255:
            raise ValueError(f"link_id: want 0 to 255, got {link_id!r}")
        self.link_id = link_id
        self.counts: Counter[str] = Counter()
        self._key = key
        self._file = file
        # What exactly was sent last is known only after a clean end; that it was at most the bound, always.
        self._bound, self._streams = (0, {}) if file is None else file.load()
        self.timestamp = self._bound
        self._warned: set[str] = set()

    def tick(self, unix_ns: int) -> None:
        """The time, as the link tells it. A clock that is set back changes nothing."""
        self.timestamp = min(max(self.timestamp, (unix_ns - _EPOCH_NS) // _UNIT_NS), _LAST)

    def sign(self, frame: bytes) -> bytes:
        """A whole MAVLink 2 frame whose header says that it is signed, with its signature behind it."""
        self.timestamp = min(self.timestamp + 1, _LAST)
        if self.timestamp > self._bound:
            self._save(self.timestamp + AHEAD)
        tail = bytes((self.link_id,)) + self.timestamp.to_bytes(6, "little")
        return frame + tail + self._hash(frame + tail)

    def good(self, frame: bytes, number: int) -> bool:
        """Whether to believe a whole frame (its checksum holds) of message ``number``; counted either way."""
        why = self._judge(frame, number)
        self.counts[why] += 1
        if why in ("signed", "unsigned radio"):
            return True
        if why not in self._warned:
            self._warned.add(why)
            _log.warning("%s message of system %d refused: %s", why, _sender(frame)[0], _ADVICE[why])
        return False

    def _judge(self, frame: bytes, number: int) -> str:
        if frame[0] != _V2 or not frame[2] & _SIGNED:
            return "unsigned radio" if number in _UNSIGNED_ALLOWED else "unsigned"
        if not hmac.compare_digest(self._hash(frame[:-_HASHED]), frame[-_HASHED:]):
            return "bad signature"
        stream = (*_sender(frame), frame[-SIZE])
        at = int.from_bytes(frame[1 - SIZE : -_HASHED], "little")
        last = self._streams.get(stream)
        if last is not None and at <= last:
            return "replayed"
        if last is None and (at + MINUTE < self.timestamp or len(self._streams) >= _MOST_STREAMS):
            return "too old"
        self._streams[stream] = at
        self.timestamp = max(self.timestamp, at)
        return "signed"

    def leave(self) -> None:
        """Keep the timestamps for the next start."""
        self._save(self.timestamp)

    def _save(self, bound: int) -> None:
        self._bound = bound
        if self._file is None:
            return
        try:
            self._file.store(bound, self._streams)
        except OSError as error:
            self.counts["not saved"] += 1
            if "not saved" not in self._warned:
                self._warned.add("not saved")
                _log.error("%s: signing timestamps cannot be kept: %s", self._file.path, error.strerror)

    def _hash(self, data: bytes) -> bytes:
        return hashlib.sha256(self._key + data).digest()[:_HASHED]

    def __repr__(self) -> str:
        return f"Signing(link_id={self.link_id})"  # never the key


_ADVICE = {
    "unsigned": "a key is set, and only what is signed with it is believed",
    "bad signature": "signed with another key; check --key-file",
    "replayed": "not newer than the one before",
    "too old": "more than a minute behind us, or too many senders; check the clocks",
}


def _sender(frame: bytes) -> tuple[int, int]:
    return (frame[5], frame[6]) if frame[0] == _V2 else (frame[3], frame[4])


class Seal:
    """Whether the vehicle signs what it says while we hold no key: then it hears nothing of what we send.

    keyed : we hold a key, so nothing unsigned ever gets here.
    """

    def __init__(self, keyed: bool) -> None:
        self._keyed = keyed
        self._signing: dict[tuple[int, int, str], None] = {}

    def on_message(self, message: Message, route: str) -> None:
        """Take note of a heartbeat."""
        if self._keyed or message.get_type() != "HEARTBEAT":
            return
        pin = message.get_srcSystem(), message.get_srcComponent(), route
        if not is_signed(message):
            self._signing.pop(pin, None)
        elif len(self._signing) < _MOST_STREAMS:
            self._signing[pin] = None

    def shuts_out(self, pin: tuple[int, int, str] | None) -> bool:
        """The autopilot of this pin would not hear us."""
        return pin in self._signing
