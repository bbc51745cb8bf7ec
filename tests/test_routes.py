"""Trust is by route (design, rule 11): what a second route says feeds nothing, starts nothing and proves nothing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fleet_rig import Airspace, Craft, ground
from memory_flight import flight
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.core.types import Change, Reason, State, UploadResult
from magmav.fleet import Fleet

READ = ("COMPASS_LEARN", 0.0), ("COMPASS_OFFS_MAX", 1800.0), ("COMPASS_PRIO1_ID", 97540.0)


def armed(c: Craft) -> Craft:
    c.params |= dict(READ)
    return c


def one(folder: Path, **options: object) -> Airspace:
    return Airspace(folder, armed(Craft(1, "udp:1")), **options)


def known(sky: Airspace) -> dict[str, float]:
    return dict(sky.service.pipeline.vehicles[1].calibrations._held)


def estimate(sky: Airspace) -> tuple[int, tuple[float, ...]]:
    record = sky.records[-1]
    return record.estimate.samples, tuple(record.estimate.hard_iron_b_mg)


SPOOFS: dict[str, Callable[[Craft, int], bytes]] = {
    "IMU": lambda c, ms: c.pack(dialect.MAVLink_raw_imu_message(ms * 1000, 0, 0, -1000, 0, 0, 0, 900, -700, 99)),
    "second compass": lambda c, ms: c.pack(
        dialect.MAVLink_scaled_imu2_message(ms, 0, 0, -1000, 0, 0, 0, 900, -700, 99)
    ),
    "attitude": lambda c, ms: c.pack(dialect.MAVLink_attitude_message(ms, 1.0, 1.0, 1.0, 0, 0, 0)),
    "offsets": lambda c, ms: c.param("COMPASS_OFS_X", 777.0),
    "device id": lambda c, ms: c.param("COMPASS_DEV_ID", 4711.0),
    "matrix": lambda c, ms: c.param("COMPASS_ODI_X", 0.5),
    "position": lambda c, ms: c.pack(
        dialect.MAVLink_global_position_int_message(ms, -(10**8), 10**8, 0, 0, 0, 0, 0, 0)
    ),
    "heartbeat": lambda c, ms: c.heartbeat(True),
    "reboot": lambda c, ms: c.pack(dialect.MAVLink_attitude_message(1, 0, 0, 0, 0, 0, 0)),
}


class Flown(Airspace):
    """A flight from memory over one route, with whatever is slipped in over another."""

    def __init__(self, folder: Path, slip: Callable[[Craft, int], bytes] | None, route: str, system: int = 1) -> None:
        super().__init__(folder)
        liar = Craft(system, route)
        for n, (ms, data) in enumerate(flight(seconds=14.0, seed=3)):
            self.ms = ms
            self.push(data, "udp:1")
            if slip is not None and n > 20 and n % 3 == 0:
                self.push(slip(liar, ms), route)


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    return Flown(tmp_path_factory.mktemp("honest"), None, "")


@pytest.mark.parametrize("what", SPOOFS)
def test_nothing_from_a_second_route_feeds_the_estimate_or_the_calibration(
    tmp_path: Path, honest: Flown, what: str
) -> None:
    """Bit for bit the same answer as if it had never been said; nor does it make a vehicle of its own."""
    spoofed = Flown(tmp_path, SPOOFS[what], "udp:66")
    assert estimate(spoofed) == estimate(honest) and known(spoofed) == known(honest)
    assert len(spoofed.records) == len(honest.records)
    assert spoofed.service.counts().get("vehicle 1") == honest.service.counts().get("vehicle 1")
    assert set(spoofed.service.pipeline.vehicles[1].channels) == {1}
    assert isinstance(spoofed.service.companion, Fleet)
    assert spoofed.service.companion.members[1].plan(1) == honest.service.companion.members[1].plan(1)


@pytest.mark.parametrize("what", ["IMU", "offsets", "device id"])
def test_the_same_over_the_vehicles_own_route_does_count(tmp_path: Path, honest: Flown, what: str) -> None:
    """Otherwise the test above could not fail."""
    told = Flown(tmp_path, SPOOFS[what], "udp:1")
    assert (estimate(told), known(told)) != (estimate(honest), known(honest))


def test_a_vehicle_that_speaks_from_elsewhere_after_silence_is_learnt_anew(tmp_path: Path) -> None:
    """What was learnt over one route is never mixed with what comes over another, nor planned with."""
    sky = Airspace(tmp_path)
    play = flight(seconds=14.0, seed=3)
    for ms, data in play:
        sky.ms = ms
        sky.push(data, "udp:1")
    samples, member = estimate(sky)[0], sky.fleet.members[1]
    assert samples > 100 and member.plan(1) is not None
    last = sky.ms
    for ms, data in flight(seconds=9.0, seed=4, from_ms=last + 2000, told=None):
        sky.ms = ms
        held = member.presence.autopilot.route
        sky.push(data, "udp:66")
        if held == "udp:1" and member.presence.autopilot.route == "udp:66":
            assert member._records == {}, "nothing of before is planned with, not even for a moment"
        if ms < last + 4500:
            assert member.presence.autopilot.route == "udp:1" and estimate(sky)[0] == samples
    assert member.presence.autopilot.route == "udp:66"
    assert 0 < estimate(sky)[0] < samples
    assert member.plan(1) is None and not sky.service.pipeline.vehicles[1].calibrations.known(1)
    asked = [m.param_id for m in sky.link.sent["udp:66"] if m.get_type() == "PARAM_REQUEST_READ"]
    assert "COMPASS_OFS_X" in asked, "all that the write rests on is read again, over the new route"


def test_before_anybody_is_chosen_too_only_the_first_route_counts(tmp_path: Path) -> None:
    """A single companion waits three seconds for others; what it hears meanwhile already counts, but not from all."""
    sky = Airspace(tmp_path, single=True)
    craft, liar = Craft(1, "udp:1"), Craft(1, "udp:66")
    sky.push(craft.heartbeat(), "udp:1")
    sky.push(liar.heartbeat(), "udp:66")
    for n in range(10):
        sky.push(liar.imu(1000 + 40 * n), "udp:66")
    assert sky.records == [] and sky.service.companion.presence.autopilot is None
    for n in range(10):
        sky.push(craft.imu(1000 + 40 * n), "udp:1")
    assert len(sky.records) > 5


def test_a_stream_that_was_reopened_is_the_same_vehicle(tmp_path: Path) -> None:
    sky = Airspace(tmp_path)
    for ms, data in flight(seconds=14.0, seed=3):
        sky.ms = ms
        sky.push(data, "tcp:10.0.0.1:5760")
    samples = estimate(sky)[0]
    for ms, data in flight(seconds=9.0, seed=4, from_ms=sky.ms + 100, told=None):
        sky.ms = ms
        sky.push(data, "tcp:10.0.0.1:5760#2")
    assert estimate(sky)[0] > samples and sky.fleet.members[1].plan(1) is not None


# ------------------------------------------------------------ writes


def change(sky: Airspace) -> Change:
    device = sky.service.pipeline.vehicles[1].calibrations.device_id(1)
    names = ("COMPASS_OFS_X", "COMPASS_OFS_Y", "COMPASS_OFS_Z")
    new = (50.0, -40.0, 30.0)
    steps = (50.0, 40.0, 30.0)
    return Change(1, 1, "COMPASS_DEV_ID", device, names, (0.0, 0.0, 0.0), new, new, (3.0, 3.0, 3.0), steps)


class Applying(Craft):
    """An autopilot that adds its offsets to the field, as ArduPilot does."""

    def imu(self, ms: int) -> bytes:
        held = self.field
        self.field = held + np.array([self.params[f"COMPASS_OFS_{a}"] for a in "XYZ"])
        try:
            return super().imu(ms)
        finally:
            self.field = held


def test_an_upload_nobody_disturbs_ends_all_new(tmp_path: Path) -> None:
    sky = Airspace(tmp_path, armed(Applying(1, "udp:1")))
    sky.run(12.0)
    member = sky.fleet.members[1]
    member.start(change(sky), None, sky.now_ns)
    sky.run(40.0)
    assert member.ended.result is UploadResult.ALL_NEW, member.ended.reasons
    assert sky.craft[0].params["COMPASS_OFS_X"] == 50.0
    sets = {r: [m for m in sent if m.get_type() == "PARAM_SET"] for r, sent in sky.link.sent.items()}
    assert {r for r, m in sets.items() if m} == {"udp:1"}


def test_a_spoofed_disarmed_over_a_second_route_lets_nothing_be_written(tmp_path: Path) -> None:
    sky = one(tmp_path)
    craft = sky.craft[0]
    sky.run(12.0)
    plan = change(sky)
    craft.armed = True
    sky.run(2.0)
    member, liar = sky.fleet.members[1], Craft(1, "udp:66")
    member.start(plan, None, sky.now_ns)
    for _ in range(300):
        sky.push(liar.heartbeat(False), "udp:66")
        sky.run(0.1)
    assert member.ended.result is UploadResult.REFUSED
    assert {Reason.ARMED, Reason.SECOND_ROUTE} & set(member.ended.reasons)
    assert not any(m.get_type() == "PARAM_SET" for sent in sky.link.sent.values() for m in sent)


def test_a_spoofed_read_back_over_a_second_route_is_no_proof(tmp_path: Path) -> None:
    """The vehicle is deaf to the write; somebody else says it was done."""
    sky = one(tmp_path)
    craft = sky.craft[0]
    sky.run(12.0)
    member, liar = sky.fleet.members[1], Craft(1, "udp:66")
    plan = change(sky)
    honest_answer = craft.answer
    craft.answer = lambda m: [] if m.get_type() == "PARAM_SET" else honest_answer(m)
    member.start(plan, None, sky.now_ns)
    for _ in range(1200):
        for name, value in zip(plan.names, plan.new, strict=True):
            sky.push(liar.param(name, value), "udp:66")
        sky.run(0.1)
        if member.ended is not None:
            break
    assert member.ended is not None and member.ended.result is not UploadResult.ALL_NEW
    assert craft.params["COMPASS_OFS_X"] == 0.0
    assert known(sky)["COMPASS_OFS_X"] == 0.0


def test_a_trigger_over_a_second_route_starts_nothing(tmp_path: Path) -> None:
    sky = Airspace(tmp_path)
    for ms, data in flight(seconds=35.0, seed=3):
        sky.ms = ms
        sky.push(data, "udp:1")
    assert sky.records[-1].verdict.state is State.READY
    member = sky.fleet.members[1]
    before = member.result, member.confirm
    for name in ("MMAG_UPLOAD", "MMAG_RESTORE", "MMAG_CONFIRM"):
        wish = dialect.MAVLink_param_set_message(1, 191, name.encode(), 1.0, 9)
        for sender in ((255, 190), (1, 1), (1, 240)):
            sky.push(ground(wish, *sender), "udp:66")
            assert (member.result, member.confirm) == before
            assert member.job is None is member.ended is member.refusal
    errors = [m.error for m in sky.link.sent["udp:66"] if m.get_type() == "PARAM_ERROR"]
    assert set(errors) == {dialect.MAV_PARAM_ERROR_PERMISSION_DENIED}
    assert not any(m.get_type() == "PARAM_SET" for sent in sky.link.sent.values() for m in sent)
    sky.push(ground(dialect.MAVLink_param_set_message(1, 191, b"MMAG_CONFIRM", 7.0, 9)), "udp:1")
    sky.push(ground(dialect.MAVLink_param_set_message(1, 191, b"MMAG_UPLOAD", 1.0, 9)), "udp:1")
    assert member.confirm == 7.0 and (member.result != before[0] or member.job is not None), "over its own it does"


def test_one_ground_station_after_another_cannot_fill_the_memory(tmp_path: Path) -> None:
    """A thousand senders with every kind of request: what is kept of them stays small."""
    sky = one(tmp_path)
    sky.run(5.0)
    for n in range(700):
        sender = 1 + n % 254, 1 + n // 10 % 250
        for m in (
            dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3),
            dialect.MAVLink_ping_message(n, n, 0, 0),
            dialect.MAVLink_param_request_read_message(1, 191, b"MMAG_HDG", -1),
        ):
            sky.push(ground(m, *sender), f"udp:{n}")
    presence = sky.fleet.members[1].presence
    assert len(presence._seen) <= 256 and len(presence._manners._pinged) <= 64
    assert len(sky.fleet.members) == 1 and len(sky.service.hearing._lives) <= 1


# ------------------------------------------------------------ company on the same system id


class Company:
    """Gimbal, camera, another companion and two ground stations, all as system 1, on the vehicle's route and others."""

    def __init__(self) -> None:
        self.gimbal = dialect.MAVLink(None, srcSystem=1, srcComponent=154)
        self.camera = dialect.MAVLink(None, srcSystem=1, srcComponent=100)
        self.peer = dialect.MAVLink(None, srcSystem=1, srcComponent=192)
        self.stations = [dialect.MAVLink(None, srcSystem=1, srcComponent=c) for c in (190, 195)]

    def talk(self, ms: int) -> list[tuple[bytes, str]]:
        beat = dialect.MAVLink_heartbeat_message
        # This gimbal claims to be an ArduPilot, as some do, and to be armed.
        out = [
            (beat(26, 3, 128, 0, 4, 3).pack(self.gimbal), "udp:1"),
            (beat(30, 8, 0, 0, 4, 3).pack(self.camera), "udp:1"),
        ]
        out.append((beat(18, 8, 0, 0, 4, 3).pack(self.peer), "udp:5"))
        out += [(beat(6, 8, 192, 0, 4, 3).pack(s), f"udp:{9 + n}") for n, s in enumerate(self.stations)]
        out.append((dialect.MAVLink_attitude_message(ms, 0.5, -1.2, 2.0, 0, 0, 0).pack(self.gimbal), "udp:1"))
        out.append((dialect.MAVLink_param_value_message(b"COMPASS_OFS_X", 99.0, 9, 50, 3).pack(self.camera), "udp:1"))
        out.append(
            (dialect.MAVLink_raw_imu_message(ms * 1000, 0, 0, -1000, 0, 0, 0, 9, 9, 9).pack(self.gimbal), "udp:1")
        )
        for s in self.stations:
            out.append((dialect.MAVLink_param_request_list_message(1, 154).pack(s), "udp:9"))
            out.append((dialect.MAVLink_param_request_read_message(1, 1, b"MMAG_HDG", -1).pack(s), "udp:9"))
        return [(bytes(data), route) for data, route in out]


@pytest.mark.parametrize("first", [True, False], ids=["company first", "vehicle first"])
def test_AT_9a_gimbal_camera_and_two_ground_stations_on_our_system_id_do_no_harm(
    tmp_path: Path, honest: Flown, first: bool
) -> None:
    sky, company = Airspace(tmp_path), Company()
    next_ms = 0
    for n, (ms, data) in enumerate(flight(seconds=14.0, seed=3)):
        sky.ms = ms
        if (n and ms < next_ms) or (not first and n < 3):
            sky.push(data, "udp:1")
            continue
        next_ms = ms + 1000
        for frame, route in company.talk(ms):
            sky.push(frame, route)
        sky.push(data, "udp:1")
    member = sky.fleet.members[1]
    assert member.presence.autopilot.pin == (1, 1, "udp:1") and not member.presence.second_route
    assert estimate(sky) == estimate(honest) and known(sky) == known(honest)
    assert sky.service.pipeline.vehicles[1].phase.armed
    sky.run(30.0)  # our own values come when the vehicle's have been read: all share one budget
    said = [m for sent in sky.link.sent.values() for m in sent]
    assert {(m.get_srcSystem(), m.get_srcComponent()) for m in said} == {(1, 191)}
    own = {m.param_id for m in said if m.get_type() == "PARAM_VALUE"}
    assert own and all(name.startswith("MMAG_") for name in own), "never answered for another component"
    for m in said:
        assert (getattr(m, "target_system", 0), getattr(m, "target_component", 0)) in ((0, 0), (1, 1)), m
    assert not any(m.get_type() == "PARAM_ERROR" for m in said)


def test_with_all_that_company_an_upload_still_goes_through(tmp_path: Path) -> None:
    sky, company = Airspace(tmp_path, armed(Applying(1, "udp:1"))), Company()
    sky.run(4.0)
    for second in range(40):
        for frame, route in company.talk(sky.ms):
            sky.push(frame, route)
        if second == 8:
            sky.fleet.members[1].start(change(sky), None, sky.now_ns)
        sky.run(1.0)
    assert sky.fleet.members[1].ended.result is UploadResult.ALL_NEW, sky.fleet.members[1].ended.reasons
