"""Every compass of every recording: heading error uncalibrated, as stored, by each estimator, and after fit.

    recordings_table.py [--only NAMES] [--files PART,...] [--write docs/fit.md]

Each column is fitted on the first half of what taught and scored on the second, on the same samples. The recordings are
found through MAGMAV_DATA (exit code 3 where there are none). --write puts the table between the marks in that page,
at the end and in one go. A recording that cannot be read has a line that says so.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path
from typing import Any

import magmav
from magmav.comparison import METHODS, SMOOTHED, compare
from magmav.geomag import world_magnetic_model
from magmav.link import LinkError
from magmav.logs import LogError
from magmav.recording import NothingToLearnFrom, open_recording
from magmav.settings import Settings

DATA = Path(os.environ.get("MAGMAV_DATA", Path(__file__).parents[2] / "shared" / "data"))
ALL = [name for name in METHODS if name != SMOOTHED]  # that is what fit does, which has columns of its own
BEGIN, END = "<!-- recordings_table: begin -->", "<!-- recordings_table: end -->"


def recordings(parts: list[str]) -> list[Path]:
    """All of them, in order of name."""
    found = [p for p in sorted(DATA.rglob("*")) if p.suffix in (".tlog", ".bin", ".ulg")]
    return [p for p in found if not parts or any(part in p.name for part in parts)]


def truth_of(path: Path) -> Path | None:
    """The truth file that lies beside a recording."""
    truth = path.with_name(path.stem.removesuffix("_imu") + "_truth.csv")
    return truth if truth.is_file() else None


def rows(path: Path, names: list[str]) -> list[list[str]]:
    """A line per compass."""
    truth = truth_of(path)
    recording = None
    try:
        recording = open_recording(path)
        side = compare(
            recording,
            Settings(),
            world_magnetic_model,
            clock=time.perf_counter,
            reference_csvs=[] if truth is None else [truth],
            only=names,
        )
        fit = magmav.fit(path, options=magmav.FitOptions(heading_reference=None if truth is None else str(truth)))
    except (NothingToLearnFrom, LinkError, LogError) as error:
        return [[path.name, "-", str(error).partition(": ")[2][:60]]]
    finally:
        if recording is not None:
            recording.close()
    fits = {(v["system"], c["compass"]): c for v in fit["vehicles"] for c in v["compasses"]}
    out = []
    for vehicle in side["vehicles"]:
        for compass in vehicle["compasses"]:
            entry = fits.get((vehicle["system"], compass["compass"]), {})
            out.append(row(path, compass, entry, names))
    return out


def row(path: Path, compass: dict[str, Any], entry: dict[str, Any], names: list[str]) -> list[str]:
    """Degrees RMS on the second half."""
    by = {r["name"]: r for r in compass["estimators"]}
    told = entry.get("fit") or {}
    heading = told.get("heading") or {}
    held = heading.get("held_out") or {}
    stored = compass["stored"]
    offsets = told.get("new_offsets_mg") or told.get("change_mg")
    return [
        path.name,
        str(compass["compass"]),
        compass["reference"] or "-",
        degrees(compass["uncalibrated"]["second_half"]),
        "-" if stored is None else degrees(stored["second_half"]),
        *(degrees(by[n]["second_half"]) for n in names),
        degrees(held.get("after")),
        degrees(heading.get("full")),
        "-" if offsets is None else " ".join(f"{v:.0f}" for v in offsets),
        told.get("state", "-"),
    ]


def degrees(score: dict[str, Any] | None) -> str:
    """One number, or that there is none."""
    return "-" if not score or score.get("rms_deg") is None else f"{score['rms_deg']:.1f}"


def placed(page: str, lines: list[str]) -> str:
    """The page with these lines between its marks. SystemExit where it has none."""
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise SystemExit(f"the page wants the lines {BEGIN} and {END}: the table is put between them")
    return before + "\n".join([BEGIN, *lines, END]) + after


def main(argv: list[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default=",".join(ALL), metavar="NAMES", help=f"of {', '.join(METHODS)}")
    parser.add_argument("--files", default="", metavar="PART,...", help="recordings whose name contains one of these")
    parser.add_argument("--write", type=Path, metavar="PAGE", help="put the table into this page")
    o = parser.parse_args(argv)
    names, files = o.only.split(","), recordings([p for p in o.files.split(",") if p])
    if not files:
        print(f"{DATA}: no such recordings; set MAGMAV_DATA", file=sys.stderr)
        return 3
    if unknown := set(names) - set(METHODS):
        parser.error(f"--only: no such method: {', '.join(sorted(unknown))}")
    if o.write is not None:
        placed(o.write.read_text(encoding="utf-8"), [])  # said before an hour of work, not after
    head = ["recording", "compass", "reference", "uncalibrated", "stored", *names]
    head += ["fit, held out", "fit, whole flight", "offsets or change of fit, mG", "state of fit"]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    print("\n".join(lines), flush=True)
    for path in files:
        for cells in rows(path, names):
            lines.append("| " + " | ".join(cells + [""] * (len(head) - len(cells))) + " |")
            print(lines[-1], flush=True)
    if o.write is not None:
        page = placed(o.write.read_text(encoding="utf-8"), lines)
        part = o.write.with_name(f"{o.write.name}.part")
        part.write_text(page, encoding="utf-8")
        part.replace(o.write)
    return 0


if __name__ == "__main__":
    sys.exit(main())
