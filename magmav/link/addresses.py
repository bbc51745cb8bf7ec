"""Internet addresses as text, and why one cannot be used."""

from __future__ import annotations

import errno
import ipaddress
import socket

from magmav.link import LinkError

Address = tuple[str | int, ...]
"""As the operating system gives it: (ip, port) or (ip, port, flow, scope)."""


def resolve_udp(name: str, host: str, port: int) -> tuple[int, Address]:
    """Address family and address; LinkError beginning with ``name`` when the host is not known."""
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
    except (OSError, UnicodeError) as error:
        raise LinkError(f"{name}: {not_known(host)}") from error
    # "localhost" may name ::1 first, where no autopilot and no simulator talks.
    family, _, _, _, address = min(found, key=lambda entry: entry[0] != socket.AF_INET)
    return family, tuple(part for part in address if isinstance(part, str | int))


def not_known(host: str) -> str:
    return f"host {host!r} is not known; give an IP address or check the name"


def why_not_bound(error: OSError, host: str, port: int) -> str:
    """The cause in plain words, and what to do."""
    if error.errno == errno.EADDRINUSE:
        return f"port {port} is taken by another program; stop that program or choose another port"
    if error.errno == errno.EADDRNOTAVAIL:
        return f"{host} is not an address of this machine; use 127.0.0.1, or 0.0.0.0 to listen everywhere"
    if error.errno in (errno.EACCES, errno.EPERM):
        return f"port {port} is reserved; choose one above 1023"
    return f"cannot listen: {error.strerror}; choose another address"


def is_loopback(ip: str) -> bool:
    return ipaddress.ip_address(ip.partition("%")[0]).is_loopback


def bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def udp_route(address: Address) -> str:
    return f"udp:{bracketed(str(address[0]))}:{address[1]}"
