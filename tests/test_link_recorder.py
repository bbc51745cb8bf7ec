"""What is recorded is what went over the link: read back, frame for frame, at the time it went."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
from itertools import islice
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.link import LinkError, Packet
from magmav.link.frames import cut
from magmav.link.memory import MemoryLink, SetClock, memory_pair
from magmav.link.recorder import TlogRecorder
from magmav.link.tlog import TlogLink

UNIX_NS = 1_795_000_000 * 10**9


def frames(count: int) -> list[bytes]:
    """Real frames, packed by pymavlink: two lengths, with start bytes in the payload."""
    mav = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    out = []
    for i in range(count):
        message = (
            mav.heartbeat_encode(2, 3, 0xFD, 0xFEFDFEFD, 4)
            if i % 3
            else mav.raw_imu_encode(i, 0, 0, -1000, 1, 2, 3, 0x7FFD, -515, 253)
        )
        mav.seq = i & 0xFF
        out.append(bytes(message.pack(mav)))
    return out


def pair(clock: SetClock, datagrams: bool = True) -> tuple[MemoryLink, MemoryLink]:
    return memory_pair(clock, datagrams=datagrams, unix_offset_ns=UNIX_NS)


def recorded(path: Path) -> list[tuple[int, bytes]]:
    """(ns since UNIX_NS, frame) of each record."""
    return [(p.t_ns - UNIX_NS, p.data) for p in TlogLink(path).packets() if p.data]


def test_both_directions_come_back_frame_for_frame_in_order_and_in_time(tmp_path: Path) -> None:
    clock = SetClock()
    here, there = pair(clock)
    link = TlogRecorder(here, tmp_path / "a.tlog")
    wire = frames(90)
    want = []
    turns = link.packets()
    for i in range(0, 90, 3):
        clock.advance(0.1)
        there.send(wire[i] + wire[i + 1])  # two frames in one datagram: two records
        assert next(turns).data == wire[i] + wire[i + 1]
        link.send(wire[i + 2])
        want += [(clock.now_ns, frame) for frame in wire[i : i + 3]]
    link.close()
    assert [p.data for p in islice(there.packets(), 30)] == wire[2::3]
    assert recorded(tmp_path / "a.tlog") == want
    assert link.counts["recorded"] == 90 and list(turns) == []


@pytest.mark.parametrize("size", [1, 2, 7, 33, 1000])
def test_a_stream_is_cut_into_whole_frames_however_it_arrives(tmp_path: Path, size: int) -> None:
    clock = SetClock()
    here, there = pair(clock, datagrams=False)
    link = TlogRecorder(here, tmp_path / "a.tlog")
    wire = frames(60)
    noise = b"\x01\x02 noise before"
    stream = noise + b"".join(wire)
    pieces = [stream[i : i + size] for i in range(0, len(stream), size)]
    for piece in pieces:
        there.send(piece)
    assert b"".join(p.data for p in islice(link.packets(), len(pieces))) == stream
    link.close()
    assert [frame for _, frame in recorded(tmp_path / "a.tlog")] == wire
    assert link.counts["unrecorded bytes"] == len(noise)


def test_it_is_on_disk_after_a_second_and_not_only_at_the_end(tmp_path: Path) -> None:
    clock = SetClock()
    here, there = pair(clock)
    path = tmp_path / "a.tlog"
    link = TlogRecorder(here, path)
    turns = link.packets()
    wire = frames(2)
    there.send(wire[0])
    next(turns)
    clock.advance(0.9)
    next(turns)
    assert path.stat().st_size == 0
    clock.advance(0.1)
    next(turns)
    assert path.stat().st_size == 8 + len(wire[0])
    link.close()


def test_what_was_sent_before_the_link_told_the_time_is_not_lost(tmp_path: Path) -> None:
    clock = SetClock(7_000_000_000)
    here, _ = pair(clock)
    link = TlogRecorder(here, tmp_path / "a.tlog")
    wire = frames(1)
    link.send(wire[0])
    next(link.packets())
    link.close()
    assert recorded(tmp_path / "a.tlog") == [(7_000_000_000, wire[0])]


def test_an_old_recording_is_continued_and_never_overwritten(tmp_path: Path) -> None:
    wire = frames(2)
    for i, frame in enumerate(wire):
        clock = SetClock(i * 10**9)
        here, there = pair(clock)
        link = TlogRecorder(here, str(tmp_path / "a.tlog"))
        there.send(frame)
        next(link.packets())
        link.close()
    assert recorded(tmp_path / "a.tlog") == [(0, wire[0]), (10**9, wire[1])]


def test_another_programs_reader_reads_it_too(tmp_path: Path) -> None:
    """pymavlink's own log reader, in a process of its own, finds the same messages at the same times."""
    clock = SetClock()
    here, there = pair(clock)
    link = TlogRecorder(here, tmp_path / "a.tlog")
    turns = link.packets()
    for frame in frames(30):
        clock.advance(0.5)
        there.send(frame)
        next(turns)
    link.close()
    program = (
        "import sys; from pymavlink import mavutil; log = mavutil.mavlink_connection(sys.argv[1])\n"
        "while m := log.recv_msg(): print(m.get_type(), round((m._timestamp - 1795000000) * 1000))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "a.tlog")],
        env={**os.environ, "MAVLINK20": "1", "MAVLINK_DIALECT": "ardupilotmega"},
        capture_output=True,
        text=True,
        timeout=30,
        check=True,
    )
    want = [f"{'HEARTBEAT' if i % 3 else 'RAW_IMU'} {500 * (i + 1)}" for i in range(30)]
    assert done.stdout.splitlines() == want


class Disk:
    """A file on a disk with room for so many bytes; takes at most 100 at a time, as a raw file may."""

    def __init__(self, room: int) -> None:
        self.data = bytearray()
        self._room = room

    def write(self, data: bytes, /) -> int:
        taken = min(len(data), 100, self._room - len(self.data))
        if taken == 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        self.data += data[:taken]
        return taken

    def flush(self) -> None: ...


@pytest.mark.parametrize(("room", "stops"), [(1000, 1), (10**6, 0)])
def test_a_full_disk_stops_the_recording_and_not_the_link(room: int, stops: int) -> None:
    clock = SetClock()
    here, there = pair(clock)
    disk = Disk(room)
    link = TlogRecorder(here, disk)
    turns = link.packets()
    wire = frames(200)
    for frame in wire:
        clock.advance(0.1)
        there.send(frame)
        assert next(turns).data == frame
        link.send(frame)
    link.close()
    assert sum(bool(p.data) for p in islice(there.packets(), 200)) == 200
    assert link.counts["recording stopped"] == stops
    whole = sum(2 * (8 + len(frame)) for frame in wire)
    assert len(disk.data) == min(room, whole)


def test_a_place_that_cannot_be_written_is_refused_by_name(tmp_path: Path) -> None:
    here, _ = pair(SetClock())
    with pytest.raises(LinkError, match=r"nosuch/a\.tlog: cannot record there: No such file or directory"):
        TlogRecorder(here, tmp_path / "nosuch" / "a.tlog")
    with pytest.raises(LinkError, match="Is a directory"):
        TlogRecorder(here, tmp_path)


def test_a_reader_that_stops_and_comes_back_is_recorded_throughout(tmp_path: Path) -> None:
    clock = SetClock()
    here, there = pair(clock)
    link = TlogRecorder(here, tmp_path / "a.tlog")
    wire = frames(4)
    for frame in wire:
        there.send(frame)
        for packet in link.packets():
            assert packet.data == frame
            break
    link.close()
    link.close()
    assert [frame for _, frame in recorded(tmp_path / "a.tlog")] == wire


def test_a_signal_in_the_middle_of_a_write_loses_nothing(tmp_path: Path) -> None:
    class Slow(Disk):
        def write(self, data: bytes, /) -> int:
            signal.raise_signal(signal.SIGALRM)
            return super().write(data)

    clock = SetClock()
    here, there = pair(clock)
    disk = Slow(10**6)
    link = TlogRecorder(here, disk)
    before = signal.signal(signal.SIGALRM, lambda *_: link.close())
    try:
        wire = frames(10)
        there.send(b"".join(wire))
        turns = link.packets()
        next(turns)
        clock.advance(2.0)
        # The tick that flushes is interrupted by the close; it still comes, and is the last.
        assert list(turns) == [Packet(2_000_000_000, b"", "")]
    finally:
        signal.signal(signal.SIGALRM, before)
    (tmp_path / "a.tlog").write_bytes(disk.data)
    assert [frame for _, frame in recorded(tmp_path / "a.tlog")] == wire


@settings(max_examples=200, deadline=None)
@given(noise=st.lists(st.binary(max_size=300), max_size=8))
def test_cutting_a_stream_keeps_every_byte_accounted_for_and_the_rest_short(noise: list[bytes]) -> None:
    rest, seen, kept, lost = b"", 0, 0, 0
    for piece in noise:
        seen += len(piece)
        found = cut(rest + piece, whole=False)
        rest = found.rest
        kept += sum(map(len, found.frames))
        lost += found.garbage
        assert len(rest) < 280 and kept + lost + len(rest) == seen
