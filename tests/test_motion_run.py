"""A run of attitudes leaves everything behind it as its readings one by one would have: Samples, scores, counts."""

from __future__ import annotations

import math
import os
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dataflash_writer import ARM, ATT, IMU, MAG, MSG, Log
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.core.lately import Lately
from magmav.core.motion import Motion
from magmav.core.motion_run import MotionRun, attitude_columns
from magmav.core.own_frame import matrix
from magmav.core.types import AttitudeReading, Reading, Sample, vec3
from magmav.geomag import world_magnetic_model
from magmav.logs import Recording
from magmav.pipeline import Pipeline
from magmav.recording import Keeper, open_recording, play
from magmav.service import all_counts
from magmav.settings import Settings

DATA = Path(os.environ.get("MAGMAV_DATA", Path(__file__).parents[2] / "shared" / "data"))
NEAR = 1e-9  # sums made in another order


class Singly:
    """The same recording with no runs in it."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording

    def in_runs(self) -> Iterator[tuple[int, Reading]]:
        return self._recording.readings()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._recording, name)


def gone_through(recording: Any) -> tuple[list[tuple[Sample, tuple[int, int]]], dict[int, Any], dict[str, Any], int]:
    """Samples with their stretches, each system's attitudes, what was counted, and how many attitudes were in runs."""
    taken: list[tuple[Sample, tuple[int, int]]] = []
    rows = 0
    pipeline = Pipeline(
        Settings(), world_magnetic_model, recording.unix_offset_ns, lambda s, _, where: taken.append((s, where)), True
    )
    keeper = Keeper(pipeline, None)
    watched = keeper.run

    def count(run: MotionRun) -> None:
        nonlocal rows
        rows += run.end - run.begin
        watched(run)

    keeper.run = count  # type: ignore[method-assign]
    play(recording, pipeline, keeper)
    keeper.bring_back()
    tables = {}
    for system in pipeline.vehicles:
        reference = keeper.reference(system, None)
        if reference is not None:
            parts = (reference.boot_s, reference.roll_rad, reference.pitch_rad, reference.yaw_true_rad)
            tables[system] = np.array((*parts, reference.armed, reference.airborne), dtype=np.float64)
    flights = {s: [f.as_seconds() for f in v.phase.flights] for s, v in pipeline.vehicles.items()}
    return taken, tables, {**all_counts({"log": dict(recording.counts)}, pipeline), "flights": flights}, rows


def split(sample: Sample, where: tuple[int, int]) -> tuple[list[object], list[float]]:
    """What must be equal, and numbers that may differ by rounding."""
    exact, numbers = [*where], list[float]()
    for name in Sample.__dataclass_fields__:
        value = getattr(sample, name)
        if isinstance(value, float):
            numbers.append(value)
        elif isinstance(value, np.ndarray):
            numbers += value.ravel().tolist()
        else:
            exact.append(value.matrix.tolist() if name == "shaping" else value)
    return exact, numbers


def same(path: Path) -> tuple[int, int]:
    """The law. How many Samples there were, and attitudes in runs."""
    ours, tables, counts, rows = gone_through(open_recording(path))
    theirs, their_tables, their_counts, none = gone_through(Singly(open_recording(path)))
    assert none == 0
    assert len(ours) == len(theirs)
    told, their_told = ([split(*one) for one in taken] for taken in (ours, theirs))
    assert [exact for exact, _ in told] == [exact for exact, _ in their_told]
    numbers, their_numbers = (np.array([v for _, row in both for v in row]) for both in (told, their_told))
    np.testing.assert_allclose(numbers, their_numbers, rtol=0.0, atol=NEAR)
    assert counts == their_counts
    assert tables.keys() == their_tables.keys()
    for system, table in tables.items():
        np.testing.assert_array_equal(table, their_tables[system])
    return len(ours), rows


def course(rng: random.Random, seconds: float, wild: float) -> Iterator[tuple[float, list[float], list[float]]]:
    """Time, roll, pitch, yaw and body rates, 50 times a second. wild : rad of swing; over 1.6 it goes past the top."""
    parts = [(rng.uniform(0.2, 3.0), rng.uniform(0.0, math.tau), rng.uniform(0.2, 1.0)) for _ in range(3)]
    for k in range(round(seconds * 50.0)):
        t = 0.02 * k
        roll, pitch = (wild * p * math.sin(w * t + o) for w, o, p in parts[:2])
        yaw = math.remainder(0.3 * t + parts[2][2] * math.sin(parts[2][0] * t), math.tau)
        rates = [rng.gauss(0.0, 0.3) for _ in range(3)]
        yield t, [roll, math.remainder(pitch, math.pi), yaw], rates


def troubled(seed: int, wild: float) -> bytes:
    """A minute of a copter with every trouble an attitude can have on its way."""
    rng = random.Random(seed)
    out: list[bytes] = []
    boot_ms, mav = 5000.0, dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    stranger = dialect.MAVLink(None, srcSystem=1, srcComponent=154)
    kinds = (
        ("none", 60),
        ("lost", 8),
        ("late", 4),
        ("twice", 4),
        ("pause", 1),
        ("nan", 2),
        ("stranger", 4),
        ("other", 2),
    )
    names, weights = zip(*kinds, strict=True)
    reboot_at = rng.uniform(15.0, 40.0) if rng.random() < 0.5 else math.inf
    for t, angles, rates in course(rng, 50.0, wild):
        if t > reboot_at:
            boot_ms, reboot_at = -1000.0 * t + 300.0, math.inf
        trouble = rng.choices(names, weights)[0]
        now = int(boot_ms + 1000.0 * t)
        if trouble == "pause":
            boot_ms += rng.choice((300.0, 900.0, 3000.0, 8000.0))
        if trouble == "nan":
            angles[rng.randrange(3)] = math.nan
        told = [dialect.MAVLink_attitude_message(now, *angles, *rates)]
        if round(t * 50) % 50 == 0:
            told.append(dialect.MAVLink_heartbeat_message(2, 3, 128 if t > 10.0 else 0, 0, 4, 3))
            told.append(dialect.MAVLink_global_position_int_message(now, 474000000, 85000000, 500000, 0, 0, 0, 0, 0))
            told[-1].relative_alt = 12_000 if 13.0 < t < 40.0 else 0
        if round(t * 50) % 5 == 2:
            field = [round(200.0 * math.cos(t + i)) + rng.randrange(9) for i in range(3)]
            told.append(dialect.MAVLink_raw_imu_message(now * 1000 + 700, 1, 2, -1000, 3, 4, 5, *field))
        if trouble == "lost":
            told = told[1:]
        elif trouble == "twice":
            told.insert(0, told[0])
        elif trouble == "other":
            told.append(dialect.MAVLink_scaled_imu2_message(now, 1, 2, -1000, 3, 4, 5, 100, 200, rng.randrange(300)))
        frames = [bytes(m.pack(mav)) for m in told]
        if trouble == "stranger":
            frames.append(bytes(dialect.MAVLink_attitude_message(now + 5, 0.1, 0.2, 0.3, 0, 0, 0).pack(stranger)))
        stamp = (1_700_000_000_000_000 + round(t * 1e6)).to_bytes(8, "big")
        records = [stamp + frame for frame in frames]
        if trouble == "late" and out:
            out.insert(len(out) - 1, records.pop(0))
        out += records
    return b"".join(out)


@pytest.mark.parametrize("wild", [0.4, 2.5])
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=4, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_tlog_with_every_trouble(tmp_path: Path, wild: float, seed: int) -> None:
    path = tmp_path / "a.tlog"
    path.write_bytes(troubled(seed, wild))
    samples, rows = same(path)
    assert samples > 100
    assert rows > 1000 if wild < 1.0 else rows > 200


@pytest.mark.parametrize("wild", [0.4, 2.5])
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=4, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_dataflash_log_with_the_gyro_between_the_attitudes(tmp_path: Path, wild: float, seed: int) -> None:
    rng, log = random.Random(seed), Log()
    log.add(MSG, 5_000_000, "ArduCopter V4.5.1 (written)")
    log.add(ARM, 5_000_000, 1, 0)
    us = 5_000_000
    for t, (roll, pitch, yaw), rates in course(rng, 40.0, wild):
        us += 20_000 if rng.random() > 0.01 else rng.choice((0, 150_000, 700_000, 7_000_000))
        for _ in range(rng.choice((0, 1, 1, 2))):
            log.add(IMU, us - rng.randrange(9000), 0, *rates, 0.1, 0.2, -9.8)
        if rng.random() > 0.05:
            angles = (math.degrees(v) for v in (roll, pitch))
            log.add(ATT, us, 0.0, next(angles), 0.0, next(angles), 0.0, math.degrees(yaw) % 360.0)
        if round(t * 50) % 5 == 0:
            for number in range(2):
                field = [round(200.0 * math.cos(t + i)) + rng.randrange(9) for i in range(3)]
                log.add(MAG, us, number, *field, *(0,) * 6, 1, us)
    path = tmp_path / "a.bin"
    path.write_bytes(log.binary())
    samples, rows = same(path)
    assert samples > 100
    assert rows > 300


@pytest.mark.parametrize("name", ["thor75.tlog", "log171.bin"])
def test_real_flights(name: str) -> None:
    found = next(iter(DATA.glob(f"**/{name}")), None)
    if found is None:
        pytest.skip(f"{name} is not here (MAGMAV_DATA)")
    samples, rows = same(found)
    assert samples > 1000
    assert rows > 1000


def test_the_columns_own_frame_is_the_one_that_readings_one_by_one_build_up() -> None:
    """Over ten thousand steps, without a mag between them: no error of the summing may grow."""
    rng = random.Random(4)
    rows = list(course(rng, 200.0, 1.2))
    boot_ns = np.array([round(1e9 * t) + 7 for t, _, _ in rows])
    angles, rates = np.array([a for _, a, _ in rows]), np.array([r for _, _, r in rows])
    good = np.ones(len(rows), dtype=bool)
    columns = attitude_columns("ATTITUDE", boot_ns, angles, rates, good, np.zeros(len(rows), dtype=np.int64))
    assert columns.joined[1:].all()
    motion = Motion()
    for t, a, r in zip(boot_ns.tolist(), angles.tolist(), rates, strict=True):
        motion.attitude(AttitudeReading(1, "ATTITUDE", t, a[0], a[1], a[2], vec3(r, "rate")))
    last = motion.at(int(boot_ns[-1]))
    assert last is not None
    frame = columns.rows[-1, 9:13].tolist()
    np.testing.assert_allclose(matrix((frame[0], frame[1], frame[2], frame[3])), last.body_from_own, atol=NEAR)
    assert columns.rows[-1, 13] == pytest.approx(last.yaw_rad, abs=NEAR)


def test_a_run_that_begins_before_the_newest_attitude_does_not_follow() -> None:
    boot_ns = np.array([100, 200]) * 10_000_000
    columns = attitude_columns(
        "ATTITUDE", boot_ns, np.zeros((2, 3)), np.zeros((2, 3)), np.ones(2, dtype=bool), np.zeros(2, dtype=np.int64)
    )
    lately, motion = Lately(), Motion()
    assert lately.before(0)
    run = MotionRun(1, columns, 0, 2, 1_000_000_000, 2_000_000_000, lambda: iter(()))
    assert motion.follows(run)
    motion.attitude(AttitudeReading(1, "ATTITUDE", 1_500_000_000, 0.0, 0.0, 0.0, vec3((0, 0, 0), "rate")))
    assert not motion.follows(run)
