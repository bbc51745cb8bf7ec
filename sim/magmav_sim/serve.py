"""The vehicle on a real link, at the link's time or as fast as somebody on the other end can follow."""

from __future__ import annotations

from collections.abc import Callable

from magmav.link import Link
from magmav_sim.truth import TruthLog
from magmav_sim.vehicle import Simulation

_TICK_NS = 20_000_000
_MOST_AT_ONCE_NS = 500_000_000  # then the link is read again
_PING_EVERY_NS = 200_000_000
_WINDOW_NS = 400_000_000  # how far ahead of the last answered ping
_PATIENCE_NS = 1_000_000_000
_DATAGRAM = 1200


class Pacer:
    """How far simulated time may go. The link's time is an argument; all times in ns.

    speed : simulated seconds per second, or None: a PING goes out every 0.2 s of simulated time and the
    vehicle stays within 0.4 s of the last one answered. Where nobody answers for a second, real time goes on.
    """

    def __init__(self, speed: float | None) -> None:
        if speed is not None and not speed > 0:
            raise ValueError(f"speed: want a positive number or None, got {speed}")
        self._speed = speed
        self._start_ns: int | None = None
        self._pong = -1
        self._answered_at_ns = 0
        self._slow_from: tuple[int, int] | None = None

    def limit_ns(self, now_ns: int, elapsed_ns: int, pong: int) -> int:
        """Simulated time that may be reached now; ``pong`` is the last ping answered."""
        if self._start_ns is None:
            self._start_ns = self._answered_at_ns = now_ns
        if self._speed is not None:
            return int((now_ns - self._start_ns) * self._speed)
        pong = min(pong, elapsed_ns // _PING_EVERY_NS)  # nobody answers what was not asked
        if pong > self._pong:
            self._pong, self._answered_at_ns, self._slow_from = pong, now_ns, None
        limit = self._pong * _PING_EVERY_NS + _WINDOW_NS
        if now_ns - self._answered_at_ns >= _PATIENCE_NS:
            if self._slow_from is None:
                self._slow_from = now_ns, elapsed_ns
            limit = max(limit, self._slow_from[1] + now_ns - self._slow_from[0])
        return limit

    def ping_due(self, elapsed_ns: int) -> int | None:
        """Sequence number of the ping for this simulated time, where there is one."""
        if self._speed is not None or elapsed_ns % _PING_EVERY_NS:
            return None
        return elapsed_ns // _PING_EVERY_NS


def serve(
    link: Link,
    simulation: Simulation,
    speed: float | None = 1.0,
    truth: TruthLog | None = None,
    stop: Callable[[], bool] = lambda: False,
    second: Link | None = None,
) -> None:
    """Fly until the scenario ends, the link does, or ``stop`` says so. The link's quiet ticks are the
    clock. ``second``: another link to the same place, for what comes over a second route; it is only sent to."""
    pacer = Pacer(speed)
    for packet in link.packets():
        if packet.data:
            simulation.receive(packet.data, whole=link.datagrams)
        limit_ns = pacer.limit_ns(packet.t_ns, simulation.elapsed_ns, simulation.pong)
        limit_ns = min(limit_ns, simulation.elapsed_ns + _MOST_AT_ONCE_NS)
        while simulation.elapsed_ns + _TICK_NS <= limit_ns and not simulation.finished:
            frames = simulation.advance(_TICK_NS / 1e9)
            due = pacer.ping_due(simulation.elapsed_ns)
            if due is not None:
                frames.append(simulation.ping(due))
            for datagram in packed(frames):
                link.send(datagram)
            for datagram in packed(simulation.second_route()):
                if second is not None:
                    second.send(datagram)
            if truth is not None:
                truth.sample()
        if simulation.finished or stop():
            return


def packed(frames: list[bytes]) -> list[bytes]:
    """Frames joined into datagrams of at most 1200 bytes, in order, none cut."""
    out: list[bytes] = []
    for frame in frames:
        if out and len(out[-1]) + len(frame) <= _DATAGRAM:
            out[-1] += frame
        else:
            out.append(frame)
    return out
