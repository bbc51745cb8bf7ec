"""AT-14a: one flight as a ground station's .tlog, ArduPilot's .bin and PX4's .ulg gives one answer."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
import pytest
from magmav_sim import Simulation, load_scenario
from magmav_sim.recorder import Recorder, unattended

from magmav.core.types import (
    AttitudeReading,
    AxisState,
    InertialReading,
    MagReading,
    MotionReading,
    ParamReading,
    Record,
    State,
)
from magmav.geomag import world_magnetic_model
from magmav.pipeline import Pipeline
from magmav.recording import open_recording
from magmav.settings import Settings, with_value

pytestmark = pytest.mark.long  # test_fit.py holds AT-14a to the after-flight answer; here it is the pipeline's

KINDS = ("tlog", "bin", "ulg")
CUT_S = 90.0


class Answers(NamedTuple):
    """The last Record by kind of file, what is true, and where the files are."""

    last: dict[str, Record]
    iron_mg: np.ndarray
    device_id: int
    folder: Path


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> Answers:
    """Two figures of eight and most of the landing, written in one pass, then each file through its own reader."""
    folder = tmp_path_factory.mktemp("three")
    scenario = unattended(load_scenario("figure8"))
    sim = Simulation(msgspec.structs.replace(scenario, compasses=scenario.compasses[:1]))
    with Recorder(sim, [folder / f"flight.{kind}" for kind in (*KINDS, "log")]):
        sim.advance(CUT_S)
    last = {kind: learnt(folder / f"flight.{kind}") for kind in KINDS}
    return Answers(last, np.array(sim.truth.hard_iron_b_mg[0]), scenario.compasses[0].device_id, folder)


def learnt(path: Path) -> Record:
    """The last Record, from the pipeline that flies."""
    recording = open_recording(path)
    # The readers are judged: kalman, which knows the down axis of this flight whatever the rate of the samples.
    pipeline = Pipeline(
        with_value(Settings(), "learn", "estimator", "kalman"), world_magnetic_model, recording.unix_offset_ns
    )
    records = [pipeline.step(reading, t_ns) for t_ns, reading in recording.readings()]
    return next(record for record in reversed(records) if record is not None)


def test_the_formats_agree_within_3_mg(answers: Answers) -> None:
    offsets = np.array([answers.last[kind].offsets_mg for kind in KINDS])
    assert np.ptp(offsets, axis=0).max() < 3.0, offsets
    sigmas = np.array([answers.last[kind].sigma_mg for kind in KINDS])
    np.testing.assert_allclose(sigmas, np.broadcast_to(sigmas[0], sigmas.shape), rtol=0.1)


@pytest.mark.parametrize("kind", KINDS)
def test_each_is_right_within_three_of_its_own_sigmas(answers: Answers, kind: str) -> None:
    record = answers.last[kind]
    assert record.verdict.axes == (AxisState.OBSERVED,) * 3 and record.verdict.state is State.READY
    assert not record.relative and record.device_id == answers.device_id
    miss = record.estimate.hard_iron_b_mg - answers.iron_mg
    assert (np.abs(miss) < 3 * record.sigma_mg).all(), (miss, record.sigma_mg)
    assert (record.sigma_mg < 10).all()


def test_measurement_times_agree_within_20_ms_once_delays_are_learnt(answers: Answers) -> None:
    """A .tlog, a .bin and a .ulg stamp one value differently; age and learnt delay together make up for it."""
    lag_s = {kind: r.age_s + r.estimate.delay_s for kind, r in answers.last.items()}
    lag_s["ulg"] += 0.045  # stamped with the middle of what was averaged, where a .bin tells when it was read
    lag_s["tlog"] -= 0.025  # and a .tlog when it was sent, up to 50 ms later still
    assert max(lag_s.values()) - min(lag_s.values()) < 0.02, lag_s


def told(path: Path) -> Iterator[tuple[object, ...]]:
    """What a recording says, as plain values."""
    for t_ns, r in open_recording(path).readings():
        match r:
            case MagReading():
                yield "mag", t_ns, r.compass, *r.field_b_mg
            case InertialReading():
                yield "inertial", t_ns, *r.force_b_mss, *r.rate_b_rads
            case AttitudeReading():
                yield "attitude", t_ns, r.roll_rad, r.pitch_rad, r.yaw_rad, *r.rate_b_rads
            case MotionReading():
                yield "motion", t_ns, r.north_mps, r.east_mps, r.height_m
            case ParamReading():
                yield "param", t_ns, r.name, r.value
            case _:
                yield type(r).__name__, t_ns


def test_the_text_log_says_what_the_binary_one_says(answers: Answers) -> None:
    one, other = (list(told(answers.folder / f"flight.{kind}")) for kind in ("bin", "log"))
    assert len(one) == len(other) > 5000
    assert [r[:2] for r in one] == [r[:2] for r in other]
    for a, b in zip(one, other, strict=True):
        words, others = ([v for v in r if isinstance(v, str)] for r in (a, b))
        numbers, same = ([v for v in r if not isinstance(v, str)] for r in (a, b))
        assert words == others and np.allclose(numbers, same, rtol=1e-6, atol=1e-5), (a, b)
