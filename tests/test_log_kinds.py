"""What a file is, by its front; and what is said of one that cannot be opened."""

import errno
import struct

import numpy as np
import pytest
from dataflash_writer import flight
from hypothesis import given
from hypothesis import strategies as st
from ulog_writer import Ulog

from magmav.logs import HEAD, LogError, kind_of, open_log
from magmav.logs.dataflash_readings import DataflashRecording

BINARY, TEXT = flight(2.0).binary(), flight(2.0).text().encode()
NOW_US = struct.pack(">Q", 1_700_000_000_000_000)


@pytest.mark.parametrize(
    ("data", "kind"),
    [
        (Ulog().bytes(), "ulog"),
        (BINARY, "dataflash"),
        (TEXT, "text"),
        (b"\xef\xbb\xbf" + TEXT, "text"),
        (b"ArduCopter V3.1\r\nFree RAM: 1000\r\n\r\n" + TEXT, "text"),
        (TEXT[:2000] + bytes(500), "text"),
        (b"", None),
        (b"heading,FMT, of a table\n1,2\n", None),
        (b"\0" + TEXT, None),
        (NOW_US + b"\xfd" + bytes(40), None),
        (NOW_US + b"\xfe" + BINARY[:3000], None),
    ],
    ids=[
        "ulog",
        "bin",
        "text",
        "mark",
        "greeting",
        "filled up",
        "empty",
        "table",
        "zero",
        "tlog",
        "tlog of a download",
    ],
)
def test_a_file_is_known_by_its_front(data, kind):
    assert kind_of(data[:HEAD]) == kind


@given(st.integers(0, BINARY.rfind(b"\xa3\x95\x80")))
def test_a_log_whose_first_bytes_are_lost_is_still_one_while_a_definition_is_left(lost):
    assert kind_of(BINARY[lost : lost + HEAD]) == "dataflash"


def test_what_is_known_as_dataflash_is_read_as_such(tmp_path):
    path = tmp_path / "late.bin"
    path.write_bytes(BINARY[50:])
    assert sum(1 for _ in DataflashRecording(path).readings()) > 200


def test_chance_is_no_log():
    """Random bytes hold the two sync bytes two times out of three; a whole definition practically never."""
    r = np.random.default_rng(1)
    assert [kind_of(r.bytes(HEAD)) for _ in range(60)] == [None] * 60


def test_a_file_that_breaks_while_it_is_read_is_named(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"x")
    with pytest.raises(LogError, match=r"a\.bin: cannot be read: .*copy it again"), open_log(path, ".bin"):
        raise OSError(errno.EIO, "Input/output error")


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("none.bin", "no such file; check"),
        ("folder", "directory; give the .bin file"),
        ("nul\0.bin", "cannot be opened"),
    ],
    ids=["missing", "folder", "nul"],
)
def test_what_cannot_be_opened_is_said_with_what_to_do(tmp_path, name, says):
    (tmp_path / "folder").mkdir()
    with pytest.raises(LogError, match=says), open_log(tmp_path / name, ".bin"):
        raise AssertionError("opened")
