"""The allow-list's mechanism: a change is offsets of one compass, or it is nothing (S5, S9)."""

from __future__ import annotations

import re
from dataclasses import replace

from magmav.core.types import Change
from magmav.mavlink.float32 import float32

COMPASSES = (1, 2, 3)


def allowed(change: Change, offset: re.Pattern[str], device: re.Pattern[str]) -> Change:
    """The same change in exact 32-bit floats. ValueError names what may not be written or does not fit.

    offset, device : what a whole name must match; the first two groups say whose it is.
    """
    sizes = {len(change.names), len(change.old), len(change.new), len(change.step_mg)}
    if sizes - {1, 2, 3} or len(sizes) != 1:
        raise ValueError("change: names, old, new and step_mg want the same length, 1 to 3")
    if len(set(change.names)) != len(change.names):
        raise ValueError(f"change: a name is there twice in {change.names!r}")
    if change.compass not in COMPASSES:
        raise ValueError(f"change: compass wants 1, 2 or 3, got {change.compass!r}")
    found = [offset.fullmatch(name) for name in change.names]
    for name, match in zip(change.names, found, strict=True):
        if match is None:
            raise ValueError(f"change: {name!r} is not a compass offset, and nothing else is ever written")
    owner = device.fullmatch(change.device_name)
    if owner is None or {_whose(match) for match in found} != {_whose(owner)}:
        raise ValueError(f"change: {change.names!r} and {change.device_name!r} are not of one compass")
    return replace(change, old=tuple(map(float32, change.old)), new=tuple(map(float32, change.new)))


def _whose(match: re.Match[str] | None) -> tuple[str | None, ...]:
    """Number and scheme in a name."""
    return () if match is None else match.groups()[:2]
