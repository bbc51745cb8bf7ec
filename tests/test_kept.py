"""After the autopilot restarts: are the values still there? PERSISTED, LOST, or somebody else's (AT-4c)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect
from scripted_vehicle import MS, S, Vehicle
from upload_rig import NAMES, OLD, Rig, a_change

from magmav.core.types import UploadResult
from magmav.geomag import world_magnetic_model
from magmav.link.memory import SetClock, memory_pair
from magmav.live import Session, history_entry
from magmav.mavlink.autopilot.adapter import ADAPTERS
from magmav.mavlink.codec import Codec
from magmav.mavlink.kept import Keeping, Kept
from magmav.mavlink.uid import Uid
from magmav.settings import Settings
from magmav.store import Store

NEW = dict(zip(NAMES, a_change().new, strict=True))
BEFORE = dict(zip(NAMES, OLD, strict=True))


class Watched:
    """A Kept on the scripted vehicle, which tells its boot clock."""

    result: UploadResult | None = None

    def __init__(self, rig: Rig, boot_ms: int) -> None:
        self.kept = Kept(ADAPTERS[3], rig.presence, NEW, BEFORE, boot_ms)

    def on_message(self, message: Any, route: str, now_ns: int) -> Any:
        self.kept.on_message(message, route, now_ns)
        return self.kept.poll(now_ns)

    def poll(self, now_ns: int) -> Any:
        return self.kept.poll(now_ns)


@pytest.mark.parametrize(
    ("after", "found"),
    [
        (NEW, Keeping.PERSISTED),
        (BEFORE, Keeping.LOST),
        (NEW | {"COMPASS_OFS_Z": OLD[2]}, Keeping.LOST),
        (dict.fromkeys(NAMES, 0.0), Keeping.LOST),
        (NEW | {"COMPASS_OFS_Z": 1.5}, Keeping.CHANGED),
    ],
)
@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_AT_4c_persisted_lost_or_changed(after: dict[str, float], found: Keeping, loss: float) -> None:
    rig = Rig(3, loss=loss)
    rig.vehicle.params.update(NEW)
    rig.vehicle.loss = 0.0
    rig.vehicle.clock(600_000)
    rig.vehicle.run(None, 1.0, rig.feed)
    watched = Watched(rig, boot_ms=600_000)
    rig.vehicle.run(watched, 8.0, rig.feed)
    assert watched.kept.found is None and not rig.vehicle.sent, "nothing is asked before it has rebooted"
    rig.vehicle.params.update(after)
    rig.vehicle.clock(4_000)
    rig.vehicle.loss = loss
    rig.vehicle.run(watched, 30.0, rig.feed)
    assert watched.kept.found is found
    assert {m.get_type() for _, m in rig.vehicle.sent} == {"PARAM_REQUEST_READ"}


def test_AT_4c_a_clock_that_jumps_a_little_is_no_reboot_and_silence_after_one_is_no_answer() -> None:
    rig = Rig()
    rig.vehicle.clock(600_000)
    rig.vehicle.run(None, 2.0, rig.feed)
    watched = Watched(rig, boot_ms=600_000)
    rig.vehicle.say(dialect.MAVLink_system_time_message(0, 601_100))  # overtaken
    rig.vehicle.say(dialect.MAVLink_system_time_message(0, 4_000))  # and nothing that goes on from here
    rig.vehicle.run(watched, 5.0, rig.feed)
    assert not rig.vehicle.sent
    rig.vehicle.deaf = True
    rig.vehicle.clock(4_000)
    rig.vehicle.run(watched, 60.0, rig.feed)
    assert watched.kept.given_up and watched.kept.found is None
    assert len(rig.vehicle.sent) == 90


class Bench:
    """The whole companion on a memory link, with the scripted vehicle at the other end."""

    def __init__(self, path: Path, vehicle: Vehicle) -> None:
        self.vehicle = vehicle
        self.clock = SetClock(vehicle.now_ns)
        self.here, self.there = memory_pair(self.clock)
        self.store = Store(path).open()
        self.session = Session.on(self.here, Settings(), world_magnetic_model, self.store)
        self.companion = self.session.companion
        self._packets, self._heard = self.here.packets(), self.there.packets()
        self.codec = Codec()
        self.boot_ms: int | None = 600_000
        self.uid2 = b""
        self.texts: list[str] = []

    result = None

    def on_message(self, message: Any, route: str, now_ns: int) -> Any:
        self.there.send(self.codec.encode(message, self.vehicle.system, self.vehicle.component))
        return []

    def poll(self, now_ns: int) -> Any:
        self.clock.now_ns = now_ns
        if self.boot_ms is not None and now_ns % S == 0:
            self.boot_ms += 1000
            self.vehicle.clock(self.boot_ms)
            if self.uid2:
                uid2 = self.uid2.ljust(18, b"\0")
                self.vehicle.say(
                    dialect.MAVLink_autopilot_version_message(
                        0, 0, 0, 0, 0, bytes(8), bytes(8), bytes(8), 0, 0, 7, uid2
                    )
                )
        while (packet := next(self._packets)).data:
            self.session.service.turn(packet)
        self.session.service.turn(packet)
        while (sent := next(self._heard)).data:
            for m in self.codec.decode(sent.data, "back", whole=True):
                self.vehicle._later("vehicle", m)
                if m.get_type() == "STATUSTEXT":
                    self.texts.append(m.text)
        return []

    def run(self, seconds: float) -> None:
        self.vehicle.run(self, seconds)


@pytest.mark.parametrize(("after", "found"), [(NEW, "PERSISTED"), (BEFORE, "LOST")])
@pytest.mark.parametrize("restarts", [False, True])
def test_AT_4c_the_companion_says_so_after_the_reboot_even_when_it_restarted_itself(
    tmp_path: Path, after: dict[str, float], found: str, restarts: bool
) -> None:
    vehicle = Vehicle()
    bench = Bench(tmp_path / "s.sqlite", vehicle)
    bench.run(15.0)
    bench.companion.start(a_change(), None, vehicle.now_ns)
    bench.run(20.0)
    assert bench.companion.ended is not None and bench.companion.ended.result is UploadResult.ALL_NEW
    assert not any("PERSISTED" in t or "LOST" in t for t in bench.texts)
    if restarts:
        bench.store.close()
        bench = Bench(tmp_path / "s.sqlite", vehicle)
    bench.boot_ms = 3_000
    vehicle.params.update(after)
    bench.run(30.0)
    assert any(found in text for text in bench.texts), bench.texts
    assert [row.kept for row in bench.store.history()] == [Keeping[found]]
    assert history_entry(bench.store.history()[0])["kept"] == found
    bench.store.close()


def test_S19_a_write_cut_short_on_another_vehicle_of_the_same_numbers_is_left_alone(tmp_path: Path) -> None:
    """System id, device id and even the values fit; the vehicle's own number does not."""
    for uid2, restored in ((b"\xbb", False), (b"\xaa", True)):
        vehicle = Vehicle()
        vehicle.params.update({NAMES[0]: a_change().new[0]})
        vehicle.applied.update(vehicle.params)
        path = tmp_path / f"{uid2.hex()}.sqlite"
        with Store(path) as store:
            store.begin(a_change(), 5, vehicle="1 uid aa")
        bench = Bench(path, vehicle)
        bench.uid2 = uid2
        bench.run(40.0)
        assert bench.companion.writer.vehicle == f"1 uid {uid2.hex()}"
        assert vehicle.params[NAMES[0]] == (OLD[0] if restored else a_change().new[0])
        assert bool(bench.store.pending()) is not restored
        bench.store.close()


def test_S19_the_number_comes_from_uid2_else_uid_and_a_mute_vehicle_is_asked_six_times() -> None:
    rig = Rig()
    asked: list[Any] = []
    uid = Uid(rig.presence)
    for _ in range(1000):
        asked += uid.poll(rig.vehicle.now_ns)
        rig.vehicle.now_ns += 20 * MS
    assert (uid.settled, uid.key, len(asked)) == (True, "1", 6)
    assert {m.message.command for m in asked} == {512, 520}

    def version(uid8: int, uid2: bytes, component: int = 1) -> Any:
        m = dialect.MAVLink_autopilot_version_message(
            0, 0, 0, 0, 0, bytes(8), bytes(8), bytes(8), 0, 0, uid8, uid2.ljust(18, b"\0")
        )
        return rig.vehicle._wire.carry(m, 1, component)

    uid.on_message(version(5, b"\x01\x02"), "udp:2")
    uid.on_message(version(5, b"\x01\x02", 154), "udp:1")
    assert uid.key == "1", "rule 11: over the pinned route, from the autopilot"
    uid.on_message(version(0, b""), "udp:1")
    assert uid.key == "1"
    uid.on_message(version(0x2A, b""), "udp:1")
    assert uid.key == "1 uid 000000000000002a"
    uid.on_message(version(0x2A, b"\x01\x02"), "udp:1")
    assert uid.key == "1 uid 0102"
