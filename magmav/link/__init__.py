"""Bytes in and out, and the only place with a clock.

A link yields packets for as long as it lives, and a quiet tick (empty bytes) when nothing came, so that
whoever turns the crank always knows what time it is. Nobody else may ask. Sources are peers: live sockets,
recorded files and the in-memory pair keep the same contract, and damage is a wrapper around any of them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple, Protocol


class Packet(NamedTuple):
    """Bytes as they arrived. An empty ``data`` is a quiet tick: only the time is news."""

    t_ns: int
    data: bytes
    route: str  # who sent it, e.g. "udp:127.0.0.1:14550"; "" on a quiet tick


class LinkError(Exception):
    """A link that cannot be opened or read; the text names the link, the cause and what to do."""


class Link(Protocol):
    """What every link offers."""

    name: str
    datagrams: bool  # whole frames per packet: a parser forgets everything between packets
    unix_offset_ns: int  # t_ns + unix_offset_ns is UNIX time
    counts: Counter[str]

    def packets(self) -> Iterator[Packet]:
        """Yield packets until closed or, for a file, until its end."""
        ...

    def send(self, data: bytes, route: str = "") -> None:
        """Send to one route, or to every peer heard from (and the configured one) when route is empty."""
        ...

    def close(self) -> None:
        """Stop; the iterator of packets ends. Safe to call twice and from a signal handler."""
        ...


def whole_frames(link: Link, route: str) -> bool:
    """Whether packets of this route hold whole frames; several links in one may differ."""
    told: bool = link.whole(route) if hasattr(link, "whole") else link.datagrams
    return told


def routes_of(link: Link) -> tuple[str, ...]:
    """Whom send() with an empty route reaches, where a link can tell; empty where there is but one other end."""
    told: tuple[str, ...] = getattr(link, "routes", ())
    return told
