"""What was known along the way: a row every so many seconds of each compass's boot time."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from magmav.core.types import AttitudeReading, Reading, Record

Result = dict[str, Any]


class Timeline:
    """What was known every so many seconds of each compass's boot time, with the error against ATTITUDE yaw."""

    def __init__(self, every_s: float) -> None:
        self._every_ns = every_s * 1e9
        self._next: dict[tuple[int, int], float] = {}
        self._yaw: dict[int, float] = {}
        self.rows: list[Result] = []

    def __call__(self, reading: Reading, record: Record | None) -> None:
        """Watch one reading."""
        if isinstance(reading, AttitudeReading):
            self._yaw[reading.system] = reading.yaw_rad
        if record is None:
            return
        key = (record.system, record.compass)
        if record.boot_ns < self._next.get(key, -math.inf) - 2 * self._every_ns:
            self._next[key] = -math.inf  # the vehicle rebooted
        if record.boot_ns >= self._next.get(key, -math.inf):
            self._next[key] = record.boot_ns + self._every_ns
            self.rows.append(self._row(record))

    def _row(self, r: Record) -> Result:
        known = r.estimate.samples > 0
        offsets = [round(float(v), 1) for v in r.offsets_mg]
        yaw = self._yaw.get(r.system)
        error = None
        if yaw is not None and r.heading.true_valid:
            error = round(math.degrees(math.remainder(r.heading.true_rad - yaw, math.tau)), 2)
        return {
            "boot_s": round(r.boot_ns / 1e9, 3),
            "system": r.system,
            "compass": r.compass,
            "offsets_mg": offsets if known and not r.relative else None,
            "offsets_change_mg": offsets if known and r.relative else None,
            "sigma_mg": [round(float(v), 1) for v in r.sigma_mg] if known else None,
            "axes": [a.value for a in r.verdict.axes],
            "state": r.verdict.state.name,
            "reasons": [x.name for x in r.verdict.reasons],
            "heading_error_deg": error,
            "learnt": r.learnt,
        }

    def lines(self) -> Iterator[str]:
        """The rows for people."""
        yield "boot s     compass  offsets x y z mG (+- sigma)                              state     heading error deg"
        for r in self.rows:
            numbers = r["offsets_mg"] or r["offsets_change_mg"]
            if numbers is None:
                offsets = "not known"
            else:
                pairs = zip(numbers, r["sigma_mg"], strict=True)
                offsets = "  ".join(f"{o:7.1f} +-{s:5.1f}" for o, s in pairs)
                offsets += " (change)" if r["offsets_mg"] is None else ""
            error = "not known" if r["heading_error_deg"] is None else f"{r['heading_error_deg']:+.1f}"
            yield f"{r['boot_s']:9.1f}  {r['compass']:^7}  {offsets:<57}  {r['state']:<9} {error}"
