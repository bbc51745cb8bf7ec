"""HTML that is safe by construction: text from logs is escaped where it enters, tags are made here and nowhere else.

A page is one file. It holds no script and names no address, and its own policy forbids the browser both, so that it
can be mailed, opened on a field without network, and read in ten years.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

import numpy as np

UNKNOWN = "not known"
AXIS_NAMES = ("x forward", "y right", "z down")

# Contrast on white: text 4.5 to 1 or more, lines and marks 3 to 1 or more.
CSS = """
:root{color-scheme:light}
*{box-sizing:border-box}
html{-webkit-text-size-adjust:100%;text-size-adjust:100%}
body{margin:0 auto;max-width:72rem;padding:1rem;background:#fff;color:#1b1b1b;
 font:16px/1.45 system-ui,-apple-system,"Segoe UI",Roboto,"Liberation Sans",Arial,sans-serif;overflow-wrap:anywhere}
h1{font-size:1.5rem;line-height:1.2;margin:.2rem 0 .4rem}
h2{font-size:1.25rem;margin:2rem 0 .5rem;padding-top:.5rem;border-top:2px solid #1b1b1b}
h3{font-size:1.02rem;margin:1.3rem 0 .3rem}
p,ul,ol,dl{margin:.4rem 0}
ul,ol{padding-left:1.3rem}
li{margin:.15rem 0}
a{color:#00508a}
.quiet{color:#4a4a4a}
span.quiet{font-size:.86rem}
.verdict{border:1px solid #767676;border-left:.5rem solid #767676;padding:.6rem .8rem;margin:.6rem 0}
.verdict>p:first-child{margin-top:0}
.verdict strong{font-size:1.1rem}
.READY{border-left-color:#007a3d}.LEARNING{border-left-color:#a15c00}
.REFUSED,.NO_DATA{border-left-color:#b3261e}
.wide{overflow-x:auto}
table{border-collapse:collapse;margin:.4rem 0;font-size:.94rem;font-variant-numeric:tabular-nums;overflow-wrap:normal}
caption{text-align:left;font-weight:600;padding:.2rem 0}
th,td{padding:.22rem .8rem .22rem 0;text-align:right;vertical-align:top;border-bottom:1px solid #d0d0d0}
th:first-child,td:first-child,td.word,th.word{text-align:left}
th:last-child,td:last-child{padding-right:.1rem}
thead th{border-bottom:2px solid #767676;vertical-align:bottom;white-space:normal}
tbody th{font-weight:400}
tr.changed td,tr.changed th{font-weight:650}
td.word{white-space:normal;overflow-wrap:anywhere}
.pair{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(23rem,100%),1fr));gap:0 1.6rem}
.pair>div{min-width:0}
.pictures{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(24rem,100%),1fr));gap:1rem 1.6rem}
figure{margin:.6rem 0 0;min-width:0}
figcaption{font-size:.9rem;color:#4a4a4a}
figure h3{margin:.2rem 0}
svg.picture{display:block;width:100%;height:auto}
.legend{list-style:none;padding:0;margin:.1rem 0;font-size:.88rem;display:flex;flex-wrap:wrap;gap:.1rem .9rem}
.legend li{margin:0}
.legend svg{width:1.7rem;height:.8rem;vertical-align:-.05rem;margin-right:.3rem}
.facts{display:grid;grid-template-columns:minmax(7.5rem,max-content) 1fr;gap:.1rem .9rem;font-size:.94rem}
.facts dt{color:#4a4a4a}.facts dd{margin:0}
details{margin:.8rem 0}
summary{cursor:pointer;padding:.3rem 0}
pre{font-size:.78rem;white-space:pre-wrap;overflow-wrap:anywhere;background:#f6f6f6;padding:.6rem;max-height:60vh;
 overflow:auto}
@media (max-width:30rem){body{padding:.75rem}th,td{padding-right:.5rem;font-size:.86rem}h1{font-size:1.3rem}
 .facts{grid-template-columns:1fr}.facts dd{margin-bottom:.3rem}}
@media print{@page{size:A4;margin:14mm}body{max-width:none;padding:0;font-size:10.5pt}
 .pictures{grid-template-columns:1fr 1fr;gap:.6rem 1.2rem}
 figure,table,.verdict,.whole,tr{break-inside:avoid}h2,h3,caption{break-after:avoid}
 section.compass{break-before:page}section.compass.first{break-before:auto}
 .wide{overflow:visible}a{color:inherit;text-decoration:none}.screen{display:none}
 *{-webkit-print-color-adjust:exact;print-color-adjust:exact}}
"""
_POLICY = "default-src 'none'; style-src 'unsafe-inline'"


class Markup(str):
    """Text that already is HTML. Only ``tag`` and ``text`` make it."""

    __slots__ = ()


Child = object  # str, Markup, a number, None, or an iterable of these


def text(value: object) -> Markup:
    """Escaped text; characters that show nothing, or turn the line round, become U+FFFD."""
    if isinstance(value, Markup):
        return value
    shown = str(value)
    if not shown.isprintable():
        shown = "".join(c if c.isprintable() or c in "\n\t" else "\ufffd" for c in shown)
    return Markup(escape(shown, quote=True))


def join(children: Iterable[Child]) -> Markup:
    """Everything in order, each escaped unless it is Markup; None is nothing, an iterable its members."""
    out: list[str] = []
    for child in children:
        if child is None:
            continue
        if isinstance(child, Iterable) and not isinstance(child, str):
            out.append(join(child))
        else:
            out.append(text(child))
    return Markup("".join(out))


_VOID = ("meta", "br", "line", "rect", "circle", "path", "polygon")


def tag(name: str, /, *children: Child, **attributes: object) -> Markup:
    """One element. ``class_`` is class, ``stroke_width`` is stroke-width; an attribute of None is left out."""
    told = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{text(value)}"'
        for key, value in attributes.items()
        if value is not None
    )
    if name in _VOID:
        return Markup(f"<{name}{told}>" if name in ("meta", "br") else f"<{name}{told}/>")
    return Markup(f"<{name}{told}>{join(children)}</{name}>")


def table(
    head: Sequence[Child], rows: Iterable[Sequence[Child]], caption: str | None = None, changed: Sequence[bool] = ()
) -> Markup:
    """A table that scrolls by itself where a phone is narrower. The first cell of a row names it.

    changed : rows to set in bold, in order. Cells that are no figures stand on the left, and so do heads that are
    Markup.
    """
    body = []
    for i, row in enumerate(rows):
        cells = [tag("th", row[0], scope="row")]
        cells += [tag("td", cell, class_=None if _is_figure(cell) else "word") for cell in row[1:]]
        body.append(tag("tr", cells, class_="changed" if i < len(changed) and changed[i] else None))
    heads = [tag("th", cell, scope="col", class_="word" if isinstance(cell, Markup) else None) for cell in head]
    top = None if caption is None else tag("caption", caption)
    whole = tag("table", top, tag("thead", tag("tr", heads)), tag("tbody", body))
    return tag("div", whole, class_="wide")


def _is_figure(cell: Child) -> bool:
    shown = str(cell).lstrip("+-")
    return shown[:1].isdigit() or shown == UNKNOWN


def facts(pairs: Iterable[tuple[str, Child]]) -> Markup:
    """Name and value, side by side on paper, one under the other on a phone."""
    return tag("dl", ((tag("dt", name), tag("dd", value)) for name, value in pairs), class_="facts")


def bullets(items: Iterable[Child], kind: str = "ul") -> Markup | None:
    """A list, or nothing where there is nothing."""
    points = [tag("li", item) for item in items]
    return tag(kind, points) if points else None


def number(value: Any, form: str = ".1f", unit: str = "") -> str:
    """The figure and its unit; "not known" for what is none. No minus before a nothing."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return UNKNOWN
    shown = format(value, form)
    if float(shown) == 0.0:
        shown = format(0.0, form)
    return f"{shown} {unit}" if unit else shown


def word(value: Any) -> str:
    """As it stands; "not known" for None, numbers in full."""
    if value is None:
        return UNKNOWN
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return format(value, ".9g")
    if isinstance(value, list | tuple):
        between = "; " if value and isinstance(value[0], list | tuple) else ", "
        return between.join(word(v) for v in value)
    if isinstance(value, dict):
        return ", ".join(f"{k} {word(v)}" for k, v in value.items())
    return str(value)


def exact(value: Any) -> str:
    """A parameter's value with as many digits as a 32-bit float has, as the parameter file writes it."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return word(value)
    if not math.isfinite(value) or float(np.float32(value)) != value:
        return word(value)
    return str(np.float32(value)).removesuffix(".0")


def page(title: str, body: Iterable[Child]) -> str:
    """The whole file. No date in it: the same input gives the same bytes."""
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", http_equiv="Content-Security-Policy", content=_POLICY),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", name="referrer", content="no-referrer"),
        tag("title", title),
        tag("style", Markup(CSS)),
    )
    return f"<!DOCTYPE html>\n{tag('html', head, tag('body', tag('main', body)), lang='en')}\n"
