"""The pictures of docs/methods.md, out of the same seeded data as the table of papers.py.

method_plots.py [FOLDER]        writes its PNGs there; default docs/methods
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import papers
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from magmav.core.estimators.centred import bullock, kasa, taubin
from magmav.core.estimators.fit import Array as FitArray
from magmav.core.estimators.fit import Fit, fit_points
from magmav.core.estimators.moments import Moments
from magmav.core.rotation import body_from_earth, level_from_body
from magmav.core.smoothing import FixedLagSmoother
from magmav.core.two_axis import worst_turn_per_dip
from magmav.view.drawing import AFTER, AXES, BEFORE, DPI, FAINT, INK, STYLE, caption, save

Array = papers.Array
GREEN, ORANGE, PURPLE = (colour for _, colour in AXES)
_FOLDER = Path(__file__).parents[1] / "docs" / "methods"
_ROUND = np.linspace(0.0, 2.0 * np.pi, 361)


def page(columns: int, height: float = 4.0, width: float = 9.6) -> tuple[Figure, list[Axes]]:
    """A figure as wide as the page, with its pictures in one row."""
    figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained")
    return figure, list(figure.subplots(1, columns, squeeze=False)[0])


def ring(
    axes: Axes, centre: Sequence[float] | FitArray, radius: float, colour: str, label: str, style: str = "-"
) -> None:
    """A circle with its centre."""
    x, y = float(centre[0]), float(centre[1])
    axes.plot(x + radius * np.cos(_ROUND), y + radius * np.sin(_ROUND), style, lw=1.8, color=colour, label=label)
    axes.plot(x, y, "o", ms=5, color=colour)


def cloud(axes: Axes, points: Array, label: str = "readings") -> None:
    """Points, small and grey."""
    axes.plot(points[:, 0], points[:, 1], ".", ms=2.6, mew=0, color=FAINT, label=label)


def plane(axes: Axes, unit: str) -> None:
    """Both axes alike, and the origin marked: a heading is seen from there."""
    axes.plot(0.0, 0.0, "+", ms=11, mew=1.6, color=INK)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(f"ahead, {unit}")
    axes.set_ylabel(f"right, {unit}")


def heading_deg(points: Array) -> Array:
    """Of levelled points (n, 2)."""
    out: Array = np.degrees(np.arctan2(-points[:, 1], points[:, 0]))
    return out


def away_deg(got_deg: Array, true_deg: Array) -> Array:
    """Differences in [-180, 180)."""
    out: Array = np.remainder(got_deg - true_deg + 180.0, 360.0) - 180.0
    return out


# ---------------------------------------------------------------- the pictures


def table_3_1() -> Figure:
    """Sawicki's figure 7: points, circles, and what the difference is worth in heading."""
    points = papers.spiked()
    fits = {m: papers.fitted_points(m, points, 1500.0) for m in ("minmax", "kasa", "bullock")}
    figure, (left, right) = page(2, 4.4)
    left.plot(points[:, 0], points[:, 1], ".", ms=4, mew=0, color=FAINT)
    ring(left, fits["minmax"].centre, fits["minmax"].radius, BEFORE, "I")
    ring(left, fits["kasa"].centre, fits["kasa"].radius, AFTER, "II")
    ring(left, fits["bullock"].centre, fits["bullock"].radius, INK, "III", ":")
    spikes = points[[0, 250, 500]]
    left.plot(spikes[:, 0], spikes[:, 1], "x", ms=8, mew=1.8, color=INK, label="spikes")
    plane(left, "counts")
    caption(left, "Three spikes decide method I", 4, 1.0)
    true = heading_deg(papers.circle(721, papers.PRINTED_II[2], (0.0, 0.0)))
    seen = papers.circle(721, papers.PRINTED_II[2], papers.PRINTED_II[:2])
    order = np.argsort(true)
    for method, colour, label, style in (
        ("minmax", BEFORE, "I", "-"),
        ("kasa", AFTER, "II", "-"),
        ("bullock", INK, "III", ":"),
    ):
        error = away_deg(heading_deg(seen - fits[method].centre), true)
        right.plot(true[order], error[order], style, lw=1.8, color=colour, label=label)
    compass_axis(right)
    caption(right, "What is left of it in the heading", 3, 1.5)
    return figure


def compass_axis(axes: Axes) -> None:
    """Heading across, its error upward."""
    axes.set_xlim(-180, 180)
    axes.set_xticks(range(-180, 181, 90))
    axes.set_xlabel("true heading, deg")
    axes.set_ylabel("heading error, deg")
    axes.axhline(0.0, color=INK, lw=0.8)


IRON_MG = np.array((400.0, -300.0, 900.0))
_EARTH = np.array((1000.0, 0.0, 900.0))


def wobbling(degrees: float, n: int = 1200, seed: int = 1) -> tuple[Array, Array, Array]:
    """Turns with random roll and pitch: seen in body axes (n, 3), levelled (n, 3), true heading (n,) deg."""
    tilt = math.radians(degrees)
    roll, pitch = np.random.default_rng(seed).uniform(-tilt, tilt, (2, n))
    yaw = np.linspace(0.0, 8.0 * np.pi, n)
    attitudes = list(zip(roll.tolist(), pitch.tolist(), yaw.tolist(), strict=True))
    seen = np.array([body_from_earth(*a) @ _EARTH for a in attitudes]) + IRON_MG
    level = np.array([level_from_body(r, p) for r, p, _ in attitudes])
    return seen, level, np.degrees(yaw)


class Orders(NamedTuple):
    """Levelled points (n, 2) and their circle; points by body first (n, 2); heading errors of both orders (n,), deg."""

    flat: Array
    circle: Fit
    clean: Array
    level_first_deg: Array
    body_first_deg: Array


def two_orders(degrees: float) -> Orders:
    """One flight calibrated both ways."""
    seen, level, true = wobbling(degrees)
    flat = np.einsum("nij,nj->ni", level, seen)[:, :2]
    circle, ball = (papers.fitted_points("bullock", points, 1000.0) for points in (flat, seen))
    clean = np.einsum("nij,nj->ni", level, seen - ball.centre)[:, :2]
    first = away_deg(heading_deg(flat - circle.centre), true)
    return Orders(flat, circle, clean, first, away_deg(heading_deg(clean), true))


def orders() -> Figure:
    """Level first against body first."""
    flat, circle, clean, *_ = two_orders(10.0)
    figure, (left, middle, right) = page(3, 3.9, 10.4)
    cloud(left, flat)
    ring(left, circle.centre, circle.radius, BEFORE, "circle fitted")
    plane(left, "mG")
    caption(left, "Level first, then fit", 2, 1.5)
    ring(middle, (0.0, 0.0), 1000.0, AFTER, "circle")
    middle.plot(clean[::6, 0], clean[::6, 1], ".", ms=3.5, mew=0, color=INK, label="readings", zorder=3)
    plane(middle, "mG")
    caption(middle, "Fit in body axes, then level", 2, 1.5)
    wobbles = (1.0, 2.0, 3.0, 4.0, 5.0, 7.5, 10.0, 15.0, 20.0)
    runs = [two_orders(w) for w in wobbles]
    right.plot(
        wobbles, [np.abs(o.level_first_deg).max() for o in runs], "o-", ms=4.5, color=BEFORE, label="level first"
    )
    right.plot(wobbles, [np.abs(o.body_first_deg).max() for o in runs], "o-", ms=4.5, color=AFTER, label="body first")
    right.set_xlabel("roll and pitch up to, deg")
    right.set_ylabel("worst heading error, deg")
    caption(right, "Cost; tilt angles perfect", 2, 1.0)
    return figure


_SOLVERS = {"kasa": kasa, "bullock": bullock, "taubin": taubin}


def solved(points: Array, method: str) -> tuple[Array, float]:
    """Centre and radius by the equations alone: a fit would refuse the shortest of these arcs."""
    m = Moments(2, 200.0)
    for p in points:
        m.add(p)
    centre, square = _SOLVERS[method](m.within(np.eye(2)))
    shift = np.zeros(2) if m.shift is None else m.shift
    return shift + 200.0 * centre, 200.0 * math.sqrt(max(square, 0.0))


def arc(degrees: float, seed: int, n: int = 250, noise: float = 10.0) -> Array:
    """Part of a circle of 200 about the origin, evenly turned, (n, 2)."""
    r = np.random.default_rng(seed)
    a = np.radians(np.linspace(-degrees / 2.0, degrees / 2.0, n))
    out: Array = 200.0 * np.stack((np.cos(a), np.sin(a)), 1) + r.normal(0.0, noise, (n, 2))
    return out


def short_arcs() -> Figure:
    """Kasa draws short arcs to small circles, Taubin does not."""
    figure, (left, right) = page(2, 4.3)
    points = arc(90.0, 3)
    cloud(left, points)
    ring(left, (0.0, 0.0), 200.0, FAINT, "true", "--")
    for method, colour, label in (("kasa", BEFORE, "II and III"), ("taubin", AFTER, "Taubin")):
        ring(left, *solved(points, method), colour, label)
    plane(left, "mG")
    caption(left, "A quarter turn, 5 % noise", 4, 1.5)
    spans = np.arange(50.0, 361.0, 10.0)
    for method, colour, label in (("kasa", BEFORE, "II and III"), ("taubin", AFTER, "Taubin")):
        off, told = [], []
        for span in spans:
            some = [arc(span, seed) for seed in range(12)]
            off.append(100.0 * np.median([float(np.hypot(*solved(p, method)[0])) / 200.0 for p in some]))
            answers = [fit_points(p, papers.fitter(method, 2, 200.0)) for p in some[:4]]
            told.append(sum(isinstance(a, Fit) for a in answers) >= 2)
        silent = np.flatnonzero(~np.array(told))
        last = int(silent[-1]) + 1 if len(silent) else 0
        right.plot(spans[last:], off[last:], "-", lw=1.8, color=colour, label=label)
        right.plot(spans[: last + 1], off[: last + 1], ":", lw=1.8, color=colour)
    right.plot([], [], ":", lw=1.8, color=INK, label="refused")
    right.set_yscale("log")
    right.set_yticks([0.5, 1, 2, 5, 10, 20, 50], labels=["0.5", "1", "2", "5", "10", "20", "50"])
    right.minorticks_off()
    right.set_xlim(45, 365)
    right.set_xticks(range(60, 361, 60))
    right.set_xlabel("turned through, deg")
    right.set_ylabel("centre off by, % of the radius")
    caption(right, "Error of the centre, median of 12", 3, 1.0)
    return figure


SOFT = np.array(((1.2, 0.2), (0.2, 0.8)))


def soft_iron() -> Figure:
    """The printed chain against the conic."""
    yaw = np.linspace(-np.pi, np.pi, 900, endpoint=False)
    circle = 200.0 * np.stack((np.cos(yaw), -np.sin(yaw)), 1)
    noise = np.random.default_rng(4).normal(0.0, 2.0, circle.shape)
    seen = circle @ SOFT.T + (90.0, -60.0) + noise
    chain, conic = (papers.fitted_points(m, seen, 200.0) for m in ("sytnyk", "ellipse"))
    figure, (left, right) = page(2, 4.4)
    cloud(left, seen)
    clean = (seen - conic.centre) @ conic.matrix.T
    left.plot(clean[:, 0], clean[:, 1], ".", ms=2.6, mew=0, color=AFTER, label="after the conic fit")
    plane(left, "mG")
    caption(left, "Ellipse before, circle after", 2, 4.0)
    true = np.degrees(yaw)
    for label, centre, matrix, colour in (
        ("circle (refused)", solved(seen, "bullock")[0], np.eye(2), BEFORE),
        ("printed chain", chain.centre, chain.matrix, ORANGE),
        ("conic", conic.centre, conic.matrix, AFTER),
    ):
        error = away_deg(heading_deg((seen - noise - centre) @ matrix.T), true)
        right.plot(true, error, lw=1.8, color=colour, label=label)
    compass_axis(right)
    right.set_ylim(-22, 22)
    caption(right, "What is left of it in the heading", 3, 1.5)
    return figure


def two_axes() -> Figure:
    """What a wrong dip costs a two-axis compass."""
    figure, (left, right) = page(2, 4.2)
    tilts = np.arange(0.0, 60.1, 1.0)
    for error, colour in ((0.5, GREEN), (2.0, AFTER), (5.0, ORANGE), (10.0, BEFORE)):
        e = math.radians(error)
        cost = [max(papers.worst_heading_error(math.radians(t), 0.0, papers.INCLINATION, s * e) for s in (-1.0, 1.0))
                for t in tilts]  # fmt: skip
        left.plot(tilts, np.degrees(cost), lw=1.8, color=colour, label=f"{error:g} deg")
    left.set_ylim(0, 30)
    left.set_ylabel("worst heading error, deg")
    caption(left, "Dip 66 deg (central Europe), dip wrong by", 4, 1.0)
    for dip, colour in ((40.0, GREEN), (55.0, AFTER), (66.0, ORANGE), (75.0, BEFORE)):
        cost = [worst_turn_per_dip(math.radians(t), math.radians(dip)) for t in tilts]
        right.plot(tilts, cost, lw=1.8, color=colour, label=f"{dip:g} deg")
    right.set_ylim(0, 15)
    right.set_ylabel("heading error per degree of dip, deg")
    caption(right, "Dip wrong by 1 deg, where the dip is", 4, 1.0)
    for axes in (left, right):
        axes.set_xlim(0, 60)
        axes.set_xlabel("tilt, deg")
    return figure


def smoothing() -> Figure:
    """What smoothing takes out, and what it cannot."""
    sigma = math.radians(papers.SIGMA_DEG)
    r = np.random.default_rng(8)
    drive = papers.turning(r, n=400)
    raw = np.remainder(drive.truth_rad + r.normal(0.0, sigma, 400), 2.0 * np.pi)
    figure, (left, right) = page(2, 4.2, 10.0)
    late = FixedLagSmoother(10)
    lagged = [s for t, z in zip(drive.boot_s, raw, strict=True) for s in late.step(t, z, sigma)] + late.finish()

    def off(headings: Array) -> Array:
        out: Array = np.degrees(papers.wrapped(headings - drive.truth_rad))
        return out

    left.plot(drive.boot_s, off(raw), ".", ms=3.5, mew=0, color=FAINT, label="measured")
    one_late = off(np.array([s.heading_rad for s in lagged]))
    left.plot(drive.boot_s, off(papers.live(drive.boot_s, raw, sigma)), lw=1.3, color=BEFORE, label="live")
    left.plot(drive.boot_s, one_late, lw=3.4, color=ORANGE, label="1 s late")
    rts = off(papers.after(drive.boot_s, raw, sigma))
    left.plot(drive.boot_s, rts, lw=1.4, color=AFTER, label="RTS")
    left.axhline(0.0, color=INK, lw=0.8)
    left.set_xlim(5, 25)
    left.set_xticks(range(5, 26, 5))
    left.set_ylim(-4.2, 4.2)
    left.set_xlabel("time, s")
    left.set_ylabel("heading error, deg")
    caption(left, "Noise of 1.25 deg, turns up to 20 deg/s", 4, 1.5)
    t = np.arange(0.0, 720.0) * papers.STEP_S
    truth = math.radians(10.0) * t - np.pi
    small = math.radians(papers.SMALL_SIGMA_DEG)
    noise = np.random.default_rng(2).normal(0.0, small, len(t))
    swung = truth + math.radians(papers.DEVIATION_DEG) * np.sin(truth) + noise
    across = np.degrees(papers.wrapped(truth))
    smooth = papers.after(t, np.remainder(swung, 2.0 * np.pi), small)
    right.plot(across, np.degrees(papers.wrapped(swung - truth)), ".", ms=3.5, mew=0, color=FAINT, label="measured")
    half = slice(0, 360)
    right.plot(across[half], np.degrees(papers.wrapped(smooth - truth))[half], lw=1.6, color=AFTER, label="RTS")
    iron = papers.DEVIATION_DEG * np.sin(np.radians(across[half]))
    right.plot(across[half], iron, "--", lw=1.4, color=BEFORE, label="iron left in the compass")
    compass_axis(right)
    right.set_ylim(-4.2, 4.2)
    caption(right, "Deviation stays, however smooth", 3, 1.5)
    return figure


def marg_steps() -> Figure:
    """How the solvers come near."""
    tasks = [papers.task(seed, 45.0) for seed in range(12)]

    def typical(step: Callable[..., Array], dynamic: bool, n: int, frozen: bool = False) -> Array:
        paths = np.array([papers.path(t, step, dynamic, n, frozen) for t in tasks])
        out: Array = np.exp(np.mean(np.log(np.maximum(paths, 1e-16)), axis=0))
        return out

    figure, (left, right) = page(2, 4.3)
    n = 100
    steps = np.arange(1, n + 1)
    left.plot(steps, typical(papers.PLAIN, True, n), lw=1.8, color=ORANGE, label="dynamic")
    left.plot(steps, typical(papers.PLAIN, False, n), lw=1.8, color=AFTER, label="direct")
    left.plot(steps, typical(papers.NORMALISED, True, n), lw=1.4, color=BEFORE, label="normalised")
    left.plot(steps, typical(papers.PLAIN, False, n, True), lw=1.4, color=PURPLE, label="frozen")
    for value, text in ((0.0425, "0.0425"), (8.33e-4, "8.33e-4")):
        left.axhline(value, color=INK, lw=0.8, ls=":")
        left.text(n - 1, value * 1.1, f"printed: {text}", ha="right", va="bottom", fontsize=8.5, color=INK)
    left.set_ylim(1e-5, 0.5)
    left.set_xlim(0, n)
    caption(left, "Gradient descent, step 0.2", 4, 1.0)
    m = 30
    steps = np.arange(1, m + 1)
    right.plot(steps, typical(papers.NEWTON, True, m), "o-", ms=3.5, lw=1.5, color=ORANGE, label="dynamic")
    right.plot(steps, typical(papers.NEWTON, False, m), "o-", ms=3.5, lw=1.5, color=AFTER, label="direct")
    right.set_ylim(1e-16, 0.5)
    right.set_xlim(0, m)
    caption(right, "Gauss-Newton", 2, 1.0)
    for axes in (left, right):
        axes.set_yscale("log")
        axes.set_xlabel("steps from 45 deg off")
        axes.set_ylabel("mean component of the error")
    return figure


FIGURES: dict[str, Callable[[], Figure]] = {
    "circles": table_3_1,
    "orders": orders,
    "arcs": short_arcs,
    "ellipse": soft_iron,
    "two_axes": two_axes,
    "smoothing": smoothing,
    "marg": marg_steps,
}


def main(argv: Sequence[str]) -> int:
    """Draw them all."""
    folder = Path(argv[0]) if argv else _FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    for name, draw in FIGURES.items():
        with rc_context(STYLE):
            save(draw(), folder / f"{name}.png")
        sys.stdout.write(f"{folder / name}.png\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
