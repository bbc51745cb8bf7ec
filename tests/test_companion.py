"""The whole companion on a simulated vehicle: what it asks, publishes and writes, and what it never sends.

Tests of the safety rules bear the rule's number (reference: users.md, S1 to S20).
"""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from flight_rig import Flight, ready, staying
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.core.types import Reason, UploadResult
from magmav.mavlink.change import code_needed
from magmav.own_params import entries

_OFFSETS = ("COMPASS_OFS_X", "COMPASS_OFS_Y", "COMPASS_OFS_Z")
_MAY_SEND = {
    "HEARTBEAT", "COMMAND_LONG", "PARAM_REQUEST_READ", "PARAM_SET", "PARAM_VALUE", "PARAM_ERROR", "NAMED_VALUE_FLOAT",
    "STATUSTEXT", "PING", "COMMAND_ACK", "FILE_TRANSFER_PROTOCOL", "TIMESYNC",
}  # fmt: skip


def parsed(sent):
    """(link time, armed, message) of every frame that left us, read by pymavlink's own parser."""
    mav = dialect.MAVLink(None)
    return [(s.t_ns, s.armed, m) for s in sent for m in (mav.parse_buffer(s.data) or [])]


def values(messages, name):
    return [m.param_value for m in messages if m.get_type() == "PARAM_VALUE" and m.param_id == name]


def texts(messages):
    return [m.text for m in messages if m.get_type() == "STATUSTEXT"]


def mean_stream(f):
    """The last two seconds of the corrected field as the autopilot streams it, (3,) mG."""
    return np.mean([r.stored_b_mg for r in f.records if r.t_ns > f.service.now_ns - 2e9], axis=0)


class Story:
    """One flight with everything an operator does; what came of each step."""

    def __init__(self, folder):
        f = self.f = Flight(staying(), folder)
        f.fly(lambda: f.companion.settled, 30.0)
        self.met = f.said()
        f.set("MMAG_LEARN", 0.0)
        f.set("MMAG_HDG", 12.0)
        self.sets = f.said()
        f.set("MMAG_LEARN", 1.0)
        assert f.fly(lambda: f.sim.autopilot.armed, 60.0)
        f.fly(lambda: ready(f.last()), 120.0)
        f.said()
        f.set("MMAG_CONFIRM", float(code_needed(f.companion.plan(1)) or 0))
        f.set("MMAG_UPLOAD", 1.0)
        f.fly(seconds=2.0)
        self.in_flight, self.in_flight_result = f.said(), f.companion.result
        f.land()
        self.landed_ns = f.sim.elapsed_ns
        f.said()
        f.fly(seconds=31.0)  # a repeat within 30 s of the same trigger is not a new wish
        self.idle = f.said()
        f.set("MMAG_UPLOAD", 1.0)
        self.change = f.companion.plan(1)
        f.fly(seconds=6.0)
        self.unconfirmed, self.unconfirmed_result = f.said(), f.companion.result
        self.code = code_needed(self.change)
        f.set("MMAG_CONFIRM", float(self.code))
        f.fly(seconds=0.5)
        self.stream_before = mean_stream(f)
        f.set("MMAG_UPLOAD", 1.0)
        f.fly(lambda: f.companion.ended is not None and f.companion.result != 1.0, 60.0)
        self.uploaded, self.uploaded_result = f.companion.ended, f.companion.result
        self.held = [f.value(n) for n in _OFFSETS]
        f.fly(seconds=3.0)
        self.stream_after = mean_stream(f)
        self.after_upload = f.said()
        f.set("MMAG_RESTORE", 1.0)
        f.fly(lambda: f.companion.job is not None, 5.0)
        f.fly(lambda: f.companion.job is None, 60.0)
        self.restored_result = f.companion.result
        self.restored = [f.value(n) for n in _OFFSETS]
        f.fly(seconds=2.0)
        f.said()
        f.end()
        self.left = f.said()
        self.sent = parsed(f.link.sent)


@pytest.fixture(scope="module")
def story(tmp_path_factory):
    return Story(tmp_path_factory.mktemp("story"))


def test_heartbeat_once_a_second_as_a_component_of_the_vehicle(story):
    beats = [(t, m) for t, _, m in story.sent if m.get_type() == "HEARTBEAT"]
    assert {(m.get_srcSystem(), m.get_srcComponent()) for _, m in beats} == {(1, 191)}
    assert {(m.type, m.autopilot) for _, m in beats} == {
        (dialect.MAV_TYPE_ONBOARD_CONTROLLER, dialect.MAV_AUTOPILOT_INVALID)
    }
    late = [t for t, _ in beats if t > 10e9]
    assert all(abs(b - a - 1e9) <= 0.05e9 for a, b in pairwise(late))
    assert {m.get_srcSystem() for _, _, m in story.sent} == {1}


def test_S14_intervals_are_asked_for_and_given_back(story):
    commands = [m for _, _, m in story.sent[:400] if m.get_type() == "COMMAND_LONG"]
    asked = {int(m.param1): m.param2 for m in commands if m.command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL}
    ids = {kind.msgname: number for number, kind in dialect.mavlink_map.items()}
    assert asked[ids["RAW_IMU"]] == asked[ids["ATTITUDE"]] == pytest.approx(50_000)
    assert asked[ids["GLOBAL_POSITION_INT"]] == pytest.approx(500_000)
    back = {int(m.param1): m.param2 for m in story.left if m.get_type() == "COMMAND_LONG"}
    assert set(back) == set(asked)
    assert set(back.values()) == {0.0}


def test_S14_no_full_parameter_download(story):
    kinds = Counter(m.get_type() for _, _, m in story.sent)
    assert kinds["PARAM_REQUEST_LIST"] == 0
    names = {m.param_id for _, _, m in story.sent if m.get_type() == "PARAM_REQUEST_READ"}
    assert names and all(n.startswith("COMPASS") for n in names)


def test_every_own_parameter_is_listed_once_with_a_stable_count(tmp_path):
    f = Flight(staying(), tmp_path)
    f.fly(lambda: f.companion.settled, 40.0)
    expected = [e.name for e in entries(f.companion, lambda: 0)]
    f.said()
    for _ in range(2):
        f.operator(dialect.MAVLink_param_request_list_message(1, 191))
        f.fly(seconds=20.0)
        listed = [m for m in f.said() if m.get_type() == "PARAM_VALUE"]
        assert [m.param_id for m in listed] == expected
        assert [m.param_index for m in listed] == list(range(len(expected)))
        assert {m.param_count for m in listed} == {len(expected)}
        assert {m.param_type for m in listed} == {dialect.MAV_PARAM_TYPE_REAL32}
    assert all(name.startswith("MMAG_") and len(name) <= 16 for name in expected)
    f.end()


def test_set_of_a_choice_works_and_of_a_live_value_is_refused_with_the_old_one(story):
    assert values(story.sets, "MMAG_LEARN") == [0.0]
    (shown,) = values(story.sets, "MMAG_HDG")
    assert math.isnan(shown)  # nothing was known yet, and 12 was not taken
    (error,) = [m for m in story.sets if m.get_type() == "PARAM_ERROR"]
    assert error.param_id == "MMAG_HDG"


def test_upload_while_flying_is_refused_and_nothing_is_written(story):
    assert story.in_flight_result == -Reason.ARMED.number
    assert any("vehicle is armed" in text for text in texts(story.in_flight))
    assert not [m for m in story.in_flight if m.get_type() == "PARAM_SET"]
    assert values(story.in_flight, "MMAG_UPLOAD") == [1.0]


def test_large_change_without_the_code_is_refused_and_the_code_is_announced(story):
    assert story.unconfirmed_result == -Reason.CONFIRM_CHANGE.number
    assert not [m for m in story.unconfirmed if m.get_type() == "PARAM_SET"]
    assert any(f"MMAG_CONFIRM {story.code}" in text for text in texts(story.unconfirmed))


def test_upload_with_the_code_writes_exactly_what_was_announced_and_the_stream_moves(story):
    assert story.uploaded.result is UploadResult.ALL_NEW and story.uploaded_result == 2.0
    assert story.held == list(story.change.new)
    moved = story.stream_after - story.stream_before
    assert moved == pytest.approx(story.change.new, abs=4.0)  # old offsets were zero; noise and whole mG
    assert all(abs(a + b) <= 20.0 for a, b in zip(story.held, (180.0, -120.0, 240.0), strict=True))


def test_restore_brings_the_old_values_back_exactly(story):
    assert story.restored_result == 3.0
    assert story.restored == [0.0, 0.0, 0.0] == list(story.change.old)


def test_S1_no_parameter_is_written_while_armed(story):
    writes = [(t, armed) for t, armed, m in story.sent if m.get_type() == "PARAM_SET"]
    assert len(writes) >= 6  # three there, three back
    assert not any(armed for _, armed in writes)
    assert min(t for t, _ in writes) > story.landed_ns


def test_S5_only_offsets_are_ever_written(story):
    names = {m.param_id for _, _, m in story.sent if m.get_type() == "PARAM_SET"}
    assert names == set(_OFFSETS)


def test_S9_S12_S13_nothing_is_sent_but_what_is_on_the_list(story):
    """No health is faked, no heading is fed to the EKF, nobody is impersonated: the list has no room for it."""
    assert {m.get_type() for _, _, m in story.sent} <= _MAY_SEND
    commands = [m for _, _, m in story.sent if m.get_type() == "COMMAND_LONG"]
    asks = {dialect.MAV_CMD_REQUEST_MESSAGE, dialect.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES}  # who are you?
    may = {dialect.MAV_CMD_SET_MESSAGE_INTERVAL, dialect.MAV_CMD_RUN_PREARM_CHECKS} | asks
    assert dialect.MAV_CMD_SET_MESSAGE_INTERVAL in {m.command for m in commands} <= may
    assert {m.get_srcComponent() for _, _, m in story.sent} == {191}
    own = {m.param_id for _, _, m in story.sent if m.get_type() == "PARAM_VALUE"}
    assert own and all(name.startswith("MMAG_") for name in own)


def test_S13_parameters_of_another_component_are_not_answered_for(tmp_path):
    f = Flight(staying(), tmp_path)
    f.fly(lambda: f.companion.settled, 40.0)
    f.said()
    f.operator(dialect.MAVLink_param_request_read_message(1, 1, b"MMAG_HDG", -1))
    f.set("MMAG_UPLOAD", 1.0, component=1)
    f.set("MMAG_LEARN", 0.0, component=1)
    f.operator(dialect.MAVLink_command_long_message(1, 1, dialect.MAV_CMD_COMPONENT_ARM_DISARM, 0, 1, *[0] * 6))
    f.fly(seconds=2.0)
    assert not [m for m in f.said() if m.get_type() in ("PARAM_VALUE", "PARAM_ERROR", "COMMAND_ACK", "COMMAND_LONG")]
    assert f.companion.settings.learn.on
    f.end()


def test_S18_nothing_is_written_unasked(story):
    """Writes come only after the operator's confirmed wish: READY in flight, landing and half a minute brought none."""
    writes = [t for t, _, m in story.sent if m.get_type() == "PARAM_SET"]
    assert min(writes) > story.landed_ns + 31e9
    assert not [m for m in story.idle if m.get_type() == "PARAM_SET"]


def test_headings_go_out_as_named_values_at_the_settled_rate(story):
    sent = [(t, m) for t, _, m in story.sent if m.get_type() == "NAMED_VALUE_FLOAT"]
    assert {m.name for _, m in sent} == {"MMAG_HDG"}
    assert all(0.0 <= m.value < 360.0 for _, m in sent)
    last_minute = [t for t, _ in sent if story.landed_ns < t <= story.landed_ns + 30e9]
    assert 0.8 * 60 <= len(last_minute) <= 61


def most_in_ten_seconds(frames):
    """Bytes in the fullest ten seconds, per second. frames : (t_ns, bytes), in order."""
    best, start, total = 0, 0, 0
    for t_ns, size in frames:
        total += size
        while t_ns - frames[start][0] > 10e9:
            total -= frames[start][1]
            start += 1
        best = max(best, total)
    return best / 10.0


def test_S14_own_downlink_stays_within_500_bytes_a_second(story):
    """Any ten seconds, whatever happens, our requests included (AT-9c)."""
    frames = [(s.t_ns, len(s.data)) for s in story.f.link.sent]
    requests = {"COMMAND_LONG", "PARAM_REQUEST_READ", "PARAM_SET", "PING"}
    own = [(t, len(m.get_msgbuf())) for t, _, m in story.sent if m.get_type() not in requests]
    assert most_in_ten_seconds(own) <= 500.0
    assert most_in_ten_seconds(frames) <= 500.0


def fingerprint(folder):
    folder.mkdir()
    f = Flight(staying(), folder)
    f.fly(seconds=30.0)
    f.end()
    return hashlib.sha256(b"".join(s.t_ns.to_bytes(8, "big") + s.data for s in f.link.sent)).hexdigest()


def test_same_scenario_twice_gives_the_same_bytes(tmp_path):
    assert fingerprint(tmp_path / "a") == fingerprint(tmp_path / "b")
