"""Numbers in PARAM_VALUE and PARAM_SET: four bytes that two autopilots read in two ways.

ArduPilot casts every number to a float (C-cast). PX4 puts the four bytes of an int32 where the float is (byte-wise), so
that -1 looks like a NaN; Python's way from a 32-bit float and back changes such bytes, so they are taken from the
payload itself (autopilots.md section 4.6, https://mavlink.io/en/services/parameter.html#parameter-encoding).
"""

from __future__ import annotations

import math
import struct

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.mavlink.codec import Message

_FLOAT = struct.Struct("<f")
_V2 = 0xFD
_INTEGERS = {
    dialect.MAV_PARAM_TYPE_UINT8: "<B",
    dialect.MAV_PARAM_TYPE_INT8: "<b",
    dialect.MAV_PARAM_TYPE_UINT16: "<H",
    dialect.MAV_PARAM_TYPE_INT16: "<h",
    dialect.MAV_PARAM_TYPE_UINT32: "<I",
    dialect.MAV_PARAM_TYPE_INT32: "<i",
}
_REAL32 = dialect.MAV_PARAM_TYPE_REAL32


def payload_bytes(message: Message) -> bytes:
    """The four bytes of param_value: as they came, or as they would go out of a message made here."""
    frame = message.get_msgbuf()  # get_payload() of pymavlink 2.4.50 cuts as if every frame were MAVLink 1
    if not frame:
        return _FLOAT.pack(message.param_value)
    at = 10 if frame[0] == _V2 else 6
    return bytes(frame[at : at + min(4, frame[1])]).ljust(4, b"\0")  # first in both; MAVLink 2 cuts zeros off the end


def says_bytewise(capabilities: int) -> bool | None:
    """How a vehicle says in AUTOPILOT_VERSION that it encodes; None where it says neither or both."""
    bytes_too = bool(capabilities & dialect.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE)
    casts = bool(capabilities & dialect.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST)
    return None if bytes_too == casts else bytes_too


def cast(message: Message) -> float | None:
    """A number sent as a float whatever its type is. None when it is not finite."""
    value = float(message.param_value)
    return value if math.isfinite(value) else None


def bytewise(message: Message) -> float | None:
    """A number whose bytes are those of its type. None for a float that is not finite, or a type of 8 bytes."""
    data, kind = payload_bytes(message), message.param_type
    if kind == _REAL32:
        value = float(_FLOAT.unpack(data)[0])
        return value if math.isfinite(value) else None
    form = _INTEGERS.get(kind)
    return None if form is None else float(struct.unpack_from(form, data)[0])


def set_cast(system: int, component: int, name: str, value: float, param_type: int) -> Message:
    """PARAM_SET with the number as a float. ValueError for one that is not finite."""
    if not math.isfinite(value):
        raise ValueError(f"{name}: {value!r} is no finite number, and no autopilot stores it")
    return dialect.MAVLink_param_set_message(system, component, name.encode("ascii"), value, param_type)


def set_bytewise(system: int, component: int, name: str, value: float, param_type: int) -> Message:
    """PARAM_SET with the bytes of the number's type.

    ValueError for a number the type cannot hold, and for an integer whose bytes do not survive the way through a float
    (-4194305 does not: its bytes are a signalling NaN, and that loses a bit on the way).
    """
    if param_type == _REAL32:
        return set_cast(system, component, name, value, param_type)
    form = _INTEGERS.get(param_type)
    if form is None or not float(value).is_integer():
        raise ValueError(f"{name}: {value!r} does not fit MAV_PARAM_TYPE {param_type}")
    try:
        data = struct.pack(form, int(value)).ljust(4, b"\0")
    except struct.error:
        raise ValueError(f"{name}: {value!r} does not fit MAV_PARAM_TYPE {param_type}") from None
    number = float(_FLOAT.unpack(data)[0])
    if _FLOAT.pack(number) != data:
        raise ValueError(f"{name}: {value!r} cannot be sent, its bytes change on their way through a float")
    return dialect.MAVLink_param_set_message(system, component, name.encode("ascii"), number, param_type)
