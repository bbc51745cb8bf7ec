"""The picture of the demonstration: one flight with the old offsets, one with the uploaded ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from magmav.core.types import Vec3
from magmav.view.drawing import (
    AFTER,
    AXES,
    BEFORE,
    DPI,
    FAINT,
    INK,
    STYLE,
    caption,
    check_name,
    dots,
    heading_axis,
    plain,
    rms_text,
    save,
)
from magmav.view.trace import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True, eq=False)
class DemoFlight:
    """The compass's heading error over one flight, as the vehicle itself streams it.

    boot_s and error_deg are (N,), degrees wrapped to +-180, NaN where not known; rms_deg is the score's.
    own_error_deg is the error of the heading that magmav published meanwhile, when it is to be shown.
    """

    boot_s: Floats
    error_deg: Floats
    rms_deg: float | None
    own_error_deg: Floats | None = None


@dataclass(frozen=True, slots=True)
class DemoOffsets:
    """Offsets of one compass, (3,) mG as ArduPilot adds them: what it held, what was written, the truth."""

    compass: int
    old_mg: Vec3
    new_mg: Vec3
    sigma_mg: Vec3
    true_mg: Vec3


def plot_demo(
    path_png: str | Path,
    before: DemoFlight,
    after: DemoFlight,
    offsets: Sequence[DemoOffsets],
    title: str,
    reference_name: str,
) -> Figure:
    """Draw both flights on one scale, the second magnified, and the offsets; give back the figure."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    check_name(path_png)
    reference = plain(reference_name)
    with rc_context(STYLE):
        figure = Figure(figsize=(12.0, 6.4), dpi=DPI, layout="constrained")
        figure.suptitle(plain(title), fontsize=13, fontweight="bold", x=0.01, ha="left")
        flights, table = figure.subfigures(1, 2, squeeze=False, width_ratios=(1.9, 1.0))[0]
        grid = flights.add_gridspec(2, 2, height_ratios=(1.45, 1.0))
        first = flights.add_subplot(grid[0, 0])
        second = flights.add_subplot(grid[0, 1], sharey=first)
        dots(first, _since_start(before), before.error_deg, BEFORE, "streamed" + rms_text(before.rms_deg))
        if before.own_error_deg is not None:
            dots(first, _since_start(before), before.own_error_deg, AFTER, "magmav")
        dots(second, _since_start(after), after.error_deg, AFTER, "streamed" + rms_text(after.rms_deg))
        heading_axis(first, np.concatenate((before.error_deg, after.error_deg)))
        second.axhline(0.0, color=INK, lw=0.8)
        second.tick_params(labelleft=False)
        caption(first, "First flight: old offsets")
        caption(second, "Second flight: uploaded offsets")
        close = flights.add_subplot(grid[1, :])
        dots(close, _since_start(after), after.error_deg, AFTER, "streamed" + rms_text(after.rms_deg))
        heading_axis(close, after.error_deg)
        caption(close, "The second flight magnified")
        for axes in (first, second, close):
            axes.set_xlabel("time into the flight, s")
            axes.set_ylabel(f"error against {reference}, deg" if axes is not second else "")
        _offsets(table.subplots(), offsets)
        save(figure, path_png)
    return figure


def _since_start(flight: DemoFlight) -> Floats:
    return flight.boot_s - flight.boot_s[0] if len(flight.boot_s) else flight.boot_s


def _offsets(axes: Axes, offsets: Sequence[DemoOffsets]) -> None:
    """A row per compass and axis: from the old value to the new one, the truth as a bar behind it."""
    rows = [(o, i) for o in offsets for i in range(3)]
    for y, (o, i) in enumerate(rows):
        axes.plot([o.old_mg[i], o.new_mg[i]], [y, y], color=FAINT, lw=1.2, zorder=1)
        error = f"off by {o.new_mg[i] - o.true_mg[i]:+.1f} ± {o.sigma_mg[i]:.1f} mG"
        axes.annotate(error, (o.true_mg[i], y), (0, 13), textcoords="offset points", ha="center", fontsize=8.5)
    at = np.arange(len(rows), dtype=np.float64)
    old, new, true = (np.array([getattr(o, n)[i] for o, i in rows]) for n in ("old_mg", "new_mg", "true_mg"))
    axes.plot(true, at, ls="none", marker="|", ms=17, mew=2.2, color=INK, label="truth", zorder=2)
    axes.plot(old, at, ls="none", marker="o", ms=8, mew=1.8, mfc="white", color=BEFORE, label="old", zorder=3)
    axes.plot(new, at, ls="none", marker="o", ms=7, color=AFTER, label="uploaded", zorder=4)
    axes.set_yticks(at, [f"compass {o.compass}\n{AXES[i][0]}" if i == 0 else AXES[i][0] for o, i in rows])
    axes.set_ylim(len(rows) - 0.4, -0.7)
    axes.margins(x=0.3)
    axes.set_xlabel("offset, mG, as ArduPilot adds it")
    caption(axes, "Offsets: old, uploaded and true", scale=0.8)
