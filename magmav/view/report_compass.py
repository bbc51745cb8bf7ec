"""The section of one compass: verdict, causes, what to do, values, how good they are, pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from magmav.view import report_charts as charts
from magmav.view.report_page import AXIS_NAMES, Child, Markup, bullets, exact, facts, number, table, tag, word
from magmav.view.report_words import AUTOPILOTS, AXES, lines, meaning, title_of, to_do

Json = Mapping[str, Any]

_WAYS = {
    "uncalibrated": "no calibration at all",
    "before": "as stored",
    "after": "new calibration",
    "full": "full model, iron of each moment",
}
_NAMES = (
    "state reasons causes advice device_id relative span_s cut old_offsets_mg new_offsets_mg change_mg sigma_mg axes "
    "hard_iron_mg hard_iron_at soft_iron motor scale changes_s parameters residual_mg heading mounting odd_one_out "
    "deviation coverage series"
)
_SHOWN = frozenset(_NAMES.split())  # what comes new into a fit is shown by its own name
_PARTS = {"soft_iron": "soft iron", "motor": "motor and current", "scale": "scale"}


def compass_section(vehicle: Json, compass: Json, anchor: str, first: bool) -> Markup:
    """Everything about one compass. anchor: the id links point at; first: the first of the page."""
    fit = compass.get("fit")
    device = (fit or {}).get("device_id") or compass.get("device_id")
    name = f"Compass {word(compass.get('compass'))} of system {word(vehicle.get('system'))}"
    return tag(
        "section",
        tag("h2", f"{name}, device {word(device)}"),
        _verdict(compass),
        () if fit is None else _of_fit(fit),
        _recorded(compass),
        id=anchor,
        class_="compass first" if first else "compass",
    )


def _verdict(compass: Json) -> Markup:
    told = compass.get("fit") or compass
    state = str(told.get("state"))
    style = state if state in ("READY", "LEARNING", "REFUSED", "NO_DATA") else "NO_DATA"
    parts: list[Child] = [tag("p", tag("strong", title_of(told.get("state")), "."), " ", " ".join(meaning(compass)))]
    for title, found in (
        ("Why", bullets(lines(told.get("reasons")))),
        ("What is wrong, and by which figure", bullets(lines(told.get("causes")))),
        ("What to do", bullets(to_do(compass))),
    ):
        if found is not None:
            parts += [tag("h3", title), found]
    return tag("div", parts, class_=f"verdict {style}")


def _of_fit(fit: Json) -> list[Child]:
    series, cut = fit.get("series") or {}, fit.get("cut") or []
    heading = fit.get("heading") or {}
    pictures = [
        charts.deviation(fit.get("deviation") or []),
        tag("div", _card(fit.get("deviation") or [])),
        charts.coverage(fit.get("coverage") or {}),
        charts.field(series, cut),
        charts.heading(series, cut, heading.get("reference")),
        charts.offsets(series, cut, None if fit.get("hard_iron_at") == "zero power" else fit.get("hard_iron_mg")),
    ]
    return [
        tag(
            "div",
            tag("div", _values(fit)),
            tag("div", _parameters(fit.get("parameters") or {})),
            tag("div", _misfit(fit)),
            tag("div", _heading(fit.get("heading"))),
            class_="pair",
        ),
        tag("div", pictures, class_="pictures"),
        tag("div", _spans(fit), class_="whole"),
        tag("div", _beyond(fit), class_="whole"),
    ]


def _values(fit: Json) -> list[Child]:
    rows: list[Sequence[Child]] = [
        (name, *(number(_item(fit.get(key), i), form) for i in range(3))) for name, key, form in _ROWS
    ]
    axes = [word(_item(fit.get("axes"), i)) for i in range(3)]
    rows.append(("how it is known", *(tag("span", AXES.get(axis, axis)) for axis in axes)))
    note = (
        "Body axes, mG, as ArduPilot would add them. Hard iron is what the sensor itself carries, at "
        f"{word(fit.get('hard_iron_at'))}, and is subtracted."
    )
    if fit.get("relative"):
        note += " Relative: add the change to what is stored; the values to store are not known."
    return [tag("h3", "Offsets"), table(("mG", *AXIS_NAMES), rows), tag("p", note, class_="quiet")]


_ROWS = (
    ("stored", "old_offsets_mg", ".1f"),
    ("new", "new_offsets_mg", ".1f"),
    ("change", "change_mg", "+.1f"),
    ("one sigma", "sigma_mg", ".1f"),
    ("hard iron", "hard_iron_mg", ".1f"),
)


def _parameters(named: Json) -> list[Child]:
    old, new, changed = (named.get(k) or {} for k in ("old", "new", "changed"))
    names = list(dict.fromkeys((*new, *changed, *old)))
    kind = str(named.get("autopilot"))
    kind = {name.lower(): name for name in AUTOPILOTS.values()}.get(kind, word(named.get("autopilot")))
    title = tag("h3", f"Parameters of the autopilot ({kind})")
    closure = number(named.get("closure_mg"), ".3g", "mG")
    proof = tag(
        "p", f"With these the autopilot makes the field that the fit foretells, within {closure}.", class_="quiet"
    )
    if not names:
        return [title, tag("p", "No parameter is to be changed, or which ones belong to this compass is not known.")]
    rows = [
        (n, exact(old.get(n)), exact(new.get(n)), tag("span", _write(n, old.get(n), new.get(n), changed)))
        for n in names
    ]
    whole = table(("parameter", "stored", "new", ""), rows, changed=[n in changed for n in names])
    return [title, whole, proof if named.get("closure_mg") is not None else None]


def _write(name: str, old: Any, new: Any, changed: Json) -> str:
    if name not in changed:
        return "stays" if old == new else "do not write"
    return "write" if changed[name] == new else f"write {exact(changed[name])}"


def _misfit(fit: Json) -> list[Child]:
    left = fit.get("residual_mg") or {}
    rows = [
        (name, number(left.get(f"{part}before"), ".2f"), number(left.get(f"{part}after"), ".2f"))
        for name, part in (("all that was used", ""), ("held out: not seen by its fit", "held_out_"))
    ]
    return [tag("h3", "Misfit of the field, RMS, mG"), table(("samples", "as stored", "new"), rows)]


def _heading(heading: Json | None) -> list[Child]:
    if not heading:
        title = tag("h3", "Heading error")
        return [title, tag("p", "Heading error: not known, there is no reference to measure it against.")]
    held = heading.get("held_out") or {}
    scores = [(_WAYS.get(k, k), v) for k, v in heading.items() if isinstance(v, Mapping) and "rms_deg" in v]
    scores += [(f"held out: {_WAYS.get(k, k)}", v) for k, v in held.items() if isinstance(v, Mapping)]
    rows = [
        (name, number(s.get("rms_deg"), ".2f"), number(s.get("p95_deg"), ".2f"), number(s.get("n"), "d"))
        for name, s in scores
    ]
    reference = word(heading.get("reference"))
    how = f"Held out: {held['how']}." if held.get("how") else "No part of the flight was held out."
    left_out = ", ".join(f"{word(k)} {word(n)}" for k, n in (heading.get("excluded") or {}).items() if n)
    how += f" Samples left out of the score: {left_out}." if left_out else ""
    if reference.startswith("ATTITUDE"):
        how += " Yaw of an autopilot usually follows its own compass: agreeing with it proves little."
    head = ("calibration", "RMS", "95 % within", "samples")
    title = tag("h3", f"Heading error against {reference}, degrees")
    return [title, table(head, rows), tag("p", how, class_="quiet")]


def _card(card: Sequence[Json]) -> list[Child]:
    if not card:
        return [tag("p", "Deviation card: not known, so little level field is left that no heading shows.")]
    rows = []
    for i, row in enumerate(card):
        after, sigma = row.get("after_deg"), row.get("sigma_deg")
        told = number(after, "+.2f") if sigma is None else f"{number(after, '+.2f')} \u00b1 {number(sigma, '.2f')}"
        heading = f"{charts.POINTS[i % 8]} {number(row.get('heading_deg'), '.0f')}"
        rows.append((heading, number(row.get("before_deg"), "+.2f"), told))
    note = "Level vehicle: heading shown less the heading it is on, degrees, with one sigma of the new."
    return [
        table(("heading", "as stored", "new"), rows, "Deviation card, figures"),
        tag("p", note, class_="quiet"),
    ]


def _spans(fit: Json) -> list[Child]:
    span = fit.get("span_s") or (None, None)
    used = f"Samples from {number(_item(span, 0), '.1f')} to {number(_item(span, 1), '.1f')} s since boot were used."
    cut = fit.get("cut") or []
    out: list[Child] = [tag("h3", "Time span"), tag("p", used, None if cut else " Nothing inside was left out.")]
    if cut:
        rows = [
            (
                f"{number(c.get('from_s'), '.1f')} to {number(c.get('to_s'), '.1f')}",
                tag("span", f"{word(c.get('text'))} ({word(c.get('code'))})"),
            )
            for c in cut
        ]
        out.append(table(("left out, s", tag("span", "why")), rows))
    changes = fit.get("changes_s")
    if changes:
        told = ", ".join(number(t, ".1f") for t in changes)
        out.append(tag("p", f"The iron on board changed at {told} s: the answer is that of what came after."))
    return out


def _beyond(fit: Json) -> list[Child]:
    """Mounting, and what was asked for beyond offsets."""
    mounting = fit.get("mounting") or {}
    found = mounting.get("found")
    told = "no error found"
    if found:
        turn, rotation = number(found.get("angle_deg"), ".1f"), word(found.get("rotation"))
        told = f"{word(found.get('text'))}: {turn} degrees, as rotation {rotation}"
        told += "".join(f"; {k}: {word(v)}" for k, v in found.items() if k not in ("text", "angle_deg", "rotation"))
    pairs: list[tuple[str, Child]] = [
        ("mounting", told),
        ("orientation stored", word(mounting.get("stored_orientation"))),
        ("the bad one on board", "yes, of the compasses it fits the motion worst" if fit.get("odd_one_out") else "no"),
    ]
    pairs += [(name, _part(fit.get(key))) for key, name in _PARTS.items()]
    pairs += [(key.replace("_", " "), word(value)) for key, value in fit.items() if key not in _SHOWN]
    return [tag("h3", "Mounting and terms beyond offsets"), facts(pairs)]


def _part(part: Any) -> str:
    """Asked and earned first, because a term that is not both is not used."""
    if not isinstance(part, Mapping):
        return "not fitted"
    asked, earned = (part.get(k) for k in ("asked", "earned"))
    told = f"{'asked for' if asked else 'not asked for'}, {'earned' if earned else 'not earned'}"
    told += ", used" if asked and earned else ", not used"
    rest = "; ".join(f"{k.replace('_', ' ')}: {word(v)}" for k, v in part.items() if k not in ("asked", "earned"))
    return f"{told}. {rest}"


def _recorded(compass: Json) -> list[Child]:
    """The rest of the entry; offsets and heading only where no fit has said them already."""
    pairs: list[tuple[str, Child]] = []
    if compass.get("fit") is None:
        offsets, sigma, heading = (compass.get(k) for k in ("offsets_mg", "sigma_mg", "heading"))
        pairs.append(("offsets known in flight, mG", _three(offsets, sigma)))
        if heading and heading.get("reference") is not None:
            told = f"{number(heading.get('rms_deg'), '.2f')} deg RMS, as known in flight"
            pairs.append((f"heading against {word(heading['reference'])}", told))
    pairs.append(("samples", f"{word(compass.get('samples'))}, {word(compass.get('samples_learnt'))} of them taught"))
    if compass.get("delay_s") is not None:
        pairs.append(("field against attitude", f"{number(compass['delay_s'], '+.3f')} s late"))
    stored = compass.get("stored") or {}
    pairs.append(("the autopilot held", ", ".join(f"{k} {exact(v)}" for k, v in stored.items()) or word(None)))
    return [tag("h3", "From the recording"), facts(pairs)]


def _three(values: Any, sigmas: Any) -> str:
    if values is None:
        return word(None)
    out = []
    for i, name in enumerate("xyz"):
        sigma = _item(sigmas, i)
        out.append(f"{name} {number(_item(values, i))}" + ("" if sigma is None else f" \u00b1 {number(sigma)}"))
    return ", ".join(out)


def _item(values: Any, index: int) -> Any:
    return values[index] if values is not None and index < len(values) else None
