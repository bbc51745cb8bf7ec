"""What to do next and what is wrong, said in words while the vehicle flies: for `magmav run` and for the wire."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from magmav.core.coach import advise, next_step
from magmav.core.types import Record
from magmav.vehicle import Vehicle

_LOOK_NS = 1_000_000_000
EVERY_NS = 30_000_000_000
_LONGEST = 200  # four chunks of STATUSTEXT

Say = Callable[[str, int], None]
"""Takes a text and the link time."""


def advice_for(record: Record, vehicle: Vehicle | None) -> str:
    """The next step for one compass, at most 50 characters; "" when it is ready and every axis is known."""
    kind = None if vehicle is None else vehicle.phase.kind
    limit_mg = 10.0 if vehicle is None else vehicle.settings.gate.axis_sigma_mg
    heading = record.heading.magnetic_rad if record.heading.valid else None
    verdict = record.verdict
    advice = advise(record.estimate, record.roll_rad, record.pitch_rad, heading, kind, limit_mg, verdict.reasons)
    return next_step(verdict, advice)


class Coaching:
    """Says per compass the next step, at most every 30 s, and each cause once, when it is first found."""

    def __init__(self, vehicles: Mapping[int, Vehicle], say: Say) -> None:
        self._vehicles = vehicles
        self._say = say
        self._looked_ns: dict[tuple[int, int], int] = {}
        self._said_ns: dict[tuple[int, int], int] = {}
        self._told: set[tuple[int, int, str]] = set()

    def on_record(self, r: Record) -> None:
        """Look at one compass; at most once a second anything is thought about."""
        key = (r.system, r.compass)
        if r.t_ns - self._looked_ns.get(key, -_LOOK_NS) < _LOOK_NS:
            return
        self._looked_ns[key] = r.t_ns
        vehicle = self._vehicles.get(r.system)
        for cause in () if vehicle is None else vehicle.causes.latest(r.compass):
            if (*key, cause.code) not in self._told:
                self._told.add((*key, cause.code))
                self._say(f"c{r.compass}: {cause.text}"[:_LONGEST], r.t_ns)
        if r.t_ns - self._said_ns.get(key, -EVERY_NS) < EVERY_NS:
            return
        text = advice_for(r, vehicle)
        if text:
            self._said_ns[key] = r.t_ns
            self._say(f"c{r.compass}: {text}", r.t_ns)
