"""The best answer after the flight, of one log: what to store, how sure, what was cut, and what it rests on.

A recording goes through the pipeline once. Its Samples are then solved all at once (core.after_flight), scored on what
the fit did not see, and turned into parameters in the autopilot's own names. Nothing here prints or writes a file.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from magmav import __version__
from magmav.boot import Boot
from magmav.core.types import FieldModel
from magmav.fitting.answer import answer
from magmav.fitting.case import Case, Told, solve
from magmav.fitting.dated import Dated
from magmav.fitting.tape import Recorder
from magmav.fitting.why import asked
from magmav.geomag import world_magnetic_model
from magmav.logs import HEAD, Progress, kind_of
from magmav.recording import open_recording, replay
from magmav.reference import Reference
from magmav.settings import Settings
from magmav.vehicle import Vehicle

Result = dict[str, Any]
_CHUNK = 1 << 20


@dataclass(frozen=True, slots=True)
class FitOptions:
    """What is asked for beyond the offsets, and of which compasses (empty: all).

    heading_reference : path of a truth csv (see reference.CSV_COLUMNS) instead of the recording's own yaw.
    """

    soft_iron: bool = False
    motor: bool = False
    scale: bool = False
    heading_reference: str | None = None
    compasses: tuple[int, ...] = ()


def fit(
    path: str | Path,
    settings: Settings | None = None,
    *,
    options: FitOptions = FitOptions(),
    progress: Progress | None = None,
    model: FieldModel = world_magnetic_model,
    arrays: dict[tuple[int, int], dict[str, Any]] | None = None,
) -> Result:
    """One log's entry of what ``magmav fit --json`` prints: the document of ``replay`` with ``fit`` in each compass.

    arrays : filled with numpy arrays by system and compass, see ``magmav.library.fit``.
    Raises LogError or LinkError for a file that cannot be read, NothingToLearnFrom where no compass was heard,
    TruthError for a bad reference file, ValueError for a compass that is not 1, 2 or 3.
    """
    path, settings = Path(path), settings or Settings()
    wrong = [c for c in options.compasses if c not in (1, 2, 3)]
    if wrong:
        raise ValueError(f"compasses: want 1, 2 or 3, got {wrong[0]}")
    recorder, dated = Recorder(), Dated()
    references: dict[int, Reference] = {}
    boots: dict[int, Vehicle | Boot] = {}
    recording = open_recording(path, progress)
    try:
        result = replay(
            recording,
            settings,
            model,
            source=str(path),
            reference_csv=None if options.heading_reference is None else Path(options.heading_reference),
            watchers=(recorder.watch, dated),
            references=references,
            tap=recorder.tap,
            boots=boots,
            idle=True,
        )
    finally:
        recording.close()
    recorder.close()
    for vehicle in result["vehicles"]:
        system = vehicle["system"]
        told = Told(
            system,
            vehicle["autopilot"],
            boots[system],
            references.get(system),
            recorder.currents(system),
            recorder.parameters(system),
            recorder.moved_s(system),
            settings,
        )
        cases: dict[int, Case] = {}
        for entry in vehicle["compasses"]:
            entry["fit"], compass = None, entry["compass"]
            tape = recorder.tapes.get((system, compass))
            case = None if tape is None else solve(compass, tape, told)
            if case is not None:
                cases[compass] = case
        found, finder = asked(list(cases.values()))
        for entry in vehicle["compasses"]:
            chosen = not options.compasses or entry["compass"] in options.compasses
            if entry["compass"] in cases and chosen:
                got = answer(entry, cases[entry["compass"]], found[entry["compass"]], finder, options)
                if arrays is not None:
                    arrays[system, entry["compass"]] = got
    result["file"] = file_facts(path) | {"began_unix_s": dated.unix_s(recording.unix_offset_ns)}
    result["made_by"] = {"magmav": __version__, "at": None}
    return result


def file_facts(path: Path) -> Result:
    """path, sha256, bytes and kind of a file that was read a moment ago."""
    digest, size = hashlib.sha256(), 0
    with path.open("rb") as file:
        head = file.read(HEAD)
        block = head
        while block:
            digest.update(block)
            size += len(block)
            block = file.read(_CHUNK)
    return {"path": str(path), "sha256": digest.hexdigest(), "bytes": size, "kind": kind_of(head) or "tlog"}
