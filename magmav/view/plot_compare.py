"""The points and what each method made of them: circles in the levelled plane, spheres in two cuts of the body.

As in Sawicki's figures: the horizontal field of every sample with the tilt undone, and the circle each method says it
should lie on. A heading error is the angle between a point seen from the origin and from its circle's centre. Iron is
fixed to the body, so the levelled circle is blurred where the vehicle tilts; the second picture shows the same points
with the iron removed first.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from magmav.view.drawing import BEFORE, DPI, FAINT, INK, STYLE, check_name, plain, save
from magmav.view.trace import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS = (
    "#0072B2",
    "#009E73",
    "#E69F00",
    "#A4508B",
    "#56B4E9",
    "#D55E00",
    "#666666",
    "#B8A000",
    "#004D40",
    "#8B2252",
)
_MOST = 4000


class Cloud(NamedTuple):
    """The points one compass was fitted to, body axes (N, 3) mG, and the tilt of each, (N,) rad."""

    sensor_b_mg: Floats
    roll_rad: Floats
    pitch_rad: Floats


def plot_compare(path_png: str | Path, result: Mapping[str, Any], clouds: Mapping[tuple[int, int], Cloud]) -> Figure:
    """One row of four pictures per compass. ViewError when the file cannot be written."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    check_name(path_png)
    entries = [(v["system"], c) for v in result["vehicles"] for c in v["compasses"]]
    with rc_context(STYLE):
        figure = Figure(figsize=(19.0, 0.6 + 5.2 * len(entries)), dpi=DPI, layout="constrained")
        figure.suptitle(plain(Path(result["source"]).name), fontsize=13, fontweight="bold", x=0.01, ha="left")
        rows = figure.subplots(len(entries), 4, squeeze=False)
        for axes, (system, entry) in zip(rows, entries, strict=True):
            _row(list(axes), entry, thinned(clouds[system, entry["compass"]]))
        save(figure, path_png)
    return figure


def thinned(cloud: Cloud) -> Cloud:
    """At most some thousands of points: more only make the file slow to open."""
    step = max(1, len(cloud.sensor_b_mg) // _MOST)
    return Cloud(*(column[::step] for column in cloud))


def levelled(field_b_mg: Floats, cloud: Cloud) -> Floats:
    """Horizontal field ahead and to the right, (N, 2) mG, of body vectors (N, 3) or (3,)."""
    x, y, z = np.broadcast_to(field_b_mg, cloud.sensor_b_mg.shape).T
    cr, sr, cp, sp = np.cos(cloud.roll_rad), np.sin(cloud.roll_rad), np.cos(cloud.pitch_rad), np.sin(cloud.pitch_rad)
    return np.column_stack([x * cp + sp * (y * sr + z * cr), y * cr - z * sr])


def _row(axes: list[Axes], entry: Mapping[str, Any], cloud: Cloud) -> None:
    level, after, above, beside = axes
    raw = levelled(cloud.sensor_b_mg, cloud)
    size = 3.5 if len(raw) < 1500 else 1.8
    level.plot(raw[:, 0], raw[:, 1], ".", ms=size, mew=0, color=FAINT, label="points")
    x, y, z = cloud.sensor_b_mg.T
    above.plot(y, x, ".", ms=size, mew=0, color=FAINT)
    beside.plot(x, z, ".", ms=size, mew=0, color=FAINT)
    shown = ""  # the first method that knows all three axes
    for index, method in enumerate(m for m in entry["estimators"] if m["offsets_mg"] is not None):
        iron = -np.array([0.0 if v is None else v for v in method["offsets_mg"]])
        colour = _COLOURS[index % len(_COLOURS)]
        style = "-" if index < len(_COLOURS) else "--"
        # Where the method's z is not known, levelling its iron with z = 0 is what the paper's own order does.
        centre = levelled(iron, cloud).mean(axis=0)
        away = cloud.sensor_b_mg - iron
        radius = float(np.median(np.hypot(*levelled(away, cloud).T)))
        total = float(np.median(np.linalg.norm(away, axis=1)))
        _ring(level, centre[0], centre[1], radius, colour, style, method["name"])
        if method["offsets_mg"][2] is not None:
            _ring(above, iron[1], iron[0], total, colour, style)
            _ring(beside, iron[0], iron[2], total, colour, style)
        if not shown and None not in method["offsets_mg"]:
            clean = levelled(away, cloud)
            after.plot(clean[:, 0], clean[:, 1], ".", ms=size, mew=0, color=FAINT)
            _ring(after, 0.0, 0.0, radius, colour, style)
            shown = f"Iron of {method['name']} removed, then levelled"
    for axis, (title, across, up) in zip(
        axes,
        (
            ("Levelled: the circle of headings", "ahead, mG", "right, mG"),
            (shown or "no method knows all three axes", "ahead, mG", "right, mG"),
            ("Body, from above: outline of the sphere", "y right, mG", "x forward, mG"),
            ("Body, from the side", "x forward, mG", "z down, mG"),
        ),
        strict=True,
    ):
        axis.set_title(f"Compass {entry['compass']}: {title}" if axis is level else title)
        axis.set_xlabel(across)
        axis.set_ylabel(up)
        axis.plot(0.0, 0.0, "+", ms=12, mew=1.6, color=BEFORE)
        axis.set_aspect("equal", adjustable="datalim")
        axis.axhline(0.0, color=INK, lw=0.4)
        axis.axvline(0.0, color=INK, lw=0.4)
    beside.invert_yaxis()
    level.legend(
        loc="upper center",
        bbox_to_anchor=(0.5, -0.13),
        fontsize=8.0,
        markerscale=2.0,
        ncols=5,
        columnspacing=0.8,
        handlelength=1.2,
    )


def _ring(axes: Axes, x: float, y: float, radius: float, colour: str, style: str, label: str | None = None) -> None:
    """A circle and its centre."""
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    axes.plot(x + radius * np.cos(turn), y + radius * np.sin(turn), style, lw=1.2, color=colour, label=label)
    axes.plot(x, y, "o", ms=4.0, color=colour)
