"""The rows as Markdown, with the targets of the project beside them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from real_bench.held_out import HeldOut
from real_bench.magnets import MagnetRow
from real_bench.ready import Ready

TARGET_ESTIMATOR = "adaptive"
ONSET_S = 10.0


def held_out_target(file: str, compass: int, learn_for_s: float) -> float | None:
    """Most that the heading RMS may be, degrees; None where nothing is demanded."""
    if file == "thor75.tlog":
        return 4.0 if learn_for_s == 30.0 else 3.4 if learn_for_s == 60.0 else 3.6 if learn_for_s <= 250.0 else None
    return (
        {(1, 30.0): 3.8, (2, 30.0): 5.2, (3, 60.0): 6.2}.get((compass, learn_for_s)) if file == "log171.bin" else None
    )


def num(value: float | None, digits: int = 2) -> str:
    """A number, or a dash."""
    return "-" if value is None else f"{value:.{digits}f}"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = ["| " + " | ".join(head) + " |", "|" + "|".join("---" if i < 1 else "--:" for i in range(len(head))) + "|"]
    return "\n".join([*lines, *("| " + " | ".join(r) + " |" for r in rows)])


def held_out_table(rows: list[HeldOut]) -> str:
    """One line per recording, compass and time; per estimator full / offsets (claimed sigma)."""
    names = list(dict.fromkeys(r.estimator for r in rows))
    keys = list(dict.fromkeys((r.file, r.compass, r.learn_for_s) for r in rows))
    by = {(r.file, r.compass, r.learn_for_s, r.estimator): r for r in rows}
    lines = []
    for key in keys:
        mine = [by[(*key, n)] for n in names]
        file, compass, s = key
        cells = [f"{file} {compass}", f"{s:.0f}", num(mine[0].best_deg), num(held_out_target(*key), 1)]
        for r in mine:
            late = held_out_late(r)
            full = f"**{num(r.full_deg)}**" if late else num(r.full_deg)
            cells.append(f"{full} / {num(r.offsets_deg)} ({num(r.sigma_deg, 1)})")
        lines.append(cells)
    return table(["recording, compass", "S", "r", "target", *names], lines)


def held_out_late(r: HeldOut) -> bool:
    """Worse than the target."""
    target = held_out_target(r.file, r.compass, r.learn_for_s)
    return target is not None and (r.full_deg is None or r.full_deg > target)


def ready_table(rows: list[Ready]) -> str:
    """One line per recording, compass and estimator."""
    lines = []
    for r in rows:
        why = ", ".join(f"{k} {v:.0f}" for k, v in list(r.why_not.items())[:5])
        cells = [f"{r.file} {r.compass}", r.estimator, num(r.flown_s, 0), num(r.after_s, 1), f"{100 * r.share:.0f} %"]
        cells += [num(r.full_deg), num(r.offsets_deg), num(r.sigma_deg, 1), num(r.best_rest_deg), num(r.best_deg)]
        cells += [
            "-" if r.wrong is None else "WRONG" if r.wrong else "right",
            f"{r.wrong_s:.0f} / {r.offsets_wrong_s:.0f} of {r.ready_s:.0f}",
            why,
        ]
        lines.append(cells)
    head = ["recording, compass", "estimator", "flown s", "READY after s", "READY", "RMS", "offsets only", "sigma"]
    return table([*head, "r rest", "r all", "then", "wrong s: full / offsets", "s against it"], lines)


def ready_missed(r: Ready) -> list[str]:
    """What the project demands and this is not."""
    out = []
    if r.wrong_s:
        out.append(f"READY while wrong ({r.wrong_s:.0f} of {r.ready_s:.0f} s)")
    if r.offsets_wrong_s:
        out.append(f"READY while the offsets alone are wrong ({r.offsets_wrong_s:.0f} of {r.ready_s:.0f} s)")
    thor = r.file == "thor75.tlog"
    if not thor and (r.file != "log171.bin" or r.compass not in (1, 2)):
        return out
    if r.after_s is None:
        return [*out, "never READY"]
    if thor and r.after_s > 120.0:
        out.append(f"READY after {r.after_s:.0f} s, want 120")
    if r.full_deg is None or r.full_deg > 5.0:
        out.append(f"{num(r.full_deg)} degrees when first READY, want 5")
    return out


def magnet_table(rows: list[MagnetRow]) -> str:
    """One line per recording, way and estimator and per coming and going of the magnet."""
    lines = []
    for r in rows:
        for s in r.spells:
            cells = [f"{r.file} {s.what}", r.way, r.estimator, num(s.from_s, 1), num(s.turning_from_s, 1)]
            cells += [num(s.turned_before_s, 0), num(s.level_s, 1), num(s.flown_s, 1)]
            cells += [f"{num(s.level_deg)} ({num(s.level_best_deg)})", f"{num(s.flown_deg)} ({num(s.flown_best_deg)})"]
            cells += ["/".join(f"{v:.0f}" for v in s.iron_error_mg)]
            cells += [f"{r.ready_s:.0f}", f"{r.ready_wrong_s:.1f}", f"{r.odd_wrong_s:.1f}"]
            lines.append(cells)
    head = ["recording, magnet", "tilt", "estimator", "from s", "turned from s", "turned before, s"]
    head += ["level: s to 1 deg", "flown: s to 1 deg", "level at end (optical offset)", "flown at end (optical offset)"]
    return table([*head, "iron error at end, mG", "READY s", "of it wrong s", "and on the way s"], lines)


def magnet_missed(r: MagnetRow) -> list[str]:
    """What the project demands and this is not."""
    out = []
    for s in r.spells:
        if s.what != "none" and s.turned_before_s > 5.0 and (s.level_s is None or s.level_s > ONSET_S):
            out.append(f"magnet {s.what}: within one degree after {num(s.level_s, 1)} s, want {ONSET_S:.0f}")
    if r.wrongs:
        when = ", ".join(f"{a:.1f}-{b:.1f}" for a, b in r.wrongs)
        out.append(f"READY while wrong for {r.ready_wrong_s:.1f} s, and {r.odd_wrong_s:.1f} s on the way (boot {when})")
    return out
