"""The binary DataFlash reader: what was written is what is read, and damage costs the records it hit, not the file."""

from __future__ import annotations

import json
import math
import os
import random
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dataflash_writer import ATT, EV, FMT, IMU, MAG, PARTS, Log, Message, flight
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from magmav.logs import LogError
from magmav.logs.columns import STRINGS, Tables
from magmav.logs.dataflash import read_binary
from magmav.logs.dataflash_readings import DataflashRecording

LOGS = Path(os.environ.get("MAGMAV_DATA", Path(__file__).parents[2] / "shared" / "data")) / "logs"
DAMAGES = int(os.environ.get("MAGMAV_DAMAGES", "200"))
READ = ("MAG", "MAG2", "MAG3", "IMU", "ATT", "EKF1", "AHR2", "GPS", "CURR", "CTUN", "RCOU", "BARO",
        "PARM", "MODE", "EV", "MSG")  # fmt: skip

WHOLE = {"b": 8, "h": 16, "i": 32, "q": 64, "c": 16, "e": 32, "L": 32, "B": -8, "H": -16, "I": -32, "Q": -64, "C": -16,
         "E": -32, "M": -8}  # fmt: skip


def parse(data: bytes) -> Tables:
    return read_binary(np.frombuffer(data, dtype=np.uint8), "test.bin")


def column(tables: Tables, name: str, label: str) -> list[Any]:
    """All values of a column, over every definition of the message, in the order of the file."""
    found = []
    for table in tables.of(name):
        values = table.texts(label) if table.letters[label] in STRINGS else table.values(label).tolist()
        found += list(zip(table.at.tolist(), values, strict=True))
    return [v for _, v in sorted(found, key=lambda pair: pair[0])]


def a_value(letter: str) -> st.SearchStrategy[Any]:
    if letter in "fdg":
        return st.floats(width={"f": 32, "d": 64, "g": 16}[letter], allow_nan=False)
    if letter in STRINGS:
        longest = {"n": 4, "N": 16, "Z": 64}[letter]
        return st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=longest)
    bits = WHOLE[letter]
    low, high = (0, 2**-bits - 1) if bits < 0 else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    return st.integers(low, high).map(lambda v: v / PARTS[letter] if letter in PARTS else v)


@given(st.data(), st.lists(st.sampled_from("bBhHiIqQfdgnNZcCeELM"), min_size=1, max_size=16))
@settings(max_examples=60, deadline=None)
def test_what_was_written_is_what_is_read(data: st.DataObject, letters: list[str]) -> None:
    labels = [f"F{i}" for i in range(len(letters))]
    message = Message(7, "ALL", "".join(letters), ",".join(labels))
    assume(message.size < 256)
    rows = data.draw(st.lists(st.tuples(*map(a_value, letters)), min_size=1, max_size=5))
    log = Log([(message, row) for row in rows])
    tables = parse(log.binary())
    assert tables.heard["ALL"] == len(rows)
    for label, written in zip(labels, zip(*rows, strict=True), strict=True):
        assert column(tables, "ALL", label) == list(written)


def test_sync_bytes_inside_a_record_begin_no_record() -> None:
    evil = Message(9, "EVIL", "ZB", "Data,N")
    log = Log()
    for i in range(50):
        log.add(EV, i, 10)
        # Headers of every known message, back to back: FMT, EV, EVIL itself.
        log.rows.append((evil, ((bytes((0xA3, 0x95, 128, 0xA3, 0x95, EV.number, 0xA3, 0x95, 9)) * 8)[:64], i)))
    tables = parse(log.binary())
    assert column(tables, "EVIL", "N") == list(range(50))
    assert column(tables, "EV", "TimeUS") == list(range(50))
    assert not tables.counts


@given(st.lists(st.binary(max_size=40).filter(lambda b: b"\xa3" not in b), min_size=30, max_size=30))
@settings(max_examples=40, deadline=None)
def test_garbage_between_records_costs_its_own_bytes(garbage: list[bytes]) -> None:
    log = Log()
    for i in range(30):
        log.add(EV, i, i)
    head, rows = log.pieces()[: len(log.head())], log.pieces()[len(log.head()) :]
    tables = parse(b"".join((*head, *(g + r for g, r in zip(garbage, rows, strict=True)))))
    assert column(tables, "EV", "Id") == list(range(30))
    assert tables.counts["bytes skipped"] == sum(map(len, garbage))


def test_cut_anywhere_all_whole_records_before_stay() -> None:
    log = flight(1.0)
    pieces = log.pieces()
    whole, ends = log.binary(), np.cumsum([len(p) for p in pieces])
    names = [m.name for m, _ in (*log.head(), *log.rows)]
    for cut in range(int(ends[len(log.head())]), len(whole), 37):
        tables = parse(whole[:cut])
        full = int(np.searchsorted(ends, cut, side="right"))
        assert sum(tables.heard.values()) == full
        assert tables.heard["IMU"] == names[:full].count("IMU")
        assert tables.counts["bytes skipped"] == cut - ends[full - 1]


def test_bytes_lost_inside_a_record_cost_that_record_alone() -> None:
    log = Log()
    for i in range(40):
        log.add(MAG, i, 0, i, 2, 3, *(0,) * 6, 1, 0)
    pieces = log.pieces()
    first = len(log.head())
    for hurt in range(first + 1, len(pieces) - 1):
        cut = [p[: 5 + hurt % 10] if k == hurt else p for k, p in enumerate(pieces)]
        got = column(parse(b"".join(cut)), "MAG", "MagX")
        assert got == [i for i in range(40) if i != hurt - first]


def test_a_message_defined_anew_is_read_by_each_definition_in_its_place() -> None:
    old, new = Message(9, "XYZ", "Ih", "TimeMS,A"), Message(9, "XYZ", "Qfh", "TimeUS,B,A")
    define = [FMT.body((m.number, m.size, m.name, m.letters, m.labels)) for m in (FMT, old, new)]
    parts = [*define[:2], *(old.body((i, i)) for i in range(10)), define[2]]
    parts += [new.body((i, 0.5, i)) for i in range(10, 20)]
    tables = parse(b"".join(parts))
    assert column(tables, "XYZ", "A") == list(range(20))
    assert [len(t) for t in tables.of("XYZ")] == [10, 10]
    assert tables.counts == {"FMT: message defined anew": 1}


def test_what_is_not_defined_or_contradicts_itself_is_skipped_and_counted() -> None:
    lie = FMT.body((20, 9, "LIE", "BB", "A,B"))  # says 9 bytes, its letters make 5
    log = Log([(EV, (i, i)) for i in range(3)])
    unknown = bytes((0xA3, 0x95, 99, 1, 2, 3, 4))
    tables = parse(log.binary() + lie + bytes((0xA3, 0x95, 20, 0, 0, 0, 0, 0, 0)) + unknown + EV.body((9, 9)))
    assert column(tables, "EV", "Id") == [0, 1, 2, 9]
    assert tables.of("LIE") == ()
    assert tables.counts["LIE: its definition contradicts itself"] == 1
    assert tables.counts["records of a message never defined"] == 1
    assert tables.counts["bytes skipped"] == len(unknown)


def test_a_unit_is_taken_from_fmtu_and_else_from_the_caller() -> None:
    log = Log([(MAG, (1, 0, 250, 0, 0, *(0,) * 6, 1, 0)), (ATT, (2, 0.0, 12.34, 0.0, 0.0, 0.0, 0.0))])
    (mag,), (att,) = parse(log.binary()).of("MAG"), parse(log.binary()).of("ATT")
    assert mag.base("MagX", otherwise=77.0) == pytest.approx(0.25, rel=1e-15)  # gauss
    assert att.base("Roll", otherwise=77.0) == pytest.approx(12.34, rel=1e-15)  # its letter scales, once
    bare = Message(MAG.number, "MAG", MAG.letters, MAG.labels)
    (plain,) = parse(Log([(bare, log.rows[0][1])]).binary()).of("MAG")
    assert plain.base("MagX", otherwise=1e-3, per=1e3) == 250.0


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "is empty"),
        (b"\xa3\x95\x80" + bytes(200), "no FMT record"),
        (b"ULog" + bytes(100), "no DataFlash log"),
        (b"hello\n" * 99, "no DataFlash log"),
        (b"FMT, nonsense\n", "no FMT line"),
    ],
)
def test_what_is_no_log_is_refused_by_name(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "strange.bin"
    path.write_bytes(content)
    with pytest.raises(LogError, match=f"strange.bin.*{said}"):
        DataflashRecording(path)


def test_a_path_that_cannot_be_read_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"gone\.bin: no such file"):
        DataflashRecording(tmp_path / "gone.bin")
    with pytest.raises(LogError, match="is a directory"):
        DataflashRecording(tmp_path)


def hurt_copies(whole: bytes, head: int, many: int, seed: int) -> list[bytes]:
    """Copies with one to fifty flipped bits: anywhere, or among the definitions alone; and one in ten cut short."""
    rng = random.Random(seed)
    out = []
    for i in range(many):
        if i % 10 == 0:
            out.append(whole[: rng.randrange(1, len(whole))])
            continue
        copy = bytearray(whole)
        for _ in range(rng.choice((1, 5, 50))):
            copy[rng.randrange(head if i % 2 else len(copy))] ^= 1 << rng.randrange(8)
        out.append(bytes(copy))
    return out


def test_damage_gives_readings_or_a_log_error_and_time_never_turns_back(tmp_path: Path) -> None:
    path = tmp_path / "hurt.bin"
    log = flight(1.0)
    whole, head = log.binary(), sum(map(len, log.pieces()[: len(log.head())]))
    path.write_bytes(whole)
    all_of_it = sum(1 for _ in DataflashRecording(path).readings())
    kept = []
    for copy in hurt_copies(whole, head, DAMAGES, seed=171):
        path.write_bytes(copy)
        try:
            times = [t for t, _ in DataflashRecording(path).readings()]
        except LogError:
            continue
        assert times == sorted(times)
        kept.append(len(times) / all_of_it)
    assert len(kept) > 0.8 * DAMAGES
    assert np.median(kept) > 0.9


def same(ours: Any, theirs: Any) -> bool:
    both_nan = isinstance(ours, float) and isinstance(theirs, float) and math.isnan(ours) and math.isnan(theirs)
    return both_nan or ours == theirs


PEER = """
import json, sys
from pymavlink import DFReader
log = DFReader.DFReader_binary(sys.argv[1])
out = {}
while (m := log.recv_match(type=sys.argv[2].split(","))) is not None:
    columns = out.setdefault(m.get_type(), {})
    for label in m.get_fieldnames():
        columns.setdefault(label, []).append(getattr(m, label))
print(json.dumps(out))
"""


def peer(path: Path, names: tuple[str, ...]) -> dict[str, dict[str, list[Any]]]:
    """What pymavlink's reader (GPL, so in a process of its own) finds in these messages."""
    command = [sys.executable, "-c", PEER, str(path), ",".join(names)]
    out: dict[str, dict[str, list[Any]]] = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
    return out


def assert_same_columns(path: Path, names: tuple[str, ...]) -> int:
    tables, theirs = parse(path.read_bytes()), peer(path, names)
    assert theirs
    compared = 0
    for name, columns in theirs.items():
        for label, values in columns.items():
            if name == "MODE" and label == "Mode":
                continue  # it gives the mode a name
            ours = column(tables, name, label)
            assert len(ours) == len(values), (name, label)
            wrong = [(i, a, b) for i, (a, b) in enumerate(zip(ours, values, strict=True)) if not same(a, b)]
            assert wrong == [], (name, label, wrong[:3])
            compared += len(values)
    return compared


def test_another_reader_finds_the_same_in_a_log_with_units(tmp_path: Path) -> None:
    path = tmp_path / "units.bin"
    log = flight(3.0)
    log.add(IMU, 9_000_000, 0, math.nan, 1.5, -0.0, math.inf, 3e-39, -9.8)
    path.write_bytes(log.binary())
    names = ("MAG", "IMU", "ATT", "GPS", "POS", "BAT", "CTUN", "PARM", "MSG", "ARM")
    assert assert_same_columns(path, names) > 4000


@pytest.mark.flights
def test_another_reader_finds_the_same_in_a_real_log() -> None:
    path = LOGS / "log171.bin"
    if not path.exists():
        pytest.skip(f"real recordings not found at {LOGS}; set MAGMAV_DATA")
    assert assert_same_columns(path, READ) > 300_000


def test_the_form_is_what_the_documents_say() -> None:
    """The writer the other tests rest on: 89 bytes of FMT, little-endian and unpadded."""
    assert FMT.size == 89
    assert EV.body((0x0102030405060708, 9)) == b"\xa3\x95" + bytes((EV.number, 8, 7, 6, 5, 4, 3, 2, 1, 9))
    assert ATT.body((1, 0.0, -1.0, 0.0, 0.0, 0.0, 359.99))[-2:] == struct.pack("<H", 35999)
