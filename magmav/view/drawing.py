"""What all pictures share: the colours, the style, text that is safe to draw, and the way to disk.

Colours are Okabe and Ito's, told apart by the colour-blind too: before is vermilion, after is blue, the three
axes are green, orange and purple. matplotlib is imported only when a picture is drawn, and without pyplot, so
nothing global is left behind.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from magmav.view.records import ViewError, WrongName
from magmav.view.trace import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BEFORE, AFTER, INK, FAINT, BAND = "#D55E00", "#0072B2", "#222222", "#9a9a9a", "#56B4E9"
AXES = (("x forward", "#009E73"), ("y right", "#E69F00"), ("z down", "#A4508B"))
DPI = 100

# Any: matplotlib's own type for this names every key there is, and changes with every release.
STYLE: Any = {
    "font.size": 10.0,
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": FAINT,
    "axes.grid": True,
    "grid.color": "#e6e6e6",
    "legend.frameon": False,
    "legend.fontsize": 9.0,
    "legend.columnspacing": 1.4,
    "legend.handletextpad": 0.5,
    "xtick.color": INK,
    "ytick.color": INK,
}
_LIMITS_DEG = (1, 2, 4, 10, 20, 40, 90, 180)


def plain(text: str) -> str:
    """Text that matplotlib draws as it stands: no formulas, no characters its font lacks."""
    latin = "".join(c if c.isprintable() and ord(c) < 256 else "?" for c in text)
    return latin.replace("$", r"\$")


def rms_text(rms_deg: float | None) -> str:
    """The number for a legend, or nothing when it is not known."""
    return "" if rms_deg is None else f": {rms_deg:.3g} deg RMS"


def dots(axes: Axes, x: Floats, y: Floats, colour: str, label: str) -> None:
    """A series as dots, because a line would draw a stroke across the picture at every wrap."""
    axes.plot(x, y, ls="none", marker=".", ms=2.4, mew=0, color=colour, label=label)


def heading_axis(axes: Axes, shown_deg: Floats, unit: str = "error, deg") -> None:
    """A symmetric axis about zero with a round half-height that shows 99.5 % of the values."""
    known = np.abs(shown_deg[np.isfinite(shown_deg)])
    wanted = float(np.percentile(known, 99.5)) * 1.1 if len(known) else 0.0
    limit = float(next((limit for limit in _LIMITS_DEG if limit >= wanted), 180))
    axes.axhline(0.0, color=INK, lw=0.8)
    axes.set_ylim(-limit, limit)
    axes.set_yticks(np.linspace(-limit, limit, 5))
    axes.set_ylabel(unit)


def caption(axes: Axes, title: str, columns: int = 4, scale: float = 4.0) -> None:
    """Title and, between it and the picture where it can hide nothing, the legend."""
    axes.set_title(title, pad=24)
    legend = axes.legend(
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        borderaxespad=0.1,
        borderpad=0.1,
        ncols=columns,
        markerscale=scale,
    )
    legend.set_in_layout(False)  # else one long legend would squeeze the pictures beside it


def save(figure: Figure, path_png: str | Path) -> None:
    """Write the PNG in one go; ViewError naming the file when it cannot be."""
    path = Path(path_png)
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=DPI)
    try:
        path.write_bytes(drawn.getvalue())
    except OSError as error:
        raise ViewError(f"{path}: cannot write picture: {error.strerror}") from error


def check_name(path_png: str | Path) -> None:
    """WrongName for a name that is not a PNG's, before anything is drawn."""
    if Path(path_png).suffix.lower() != ".png":
        raise WrongName(f"{path_png}: pictures want a name ending in .png")
