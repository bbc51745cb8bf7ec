"""When was READY said first, and was that right?

Wrong is a calibration whose held-out heading error, over the rest of the flight, is beyond 3 sqrt(sigma^2 + r^2): sigma
the heading's own claimed sigma at that moment, r what the best constant offset leaves on that recording.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

from magmav.core.types import State
from real_bench.held_out import LEAST_REST_S, Judge
from real_bench.running import Moment, offsets_to_store
from real_bench.tapes import Tape


@dataclass(frozen=True, slots=True)
class Ready:
    """One compass, one estimator. None where it was never READY, or nothing was left to judge it by.

    after_s : seconds of flying until the first READY.  share : of flying seconds spent READY.
    ready_s, wrong_s : seconds READY while flying with enough of the flight left to judge by, and those of them wrong.
    offsets_wrong_s : those where the offsets alone, which is what an upload writes, are wrong by the same rule.
    why_not : how many flying seconds each reason stood against it.
    """

    file: str
    compass: int
    estimator: str
    flown_s: float
    after_s: float | None
    share: float
    full_deg: float | None
    offsets_deg: float | None
    sigma_deg: float | None
    best_rest_deg: float | None
    best_deg: float | None
    wrong: bool | None
    ready_s: float
    wrong_s: float
    offsets_wrong_s: float
    why_not: dict[str, float]


def ready(judge: Judge, estimator: str, moments: list[Moment]) -> Ready:
    """One row. Every fifth second of READY is judged like the first."""
    tape: Tape = judge.tape
    flying = [m for m in moments if m.flying and m.boot_s < judge.crash_s]
    spent = [b.flown_s - a.flown_s for a, b in pairwise(flying)] + [0.0]
    total = sum(spent)
    is_ready = [m.state is State.READY for m in flying]
    why_not: dict[str, float] = {}
    for m, dt, yes in zip(flying, spent, is_ready, strict=True):
        for reason in () if yes else m.reasons:
            why_not[reason] = why_not.get(reason, 0.0) + dt
    said = [m for m, yes in zip(flying, is_ready, strict=True) if yes]
    best = judge.best(0.0)
    judged: list[tuple[Moment, float, float | None, float | None, float | None, bool, bool]] = []
    for m in said:
        frozen_s = m.boot_s - tape.started_s
        if judged and m.boot_s - judged[-1][0].boot_s < 5.0:
            continue
        if judge.rest_s(frozen_s) < LEAST_REST_S:
            break
        full, offsets, _ = judge.score(frozen_s, m.estimate, offsets_to_store(tape, judge.compass, m.estimate))
        sigma = judge.sigma_deg(frozen_s, m.estimate)
        most = 3.0 * math.hypot(sigma or 0.0, best or 0.0)
        judged.append((m, frozen_s, full, offsets, sigma, (full or 0.0) > most, (offsets or 0.0) > most))
    first = judged[0] if judged else None
    return Ready(
        file=tape.name,
        compass=judge.compass,
        estimator=estimator,
        flown_s=total,
        after_s=said[0].flown_s if said else None,
        share=sum(dt for dt, yes in zip(spent, is_ready, strict=True) if yes) / total if total else 0.0,
        full_deg=first[2] if first else None,
        offsets_deg=first[3] if first else None,
        sigma_deg=first[4] if first else None,
        best_rest_deg=judge.best(first[1]) if first else None,
        best_deg=best,
        wrong=first[5] if first else None,
        ready_s=5.0 * len(judged),
        wrong_s=5.0 * sum(j[5] for j in judged),
        offsets_wrong_s=5.0 * sum(j[6] for j in judged),
        why_not=dict(sorted(why_not.items(), key=lambda kv: -kv[1])),
    )
