"""After the flight: the iron of every second with all of the flight known, by core.smoother.

What was turned by hand before the flight is another flight to the estimator, and is left out where anything flew.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magmav.core.estimators.adaptive.layout import Array
from magmav.core.estimators.adaptive.tuning import Tuning
from magmav.core.smoother import Smoothed, smooth
from magmav.core.stretch import flown, framed
from magmav.core.types import Estimate, Sample

_EVERY_NS = 1_000_000_000
_MOMENTS = 400  # at most about so many: between them the iron is a straight line


@dataclass(frozen=True, slots=True, eq=False)
class AfterFlight:
    """What is known of the iron of every moment with the whole flight known.

    boot_ns : (N,) increasing, a second apart, or a 400th of the flight.  estimates : N of them; their hard
    iron is at the same throttle as the estimator's own.  changes_ns : the iron changed suddenly right after these.
    """

    boot_ns: NDArray[np.int64]
    estimates: tuple[Estimate, ...]
    changes_ns: tuple[int, ...]
    foretold: Estimate | None = None  # by the time asked for, with nothing of what the compass said after it

    @property
    def answer(self) -> Estimate:
        """Of the flight as a whole: the iron at its end, which is what the vehicle carries on.

        Where the iron stayed, every moment says the same to its sigma; where it moved, the end is what counts.
        """
        return self.estimates[-1]

    def iron_b_mg(self, boot_ns: NDArray[np.int64]) -> Array:
        """Hard iron at these times, (M,), as (M, 3) mG: between two moments in proportion, across a change not."""
        out = np.empty((len(boot_ns), 3))
        iron = np.array([e.hard_iron_b_mg for e in self.estimates])
        edges = np.array(self.changes_ns, dtype=np.int64)
        part_of = np.searchsorted(edges, self.boot_ns), np.searchsorted(edges, boot_ns)
        for part in np.unique(part_of[1]):
            mine, wanted = part_of[0] == part, part_of[1] == part
            for axis in range(3):
                out[wanted, axis] = np.interp(boot_ns[wanted], self.boot_ns[mine], iron[mine, axis])
        return out

    def iron_of(self, samples: Sequence[Sample]) -> Array:
        """Hard iron at the moment each of them was measured, (M, 3) mG."""
        return self.iron_b_mg(np.array([s.boot_ns - round(1e9 * s.age_s) for s in samples], dtype=np.int64))


def after_flight(
    samples: Sequence[Sample], tuning: Tuning | None = None, until_ns: int | None = None
) -> AfterFlight | None:
    """The iron along one stretch of one compass; None where nothing is known of it.

    samples : as the estimator was given them, in order of time; of one boot, undone with one set of stored values.
    until_ns : boot time of ``foretold``.
    """
    stretch = framed(flown(samples))
    whole = smooth(stretch, tuning)
    if whole is None:
        return None
    times = whole.boot_ns
    known = [(int(times[i]), e) for i in _moments(whole) if (e := whole.estimate(i)) is not None]
    if not known:
        return None
    foretold = None
    if until_ns is not None:
        first = whole.first(int(np.searchsorted(times, until_ns, side="right")))
        foretold = None if first is None else first.estimate(len(first.nodes) - 1)
    return AfterFlight(
        np.array([t for t, _ in known], dtype=np.int64),
        tuple(e for _, e in known),
        tuple(int(times[place]) for place in whole.changes),
        foretold,
    )


def _moments(whole: Smoothed) -> list[int]:
    """Nodes: the first of every second, or fewer, evenly; those next to a change; and the last."""
    times = whole.boot_ns
    every_ns = max(_EVERY_NS, int(times[-1] - times[0]) // _MOMENTS)
    turn = (times - times[0]) // every_ns
    wanted = {0, *(np.flatnonzero(np.diff(turn)) + 1).tolist(), len(times) - 1}
    for place in whole.changes:
        wanted |= {place, place + 1}
    return sorted(wanted)
