"""Did the corrected field really move as the new offsets promise? (S11)

An autopilot that echoes a value need not use it. What the stream says before and after is compared with the
prediction, as far as the scatter of the readings allows.
"""

from __future__ import annotations

import math

from magmav.mavlink.codec import Message

ENOUGH = 10
WINDOW_NS = 2_000_000_000
FLOOR_MG = 4.0  # whole mG cut toward zero on both sides, and the vehicle never stands perfectly still
SHARE = 0.05
_QUANTUM_MG = 0.6  # scatter of a whole number that never changes
_FEW, _FEW_SCATTER_MG = 5, 2.0  # fewer values than this do not show their own scatter


class Window:
    """Distinct corrected readings of one compass since ``since_ns``: mean and standard error, mG, body axes.

    ArduPilot repeats a value when asked faster than 10 Hz, so a triple equal to the one before is not news.
    All zeros is how it says that there is no compass. streams : messages that carry it; the first seen counts.
    """

    def __init__(self, streams: tuple[str, ...], since_ns: int) -> None:
        self.since_ns = since_ns
        self._sources = streams
        self._values: list[tuple[int, int, int]] = []

    def add(self, message: Message) -> None:
        """Take the reading if it is one of this compass, and new."""
        kind = message.get_type()
        if kind not in self._sources:
            return
        value = message.xmag, message.ymag, message.zmag
        if not any(value) or (self._values and self._values[-1] == value):
            return
        self._sources = (kind,)
        self._values.append(value)

    def __len__(self) -> int:
        return len(self._values)

    def ready(self, now_ns: int) -> bool:
        """Ten values, or two seconds with at least one."""
        return len(self) >= ENOUGH or (len(self) > 0 and now_ns - self.since_ns >= WINDOW_NS)

    @property
    def mean_mg(self) -> tuple[float, ...]:
        """Per axis; call it on a window with values only."""
        return tuple(math.fsum(axis) / len(self) for axis in zip(*self._values, strict=True))

    @property
    def error_mg(self) -> tuple[float, ...]:
        """Standard error of the mean per axis."""
        n = len(self)
        floor = _QUANTUM_MG if n >= _FEW else _FEW_SCATTER_MG
        out = []
        for axis, mean in zip(zip(*self._values, strict=True), self.mean_mg, strict=True):
            spread = math.sqrt(math.fsum((x - mean) ** 2 for x in axis) / max(n - 1, 1))
            out.append(max(spread, floor) / math.sqrt(n))
        return tuple(out)


def moved_as_predicted(before: Window, after: Window, shift_b_mg: tuple[float, float, float]) -> bool:
    """True when every axis moved by its shift, within 4 mG, 5 % of the shift's length and 3 standard errors;

    and when the whole movement is nearer to the shift than to no movement at all, where the shift is large
    enough to tell. How sure the estimate is does not enter: what the stream does with given offsets is
    certain.
    """
    moved = [b - a for a, b in zip(before.mean_mg, after.mean_mg, strict=True)]
    length = math.hypot(*shift_b_mg)
    errors = [math.hypot(a, b) for a, b in zip(before.error_mg, after.error_mg, strict=True)]
    missed = [m - s for m, s in zip(moved, shift_b_mg, strict=True)]
    near = all(abs(x) <= FLOOR_MG + SHARE * length + 3.0 * e for x, e in zip(missed, errors, strict=True))
    return near and (length < FLOOR_MG or math.hypot(*missed) < math.hypot(*moved))
