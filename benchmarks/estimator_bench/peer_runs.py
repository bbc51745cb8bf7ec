"""Peers on a flight: those written here, and those that run in environments of their own."""

from __future__ import annotations

import json
import math
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from estimator_bench import peers
from estimator_bench.flights import STEP_S
from estimator_bench.motions import Array
from estimator_bench.peer_environments import NoEnvironment, python_of
from estimator_bench.running import Heard
from estimator_bench.score import CHECKPOINTS_S, Answer, Scored, score_answers
from estimator_bench.telemetry import BOOT_S, Flight
from magmav.core.types import InertialReading, MagReading

_RUNNERS = Path(__file__).parent / "runners"
_ENOUGH_S = 600.0
_HEADINGS_FROM_S = 60.0
_STEEPEST = math.sin(math.radians(60.0))
OWN = (*peers.EVERY_SECOND, *peers.AT_CHECKPOINTS)
# Name on the command line -> environment, script, further arguments.
FOREIGN = {
    "mavproxy": ("mavproxy", "mavproxy.py", ("plain",)),
    "mavproxy_ell": ("mavproxy", "mavproxy.py", ("elliptical",)),
    "magyc": ("magyc", "magyc_shipped.py", ()),
}
ATTITUDE_FILTERS = "ahrs"
NAMES = (*OWN, *FOREIGN, ATTITUDE_FILTERS)


@dataclass(frozen=True, slots=True)
class Ready:
    """The peers that can be run: names, the Pythons of those that need one, and why others cannot."""

    names: tuple[str, ...]
    pythons: dict[str, str] = field(default_factory=dict)
    missing: tuple[str, ...] = ()


def ready(names: Sequence[str], say: Callable[[str], None]) -> Ready:
    """Make the environments that are wanted. What cannot be made is said, not raised."""
    pythons: dict[str, str] = {}
    missing: dict[str, str] = {}
    able = []
    for name in names:
        environment = FOREIGN[name][0] if name in FOREIGN else name if name == ATTITUDE_FILTERS else None
        if environment is not None and environment not in {*pythons, *missing}:
            try:
                pythons[environment] = str(python_of(environment, say))
            except NoEnvironment as error:
                missing[environment] = str(error)
                say(str(error))
        if environment not in missing:
            able.append(name)
    return Ready(tuple(able), pythons, tuple(missing.values()))


def peer_scores(flight: Flight, heard: list[Heard], able: Ready) -> list[Scored]:
    """Every peer that estimates iron, on one flight."""
    c = peers.columns(heard)
    out = []
    for name in able.names:
        if name in OWN:
            every = np.arange(1.0, 179.0) if name in peers.EVERY_SECOND else np.array(CHECKPOINTS_S)
            got = [(float(t), _plain(peers.answers(name, c, float(t)))) for t in every]
            out.append(score_answers(flight, name, got))
        elif name in FOREIGN:
            environment, script, more = FOREIGN[name]
            told = _told(able.pythons[environment], script, more, _packed(flight, c))
            for label, values in told.items():
                out.append(score_answers(flight, label, list(zip(CHECKPOINTS_S, map(_foreign, values), strict=True))))
    return out


def _plain(hard_iron_mg: Array | None) -> Answer | None:
    return None if hard_iron_mg is None else Answer(hard_iron_mg, np.eye(3))


def _foreign(value: dict[str, Any]) -> Answer | None:
    if "error" in value:
        return None
    return Answer(np.array(value["hard_iron_mg"]), np.array(value["matrix"]))


def _packed(flight: Flight, c: peers.Columns) -> dict[str, Any]:
    """For a runner. The model's field is told even where no position is sent: MAVProxy lets one type it in."""
    return {
        **dict(zip(("t_s", "mag_mg", "rate_rads", "roll_rad", "pitch_rad"), c[:5], strict=True)),
        "model_n_mg": flight.errors.model_n_mg,
        "checkpoints_s": np.array(CHECKPOINTS_S),
    }


def _told(python: str, script: str, more: Sequence[str], data: dict[str, Any]) -> dict[str, Any]:
    """What a runner prints about these data. RuntimeError with its last words where it breaks."""
    with TemporaryDirectory() as folder:
        file = Path(folder) / "flight.npz"
        np.savez(file, **data)
        got = subprocess.run(
            [python, str(_RUNNERS / script), str(file), *more], capture_output=True, text=True, timeout=_ENOUGH_S
        )
    if got.returncode != 0:
        last = got.stderr.strip().splitlines()[-1:] or ["no word"]
        raise RuntimeError(f"{script}: {last[0][:200]}")
    out: dict[str, Any] = json.loads(got.stdout)
    return out


def shipped_pins(python: str, data: dict[str, Any]) -> dict[str, Any]:
    """What magyc as shipped says of data that a test or a table was made from."""
    return _told(python, "magyc_shipped.py", (), data)


# ---------------------------------------------------------------- attitude filters


def filter_headings(flight: Flight, irons_mg: dict[str, Array], able: Ready) -> dict[str, dict[str, float]]:
    """RMS heading error, degrees, of attitude filters after 60 s: name -> which calibration -> error.

    irons_mg : hard irons to take away, by label. Where the nose points steeply up or down nothing is scored.
    """
    if ATTITUDE_FILTERS not in able.names or flight.scenario.link.imu_hz < 10.0:
        return {}
    inertial = {r.boot_ns: r for _, r in flight.readings if isinstance(r, InertialReading)}
    pairs = [
        (inertial[r.boot_ns], r) for _, r in flight.readings if isinstance(r, MagReading) and r.boot_ns in inertial
    ]
    t_s = np.array([m.boot_ns / 1e9 - BOOT_S for _, m in pairs])
    order = np.flatnonzero(np.diff(t_s, prepend=-1.0) > 0.0)
    index = np.clip(np.round(t_s / STEP_S).astype(int), 0, len(flight.truth.t_s) - 1)
    nose = flight.truth.C_bn[index, 0, :]
    north, east, _ = flight.errors.field_n_mg
    heading = np.arctan2(nose[:, 1], nose[:, 0]) - math.atan2(east, north)
    level = np.abs(nose[:, 2]) < _STEEPEST
    data = {
        "imu_t_s": t_s[order],
        "imu_rate_rads": np.array([i.rate_b_rads for i, _ in pairs])[order],
        "imu_force_mss": np.array([i.force_b_mss for i, _ in pairs])[order],
        "imu_mag_mg": np.array([m.field_b_mg for _, m in pairs])[order],
        "imu_heading_rad": heading[order],
        "imu_scored": (level & (t_s > _HEADINGS_FROM_S))[order],
        "labels": np.array(list(irons_mg)),
        "hard_irons_mg": np.array(list(irons_mg.values())),
    }
    return _told(able.pythons[ATTITUDE_FILTERS], "attitude_filters.py", (), data)
