"""For programs and notebooks: ``magmav.replay(path)`` and ``magmav.fit(path)``, whose records are numpy arrays.

Both give the document that the command prints with --json, with one thing more: ``.arrays``, by (system, compass).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magmav import recording as recordings
from magmav.core.types import FieldModel, Reading, Record
from magmav.fitting import FitOptions
from magmav.fitting import fit as fit_one
from magmav.geomag import world_magnetic_model
from magmav.logs import Progress, Recording
from magmav.service import Watcher
from magmav.settings import Settings

_PLAIN = FitOptions()
Arrays = dict[str, NDArray[Any]]


class Result(dict[str, Any]):
    """The document, and beside it ``arrays``: by (system, compass), columns by name, (N,) or (N, 3)."""

    def __init__(self, document: dict[str, Any], arrays: dict[tuple[int, int], Arrays]) -> None:
        super().__init__(document)
        self.arrays = arrays


def fit(
    path: str | Path,
    settings: Settings | None = None,
    *,
    options: FitOptions = _PLAIN,
    progress: Progress | None = None,
    model: FieldModel = world_magnetic_model,
) -> Result:
    """The best answer after the flight, of one log. Raises as ``magmav.fitting.fit`` does.

    arrays : boot_s, sensor_b_mg (the sensor's own field), before_b_mg and after_b_mg (as stored offsets and new ones
    correct it), hard_iron_b_mg at each moment, roll_rad, pitch_rad, taught, throttle (NaN unknown), ampere (likewise).
    """
    arrays: dict[tuple[int, int], Arrays] = {}
    entry = fit_one(path, settings, options=options, progress=progress, model=model, arrays=arrays)
    return Result(entry, arrays)


def replay(
    recording: Recording | str | Path,
    settings: Settings | None = None,
    model: FieldModel = world_magnetic_model,
    *,
    watchers: Sequence[Watcher] = (),
    **options: Any,
) -> Result:
    """What the service would have known, of a recording or of the file at a path. Raises as ``recording.replay`` does.

    arrays : boot_s, sensor_b_mg, corrected_b_mg, stored_b_mg, hard_iron_b_mg, offsets_mg, sigma_mg, roll_rad,
    pitch_rad, heading_rad (magnetic, NaN where none was published), heading_true_rad (likewise), learnt, state.
    """
    opened = recordings.open_recording(recording) if isinstance(recording, str | Path) else recording
    kept: dict[tuple[int, int], list[Record]] = {}

    def keep(reading: Reading, record: Record | None) -> None:
        if record is not None:
            kept.setdefault((record.system, record.compass), []).append(record)

    try:
        document = recordings.replay(opened, settings or Settings(), model, watchers=(*watchers, keep), **options)
    finally:
        if opened is not recording:
            opened.close()
    return Result(document, {key: _columns(records) for key, records in kept.items()})


def _columns(records: Sequence[Record]) -> Arrays:
    nan = float("nan")
    out: Arrays = {"boot_s": np.array([r.boot_ns / 1e9 for r in records])}
    for source, name in (
        ("mag_b_mg", "sensor_b_mg"),
        ("corrected_b_mg", "corrected_b_mg"),
        ("stored_b_mg", "stored_b_mg"),
        ("offsets_mg", "offsets_mg"),
        ("sigma_mg", "sigma_mg"),
        ("roll_rad", "roll_rad"),
        ("pitch_rad", "pitch_rad"),
        ("learnt", "learnt"),
    ):
        out[name] = np.array([getattr(r, source) for r in records])
    out["hard_iron_b_mg"] = np.array([r.estimate.hard_iron_b_mg for r in records])
    out["heading_rad"] = np.array([r.heading.magnetic_rad if r.heading.valid else nan for r in records])
    true = [r.heading.true_rad if r.heading.valid and r.heading.true_valid else nan for r in records]
    out["heading_true_rad"] = np.array(true)
    out["state"] = np.array([int(r.verdict.state) for r in records])
    return out
