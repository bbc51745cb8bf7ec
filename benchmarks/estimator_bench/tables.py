"""The results as Markdown and as a JSON document."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from estimator_bench.bound import Bound
from estimator_bench.scenarios import SCENARIOS
from estimator_bench.score import CHECKPOINTS_S, Scored, Summary, as_dict, plain, rms, summed

BOUND, RIVAL = "bound", "twostep_win"
_RESAMPLED = 2000
Cell = float | None
Headings = dict[tuple[str, int], dict[str, dict[str, float]]]  # filter -> calibration -> degrees RMS
_HONESTY = (
    "b_xy mG", "b_z mG", "efficiency @178", "NEES", "error/sigma", "to 1 deg s", "again s", "ready s", "ready < 60 s",
    "ready & > 3 deg", "ready & > 3 sigma", "us", "us < 20 s",
)  # fmt: skip
_OVERALL = ("worst @178", "NEES", "error/sigma", "ready & > 3 deg", "ready & > 3 sigma", "ready < 60 s", "us")


def number(value: Cell, digits: int = 2) -> str:
    """For a cell."""
    if value is None or math.isnan(value):
        return ""
    return "-" if math.isinf(value) else f"{value:.{digits}f}"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table; the first column is text."""
    line = "|" + "|".join(["---"] + ["---:"] * (len(head) - 1)) + "|"
    return "\n".join(["| " + " | ".join(head) + " |", line, *("| " + " | ".join(row) + " |" for row in rows)])


class Results:
    """Everything measured. bounds and headings: by (scenario, seed), or nothing where they were not wanted."""

    def __init__(
        self, scored: Sequence[Scored], bounds: dict[tuple[str, int], Bound], headings: Headings | None = None
    ) -> None:
        self.scored = list(scored)
        self.bounds = bounds
        self.headings = headings or {}
        self.scenarios = list(dict.fromkeys(s.scenario for s in scored))
        self.names = list(dict.fromkeys(s.name for s in scored))
        self.summaries: dict[tuple[str, str], Summary] = {}
        for scenario in self.scenarios:
            for name in self.names:
                some = [s for s in scored if (s.scenario, s.name) == (scenario, name)]
                if some:
                    self.summaries[scenario, name] = summed(some)

    def bound_deg(self, scenario: str, i: int) -> Cell:
        """RMS over seeds of the bound at a checkpoint."""
        some = [b.heading_deg[i] for (s, _), b in self.bounds.items() if s == scenario]
        return rms(some) if some else None

    def columns(self, names: Sequence[str] | None = None) -> list[str]:
        """The bound first, where there is one."""
        return ([BOUND] if self.bounds else []) + list(names or self.names)

    def error(self, scenario: str, name: str, i: int, offsets_only: bool = False) -> Cell:
        """RMS over seeds of the heading error at a checkpoint, degrees."""
        if name == BOUND:
            return self.bound_deg(scenario, i)
        s = self.summaries.get((scenario, name))
        return None if s is None else (s.offsets_deg if offsets_only else s.full_deg)[i]

    # ------------------------------------------------------------ tables

    def heading(self, i: int, offsets_only: bool = False) -> str:
        """Scenarios by methods at one checkpoint, with median, worst, and how often best."""
        names = self.columns()
        cells = {s: {n: self.error(s, n, i, offsets_only) for n in names} for s in self.scenarios}
        won = dict.fromkeys(names, 0)
        rows = []
        for s in self.scenarios:
            rivals = {n: v for n, v in cells[s].items() if n != BOUND and v is not None}
            best = min(rivals, key=lambda n: rivals[n], default=None)
            if best is not None:
                won[best] += 1
            rows.append([s, *(f"**{number(v)}**" if n == best else number(v) for n, v in cells[s].items())])
        for label, fold in (("*median*", np.median), ("*worst*", np.max)):
            rows.append([label, *(number(_fold(fold, [cells[s][n] for s in self.scenarios])) for n in names)])
        rows.append(["*scenarios won*", *("" if n == BOUND else str(won[n]) for n in names)])
        return table(["scenario", *names], rows)

    def honesty(self, name: str) -> str:
        """One method, scenario by scenario."""
        head = ["scenario", *_HONESTY]
        rows = []
        for s in self.scenarios:
            if (one := self.summaries.get((s, name))) is None:
                continue
            limit = self.bound_deg(s, -1)
            share = None if limit is None else limit / max(one.full_deg[-1], 1e-9)
            rows.append(
                [s, number(one.iron_xy_mg, 1), number(one.iron_z_mg, 1), number(share), number(one.nees, 1),
                 number(one.ratio), number(one.to_one_degree_s, 0), number(one.again_s, 0), number(one.ready_s, 0),
                 f"{100 * one.ready_within_60s:.0f} %", f"{100 * one.wrong_share:.2f} %",
                 f"{100 * one.beyond_share:.2f} %", number(one.us_per_sample, 0), number(one.us_first_20s, 0)]
            )  # fmt: skip
        return table(head, rows)

    def overall(self) -> str:
        """One line a method. Ready within a minute is asked where the telemetry is full and the motion is no hover."""
        times = [f"{t:.0f}" for t in CHECKPOINTS_S]
        rivals = [n for n in (BOUND, RIVAL) if n in self.columns()]
        head = ["method", *(f"median @{t}" for t in times), *(f"/ {n} @{t}" for n in rivals for t in times), *_OVERALL]
        rows = []
        count = range(len(CHECKPOINTS_S))
        for name in self.names:
            some = [self.summaries[s, name] for s in self.scenarios if (s, name) in self.summaries]
            here = [s.scenario for s in some]
            middles = [_fold(np.median, [s.full_deg[i] for s in some]) for i in count]
            others = [_fold(np.median, [self.error(s, n, i) for s in here]) for n in rivals for i in count]
            shares = [
                m / b if m is not None and b else None for m, b in zip(middles * len(rivals), others, strict=True)
            ]
            runs = [s for s in self.scored if s.name == name]
            fair = [s for s in runs if SCENARIOS[s.scenario].tells_enough]
            seconds = sum(s.ready_seconds for s in runs)
            judged = seconds > 0
            rows.append(
                [name, *map(number, middles), *map(number, shares), number(max(s.full_deg[-1] for s in some)),
                 number(_fold(np.median, [s.nees for s in some]), 1), number(rms([r for s in runs for r in s.ratios])),
                 f"{100 * sum(s.ready_wrong for s in runs) / seconds:.3f} %" if judged else "",
                 f"{100 * sum(s.ready_beyond for s in runs) / seconds:.3f} %" if judged else "",
                 f"{100 * np.mean([s.ready_s <= 60 for s in fair]):.0f} %" if judged and fair else "",
                 number(float(np.mean([s.us_per_sample for s in runs])), 0)]
            )  # fmt: skip
        return table(head, rows)

    def versus(self, name: str, i: int) -> str:
        """One method's heading error as a share of each rival's at a checkpoint: RMS over the same seeds, with the 95 %
        interval of a seeded bootstrap over seeds. ``<`` marks where all of it lies under 1, ``>`` over."""
        rivals = [n for n in self.names if n != name and not self.judged(n)]
        rows = []
        for s in self.scenarios:
            ours = {r.seed: r.full_deg[i] for r in self.scored if (r.scenario, r.name) == (s, name)}
            cells = []
            for rival in rivals:
                theirs = {r.seed: r.full_deg[i] for r in self.scored if (r.scenario, r.name) == (s, rival)}
                cells.append(_ratio([(ours[k], theirs[k]) for k in ours if k in theirs]))
            rows.append([s, *cells])
        return table(["scenario", *rivals], rows)

    def judged(self, name: str) -> bool:
        """Is this one of the project's own, which claim a sigma?"""
        return any(r.ratios or r.ready_seconds for r in self.scored if r.name == name)

    def filters(self) -> str:
        """Attitude filters with several calibrations, scenario by scenario; RMS over seeds."""
        keys = list(dict.fromkeys((f, c) for h in self.headings.values() for f, cs in h.items() for c in cs))
        rows = []
        for s in self.scenarios:
            some = [h for (scenario, _), h in self.headings.items() if scenario == s]
            if some:
                values = [[h[f][c] for h in some if isinstance(h[f].get(c), float)] for f, c in keys]
                rows.append([s, *(number(rms(v) if v else None) for v in values)])
        return table(["scenario", *(f"{f}, {c}" for f, c in keys)], rows)

    def markdown(self, notes: Sequence[str], details: Callable[[str], bool]) -> str:
        """The whole page. details: of which methods the scenario-by-scenario table is wanted."""
        parts = [*notes, "## All scenarios together\n\n" + self.overall()]
        for i, t in enumerate(CHECKPOINTS_S):
            parts.append(f"## Heading error after {t:.0f} s, degrees RMS\n\n" + self.heading(i))
        soft = [s for s in self.scenarios if any(r.full_deg != r.offsets_deg for r in self.scored if r.scenario == s)]
        if soft:
            text = "## The same after 178 s for what an upload of offsets alone gives\n\n"
            parts.append(text + self.heading(len(CHECKPOINTS_S) - 1, offsets_only=True))
        if self.headings:
            parts.append(
                "## Headings of attitude filters after 60 s, by the iron taken away first\n\n" + self.filters()
            )
        if self.scored and self.judged(self.names[0]) and not all(map(self.judged, self.names)):
            text = f"## {self.names[0]} against each peer after {CHECKPOINTS_S[-1]:.0f} s, share of its error\n\n"
            parts.append(text + self.versus(self.names[0], len(CHECKPOINTS_S) - 1))
        parts += [f"## {name}\n\n" + self.honesty(name) for name in self.names if details(name)]
        return "\n\n".join(parts) + "\n"

    def document(self, facts: dict[str, Any]) -> dict[str, Any]:
        """For JSON."""
        bounds = [
            {"scenario": s, "seed": seed, "heading_deg": list(b.heading_deg), "iron_mg": [list(v) for v in b.iron_mg]}
            for (s, seed), b in self.bounds.items()
        ]
        filters = [{"scenario": s, "seed": seed, "heading_rms_deg": h} for (s, seed), h in self.headings.items()]
        summaries, runs = map(as_dict, self.summaries.values()), map(as_dict, self.scored)
        out: dict[str, Any] = plain(
            {
                **facts,
                "checkpoints_s": list(CHECKPOINTS_S),
                "summaries": list(summaries),
                "runs": list(runs),
                "bounds": bounds,
                "attitude_filters": filters,
            }
        )
        return out


def _ratio(pairs: Sequence[tuple[float, float]]) -> str:
    """RMS of the first over RMS of the second, with its interval over resampled pairs."""
    square = np.square(np.array(pairs).reshape(-1, 2))
    if len(square) == 0 or not square[:, 1].any():
        return ""
    share = float(np.sqrt(square[:, 0].sum() / square[:, 1].sum()))
    if len(square) < 3:
        return number(share)
    drawn = np.random.default_rng(1).integers(0, len(square), (_RESAMPLED, len(square)))
    sums = square[drawn].sum(axis=1)
    low, high = np.sqrt(np.quantile(sums[:, 0] / np.maximum(sums[:, 1], 1e-12), (0.025, 0.975)))
    mark = " <" if high < 1.0 else " >" if low > 1.0 else ""
    return f"{share:.2f} ({low:.2f}-{high:.2f}){mark}"


def _fold(fold: Callable[..., Any], values: Sequence[Cell]) -> Cell:
    some = [v for v in values if v is not None and not math.isnan(v)]
    return float(fold(some)) if some else None
