"""The report of a fit: one HTML file, with everything in it that the JSON says.

It opens without a network, on a phone and on paper. It holds no script, and no text of a log is ever read as HTML.
"""

from __future__ import annotations

import json
import math
import os
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from magmav.view.records import ViewError, WrongName
from magmav.view.report_compass import compass_section
from magmav.view.report_page import Child, Markup, facts, number, page, table, tag, word
from magmav.view.report_words import autopilot_name, title_of

Json = Mapping[str, Any]

_WORDS = (
    ("Offset", "what the autopilot adds to each axis so that iron on board does not turn the heading"),
    ("mG", "milligauss; the Earth's field is 250 to 650 mG, its level part steers a compass"),
    ("One sigma", "two times of three the true value is within it, 19 times of 20 within two"),
    ("Held out", "fitted on one part of the flight, scored on another that the fit did not see"),
    ("RMS", "size of a typical error, large ones counting more"),
    ("Deviation", "shown heading less true heading, by heading"),
    ("Field model", "the World Magnetic Model at the place and date of the flight"),
)


def write_report(entry: Json, path: str | Path) -> None:
    """Write the report of one log's entry, or of ``{"logs": [entry, ...]}``, whole or not at all.

    An earlier file of this name is replaced. ViewError naming the file when it cannot be written or its name does
    not end in .html.
    """
    path = Path(path)
    check_report_name(path)
    write_whole(path, report_html(entry))


def check_report_name(path: str | Path) -> None:
    """WrongName for a name that is not a page's: the likeliest mistake is naming a log here."""
    if Path(path).suffix.lower() not in (".html", ".htm"):
        raise WrongName(f"{path}: reports want a name ending in .html")


def write_whole(path: Path, content: str) -> None:
    """Text to a file through a name beside it, so that a reader never meets half of it."""
    aside: str | None = None
    try:
        handle, aside = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
        with os.fdopen(handle, "wb") as file:
            file.write(content.encode())
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(aside, 0o666 & ~umask)  # mkstemp's file is its owner's alone; a report is for others
        os.replace(aside, path)
    except OSError as error:
        raise ViewError(f"{path}: cannot write report: {error.strerror}") from error
    finally:
        if aside is not None:
            with suppress(OSError):
                os.unlink(aside)


def report_html(entry: Json) -> str:
    """The page as text; the same entry gives the same bytes."""
    entries = entry.get("logs", [entry])
    names = [_name(e) for e in entries]
    body: list[Child] = []
    for i, (one, name) in enumerate(zip(entries, names, strict=True)):
        body += _log(one, name, f"l{i}" if len(entries) > 1 else "")
    title = f"Compass report: {names[0]}" if len(names) == 1 else f"Compass report: {len(names)} logs"
    body += [
        tag("section", tag("h2", "What the words mean"), facts(_WORDS)),
        tag(
            "details",
            tag("summary", "All figures as JSON"),
            tag("pre", as_json(entry)),
            class_="screen",
        ),
    ]
    return page(title, body)


def as_json(entry: Json) -> str:
    """The entry on lines of a bearable length; what is not finite is null."""
    return json.dumps(_known(entry), ensure_ascii=True, allow_nan=False, indent=None, separators=(", ", ": "))


def _known(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {str(k): _known(v) for k, v in value.items()}
    return [_known(v) for v in value] if isinstance(value, list | tuple) else value


def _log(entry: Json, name: str, prefix: str) -> list[Child]:
    vehicles = entry.get("vehicles") or []
    out: list[Child] = [tag("h1", f"Compass report: {name}")]
    rows = []
    sections: list[Markup] = []
    for v, vehicle in enumerate(vehicles):
        for c, compass in enumerate(vehicle.get("compasses") or []):
            anchor = f"{prefix}v{v}c{c}"
            rows.append(_row(vehicle, compass, anchor))
            sections.append(compass_section(vehicle, compass, anchor, not sections))
    if rows:
        head = ("compass", tag("span", "verdict"), "RMS stored, deg", "RMS new, deg", tag("span", "against"))
        out.append(table(head, rows))
        held = "Heading errors on samples that the fit did not see where such were held out, else on all."
        out.append(tag("p", held, class_="quiet"))
    else:
        out.append(tag("p", "No compass was heard in this log."))
    out += [_flights(vehicle) for vehicle in vehicles]
    return [*out, *sections, _made_from(entry)]


def _row(vehicle: Json, compass: Json, anchor: str) -> Sequence[Child]:
    fit = compass.get("fit") or {}
    heading = fit.get("heading") or {}
    held = heading.get("held_out") or {}
    part = held if held.get("after") else heading
    name = f"{word(vehicle.get('system'))}/{word(compass.get('compass'))}"
    before, after = ((part.get(k) or {}).get("rms_deg") for k in ("before", "after"))
    state = title_of(fit.get("state") if fit else compass.get("state"))
    return (
        tag("a", f"{name}", href=f"#{anchor}"),
        tag("span", state if fit else f"{state}, nothing learnt"),
        number(before, ".2f"),
        number(after, ".2f"),
        tag("span", word(heading.get("reference"))),
    )


def _flights(vehicle: Json) -> Markup:
    told = []
    for flight in vehicle.get("flights") or []:
        start, end, crash = (flight.get(f"{k}_s") for k in ("takeoff", "landed", "crash"))
        part = "no take-off seen" if start is None else f"from {number(start, '.0f')} s"
        part += ", no landing seen" if end is None else f" to {number(end, '.0f')} s"
        told.append(part + (f", crash at {number(crash, '.0f')} s" if crash is not None else ""))
    reboots = vehicle.get("reboots")
    pairs: list[tuple[str, Child]] = [
        ("vehicle", f"system {word(vehicle.get('system'))}, {autopilot_name(vehicle)}"),
        ("in the air", "; ".join(told) or "no flight was seen"),
    ]
    pairs += [("reboots inside the log", word(reboots))] if reboots is not None else []
    return facts(pairs)


def _made_from(entry: Json) -> Markup:
    file, made = entry.get("file") or {}, entry.get("made_by") or {}
    pairs: list[tuple[str, Child]] = [
        ("log", word(file.get("path") or entry.get("source"))),
        ("kind", word(file.get("kind"))),
        ("bytes", word(file.get("bytes"))),
        ("SHA-256", word(file.get("sha256"))),
        ("made by", f"magmav {word(made.get('magmav'))}"),
        (
            "made at",
            word(made["at"]) if made.get("at") is not None else "not noted: the same log gives the same report",
        ),
    ]
    for key, count in (entry.get("counts") or {}).items():
        if count not in ({}, None):
            pairs.append((f"counted, {key}", word(count)))
    return tag("section", tag("h2", "Where it comes from"), facts(pairs))


def _name(entry: Json) -> str:
    path = (entry.get("file") or {}).get("path") or entry.get("source")
    return UNNAMED if path is None else str(path).replace("\\", "/").rstrip("/").rpartition("/")[2] or UNNAMED


UNNAMED = "a log without a name"
