"""Results as tables for people, made from the same dict that is the JSON, so that the two cannot disagree.

null is shown as "not known"; a heading error always names what it was measured against.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from rich import box
from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from magmav.view.deviation import card_view

Json = Mapping[str, Any]

UNKNOWN = "not known"
_STATES = {"NO_DATA": "no data", "LEARNING": "learning", "READY": "ready", "REFUSED": "refused"}
_COLOURS = {"NO_DATA": "red", "LEARNING": "yellow", "READY": "green", "REFUSED": "red"}
_AXES = {"OBSERVED": "observed", "FROM_MODEL": "from the field model", "NOT_OBSERVED": "not observed"}
_AUTOPILOTS = {3: "ArduPilot", 12: "PX4"}  # MAV_AUTOPILOT
_AXIS_NAMES = ("x forward", "y right", "z down")
RESULTS = {
    "ALL_NEW": "all new values are in place and proven",
    "ALL_OLD": "all old values are in place",
    "WRITTEN_UNPROVEN": "written, but not proven",
    "PENDING_RESTORE": "the old values wait to be restored",
    "REFUSED": "refused, nothing was written",
}
_FOLLOWS = "Yaw of an autopilot usually follows its own compass: agreeing with it proves little."


def to_text(view: RenderableType, width: int = 100) -> str:
    """The view as plain text of at most this width, without colours."""
    out = io.StringIO()
    Console(file=out, width=width, color_system=None, highlight=False, legacy_windows=False).print(view)
    return "\n".join(line.rstrip() for line in out.getvalue().splitlines()) + "\n"


def replay_view(result: Json) -> RenderableType:
    """One recording: per compass the offsets, how each axis is known, heading error and verdict."""
    parts: list[RenderableType] = [_line(_word(result.get("source")), "bold")]
    vehicles = result.get("vehicles") or []
    for vehicle in vehicles:
        kind = vehicle.get("autopilot")
        name = f"System {_word(vehicle.get('system'))}, {_AUTOPILOTS.get(kind, f'autopilot {_word(kind)}')}"
        parts += [Text(), _line(name, "bold")]
        parts += [_compass(compass) for compass in vehicle.get("compasses") or []]
        if not vehicle.get("compasses"):
            parts.append(_para("  no compass was seen"))
    if not vehicles:
        parts.append(_line("no vehicle was seen"))
    if any(_reference(c).startswith("ATTITUDE") for v in vehicles for c in v.get("compasses") or []):
        parts += [Text(), _line(_FOLLOWS, "dim")]
    counts = _counts(result.get("counts") or {})
    if counts:
        parts += [Text(), _line("Counted:", "dim"), *(_para(f"  {line}", "dim") for line in counts)]
    return Group(*parts)


def summary_view(results: Iterable[Json]) -> RenderableType:
    """Many recordings, one row per compass."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("recording", overflow="fold")
    for name in ("compass", "offsets to store, mG", "one sigma", "verdict"):
        table.add_column(name)
    table.add_column("heading RMS, deg", justify="right")
    table.add_column("against")
    for result in results:
        rows = [(v, c) for v in result.get("vehicles") or [] for c in v.get("compasses") or []]
        for vehicle, compass in rows:
            heading = compass.get("heading") or {}
            state = str(compass.get("state"))
            table.add_row(
                _line(_word(result.get("source"))),
                _line(f"{_word(vehicle.get('system'))}/{_word(compass.get('compass'))}"),
                _line(_triple(compass.get("offsets_mg"), "+.0f")),
                _line(_triple(compass.get("sigma_mg"), ".1f")),
                _line(_STATES.get(state, _word(compass.get("state"))), _COLOURS.get(state, "")),
                _line(f"{_number(heading.get('uncalibrated_rms_deg'))} → {_number(heading.get('rms_deg'))}"),
                _line(_word(heading.get("reference"))),
            )
        if not rows:
            table.add_row(_line(_word(result.get("source"))), *[Text()] * 3, _line("no compass"))
    return table


def demo_view(result: Json) -> RenderableType:
    """The demonstration: heading error before and after, offsets against the truth, upload and undo."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for name in ("", "before upload", "after upload"):
        table.add_column(name, justify="left" if not name else "right")
    reference = result.get("reference") or "simulated truth"
    before, after = (_rms(result.get(name)) for name in ("before", "after"))
    table.add_row(_line(f"heading RMS against {_word(reference)}"), _line(before), _line(after))
    parts: list[RenderableType] = [table]
    for number, compass in enumerate(result.get("compasses") or [], start=1):
        error = compass.get("offset_error_mg")
        text = _triple(error, "+.1f") if isinstance(error, Sequence) else _number(error)
        head = f"Compass {_word(compass.get('compass', number))}"
        parts.append(_line(f"{head}: offsets off the truth by {text} mG"))
        upload = compass.get("upload") or {}
        if upload.get("confirm_code") is not None:
            step, code = _number(upload.get("largest_change_mg"), ".0f"), upload["confirm_code"]
            given = "given" if upload.get("confirmed") else "not given"
            parts.append(_line(f"  a change of {step} mG wants the code of its dry run, {code}: {given}", "dim"))
    for name in ("upload", "restore"):
        outcome = (result.get(name) or {}).get("result")
        parts.append(_line(f"{name.capitalize()}: {_outcome(outcome)}"))
    parts.append(_line(f"Took {_number(result.get('wall_s'))} s", "dim"))
    return Group(*parts)


def write_view(result: Json) -> RenderableType:
    """One write or undo, or the dry run of one: the values, every message where asked, and how it ended."""
    parts: list[RenderableType] = []
    if result.get("old"):
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
        for name in ("parameter", "old mG", "new mG", "change mG"):
            table.add_column(name, justify="left" if name == "parameter" else "right")
        for name, old in result["old"].items():
            new = result["new"][name]
            cells = (name, _number(old, ".1f"), _number(new, ".1f"), _number(new - old, "+.1f"))
            table.add_row(*(_line(cell) for cell in cells))
        parts.append(table)
    if result.get("dry_run"):
        parts += [_line("Nothing was written. To write, these go out:"), *(_line(f"  {m}") for m in result["messages"])]
    else:
        parts.append(_line(_outcome(result.get("result")), "bold"))
    parts += [_line(f"  {reason.get('text')}") for reason in result.get("reasons") or []]
    code = result.get("confirm_code")
    if code is not None and not result.get("confirmed") and result.get("result") in (None, "REFUSED"):
        parts.append(_line(f"Such a large change wants --confirm-change {code}"))
    return Group(*parts)


def history_view(entries: Iterable[Json]) -> RenderableType:
    """Writes to vehicles, a row each: unix_s, system, compass, device_id, action, result, undone, old, new.

    A result of null is a write that was cut short; old and new map parameter names to values.
    """
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for name in ("when (UTC)", "system", "compass", "device", "action", "result", "values: old → new"):
        table.add_column(name)
    count = 0
    for entry in entries:
        count += 1
        cells = (
            _when(entry.get("unix_s")),
            *(_word(entry.get(k)) for k in ("system", "compass", "device_id")),
        )
        result = entry.get("result")
        outcome = "cut short" if result is None else _outcome(result)
        outcome += "; undone later" if entry.get("undone") else ""
        outcome += f"; {entry['note']}" if entry.get("note") else ""
        texts = (*cells, _word(entry.get("action")), outcome, _changes(entry))
        table.add_row(*(_line(text) for text in texts))
    return table if count else _line("nothing was ever written")


def _compass(compass: Json) -> RenderableType:
    state = str(compass.get("state"))
    device = compass.get("device_id")
    head = f"  Compass {_word(compass.get('compass'))} (device {_word(device)}): "
    verdict = _line(_STATES.get(state, _word(compass.get("state"))), f"bold {_COLOURS.get(state, '')}")
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    offsets, wanted = compass.get("offsets_mg"), "offset to store, mG"
    if offsets is None and compass.get("offsets_change_mg") is not None:
        offsets, wanted = compass["offsets_change_mg"], "change of offset, mG"
    table.add_column("axis")
    table.add_column(wanted, justify="right")
    table.add_column("one sigma, mG", justify="right")
    table.add_column("how it is known")
    for i, name in enumerate(_AXIS_NAMES):
        axis = _item(compass.get("axes"), i)
        table.add_row(
            name,
            _line(_number(_item(offsets, i), "+.1f")),
            _line(_number(_item(compass.get("sigma_mg"), i), ".1f")),
            _line(_AXES.get(str(axis), _word(axis))),
        )
    lines: list[RenderableType] = [Text.assemble(_line(head), verdict)]
    lines += [_para(f"    - {_word(r.get('text') or r.get('code'))}") for r in compass.get("reasons") or []]
    lines += [_para(f"    ! {_word(c.get('text') or c.get('code'))}") for c in compass.get("causes") or []]
    stored = ", ".join(f"{_word(n)} {_number(v, 'g')}" for n, v in (compass.get("stored") or {}).items())
    facts = [_para(f"  The autopilot holds: {stored or UNKNOWN}"), *_headings(compass), *_afterwards(compass)]
    card = card_view(compass.get("deviation_card") or [])
    return Group(Text(), *lines, table, *facts, *([Text(), card] if compass.get("deviation_card") else []))


def _headings(compass: Json) -> list[RenderableType]:
    """What the numbers say about heading; offsets alone get their own line when that was scored."""
    heading = compass.get("heading")
    if not heading or heading.get("reference") is None:
        return [_para("  Heading error: not known, there is no reference to measure it against")]
    left_out = ", ".join(f"{_word(k)} {_word(n)}" for k, n in (heading.get("excluded") or {}).items())
    left_out = f"; left out: {left_out}" if left_out else ""
    if not heading.get("n"):
        return [_para(f"  Heading error against {_word(heading['reference'])}: no sample to score{left_out}")]
    span = f"{_number(heading.get('from_s'), '.0f')} to {_number(heading.get('to_s'), '.0f')} s"
    stored = heading.get("stored_rms_deg")
    stored = "" if stored is None else f", as stored {_number(stored)}"
    stored_mean = heading.get("stored_bias_deg")
    stored_mean = "" if stored_mean is None else f", as stored {_number(stored_mean, '+.2f')}"
    claim = heading.get("sigma_deg")
    out: list[RenderableType] = [
        _para(f"  Heading RMS against {_word(heading['reference'])}:"),
        _para(
            f"    uncalibrated {_number(heading.get('uncalibrated_rms_deg'))}{stored}"
            f" → corrected {_number(heading.get('rms_deg'))} deg"
            f" (95 % within {_number(heading.get('p95_deg'))}, one sigma claimed: {_number(claim)})"
        ),
        _para(
            f"    mean error: uncalibrated {_number(heading.get('uncalibrated_bias_deg'), '+.2f')}{stored_mean}"
            f" → corrected {_number(heading.get('bias_deg'), '+.2f')} deg"
        ),
    ]
    only = compass.get("heading_offsets_only")
    if only:
        out.append(_para(f"    with an upload of offsets alone: {_number(only.get('rms_deg'))} deg"))
    out.append(_para(f"    over {_word(heading.get('n'))} samples, {span} of boot time{left_out}", "dim"))
    return out


def _afterwards(compass: Json) -> list[RenderableType]:
    """What all of the flight shows, where that was asked for."""
    if "after_flight" not in compass:
        return []
    known = compass["after_flight"]
    if known is None:
        return [_para("  After the flight, all of it at once: nothing is known")]
    offsets, sigma = _triple(known["offsets_mg"], "+.1f"), _triple(known["sigma_mg"], ".1f")
    out = [f"  After the flight, all of it at once: offsets {offsets} mG (one sigma {sigma})"]
    if known["changes_s"]:
        out.append(f"    the iron changed at {', '.join(_number(t, '.1f') for t in known['changes_s'])} s of boot time")
    if known["heading"] is not None:
        out.append(f"    heading RMS with the iron of each moment: {_number(known['heading']['rms_deg'])} deg")
    return [_para(line) for line in out]


def _reference(compass: Json) -> str:
    return str((compass.get("heading") or {}).get("reference") or "")


def _rms(part: Any) -> str:
    value = (part or {}).get("heading_rms_deg")
    return UNKNOWN if value is None else f"{_number(value)} deg"


def _outcome(result: Any) -> str:
    return UNKNOWN if result is None else f"{_word(result)} ({RESULTS.get(str(result), 'unheard of')})"


def _changes(entry: Json) -> str:
    old, new = entry.get("old") or {}, entry.get("new") or {}
    names = list(dict.fromkeys((*old, *new)))
    return "\n".join(f"{n} {_number(old.get(n), 'g')} → {_number(new.get(n), 'g')}" for n in names) or UNKNOWN


def _when(unix_s: Any) -> str:
    if not isinstance(unix_s, int | float):
        return UNKNOWN
    return datetime.fromtimestamp(unix_s, UTC).strftime("%Y-%m-%d %H:%M:%S")


def _triple(values: Any, form: str) -> str:
    if values is None:
        return UNKNOWN
    return ", ".join(_number(_item(values, i), form) for i in range(3))


def _item(values: Any, index: int) -> Any:
    return values[index] if values is not None and index < len(values) else None


def _number(value: Any, form: str = ".2f") -> str:
    return format(value, form) if isinstance(value, int | float) else UNKNOWN


def _word(value: Any) -> str:
    return UNKNOWN if value is None else str(value)


def _counts(counts: Json) -> list[str]:
    """One line per part of the path that counted anything; a plain number stands under its own name."""
    out = []
    for name, count in counts.items():
        kinds = count if isinstance(count, Mapping) else {"": count}
        told = ", ".join(f"{_word(kind)} {_word(n)}".strip() for kind, n in kinds.items() if n)
        out += [f"{_word(name)}: {told}"] if told else []
    return out


def _para(text: str, style: str = "") -> RenderableType:
    """A paragraph that keeps its leading spaces on every line it is broken into."""
    return Padding(_line(text.lstrip(" "), style), (0, 0, 0, len(text) - len(text.lstrip(" "))))


def _line(text: str, style: str = "") -> Text:
    """Text as it stands. Names come off the wire and from files: no markup and no escape codes."""
    return Text("".join(c if c.isprintable() or c == "\n" else "?" for c in text), style=style)
