"""One log's entry as ``magmav fit --json`` gives it, made by hand: two vehicles, three compasses, every key filled."""

from __future__ import annotations

import copy
import math
from typing import Any

Json = dict[str, Any]
POINTS = 40


def entry() -> Json:
    """A compass that is ready, one that is refused, one of another vehicle of which nothing was learnt."""
    refused = compass(2, state="REFUSED")
    refused["fit"] |= {"relative": True, "old_offsets_mg": None, "new_offsets_mg": None, "odd_one_out": True}
    refused["fit"]["heading"] = None
    unlearnt = compass(1, state="NO_DATA") | {"fit": None, "offsets_mg": None, "sigma_mg": None, "heading": None}
    return {
        "source": "logs/hill.tlog",
        "vehicles": [
            {
                "system": 1,
                "autopilot": 3,
                "reboots": 1,
                "flights": [
                    {"armed_s": 20.0, "takeoff_s": 24.0, "landed_s": 300.0, "disarmed_s": 303.0, "crash_s": None}
                ],
                "compasses": [compass(1), refused],
            },
            {"system": 7, "autopilot": 12, "reboots": 0, "flights": [], "compasses": [unlearnt]},
        ],
        "counts": {"link": {"records": 9123}, "codec": {"messages": 9120, "bad checksum": 3}, "decode": {}},
        "file": {"path": "logs/hill.tlog", "sha256": "ab" * 32, "bytes": 123456, "kind": "tlog"},
        "made_by": {"magmav": "0.1.0", "at": None},
    }


def compass(number: int, state: str = "READY") -> Json:
    """One compass's entry with its fit."""
    score = {"reference": "GPS yaw", "rms_deg": 4.25, "p95_deg": 8.5, "uncalibrated_rms_deg": 44.5, "n": 800}
    return {
        "compass": number,
        "device_id": 97539,
        "offsets_mg": [-101.25, 50.5, 31.75],
        "sigma_mg": [2.5, 2.25, 6.75],
        "axes": ["OBSERVED", "OBSERVED", "FROM_MODEL"],
        "state": state,
        "reasons": [{"code": "Z_FROM_MODEL", "text": "down axis rests on the field model"}],
        "causes": [],
        "stored": {"COMPASS_OFS_X": 0.0, "COMPASS_DEV_ID": 97539.0},
        "heading": score,
        "heading_offsets_only": score | {"rms_deg": 4.75},
        "samples": 4000,
        "samples_learnt": 3100,
        "fit": fit(state),
    }


def fit(state: str) -> Json:
    """The ``fit`` part, every key of the contract."""
    card = [
        {"heading_deg": 45.0 * i, "before_deg": 30.5 * math.cos(i), "after_deg": 0.4 * math.sin(i), "sigma_deg": 0.75}
        for i in range(8)
    ]
    rays = [{"azimuth_deg": 31.0 * i % 360.0, "elevation_deg": 7.0 * i - 77.0, "n": i % 5} for i in range(22)]
    return copy.deepcopy({
        "state": state,
        "reasons": [{"code": "RELATIVE_ONLY", "text": "stored offsets unknown"}],
        "causes": [{"code": "FOLLOWS_CURRENT", "text": "field follows the current", "figure": {"size_mg": 3.125}}],
        "advice": ["Move the compass away from the power wires."],
        "device_id": 97539,
        "relative": False,
        "span_s": [24.5, 299.5],
        "cut": [{"from_s": 24.5, "to_s": 31.5, "code": "TAKEOFF_ANOMALY", "text": "steel below the place"}],
        "old_offsets_mg": [11.0, -12.0, 13.0],
        "new_offsets_mg": [-100.5, 51.5, 32.5],
        "change_mg": [-111.5, 63.5, 19.5],
        "sigma_mg": [1.5, 1.25, 5.75],
        "axes": ["OBSERVED", "OBSERVED", "FROM_MODEL"],
        "hard_iron_mg": [100.0, -50.0, -30.0],
        "hard_iron_at": "average power",
        "changes_s": [88.5],
        "soft_iron": {
            "matrix": [[1.01, 0.02, 0.03], [0.02, 0.99, 0.04], [0.03, 0.04, 1.05]],
            "sigma": [[0.001, 0.002, 0.003], [0.002, 0.004, 0.005], [0.003, 0.005, 0.006]],
            "earned": False,
            "asked": True,
        },
        "motor": {"mg_per_unit": [1.5, -2.5, 3.5], "of": "current", "earned": True, "asked": True, "evidence": "0.9"},
        "scale": {"value": 1.125, "sigma": 0.0625, "earned": True, "asked": False},
        "parameters": {
            "autopilot": "ardupilot",
            "old": {"COMPASS_OFS_X": 11.0, "COMPASS_OFS_Y": None, "COMPASS_ORIENT": 0.0},
            "new": {"COMPASS_OFS_X": -100.5, "COMPASS_OFS_Y": 51.5, "COMPASS_ORIENT": 0.0},
            "changed": {"COMPASS_OFS_X": -100.5, "COMPASS_OFS_Y": 51.5},
            "closure_mg": 0.0125,
        },
        "residual_mg": {"before": 120.25, "after": 6.25, "held_out_before": 118.25, "held_out_after": 7.75},
        "heading": {
            "reference": "GPS yaw",
            "before": {"rms_deg": 40.25, "p95_deg": 77.5, "n": 900},
            "after": {"rms_deg": 3.25, "p95_deg": 6.5, "n": 901},
            "excluded": {"tilt over 60 deg": 41, "disarmed": 12},
            "held_out": {
                "before": {"rms_deg": 41.5, "p95_deg": 78.5, "n": 450},
                "after": {"rms_deg": 3.75, "p95_deg": 7.25, "n": 451},
                "how": "fitted on the first half, scored on the second",
            },
        },
        "mounting": {
            "stored_orientation": 4,
            "found": {
                "rotation": "YAW_90",
                "angle_deg": 91.5,
                "text": "mounted turned by 91.5 degrees",
                "set": {"name": "COMPASS_ORIENT", "value": 2},
            },
        },
        "odd_one_out": False,
        "deviation": card,
        "coverage": {"directions": rays, "share": 0.625},
        "series": series(),
        "something_new": [1.5, "a later version's"],
    })  # fmt: skip


def series() -> Json:
    """Waves, so that no two points are alike."""
    t = [20.0 + 7.0 * i for i in range(POINTS)]
    return {
        "t_s": t,
        "field_before_mg": [600.0 + 90.0 * math.sin(i / 3) for i in range(POINTS)],
        "field_after_mg": [520.0 + 9.0 * math.cos(i / 2) for i in range(POINTS)],
        "model_mg": [519.0 + 0.1 * i for i in range(POINTS)],
        "current_a": [12.0 + 8.0 * math.sin(i / 5) for i in range(POINTS)],
        "throttle": [0.5 + 0.25 * math.sin(i / 5) for i in range(POINTS)],
        "offsets_t_s": t[5:],
        "offsets_mg": [[-100.0 + 9 / (i + 1), 50.0 + 5 / (i + 1), 30.0 + i / 9] for i in range(POINTS - 5)],
        "offsets_sigma_mg": [[1.0 + 9 / (i + 1), 1.0 + 8 / (i + 1), 5.0 + 5 / (i + 1)] for i in range(POINTS - 5)],
        "heading_deg": [(11.0 * i) % 360.0 for i in range(POINTS)],
        "reference_deg": [(11.0 * i + 3.0 * math.sin(i)) % 360.0 for i in range(POINTS)],
    }
