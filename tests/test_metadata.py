"""Component metadata: the message is the public one, the files follow the public schemas and say what is true."""

from __future__ import annotations

import json
import lzma
import re
import struct

import pytest
from ftp_client import Client
from own_board import OwnBoard
from pymavlink.dialects.v20 import ardupilotmega as dialect
from scripted_vehicle import S, Wire

from magmav import __version__
from magmav.mavlink.budget import Budget
from magmav.mavlink.codec import Codec
from magmav.mavlink.manners import Manners
from magmav.mavlink.metadata import ComponentMetadata, announcement, crc32, files
from magmav.mavlink.presence import Presence
from magmav.settings import knobs

WIRE = Wire()
# The keys that parameter.schema.json knows (it allows no others), with their JSON types.
_KNOWN = {
    "name": str, "type": str, "shortDesc": str, "longDesc": str, "units": str, "default": (int, float),
    "decimalPlaces": int, "min": (int, float), "max": (int, float), "increment": (int, float), "rebootRequired": bool,
    "group": str, "category": str, "volatile": bool, "values": list, "readOnly": bool,
}  # fmt: skip


def polite(bps: float = 500.0):
    """A presence on vehicle 7 with our files, whose sending is counted in the budget as the companion does it."""
    board = OwnBoard()
    budget = Budget(bps)
    held = files(board.entries, __version__)
    presence = Presence(target_system=7, manners=Manners(budget, held))
    beat = WIRE.carry(dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3), 7, 1)
    presence.on_message(beat, "a", 0)
    presence.poll(0)

    def counted(out, now_ns):
        for item in out:
            budget.force(item.message, now_ns)
        return out

    return board, held, presence, counted


def test_layout_and_checksum_seed_follow_from_the_public_definition():
    """COMPONENT_METADATA: uint32_t time_boot_ms, uint32_t file_crc, char[100] uri. The seed as MAVLink makes it."""
    text = b"COMPONENT_METADATA uint32_t time_boot_ms uint32_t file_crc char uri " + bytes((100,))
    crc = dialect.x25crc(text).crc
    assert ComponentMetadata.crc_extra == (crc & 0xFF) ^ (crc >> 8) == 182
    assert ComponentMetadata.unpacker.size == 108 and ComponentMetadata.id == 397
    assert 397 not in dialect.mavlink_map, "the dialect has it now: use that"


def test_the_message_on_the_wire_names_the_general_file():
    held = files(OwnBoard().entries, __version__)
    frame = Codec().encode(announcement(held, 12_345_000_000), 7, 191)
    length, number = frame[1], int.from_bytes(frame[7:10], "little")
    assert (frame[0], frame[5], frame[6], number) == (0xFD, 7, 191, 397)
    payload = frame[10 : 10 + length].ljust(108, b"\0")
    time_ms, crc, uri = struct.unpack("<II100s", payload)
    assert (time_ms, crc, uri.rstrip(b"\0")) == (12_345, crc32(held["general.json"]), b"mftp://general.json")
    seeded = dialect.x25crc(frame[1 : 10 + length])
    seeded.accumulate(bytes((182,)))
    assert frame[10 + length :] == seeded.crc.to_bytes(2, "little")


@pytest.mark.parametrize("kind", ["COMMAND_LONG", "COMMAND_INT"])
def test_the_request_is_accepted_and_answered_and_only_ours(kind):
    _, held, presence, _ = polite()

    def ask(what, *target):
        if kind == "COMMAND_LONG":
            message = dialect.MAVLink_command_long_message(*target, 512, 0, what, *(0,) * 6)
        else:
            message = dialect.MAVLink_command_int_message(*target, 0, 512, 0, 0, what, *(0,) * 6)
        return presence.on_message(WIRE.carry(message, 255, 190), "gcs", S)

    ack, told = ask(397, 7, 191)
    assert (ack.message.command, ack.message.result, ack.route, told.route) == (512, 0, "gcs", "gcs")
    assert told.message.file_crc == crc32(held["general.json"])
    (no,) = ask(148, 7, 191)
    assert no.message.result == dialect.MAV_RESULT_UNSUPPORTED
    for target in ((7, 1), (7, 0), (0, 0), (8, 191)):
        assert ask(397, *target) == [], target


def test_general_points_at_the_parameter_file_packed_and_plain():
    held = files(OwnBoard().entries, "1.2.3")
    general = json.loads(held["general.json"])
    assert set(general) <= {"version", "vendorName", "modelName", "firmwareVersion", "metadataTypes"}
    assert general["version"] == 1 and re.fullmatch(r"\d+\.\d+\.\d+(\.\d+)?", general["firmwareVersion"])
    (where,) = general["metadataTypes"]
    assert set(where) == {"type", "uri", "fileCrc", "uriFallback", "fileCrcFallback"} and where["type"] == 1
    for uri, crc in (("uri", "fileCrc"), ("uriFallback", "fileCrcFallback")):
        scheme, _, path = where[uri].partition("://")
        assert scheme == "mftp" and crc32(held[path]) == where[crc]
    assert lzma.decompress(held["parameter.json.xz"]) == held["parameter.json"]
    assert len(held["parameter.json.xz"]) < 3500, "a few seconds at 500 B/s"


def test_every_parameter_is_described_once_as_the_schema_wants_it():
    board = OwnBoard()
    said = json.loads(files(board.entries, __version__)["parameter.json"])
    assert set(said) == {"version", "parameters"} and said["version"] >= 3
    rows = said["parameters"]
    assert [row["name"] for row in rows] == [entry.name for entry in board.entries]
    for row, entry in zip(rows, board.entries, strict=True):
        for key, value in row.items():
            assert isinstance(value, _KNOWN[key]), (row["name"], key)
        assert row["type"] == "Float" and row["shortDesc"] and len(row["shortDesc"]) < 130, row["name"]
        assert row.get("readOnly", False) == (entry.set is None), row["name"]
        assert all(set(v) == {"value", "description"} for v in row.get("values", []))


def test_settings_are_described_by_the_one_table_and_the_limits_are_those_that_hold():
    board = OwnBoard()
    rows = {row["name"]: row for row in json.loads(files(board.entries, __version__)["parameter.json"])["parameters"]}
    for knob in (k for k in knobs() if k.param):
        row = rows[knob.param]
        assert row["shortDesc"] == knob.text and row.get("units", "") == knob.unit
        assert row["default"] == board.value(knob.param), "nothing was chosen yet"
        for good in (row["min"], row["max"]):
            assert board.set(knob.param, good), (knob.param, good)
            assert board.value(knob.param) == good
        for bad in (row["min"] - 0.01, row["max"] * 1.01 + 0.01):
            assert not board.set(knob.param, bad), (knob.param, bad)
            assert board.value(knob.param) == row["max"]
        board.set(knob.param, row["default"])
        if "values" in row:
            assert [v["value"] for v in row["values"]] == list(range(int(row["max"]) + 1))


def test_AT_9c_a_ground_station_reads_all_of_it_at_500_bytes_a_second():
    """Request, general file, packed parameter file, over the presence with its heartbeat, in simulated time."""
    board, _, presence, counted = polite()
    client = Client(
        lambda m, route, now_ns: counted(presence.on_message(m, route, now_ns), now_ns),
        lambda now_ns: counted(presence.poll(now_ns), now_ns),
        now_ns=S,
    )
    general = json.loads(client.download(b"general.json"))
    path = general["metadataTypes"][0]["uri"].removeprefix("mftp://")
    said = json.loads(lzma.decompress(client.download(path.encode())))
    assert len(said["parameters"]) == len(board.entries)
    assert client.now_ns < 20 * S
    sent = client.sent
    most = max(sum(n for t, n in sent if start <= t < start + 10 * S) for start, _ in sent)
    assert most <= 5000
    beats = sum(n == 21 for _, n in sent)
    assert beats >= client.now_ns // S - 2, "and the heart goes on beating"
