"""UDP on our own sockets: one datagram is one packet, one peer is one route.

mavutil's udpin is not used: with SO_REUSEADDR two programs bind one port without an error and the last gets
everything, and it answers every address it ever saw (ecosystem survey, section 2).
"""

from __future__ import annotations

import select
import socket
import time
from collections import Counter
from collections.abc import Callable, Iterator

from magmav.link import LinkError, Packet
from magmav.link.addresses import Address, bracketed, is_loopback, resolve_udp, udp_route, why_not_bound

_BIGGEST = 65_535
_RECEIVE_BUFFER = 4 << 20  # asked for; the kernel gives what it may. A busy second must fit
_WIDE = "open to other machines: anyone on the network can claim to be the vehicle (127.0.0.1 is safe)"


class UdpLink:
    """A UDP socket. Open one with udp_in (many peers) or udp_out (one peer, fixed).

    port : the bound port.  warning : text when others than this machine can reach it, else "".
    Peers are forgotten after forget_s of silence; beyond most_peers new ones are not heard.
    Sending is never an error: what fails is counted.
    counts : "received", "sent", "not sent" (no such peer), "send errors", "receive errors",
    "empty datagrams", "too many peers", "wrong source", "peers forgotten", "bound beyond loopback".
    """

    datagrams = True

    def __init__(
        self,
        name: str,
        sock: socket.socket,
        *,
        peer: Address | None,
        tick_s: float,
        clock_ns: Callable[[], int],
        most_peers: int,
        forget_s: float,
    ) -> None:
        if not tick_s > 0:
            sock.close()
            raise ValueError(f"tick_s: want a positive time, got {tick_s!r}")
        self.name = name
        self.counts: Counter[str] = Counter()
        self.unix_offset_ns = time.time_ns() - clock_ns()
        bound = sock.getsockname()
        self.port: int = bound[1]
        self.warning = "" if peer is not None or is_loopback(bound[0]) else f"{name}: {_WIDE}"
        if self.warning:
            self.counts["bound beyond loopback"] += 1
        self._sock = sock
        self._clock_ns = clock_ns
        self._tick_ms = tick_s * 1000
        self._most_peers = most_peers
        self._forget_ns = round(forget_s * 1e9)
        self._fixed = peer is not None
        self._route: dict[Address, str] = {} if peer is None else {peer: udp_route(peer)}
        self._heard_ns: dict[Address, int] = {}
        self._closed = False
        sock.setblocking(False)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)

    @property
    def routes(self) -> tuple[str, ...]:
        """Whom send() with an empty route reaches."""
        return tuple(self._route.values())

    def fileno(self) -> int:
        """Readable when a datagram waits; -1 when closed."""
        return self._sock.fileno()

    def packets(self) -> Iterator[Packet]:
        """Packets, and a quiet tick when nothing came for tick_s."""
        if self._closed:
            return
        receive, clock_ns, route_of = self._sock.recvfrom, self._clock_ns, self._route.get
        waiting = select.poll()
        waiting.register(self._sock, select.POLLIN)
        while not self._closed:
            try:
                data, address = receive(_BIGGEST)
            except BlockingIOError:
                if not waiting.poll(self._tick_ms) and not self._closed:
                    now_ns = clock_ns()
                    self._forget(now_ns)
                    yield Packet(now_ns, b"", "")
                continue
            except OSError:
                if self._closed:
                    return
                self.counts["receive errors"] += 1
                yield Packet(clock_ns(), b"", "")
                continue
            now_ns = clock_ns()
            route = route_of(address) or self._greet(address, now_ns)
            if route:
                self._heard_ns[address] = now_ns
                self.counts["received" if data else "empty datagrams"] += 1
            # What is not wanted still makes a tick: a flood of it must not stop the reader's time.
            yield Packet(now_ns, data, route) if data and route else Packet(now_ns, b"", "")

    def send(self, data: bytes, route: str = "") -> None:
        """One datagram to one route, or to each live peer."""
        self._forget(self._clock_ns())
        peers = [address for address, known in self._route.items() if route in ("", known)]
        if not data or self._closed or not peers:
            self.counts["not sent"] += 1
            return
        for address in peers:
            try:
                self._sock.sendto(data, address)
                self.counts["sent"] += 1
            except OSError:
                self.counts["send errors"] += 1

    def close(self) -> None:
        """Close the socket; the packets end within a tick."""
        self._closed = True
        self._sock.close()

    def _greet(self, address: Address, now_ns: int) -> str:
        """The route of a new peer, or "" when it is not wanted."""
        if len(self._route) >= self._most_peers:
            self._forget(now_ns)
        if len(self._route) >= self._most_peers:
            self.counts["wrong source" if self._fixed else "too many peers"] += 1
            return ""
        return self._route.setdefault(address, udp_route(address))

    def _forget(self, now_ns: int) -> None:
        """Drop peers that have been silent for too long; never the configured one."""
        if self._fixed:
            return
        for address in [a for a, heard in self._heard_ns.items() if now_ns - heard > self._forget_ns]:
            del self._heard_ns[address], self._route[address]
            self.counts["peers forgotten"] += 1


def udp_in(
    host: str,
    port: int,
    *,
    tick_s: float = 0.05,
    clock_ns: Callable[[], int] = time.monotonic_ns,
    most_peers: int = 16,
    forget_s: float = 30.0,
) -> UdpLink:
    """Listen on host (empty: 127.0.0.1) and port (0: any free one). LinkError when it cannot be had."""
    host = host or "127.0.0.1"
    name = f"udpin:{bracketed(host)}:{port}"
    family, address = resolve_udp(name, host, port)
    sock = socket.socket(family, socket.SOCK_DGRAM)
    try:
        sock.bind(address)
    except OSError as error:
        sock.close()
        raise LinkError(f"{name}: {why_not_bound(error, host, port)}") from error
    return UdpLink(name, sock, peer=None, tick_s=tick_s, clock_ns=clock_ns, most_peers=most_peers, forget_s=forget_s)


def udp_out(host: str, port: int, *, tick_s: float = 0.05, clock_ns: Callable[[], int] = time.monotonic_ns) -> UdpLink:
    """Talk to one peer, hear only it. LinkError when there is no way to it; that nobody listens is no error.

    The socket stays unconnected, so that it survives a change of our own address (a radio that comes back).
    """
    name = f"udpout:{bracketed(host)}:{port}"
    family, address = resolve_udp(name, host, port)
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(address)
        except OSError as error:
            raise LinkError(f"{name}: no way to {host}: {error.strerror}; check address and network") from error
    sock = socket.socket(family, socket.SOCK_DGRAM)
    nowhere = "::" if family == socket.AF_INET6 else "0.0.0.0"
    sock.bind((str(address[0]) if is_loopback(str(address[0])) else nowhere, 0))
    return UdpLink(name, sock, peer=address, tick_s=tick_s, clock_ns=clock_ns, most_peers=1, forget_s=0.0)
