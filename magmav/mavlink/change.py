"""A change of offsets before anything is sent: what may be written, the code, the dry run, the undo.

ArduPilot only. Offsets are the one thing ever written (S5, S9): no scale, matrix, motor term, orientation,
use, priority, device id or learning mode.
"""

from __future__ import annotations

import hashlib
import math
import re
import struct
from collections.abc import Mapping
from dataclasses import replace

from magmav.core.types import Change, Reason
from magmav.mavlink.float32 import float32, same

CONFIRM_ABOVE_MG = 150.0
LEARN, OFFS_MAX = "COMPASS_LEARN", "COMPASS_OFFS_MAX"
# COMPASS_OFS_X, COMPASS_OFS2_X, COMPASS_OFS3_X, and the other naming scheme's COMPASS1_OFS_X and so on
_OFFSET = re.compile(r"COMPASS(?:_OFS([23]?)|([123])_OFS)_([XYZ])")
_DEVICE = re.compile(r"COMPASS(?:_DEV_ID([23]?)|([123])_DEV_ID)")


def checked(change: Change) -> Change:
    """The same change in exact 32-bit floats. ValueError names what may not be written or does not fit."""
    sizes = {len(change.names), len(change.old), len(change.new), len(change.step_mg)}
    if sizes - {1, 2, 3} or len(sizes) != 1:
        raise ValueError("change: names, old, new and step_mg want the same length, 1 to 3")
    if len(set(change.names)) != len(change.names):
        raise ValueError(f"change: a name is there twice in {change.names!r}")
    for name in change.names:
        if not _OFFSET.fullmatch(name):
            raise ValueError(f"change: {name!r} is not a compass offset, and nothing else is ever written")
    device = _DEVICE.fullmatch(change.device_name)
    stems = {name[:-1] for name in change.names}
    belongs = device and {_number(_OFFSET.fullmatch(name)) for name in change.names} == {_number(device)}
    if len(stems) != 1 or not belongs:
        raise ValueError(f"change: {change.names!r} and {change.device_name!r} are not of one compass")
    if change.compass not in (1, 2, 3):
        raise ValueError(f"change: compass wants 1, 2 or 3, got {change.compass!r}")
    old, new = tuple(map(float32, change.old)), tuple(map(float32, change.new))
    return replace(change, old=old, new=new)


def _number(match: re.Match[str] | None) -> str:
    return "" if match is None else match.group(1) or match.group(2) or "1"


def triple(change: Change) -> tuple[str, str, str]:
    """All three offset names of this compass, written or not: their length counts for the limit."""
    stem = change.names[0][:-1]
    return f"{stem}X", f"{stem}Y", f"{stem}Z"


def largest_step_mg(change: Change) -> float:
    """The largest step on any axis; what the change says of itself is not trusted to be large enough."""
    steps = (abs(n - o) for o, n in zip(change.old, change.new, strict=True))
    return max((*steps, *change.step_mg))


def confirmation_code(change: Change) -> int:
    """Four digits that stand for exactly this change, the same in every process. Never 0."""
    values = struct.pack(f"<{2 * len(change.names)}f", *map(float32, (*change.old, *change.new)))
    head = f"{change.system} {change.device_id} {' '.join(change.names)} ".encode()
    return 1000 + int.from_bytes(hashlib.sha256(head + values).digest()[:8], "big") % 9000


def code_needed(change: Change, above_mg: float = CONFIRM_ABOVE_MG) -> int | None:
    """The code that this change wants, or None when it is small enough to go without (S8)."""
    return confirmation_code(change) if largest_step_mg(change) > above_mg else None


def reads(change: Change) -> tuple[str, ...]:
    """Parameters that are read afresh before anything is written."""
    return (*triple(change), change.device_name, LEARN, OFFS_MAX)


def dry_run(change: Change, above_mg: float = CONFIRM_ABOVE_MG) -> list[str]:
    """Every message an upload of this change would send, in order, a line each; the code last, if wanted.

    Requests are repeated when unanswered. Where the proof fails, the old values are written back the same
    way.
    """
    change = checked(change)
    pairs = list(zip(change.names, change.old, change.new, strict=True))
    lines = [f"PARAM_REQUEST_READ {name}" for name in reads(change)]
    lines += [f"PARAM_SET {name} {new!r} (now {old!r})" for name, old, new in pairs if not same(old, new)]
    lines += [f"PARAM_REQUEST_READ {name}" for name in change.names]
    code = code_needed(change, above_mg)
    return lines if code is None else [*lines, f"a change above {above_mg:g} mG: confirm with code {code}"]


def beyond_limit(change: Change, stored: Mapping[str, float], most_mg: float) -> bool:
    """Any axis, or the length of the vector with the axes that stay, is over the limit or not finite."""
    new = dict(zip(change.names, change.new, strict=True))
    values = tuple(new.get(name, stored.get(name, 0.0)) for name in triple(change))
    return not all(map(math.isfinite, values)) or not math.hypot(*values) <= most_mg


def value_refusals(
    change: Change, stored: Mapping[str, float], *, undo: bool, offs_max_mg: float | None
) -> tuple[Reason, ...]:
    """What the freshly read parameters say against it; names not read yet say nothing.

    Before an upload every value must still be the old one; before a restore either the old or our new one,
    which is what a write that was cut short leaves behind.
    """
    out = []
    device = stored.get(change.device_name)
    if device is not None and not same(device, change.device_id):
        out.append(Reason.DEVICE_CHANGED)
    for name, old, new in zip(change.names, change.old, change.new, strict=True):
        value = stored.get(name)
        if value is not None and not same(value, old) and not (undo and same(value, new)):
            out.append(Reason.OFFSETS_CHANGED)
            break
    if not same(stored.get(LEARN, 0.0), 0.0):
        out.append(Reason.SECOND_WRITER)
    limits = [limit for limit in (stored.get(OFFS_MAX), offs_max_mg) if limit is not None]
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
