"""The five pictures of a compass: deviation, coverage, field over time, offsets over time, heading over time.

Each says in words what it shows, for those who do not see it, and each has its figures in a table or a caption too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from magmav.view.report_page import AXIS_NAMES, Markup, number, tag
from magmav.view.report_svg import (
    AFTER,
    AXIS_COLOURS,
    BEFORE,
    FAINT,
    INK,
    MODEL,
    SHADE,
    Number,
    Panel,
    area_key,
    dot_key,
    finite,
    label,
    line_key,
    mark,
    picture,
    rule,
    spread,
    swatch,
    ticks,
    words,
)

Json = Mapping[str, Any]
POINTS = ("N", "NE", "E", "SE", "S", "SW", "W", "NW")
_MINUTES_FROM_S = 1200.0
_POWER = "#7A52A3"
_TURNS = (1.0, 1.5, 3.0, 4.5, 9.0, 10.0)  # 45 and 90 degrees are round


def deviation(card: Sequence[Json]) -> Markup | None:
    """Heading error on eight headings, before and after, with one sigma."""
    if not card:
        return None
    befores, afters = finite(r.get("before_deg") for r in card), finite(r.get("after_deg") for r in card)
    reach = max((abs(v) for v in befores + afters), default=0.0)
    limit = float(next((v for v in (2, 5, 10, 20, 45, 90) if v >= reach * 1.05), 180))
    panel = Panel((-0.4, len(card) - 0.6), (-limit, limit))
    tall = [(v, label(v)) for v in ticks(-limit, limit, 4, _TURNS if limit >= 45 else (1, 2, 5, 10))]
    panel.axes([(i, POINTS[i % 8]) for i in range(len(card))], tall, "heading", "shown less true, deg")
    zero = panel.at_y(0.0)
    panel.inside.append(rule(0.0, zero, panel.right, zero, INK, 1.0))
    place = list(range(len(card)))
    panel.line(place, [r.get("before_deg") for r in card], BEFORE, 1.4, "5 3")
    panel.line(place, [r.get("after_deg") for r in card], AFTER)
    for i, row in enumerate(card):
        x, after, sigma = panel.at_x(i), row.get("after_deg"), row.get("sigma_deg")
        if row.get("before_deg") is not None:
            panel.inside.append(mark(x, panel.at_y(row["before_deg"]), "square", BEFORE))
        if after is not None:
            if sigma is not None:
                panel.inside.append(rule(x, panel.at_y(after - sigma), x, panel.at_y(after + sigma), AFTER, 1.6))
            panel.inside.append(mark(x, panel.at_y(after), "circle", AFTER))
    said = f"Heading error on eight headings: largest {_largest(befores)} before and {_largest(afters)} after."
    keys = [
        swatch(lambda: [rule(1, 8, 33, 8, BEFORE, 1.6, "5 3"), mark(17, 8, "square", BEFORE)], "as stored"),
        swatch(lambda: [rule(1, 8, 33, 8, AFTER, 1.8), mark(17, 8, "circle", AFTER)], "new calibration, one sigma"),
    ]
    return picture("Deviation card", said, 212, panel.drawn(), keys, said)


def _largest(values: Sequence[float]) -> str:
    return number(max((abs(v) for v in values), default=None), ".1f", "deg")


def coverage(seen: Json) -> Markup | None:
    """Which directions of the field, in body axes, were seen: two discs, forward up, right on the right."""
    told = seen.get("directions") or ()
    rows = [r for r in told if None not in (r.get("n"), r.get("azimuth_deg"), r.get("elevation_deg"))]
    if not rows:
        return None
    most = max((r["n"] for r in rows), default=0)
    drawn: list[Markup] = []
    for middle, name, half in ((104.0, "field points down", 1), (296.0, "field points up", -1)):
        drawn.append(tag("circle", cx=middle, cy=112, r=84, fill="none", stroke=FAINT, stroke_width=1))
        drawn += [words(middle, 22, "forward", "middle"), words(middle, 214, name, "middle")]
        drawn.append(rule(middle, 28, middle, 196, FAINT, 0.5, "2 3"))
        drawn.append(rule(middle - 84, 112, middle + 84, 112, FAINT, 0.5, "2 3"))
        for row in rows:
            if (row["elevation_deg"] >= 0.0) != (half > 0):
                continue
            out = 84 * math.sqrt(2.0) * math.sin(math.radians(90.0 - abs(row["elevation_deg"])) / 2.0)
            turn = math.radians(row["azimuth_deg"])
            x, y = middle + out * math.sin(turn), 112 - out * math.cos(turn)
            if row["n"]:
                size = 3.0 + 5.5 * math.sqrt(row["n"] / most)
                drawn.append(tag("circle", cx=f"{x:.1f}", cy=f"{y:.1f}", r=f"{size:.1f}", fill=AFTER, fill_opacity=0.8))
            else:
                drawn.append(mark(x, y, "square", FAINT, 2.0))
    share = seen.get("share")
    hit = sum(1 for r in rows if r["n"])
    part = number(None if share is None else 100.0 * share, ".1f", "%")
    total = sum(r["n"] for r in rows)
    said = (
        f"{hit} of {len(rows)} directions seen, {part} of the sphere, {total} samples, at most {most} in one direction."
    )
    keys = [
        swatch(lambda: [mark(8, 8, "circle", AFTER, 3), mark(24, 8, "circle", AFTER, 7)], "seen, larger is more"),
        swatch(lambda: [mark(17, 8, "square", FAINT, 2.5)], "never seen"),
    ]
    caption = f"{said} Seen from above the vehicle, right on the right. A level flight can only show a ring."
    return picture("Coverage in body axes", said, 222, drawn, keys, caption)


def field(series: Json, cut: Sequence[Json]) -> Markup | None:
    """Length of the field before and after against the model, with current or throttle on the right."""
    times = series.get("t_s") or []
    before, after = _of(series, "field_before_mg", times), _of(series, "field_after_mg", times)
    model = _of(series, "model_mg", times)
    if not finite(before + after):
        return None
    ranges = [spread(v) for v in (finite(before), finite(after), finite(model)) if v]
    low, high = min(r[0] for r in ranges), max(r[1] for r in ranges)
    room = max(0.08 * (high - low), 10.0)
    panel = Panel(_reach(times), (max(low - room, 0.0), high + room))
    power, name, unit = _power(series, times)
    if power:
        panel.right = 352.0
    across, x_name, spans = _time_axis(panel)
    panel.axes(across, [(v, label(v)) for v in ticks(*panel.y)], x_name, "field, mG")
    _shade(panel, cut)
    if power:
        top = max(finite(power)) * 1.05 or 1.0
        scaled = [None if p is None else panel.y[0] + p / top * (panel.y[1] - panel.y[0]) for p in power]
        panel.band(times, [panel.y[0]] * len(times), scaled, _POWER, 0.3)
        panel.right_axis(0.0, top, f"{name}, {unit}" if unit else name)
    panel.line(times, before, BEFORE, 1.2)
    panel.line(times, after, AFTER, 1.4)
    panel.line(times, model, MODEL, 1.6, "6 4")
    said = f"Field length over {spans}: " + "; ".join(
        f"{told} {number(spread(known, 0.05)[0], '.1f')} to {number(spread(known, 0.05)[1], '.1f')} mG"
        for told, known in (("before", finite(before)), ("after", finite(after)), ("model", finite(model)))
        if known
    )
    said += (
        f"; {name} {number(min(finite(power)), '.3g')} to {number(max(finite(power)), '.3g', unit)}." if power else "."
    )
    keys = [line_key("as stored", BEFORE), line_key("new calibration", AFTER)] if finite(before) else []
    keys = keys or [line_key("new calibration", AFTER)]
    keys += [line_key("field model", MODEL, "6 4")] if finite(model) else []
    keys += [area_key(f"{name}, on the right", _POWER, 0.4)] if power else []
    keys += _cut_key(cut)
    return picture("Length of the field", said, 212, panel.drawn(), keys, f"{said} The middle 90 % of each.")


def _power(series: Json, times: Sequence[Number]) -> tuple[list[Number], str, str]:
    """Current where known, else throttle; its name and unit."""
    for key, name, unit in (("current_a", "current", "A"), ("throttle", "throttle", "")):
        values = _of(series, key, times)
        if finite(values):
            return values, name, unit
    return [], "", ""


def offsets(series: Json, cut: Sequence[Json], iron_mg: Sequence[Number] | None) -> Markup | None:
    """Three narrow plots, one an axis, each with a scale of its own: value and one sigma.

    iron_mg : the fit's hard iron, whose negative is drawn across.
    """
    times = series.get("offsets_t_s") or []
    values, sigmas = series.get("offsets_mg") or [], series.get("offsets_sigma_mg") or []
    if not times or len(values) != len(times):
        return None
    panels, told = [], []
    for i, name in enumerate(AXIS_NAMES):
        value = [_at(row, i) for row in values]
        sigma = [_at(row, i) for row in sigmas] if len(sigmas) == len(times) else [None] * len(times)
        known = finite(value)
        low, high = spread(known, 0.01)
        wide = spread(finite(sigma), 0.5)[0] if finite(sigma) else 0.0
        room = max(0.15 * (high - low), 2.5 * wide, 3.0)
        panel = Panel(_reach(times), (low - room, high + room), top=22.0 + 88.0 * i, height=64.0)
        across, x_name, _ = _time_axis(panel)
        panel.axes(across if i == 2 else [], [(v, label(v)) for v in ticks(*panel.y, 3)], x_name if i == 2 else "")
        _shade(panel, cut)
        iron = _at(iron_mg or (), i)
        if iron is not None:
            y = panel.at_y(-iron)
            panel.inside.append(rule(0.0, y, panel.right, y, INK, 1.0, "2 3"))
        edges = [(None, None) if v is None or s is None else (v - s, v + s) for v, s in zip(value, sigma, strict=True)]
        panel.band(times, [e[0] for e in edges], [e[1] for e in edges], AXIS_COLOURS[i], 0.3)
        panel.line(times, value, AXIS_COLOURS[i], 1.8)
        panel.outside.append(words(panel.left, panel.top - 5, f"{name}, mG", font_weight="bold"))
        panels += panel.drawn()
        last = [v for v in sigma if v is not None][-1:]
        end = f"{number(known[-1], '.1f')} mG" if known else "not known"
        told.append(f"{name} ends at {end}" + (f" \u00b1 {number(last[0])}" if last and known else ""))
    said = "Offsets of each moment: " + ", ".join(told) + "."
    keys = [
        swatch(_banded, "offset of the moment, one sigma"),
        *([line_key("the fit's answer", INK, "2 3", 1.6)] if iron_mg else []),
        *_cut_key(cut),
    ]
    caption = f"{said} All of the flight is solved at once, so that each moment knows what came later too. "
    caption += "Without soft iron, at the power of the moment: the values to store are in the table of offsets."
    return picture("Offsets over time", said, 302, panels, keys, caption)


def _banded() -> list[Markup]:
    area = tag("rect", x=1, y=2, width=32, height=12, fill=AXIS_COLOURS[0], fill_opacity=0.3)
    return [area, rule(1, 8, 33, 8, AXIS_COLOURS[0], 2.0)]


def heading(series: Json, cut: Sequence[Json], reference: str | None) -> Markup | None:
    """The corrected heading and the reference, and below it how far they are apart."""
    times = series.get("t_s") or []
    ours, theirs = _of(series, "heading_deg", times), _of(series, "reference_deg", times)
    if not finite(ours):
        return None
    upper = Panel(_reach(times), (0.0, 360.0), height=128.0)
    across, x_name, spans = _time_axis(upper)
    both = bool(finite(theirs)) and reference is not None
    north = [(float(v), n) for v, n in ((0, "N"), (90, "E"), (180, "S"), (270, "W"), (360, "N"))]
    upper.axes([] if both else across, north, "" if both else x_name, "true heading")
    _shade(upper, cut)
    drawn, said, height = upper, f"Corrected heading over {spans}", 172.0
    keys = [dot_key("new calibration", AFTER)]
    more: list[Markup] = []
    if both:
        upper.dots(times, theirs, BEFORE, 3.4)
        pairs = zip(ours, theirs, strict=True)
        apart = [None if a is None or b is None else (a - b + 180.0) % 360.0 - 180.0 for a, b in pairs]
        fitted = finite(a for t, a in zip(times, apart, strict=True) if not _is_cut(t, cut))
        size = spread([abs(v) for v in fitted], 0.02)[1]
        limit = float(next((v for v in (2, 5, 10, 20, 45, 90) if v >= size), 180))
        lower = Panel(upper.x, (-limit, limit), top=152.0, height=84.0)
        steps = [(v, label(v)) for v in ticks(-limit, limit, 4, _TURNS if limit >= 45 else (1, 2, 5, 10))]
        lower.axes(across, steps, x_name, "apart, deg")
        _shade(lower, cut)
        zero = lower.at_y(0.0)
        lower.inside.append(rule(0.0, zero, lower.right, zero, INK, 1.0))
        lower.dots(times, apart, AFTER)
        more, height = lower.drawn(), 278.0
        keys.insert(0, dot_key(f"reference: {reference}", BEFORE))
        said += f" against {reference}: 95 % of the points that were not left out are within {_within(fitted)} of it"
    upper.dots(times, ours, AFTER)
    keys += _cut_key(cut)
    return picture("Heading", f"{said}.", height, [*drawn.drawn(), *more], keys, f"{said}.")


def _within(apart: Sequence[float]) -> str:
    ordered = sorted(abs(v) for v in apart)
    return number(ordered[int(0.95 * (len(ordered) - 1))] if ordered else None, ".1f", "deg")


def _of(series: Json, key: str, times: Sequence[Number]) -> list[Number]:
    """One series of the length of its times; all unknown where it is missing."""
    values = series.get(key)
    return list(values) if values is not None and len(values) == len(times) else [None] * len(times)


def _at(row: Sequence[Number], i: int) -> Number:
    value = row[i] if i < len(row) else None
    return value if value is not None and math.isfinite(value) else None


def _reach(times: Sequence[Number]) -> tuple[float, float]:
    known = finite(times)
    return (known[0], max(known[-1], known[0] + 1.0)) if known else (0.0, 1.0)


def _time_axis(panel: Panel) -> tuple[list[tuple[float, str]], str, str]:
    """Ticks, the axis's name, and the stretch in words: seconds, or minutes where that is long."""
    low, high = panel.x
    span = f"{number(low, '.0f')} to {number(high, '.0f')} s"
    if high - low < _MINUTES_FROM_S:
        return [(v, label(v)) for v in ticks(low, high, 5)], "time since boot, s", span
    minutes = ticks(low / 60.0, high / 60.0, 5)
    return [(60.0 * v, label(v)) for v in minutes], "time since boot, min", span


def _shade(panel: Panel, cut: Sequence[Json]) -> None:
    for part in cut:
        if None not in (part.get("from_s"), part.get("to_s")):
            panel.span(part["from_s"], part["to_s"])


def _is_cut(time: Number, cut: Sequence[Json]) -> bool:
    return time is None or any(c["from_s"] <= time <= c["to_s"] for c in cut if None not in (c["from_s"], c["to_s"]))


def _cut_key(cut: Sequence[Json]) -> list[Markup]:
    return [area_key("left out of the fit", SHADE, 0.6)] if cut else []
