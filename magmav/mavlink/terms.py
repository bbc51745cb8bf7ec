"""The words of the upload: its phases, its limits and waits, and the record it wants kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from magmav.core.types import Change, Reason, UploadResult
from magmav.mavlink.change import CONFIRM_ABOVE_MG

_MS = 1_000_000


class Journal(Protocol):
    """Where a change is on record before its first write. Store is one."""

    def begin(self, change: Change, unix_ns: int, undoes: int | None = None, vehicle: str = "") -> int:
        """Durable when it returns. BlockingIOError: another write is running; OSError: cannot be recorded."""
        ...

    def finish(self, row: int, result: UploadResult, reasons: Sequence[Reason]) -> None:
        """How it ended. OSError: cannot be recorded."""
        ...


@dataclass(frozen=True, slots=True)
class UploadSettings:
    """Limits and waits. offs_max_mg tightens COMPASS_OFFS_MAX of the vehicle; None leaves it as it is.

    Tries and lingering allow for an answer that takes 4 s, as over a link with 2 s of latency each way.
    """

    offs_max_mg: float | None = None
    confirm_above_mg: float = CONFIRM_ABOVE_MG
    heartbeat_age_ns: int = 1200 * _MS
    first_write_age_ns: int = 500 * _MS
    retry_ns: int = 500 * _MS
    preflight_ns: int = 10_000 * _MS
    watch_ns: int = 2500 * _MS  # long enough for two heartbeats of a second route
    baseline_ns: int = 8000 * _MS
    write_tries: int = 12
    read_tries: int = 24
    rounds: int = 3
    settle_ns: int = 500 * _MS
    proof_ns: int = 6000 * _MS
    linger_ns: int = 4500 * _MS  # a delayed copy of an earlier write, and its echo, have arrived by then
    seen_out_ns: int = 5000 * _MS  # heard so late, a heartbeat left the vehicle after the last write had landed
    silent_ns: int = 5000 * _MS  # nothing at all from the autopilot
    heartbeat_lost_ns: int = 10_000 * _MS
    whole_ns: int = 180_000 * _MS


class Phase(Enum):
    """Where the transaction is; the text is for people."""

    IDLE = "not started"
    PREFLIGHT = "checking the vehicle"
    BASELINE = "measuring the field before"
    WRITE = "writing"
    LINGER = "waiting for late packets"
    READ_BACK = "reading back"
    SETTLE = "letting the compass settle"
    PROOF = "checking that the field moved as predicted"
    SEEN_OUT = "waiting for a heartbeat after the last write"
    ARMING = "asking the autopilot whether it would arm"
    DONE = "done"
