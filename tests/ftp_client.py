"""A MAVLink FTP client for tests, written from the protocol page: it asks, hears, asks again, and counts bytes."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as dialect
from scripted_vehicle import MS, Wire

HEAD = 12


class Answer(NamedTuple):
    """One reply, taken apart."""

    sequence: int
    session: int
    opcode: int  # 128 ACK, 129 NAK
    request: int
    done: int
    offset: int
    data: bytes


def parsed(payload: bytes) -> Answer:
    """The bytes of FILE_TRANSFER_PROTOCOL.payload."""
    sequence, offset = int.from_bytes(payload[0:2], "little"), int.from_bytes(payload[8:12], "little")
    data = payload[HEAD : HEAD + payload[4]]
    assert len(data) == payload[4]
    return Answer(sequence, payload[2], payload[3], payload[5], payload[6], offset, data)


def request(opcode: int, sequence: int, data: bytes = b"", *, session: int = 0, size: int = -1, offset: int = 0) -> Any:
    """A message to (7, 191). ``size``: of the data, unless given."""
    n = len(data) if size < 0 else size
    head = sequence.to_bytes(2, "little") + bytes((session, opcode, n, 0, 0, 0)) + offset.to_bytes(4, "little")
    return dialect.MAVLink_file_transfer_protocol_message(0, 7, 191, list((head + data).ljust(251, b"\0")))


class Client:
    """Talks to ``hear(message, route, now_ns)`` and ``poll(now_ns)``; ``loss`` of each way, repeats after 0.5 s."""

    def __init__(
        self,
        hear: Callable[[Any, str, int], None],
        poll: Callable[[int], list[Any]],
        *,
        sender: tuple[int, int] = (255, 190),
        now_ns: int = 0,
        loss: float = 0.0,
        seed: int = 1,
    ) -> None:
        self.hear, self.poll, self.sender, self.now_ns = hear, poll, sender, now_ns
        self.loss, self.dice = loss, random.Random(seed)
        self.wire = Wire()
        self.sequence = 0
        self.sent: list[tuple[int, int]] = []  # when, bytes: what the server put on the wire

    def ask(self, opcode: int, data: bytes = b"", **fields: int) -> Answer:
        """The answer, after as many repeats as it takes (40)."""
        message = request(opcode, self.sequence, data, **fields)
        self.sequence = (self.sequence + 1) & 0xFFFF
        for _ in range(40):
            if self.dice.random() >= self.loss:
                self.hear(self.wire.carry(message, *self.sender), "gcs", self.now_ns)
            for _ in range(25):
                self.now_ns += 20 * MS
                for item in self.poll(self.now_ns):
                    before = self.wire.bytes
                    heard = self.wire.carry(item.message, 7, 191)
                    self.sent.append((self.now_ns, self.wire.bytes - before))
                    if heard.get_type() != "FILE_TRANSFER_PROTOCOL" or self.dice.random() < self.loss:
                        continue
                    answer = parsed(bytes(heard.payload))
                    if (answer.sequence, answer.request) == (self.sequence, opcode):
                        return answer
        raise AssertionError(f"no answer to opcode {opcode}")

    def download(self, path: bytes, opcode: int = 15, size: int = 239) -> bytes:
        """A file, by bursts (15) or by reads (5)."""
        opened = self.ask(4, path)
        assert opened.opcode == 128, opened
        length, out = int.from_bytes(opened.data, "little"), b""
        while True:
            got = self.ask(opcode, session=opened.session, size=size, offset=len(out))
            if got.opcode == 129:
                assert got.data == bytes((6,)), "end of file"
                break
            assert got.offset == len(out)
            out += got.data
        assert len(out) == length
        assert self.ask(1, session=opened.session).opcode == 128
        return out
