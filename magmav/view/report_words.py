"""The verdict in plain words: what the state means for whoever owns the vehicle, and what to do next."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from magmav.view.report_page import UNKNOWN, Markup, join, number, tag, word

Json = Mapping[str, Any]

STATES = {
    "READY": "Ready",
    "LEARNING": "Not ready yet",
    "REFUSED": "Refused",
    "NO_DATA": "No data",
}
_MEANS = {
    "READY": "This flight shows what the compass should have stored.",
    "LEARNING": "This flight does not show enough. Do not store these offsets.",
    "REFUSED": "These offsets must not be stored before what is listed here is settled.",
    "NO_DATA": "Nothing was heard from this compass that could be used.",
}
_DO = {
    "READY": "On the ground and disarmed, store the changed parameters below (magmav upload, or the parameter file in "
    "a ground station).",
    "LEARNING": "Fly again: turn through all headings, and tilt where that is safe. Then fit that log, or both.",
    "REFUSED": "See the causes, mend what they name, fly again and fit again.",
    "NO_DATA": "See that the compass is plugged in and switched on, and that the log or stream holds its readings.",
}
_AFTERWARDS = (
    "After any change: restart the autopilot, wait until it has settled, and check the heading against a direction you "
    "know before the next take-off."
)
AXES = {"OBSERVED": "shown by motion", "FROM_MODEL": "from the field model", "NOT_OBSERVED": "not shown, left as it is"}
AUTOPILOTS = {3: "ArduPilot", 12: "PX4"}  # MAV_AUTOPILOT


def title_of(state: Any) -> str:
    """The state, for people."""
    return STATES.get(str(state), word(state))


def meaning(compass: Json) -> list[str]:
    """One sentence a thing: the state, what it does to the heading, and what hangs over it."""
    fit = compass.get("fit")
    if fit is None:
        return [_MEANS["NO_DATA"] if compass.get("state") == "NO_DATA" else "Nothing was learnt from this log."]
    out = [_MEANS.get(str(fit.get("state")), "")]
    out += [heading_sentence(fit)]
    if fit.get("relative"):
        out.append(
            "What the autopilot had stored is not in the log: the figures are a change to that, no values to store."
        )
    if fit.get("odd_one_out"):
        out.append("Of the compasses on board this is the one that does not fit the motion.")
    return [sentence for sentence in out if sentence]


def heading_sentence(fit: Json) -> str:
    """From what to what the heading error goes, on what the fit did not see where that is known."""
    heading = fit.get("heading")
    if not heading:
        return "How far the heading is off is not known: the log holds no reference to measure it against."
    held = heading.get("held_out") or {}
    part, where = (held, "on the part of the flight that the fit did not see") if held.get("after") else (heading, "")
    before, after = ((part.get(k) or {}).get("rms_deg") for k in ("before", "after"))
    against = f"against {word(heading.get('reference'))}"
    if after is None:
        return f"How far the heading is off {against} is not known."
    if before is None:
        return f"Heading error {against}: {number(after, '.1f', 'deg')} RMS {where}".rstrip() + "."
    verb = "falls" if _falls(fit) else "does not fall: it goes"
    change = f"from {number(before, '.1f')} to {number(after, '.1f')} degrees RMS"
    return f"Heading error {against} {verb} {change} {where}".rstrip() + "."


def _falls(fit: Json) -> bool:
    """True where the heading gets better, or that is not known."""
    heading = fit.get("heading") or {}
    held = heading.get("held_out") or {}
    part = held if held.get("after") else heading
    before, after = ((part.get(k) or {}).get("rms_deg") for k in ("before", "after"))
    return before is None or after is None or after < before


def to_do(compass: Json) -> list[str]:
    """Advice of the fit, else what the state asks for; where something is to be written, what comes after (S20)."""
    fit = compass.get("fit")
    state = str((fit or compass).get("state"))
    writes = state == "READY" and bool(((fit or {}).get("parameters") or {}).get("changed"))
    advice = [str(line) for line in (fit or {}).get("advice") or () if line] or _asked(fit, state, writes)
    return [*advice, _AFTERWARDS] if writes else advice


def _asked(fit: Json | None, state: str, writes: bool) -> list[str]:
    if state == "READY" and fit is None:
        return [_DO["LEARNING"]]
    if state == "READY" and fit is not None and not _falls(fit):
        return ["What is stored does as well on the part that was held out: there is no need to change it."]
    if state == "READY" and not writes:
        return ["Nothing: what is stored fits, or which parameters belong to this compass is not known."]
    return [_DO[state]] if state in _DO else []


def autopilot_name(vehicle: Json) -> str:
    """ArduPilot, PX4, or its number."""
    kind = vehicle.get("autopilot")
    if kind is None:
        return f"autopilot {UNKNOWN}"
    return AUTOPILOTS.get(kind, f"autopilot {word(kind)}") if isinstance(kind, int) else word(kind)


def lines(items: Any) -> list[Markup]:
    """Reasons or causes; the code, by which the docs explain them, and the figures in small letters."""
    out = []
    for item in filter(None, items or ()):
        figure = item.get("figure")
        more = f": {word(figure)}" if figure else ""
        code = tag("span", f"({word(item.get('code'))}{more})", class_="quiet")
        out.append(join((word(item.get("text")), " ", code)))
    return out
