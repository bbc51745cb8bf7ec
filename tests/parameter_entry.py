"""Parameters that a fit may change, 32-bit floats of every kind, and as much of its document as a file is made of."""

from __future__ import annotations

from typing import Any

ARDUPILOT = {
    "COMPASS_OFS_X": -181.36575317382812,
    "COMPASS_OFS_Y": 0.10000000149011612,
    "COMPASS_DIA_X": 1.0499999523162842,
    "COMPASS_MOT_Z": 1e-07,
    "COMPASS_MOTCT": 2.0,
}
PX4 = {"CAL_MAG0_XOFF": 0.1813657581806183, "CAL_MAG0_YODIAG": -0.0, "CAL_MAG_COMP_TYP": 1.0}


def entry(changed: dict[str, float], system: int = 1, source: str = "flight.bin") -> dict[str, Any]:
    """As much of a fit's document as a file is made of."""
    compass = {"fit": {"parameters": {"changed": changed}}}
    return {"source": source, "vehicles": [{"system": system, "compasses": [compass, {"fit": None}]}]}
