"""In-flight learning one can trust (users.md N17): it touches nothing, and what it knew outlives a restart."""

from __future__ import annotations

import numpy as np
import pytest
from ground_frames import COPTER, frames, parked
from memory_flight import HZ, STORED, Teller, earth_model, flight
from pymavlink.dialects.v20 import ardupilotmega as dialect
from synthetic_flight import HARD_IRON_MG

from magmav.core.types import Reason, State, UploadResult
from magmav.link.memory import SetClock, memory_pair
from magmav.live import Session
from magmav.mavlink.change import code_needed
from magmav.settings import Settings
from magmav.store import Store

DEVICE = 97539
FLIGHT_S = 45.0


class Day:
    """One companion on a link in memory, on a store that may have been another companion's before."""

    def __init__(self, folder):
        self.clock = SetClock(5 * 10**9)
        self.here, self.there = memory_pair(self.clock, unix_offset_ns=1_790_000_000 * 10**9)
        self.store = Store(folder / "magmav.sqlite").open()
        self.records = []
        watch = (lambda reading, record: None if record is None else self.records.append(record),)
        self.session = Session.on(self.here, Settings(), earth_model, self.store, watch)
        self.companion = self.session.companion
        self.sent = []
        self._packets, self._heard = self.here.packets(), self.there.packets()
        self._reader = dialect.MAVLink(None)
        self._ms = None

    def play(self, some):
        """Send frames at their time; take in and answer each; keep what the companion said. Records of it."""
        before = len(self.records)
        for ms, data in some:
            self.clock.advance(max(ms - (self._ms or ms), 0) / 1000.0)
            self._ms = ms
            self.there.send(data)
            self.session.service.turn(next(self._packets))
            while (packet := next(self._heard)).data:
                self.sent += self._reader.parse_buffer(packet.data) or []
        return self.records[before:]

    def end(self):
        """As the service stops."""
        self.session.service._send(self.companion.leave(self.clock.now_ns))
        self.store.close()


def parked_after(from_ms, seconds=8.0):
    """Landed, disarmed, standing; the steel below shows."""
    return frames(parked, COPTER, seconds, 3, from_ms=from_ms, told=STORED, near_mg=np.array((90.0, 0.0, -60.0)))


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """A day that flies, lands, and is asked for nothing."""
    folder = tmp_path_factory.mktemp("day")
    day = Day(folder)
    day.folder = folder
    day.play(parked_after(1_000))
    day.air = day.play(flight(seconds=FLIGHT_S, told=None, from_ms=10_000))
    day.ready = day.companion.plan(1)
    day.play(parked_after(10_000 + int(FLIGHT_S * 1000) + 100))
    day.end()
    return day


def test_AT_17a_learning_touches_no_parameter_and_commands_nothing(first):
    """From boot to READY to standing there: only questions, and wishes for message rates."""
    assert first.air[-1].verdict.state is State.READY
    kinds = {m.get_type() for m in first.sent}
    assert kinds <= {
        "HEARTBEAT", "COMMAND_LONG", "PARAM_REQUEST_READ", "PARAM_VALUE", "NAMED_VALUE_FLOAT", "STATUSTEXT",
    }  # fmt: skip
    commands = {m.command for m in first.sent if m.get_type() == "COMMAND_LONG"}
    who_are_you = {dialect.MAV_CMD_REQUEST_MESSAGE, dialect.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES}
    assert commands == {dialect.MAV_CMD_SET_MESSAGE_INTERVAL} | who_are_you
    own = {m.param_id for m in first.sent if m.get_type() == "PARAM_VALUE"}
    assert all(name.startswith("MMAG_") for name in own)
    assert first.companion.job is None is first.companion.ended


def test_AT_17b_what_was_ready_outlives_the_companion_and_is_not_taken_for_its_own(first):
    """The next one finds it, bit for bit; until it has learnt for itself it claims nothing, and refuses to write."""
    day = Day(first.folder)
    saved = day.store.latest_estimate(1, DEVICE)
    assert saved.verdict.state is State.READY
    assert (saved.change.names, saved.change.old) == (first.ready.names, (0.0, 0.0, 0.0))
    assert saved.change.new == first.ready.new
    assert np.all(np.abs(np.array(saved.offsets_mg) + HARD_IRON_MG) < 4.0 * np.array(saved.sigma_mg))
    records = day.play(parked_after(1_000, 4.0))
    assert {r.verdict.state for r in records} == {State.LEARNING}
    assert not any(r.heading.valid for r in records)
    day.companion.request_upload(1, day.clock.now_ns)
    assert day.companion.refusal is Reason.NO_CALIBRATION and day.companion.job is None
    assert day.store.latest_estimate(1, DEVICE) == saved
    day.end()


def test_AT_17b_a_restart_of_the_autopilot_begins_anew_and_loses_nothing_that_was_saved(first):
    day = Day(first.folder)
    day.play(flight(seconds=20.0, from_ms=700_000))
    assert day.records[-1].estimate.samples > 10 * HZ
    day.play(parked_after(1_000, 4.0))
    assert day.session.service.counts()["vehicle 1"]["reboots"] == 1
    last = day.records[-1]
    assert (last.estimate.samples, last.verdict.state) == (0, State.LEARNING)
    assert day.store.latest_estimate(1, DEVICE) is not None
    day.end()


def test_AT_17b_a_write_cut_short_with_its_companion_is_taken_back_by_the_next_and_ends(tmp_path, first):
    """Killed between its first write and the proof: the next companion begins the way back by itself, and it ends."""
    with Store(tmp_path / "magmav.sqlite") as killed:
        killed.begin(first.ready, 5)
    day = Day(tmp_path)
    assert [row.change for row in day.store.pending()] == [first.ready]
    still = [
        (ms, data + Teller()(dialect.MAVLink_extended_sys_state_message(0, 1))) for ms, data in parked_after(1_000)
    ]
    day.play(still)
    job = day.companion.job or day.companion.ended
    assert job is not None and job.change == first.ready
    quiet = [(9_000 + 100 * i, Teller().heartbeat(armed=False)) for i in range(600)]
    day.play(quiet)  # a vehicle that never answers: it does not wait for ever
    assert day.companion.ended is not None
    assert day.companion.ended.result in (UploadResult.REFUSED, UploadResult.PENDING_RESTORE, UploadResult.ALL_OLD)
    day.end()


def test_offsets_somebody_else_wrote_in_flight_stay_ready_and_an_older_plan_is_stale(first, tmp_path):
    """The plan made afterwards starts from the new values and ends at the same ones; the one made before is refused."""
    day = Day(tmp_path)
    day.play(parked_after(1_000))
    frames_of_it = flight(seconds=FLIGHT_S, told=None, from_ms=10_000)
    offsets = np.zeros((int(FLIGHT_S * HZ), 3))
    offsets[38 * HZ :, 0] = 200.0
    moved = flight(seconds=FLIGHT_S, told=None, from_ms=10_000, offsets_mg=offsets)
    day.play(f for f in frames_of_it if f[0] < 48_000)
    before = day.companion.plan(1)
    day.play([(48_000, Teller().param("COMPASS_OFS_X", 200.0))])
    records = day.play(f for f in moved if f[0] >= 48_000)
    assert {r.verdict.state for r in records} == {State.READY}
    after = day.companion.plan(1)
    assert (before.old, after.old) == ((0.0, 0.0, 0.0), (200.0, 0.0, 0.0))
    assert np.abs(np.array(after.new) - first.ready.new) == pytest.approx(0.0, abs=1.0)
    assert after.shift_b_mg[0] == pytest.approx(after.new[0] - 200.0)
    told = STORED | {"COMPASS_OFS_X": 200.0}
    still = frames(parked, COPTER, 14.0, 3, from_ms=56_000, told=told)
    ground = Teller()(dialect.MAVLink_extended_sys_state_message(0, 1))
    day.play((ms, data + ground) for ms, data in still[: len(still) // 2])
    day.companion.start(before, int(code_needed(before)), day.clock.now_ns)
    answer = Teller().params(told)  # to whatever is read
    day.play(
        (ms, data + ground + (answer if i % HZ == 0 else b"")) for i, (ms, data) in enumerate(still[len(still) // 2 :])
    )
    assert day.companion.ended.result is UploadResult.REFUSED
    assert Reason.OFFSETS_CHANGED in day.companion.ended.reasons
    day.end()
