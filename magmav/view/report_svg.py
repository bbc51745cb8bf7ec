"""Small drawing of our own: a plot area with axes, lines, bands, dots and bars, as inline SVG.

A picture is 400 units wide, about a phone's width, so that its text is readable where the page is narrow and grows
with it elsewhere. What falls outside the plot area is cut off by it. Coordinates have one decimal, which is a tenth
of a phone's pixel and keeps the file small and its bytes the same everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

from magmav.view.report_page import Markup, tag

T = TypeVar("T")
Number = float | int | None
WIDTH = 400.0
INK, FAINT, GRID = "#1b1b1b", "#767676", "#e2e2e2"
BEFORE, AFTER, MODEL, SHADE = "#B84A00", "#0072B2", "#1b1b1b", "#d4d4d4"
AXIS_COLOURS = ("#00795A", "#9A6B00", "#9B3F83")
_FONT = 11.5


def finite(values: Iterable[Number] | None) -> list[float]:
    """The known ones."""
    return [float(v) for v in values or () if v is not None and math.isfinite(v)]


def spread(values: Sequence[float], share: float = 0.005) -> tuple[float, float]:
    """Lowest and highest but for this share at both ends: one wild reading must not flatten a picture."""
    if not values:
        return 0.0, 1.0
    ordered, cut = sorted(values), int(len(values) * share)
    return ordered[cut], ordered[-1 - cut]


def ticks(low: float, high: float, wanted: int = 4, bases: Sequence[float] = (1, 2, 5, 10)) -> list[float]:
    """Round values from low to high, about as many as wanted."""
    reach = max(high - low, 1e-9)
    power = 10.0 ** math.floor(math.log10(reach / wanted))
    step = next((b * power for b in bases if b * power * wanted >= reach), bases[-1] * power)
    first = math.ceil(low / step - 1e-9)
    return [i * step for i in range(first, math.floor(high / step + 1e-9) + 1)]


def label(value: float) -> str:
    """A tick's text, short."""
    return f"{value + 0.0:.6g}".replace("-", "\N{MINUS SIGN}")


@dataclass(slots=True)
class Panel:
    """One plot area. x and y are (low, high) in the data's own unit; the box is in units of the picture."""

    x: tuple[float, float]
    y: tuple[float, float]
    top: float = 8.0
    height: float = 170.0
    left: float = 50.0
    right: float = 388.0
    inside: list[Markup] = field(default_factory=list)
    outside: list[Markup] = field(default_factory=list)

    def at_x(self, x: float) -> float:
        """Within the plot area, from its left edge."""
        low, high = self.x
        return (x - low) / max(high - low, 1e-12) * (self.right - self.left)

    def at_y(self, y: float) -> float:
        """Within the plot area, from its upper edge."""
        low, high = self.y
        return (high - y) / max(high - low, 1e-12) * self.height

    def axes(
        self,
        x_ticks: Sequence[tuple[float, str]],
        y_ticks: Sequence[tuple[float, str]],
        x_name: str = "",
        y_name: str = "",
    ) -> None:
        """Grid, frame, the texts at the ticks and the names of both axes. Without x ticks no text stands below."""
        for value, shown in y_ticks:
            y = self.at_y(value)
            self.inside.append(rule(0.0, y, self.right - self.left, y, GRID, 0.8))
            self.outside.append(words(self.left - 5, self.top + y + 4, shown, "end"))
        for value, shown in x_ticks:
            x = self.at_x(value)
            self.inside.append(rule(x, 0.0, x, self.height, GRID, 0.8))
            self.outside.append(words(self.left + x, self.top + self.height + 14, shown, "middle"))
        foot = self.top + self.height
        self.outside.append(rule(self.left, foot, self.right, foot, FAINT, 1.0))
        self.outside.append(rule(self.left, self.top, self.left, foot, FAINT, 1.0))
        if x_name:
            self.outside.append(words((self.left + self.right) / 2, foot + 29, x_name, "middle"))
        if y_name:
            middle = self.top + self.height / 2
            turned = f"rotate(-90 11 {middle:.1f})"
            self.outside.append(words(11, middle, y_name, "middle", transform=turned))

    def right_axis(self, low: float, high: float, name: str) -> None:
        """Texts of a second scale at the right edge; low and high are what the plot's own edges mean on it."""
        for value in ticks(low, high, 3):
            y = self.top + (high - value) / max(high - low, 1e-12) * self.height
            self.outside.append(words(self.right + 5, y + 4, label(value), "start"))
        middle = self.top + self.height / 2
        self.outside.append(words(393, middle, name, "middle", transform=f"rotate(90 393 {middle:.1f})"))

    def line(
        self, xs: Sequence[Number], ys: Sequence[Number], colour: str, width: float = 1.6, dash: str | None = None
    ) -> None:
        """A stroke, broken where a value is not known."""
        path = "".join("M" + "L".join(f"{self.at_x(x):.1f} {self.at_y(y):.1f}" for x, y in run) for run in runs(xs, ys))
        if path:
            style = {"stroke": colour, "stroke_width": width, "stroke_dasharray": dash, "stroke_linejoin": "round"}
            self.inside.append(tag("path", d=path, fill="none", **style))

    def dots(self, xs: Sequence[Number], ys: Sequence[Number], colour: str, size: float = 2.4) -> None:
        """Dots, because a line would draw a stroke across the picture at every wrap."""
        path = "".join(f"M{self.at_x(x):.1f} {self.at_y(y):.1f}h0" for run in runs(xs, ys) for x, y in run)
        if path:
            self.inside.append(
                tag("path", d=path, fill="none", stroke=colour, stroke_width=size, stroke_linecap="round")
            )

    def band(
        self, xs: Sequence[Number], low: Sequence[Number], high: Sequence[Number], colour: str, opacity: float = 0.22
    ) -> None:
        """The area between two series."""
        for part in runs(xs, [None if a is None or b is None else (a, b) for a, b in zip(low, high, strict=True)]):
            upper = [f"{self.at_x(x):.1f} {self.at_y(pair[1]):.1f}" for x, pair in part]
            lower = [f"{self.at_x(x):.1f} {self.at_y(pair[0]):.1f}" for x, pair in reversed(part)]
            self.inside.append(tag("path", d="M" + "L".join(upper + lower) + "Z", fill=colour, fill_opacity=opacity))

    def span(self, low: float, high: float) -> None:
        """A grey strip from top to bottom, at least wide enough to be seen."""
        start = self.at_x(max(low, self.x[0]))
        width = max(self.at_x(min(high, self.x[1])) - start, 1.5)
        shape = {"x": f"{start:.1f}", "y": 0, "width": f"{width:.1f}", "height": f"{self.height:.1f}"}
        self.inside.append(tag("rect", fill=SHADE, fill_opacity=0.6, **shape))

    def drawn(self) -> list[Markup]:
        """The plot area, which cuts off what leaves it, and what stands around."""
        box = {
            "x": f"{self.left:.1f}",
            "y": f"{self.top:.1f}",
            "width": f"{self.right - self.left:.1f}",
            "height": f"{self.height:.1f}",
        }
        return [tag("svg", self.inside, overflow="hidden", **box), *self.outside]


def runs(xs: Sequence[Number], ys: Sequence[T | None]) -> list[list[tuple[float, T]]]:
    """Stretches without a gap."""
    out: list[list[tuple[float, T]]] = [[]]
    for x, y in zip(xs, ys, strict=False):
        if x is None or y is None or (isinstance(y, float) and not math.isfinite(y)):
            out.append([])
        else:
            out[-1].append((float(x), y))
    return [run for run in out if run]


def words(x: float, y: float, shown: str, anchor: str = "start", **more: object) -> Markup:
    """Text in a picture."""
    place = {"x": f"{x:.1f}", "y": f"{y:.1f}", "text_anchor": anchor, "font_size": _FONT, "fill": INK}
    return tag("text", shown, **place, **more)


def rule(x1: float, y1: float, x2: float, y2: float, colour: str, width: float, dash: str | None = None) -> Markup:
    """A straight line."""
    ends = {"x1": f"{x1:.1f}", "y1": f"{y1:.1f}", "x2": f"{x2:.1f}", "y2": f"{y2:.1f}"}
    return tag("line", **ends, stroke=colour, stroke_width=width, stroke_dasharray=dash)


def mark(x: float, y: float, kind: str, colour: str, size: float = 3.2) -> Markup:
    """A filled "circle" or an open "square": told apart without their colour."""
    if kind == "circle":
        return tag("circle", cx=f"{x:.1f}", cy=f"{y:.1f}", r=size, fill=colour)
    place = {"x": f"{x - size:.1f}", "y": f"{y - size:.1f}", "width": 2 * size, "height": 2 * size}
    return tag("rect", **place, fill="#fff", stroke=colour, stroke_width=1.6)


def swatch(draw: Callable[[], Iterable[Markup]], name: str) -> Markup:
    """One entry of a legend: a picture of 34 by 16 units, and its name."""
    return tag("li", tag("svg", draw(), viewBox="0 0 34 16", aria_hidden="true"), name)


def line_key(name: str, colour: str, dash: str | None = None, width: float = 2.4) -> Markup:
    """Legend of a line."""
    return swatch(lambda: [rule(1, 8, 33, 8, colour, width, dash)], name)


def dot_key(name: str, colour: str) -> Markup:
    """Legend of dots."""
    return swatch(lambda: [mark(x, 8, "circle", colour, 2.6) for x in (6, 17, 28)], name)


def area_key(name: str, colour: str, opacity: float) -> Markup:
    """Legend of an area."""
    return swatch(lambda: [tag("rect", x=1, y=1, width=32, height=14, fill=colour, fill_opacity=opacity)], name)


def picture(
    title: str, said: str, height: float, drawn: Iterable[Markup], keys: Sequence[Markup] = (), caption: str = ""
) -> Markup:
    """A figure: heading, legend, the drawing with ``said`` for those who do not see it, and the text below."""
    svg = tag(
        "svg",
        drawn,
        class_="picture",
        viewBox=f"0 0 {WIDTH:.0f} {height:.0f}",
        role="img",
        aria_label=f"{title}. {said}",
    )
    legend = tag("ul", list(keys), class_="legend") if keys else None
    return tag("figure", tag("h3", title), legend, svg, tag("figcaption", caption) if caption else None)
