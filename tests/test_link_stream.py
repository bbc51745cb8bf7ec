"""TCP over loopback and serial over a pseudo terminal: the other end dies, comes back, or stops listening."""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import closing
from itertools import islice
from pathlib import Path

import pytest

from magmav.link import LinkError, Packet
from magmav.link.memory import SetClock
from magmav.link.reopen import Backoff
from magmav.link.serial import serial
from magmav.link.stream import StreamLink
from magmav.link.tcp import tcp

FAST = {"tick_s": 0.01, "retry_s": 0.02, "longest_retry_s": 0.04}


def listener(port: int = 0) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    # Only this test's server may take the port of its dead predecessor at once.
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    sock.bind(("127.0.0.1", port))
    sock.listen(1)
    sock.settimeout(2.0)
    return sock


def turn_until(link: StreamLink, wanted: Callable[[list[Packet]], bool]) -> list[Packet]:
    """Packets up to the first moment at which ``wanted`` holds for those seen so far."""
    seen: list[Packet] = []
    end = time.monotonic() + 60.0  # for what never comes, however busy the machine is
    for packet in link.packets():
        seen.append(packet)
        if wanted(seen):
            return seen
        assert time.monotonic() < end, f"not reached; {link.counts}, last {seen[-3:]}"
    raise AssertionError("packets ended")


def text(packets: list[Packet]) -> bytes:
    return b"".join(p.data for p in packets)


@pytest.fixture
def pair() -> Iterator[tuple[StreamLink, socket.socket, socket.socket]]:
    """A link, the server it is connected to, and the server's side of the connection."""
    server = listener()
    link = tcp("127.0.0.1", server.getsockname()[1], **FAST)
    peer, _ = server.accept()
    peer.settimeout(2.0)
    yield link, server, peer
    for thing in (link, peer, server):
        thing.close()


Pair = tuple[StreamLink, socket.socket, socket.socket]


def test_bytes_go_both_ways(pair: Pair) -> None:
    link, _, peer = pair
    assert link.datagrams is False
    peer.sendall(b"from there")
    got = turn_until(link, lambda seen: text(seen) == b"from there")
    assert {p.route for p in got if p.data} == {link.name}
    link.send(b"from here")
    link.send(b" again", link.name)
    with peer.makefile("rb") as stream:
        assert stream.read(15) == b"from here again"


def test_a_server_that_dies_and_comes_back_is_found_under_a_new_route(pair: Pair) -> None:
    link, server, peer = pair
    port = server.getsockname()[1]
    peer.sendall(b"half a fra")
    turn_until(link, lambda seen: text(seen) == b"half a fra")
    peer.close()
    server.close()
    turn_until(link, lambda _: link.counts["lost"] == 1)
    dead = turn_until(link, lambda _: link.counts["open failed"] >= 2)
    assert all(p.data == b"" and p.route == "" for p in dead)
    assert [p.t_ns for p in dead] == sorted(p.t_ns for p in dead)
    link.send(b"nobody hears this")
    assert link.counts["not sent"] == 1
    with listener(port) as again:
        turn_until(link, lambda _: link.counts["reopened"] == 1)
        second, _ = again.accept()
        with second:
            second.sendall(b"fresh")
            got = turn_until(link, lambda seen: text(seen) == b"fresh")
            assert {p.route for p in got if p.data} == {f"{link.name}#2"}
            link.send(b"for the one before", link.name)
            link.send(b"hello again")
            assert second.recv(100) == b"hello again" and link.counts["not sent"] == 2
    assert link.counts["opened"] == 1 and link.counts["lost"] == 1


def test_a_reader_that_stops_reading_costs_whole_sends_and_no_waiting(pair: Pair) -> None:
    link, _, peer = pair
    peer.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    piece = bytes(range(250))
    sent = 0
    began = time.monotonic()
    while link.counts["dropped sends"] < 10:
        link.send(piece + sent.to_bytes(6, "big"))
        sent += 1
        assert sent < 200_000
    assert time.monotonic() - began < 60.0
    kept = link.counts["sent"]
    assert kept == sent - 10
    received = bytearray()
    turns = link.packets()
    peer.setblocking(False)
    while len(received) < 256 * kept:
        next(turns)  # what waited goes out as there is room
        try:
            received += peer.recv(65_536)
        except BlockingIOError:
            assert time.monotonic() - began < 60.0
    assert bytes(received) == b"".join(piece + i.to_bytes(6, "big") for i in range(kept))


def test_a_server_that_accepts_and_hangs_up_is_not_stormed() -> None:
    with listener() as server:
        server.settimeout(0.01)
        with closing(tcp("127.0.0.1", server.getsockname()[1], **FAST)) as link:
            end = time.monotonic() + 0.4
            accepted = 0
            while time.monotonic() < end:
                next(link.packets())
                try:
                    server.accept()[0].close()
                    accepted += 1
                except TimeoutError:
                    pass
            assert 1 <= accepted <= 12  # about one each 0.04 s, the longest pause, plus the turns


def test_the_first_connection_must_succeed() -> None:
    with listener() as server:
        port = server.getsockname()[1]
    with pytest.raises(LinkError, match=f"tcp:127.0.0.1:{port}: connection refused"):
        tcp("127.0.0.1", port)
    with pytest.raises(LinkError, match="host 'no such host' is not known"):
        tcp("no such host", 5760)


def test_settings_that_cannot_be_are_refused_by_name_and_leave_nothing_open() -> None:
    with listener() as server:
        port = server.getsockname()[1]
        with pytest.raises(ValueError, match="tick_s"):
            tcp("127.0.0.1", port, tick_s=0.0)
        with pytest.raises(ValueError, match="longest_s"):
            tcp("127.0.0.1", port, retry_s=2.0, longest_retry_s=1.0)


def test_a_tcp_link_closes_from_a_signal_handler_and_from_another_thread(pair: Pair) -> None:
    link, server, _ = pair
    before = signal.signal(signal.SIGALRM, lambda *_: link.close())
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.03)
        assert all(p.data == b"" for p in link.packets())
    finally:
        signal.signal(signal.SIGALRM, before)
    link.close()
    with closing(tcp("127.0.0.1", server.getsockname()[1], **FAST)) as other:
        timer = threading.Timer(0.03, other.close)
        timer.start()
        assert all(p.data == b"" for p in other.packets())
        timer.join()
    assert link.counts["lost"] == 0


class Wire:
    """A port on a socket pair, whose far end the test holds."""

    def __init__(self) -> None:
        self._near, self.far = socket.socketpair()
        self._near.setblocking(False)
        self.fd = self._near.fileno()

    def opened(self) -> bool:
        return True

    def read(self) -> bytes:
        if data := self._near.recv(1000):
            return data
        raise ConnectionResetError

    def write(self, data: bytes, /) -> int:
        return self._near.send(data[:100])  # takes a little, like a slow radio

    def close(self) -> None:
        self._near.close()


def test_a_lost_port_is_tried_ever_more_rarely_until_it_has_spoken_again() -> None:
    clock, wires, tried_s = SetClock(), [Wire()], list[float]()

    def reopen() -> Wire:
        tried_s.append(clock.now_ns / 1e9)
        if len(tried_s) % 4:
            raise OSError("not yet")
        wires.append(Wire())
        return wires[-1]

    with closing(StreamLink("wire", wires[0], reopen, tick_s=0.001, clock_ns=clock)) as link:
        turns = link.packets()
        link.send(b"x" * 300)  # 200 of it wait when the port dies, and must die with it
        for life in (1, 2):
            began_s = clock.now_ns / 1e9
            wires[-1].far.close()
            tried_s.clear()
            while link.counts["reopened"] < life:
                assert next(turns).data == b""
                clock.advance(0.1)
            assert [round(t - began_s, 1) for t in tried_s] == [0.5, 1.5, 3.5, 7.5]
            wires[-1].far.send(b"alive")
            assert next(turns)[1:] == (b"alive", f"wire#{life + 1}")
            link.send(b"hello")
            next(turns)
            assert wires[-1].far.recv(1000) == b"hello"
    wires[-1].far.close()
    assert link.counts["lost"] == 2 and link.counts["open failed"] == 6


def test_backoff_doubles_to_its_limit_and_starts_over_once_bytes_come() -> None:
    backoff = Backoff(0.5, 10.0)
    waits = []
    for _ in range(7):
        backoff.failed(0)
        waits.append(backoff.left_ns(0) / 1e9)
    assert waits == [0.5, 1.0, 2.0, 4.0, 8.0, 10.0, 10.0]
    assert backoff.left_ns(4_000_000_000) == 6_000_000_000 and backoff.left_ns(11_000_000_000) == 0
    backoff.alive()
    backoff.failed(0)
    assert backoff.left_ns(0) == 500_000_000
    with pytest.raises(ValueError, match="first_s"):
        Backoff(0.0, 1.0)


# ---------------------------------------------------------------- serial


def terminal(link_to: Path) -> int:
    """A pseudo terminal reachable at ``link_to``, as udev names a device; the descriptor of its far end."""
    far, near = os.openpty()
    tty.setraw(near)
    link_to.unlink(missing_ok=True)
    link_to.symlink_to(os.ttyname(near))
    os.close(near)
    return far


def test_serial_bytes_go_both_ways_unchanged(tmp_path: Path) -> None:
    far = terminal(tmp_path / "ttyTEST")
    try:
        with closing(serial(str(tmp_path / "ttyTEST"), 115_200, **FAST)) as link:
            every = bytes(range(256))  # control characters too: nothing may be translated
            os.write(far, every)
            got = turn_until(link, lambda seen: len(text(seen)) >= 256)
            assert text(got) == every and got[-1].route == link.name
            link.send(every)
            assert os.read(far, 1000) == every
    finally:
        os.close(far)


def test_an_unplugged_device_is_opened_again_when_it_is_back(tmp_path: Path) -> None:
    device = tmp_path / "ttyTEST"
    far = terminal(device)
    with closing(serial(str(device), **FAST)) as link:
        assert link.name == f"serial:{device}:57600"
        os.write(far, b"one")
        turn_until(link, lambda seen: text(seen) == b"one")
        os.close(far)
        device.unlink()
        dead = turn_until(link, lambda _: link.counts["lost"] == 1 and link.counts["open failed"] >= 2)
        assert text(dead) == b""
        far = terminal(device)
        try:
            turn_until(link, lambda _: link.counts["reopened"] == 1)
            os.write(far, b"two")
            got = turn_until(link, lambda seen: text(seen) == b"two")
            assert got[-1].route == f"{link.name}#2"
        finally:
            os.close(far)


def test_a_device_that_takes_nothing_blocks_nobody(tmp_path: Path) -> None:
    far = terminal(tmp_path / "ttyTEST")
    try:
        with closing(serial(str(tmp_path / "ttyTEST"), **FAST)) as link:
            began = time.monotonic()
            while link.counts["dropped sends"] < 10:
                link.send(bytes(200))
                assert link.counts["sent"] < 10_000
            list(islice(link.packets(), 3))
            assert time.monotonic() - began < 60.0 and link.counts["lost"] == 0
    finally:
        os.close(far)


@pytest.mark.parametrize(("waiting", "left"), [([300, 100, 0], 0), ([300] * 1000, 300)])
def test_closing_waits_for_the_last_words_but_not_for_ever(
    monkeypatch: pytest.MonkeyPatch, waiting: list[int], left: int
) -> None:
    """A stand-in for the device: a pseudo terminal has no slow wire to wait for."""
    thrown_away = []

    class Radio:
        def fileno(self) -> int:
            return 0

        @property
        def out_waiting(self) -> int:
            return waiting.pop(0)

        def reset_output_buffer(self) -> None:
            thrown_away.append(waiting[0] if waiting else 0)

        def close(self) -> None: ...

    monkeypatch.setattr("serial.Serial", lambda *_, **__: Radio())
    began = time.monotonic()
    serial("/dev/radio").close()
    assert thrown_away == [left] and time.monotonic() - began < 60.0


def test_devices_that_cannot_be_used_are_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(LinkError, match=r"no device .*nosuch; is it plugged in"):
        serial(str(tmp_path / "nosuch"))
    (tmp_path / "file").write_bytes(b"not a terminal")
    with pytest.raises(LinkError, match=r"cannot use .*file at 57600 baud"):
        serial(str(tmp_path / "file"))
    far = terminal(tmp_path / "ttyTEST")
    try:
        with (
            closing(serial(str(tmp_path / "ttyTEST"))),
            pytest.raises(LinkError, match="in use by another program"),
        ):
            serial(str(tmp_path / "ttyTEST"))
    finally:
        os.close(far)
