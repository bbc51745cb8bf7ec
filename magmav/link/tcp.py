"""A TCP client: the simulator's port, a telemetry bridge."""

from __future__ import annotations

import errno
import os
import socket
from collections.abc import Callable

from magmav.link import LinkError
from magmav.link.addresses import bracketed, not_known
from magmav.link.stream import Port, StreamLink

_SEND_BUFFER = 8192  # small, so that what does not get through shows soon instead of going out stale


class TcpPort:
    """One connection."""

    def __init__(self, sock: socket.socket) -> None:
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        # A cable that was pulled says nothing: ask after 5 s of silence, give up after 3 questions or 10 s.
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in (
            ("TCP_KEEPIDLE", 5),
            ("TCP_KEEPINTVL", 2),
            ("TCP_KEEPCNT", 3),
            ("TCP_USER_TIMEOUT", 10_000),
        ):
            if hasattr(socket, option):  # not on every operating system
                sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
        self._sock = sock
        self.fd = sock.fileno()

    def opened(self) -> bool:
        """True once connected; OSError when that has failed."""
        code = self._sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if code:
            raise OSError(code, os.strerror(code))
        if self._sock.getsockname() == self._sock.getpeername():
            # On loopback a client that tries a free port of the ephemeral range may one day meet itself.
            raise ConnectionRefusedError(errno.ECONNREFUSED, "connected to itself")
        return True

    def read(self) -> bytes:
        """What waits; ConnectionResetError when the other end has closed."""
        try:
            data = self._sock.recv(65_536)
        except BlockingIOError:
            return b""
        if not data:
            raise ConnectionResetError(errno.ECONNRESET, "closed by the other end")
        return data

    def write(self, data: bytes, /) -> int:
        return self._sock.send(data)

    def close(self) -> None:
        self.fd = -1
        self._sock.close()


def tcp(
    host: str,
    port: int,
    *,
    connect_s: float = 5.0,
    tick_s: float = 0.05,
    retry_s: float = 0.5,
    longest_retry_s: float = 10.0,
) -> StreamLink:
    """Connect to host:port. LinkError when the first connection fails; later losses are reopened.

    The name is looked up once, at the start: looking it up again could stop the reader for half a minute.
    """
    name = f"tcp:{bracketed(host)}:{port}"
    try:
        first = socket.create_connection((host, port), connect_s)
    except (OSError, UnicodeError) as error:
        raise LinkError(f"{name}: {_why_not(error, host, port)}") from error
    try:
        again = _again(first.family, first.getpeername())
        opened = TcpPort(first)
        opened.opened()
    except OSError as error:
        first.close()
        raise LinkError(f"{name}: {_why_not(error, host, port)}") from error
    return StreamLink(name, opened, again, tick_s=tick_s, retry_s=retry_s, longest_retry_s=longest_retry_s)


def _again(family: int, address: tuple[str | int, ...]) -> Callable[[], Port]:
    def connect() -> Port:
        sock = socket.socket(family, socket.SOCK_STREAM)
        try:
            port = TcpPort(sock)
            code = sock.connect_ex(address)
            if code not in (0, errno.EINPROGRESS):
                raise OSError(code, os.strerror(code))
        except OSError:
            sock.close()
            raise
        return port

    return connect


def _why_not(error: OSError | UnicodeError, host: str, port: int) -> str:
    if isinstance(error, ConnectionRefusedError):
        return f"connection refused; is a program listening on port {port} of {host}?"
    if isinstance(error, socket.gaierror | UnicodeError):
        return not_known(host)
    if isinstance(error, TimeoutError):
        return f"no answer from {host}; check address, network and firewall"
    return f"cannot connect: {error.strerror or error}; check address and network"
