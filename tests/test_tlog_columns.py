"""A tlog by columns: the same messages, numbers, times and counts as one by one, however damaged."""

from __future__ import annotations

import os
import random
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tlog_parity import HARM, Harm, cut, flight, flip, harmed, one_by_one, values_of, woven

from magmav.link import LinkError
from magmav.logs.tlog import columns, read_tlog
from magmav.mavlink.codec import Codec
from magmav.mavlink.decode import Decoder

WANTED = Decoder().wanted
DATA = Path(os.environ.get("MAGMAV_DATA", Path(__file__).parents[2] / "shared" / "data"))


def same(path: Path, data: bytes) -> None:
    """The law of this file."""
    path.write_bytes(data)
    rows, link, codec = one_by_one(path, WANTED)
    got = read_tlog(path, WANTED)
    assert woven(got) == rows
    assert got.link == link and got.codec == codec
    assert got.heard == {name: sum(r[0] == name for r in rows) for name in {r[0] for r in rows}}


@pytest.mark.parametrize("seed", range(8))
def test_same_as_one_by_one_of_every_kind_version_and_sender(tmp_path: Path, seed: int) -> None:
    path = tmp_path / "a.tlog"
    same(path, b"".join(flight(seed)))
    got = read_tlog(path, WANTED)
    assert len(got.heard) >= 7 and got.codec["skipped"] > 5 and "bad crc" not in got.codec
    assert {1, 2, 255} == set(np.concatenate([t.system for t in got.by_name.values()]).tolist())


def test_fields_are_those_of_the_dialect_number_for_number() -> None:
    data = b"".join(flight(3, 400))
    codec, got, seen = Codec(WANTED), columns(data, WANTED), 0
    at = dict.fromkeys(got.by_name, 0)
    begin = 0
    while begin < len(data):
        frame = data[begin + 8 :]
        size = 12 + frame[1] + 13 * frame[2] if frame[0] == 0xFD else 8 + frame[1]
        for message in codec.decode(frame[:size], "", whole=True):
            name = message.get_type()
            row = got.by_name[name].fields[at[name]]
            mine = []
            for label in message.ordered_fieldnames:
                value = row[label]
                if isinstance(value, np.ndarray):
                    mine.append(tuple(value.tolist()))
                elif isinstance(value, bytes):
                    mine.append(value.split(b"\0", 1)[0].decode("ascii", errors="replace"))
                else:
                    plain = value.item()
                    mine.append(np.float64(plain).tobytes() if isinstance(plain, float) else plain)
            assert mine == values_of(message)
            at[name] += 1
            seen += 1
        begin += 8 + size
    assert seen == sum(got.heard.values()) > 250


@given(seed=st.integers(0, 2**32 - 1), harm=st.lists(st.sampled_from(HARM), min_size=1, max_size=6))
@settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_same_as_one_by_one_however_damaged(tmp_path: Path, seed: int, harm: list[Harm]) -> None:
    path, data = tmp_path / "a.tlog", harmed(seed, harm)
    path.write_bytes(data)
    try:
        one_by_one(path, WANTED)
    except LinkError as error:
        with pytest.raises(LinkError) as mine:
            read_tlog(path, WANTED)
        assert str(mine.value) == str(error)
        return
    same(path, data)


def test_same_as_one_by_one_where_the_recorder_clock_was_set(tmp_path: Path) -> None:
    records = flight(5)
    shifts = (0, 400 * 86_400_000_000, -7_200_000_000)
    moved = [
        (int.from_bytes(r[:8], "big") + shifts[i * 3 // len(records)]).to_bytes(8, "big") + r[8:]
        for i, r in enumerate(records)
    ]
    path = tmp_path / "a.tlog"
    same(path, b"".join(moved))
    assert read_tlog(path, WANTED).link["clock set"] == 2


@pytest.mark.parametrize("name", ["sitl/copter-fig8.tlog", "sitl/plane-circles.tlog", "flights/thor75.tlog"])
def test_same_as_one_by_one_on_a_real_recording_whole_and_damaged(tmp_path: Path, name: str) -> None:
    path = DATA / name
    if not path.is_file():
        pytest.skip(f"no {path}: set MAGMAV_DATA")
    whole = path.read_bytes()
    begin, rng = len(whole) // 3, random.Random(name)
    data = bytearray(whole[begin : begin + 300_000])  # begins within a record
    for one in [*HARM * 10, *[flip] * 200]:
        if one is not cut:
            one(data, rng)
    same(tmp_path / "a.tlog", bytes(data))
    assert read_tlog(tmp_path / "a.tlog", WANTED).codec["bad crc"] > 20


def test_several_vehicles_are_told_apart(tmp_path: Path) -> None:
    got = columns(b"".join(flight(7, 600)), WANTED)
    table = got.of("ATTITUDE")
    parts = [table.of(system) for system in (1, 2, 255)]
    assert sum(map(len, parts)) == len(table) > 20 and all(len(p) for p in parts)
    assert sorted(np.concatenate([p.order for p in parts]).tolist()) == table.order.tolist()
    assert set(table.of(1, 100).component.tolist()) == {100}
    assert len(got.of("HIGHRES_IMU")) == 0 and "xmag" in (got.of("HIGHRES_IMU").fields.dtype.names or ())


@pytest.mark.parametrize(("content", "says"), [(b"", "is empty"), (bytes(5000), "not a tlog"), (None, "no such file")])
def test_what_is_no_tlog_is_refused_as_ever(tmp_path: Path, content: bytes | None, says: str) -> None:
    path = tmp_path / "a.tlog"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(LinkError, match=says):
        read_tlog(path, WANTED)


def test_an_unknown_message_is_named() -> None:
    with pytest.raises(KeyError, match="RAW_IMMU"):
        read_tlog("any.tlog", frozenset({"RAW_IMMU"}))
