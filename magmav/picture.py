"""The picture of a replay: traces from the records, the reference and the scores that stand in its result."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from magmav.reference import Reference
from magmav.view.plots import Trace, plot_replay


def draw_replay(
    path_png: Path, traces: Sequence[Trace], result: dict[str, Any], references: dict[int, Reference]
) -> None:
    """Draw every compass against the very reference its score names. ViewError when the file cannot be written."""
    entries = {(v["system"], c["compass"]): c for v in result["vehicles"] for c in v["compasses"]}
    drawn, name = [], None
    for trace in traces:
        entry, reference = entries.get((trace.system, trace.compass)), references.get(trace.system)
        score = None if entry is None else entry["heading"]
        if reference is None or score is None:
            drawn.append(trace)
            continue
        name = score["reference"]
        scored = None if score["from_s"] is None else (score["from_s"], score["to_s"])
        frozen = score["from_s"] if result["learn_for_s"] is not None else None
        yaw = reference.interpolate(trace.boot_s).yaw_true_rad
        before = score["stored_rms_deg"]
        drawn.append(trace.against(yaw, before, score["rms_deg"], scored, frozen))
    if name is None or any(t.reference_true_rad is None for t in drawn):
        name = None
    plot_replay(path_png, drawn, Path(result["source"]).name, name)
