"""The stretch of a flight that is known whole afterwards: which Samples, and each with a frame of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby

from magmav.core.rotation import body_from_earth
from magmav.core.types import Sample, mat3


def flown(samples: Sequence[Sample]) -> list[Sample]:
    """The last stretch that taught and was not in somebody's hands; all that taught where nothing flew."""
    in_hands = False
    runs: list[tuple[bool, list[Sample]]] = []

    def hands(s: Sample) -> bool:
        nonlocal in_hands
        in_hands = s.by_hand if s.learn else in_hands  # what does not teach belongs to what came before
        return in_hands

    runs = [(held, list(run)) for held, run in groupby(samples, key=hands)]
    taught = [(held, run) for held, run in runs if any(s.learn for s in run)]
    if not taught:
        return []
    aloft = [run for held, run in taught if not held]
    return (aloft or [run for _, run in taught])[-1]


def framed(samples: Sequence[Sample]) -> list[Sample]:
    """Each with its own frame, so that no yaw need be summed; and the field known from the first on."""
    model_mg = next((s.model_mg for s in samples if s.learn and s.model_mg is not None), None)
    out: list[Sample] = []
    yaw = 0.0
    for s in samples:
        yaw += s.yaw_step_rad
        if s.body_from_own is None:
            frame = mat3(body_from_earth(s.roll_rad, s.pitch_rad, yaw), "own frame")
            s = replace(s, body_from_own=frame)
        out.append(s if s.model_mg is not None or model_mg is None else replace(s, model_mg=model_mg))
    return out
