"""After a write the operator hears whether the autopilot will arm with it; nothing is done to make it say so."""

from __future__ import annotations

from dataclasses import replace

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect
from scripted_vehicle import MS, S
from upload_rig import NAMES, OLD, Rig, a_change

from magmav.core.types import Reason, UploadResult
from magmav.mavlink.arming import MANUAL_STEP


def commands(rig: Rig) -> list[int]:
    return [m.command for _, m in rig.vehicle.sent if m.get_type() == "COMMAND_LONG"]


def test_AT_7a_device_id_not_committed_is_said_with_the_step_and_the_step_is_not_taken() -> None:
    rig = Rig()
    rig.vehicle.committed = False
    upload = rig.go()
    assert (upload.result, upload.reasons) == (UploadResult.ALL_NEW, (Reason.NOT_COMMITTED,))
    assert rig.stored() == a_change().new
    assert "still say not calibrated" in upload.progress and "reboot" in upload.progress
    assert "param2 = 76" in MANUAL_STEP and MANUAL_STEP in upload.progress
    assert set(commands(rig)) == {dialect.MAV_CMD_RUN_PREARM_CHECKS}, "S9: 76 is for the operator"
    assert rig.journal.ended[-1][1:] == (UploadResult.ALL_NEW, (Reason.NOT_COMMITTED,))


def test_AT_7a_a_committed_compass_has_nothing_to_be_said() -> None:
    rig = Rig()
    upload = rig.go()
    assert (upload.result, upload.reasons) == (UploadResult.ALL_NEW, ())
    assert MANUAL_STEP not in upload.progress and commands(rig) == [dialect.MAV_CMD_RUN_PREARM_CHECKS]


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_AT_7a_where_the_command_is_unknown_zero_offsets_before_are_the_sign(loss: float) -> None:
    for old, why in ((OLD, ()), ((0.0, 0.0, 0.0), (Reason.PERHAPS_NOT_COMMITTED,))):
        rig = Rig(4, knows_prearm_checks=False)
        rig.vehicle.params.update(zip(NAMES, old, strict=True))
        rig.vehicle.applied.update(zip(NAMES, old, strict=True))
        rig.vehicle.loss = loss
        upload = rig.go(
            replace(a_change(), old=old, new=tuple(o + s for o, s in zip(old, (60.0, -45.0, 80.0), strict=True)))
        )
        assert (upload.result, upload.reasons) == (UploadResult.ALL_NEW, why)


def test_AT_7a_a_deaf_autopilot_is_asked_thrice_and_the_write_still_counts() -> None:
    rig = Rig()
    upload_end: list[int] = []
    rig.vehicle.on_set = lambda name: rig.vehicle.at.append((rig.vehicle.now_ns + 2 * S, deafen))

    def deafen() -> None:
        rig.vehicle.deaf = True
        upload_end.append(rig.vehicle.now_ns)

    upload = rig.go()
    assert upload.result is UploadResult.ALL_NEW
    assert len(commands(rig)) <= 3
    assert rig.vehicle.now_ns - rig.vehicle.sets[-1][0] <= 12 * S


def test_AT_7a_arming_meanwhile_ends_the_question_and_the_write_stays_done() -> None:
    """The new values were proven before: nothing is left to take back, and nothing more is sent."""
    rig = Rig()
    vehicle = rig.vehicle
    vehicle.knows_prearm_checks = True
    say = vehicle._command

    def arm_instead(message: object) -> None:
        vehicle.armed = True
        vehicle.say(vehicle.heartbeat())
        vehicle.at.append((vehicle.now_ns + 100 * MS, lambda: say(message)))

    vehicle._command = arm_instead  # type: ignore[method-assign]
    upload = rig.go()
    assert (upload.result, upload.reasons) == (UploadResult.ALL_NEW, ())
    assert rig.journal.ended[0][1] is UploadResult.ALL_NEW, "on record before the question"
    assert len(commands(rig)) == 1


def test_AT_7a_a_restore_asks_nothing() -> None:
    rig = Rig()
    rig.go()
    rig.vehicle.sent.clear()
    rig.vehicle.forget_sets()
    assert rig.go(undoes=7).result is UploadResult.ALL_OLD
    assert commands(rig) == []


def test_S9_nothing_but_offsets_reads_and_checks_is_ever_sent() -> None:
    """The allow-list of everything an upload puts on the wire, in every ending."""
    for seed in range(12):
        rig = Rig(seed)
        rig.vehicle.committed = bool(seed % 2)
        rig.vehicle.applies = seed % 3 != 0
        rig.vehicle.loss = 0.2 * (seed % 4 == 0)
        rig.go()
        for _, m in rig.vehicle.sent:
            kind = m.get_type()
            assert kind in ("PARAM_SET", "PARAM_REQUEST_READ", "COMMAND_LONG", "STATUSTEXT")
            if kind == "PARAM_SET":
                assert m.param_id in NAMES
            if kind == "COMMAND_LONG":
                values = [getattr(m, f"param{i}") for i in range(1, 8)]
                assert (m.command, values) == (dialect.MAV_CMD_RUN_PREARM_CHECKS, [0.0] * 7)
