"""Component metadata: what a ground station shows of our parameters, beyond name and number.

COMPONENT_METADATA (397) names a general file, that one names the parameter file; both are read over MAVLink FTP
(ftp.py). Message: mavlink.io/en/messages/common.html#COMPONENT_METADATA; files: mavlink.io/en/services/
component_metadata.html and the schemas general.schema.json and parameter.schema.json beside it. pymavlink's dialect
lacks the message (it is not in ArduPilot's fork), so it is defined here; its checksum seed follows from its definition
and a test computes it anew.
"""

from __future__ import annotations

import json
import lzma
import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.mavlink.codec import Message
from magmav.mavlink.entry import Entry

ID = 397
GENERAL, PARAMETER = "general.json", "parameter.json"
_PACKED = PARAMETER + ".xz"
_SCHEME = "mftp://"
_GENERAL_VERSION, _PARAMETER_VERSION = 1, 3
_TYPE_PARAMETER = 1  # COMP_METADATA_TYPE_PARAMETER
# Ground stations unpack with small decoders: CRC32 is the check each of them knows, and a dictionary that fits.
_FILTER = {"id": lzma.FILTER_LZMA2, "preset": 6, "dict_size": 1 << 16}


class ComponentMetadata(dialect.MAVLink_message):  # type: ignore[misc]
    """The message. Fields on the wire: uint32 time_boot_ms, uint32 file_crc, char[100] uri."""

    id = ID
    msgname = "COMPONENT_METADATA"
    fieldnames = ("time_boot_ms", "file_crc", "uri")
    ordered_fieldnames = fieldnames
    fieldtypes = ("uint32_t", "uint32_t", "char")
    crc_extra = 182
    unpacker = struct.Struct("<II100s")

    def __init__(self, time_boot_ms: int, file_crc: int, uri: bytes) -> None:
        super().__init__(self.id, self.msgname)
        self._fieldnames = list(self.fieldnames)
        self.time_boot_ms, self.file_crc, self.uri = time_boot_ms, file_crc, uri

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        """One frame, as pymavlink's own messages do it."""
        payload = self.unpacker.pack(self.time_boot_ms, self.file_crc, self.uri)
        return bytes(self._pack(mav, self.crc_extra, payload, force_mavlink1=force_mavlink1))


def crc32(data: bytes) -> int:
    """MAVLink's CRC32: the usual polynomial, begun at zero and not turned over at the end."""
    return zlib.crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF


def files(entries: Sequence[Entry], version: str) -> dict[str, bytes]:
    """Every file we serve, by name. The parameter file is there twice: packed, which on a slow link is the point."""
    parameter = _json({"version": _PARAMETER_VERSION, "parameters": [_described(e) for e in entries]})
    packed = lzma.compress(parameter, lzma.FORMAT_XZ, lzma.CHECK_CRC32, filters=[_FILTER])
    where = {
        "type": _TYPE_PARAMETER,
        "uri": _SCHEME + _PACKED,
        "fileCrc": crc32(packed),
        "uriFallback": _SCHEME + PARAMETER,
        "fileCrcFallback": crc32(parameter),
    }
    general = {
        "version": _GENERAL_VERSION,
        "vendorName": "magmav",
        "modelName": "magmav",
        "firmwareVersion": version,
        "metadataTypes": [where],
    }
    return {GENERAL: _json(general), PARAMETER: parameter, _PACKED: packed}


def announcement(held: Mapping[str, bytes], now_ns: int) -> Message:
    """The message that says where the general file is; its time is that of our own clock."""
    boot_ms = (now_ns // 1_000_000) & 0xFFFFFFFF
    return ComponentMetadata(boot_ms, crc32(held[GENERAL]), (_SCHEME + GENERAL).encode("ascii"))


def _described(entry: Entry) -> dict[str, Any]:
    about = entry.about
    out: dict[str, Any] = {"name": entry.name, "type": "Float", "shortDesc": about.text, "group": "magmav"}
    for key, value in (("units", about.unit), ("min", about.low), ("max", about.high), ("default", about.default)):
        if value not in (None, ""):
            out[key] = value
    if about.values:
        out["values"] = [{"value": value, "description": text} for value, text in about.values]
    if entry.set is None:
        out["readOnly"] = True
    if entry.set is None or entry.trigger or about.default is None:
        out["volatile"] = True
    return out


def _json(what: Mapping[str, Any]) -> bytes:
    return json.dumps(what, separators=(",", ":"), allow_nan=False).encode("ascii")
