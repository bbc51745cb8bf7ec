"""Recordings that hold no MAVLink: ArduPilot DataFlash and PX4 ULog, as readings in boot time.

A recording is read once, front to back; its readings go into the same pipeline as those of a link. What a file says
of a quantity it does not know gives no reading, as in mavlink.decode.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from typing import Protocol

from magmav.core.types import Reading

Progress = Callable[[int, int], None]
"""Called now and then with (done, in all), any unit, and once at the end."""


class LogError(Exception):
    """A recording that cannot be used; the text names the file, what is wrong with it, and what to do."""


class Recording(Protocol):
    """One recorded file.

    heard : how many messages of each kind the file holds.
    unix_offset_ns : takes the times of ``readings`` to UNIX time where the file says so, else 0.
    """

    name: str
    heard: Counter[str]
    unix_offset_ns: int

    @property
    def counts(self) -> Counter[str]:
        """What was left out and why."""
        ...

    def readings(self) -> Iterator[tuple[int, Reading]]:
        """(t_ns, reading) in the order of time; t_ns is the vehicle's boot clock. Once through."""
        ...

    def close(self) -> None:
        """Let go of the file. Safe to call twice."""
        ...
