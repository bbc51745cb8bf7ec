"""One of our own parameters: how it is read and written, and what a person should know of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class About:
    """What a person should know of a parameter; ``values``: (number, what it stands for)."""

    text: str = ""
    unit: str = ""
    low: float | None = None
    high: float | None = None
    default: float | None = None
    values: tuple[tuple[float, str], ...] = ()


@dataclass(frozen=True, slots=True)
class Entry:
    """One parameter. ``set(value, now_ns)`` says whether it took the value; None means read-only.

    trigger : writing starts something. Only a SET to exactly our component counts; it is echoed as written.
    pinned : a SET counts only over the route the latched autopilot is on (design, rule 11). Every trigger is.
    """

    name: str
    get: Callable[[], float]
    set: Callable[[float, int], bool] | None = None
    trigger: bool = False
    pinned: bool = False
    about: About = About()
