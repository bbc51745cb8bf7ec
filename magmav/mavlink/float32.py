"""Parameters are 32-bit floats on the wire, so that is how they are compared."""

from __future__ import annotations

import math
import struct

_FLOAT = struct.Struct("<f")


def float32(value: float) -> float:
    """The nearest 32-bit float, widened again. Too large becomes infinite with its sign, NaN stays NaN."""
    try:
        return float(_FLOAT.unpack(_FLOAT.pack(value))[0])
    except OverflowError:
        return math.copysign(math.inf, value)


def same(one: float, other: float) -> bool:
    """Equal once both are 32-bit floats. NaN equals nothing, not even itself."""
    return float32(one) == float32(other)
