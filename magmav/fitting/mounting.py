"""Is the compass mounted as the autopilot believes? What the causes found, as an orientation to set."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from magmav.core.causes import Cause
from magmav.mavlink.autopilot.stored import StoredCalibrations


def describe(causes: Sequence[Cause], held: StoredCalibrations, compass: int) -> dict[str, Any]:
    """stored_orientation, and found: None, or rotation (a name, or None where no right angle fits), angle, text."""
    found = next((c for c in causes if c.code.startswith("MOUNTED")), None)
    stored = None
    if found is None:
        return {"stored_orientation": stored, "found": None}
    name, angle = found.figure.get("orientation"), float(found.figure["turn_deg"])
    return {
        "stored_orientation": stored,
        "found": {"rotation": name, "angle_deg": round(angle, 2), "text": found.text},
    }
