"""A tlog read back: every record, its time, and what damage may cost (that record, never the file)."""

from __future__ import annotations

import os
import random
import socket
import struct
import time
from collections import Counter
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from magmav.link import LinkError, Packet
from magmav.link.cutter import RecordCutter
from magmav.link.open import open_link
from magmav.link.tlog import TlogLink
from magmav.mavlink.codec import Codec

START_US = 1_700_000_000_000_000
DAY_US = 86_400_000_000
FLIGHTS = Path(os.environ.get("MAGMAV_DATA", Path(__file__).parents[2] / "shared" / "data")) / "flights"


def frame(number: int, length: int = 20, version: int = 2, signed: bool = False) -> bytes:
    """A frame of the right form whose payload is its number, so that each is told from the others."""
    payload = struct.pack("<I", number) + bytes(range(length - 4))
    if version == 1:
        return bytes((0xFE, length, number & 0xFF, 1, 1, 27)) + payload + b"\x11\x22"
    head = bytes((0xFD, length, int(signed), 0, number & 0xFF, 1, 1, 27, 0, 0))
    return head + payload + b"\x11\x22" + (b"\x33" * 13 if signed else b"")


def record(stamp_us: int, data: bytes) -> bytes:
    return struct.pack(">Q", stamp_us) + data


def flight(count: int, step_us: int = 20_000) -> list[bytes]:
    """Records of every kind: both versions, signed, shortest and longest payload."""
    kinds = [(20, 2, False), (4, 1, False), (255, 2, True), (9, 2, False), (255, 1, False)]
    return [record(START_US + i * step_us, frame(i, *kinds[i % len(kinds)])) for i in range(count)]


def read(path: Path) -> tuple[list[Packet], TlogLink]:
    link = TlogLink(path)
    return list(link.packets()), link


def written(path: Path, *parts: bytes) -> Path:
    path.write_bytes(b"".join(parts))
    return path


def frames_of(packets: list[Packet]) -> list[bytes]:
    return [p.data for p in packets if p.data]


def test_every_record_comes_out_with_its_own_time(tmp_path: Path) -> None:
    records = flight(7000)
    path = written(tmp_path / "a.tlog", *records)
    assert path.stat().st_size > 2 << 18  # several chunks
    packets, link = read(path)
    assert packets == [Packet((START_US + i * 20_000) * 1000, r[8:], "tlog") for i, r in enumerate(records)]
    assert link.unix_offset_ns == 0 and link.counts == {"records": 7000}


def test_progress_ends_at_the_size_of_the_file_and_never_goes_back(tmp_path: Path) -> None:
    path = written(tmp_path / "a.tlog", *flight(20_000))
    seen: list[tuple[int, int]] = []
    for _ in TlogLink(path, lambda done, size: seen.append((done, size))).packets():
        pass
    size = path.stat().st_size
    assert seen[-1] == (size, size) and seen == sorted(seen) and len(seen) > 2


def test_a_single_record_is_a_tlog(tmp_path: Path) -> None:
    packets, _ = read(written(tmp_path / "a.tlog", *flight(1)))
    assert packets == [Packet(START_US * 1000, frame(0), "tlog")]


def test_a_silence_is_stepped_through_second_by_second_five_times_at_most(tmp_path: Path) -> None:
    times_s = [0.0, 1.0, 2.5, 5.5, 4000.0]
    records = [record(START_US + round(t * 1e6), frame(i)) for i, t in enumerate(times_s)]
    packets, _ = read(written(tmp_path / "a.tlog", *records))
    shape = [((p.t_ns - START_US * 1000) / 1e9, bool(p.data)) for p in packets]
    assert shape == [
        (0.0, True),
        (1.0, True),
        (2.0, False),
        (2.5, True),
        (3.5, False),
        (4.5, False),
        (5.5, True),
        *[(5.5 + i, False) for i in (1, 2, 3, 4, 5)],
        (4000.0, True),
    ]


def test_sending_into_a_recording_is_counted_and_changes_nothing(tmp_path: Path) -> None:
    path = written(tmp_path / "a.tlog", *flight(3))
    before = path.read_bytes()
    link = TlogLink(path)
    link.send(frame(1))
    link.send(frame(1), "tlog")
    assert len(list(link.packets())) == 3
    assert link.counts["not sent"] == 2 and path.read_bytes() == before


def test_S15_a_recording_opens_no_socket(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*args: object, **kwargs: object) -> None:
        raise AssertionError("a socket was opened")

    monkeypatch.setattr(socket, "socket", refused)
    link = open_link(str(written(tmp_path / "a.tlog", *flight(3))))
    link.send(frame(1))
    assert len(list(link.packets())) == 3


def test_closing_in_the_middle_ends_the_packets(tmp_path: Path) -> None:
    link = TlogLink(written(tmp_path / "a.tlog", *flight(50)))
    seen = 0
    for _ in link.packets():
        seen += 1
        if seen == 3:
            link.close()
            link.close()
    assert seen == 3 and list(link.packets()) == []


@pytest.mark.parametrize("left", range(1, 40))
def test_a_file_cut_in_its_last_record_gives_all_the_others(tmp_path: Path, left: int) -> None:
    records = flight(11)  # the last one is the plain 40-byte kind
    packets, link = read(written(tmp_path / "a.tlog", *records[:10], records[10][:left]))
    assert frames_of(packets) == [r[8:] for r in records[:10]]
    assert link.counts["truncated"] == 1 and link.counts["garbage bytes"] == 0


@pytest.mark.parametrize("garbage", [b"x", b"\x00" * 5000, bytes(range(256)) * 3, b"\xfd" * 700, b"\xa3\x95\x80"])
def test_garbage_between_records_costs_no_record(tmp_path: Path, garbage: bytes) -> None:
    records = flight(20)
    packets, link = read(written(tmp_path / "a.tlog", *records[:10], garbage, *records[10:]))
    assert frames_of(packets) == [r[8:] for r in records]
    assert link.counts["garbage bytes"] == len(garbage) and link.counts["resync"] == 1


@pytest.mark.parametrize("seed", range(12))
def test_garbage_between_all_records_costs_no_record_and_no_time(tmp_path: Path, seed: int) -> None:
    """A frame with garbage before and behind it has no company, and is the same frame."""
    records, rng = flight(60), random.Random(seed)
    parts = [part for r in records[2:] for part in (rng.randbytes(rng.randrange(1, 400)), r)]
    packets, link = read(written(tmp_path / "a.tlog", *records[:2], *parts))
    assert frames_of(packets) == [r[8:] for r in records]
    assert [p.t_ns for p in packets if p.data] == [int.from_bytes(r[:8], "big") * 1000 for r in records]
    assert link.counts["garbage bytes"] == sum(map(len, parts[::2])) and link.unix_offset_ns == 0


def test_garbage_before_the_first_record_is_skipped(tmp_path: Path) -> None:
    records = flight(20)
    packets, _ = read(written(tmp_path / "a.tlog", b"\x00\x05" * 3000, *records))
    assert frames_of(packets) == [r[8:] for r in records]


@pytest.mark.parametrize("bit", range(64))
def test_a_wrong_bit_in_a_time_loses_no_record_and_moves_no_other(tmp_path: Path, bit: int) -> None:
    records = flight(20)
    for at in (5, 19):
        hurt = bytearray(records[at])
        hurt[7 - bit // 8] ^= 1 << bit % 8
        packets, link = read(written(tmp_path / "a.tlog", *records[:at], hurt, *records[at + 1 :]))
        assert frames_of(packets) == [r[8:] for r in records]
        times_us = [p.t_ns // 1000 - START_US for p in packets if p.data]
        right = [i * 20_000 for i in range(20)]
        assert times_us[:at] == right[:at] and link.unix_offset_ns == 0
        # Where the bit is too small to look wrong, later times may be held up by less than a second.
        assert all(0 <= t - r <= 1_000_000 for t, r in zip(times_us[at + 1 :], right[at + 1 :], strict=True))
        assert times_us == sorted(times_us) and times_us[at] <= (1_400_000 if at == 5 else DAY_US)


def test_a_clock_set_in_flight_moves_the_offset_and_not_the_time(tmp_path: Path) -> None:
    steps = [(0, 0), (1, 400 * DAY_US), (2, 400 * DAY_US - 3_600_000_000)]
    records = [
        record(START_US + shift + (part * 20 + i) * 20_000, frame(part * 20 + i))
        for part, shift in steps
        for i in range(20)
    ]
    link = TlogLink(written(tmp_path / "a.tlog", *records))
    times_us, unix_us = [], []
    for packet in link.packets():
        times_us.append(packet.t_ns // 1000)
        unix_us.append((packet.t_ns + link.unix_offset_ns) // 1000)
    assert unix_us == [int.from_bytes(r[:8], "big") for r in records]
    assert all(0 <= b - a <= 20_000 for a, b in pairwise(times_us))
    assert link.counts["clock set"] == 2 and "garbage bytes" not in link.counts


def test_times_a_little_out_of_order_never_go_back(tmp_path: Path) -> None:
    times = [0, 20, 10, 30, 25, 40]
    records = [record(START_US + t * 1000, frame(i)) for i, t in enumerate(times)]
    packets, _ = read(written(tmp_path / "a.tlog", *records))
    assert [p.t_ns // 1_000_000 - START_US // 1000 for p in packets] == [0, 20, 20, 30, 30, 40]


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("empty.tlog", b"", "is empty"),
        ("zeros.tlog", b"\x00" * 3000, "not a tlog"),
        ("text.tlog", b"latitude,longitude\n" * 100, "not a tlog"),
        ("log.tlog", b"\xa3\x95\x80\x80" + b"\x59FMT\0" * 50, "DataFlash"),
        ("px4.tlog", b"ULog\x01\x12\x35" + b"\0" * 500, "ULog"),
        ("raw.tlog", b"".join(frame(i) for i in range(50)), "8 bytes of time"),
        ("short.tlog", b"\x00\x06", "not a tlog"),
    ],
)
def test_what_is_no_tlog_is_refused_by_name(tmp_path: Path, name: str, content: bytes, says: str) -> None:
    path = written(tmp_path / name, content)
    with pytest.raises(LinkError, match=says) as caught:
        TlogLink(path)
    assert str(path) in str(caught.value)


def test_missing_files_and_directories_are_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(LinkError, match=r"nosuch\.tlog: no such file"):
        TlogLink(tmp_path / "nosuch.tlog")
    with pytest.raises(LinkError, match="is a directory"):
        TlogLink(tmp_path)
    os.mkfifo(tmp_path / "pipe.tlog")
    with pytest.raises(LinkError, match="not a regular file"):
        TlogLink(tmp_path / "pipe.tlog")


RECORDS = flight(60)
BOUNDS = [sum(len(r) for r in RECORDS[:i]) for i in range(61)]
WHOLE = b"".join(RECORDS)
quick = settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@quick
@given(at=st.integers(0, len(WHOLE) - 1), mask=st.integers(1, 255))
def test_any_byte_flipped_costs_its_record_and_at_most_a_neighbour(tmp_path: Path, at: int, mask: int) -> None:
    hurt = bytearray(WHOLE)
    hurt[at] ^= mask
    packets, _ = read(written(tmp_path / "a.tlog", bytes(hurt)))
    where = next(i for i in range(60) if at < BOUNDS[i + 1])
    got = frames_of(packets)
    want = [r[8:] for i, r in enumerate(RECORDS) if abs(i - where) > 1]
    assert [f for f in got if f in set(want)] == want
    times = [p.t_ns for p in packets]
    assert times == sorted(times)


@quick
@given(pieces=st.lists(st.tuples(st.integers(0, len(WHOLE)), st.integers(0, 400), st.binary(max_size=80)), max_size=4))
def test_anything_cut_out_or_put_in_spares_what_is_far_from_it(
    tmp_path: Path, pieces: list[tuple[int, int, bytes]]
) -> None:
    """Each piece replaces bytes by others; records not within two of a wound must all come out, in order."""
    data, done, wounds = b"", 0, set[int]()
    for start, size, new in sorted(pieces):
        at = max(start, done)
        data, done = data + WHOLE[done:at] + new, min(at + size, len(WHOLE))
        wounds |= {i for i in range(60) if BOUNDS[i] <= done and BOUNDS[i + 1] >= at}
    data += WHOLE[done:]
    path = written(tmp_path / "a.tlog", data)
    try:
        packets, _ = read(path)
    except LinkError:
        assert len(wounds) > 50 or len(data) < 600
        return
    want = [r[8:] for i, r in enumerate(RECORDS) if all(abs(i - w) > 2 for w in wounds)]
    assert [f for f in frames_of(packets) if f in set(want)] == want


@quick
@given(at=st.integers(0, len(WHOLE) - 1), mask=st.integers(0, 255), size=st.integers(40, 4000), new=st.binary())
def test_the_pieces_a_file_is_read_in_change_nothing(at: int, mask: int, size: int, new: bytes) -> None:
    hurt = bytearray(WHOLE)
    hurt[at] ^= mask
    hurt[at // 2 : at // 2] = new
    results = []
    for step in (size, len(hurt)):
        counts: Counter[str] = Counter()
        cutter, packets = RecordCutter(counts, "tlog"), list[Packet]()
        for start in range(0, len(hurt), step):
            cutter.feed(bytes(hurt[start : start + step]), last=start + step >= len(hurt))
            while batch := cutter.cut()[1]:
                packets += batch
        results.append((packets, counts))
    assert results[0] == results[1]


def test_a_header_with_nothing_behind_it_swallows_no_record(tmp_path: Path) -> None:
    """The front of a record that was never finished: its length reaches over the next two records."""
    records = flight(20)
    for half in (records[9][:30], record(START_US + 190_000, frame(99, 90))[:20]):
        packets, _ = read(written(tmp_path / "a.tlog", *records[:9], half, *records[10:]))
        assert frames_of(packets) == [r[8:] for r in records[:9] + records[10:]]
        packets, _ = read(written(tmp_path / "a.tlog", *records[:9], b"noise", half, *records[10:]))
        assert frames_of(packets) == [r[8:] for r in records[:9] + records[10:]]


def test_a_false_start_from_another_year_does_not_set_the_time(tmp_path: Path) -> None:
    records = flight(20)
    packets, link = read(written(tmp_path / "a.tlog", record(4 * START_US // 3, frame(99)), *records))
    assert [(p.t_ns // 1000, p.data) for p in packets] == [
        (START_US + i * 20_000, r[8:]) for i, r in enumerate(records)
    ]
    assert link.unix_offset_ns == 0 and link.counts["clock set"] == 0


@quick
@given(cut=st.integers(0, len(WHOLE)))
def test_a_file_cut_anywhere_gives_every_record_before_the_cut(tmp_path: Path, cut: int) -> None:
    path = written(tmp_path / "a.tlog", WHOLE[:cut])
    whole = sum(end <= cut for end in BOUNDS[1:])
    try:
        packets, _ = read(path)
    except LinkError:
        assert whole == 0
        return
    assert frames_of(packets) == [r[8:] for r in RECORDS[:whole]]


@quick
@given(noise=st.binary(max_size=3000))
def test_noise_is_refused_or_read_but_never_raises_anything_else(tmp_path: Path, noise: bytes) -> None:
    try:
        packets, _ = read(written(tmp_path / "a.tlog", noise))
    except LinkError:
        return
    assert frames_of(packets)


@pytest.mark.flights
def test_a_real_flight_decodes_without_a_single_bad_checksum() -> None:
    path = FLIGHTS / "thor75.tlog"
    if not path.exists():
        pytest.skip(f"real recordings not found at {FLIGHTS}; set MAGMAV_DATA")
    began = time.process_time()
    packets, link = read(path)
    took_s = time.process_time() - began
    codec = Codec()
    for packet in packets:
        assert len(codec.decode(packet.data, packet.route, whole=True)) == 1
    assert len(packets) == 64_076 and link.counts == {"records": 64_076}
    assert set(codec.counts) <= {"messages", "garbage bytes"} and codec.counts["garbage bytes"] == 0
    assert 690 < (packets[-1].t_ns - packets[0].t_ns) / 1e9 < 700
    assert took_s < 2.0  # 0.1 s here, with room for a busy machine


@pytest.mark.flights
def test_a_real_flight_with_a_thousand_wounds_keeps_nearly_everything(tmp_path: Path) -> None:
    path = FLIGHTS / "thor75.tlog"
    if not path.exists():
        pytest.skip(f"real recordings not found at {FLIGHTS}; set MAGMAV_DATA")
    hurt, rng = bytearray(path.read_bytes()), random.Random(75)
    for _ in range(1000):
        hurt[rng.randrange(len(hurt))] ^= 1 << rng.randrange(8)
    packets, _ = read(written(tmp_path / "hurt.tlog", bytes(hurt)))
    codec = Codec()
    good = sum(len(codec.decode(p.data, p.route, whole=True)) for p in packets)
    assert good > 64_076 - 1150
    times = [p.t_ns for p in packets]
    assert times == sorted(times) and (times[-1] - times[0]) / 1e9 < 700
