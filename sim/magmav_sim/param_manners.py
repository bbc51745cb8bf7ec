"""How the two autopilots answer parameter messages: who is addressed, how a value is packed, what is left unsaid."""

from __future__ import annotations

import math
import struct
import zlib
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav_sim.autopilot import Autopilot
from magmav_sim.parameters import INT32, REAL32, Parameters

HASH = "_HASH_CHECK"
_LIST_PER_FRAME = 3
_NO_INDEX, _UINT32 = 65535, 5
_NO_SUCH, _OUT_OF_RANGE = 1, 2  # MAV_PARAM_ERROR


class ParamManners(ABC):
    """Takes PARAM_REQUEST_LIST, PARAM_REQUEST_READ and PARAM_SET; answers into the outbox."""

    def __init__(self, autopilot: Autopilot) -> None:
        self._a = autopilot
        self._list: Iterator[str] = iter(())

    def forget(self) -> None:
        """As after a boot."""
        self._list = iter(())

    def trickle(self) -> None:
        """Send on with a list that was asked for."""
        for _ in range(_LIST_PER_FRAME):
            name = next(self._list, None)
            if name is None:
                return
            self._a.tell(name, indexed=True)

    def handle(self, message: Any) -> None:
        """React to one of the three."""
        kind, table = message.get_type(), self._a.parameters
        if kind == "PARAM_REQUEST_LIST":
            self._list = iter(self.listed())
        elif kind == "PARAM_REQUEST_READ":
            if message.param_index < 0:
                self.read(message.param_id)
            elif message.param_index < len(table):
                self._a.tell(table.names[message.param_index], indexed=True)
        elif kind == "PARAM_SET":
            self.set(message)

    def store(self, name: str, value: float) -> None:
        """Keep it, say so, and let follow what follows."""
        table = self._a.parameters
        before = table[name]
        table.put(name, value)
        self._a.tell(name)
        self._a.param_was_set(name, before)

    def listed(self) -> list[str]:
        """Names in the order of the list."""
        return self._a.parameters.names

    @abstractmethod
    def read(self, name: str) -> None:
        """PARAM_REQUEST_READ by name."""

    @abstractmethod
    def set(self, message: Any) -> None:
        """PARAM_SET."""


class ArduPilotParams(ParamManners):
    """A value travels as a float; its type in PARAM_SET is not looked at. 4.5 is silent about what it does not take,
    later releases send PARAM_ERROR (autopilots.md 2.3)."""

    def read(self, name: str) -> None:
        """Answered without index."""
        if name in self._a.parameters:
            self._a.tell(name)
        else:
            self._error(name, _NO_SUCH)

    def set(self, message: Any) -> None:
        """Any finite number is taken, armed or not."""
        name, value = message.param_id, message.param_value
        if name not in self._a.parameters:
            self._error(name, _NO_SUCH)
        elif not math.isfinite(value):
            self._error(name, _OUT_OF_RANGE)
        else:
            self.store(name, value)

    def _error(self, name: str, error: int) -> None:
        if self._a.newer:
            self._a.outbox.append(dialect.MAVLink_param_error_message(0, 0, name.encode(), -1, error))


class Px4Params(ParamManners):
    """A value travels as its four bytes; a type that is not the stored one is refused without any answer, and an
    unknown name with a text (autopilots.md 4.6, and mavlink_parameters.cpp)."""

    def listed(self) -> list[str]:
        """The hash goes first and is no parameter."""
        return [HASH, *self._a.parameters.names]

    def read(self, name: str) -> None:
        """Answered with its true index."""
        if name == HASH or name in self._a.parameters:
            self._a.tell(name)
        else:
            self._unknown(name)

    def set(self, message: Any) -> None:
        """Stored in the air too. A PARAM_SET of the hash ends the list: the ground station holds all of it."""
        name, table = message.param_id, self._a.parameters
        if name == HASH:
            self.forget()
        elif name not in table:
            self._unknown(name)
        elif table.kind(name) == message.param_type:
            held = payload(message)[:4]
            value = struct.unpack("<i" if message.param_type == INT32 else "<f", held)[0]
            if math.isfinite(value):  # PX4 would store it, and fly with it; nothing here is learnt from that
                self.store(name, value)

    def _unknown(self, name: str) -> None:
        self._a.say(dialect.MAV_SEVERITY_ERROR, f"unknown param: {name}"[:50])


def payload(message: Any) -> bytes:
    """The payload of a received message as it came, filled up with the zeros MAVLink 2 leaves off."""
    frame = bytes(message.get_msgbuf())
    start = 10 if frame[0] == 0xFD else 6
    return frame[start : start + frame[1]].ljust(255, b"\0")


class ByteWiseValue(dialect.MAVLink_param_value_message):  # type: ignore[misc]
    """A PARAM_VALUE whose float is any four bytes. Python's own floats change some that are no numbers."""

    def __init__(self, name: str, value: bytes, kind: int, count: int, index: int) -> None:
        super().__init__(name.encode(), struct.unpack("<f", value)[0], kind, count, index)
        self._exact = value + struct.pack("<HH16sB", count, index, name.encode(), kind)

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        """The frame; the payload is not built from the float."""
        return bytes(self._pack(mav, self.crc_extra, self._exact, force_mavlink1=force_mavlink1))


def hash_check(table: Parameters) -> bytes:
    """Four bytes that another value anywhere would make others."""
    crc = 0
    for name in table.names:
        crc = zlib.crc32(name.encode() + value_bytes(table, name), crc)
    return crc.to_bytes(4, "little")


def value_bytes(table: Parameters, name: str) -> bytes:
    """The four bytes PX4 keeps and sends."""
    if table.kind(name) == REAL32:
        return struct.pack("<f", table[name])
    return struct.pack("<i", int(table[name]))


def byte_wise(table: Parameters, name: str, index: int) -> ByteWiseValue:
    """PARAM_VALUE of one parameter, or of the hash."""
    if name == HASH:
        return ByteWiseValue(HASH, hash_check(table), _UINT32, len(table), _NO_INDEX)
    return ByteWiseValue(name, value_bytes(table, name), table.kind(name), len(table), index)
