"""A change of offsets before anything is sent: whose it is, the code, the dry run, what forbids it, the undo.

Offsets are the one thing ever written (S5, S9): no scale, matrix, motor term, orientation, use, priority, device id or
learning mode. What the names and units are is the autopilot's adapter's to know.
"""

from __future__ import annotations

import hashlib
import math
import struct
from collections.abc import Mapping
from functools import lru_cache

from magmav.core.types import Change, Reason
from magmav.mavlink.autopilot.adapter import ADAPTERS, Adapter
from magmav.mavlink.float32 import float32, same

CONFIRM_ABOVE_MG = 150.0


@lru_cache(maxsize=64)  # asked at every turn of a write, of the same change
def adapter_for(change: Change) -> Adapter:
    """The autopilot whose offsets these are. ValueError names what may not be written or does not fit."""
    why: list[ValueError] = []
    for adapter in ADAPTERS.values():
        try:
            adapter.checked(change)
        except ValueError as error:
            why.append(error)
        else:
            return adapter
    # The one that came furthest: a name of its own in the wrong place says more than a name that is unknown.
    raise max(why, key=lambda error: "nothing else is ever written" not in str(error))


def checked(change: Change) -> Change:
    """The same change in exact 32-bit floats. ValueError names what may not be written or does not fit."""
    return adapter_for(change).checked(change)


def largest_step_mg(change: Change) -> float:
    """The largest step on any axis; what the change says of itself is not trusted to be large enough."""
    unit_mg = adapter_for(change).unit_mg
    steps = (unit_mg * abs(n - o) for o, n in zip(change.old, change.new, strict=True))
    return max((*steps, *change.step_mg))


def is_too_small(change: Change) -> bool:
    """The autopilot would not take it up before it restarts."""
    adapter = adapter_for(change)
    steps = (n - o for o, n in zip(change.old, change.new, strict=True))
    return adapter.least_step_mg > 0.0 and adapter.unit_mg * math.hypot(*steps) <= adapter.least_step_mg


def confirmation_code(change: Change) -> int:
    """Four digits that stand for exactly this change, the same in every process. Never 0."""
    values = struct.pack(f"<{2 * len(change.names)}f", *map(float32, (*change.old, *change.new)))
    head = f"{change.system} {change.device_id} {' '.join(change.names)} ".encode()
    return 1000 + int.from_bytes(hashlib.sha256(head + values).digest()[:8], "big") % 9000


def code_needed(change: Change, above_mg: float = CONFIRM_ABOVE_MG) -> int | None:
    """The code that this change wants, or None when it is small enough to go without (S8)."""
    return confirmation_code(change) if largest_step_mg(change) > above_mg else None


def dry_run(change: Change, above_mg: float = CONFIRM_ABOVE_MG, *, undo: bool = False) -> list[str]:
    """Every message the transaction would send, in order, a line each; the code last, if wanted.

    Requests are repeated when unanswered. Where the proof fails, the old values are written back the same
    way. undo : the way back, from a vehicle that holds the new values.
    """
    adapter = adapter_for(change)
    change = adapter.checked(change)
    start, target = (change.new, change.old) if undo else (change.old, change.new)
    lines = [f"PARAM_REQUEST_READ {name}" for name in adapter.reads(change)]
    for name, now, then in zip(change.names, start, target, strict=True):
        if not same(now, then):
            lines.append(f"PARAM_SET {name} {then!r} (now {now!r})")
    lines += [f"PARAM_REQUEST_READ {name}" for name in change.names]
    if adapter.proof_streams(change.compass) and not undo:
        lines.append("COMMAND_LONG MAV_CMD_RUN_PREARM_CHECKS")
    code = None if undo else code_needed(change, above_mg)
    return lines if code is None else [*lines, f"a change above {above_mg:g} mG: confirm with code {code}"]


def beyond_limit(change: Change, stored: Mapping[str, float], most_mg: float) -> bool:
    """Any axis, or the length of the vector with the axes that stay, is over the limit or not finite."""
    adapter = adapter_for(change)
    new = dict(zip(change.names, change.new, strict=True))
    values = tuple(new.get(name, stored.get(name, 0.0)) for name in adapter.triple(change))
    return not all(map(math.isfinite, values)) or not adapter.unit_mg * math.hypot(*values) <= most_mg


def value_refusals(
    change: Change, stored: Mapping[str, float], *, undo: bool, offs_max_mg: float | None
) -> tuple[Reason, ...]:
    """What the freshly read parameters say against it; names not read yet say nothing.

    Before an upload every value must still be the old one; before a restore either the old or our new one,
    which is what a write that was cut short leaves behind.
    """
    adapter = adapter_for(change)
    out = []
    device = stored.get(change.device_name)
    if device is not None and not same(device, change.device_id):
        out.append(Reason.DEVICE_CHANGED)
    if adapter.ambiguous(change, stored):
        out.append(Reason.MAPPING_UNCLEAR)
    for name, old, new in zip(change.names, change.old, change.new, strict=True):
        value = stored.get(name)
        if value is not None and not same(value, old) and not (undo and same(value, new)):
            out.append(Reason.OFFSETS_CHANGED)
            break
    if adapter.second_writer(stored):
        out.append(Reason.SECOND_WRITER)
    limits = [limit for limit in (adapter.most_mg(stored), offs_max_mg) if limit is not None]
    if not undo and beyond_limit(change, stored, min(limits, default=math.inf)):
        out.append(Reason.BEYOND_LIMIT)
    return tuple(out)


def restore_blockers(change: Change, system: int, stored: Mapping[str, float]) -> tuple[Reason, ...]:
    """Why an unfinished change may not be restored without asking; empty: it may, at the next disarm (rule
    10).

    stored : freshly read values by parameter name, the device id's among them.
    """
    out = [] if system == change.system else [Reason.WRONG_VEHICLE]
    if any(name not in stored for name in (*change.names, change.device_name)):
        out.append(Reason.UNKNOWN_PARAM)
    return (*out, *value_refusals(checked(change), stored, undo=True, offs_max_mg=None))
