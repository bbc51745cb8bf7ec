"""A link that loses a third and takes two seconds each way: it still lists, still writes, never in between."""

from __future__ import annotations

import random
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from flight_rig import IRON_MG, Flight
from magmav_sim import Simulation, parse_scenario
from pymavlink.dialects.v20 import ardupilotmega as dialect
from scripted_vehicle import MS, S
from upload_rig import NAMES, OLD, Rig, a_change

from magmav.core.types import UploadResult
from magmav.link.damage import Lossy
from magmav.link.memory import SetClock, memory_pair
from magmav.mavlink.autopilot.ardupilot import plan_change
from magmav.mavlink.change import code_needed
from magmav.mavlink.codec import Codec

GROUND = b"""
seed = 1
airframe = "F450"
date = 2026-11-22T10:00:00Z
place = { lat_deg = 47.3977, lon_deg = 8.5456, alt_m = 488.0 }
stay = true
[[compass]]
device_id = 97539
hard_iron_mg = [180.0, -120.0, 240.0]
noise_mg = 4.0
"""


@pytest.mark.parametrize("jitter", [False, True])
def test_AT_8a_two_seconds_each_way_and_thirty_percent_loss_is_never_mixed(jitter: bool) -> None:
    ends: Counter[UploadResult] = Counter()
    for seed in range(25):
        rig = Rig(seed, latch_s=8.0)
        dice = random.Random(seed + 1000)
        rig.vehicle.loss, rig.vehicle.duplicate = 0.3, 0.1
        rig.vehicle.delay_ns = lambda d=dice, j=jitter: round((d.uniform(0.2, 2.0) if j else 2.0) * S)  # type: ignore[misc]
        rig.vehicle.run(None, 8.0, rig.feed)
        upload = rig.go(until_s=200.0)
        rig.vehicle.run(None, 5.0, rig.feed)  # let everything arrive
        assert upload.result in (UploadResult.ALL_NEW, UploadResult.ALL_OLD), (seed, upload.reasons)
        assert rig.stored() == (a_change().new if upload.result is UploadResult.ALL_NEW else OLD), seed
        rig.check_S1()
        ends[upload.result] += 1
    assert ends[UploadResult.ALL_NEW] >= 23, ends


def test_AT_8a_two_seconds_each_way_the_retreat_holds_too() -> None:
    for seed in range(10):
        rig = Rig(seed, applies=False)
        dice = random.Random(seed)
        rig.vehicle.loss, rig.vehicle.duplicate = 0.2, 0.5
        rig.vehicle.delay_ns = lambda d=dice: round(d.choice((0.01, 0.3, 1.0, 2.0)) * S)  # type: ignore[misc]
        rig.vehicle.run(None, 6.0, rig.feed)
        upload = rig.go(until_s=200.0)
        rig.vehicle.run(None, 6.0, rig.feed)
        assert upload.result is UploadResult.ALL_OLD, (seed, upload.reasons)
        assert rig.stored() == OLD, seed


def test_S1_two_seconds_of_latency_a_write_that_lands_armed_ends_pending() -> None:
    ends: set[UploadResult] = set()
    for step in range(16):
        rig = Rig(step)
        vehicle = rig.vehicle
        vehicle.delay_ns = lambda: 2 * S
        vehicle.run(None, 6.0, rig.feed)
        vehicle.at.append((vehicle.now_ns + 5 * S + step * 300 * MS, lambda v=vehicle: setattr(v, "armed", True)))
        upload = rig.go(until_s=200.0)
        rig.check_S1()
        if upload.result is UploadResult.REFUSED:
            assert rig.stored() == OLD
        else:
            assert upload.result in (UploadResult.PENDING_RESTORE, UploadResult.ALL_NEW), (step, upload.reasons)
        assert upload.result is not None
        ends.add(upload.result)
    assert UploadResult.PENDING_RESTORE in ends


class Ground:
    """A ground station on the same bad link: lists, and asks by index for what did not come."""

    def __init__(self, flight: Flight) -> None:
        self.flight = flight
        self.names: dict[int, str] = {}
        self.count = 0
        self.asked_s = -99.0
        self.codec = Codec()
        self.dice = random.Random(4)
        self.seen = 0
        self.queue: list[tuple[float, object]] = []

    def turn(self) -> bool:
        """True once every parameter of component 191 is known."""
        now_s = self.flight.sim.elapsed_ns / 1e9
        for sent in self.flight.link.sent[self.seen :]:
            for m in self.codec.decode(sent.data, "", whole=True):
                if m.get_type() == "PARAM_VALUE" and self.dice.random() > 0.3:
                    self.queue.append((now_s + 2.0, m))
        self.seen = len(self.flight.link.sent)
        for _, m in [q for q in self.queue if q[0] <= now_s]:
            self.names[m.param_index], self.count = m.param_id, m.param_count  # type: ignore[attr-defined]
        self.queue = [q for q in self.queue if q[0] > now_s]
        if now_s - self.asked_s >= 8.0:
            self.asked_s = now_s
            missing = [i for i in range(self.count) if i not in self.names]
            asks = [dialect.MAVLink_param_request_read_message(1, 191, b"", i) for i in missing[:10]]
            for ask in asks or [dialect.MAVLink_param_request_list_message(1, 191)]:
                if self.dice.random() > 0.3:
                    self.flight.operator(ask)
        return self.count > 0 and len(self.names) == self.count


def test_AT_8a_the_whole_companion_lists_all_and_uploads_over_two_seconds_and_thirty_percent(tmp_path: Path) -> None:
    simulation = Simulation(parse_scenario(GROUND, "ground.toml"), 3)
    flight = Flight(simulation, tmp_path, weather={"drop": 0.3, "latency_s": 2.0}, weather_seed=5)
    companion = flight.companion
    ground = Ground(flight)
    assert flight.fly(ground.turn, 200.0), f"{len(ground.names)} of {ground.count} parameters"
    assert sorted(ground.names) == list(range(ground.count))
    assert {"MMAG_HDG", "MMAG_UPLOAD", "MMAG_RESULT"} <= set(ground.names.values())

    def known() -> bool:
        flown = companion.flown()
        return flown is not None and flown.calibrations.known(1)

    assert flight.fly(known, 200.0)
    flown = companion.flown()
    assert flown is not None
    sigma = np.array((2.0, 2.0, 5.0))
    change = plan_change(flown.calibrations, 1, 1, IRON_MG, sigma, (True, True, True))
    assert change is not None
    companion.start(change, code_needed(change), flight.service.now_ns)
    assert flight.fly(lambda: companion.ended is not None, 200.0)
    assert companion.ended is not None and companion.ended.result is UploadResult.ALL_NEW, companion.ended.reasons
    assert tuple(flight.value(name) for name in NAMES) == change.new
    flight.end()


def test_latency_delays_each_way_and_keeps_order() -> None:
    clock = SetClock(5 * S)
    here, there = memory_pair(clock)
    far = Lossy(there, 1, latency_s=2.0)
    turns = far.packets()
    next(turns)
    here.send(b"a")
    here.send(b"b")
    far.send(b"back")
    heard: list[tuple[float, bytes]] = []
    back: list[float] = []
    reader = here.packets()
    for _ in range(60):
        packet = next(turns)
        if packet.data:
            heard.append((packet.t_ns / S, packet.data))
        if next(reader).data:
            back.append(clock.now_ns / S)
        clock.advance(0.1)
    assert heard == [(pytest.approx(7.0, abs=0.21), b"a"), (pytest.approx(7.0, abs=0.31), b"b")]
    assert back == [pytest.approx(7.0, abs=0.11)]
    for wrong in (-0.1, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="latency_s"):
            Lossy(here, 1, latency_s=wrong)
