"""A .tlog read by columns gives the readings that a link gives of it, in the same order, with the same counts."""

from __future__ import annotations

import dataclasses
import os
import random
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect
from tlog_parity import HARM, START_US, Harm, cut, flight, flip, harmed

from magmav.core.types import MagReading, Reading
from magmav.hearing import LinkRecording
from magmav.link import LinkError
from magmav.link.tlog import TlogLink
from magmav.recording import open_recording
from magmav.tlog_recording import TlogRecording

DATA = Path(os.environ.get("MAGMAV_DATA", Path(__file__).parents[2] / "shared" / "data"))


def every_bit(reading: Reading) -> list[object]:
    """A reading as what can be compared: type, numbers to the last bit, arrays as their bytes."""
    values = [getattr(reading, f.name) for f in dataclasses.fields(reading)]
    return [type(reading), *(v.tobytes() if isinstance(v, np.ndarray) else (type(v), repr(v)) for v in values)]


def same(path: Path) -> int:
    """The law of this file; how many readings there were."""
    one, other = TlogRecording(path), LinkRecording(TlogLink(path))
    ours = [(t, every_bit(r)) for t, r in one.readings()]
    theirs = [(t, every_bit(r)) for t, r in other.readings()]
    assert ours == theirs
    assert one.by_storey() == other.by_storey() and one.counts == other.counts
    assert one.heard == other.heard and one.name == other.name and one.unix_offset_ns == other.unix_offset_ns
    return len(ours)


@pytest.mark.parametrize("seed", range(6))
def test_same_readings_and_counts_of_several_vehicles(tmp_path: Path, seed: int) -> None:
    path = tmp_path / "a.tlog"
    path.write_bytes(b"".join(flight(seed, 300)))
    assert same(path) > 50
    told = TlogRecording(path)
    got = [r for _, r in told.readings()]
    assert {r.system for r in got} == {1, 2, 255}
    assert told.counts["not from the autopilot"] > 5 and told.counts["ATTITUDE: not a number"] > 3
    assert all(not r.field_b_mg.flags.writeable for r in got if isinstance(r, MagReading))


@given(seed=st.integers(0, 2**32 - 1), harm=st.lists(st.sampled_from(HARM), min_size=1, max_size=5))
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_same_readings_however_damaged(tmp_path: Path, seed: int, harm: list[Harm]) -> None:
    path = tmp_path / "a.tlog"
    path.write_bytes(harmed(seed, harm))
    try:
        TlogLink(path).close()
    except LinkError:
        with pytest.raises(LinkError):
            TlogRecording(path)
        return
    same(path)


@pytest.mark.parametrize("seed", range(4))
def test_garbage_and_other_components_between_all_frames_change_no_reading(tmp_path: Path, seed: int) -> None:
    """To the last bit: a fit of the dirty file is the fit of the clean one."""
    rng, clean, dirty = random.Random(seed), [], []
    mav, other = (dialect.MAVLink(None, srcSystem=1, srcComponent=component) for component in (1, 154))
    gimbal = [
        dialect.MAVLink_heartbeat_message(26, 8, 0, 0, 0, 3),
        dialect.MAVLink_attitude_message(7, 0.3, 0.2, 0.1, 0.0, 0.0, 0.0),
        dialect.MAVLink_param_value_message(b"COMPASS_OFS_X", 99.0, 9, 10, 1),
    ]
    for number in range(200):
        stamp = (START_US + 40_000 * number).to_bytes(8, "big")
        ms = 5000 + 40 * number
        if number % 25 == 0:
            some = dialect.MAVLink_heartbeat_message(2, 3, 128, 4, 4, 3)
        elif number % 2:
            some = dialect.MAVLink_attitude_message(ms, *(rng.uniform(-0.5, 0.5) for _ in range(6)))
        else:
            some = dialect.MAVLink_raw_imu_message(1000 * ms, *(rng.randrange(-900, 900) for _ in range(9)))
        clean.append(stamp + bytes(some.pack(mav)))
        if number > 1 and rng.random() < 0.8:  # two in a row tell that this is a tlog
            dirty.append(rng.randbytes(rng.randrange(1, 300)))
        if number > 1 and rng.random() < 0.3:
            dirty.append(stamp + bytes(rng.choice(gimbal).pack(other)))
        dirty.append(clean[-1])
    heard = []
    for name, parts in (("clean.tlog", clean), ("dirty.tlog", dirty)):
        (path := tmp_path / name).write_bytes(b"".join(parts))
        assert same(path) > 250
        heard.append([(t, every_bit(r)) for t, r in TlogRecording(path).readings()])
    assert heard[0] == heard[1]


@pytest.mark.parametrize(
    ("xyz", "mag", "usec"),
    [
        ((0, 0, 0), (100, 200, 300), 10**6),
        ((1, 0, 0), (0, 0, 0), 10**6),
        ((1, 2, 3), (-32768, 0, 0), 10**6),
        ((1, 2, 3), (0, 32767, 0), 10**6),
        ((-32768, 32767, 1), (32766, -32767, 1), 10**14),
        ((1, 2, 3), (1, 2, 3), 10**14 + 1),
        ((1, 2, 3), (1, 2, 3), 2**64 - 1),
    ],
)
@pytest.mark.parametrize("autopilot", [3, 12])
def test_every_way_an_imu_may_be_silent(
    tmp_path: Path, xyz: tuple[int, int, int], mag: tuple[int, int, int], usec: int, autopilot: int
) -> None:
    mav = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    some = [
        dialect.MAVLink_heartbeat_message(2, autopilot, 128, 4, 4, 3),
        dialect.MAVLink_raw_imu_message(usec, *xyz, 4, 5, 6, *mag),
        dialect.MAVLink_scaled_imu_message(usec & 0xFFFFFFFF, *xyz, 4, 5, 6, *mag),
        dialect.MAVLink_scaled_imu3_message(usec & 0xFFFFFFFF, *xyz, 4, 5, 6, *mag),
    ]
    path = tmp_path / "a.tlog"
    path.write_bytes(b"".join((START_US + i).to_bytes(8, "big") + bytes(m.pack(mav)) for i, m in enumerate(some)))
    same(path)


@pytest.mark.parametrize("number", [6.4, -6.4, 99.0, 101.0, 1e30, float("inf"), float("nan"), -0.0])
@pytest.mark.parametrize("place", range(6))
def test_every_way_an_attitude_may_be_beyond_belief(tmp_path: Path, number: float, place: int) -> None:
    values = [0.1, -0.2, 3.0, 0.5, -0.5, 0.0]
    values[place] = number
    mav = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    frame = dialect.MAVLink_attitude_message(7, *values).pack(mav)
    path = tmp_path / "a.tlog"
    path.write_bytes(START_US.to_bytes(8, "big") + bytes(frame))
    same(path)


@pytest.mark.parametrize("name", ["sitl/plane-circles.tlog", "flights/thor75.tlog"])
def test_same_readings_of_a_real_recording_damaged(tmp_path: Path, name: str) -> None:
    whole = DATA / name
    if not whole.is_file():
        pytest.skip(f"no {whole}: set MAGMAV_DATA")
    rng, data = random.Random(name), bytearray(whole.read_bytes()[:400_000])
    for one in [*HARM * 5, *[flip] * 100]:
        if one is not cut:
            one(data, rng)
    path = tmp_path / "a.tlog"
    path.write_bytes(data)
    assert same(path) > 2000


def test_a_tlog_is_opened_so_and_progress_ends_at_its_size(tmp_path: Path) -> None:
    path = tmp_path / "a.tlog"
    path.write_bytes(b"".join(flight(1, 200)))
    seen: list[tuple[int, int]] = []
    told = open_recording(path, lambda done, size: seen.append((done, size)))
    assert isinstance(told, TlogRecording)
    assert len(list(told.readings())) > 50 and list(told.readings()) == []
    size = path.stat().st_size
    assert seen == sorted(seen) and seen[-1] == (size, size)
    told.close()
