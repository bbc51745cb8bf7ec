"""Many logs as one table: for a terminal, as CSV, and as one HTML file without network, all from the same dict."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import PurePath
from typing import Any

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

Json = Mapping[str, Any]
AXES = ("x", "y", "z")
_COLOURS = ("#00508a", "#b3261e", "#3b6e22")
_CSS = """
body{margin:0 auto;max-width:76rem;padding:1rem;background:#fff;color:#1b1b1b;overflow-wrap:anywhere;
 font:16px/1.45 system-ui,"Segoe UI",Roboto,"Liberation Sans",Arial,sans-serif}
h1{font-size:1.5rem}h2{font-size:1.2rem;margin:2rem 0 .3rem;border-top:2px solid #1b1b1b;padding-top:.5rem}
.wide{overflow-x:auto}
table{border-collapse:collapse;font-size:.9rem;font-variant-numeric:tabular-nums;overflow-wrap:normal}
td,th{white-space:nowrap}td:nth-child(2){white-space:normal;min-width:9rem;max-width:24rem;overflow-wrap:anywhere}
th,td{padding:.2rem .8rem .2rem 0;text-align:right;vertical-align:top;border-bottom:1px solid #d0d0d0}
th:first-child,td:first-child,td.w,th.w{text-align:left}tr.changed{font-weight:650}.quiet{color:#4a4a4a}
svg{display:block;width:100%;max-width:52rem;height:auto}
@media print{body{max-width:none;padding:0;font-size:9pt}table{font-size:7pt}th,td{padding-right:.4rem}
 .wide{overflow:visible}h2,svg,tr{break-inside:avoid}h2{break-after:avoid}}
"""


def many_csv(table: Json) -> str:
    """One line for each log and compass. Empty: not known."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    triples = ("old_offsets_mg", "new_offsets_mg", "change_mg", "sigma_mg", "axes")
    plain = ("system", "device_id", "compass", "autopilot", "date", "path", "sha256", "kind", "flights", "state")
    scores = ("heading_reference", "heading_before_rms_deg", "heading_after_rms_deg", "heading_held_out_rms_deg")
    names = [f"{name.removesuffix('_mg')}_{axis}{'_mg' * name.endswith('_mg')}" for name in triples for axis in AXES]
    listed = ("reasons", "causes")
    head = [*plain, *listed, "relative", *names, *scores, "heading_n", "counts_in_trend", "why_not", "changed_axes"]
    writer.writerow(head)
    for compass in _compasses(table):
        changed = _changed(compass)
        for row in compass["logs"]:
            values = [row[name] for name in plain] + [" ".join(row[name]) for name in listed] + [row["relative"]]
            values += [v for name in triples for v in (row[name] or (None, None, None))]
            values += [row[name] for name in (*scores, "heading_n", "counts", "why_not")]
            values.append("".join(changed.get(row["sha256"], ())))
            writer.writerow(["" if v is None else _safe(v) for v in values])
    return out.getvalue()


def many_view(table: Json) -> RenderableType:
    """For a terminal: a table per compass, and what changed when."""
    parts: list[RenderableType] = []
    for vehicle in table["vehicles"]:
        for compass in vehicle["compasses"]:
            head = f"System {vehicle['system']}, {_device(compass)}"
            grid = Table(title=_line(head), title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
            for name in ("date (UTC)", "log", "verdict", "offsets mG", "sigma", "heading deg"):
                grid.add_column(name, overflow="fold")
            for row in compass["logs"]:
                offsets = row["new_offsets_mg"]
                turned = f"{_number(row['heading_before_rms_deg'], 1)} -> {_number(row['heading_after_rms_deg'], 1)}"
                cells = (
                    row["date"] or "not known", row["path"], row["state"],
                    _three(offsets) if offsets is not None else f"change {_three(row['change_mg'])}",
                    _three(row["sigma_mg"]), turned,
                )  # fmt: skip
                grid.add_row(*map(_line, cells))
            parts += [grid, *(_line(f"  {text}") for text in said(compass)), Text()]
    parts += [_line(f"not done: {error['text']}") for error in table["errors"]]
    same = table["same_content"]
    parts += [_line(f"the same recording twice, counted once: {s['path']} is {s['as']}") for s in same]
    logs, wrong = table["logs"], len(table["errors"])
    parts.append(_line(f"{logs} log{'s' * (logs != 1)} with an answer, {wrong} without"))
    return Group(*parts)


def said(compass: Json) -> list[str]:
    """The trend in words."""
    out = [
        f"{c['axis']} changed by {c['by_mg']:+.1f} mG after the flight of {c['after']['date']} ({c['after']['path']}): "
        f"from {c['from_mg']:.1f} to {c['to_mg']:.1f}, more than the {c['limit_mg']:.1f} that two sigmas of both allow"
        for c in compass["changes"]
    ]
    for axis, drift in compass["drift"].items():
        if drift is not None and drift["claimed"]:
            slope, sigma = drift["mg_per_flight"], drift["sigma_mg_per_flight"]
            out.append(f"{axis} drifts by {slope:+.2f} mG a flight (one sigma {sigma:.2f}, {drift['flights']} flights)")
    counted = sum(row["counts"] for row in compass["logs"])
    if not out:
        out.append("no change beyond two sigmas" if counted > 1 else "no trend: fewer than two flights count")
    out += [f"{row['path']} does not count: {row['why_not']}" for row in compass["logs"] if not row["counts"]]
    return out


def many_html(table: Json) -> str:
    """One file, no script, no network."""
    body = [f"<h1>Compass offsets of {table['logs']} logs</h1><p class=quiet>{escape(table['rule'])}</p>"]
    for vehicle in table["vehicles"]:
        for compass in vehicle["compasses"]:
            body.append(f"<h2>System {vehicle['system']}, {escape(_device(compass))}</h2>")
            body.append("<ul>" + "".join(f"<li>{escape(text)}</li>" for text in said(compass)) + "</ul>")
            body.append(_picture(compass))
            body.append(_html_rows(compass))
    if table["errors"]:
        lines = "".join(f"<li>{escape(error['text'])}</li>" for error in table["errors"])
        body.append(f"<h2>Logs without an answer</h2><ul>{lines}</ul>")
    if table["same_content"]:
        lines = "".join(f"<li>{escape(s['path'])} is {escape(s['as'])}</li>" for s in table["same_content"])
        body.append(f"<h2>The same recording twice, counted once</h2><ul>{lines}</ul>")
    policy = "default-src 'none'; style-src 'unsafe-inline'"
    head = (
        f'<meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width,initial-scale=1"><title>Compass offsets over flights</title>'
    )
    made = f"<p class=quiet>Made by magmav {escape(table['made_by']['magmav'])}</p>"
    return f'<!doctype html>\n<html lang="en"><head>{head}<style>{_CSS}</style></head><body>\n' + "\n".join(
        [*body, made, "</body></html>\n"]
    )


def report_name(path: str, sha256: str) -> str:
    """What the report of a log is called: its name as far as any file system and link takes it, and its content's."""
    stem = "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "_" for c in PurePath(path).stem)[:60]
    return f"{stem}-{sha256[:8]}.html"


def _html_rows(compass: Json) -> str:
    head = "<th>date (UTC)</th><th class=w>log</th><th class=w>verdict</th>"
    head += "".join(f"<th>{axis} mG</th><th>sigma</th>" for axis in AXES)
    head += "<th>heading before</th><th>after, deg</th><th class=w>against</th>"
    changed = _changed(compass)
    rows = []
    for row in compass["logs"]:
        offsets, sigma = row["new_offsets_mg"], row["sigma_mg"]
        cells = [f"<td>{row['date'] or 'not known'}</td>", f"<td class=w>{_link(row)}</td>"]
        cells.append(f"<td class=w>{escape(row['state'])}</td>")
        for i in range(3):
            cells += [f"<td>{_number(values and values[i], 1)}</td>" for values in (offsets, sigma)]
        cells += [f"<td>{_number(row[f'heading_{name}_rms_deg'], 1)}</td>" for name in ("before", "after")]
        cells.append(f"<td class=w>{escape(row['heading_reference'] or '-')}</td>")
        rows.append(f"<tr{' class=changed' * (row['sha256'] in changed)}>{''.join(cells)}</tr>")
    return f"<div class=wide><table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table></div>"


def _link(row: Json) -> str:
    return f'<a href="logs/{report_name(row["path"], row["sha256"])}">{escape(row["path"])}</a>'


def _picture(compass: Json) -> str:
    """Offsets of the flights that count, with two sigmas, one colour an axis; empty below two flights."""
    rows = [row for row in compass["logs"] if row["counts"]]
    if len(rows) < 2:
        return ""
    wide, high, left, low = 800.0, 260.0, 60.0, 30.0
    ends = [v + k * s for r in rows for v, s in zip(r["new_offsets_mg"], r["sigma_mg"], strict=True) for k in (-2, 2)]
    least, most = min(ends), max(max(ends), min(ends) + 1.0)

    def x(number: int) -> float:
        return left + (wide - left - 20.0) * number / (len(rows) - 1) + 5.0

    def y(value: float) -> float:
        return 10.0 + (high - low - 10.0) * float(most - value) / float(most - least)

    parts = []
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        value = least + share * (most - least)
        parts.append(f'<path d="M{left} {y(value):.1f}H{wide}" stroke="#d0d0d0" fill="none"/>')
        parts.append(f'<text x="{left - 6}" y="{y(value) + 4:.1f}" text-anchor="end">{value:.0f}</text>')
    for c in compass["changes"]:
        number = next(i for i, row in enumerate(rows) if row["sha256"] == c["found_in"]["sha256"])
        at = (x(number) + x(number - 1)) / 2.0
        parts.append(f'<path d="M{at:.1f} 10V{high - low}" stroke="#767676" stroke-dasharray="4 3" fill="none"/>')
        parts.append(f'<text x="{at + 3:.1f}" y="20">{c["axis"]}</text>')
    for i, (axis, colour) in enumerate(zip(AXES, _COLOURS, strict=True)):
        points = [(x(n), row["new_offsets_mg"][i], row["sigma_mg"][i]) for n, row in enumerate(rows)]
        line = " ".join(f"{at:.1f},{y(value):.1f}" for at, value, _ in points)
        parts.append(f'<polyline points="{line}" fill="none" stroke="{colour}" stroke-width="1.5"/>')
        bars = "".join(f"M{at:.1f} {y(v - 2 * s):.1f}V{y(v + 2 * s):.1f}" for at, v, s in points)
        parts.append(f'<path d="{bars}" stroke="{colour}" fill="none" stroke-width="2"/>')
        parts.append(f'<text x="{left + 10 + 90 * i}" y="{high - 8}" fill="{colour}">{axis}, mG</text>')
    first, last = rows[0]["date"][:10], rows[-1]["date"][:10]
    parts.append(f'<text x="{wide}" y="{high - 8}" text-anchor="end">{first} to {last}, flight by flight</text>')
    label = "Offsets of each flight with two sigmas; dashed: the axis named there changed"
    box_ = f'viewBox="0 0 {wide:.0f} {high:.0f}" font-size="12" role="img" aria-label="{label}"'
    return f"<svg {box_}>{''.join(parts)}</svg><p class=quiet>{label}.</p>"


def _compasses(table: Json) -> list[Json]:
    return [compass for vehicle in table["vehicles"] for compass in vehicle["compasses"]]


def _changed(compass: Json) -> dict[str, list[str]]:
    """sha256 of the flight a change was found in, to its axes."""
    out: dict[str, list[str]] = {}
    for change in compass["changes"]:
        out.setdefault(change["found_in"]["sha256"], []).append(change["axis"])
    return out


def _device(compass: Json) -> str:
    number = ", ".join(map(str, compass["compass"]))
    device = "device id not known" if compass["device_id"] is None else f"device {compass['device_id']}"
    return f"{device} (compass {number})"


def _three(values: Sequence[float] | None) -> str:
    return "not known" if values is None else ", ".join(_number(v, 1) for v in values)


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _safe(value: Any) -> Any:
    """A file's name may hold a line's end, or begin like a formula; a spreadsheet must not run it."""
    if not isinstance(value, str):
        return value
    value = "".join(c if c.isprintable() else "?" for c in value)
    return f"'{value}" if value[:1] in ("=", "+", "-", "@") else value


def _line(text: str) -> Text:
    """Names come from files: no markup and no escape codes."""
    return Text("".join(c if c.isprintable() else "?" for c in text))
