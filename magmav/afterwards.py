"""What `magmav replay --after-flight` adds: the iron of every moment as all of the flight shows it, and its heading."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from magmav.comparison import Columns, Tape, scored
from magmav.core.after_flight import after_flight
from magmav.core.channel import Circumstances
from magmav.core.correction import iron_of_offsets
from magmav.core.types import Sample
from magmav.reference import Reference
from magmav.score import Calibration, Window

Result = dict[str, Any]


class Afterwards:
    """Keeps the Samples of a recording while it is played (see vehicle.Tap), and runs over them when it is over."""

    def __init__(self) -> None:
        self._tapes: dict[tuple[int, int], Tape] = {}

    def tap(self, sample: Sample, circumstances: Circumstances, stretch: tuple[int, int]) -> None:
        """Take one."""
        self._tapes.setdefault((sample.system, sample.compass), Tape()).add(sample, circumstances, stretch)

    def add_to(self, result: Result, references: Mapping[int, Reference]) -> None:
        """Put ``after_flight`` into the entry of each compass; None where nothing was learnt.

        references : by system, what headings are compared with.
        """
        for tape in self._tapes.values():
            tape.close()
        for vehicle in result["vehicles"]:
            system = vehicle["system"]
            for entry in vehicle["compasses"]:
                entry["after_flight"] = _entry(self._tapes[system, entry["compass"]], references.get(system))


def _entry(tape: Tape, reference: Reference | None) -> Result | None:
    samples = [h.sample for h in tape.heard]
    known = after_flight(samples)
    if known is None:
        return None
    e, end, columns = known.answer, tape.heard[-1], Columns.of(tape.heard)
    matrix = e.soft_iron_b @ end.sample.shaping.matrix
    path = Calibration(known.iron_of(samples), matrix, columns.down_mg(e.horizontal_mg))
    scores, name = scored(columns, {"path": path}, reference, Window())
    heading = scores.get("path")
    moments = zip(known.boot_ns.tolist(), known.estimates, strict=True)
    return {
        "offsets_mg": _rounded(-iron_of_offsets(end.sample, e, end.circumstances.expected)),
        "sigma_mg": _rounded(np.sqrt(np.diag(e.covariance_mg2))),
        "changes_s": [t / 1e9 for t in known.changes_ns],
        "heading": None
        if heading is None
        else {"reference": name, "rms_deg": heading.rms_deg, "p95_deg": heading.p95_deg, "n": heading.n},
        "path": [
            {
                "boot_s": t / 1e9,
                "hard_iron_mg": _rounded(one.hard_iron_b_mg),
                "sigma_mg": _rounded(np.sqrt(np.diag(one.covariance_mg2))),
            }
            for t, one in moments
        ],
    }


def _rounded(vector: Any) -> list[float]:
    return [round(float(v), 3) for v in vector]
