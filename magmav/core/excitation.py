"""How much of what could be seen has been seen: directions of the field in body axes, and headings.

Binned in BODY axes (users.md AT-3b): in earth axes every sample of a good flight falls on one spot and shows nothing.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magmav.core.types import Vec3

_BANDS = (1, 6, 10, 6, 1)  # cells per band from nose-up pole to tail pole: about equal areas
SECTORS = 12
CELLS = sum(_BANDS)
_EDGES = (-0.95, -0.45, 0.45, 0.95)


def sectors_of(heading_rad: NDArray[np.float64]) -> int:
    """Number of 30-degree sectors that these headings, (N,) from 0 to 2 pi, have seen: Excitation's, of many."""
    return len(np.unique(np.minimum(heading_rad / math.tau * SECTORS, SECTORS - 1).astype(np.intp)))


class Excitation:
    """Cells of the field's direction in body axes, and 30-degree sectors of heading, that have been visited."""

    def __init__(self) -> None:
        self._cells: set[tuple[int, int]] = set()
        self._sectors: set[int] = set()

    def see(self, field_b_mg: Vec3, heading_rad: float | None) -> None:
        """Take a corrected field and its heading."""
        x, y, z = field_b_mg.tolist()
        length = math.hypot(x, y, z)
        if length <= 0.0:
            return
        band = sum(z / length > edge for edge in _EDGES)
        around = int((math.atan2(y, x) / math.tau % 1.0) * _BANDS[band])
        self._cells.add((band, min(around, _BANDS[band] - 1)))
        if heading_rad is not None:
            self._sectors.add(min(int(heading_rad / math.tau * SECTORS), SECTORS - 1))

    @property
    def coverage(self) -> float:
        """Share of the sphere of directions seen, 0 to 1. A full level turn fills a ring, not the sphere."""
        return len(self._cells) / CELLS

    @property
    def sectors(self) -> int:
        """Number of 30-degree heading sectors seen, 0 to 12."""
        return len(self._sectors)
