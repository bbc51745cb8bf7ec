"""The transaction against a scripted ArduPilot: what must never happen, and that it always ends."""

from __future__ import annotations

import math
import random
import struct
import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect
from scripted_vehicle import MS, S, Vehicle, f32
from upload_rig import NAMES, OLD, Rig, a_change, refused

from magmav.core.types import Change, Reason, UploadResult
from magmav.mavlink.autopilot.adapter import ADAPTERS
from magmav.mavlink.change import checked, code_needed, confirmation_code, dry_run, restore_blockers
from magmav.mavlink.proof import Window, moved_as_predicted
from magmav.mavlink.terms import UploadSettings
from magmav.mavlink.upload import Upload
from magmav.store import Store


def test_success_is_written_read_back_and_proven() -> None:
    rig = Rig()
    upload = rig.go()
    assert (upload.result, upload.reasons) == (UploadResult.ALL_NEW, ())
    assert rig.stored() == a_change().new
    assert [(n, v) for _, n, v in rig.vehicle.sets] == list(zip(NAMES, a_change().new, strict=True))
    assert rig.vehicle.sets[0][0] == rig.vehicle.sets[2][0], "back to back"
    assert rig.journal.ended == [(7, UploadResult.ALL_NEW, ())]
    assert "take-off" in upload.progress  # S20
    last_set = max(t for t, m in rig.vehicle.sent if m.get_type() == "PARAM_SET")
    read_back = [m.param_id for t, m in rig.vehicle.sent if m.get_type() == "PARAM_REQUEST_READ" and t > last_set]
    assert read_back == list(NAMES), "S11: every name is read back"
    rig.check_S1()


def test_writes_go_out_within_half_a_second_of_the_heartbeat() -> None:
    for shift_ms in range(0, 1000, 140):
        rig = Rig(latch_s=8.0 + shift_ms / 1000)
        assert rig.go().result is UploadResult.ALL_NEW
        beats = [t for t, m, _ in rig.vehicle.delivered if m.get_type() == "HEARTBEAT"]
        for when, _, _ in rig.vehicle.sets:
            assert when - max(t for t in beats if t <= when) <= 500 * MS


def test_dry_run_names_exactly_what_is_sent() -> None:
    rig = Rig()
    said = [line.split(" (")[0] for line in dry_run(a_change())]
    rig.go()
    sent = []
    for _, m in rig.vehicle.sent:
        what = "MAV_CMD_RUN_PREARM_CHECKS" if m.get_type() == "COMMAND_LONG" else m.param_id
        value = f" {m.param_value!r}" if m.get_type() == "PARAM_SET" else ""
        sent.append(f"{m.get_type()} {what}{value}")
    assert sent == said


def test_S11_echo_without_effect_ends_with_the_old_values() -> None:
    rig = Rig()
    rig.vehicle.applies = False
    upload = rig.go()
    assert (upload.result, upload.reasons) == (UploadResult.ALL_OLD, (Reason.UNPROVEN,))
    assert rig.stored() == OLD
    assert [v for _, _, v in rig.vehicle.sets] == [*a_change().new, *OLD]
    rig.check_S1()


def test_S11_an_effect_of_the_wrong_sign_or_axis_is_no_proof() -> None:
    for shift in ((-60.0, 45.0, -80.0), (45.0, 60.0, 80.0), (60.0, -45.0, 60.0)):
        upload = Rig().go(a_change(shift_b_mg=shift))
        assert (upload.result, upload.reasons) == (UploadResult.ALL_OLD, (Reason.UNPROVEN,))


def test_S11_how_unsure_the_estimate_is_does_not_soften_the_proof() -> None:
    rig = Rig()
    rig.vehicle.applies = False
    assert rig.go(a_change(shift_sigma_mg=(100.0, 100.0, 100.0))).result is UploadResult.ALL_OLD


def test_S11_a_stream_that_stops_after_the_write_proves_nothing() -> None:
    rig = Rig()
    rig.vehicle.on_set = lambda name: setattr(rig.vehicle, "streams", False)
    upload = rig.go()
    assert (upload.result, upload.reasons) == (UploadResult.ALL_OLD, (Reason.NO_STREAM, Reason.UNPROVEN))
    assert rig.stored() == OLD


def test_S1_armed_at_the_start_is_refused() -> None:
    rig = Rig()
    rig.vehicle.armed = True
    refused(rig, Reason.ARMED)


def test_S1_armed_on_any_route_is_refused() -> None:
    rig = Rig()
    rig.vehicle.at.append((rig.vehicle.now_ns + S, lambda: rig.vehicle.say(rig.vehicle.heartbeat(True), "udp:2")))
    refused(rig, Reason.ARMED, Reason.SECOND_ROUTE)


def test_rule_11_a_second_route_claiming_the_autopilot_is_refused() -> None:
    rig = Rig()
    rig.vehicle.at.append((rig.vehicle.now_ns + S, lambda: rig.vehicle.say(rig.vehicle.heartbeat(), "udp:2")))
    refused(rig, Reason.SECOND_ROUTE)


def test_S1_old_heartbeat_is_refused() -> None:
    rig = Rig()
    rig.vehicle.heartbeats = False
    refused(rig, Reason.HEARTBEAT_OLD)


def test_S1_in_the_air_or_unknown_and_moving_is_refused() -> None:
    rig = Rig()
    rig.vehicle.landed_state = 2
    refused(rig, Reason.NOT_LANDED)
    refused(Rig(landed_state=None), Reason.NOT_LANDED)  # nobody says landed, and no speed is known
    refused(Rig(landed_state=0, speed_cms=80), Reason.NOT_LANDED)
    refused(Rig(landed_state=None, speed_cms=0, gyro_mrads=90), Reason.NOT_LANDED)


def test_S1_unknown_landed_state_but_slow_and_still_for_five_seconds_is_enough() -> None:
    rig = Rig(latch_s=8.0, landed_state=None, speed_cms=10, gyro_mrads=90)
    rig.vehicle.gyro_mrads = 2
    begin_ns = rig.vehicle.now_ns
    assert rig.go().result is UploadResult.ALL_NEW
    assert 5 * S <= rig.vehicle.sets[0][0] - begin_ns <= 8 * S


def test_S6_another_device_is_refused() -> None:
    rig = Rig()
    rig.vehicle.params["COMPASS_DEV_ID"] = 131874.0
    refused(rig, Reason.DEVICE_CHANGED)


def test_S7_each_sign_of_a_second_writer_is_refused() -> None:
    rig = Rig()
    rig.vehicle.params["COMPASS_LEARN"] = 3.0
    refused(rig, Reason.SECOND_WRITER)
    rig = Rig()
    rig.vehicle.calibrating = True
    refused(rig, Reason.SECOND_WRITER)
    rig = Rig()
    rig.vehicle.params["COMPASS_OFS_Y"] = math.nextafter(OLD[1], 0.0)  # same float32: no change
    assert rig.go().result is UploadResult.ALL_NEW
    rig = Rig()
    rig.vehicle.params["COMPASS_OFS_Y"] = f32(-12.2)
    upload = rig.go()
    assert (upload.result, upload.reasons) == (UploadResult.REFUSED, (Reason.OFFSETS_CHANGED,))
    assert not rig.vehicle.sets


@given(st.sampled_from([math.nan, math.inf, -math.inf, 1e39, 1801.0, -2500.0]), st.integers(0, 2))
@settings(max_examples=12, deadline=None)
def test_S8_what_is_no_number_or_beyond_the_limit_is_refused(value: float, axis: int) -> None:
    new = list(a_change().new)
    new[axis] = value
    change = a_change(new=tuple(new))
    rig = Rig()
    upload = rig.go(change, confirm=confirmation_code(change))
    assert upload.result is UploadResult.REFUSED
    assert Reason.BEYOND_LIMIT in upload.reasons
    assert not rig.vehicle.sets


def test_S8_the_length_counts_with_the_axis_that_stays() -> None:
    rig = Rig()
    rig.vehicle.params["COMPASS_OFS_Z"] = rig.vehicle.applied["COMPASS_OFS_Z"] = 170.0
    rig.vehicle.params["COMPASS_OFFS_MAX"] = 175.0
    part = Change(
        1, 1, "COMPASS_DEV_ID", 97539, NAMES[:1], OLD[:1], (f32(65.3),), (60.0, 0.0, 0.0), (1.0,) * 3, (60.0,)
    )
    upload = rig.go(part)  # hypot(65, 12, 170) = 182
    assert (upload.result, upload.reasons) == (UploadResult.REFUSED, (Reason.BEYOND_LIMIT,))
    rig.vehicle.params["COMPASS_OFFS_MAX"] = 190.0
    assert rig.go(part).result is UploadResult.ALL_NEW
    assert {name for _, name, _ in rig.vehicle.sets} == {"COMPASS_OFS_X"}, "S4: no other axis is touched"


def test_S8_a_big_step_wants_its_code() -> None:
    change = a_change(20.0, -170.0, 10.0)
    code = code_needed(change)
    assert code is not None
    refused(Rig(), Reason.CONFIRM_CHANGE, change=change)
    refused(Rig(), Reason.CONFIRM_CHANGE, change=change, confirm=code - 1 if code > 1000 else 1001)
    assert Rig().go(change, confirm=code).result is UploadResult.ALL_NEW
    assert str(code) in dry_run(change)[-1]
    understated = replace(change, step_mg=(0.0, 0.0, 0.0))
    refused(Rig(), Reason.CONFIRM_CHANGE, change=understated)
    assert code_needed(a_change(150.0 - 1e-3, 0.0, 0.0)) is None


def test_confirmation_code_stands_for_one_change_in_every_process() -> None:
    change = a_change(20.0, -170.0, 10.0)
    others = [
        replace(change, system=2),
        replace(change, device_id=97540),
        replace(change, new=(change.new[0], change.new[1], math.nextafter(change.new[2], 99.0) + 1e-5)),
        replace(change, old=(0.0, *change.old[1:])),
    ]
    codes = {confirmation_code(c) for c in [change, *others]}
    assert len(codes) == 5 and all(1000 <= code <= 9999 for code in codes)
    program = (
        "from magmav.core.types import Change; from magmav.mavlink.change import confirmation_code;"
        f"print(confirmation_code({change!r}))"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert int(run.stdout) == confirmation_code(change)


@pytest.mark.parametrize(
    "name",
    ["COMPASS_DIA_X", "COMPASS_ODI2_X", "COMPASS_SCALE", "COMPASS_MOT_X", "COMPASS_ORIENT", "COMPASS_USE",
     "COMPASS_DEV_ID", "COMPASS_PRIO1_ID", "COMPASS_DEC", "COMPASS_LEARN", "COMPASS_CAL_FIT", "ARMING_CHECK",
     "COMPASS_OFS4_X", "COMPASS_OFS_X2", "xCOMPASS_OFS_X", "COMPASS_OFS2_X", "COMPASS_OFFS_MAX"],
)  # fmt: skip
def test_S5_S9_anything_but_this_compass_offsets_is_a_wrong_call(name: str) -> None:
    rig = Rig(latch_s=0.1)
    with pytest.raises(ValueError, match="change"):
        Upload(a_change(names=(name, *NAMES[1:])), rig.watch, journal=rig.journal)


@pytest.mark.parametrize("name", ["COMPASS_OFS_X2", "COMPASS_OFS_W", "COMPASS_DIA_X", "COMPASS_OFS1_X"])
def test_S5_alone_too(name: str) -> None:
    single = Change(1, 1, "COMPASS_DEV_ID", 1, (name,), (0.0,), (1.0,), (1.0, 0.0, 0.0), (1.0,) * 3, (1.0,))
    with pytest.raises(ValueError, match=name):
        checked(single)


def test_both_naming_schemes_are_known_and_not_mixed() -> None:
    rig = Rig(latch_s=0.1)
    for stem, device in (("COMPASS_OFS3_", "COMPASS_DEV_ID3"), ("COMPASS2_OFS_", "COMPASS2_DEV_ID")):
        names = tuple(stem + axis for axis in "XYZ")
        Upload(a_change(names=names, device_name=device), rig.watch, journal=rig.journal)
        with pytest.raises(ValueError, match="one compass"):
            Upload(a_change(names=names), rig.watch, journal=rig.journal)


def test_no_stream_is_refused_before_anything_is_written() -> None:
    rig = Rig()
    rig.vehicle.streams = False
    refused(rig, Reason.NO_STREAM)


def test_S19_wrong_vehicle_and_other_autopilots_and_no_change_are_refused_at_once() -> None:
    refused(Rig(), Reason.WRONG_VEHICLE, change=a_change(system=2))
    refused(Rig(), Reason.NOTHING_TO_DO, change=a_change(0.0, 0.0, 0.0))
    rig = Rig()
    assert rig.presence.autopilot is not None
    rig.presence.autopilot = replace(rig.presence.autopilot, kind=4)
    upload = Upload(a_change(), rig.watch, journal=rig.journal)
    upload.start(rig.vehicle.now_ns)
    assert upload.reasons == (Reason.NOT_SUPPORTED,)
    refused(Rig(latch_s=0.5), Reason.HEARTBEAT_OLD)  # nobody latched yet


def test_AT_8c_unknown_name_is_refused_in_ten_seconds_silent_or_not() -> None:
    rig = Rig()
    del rig.vehicle.params["COMPASS_LEARN"]
    begin_ns = rig.vehicle.now_ns
    refused(rig, Reason.UNKNOWN_PARAM)
    assert rig.vehicle.now_ns - begin_ns <= 10.1 * S
    rig = Rig()
    error = dialect.MAVLink_param_error_message(1, 191, b"COMPASS_LEARN", -1, 1)
    rig.vehicle.at.append((rig.vehicle.now_ns + S, lambda: rig.vehicle.say(error)))
    del rig.vehicle.params["COMPASS_LEARN"]
    begin_ns = rig.vehicle.now_ns
    refused(rig, Reason.UNKNOWN_PARAM)
    assert rig.vehicle.now_ns - begin_ns <= 1.1 * S


def test_a_deaf_vehicle_is_asked_a_bounded_number_of_times() -> None:
    rig = Rig()
    rig.vehicle.deaf = True
    refused(rig, Reason.UNKNOWN_PARAM)
    assert len(rig.vehicle.sent) <= 6 * 20
    rig = Rig()
    rig.vehicle.on_set = lambda name: setattr(rig.vehicle, "deaf", True)  # deaf after the first write
    upload = rig.go()
    assert upload.result is UploadResult.PENDING_RESTORE
    assert upload.reasons == (Reason.UNKNOWN_PARAM, Reason.UNKNOWN_PARAM)[:1]
    assert len(rig.vehicle.sets) <= 3 * 12 * 2
    assert rig.journal.ended[0][1] is UploadResult.PENDING_RESTORE
    rig.check_S1()


def test_S2_no_record_no_write() -> None:
    rig = Rig()
    rig.journal.fails = OSError("disk full")
    refused(rig, Reason.NOT_RECORDED)
    rig.journal.fails = BlockingIOError("somebody else")
    refused(rig, Reason.BUSY)


@pytest.mark.parametrize("late_ms", [1000, 2000, 3000, 4000])
def test_S1_a_write_that_landed_after_arming_is_no_success_however_late_the_heartbeat_says_so(late_ms: int) -> None:
    """Heartbeats from before come late, those that say armed are lost for a while: all is proven first."""
    rig = Rig()
    vehicle = rig.vehicle

    def arm(name: str) -> None:
        vehicle.on_set = lambda name: None
        vehicle.heartbeats, vehicle.armed = False, True
        for after_ms in (300, 900):  # on their way since before
            vehicle.at.append((vehicle.now_ns + after_ms * MS, lambda: vehicle.say(vehicle.heartbeat(armed=False))))
        vehicle.at.append((vehicle.now_ns + late_ms * MS, lambda: setattr(vehicle, "heartbeats", True)))

    vehicle.on_set = arm
    upload = rig.go()
    assert (upload.result, upload.reasons) == (UploadResult.PENDING_RESTORE, (Reason.ARMED,))
    assert rig.journal.ended == [(7, UploadResult.PENDING_RESTORE, (Reason.ARMED,))]
    rig.check_S1()


@pytest.mark.parametrize("undoes", [None, 7])
def test_S1_nothing_is_called_done_before_a_heartbeat_that_left_after_the_last_write(undoes: int | None) -> None:
    rig = Rig()
    rig.vehicle.on_set = lambda name: setattr(rig.vehicle, "heartbeats", False)
    if undoes:
        rig.vehicle.params |= dict(zip(NAMES, a_change().new, strict=True))
        rig.vehicle.applied |= rig.vehicle.params
    upload = rig.go(undoes=undoes)
    assert (upload.result, upload.reasons) == (UploadResult.PENDING_RESTORE, (Reason.LINK_LOST,))


@pytest.mark.parametrize("took_s", [0.8, 1.3, 3.0, 9.0])
def test_S1_a_disk_that_takes_seconds_makes_no_old_heartbeat_fresh(took_s: float) -> None:
    """While the record is written nothing is read. What waited meanwhile says disarmed; the vehicle has armed since."""
    rig = Rig()
    vehicle, begin = rig.vehicle, rig.journal.begin

    def slow(*args: Any) -> int:
        row = begin(*args)
        for _ in range(3):
            vehicle.say(vehicle.heartbeat(False))
        vehicle.armed, vehicle.now_ns = True, vehicle.now_ns + round(took_s * S)
        return row

    rig.journal.begin = slow  # type: ignore[method-assign]
    upload = rig.go()
    assert (upload.result, vehicle.sets) == (UploadResult.REFUSED, [])
    assert rig.stored() == OLD


@pytest.mark.parametrize("took_s", [0.4, 0.8, 3.0])
def test_a_disk_that_takes_seconds_only_delays(took_s: float) -> None:
    rig = Rig()
    vehicle, begin = rig.vehicle, rig.journal.begin

    def slow(*args: Any) -> int:
        row = begin(*args)
        vehicle.now_ns += round(took_s * S)
        return row

    rig.journal.begin = slow  # type: ignore[method-assign]
    assert rig.go().result is UploadResult.ALL_NEW
    rig.check_S1()


def test_S3_armed_between_write_one_and_two_stops_and_says_so() -> None:
    rig = Rig()
    vehicle = rig.vehicle

    def arm(name: str) -> None:
        vehicle.armed, vehicle.deaf = True, True  # the second and third PARAM_SET are lost
        vehicle.say(vehicle.heartbeat())

    vehicle.on_set = arm
    upload = rig.go()
    assert (upload.result, upload.reasons) == (UploadResult.PENDING_RESTORE, (Reason.ARMED,))
    assert rig.stored() == (a_change().new[0], *OLD[1:])
    texts = [m for _, m in vehicle.sent if m.get_type() == "STATUSTEXT"]
    assert [m.severity for m in texts] == [dialect.MAV_SEVERITY_CRITICAL]
    assert rig.journal.ended == [(7, UploadResult.PENDING_RESTORE, (Reason.ARMED,))]
    rig.check_S1()

    # while armed the way back is refused, after disarming it works and restores exactly
    vehicle.deaf, sets, vehicle.on_set = False, len(vehicle.sets), lambda name: None
    vehicle.forget_sets()
    again = rig.go(undoes=7)
    assert (again.result, again.reasons, vehicle.sets) == (UploadResult.REFUSED, (Reason.ARMED,), [])
    vehicle.armed = False
    vehicle.run(None, 2.0, rig.feed)
    again = rig.go(undoes=7)
    assert (again.result, again.reasons) == (UploadResult.ALL_OLD, ())
    assert rig.stored() == OLD
    assert [name for _, name, _ in vehicle.sets] == ["COMPASS_OFS_X"], "what is old already is left alone"
    assert sets == 3
    rig.check_S1()


def test_S1_taking_off_or_calibrating_midway_stops_at_once() -> None:
    for spoil, why in (
        (dialect.MAVLink_extended_sys_state_message(0, 3), Reason.NOT_LANDED),
        (dialect.MAVLink_mag_cal_progress_message(0, 1, 2, 1, 30, [0] * 10, 0, 0, 0), Reason.SECOND_WRITER),
    ):
        rig = Rig()
        rig.vehicle.on_set = lambda name, rig=rig, spoil=spoil: rig.vehicle.say(spoil)  # type: ignore[misc]
        upload = rig.go()
        assert (upload.result, upload.reasons) == (UploadResult.PENDING_RESTORE, (why,))
        assert rig.vehicle.now_ns - rig.vehicle.sets[0][0] <= 100 * MS


def test_S1_holds_whoever_hears_a_message_first() -> None:
    """The upload may be told before presence is; it must not act on what presence still believes."""
    for tick in range(60):
        rig = Rig(tick, latch_s=7.0 + tick / 50)
        vehicle = rig.vehicle
        vehicle.at.append((vehicle.now_ns + 900 * MS + tick * 10 * MS, lambda v=vehicle: arm(v)))

        def arm(vehicle: Vehicle) -> None:
            vehicle.armed = True
            vehicle.say(vehicle.heartbeat())

        upload = Upload(a_change(), rig.watch, journal=rig.journal)
        upload.start(vehicle.now_ns)

        class First:
            result = None

            def on_message(self, message: Any, route: str, now_ns: int, rig: Rig = rig, up: Upload = upload) -> Any:
                out = up.on_message(message, route, now_ns)
                rig.feed(message, route, now_ns)
                self.result = up.result  # type: ignore[assignment]
                return out

            def poll(self, now_ns: int, up: Upload = upload) -> Any:
                return up.poll(now_ns)

        vehicle.run(First(), 30.0)
        assert upload.result is not None
        rig.check_S1()


def test_a_write_that_lands_late_is_seen_before_the_retreat_is_believed() -> None:
    rig = Rig()
    vehicle = rig.vehicle
    vehicle.applies = False
    late = dialect.MAVLink_param_set_message(1, 1, b"COMPASS_OFS_X", a_change().new[0], 9)

    def retreat_begins(name: str) -> None:
        if len(vehicle.sets) == 6:  # a copy of the first write was held up in a radio for so long
            vehicle.at.append(
                (vehicle.now_ns + 2500 * MS, lambda: vehicle.params.update({late.param_id: late.param_value}))
            )
            vehicle.on_set = lambda name: None

    vehicle.on_set = retreat_begins
    upload = rig.go()
    vehicle.run(None, 4.0, rig.feed)
    assert upload.result is UploadResult.ALL_OLD
    assert rig.stored() == OLD


def test_link_loss_midway_is_pending_and_ends_in_seconds() -> None:
    rig = Rig()
    rig.vehicle.on_set = lambda name: setattr(rig.vehicle, "loss", 1.0)
    upload = rig.go()
    assert (upload.result, upload.reasons) == (UploadResult.PENDING_RESTORE, (Reason.LINK_LOST,))
    assert rig.vehicle.now_ns - rig.vehicle.sets[0][0] <= 6 * S
    rig.check_S1()


def test_heartbeats_alone_missing_stop_the_writing_after_their_age() -> None:
    rig = Rig()
    vehicle = rig.vehicle

    def mute(name: str) -> None:
        vehicle.heartbeats, vehicle.deaf = False, True

    vehicle.on_set = mute
    upload = rig.go()
    assert upload.result is UploadResult.PENDING_RESTORE
    assert Reason.LINK_LOST in upload.reasons
    rig.check_S1()


def test_a_reboot_midway_is_pending() -> None:
    rig = Rig()
    rig.vehicle.speed_cms = 0
    rig.vehicle.on_set = lambda name: rig.vehicle.clock(50)
    upload = rig.go()
    assert (upload.result, upload.reasons) == (UploadResult.PENDING_RESTORE, (Reason.LINK_LOST,))


def test_restore_after_success_brings_back_the_exact_values_with_proof() -> None:
    rig = Rig()
    assert rig.go().result is UploadResult.ALL_NEW
    rig.vehicle.forget_sets()
    undo = rig.go(undoes=7)
    assert (undo.result, undo.reasons) == (UploadResult.ALL_OLD, ())
    assert rig.stored() == OLD
    rig.check_S1()


def test_restore_obeys_S1_S6_S7() -> None:
    for spoil, why in (
        (lambda v: setattr(v, "armed", True), Reason.ARMED),
        (lambda v: setattr(v, "landed_state", 2), Reason.NOT_LANDED),
        (lambda v: v.params.update(COMPASS_DEV_ID=1.0), Reason.DEVICE_CHANGED),
        (lambda v: v.params.update(COMPASS_LEARN=3.0), Reason.SECOND_WRITER),
        (lambda v: v.params.update(COMPASS_OFS_Z=1.0), Reason.OFFSETS_CHANGED),
    ):
        rig = Rig()
        rig.go()
        rig.vehicle.forget_sets()
        spoil(rig.vehicle)
        undo = rig.go(undoes=7)
        assert (undo.result, undo.reasons, rig.vehicle.sets) == (UploadResult.REFUSED, (why,), [])


def test_restore_needs_no_code_and_no_stream() -> None:
    rig = Rig()
    change = a_change(20.0, -170.0, 10.0)
    rig.go(change, confirm=confirmation_code(change))
    rig.vehicle.streams, rig.vehicle.landed_state = False, 1
    rig.vehicle.forget_sets()
    assert rig.go(change, undoes=7).result is UploadResult.ALL_OLD
    assert rig.stored() == OLD


def test_restore_decision_asks_unless_every_value_is_ours_or_the_old_one() -> None:
    change = a_change()
    held = dict(zip(NAMES, change.old, strict=True)) | {"COMPASS_DEV_ID": 97539.0}
    assert restore_blockers(change, 1, held) == ()
    assert restore_blockers(change, 1, held | {"COMPASS_OFS_X": change.new[0]}) == ()
    assert restore_blockers(change, 2, held) == (Reason.WRONG_VEHICLE,)
    assert restore_blockers(change, 1, held | {"COMPASS_OFS_X": 0.5}) == (Reason.OFFSETS_CHANGED,)
    assert restore_blockers(change, 1, held | {"COMPASS_DEV_ID": 1.0}) == (Reason.DEVICE_CHANGED,)
    assert restore_blockers(change, 1, {}) == (Reason.UNKNOWN_PARAM,)


def test_AT_8a_thirty_percent_loss_both_ways_is_never_mixed() -> None:
    ends: dict[UploadResult, int] = {}
    for seed in range(60):
        rig = Rig(seed)
        dice = rig.vehicle.random
        rig.vehicle.loss, rig.vehicle.duplicate = 0.3, 0.1
        rig.vehicle.delay_ns = lambda dice=dice: round(dice.uniform(5, 300) * MS)  # type: ignore[misc]
        upload = rig.go()
        assert upload.result in (UploadResult.ALL_NEW, UploadResult.ALL_OLD), (seed, upload.reasons)
        assert rig.stored() == (a_change().new if upload.result is UploadResult.ALL_NEW else OLD), seed
        rig.check_S1()
        ends[upload.result] = ends.get(upload.result, 0) + 1
    assert ends[UploadResult.ALL_NEW] >= 57, ends


def test_AT_8a_late_copies_of_a_write_cannot_undo_the_retreat() -> None:
    for seed in range(10):
        rig = Rig(seed)
        rig.vehicle.applies = False
        dice = rig.vehicle.random
        rig.vehicle.loss, rig.vehicle.duplicate = 0.1, 0.5
        rig.vehicle.delay_ns = lambda dice=dice: round(dice.choice((5, 100, 1900)) * MS)  # type: ignore[misc]
        upload = rig.go()
        rig.vehicle.run(None, 4.0, rig.feed)  # let everything arrive
        assert upload.result is UploadResult.ALL_OLD, (seed, upload.reasons)
        assert rig.stored() == OLD, seed


@pytest.mark.long
def test_S1_S3_fuzzed_arming_never_meets_a_write() -> None:
    results = set()
    for seed in range(250):
        dice = random.Random(seed)
        rig = Rig(seed, latch_s=dice.uniform(3.4, 8.0))
        vehicle = rig.vehicle
        vehicle.loss = dice.choice((0.0, 0.0, 0.2))
        vehicle.applies = dice.random() < 0.7  # retreats are met too
        at_ns = vehicle.now_ns + round(dice.uniform(0.5, 12.0) * S)
        spoil = dice.choice(("arm", "arm", "arm and say", "mute", "flap"))

        def act(vehicle: Vehicle = vehicle, spoil: str = spoil) -> None:
            if spoil == "mute":
                vehicle.heartbeats = False
                return
            vehicle.armed = True
            if spoil == "arm and say":
                vehicle.say(vehicle.heartbeat())
            if spoil == "flap":
                vehicle.at.append((vehicle.now_ns + 900 * MS, lambda: setattr(vehicle, "armed", False)))

        vehicle.at.append((at_ns, act))
        upload = rig.go(until_s=60.0)
        rig.check_S1()
        if upload.result in (UploadResult.REFUSED, UploadResult.ALL_OLD):
            assert rig.stored() == OLD, seed
        elif upload.result is UploadResult.ALL_NEW:
            assert rig.stored() == a_change().new, seed
        results.add(upload.result)
    every = {UploadResult.ALL_NEW, UploadResult.ALL_OLD, UploadResult.REFUSED, UploadResult.PENDING_RESTORE}
    assert results == every, "the fuzz reaches every end"


def test_the_real_store_is_its_journal(tmp_path: Any) -> None:
    rig = Rig()
    with Store(tmp_path / "s.sqlite") as store:
        rig.journal = store  # type: ignore[assignment]
        assert rig.go(unix_offset_ns=5).result is UploadResult.ALL_NEW
        row = store.last_restorable(1, 1, 97539)
        assert row is not None and row.change == a_change() and store.pending() == []
        undo = rig.go(row.change, undoes=row.id)
        assert undo.result is UploadResult.ALL_OLD
        assert rig.stored() == OLD
        assert store.last_restorable(1, 1, 97539) is None


def raw_imu(mag: tuple[int, int, int], kind: str = "raw_imu") -> Any:
    make = getattr(dialect, f"MAVLink_{kind}_message")
    return make(0, 0, 0, -1000, 0, 0, 0, *mag)


def window(*values: tuple[int, int, int], compass: int = 1) -> Window:
    out = Window(ADAPTERS[3].proof_streams(compass), 0)
    for value in values:
        out.add(raw_imu(value))
    return out


def test_window_counts_news_only() -> None:
    held = window((1, 2, 3), (1, 2, 3), (1, 2, 3), (0, 0, 0), (3, 2, 1), (1, 2, 3))
    assert len(held) == 3 and held.mean_mg == pytest.approx((5 / 3, 2.0, 7 / 3))
    held.add(raw_imu((900, 900, 900), "scaled_imu"))  # the same compass through another message
    held.add(raw_imu((900, 900, 900), "scaled_imu2"))
    assert len(held) == 3
    second = Window(ADAPTERS[3].proof_streams(2), 0)
    for kind in ("raw_imu", "scaled_imu2", "scaled_imu3"):
        second.add(raw_imu((1, 1, 1), kind))
    assert len(second) == 1
    assert not second.ready(S) and second.ready(2 * S)
    ten = window(*((i, 0, 1) for i in range(10)))
    assert ten.ready(0) and ten.error_mg == pytest.approx((np.std(range(10), ddof=1) / 10**0.5, 0.19, 0.19), abs=0.01)


def test_proof_tells_a_small_shift_from_none() -> None:
    noisy = [(i % 5 - 2, 100, 100) for i in range(10)]
    before = window(*noisy)
    after = window(*((x + 6, y, z) for x, y, z in noisy))
    assert moved_as_predicted(before, after, (6.0, 0.0, 0.0))
    assert not moved_as_predicted(before, before, (6.0, 0.0, 0.0))
    assert not moved_as_predicted(before, after, (-6.0, 0.0, 0.0))


@given(st.integers(-400, 400), st.integers(-400, 400), st.floats(-60, 60))
@settings(max_examples=80, deadline=None)
def test_proof_accepts_the_prediction_and_nothing_far_from_it(x: int, y: int, wrong: float) -> None:
    before = window(*((100 + i % 2, 200, 300) for i in range(10)))
    after = window(*((100 + i % 2 + x, 200 + y, 300) for i in range(10)))
    allowed = 4.0 + 0.05 * math.hypot(x, y + wrong) + 3 * math.hypot(0.19, 0.19)
    assert moved_as_predicted(before, after, (float(x), float(y), 0.0))
    if abs(wrong) > allowed + 0.1:
        assert not moved_as_predicted(before, after, (float(x), y + wrong, 0.0))


def test_AT_4b_killed_at_any_moment_the_way_back_works() -> None:
    mixed = 0
    for step in range(60):
        rig = Rig(step)
        rig.vehicle.loss = 0.3 if step % 2 else 0.0
        doomed = Upload(a_change(), rig.watch, journal=rig.journal)
        doomed.start(rig.vehicle.now_ns)
        rig.vehicle.run(doomed, 1.0 + step * 0.05, rig.feed)  # and no more: the process is gone
        if not rig.journal.began:
            assert rig.stored() == OLD, "S2: nothing is written before it is on record"
            continue
        mixed += rig.stored() != OLD
        rig.vehicle.loss = 0.0
        rig.vehicle.forget_sets()
        rig.vehicle.run(None, 1.0, rig.feed)
        assert rig.go(undoes=7).result is UploadResult.ALL_OLD
        assert rig.stored() == OLD
    assert mixed >= 10


def test_AT_8b_a_float32_is_compared_as_one_and_its_neighbour_is_another_value() -> None:
    """0.1 on disk, in JSON or as the wire's float is one value; one unit in the last place off is not (AT-8b)."""
    rig = Rig()
    rig.vehicle.params["COMPASS_OFS_X"] = rig.vehicle.applied["COMPASS_OFS_X"] = f32(0.1)
    change = a_change(old=(0.1, *OLD[1:]), new=(60.1, *a_change().new[1:]))
    assert rig.go(change).result is UploadResult.ALL_NEW
    rig = Rig()
    near = float(np.nextafter(np.float32(OLD[0]), np.float32(99.0)))
    rig.vehicle.params["COMPASS_OFS_X"] = near
    assert rig.go().reasons == (Reason.OFFSETS_CHANGED,)


class Contrary(Vehicle):
    """An ArduPilot that puts an integer's own bytes where the float is, and may say so (AUTOPILOT_VERSION)."""

    def _value_out(self, name: str) -> Any:
        if name not in ("COMPASS_DEV_ID", "COMPASS_LEARN"):
            return super()._value_out(name)
        (bits,) = struct.unpack("<f", struct.pack("<i", int(self.params[name])))
        return dialect.MAVLink_param_value_message(name.encode(), bits, 6, 1000, 40)


class ContraryRig(Rig):
    make = Contrary


@pytest.mark.parametrize("says", [16, 131072, 0, 16 | 131072])
@pytest.mark.parametrize("route", ["", "udp:2"])
def test_AT_8b_what_the_vehicle_says_of_its_encoding_counts_for_a_write_too(says: int, route: str) -> None:
    """An integer is read as the vehicle says, over its own route; else as its kind does, which here is wrong."""
    rig = ContraryRig()
    version = dialect.MAVLink_autopilot_version_message(says, 0, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 0)
    rig.vehicle.say(version, route)
    rig.vehicle.run(None, 15.0, rig.feed)  # and what comes over a second route is long past
    upload = rig.go()
    if says == 16 and not route:
        assert (upload.result, upload.reasons) == (UploadResult.ALL_NEW, ())
    else:
        assert (upload.result, upload.reasons) == (UploadResult.REFUSED, (Reason.DEVICE_CHANGED,))
        assert not rig.vehicle.sets


def test_S20_after_a_write_there_is_advice_before_take_off_and_after_none_there_is_none() -> None:
    """Every end that wrote something says wait or reboot; none before the compass settled, none that invites."""
    rig = Rig()
    upload = rig.go()
    done_ns = rig.vehicle.now_ns
    assert done_ns - rig.vehicle.sets[-1][0] >= UploadSettings().settle_ns, "the end comes after the compass settled"
    spoilt = Rig(applies=False).go()
    cut = Rig()
    cut.vehicle.on_set = lambda name: setattr(cut.vehicle, "loss", 1.0)
    for ended in (upload, spoilt, cut.go()):
        assert "reboot or wait half a minute before take-off" in ended.progress, ended.progress
    assert "take-off" not in Rig(armed=True).go().progress


def test_S20_no_end_of_a_write_comes_before_its_settle_time() -> None:
    for seed in range(20):
        rig = Rig(seed, noise_mg=0.1)
        phases: list[tuple[int, str]] = []
        upload = Upload(a_change(), rig.watch, journal=rig.journal)
        rig.vehicle.at.append((0, lambda: None))
        upload.start(rig.vehicle.now_ns)
        while upload.result is None:
            phases.append((rig.vehicle.now_ns, upload.phase.name))
            rig.vehicle.run(upload, 0.02, rig.feed)
        first_proof = next(t for t, phase in phases if phase == "PROOF")
        assert first_proof - rig.vehicle.sets[-1][0] >= UploadSettings().settle_ns


def test_settings_can_only_tighten_the_limit() -> None:
    rig = Rig()
    upload = rig.go(settings=UploadSettings(offs_max_mg=60.0))
    assert (upload.result, upload.reasons) == (UploadResult.REFUSED, (Reason.BEYOND_LIMIT,))
    rig = Rig()
    rig.vehicle.params["COMPASS_OFFS_MAX"] = 60.0
    assert rig.go(settings=UploadSettings(offs_max_mg=900.0)).reasons == (Reason.BEYOND_LIMIT,)
