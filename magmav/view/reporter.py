"""What `magmav run` says while it runs: a line a second per compass as JSON, or for people only what changes."""

from __future__ import annotations

import json
import logging
import math
import sys
from typing import Any

from magmav.core.types import Reading, Record, State

_log = logging.getLogger("magmav")
_EVERY_NS = 1_000_000_000
_PEOPLE_EVERY_NS = 10_000_000_000


class Reporter:
    """Watches records and reports them."""

    def __init__(self, as_json: bool) -> None:
        self._json = as_json
        self._said_ns: dict[tuple[int, int], int] = {}
        self._state: dict[tuple[int, int], State] = {}

    def __call__(self, reading: Reading, record: Record | None) -> None:
        """Take one reading and the Record it led to."""
        if record is None:
            return
        key = (record.system, record.compass)
        changed = self._state.get(key) is not record.verdict.state
        pause = _EVERY_NS if self._json else _PEOPLE_EVERY_NS
        if not changed and record.t_ns - self._said_ns.get(key, -pause) < pause:
            return
        self._state[key], self._said_ns[key] = record.verdict.state, record.t_ns
        if self._json:
            sys.stdout.write(json.dumps(line(record)) + "\n")
            sys.stdout.flush()
        else:
            _log.warning("%s", sentence(record))


def line(r: Record) -> dict[str, Any]:
    """One record as a JSON object. What is not known is None."""
    known = r.estimate.samples > 0
    absolute = known and not r.relative
    h = r.heading
    return {
        "boot_s": round(r.boot_ns / 1e9, 3),
        "system": r.system,
        "compass": r.compass,
        "device_id": r.device_id or None,
        "state": r.verdict.state.name,
        "axes": [a.value for a in r.verdict.axes],
        "reasons": [x.name for x in r.verdict.reasons],
        "offsets_mg": [round(float(v), 2) for v in r.offsets_mg] if absolute else None,
        "sigma_mg": [round(float(v), 2) for v in r.sigma_mg] if known else None,
        "heading_deg": round(math.degrees(h.magnetic_rad), 2) if h.valid else None,
        "heading_true_deg": round(math.degrees(h.true_rad), 2) if h.true_valid else None,
        "heading_sigma_deg": round(math.degrees(h.sigma_rad), 2) if h.valid else None,
    }


def sentence(r: Record) -> str:
    """One record for people."""
    head = f"compass {r.compass} of system {r.system}: {r.verdict.state.name.lower()}"
    if r.estimate.samples > 0:
        pairs = zip("xyz", r.offsets_mg, r.sigma_mg, strict=True)
        what = "change of offsets" if r.relative else "offsets"
        head += f", {what} " + ", ".join(f"{n} {o:.0f} +- {s:.0f}" for n, o, s in pairs) + " mG"
    if r.heading.valid:
        kind, angle = ("true", r.heading.true_rad) if r.heading.true_valid else ("magnetic", r.heading.magnetic_rad)
        head += f", heading {math.degrees(angle):.1f} {kind} +- {math.degrees(r.heading.sigma_rad):.1f} deg"
    why = "; ".join(x.text for x in r.verdict.reasons)
    return f"{head} ({why})" if why else head
