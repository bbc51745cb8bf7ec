"""UDP with real sockets on loopback and ephemeral ports; time is injected where silence matters."""

from __future__ import annotations

import itertools
import signal
import socket
import time
from collections.abc import Iterator
from contextlib import closing

import pytest

from magmav.link import LinkError, Packet
from magmav.link.memory import SetClock
from magmav.link.udp import UdpLink, udp_in, udp_out


@pytest.fixture
def peers() -> Iterator[list[socket.socket]]:
    """Twenty plain sockets, as other programs would have them."""
    made = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(20)]
    for sock in made:
        sock.bind(("127.0.0.1", 0))
        sock.settimeout(1.0)
    yield made
    for sock in made:
        sock.close()


def some(link: UdpLink, count: int) -> list[Packet]:
    """The next packets that carry bytes; a minute is for those that never come, however busy the machine is."""
    end = time.monotonic() + 60.0
    in_time = itertools.takewhile(lambda _: time.monotonic() < end, link.packets())
    return list(itertools.islice((p for p in in_time if p.data), count))


def route_of(sock: socket.socket) -> str:
    return f"udp:127.0.0.1:{sock.getsockname()[1]}"


def nothing_waits(sock: socket.socket) -> bool:
    sock.setblocking(False)
    with pytest.raises(BlockingIOError):
        sock.recv(100)
    return True


def test_one_datagram_is_one_packet_and_each_peer_has_its_route(peers: list[socket.socket]) -> None:
    with closing(udp_in("", 0)) as link:
        for i, sock in enumerate(peers[:3]):
            sock.sendto(b"first %d" % i, ("127.0.0.1", link.port))
            sock.sendto(b"second %d" % i, ("127.0.0.1", link.port))
        got = some(link, 6)
        assert [(p.data, p.route) for p in got] == [
            (b"%s %d" % (word, i), route_of(sock)) for i, sock in enumerate(peers[:3]) for word in (b"first", b"second")
        ]
        assert [p.t_ns for p in got] == sorted(p.t_ns for p in got)
        unix_ns = got[-1].t_ns + link.unix_offset_ns
        assert abs(unix_ns - time.time_ns()) < 60_000_000_000  # not the day in which the machine was started


def test_sending_goes_to_one_route_or_to_all(peers: list[socket.socket]) -> None:
    with closing(udp_in("", 0)) as link:
        for sock in peers[:3]:
            sock.sendto(b"hello", ("127.0.0.1", link.port))
        some(link, 3)
        link.send(b"for the second", route_of(peers[1]))
        assert peers[1].recv(100) == b"for the second"
        link.send(b"for all")
        assert [sock.recv(100) for sock in peers[:3]] == [b"for all"] * 3
        link.send(b"lost", "udp:127.0.0.1:1")
        assert link.counts["not sent"] == 1 and all(nothing_waits(sock) for sock in peers[:3])


def test_a_taken_port_is_refused_with_what_to_do() -> None:
    with closing(udp_in("", 0)) as link:
        with pytest.raises(LinkError, match=f"port {link.port} is taken by another program; stop") as caught:
            udp_in("127.0.0.1", link.port)
        assert str(caught.value).startswith(f"udpin:127.0.0.1:{link.port}: ")
        port = link.port
    udp_in("", port).close()  # a closed link gives its port back


def test_a_peer_silent_for_thirty_seconds_is_forgotten(peers: list[socket.socket]) -> None:
    clock = SetClock(1_000_000_000)
    with closing(udp_in("", 0, clock_ns=clock)) as link:
        old, new = peers[:2]
        old.sendto(b"1", ("127.0.0.1", link.port))
        assert some(link, 1)[0].t_ns == clock.now_ns
        clock.advance(20.0)
        new.sendto(b"2", ("127.0.0.1", link.port))
        some(link, 1)
        clock.advance(10.0)
        link.send(b"to both, just in time")
        assert old.recv(100) == new.recv(100) == b"to both, just in time"
        clock.advance(0.001)
        link.send(b"only the new one")
        assert link.routes == (route_of(new),) and link.counts["peers forgotten"] == 1
        assert new.recv(100) == b"only the new one" and nothing_waits(old)


def test_a_peer_that_keeps_talking_is_kept(peers: list[socket.socket]) -> None:
    clock = SetClock()
    with closing(udp_in("", 0, clock_ns=clock)) as link:
        for _ in range(4):
            peers[0].sendto(b"here", ("127.0.0.1", link.port))
            some(link, 1)
            clock.advance(20.0)
            link.send(b"there")
            assert peers[0].recv(100) == b"there"


def test_the_seventeenth_peer_is_not_heard_until_another_falls_silent(peers: list[socket.socket]) -> None:
    clock = SetClock()
    with closing(udp_in("", 0, clock_ns=clock)) as link:
        for sock in peers[:17]:
            sock.sendto(b"hello", ("127.0.0.1", link.port))
        assert [p.route for p in some(link, 16)] == [route_of(sock) for sock in peers[:16]]
        assert next(link.packets()) == Packet(0, b"", "") and link.counts["too many peers"] == 1
        clock.advance(31.0)
        peers[16].sendto(b"hello", ("127.0.0.1", link.port))
        assert some(link, 1)[0].route == route_of(peers[16]) and len(link.routes) == 1


def test_udpout_speaks_first_hears_only_its_peer_and_never_forgets_it(peers: list[socket.socket]) -> None:
    clock = SetClock()
    peer, stranger = peers[:2]
    with closing(udp_out("localhost", peer.getsockname()[1], clock_ns=clock)) as link:
        link.send(b"hello")
        data, address = peer.recvfrom(100)
        assert data == b"hello" and address == ("127.0.0.1", link.port)
        stranger.sendto(b"I am the vehicle", address)
        peer.sendto(b"welcome", address)
        got = list(itertools.islice(link.packets(), 2))
        assert got == [Packet(0, b"", ""), Packet(0, b"welcome", route_of(peer))]
        assert link.counts["wrong source"] == 1
        clock.advance(3600.0)
        link.send(b"still there?")
        assert peer.recv(100) == b"still there?"


def test_a_peer_that_is_gone_is_never_an_error(peers: list[socket.socket]) -> None:
    gone = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    gone.bind(("127.0.0.1", 0))
    with closing(udp_out("127.0.0.1", gone.getsockname()[1])) as link, closing(udp_in("", 0)) as many:
        gone.sendto(b"last words", ("127.0.0.1", many.port))
        some(many, 1)
        gone.close()
        for _ in range(5):
            link.send(b"x")
            many.send(b"x")
            assert next(link.packets()).data == next(many.packets()).data == b""
        link.send(b"x" * 70_000)  # more than a datagram holds: the operating system refuses it
        assert link.counts["send errors"] == 1


def test_a_quiet_link_ticks_and_empty_datagrams_are_no_data(peers: list[socket.socket]) -> None:
    with closing(udp_in("", 0, tick_s=0.01)) as link:
        began = time.monotonic()
        ticks = list(itertools.islice(link.packets(), 5))
        assert time.monotonic() - began > 0.045
        assert all(p.data == b"" and p.route == "" for p in ticks)
        peers[0].sendto(b"", ("127.0.0.1", link.port))
        assert next(link.packets()).data == b"" and link.counts["empty datagrams"] == 1


def test_only_a_bind_beyond_loopback_warns() -> None:
    for host, warns in (("", False), ("127.0.0.1", False), ("0.0.0.0", True)):
        with closing(udp_in(host, 0)) as link:
            assert bool(link.warning) is warns and link.counts["bound beyond loopback"] == warns
            assert not warns or "anyone on the network" in link.warning


def test_addresses_that_cannot_be_are_refused_by_name() -> None:
    with pytest.raises(LinkError, match=r"udpin:192\.0\.2\.1:0: .* is not an address of this machine"):
        udp_in("192.0.2.1", 0)
    with pytest.raises(LinkError, match=r"host 'no such host' is not known"):
        udp_out("no such host", 14550)
    with pytest.raises(ValueError, match="tick_s"):
        udp_in("", 0, tick_s=0.0)


def test_ipv6_peers_have_routes_in_brackets() -> None:
    try:
        link = udp_in("::1", 0)
    except LinkError as error:
        pytest.skip(f"no IPv6 here: {error}")
    with closing(link), closing(udp_out("::1", link.port)) as other:
        other.send(b"six")
        assert some(link, 1)[0][1:] == (b"six", f"udp:[::1]:{other.port}")
        link.send(b"back")
        assert some(other, 1)[0][1:] == (b"back", f"udp:[::1]:{link.port}")


def test_closing_from_a_signal_handler_ends_the_packets() -> None:
    link = udp_in("", 0, tick_s=120.0)  # the signal comes in the middle of the wait
    before = signal.signal(signal.SIGALRM, lambda *_: link.close())
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.05)
        began = time.monotonic()
        assert list(link.packets()) == []
        assert time.monotonic() - began < 60.0
    finally:
        signal.signal(signal.SIGALRM, before)
    link.close()
    link.send(b"x")
    assert list(link.packets()) == [] and link.counts["not sent"] == 1


def test_a_burst_of_a_second_is_taken_whole(peers: list[socket.socket]) -> None:
    """400 messages of 60 bytes wait at once, as after a pause; all come, in order."""
    with closing(udp_in("", 0)) as link:
        for i in range(400):
            peers[0].sendto(i.to_bytes(60, "big"), ("127.0.0.1", link.port))
        assert [int.from_bytes(p.data, "big") for p in some(link, 400)] == list(range(400))
