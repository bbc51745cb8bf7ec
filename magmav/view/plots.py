"""The picture of a recording: offsets over time, heading error before and after, the field on its sphere.

Every heading error names the reference it is measured against.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from magmav.core.types import AxisState
from magmav.view.drawing import (
    AFTER,
    AXES,
    BAND,
    BEFORE,
    DPI,
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
from magmav.view.plot_demo import DemoFlight, DemoOffsets, plot_demo
from magmav.view.trace import Floats, Trace, TraceCollector

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

__all__ = ["DemoFlight", "DemoOffsets", "Trace", "TraceCollector", "plot_demo", "plot_replay"]

_DOUBTS = {
    AxisState.OBSERVED: "",
    AxisState.FROM_MODEL: " (from field model)",
    AxisState.NOT_OBSERVED: " (not observed)",
}


def plot_replay(path_png: str | Path, traces: Sequence[Trace], title: str, reference_name: str | None) -> Figure:
    """Draw every compass of a recording into one PNG and give back the figure it was made from.

    Per compass: offsets with one sigma; heading error as streamed and corrected, then the corrected one
    magnified with the sigma that was claimed; the field before and after on the sphere it should lie on, from
    above and from the side. Without a reference (name None) the headings stand in for their errors.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    check_name(path_png)
    if not traces:
        raise ValueError("traces: nothing to draw")
    with rc_context(STYLE):
        figure = Figure(figsize=(13.0, 0.5 + 8.2 * len(traces)), dpi=DPI, layout="constrained")
        against = f"heading errors against {reference_name}" if reference_name else "heading errors: not known"
        figure.suptitle(plain(f"{title}   ({against})"), fontsize=13, fontweight="bold", x=0.01, ha="left")
        blocks = figure.subfigures(len(traces), 1, squeeze=False)[:, 0]
        for block, trace in zip(blocks, traces, strict=True):
            _block(block, trace, reference_name)
        save(figure, path_png)
    return figure


def _block(block: SubFigure, trace: Trace, reference_name: str | None) -> None:
    device = f", device {trace.device_id}" if trace.device_id else ""
    again = f", after {trace.reboots} reboot(s)" if trace.reboots else ""
    state = trace.state.name.replace("_", " ").lower()
    text = f"System {trace.system}, compass {trace.compass}{device}: {state}{again}"
    block.suptitle(text, fontsize=11.5, x=0.01, ha="left")
    left, right = block.subfigures(1, 2, squeeze=False, width_ratios=(2.35, 1.0))[0]
    offsets, both, close = left.subplots(3, 1, sharex=True)
    above, beside = right.subplots(2, 1)
    _offsets(offsets, trace)
    if reference_name is not None and trace.reference_true_rad is not None:
        _errors(both, close, trace, plain(reference_name))
    else:
        _headings(both, close, trace)
    close.set_xlabel("time since boot, s")
    close.set_xlim(trace.boot_s[0], max(trace.boot_s[-1], trace.boot_s[0] + 1.0))
    _cloud(above, trace, (1, 0), "Field from above")
    _cloud(beside, trace, (0, 2), "Field from the side")


def _offsets(axes: Axes, trace: Trace) -> None:
    for i, (name, colour) in enumerate(AXES):
        value, sigma = trace.offsets_mg[:, i], trace.sigma_mg[:, i]
        end = f"{value[-1]:.0f} mG" if np.isfinite(value[-1]) else "not known"
        end = f"{value[-1]:.0f} ± {sigma[-1]:.1f} mG" if np.isfinite(sigma[-1]) else end
        axes.fill_between(trace.boot_s, value - sigma, value + sigma, color=colour, alpha=0.22, linewidth=0)
        axes.plot(trace.boot_s, value, color=colour, lw=1.6, label=f"{name} {end}{_DOUBTS[trace.axes[i]]}")
    known = trace.offsets_mg[np.isfinite(trace.offsets_mg)]
    low, high = np.percentile(known, (1, 99)) if len(known) else (0.0, 0.0)
    room = max(0.15 * (high - low), 3.0 * _last_sigma(trace), 5.0)
    axes.set_ylim(low - room, high + room)  # the wide sigma of the first seconds would flatten all the rest
    axes.set_ylabel("offset, mG")
    caption(axes, "Offsets to store, as ArduPilot adds them, with one sigma")


def _last_sigma(trace: Trace) -> float:
    known = trace.sigma_mg[-1][np.isfinite(trace.sigma_mg[-1])]
    return min(float(known.max()), 60.0) if len(known) else 0.0


def _errors(both: Axes, close: Axes, trace: Trace, reference: str) -> None:
    before = trace.error_deg(trace.stored_heading_true_rad)
    after = trace.error_deg(trace.heading_true_rad)
    dots(both, trace.boot_s, before, BEFORE, "as streamed" + rms_text(trace.rms_before_deg))
    dots(both, trace.boot_s, after, AFTER, "corrected" + rms_text(trace.rms_after_deg))
    heading_axis(both, np.concatenate((before, after)))
    sigma = np.degrees(trace.heading_sigma_rad)
    close.fill_between(trace.boot_s, -sigma, sigma, color=BAND, alpha=0.35, linewidth=0, label="one sigma, as claimed")
    dots(close, trace.boot_s, after, AFTER, "corrected")
    heading_axis(close, _settled(after))
    _marks(both, trace)
    _marks(close, trace)
    caption(both, f"Heading error against {reference}")
    caption(close, f"The corrected heading magnified: error against {reference}")


def _headings(both: Axes, close: Axes, trace: Trace) -> None:
    true = bool(np.isfinite(trace.heading_true_rad).any())
    before = trace.stored_heading_true_rad if true else trace.stored_heading_rad
    after = trace.heading_true_rad if true else trace.heading_rad
    dots(both, trace.boot_s, np.degrees(before) % 360.0, BEFORE, "as streamed")
    dots(both, trace.boot_s, np.degrees(after) % 360.0, AFTER, "corrected")
    both.set_ylim(0, 360)
    both.set_yticks(np.arange(0, 361, 90))
    both.set_ylabel("heading, deg")
    turned = (np.degrees(after - before) + 180.0) % 360.0 - 180.0
    dots(close, trace.boot_s, turned, AFTER, "corrected less streamed")
    heading_axis(close, turned, "turn, deg")
    _marks(both, trace)
    _marks(close, trace)
    caption(both, f"Heading, {'true' if true else 'magnetic'} north (no reference, so its error is not known)")
    caption(close, "How far the correction turns the heading")


def _settled(error_deg: Floats) -> Floats:
    """The second half of what is known: magnifying must not be spoilt by the first seconds of learning."""
    known = error_deg[np.isfinite(error_deg)]
    return known[len(known) // 2 :]


def _marks(axes: Axes, trace: Trace) -> None:
    if trace.scored_s is not None:
        axes.axvspan(*trace.scored_s, color="#000000", alpha=0.05, lw=0, label="scored", zorder=0)
    if trace.frozen_s is not None:
        axes.axvline(trace.frozen_s, color=INK, lw=1.0, ls="--", label="calibration frozen")


def _cloud(axes: Axes, trace: Trace, pick: tuple[int, int], name: str) -> None:
    """Both fields projected on two body axes, with the outline of the sphere a perfect compass draws."""
    across, up = pick
    dots(axes, trace.stored_b_mg[:, across], trace.stored_b_mg[:, up], BEFORE, "as streamed")
    dots(axes, trace.corrected_b_mg[:, across], trace.corrected_b_mg[:, up], AFTER, "corrected")
    turn, radius = np.linspace(0.0, 2.0 * np.pi, 181), trace.expected_mg
    axes.plot(radius * np.cos(turn), radius * np.sin(turn), color=INK, lw=1.2)
    if AXES[up][0] == "z down":  # down goes down on the page too
        axes.invert_yaxis()
    axes.plot(0.0, 0.0, marker="+", ms=10, color=INK, ls="none")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(f"{AXES[across][0]}, mG")
    axes.set_ylabel(f"{AXES[up][0]}, mG")
    caption(axes, f"{name} (circle: {radius:.0f} mG)")
