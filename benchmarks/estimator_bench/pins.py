"""Peers that had to be corrected, held to a case whose answer is known, as shipped and as written here.

The reference study gives, for a noise-free tumble with a hard iron of (50, -80, 30) mG: SAR-LS as shipped
(94.8, -98.2, 59.5) against (50.0, -79.9, 30.2); SAR-KF (-18, -40, 53) against (50.1, -79.7, 30.1); SAR-AID
(4, 104, -6) against (52.2, -81.5, 30.0). Its tumble is not told, so the shipped figures here are those of ours; they
must be as wrong, and the corrected ones as right. ``sar_ls(shipped=True)`` has the one error named and nothing else:
where it gives what the package gives, that error is all that is wrong with it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from estimator_bench import peers
from estimator_bench.flights import body_rates, rotations
from estimator_bench.motions import Array
from estimator_bench.peer_runs import shipped_pins

IRON_MG = np.array((50.0, -80.0, 30.0))
FIELD_N_MG = np.array((210.0, 15.0, 430.0))


@dataclass(frozen=True, slots=True)
class Pin:
    """One method. shipped: the package's answer, its error as text, or None where it is not installed."""

    method: str
    corrected_mg: list[float]
    shipped: list[float] | str | None
    error_alone_mg: list[float] | None  # our own equations with the one known error put in


def tumble(seconds: float = 60.0, hz: float = 50.0) -> tuple[Array, Array, Array]:
    """Times (N,) s, fields (N, 3) mG and rates (N, 3) rad/s of a noise-free tumble about all axes."""
    fine = 20
    t = np.arange(round(seconds * hz) * fine) / (hz * fine)
    C = rotations(1.6 * np.sin(0.9 * t) + 0.3 * t, 1.2 * np.sin(0.7 * t + 1.0), 1.5 * np.sin(0.5 * t) + 0.2 * t)
    field = C @ FIELD_N_MG + IRON_MG
    rate = body_rates(C, 1.0 / (hz * fine))
    return t[::fine], field[::fine], rate[::fine]


def pins(python: str | None) -> list[Pin]:
    """All corrected methods. python: of the environment that holds magyc, or None."""
    t_s, mag, rate = tumble()
    told = {}
    if python is not None:
        nil = np.zeros(len(t_s))
        told = shipped_pins(
            python,
            {"t_s": t_s, "mag_mg": mag, "rate_rads": rate, "roll_rad": nil, "pitch_rad": nil,
             "model_n_mg": FIELD_N_MG, "checkpoints_s": np.array([1e9])},
        )  # fmt: skip
    length = float(np.linalg.norm(FIELD_N_MG))
    methods: dict[str, Callable[[], Array | None]] = {
        "sar_ls": lambda: peers.sar_ls(t_s, mag, rate),
        "sar_kf": lambda: peers.sar_kf(t_s, mag, rate),
        "sar_aid": lambda: peers.sar_aid(t_s, mag, rate),
        "twostep_hi": lambda: peers.twostep(mag, length),
    }
    out = []
    for name, method in methods.items():
        got = method()
        shipped = told.get(f"{name} (shipped)", [None])[0]
        said = None if shipped is None else shipped.get("error", shipped.get("hard_iron_mg"))
        wrong = peers.sar_ls(t_s, mag, rate, shipped=True) if name == "sar_ls" else None
        corrected = [] if got is None else got.tolist()
        out.append(Pin(name, corrected, said, None if wrong is None else wrong.tolist()))
    return out


def pin_table(some: list[Pin]) -> str:
    """Markdown."""

    def cell(value: list[float] | str | None) -> str:
        if value is None:
            return ""
        return value if isinstance(value, str) else ", ".join(f"{v:.1f}" for v in value)

    x, y, z = IRON_MG
    head = f"## Corrected peers on a noise-free tumble; the truth is ({x:.0f}, {y:.0f}, {z:.0f}) mG\n\n"
    rows = ["| method | as shipped in magyc 1.0.0 | the known error alone | corrected |", "|---|---|---|---|"]
    rows += [f"| {p.method} | {cell(p.shipped)} | {cell(p.error_alone_mg)} | {cell(p.corrected_mg)} |" for p in some]
    return head + "\n".join(rows) + "\n"
