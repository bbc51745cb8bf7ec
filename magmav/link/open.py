"""From the words on the command line to an open link."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from magmav.link import Link, LinkError
from magmav.link.addresses import is_loopback, resolve_udp
from magmav.link.serial import serial
from magmav.link.tcp import tcp
from magmav.link.tlog import TlogLink
from magmav.link.udp import udp_in, udp_out

FORMS = "udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT, serial:DEVICE:BAUD, or the path of a .tlog file"
_BAUD = 57_600
_SCHEMES = ("udpin", "udpout", "tcp", "serial")


def open_link(
    text: str,
    *,
    tick_s: float = 0.05,
    retry_s: float = 0.5,
    longest_retry_s: float = 10.0,
    progress: Callable[[int, int], None] | None = None,
) -> Link:
    """An open link. LinkError naming what is wrong with the text, the other end or the file, and what to do.

    udpin without a host listens on 127.0.0.1; IPv6 addresses stand in brackets; BAUD may be left out (57600).
    tick_s : longest silence without a quiet tick.  retry_s, longest_retry_s : how a lost stream is reopened.
    progress : for a file, see TlogLink.
    """
    scheme, colon, rest = text.partition(":")
    if not colon or scheme not in _SCHEMES:
        if Path(text).suffix.lower() == ".tlog":
            return TlogLink(text, progress)
        raise LinkError(_not_understood(text, scheme if colon else ""))
    if scheme == "serial":
        device, baud = _device(text, rest)
        return serial(device, baud, tick_s=tick_s, retry_s=retry_s, longest_retry_s=longest_retry_s)
    host, port = _host_and_port(text, rest)
    if scheme == "udpin":
        return udp_in(host, port, tick_s=tick_s)
    if not host:
        raise LinkError(f"{text}: the host is missing; write {scheme}:HOST:{port}")
    if port == 0:
        raise LinkError(f"{text}: port 0 cannot be talked to; give the port the other end listens on")
    if scheme == "udpout":
        return udp_out(host, port, tick_s=tick_s)
    return tcp(host, port, tick_s=tick_s, retry_s=retry_s, longest_retry_s=longest_retry_s)


def stays_here(text: str) -> str:
    """The text of a link that reaches nothing but this machine; LinkError for any other (S15). Nothing is opened."""
    scheme, _, rest = text.partition(":")
    if scheme not in _SCHEMES:
        raise LinkError(_not_understood(text, ""))
    if scheme == "serial":
        raise LinkError(f"{text}: a vehicle may be at the other end of a serial device; use 127.0.0.1")
    host, port = _host_and_port(text, rest)
    if host and not is_loopback(str(resolve_udp(text, host, port)[1][0])):
        raise LinkError(f"{text}: reaches beyond this machine, where a vehicle may listen; use 127.0.0.1")
    return text


def _host_and_port(text: str, rest: str) -> tuple[str, int]:
    host, colon, port = rest.rpartition(":")
    if not colon:
        raise LinkError(f"{text}: the port is missing; links are {FORMS}")
    if host.startswith("[") and host.endswith("]"):
        host = host[1:-1]
    elif ":" in host:
        raise LinkError(f"{text}: an IPv6 address wants brackets, as in udpin:[::1]:14550; links are {FORMS}")
    # isdecimal alone would take other scripts' digits.
    if not (port.isascii() and port.isdecimal()) or int(port) > 65_535:
        raise LinkError(f"{text}: {port!r} is not a port (0 to 65535); links are {FORMS}")
    return host, int(port)


def _device(text: str, rest: str) -> tuple[str, int]:
    device, colon, baud = rest.rpartition(":")
    if not colon or Path(rest).exists():  # names under /dev/serial/by-path have colons of their own
        device, baud = rest, str(_BAUD)
    if not device:
        raise LinkError(f"{text}: the device is missing, as in serial:/dev/ttyACM0:{_BAUD}; links are {FORMS}")
    if not (baud.isascii() and baud.isdecimal()) or not 0 < int(baud) < 1 << 31:
        raise LinkError(f"{text}: {baud!r} is not a baud rate; links are {FORMS}")
    return device, int(baud)


def _not_understood(text: str, scheme: str) -> str:
    if text.startswith("/dev/"):
        return f"{text}: a serial device is written serial:{text}:{_BAUD}; links are {FORMS}"
    if scheme.lower() in _SCHEMES:
        return f"{text}: write {scheme.lower()} in small letters; links are {FORMS}"
    what = f"there is no link {scheme!r}" if scheme else "this is no link"
    return f"{text}: {what}; links are {FORMS}"
