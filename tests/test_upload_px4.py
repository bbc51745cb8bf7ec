"""Offsets to PX4: gauss, byte-wise, by the slot that holds the device, and never called proven (autopilots.md 4)."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scripted_vehicle import MS, Px4Vehicle, S, f32
from upload_rig import Rig

from magmav.core.types import Change, Reason, UploadResult
from magmav.mavlink.change import checked, code_needed, dry_run, is_too_small, largest_step_mg
from magmav.mavlink.upload import Upload

NAMES = ("CAL_MAG1_XOFF", "CAL_MAG1_YOFF", "CAL_MAG1_ZOFF")
OLD = (f32(0.0053), f32(-0.0121), f32(0.0407))


def px4_change(*step_gauss: float, **other: Any) -> Change:
    step = step_gauss or (0.06, -0.045, 0.08)
    new = tuple(f32(o + s) for o, s in zip(OLD, step, strict=True))
    mg = tuple(1000.0 * abs(s) for s in step)
    made = Change(1, 1, "CAL_MAG1_ID", 97539, NAMES, OLD, new, (-60.0, 45.0, -80.0), (1.0, 1.0, 1.0), mg)
    return replace(made, **other)


class Px4Rig(Rig):
    """The same bench with a PX4 on it."""

    make = Px4Vehicle
    names = NAMES
    first = staticmethod(px4_change)


def refused(rig: Px4Rig, *why: Reason, change: Change | None = None, **more: Any) -> None:
    upload = rig.go(change, **more)
    assert (upload.result, upload.reasons) == (UploadResult.REFUSED, why)
    assert not rig.vehicle.sets and not rig.journal.began and rig.stored() == OLD


def test_px4_a_write_is_read_back_and_called_unproven_with_the_advice_to_reboot() -> None:
    rig = Px4Rig()
    upload = rig.go()
    assert (upload.result, upload.reasons) == (UploadResult.WRITTEN_UNPROVEN, (Reason.REBOOT_TO_APPLY,))
    assert rig.stored() == px4_change().new
    assert "reboot before take-off" in upload.progress
    assert rig.journal.ended == [(7, UploadResult.WRITTEN_UNPROVEN, (Reason.REBOOT_TO_APPLY,))]
    assert {m.param_type for _, m in rig.vehicle.sent if m.get_type() == "PARAM_SET"} == {9}
    assert "COMMAND_LONG" not in {m.get_type() for _, m in rig.vehicle.sent}
    rig.check_S1()


def test_px4_a_restore_brings_back_the_exact_values() -> None:
    rig = Px4Rig()
    rig.go()
    rig.vehicle.forget_sets()
    undo = rig.go(undoes=7)
    assert (undo.result, undo.reasons, rig.stored()) == (UploadResult.ALL_OLD, (), OLD)


@pytest.mark.parametrize("autocal", [1.0, -1.0])
def test_S7_AT_18a_px4_in_flight_calibration_is_a_second_writer(autocal: float) -> None:
    """-1 is a NaN on the wire, and nevertheless not 0."""
    rig = Px4Rig()
    rig.vehicle.params["SENS_MAG_AUTOCAL"] = autocal
    refused(rig, Reason.SECOND_WRITER)


def test_S7_AT_18a_px4_whether_it_calibrates_in_flight_must_be_known() -> None:
    rig = Px4Rig()
    del rig.vehicle.params["SENS_MAG_AUTOCAL"]
    begin_ns = rig.vehicle.now_ns
    refused(rig, Reason.UNKNOWN_PARAM)
    assert rig.vehicle.now_ns - begin_ns <= 10.1 * S


def test_S6_AT_18a_px4_another_device_in_the_slot_or_the_same_in_two_is_refused() -> None:
    rig = Px4Rig()
    rig.vehicle.params["CAL_MAG1_ID"] = 97540.0
    refused(rig, Reason.DEVICE_CHANGED)
    rig = Px4Rig()
    rig.vehicle.params["CAL_MAG3_ID"] = 97539.0
    refused(rig, Reason.MAPPING_UNCLEAR)


@pytest.mark.parametrize(("mg", "small"), [(9.9, True), (10.1, False)])
def test_px4_a_change_it_would_not_take_up_is_refused(mg: float, small: bool) -> None:
    change = px4_change(mg / 1000.0 / math.sqrt(2.0), mg / 1000.0 / math.sqrt(2.0), 0.0)
    assert is_too_small(change) is small
    if small:
        refused(Px4Rig(), Reason.TOO_SMALL, change=change)
    else:
        assert Px4Rig().go(change).result is UploadResult.WRITTEN_UNPROVEN


def test_S8_px4_limits_and_the_code_are_in_milligauss() -> None:
    change = px4_change(0.02, -0.17, 0.01)
    assert largest_step_mg(change) == pytest.approx(170.0)
    code = code_needed(change)
    assert code is not None and str(code) in dry_run(change)[-1]
    refused(Px4Rig(), Reason.CONFIRM_CHANGE, change=change)
    assert Px4Rig().go(change, confirm=code).result is UploadResult.WRITTEN_UNPROVEN
    far = px4_change(1.4, 0.0, 0.0)
    refused(Px4Rig(), Reason.BEYOND_LIMIT, change=far, confirm=code_needed(far))


def test_S5_px4_nothing_but_offsets_and_nothing_of_the_other_autopilot() -> None:
    rig = Px4Rig(latch_s=0.1)
    for name in (
        "CAL_MAG1_XSCALE",
        "CAL_MAG1_ID",
        "CAL_MAG1_ROT",
        "SENS_MAG_AUTOCAL",
        "CAL_MAG4_XOFF",
        "COMPASS_OFS_X",
    ):
        with pytest.raises(ValueError, match="change"):
            Upload(px4_change(names=(name, *NAMES[1:])), rig.watch, journal=rig.journal)
    with pytest.raises(ValueError, match="one compass"):
        checked(px4_change(device_name="CAL_MAG2_ID"))


def test_S19_a_change_for_one_autopilot_is_refused_by_the_other() -> None:
    refused(Px4Rig(), Reason.WRONG_VEHICLE, change=Rig.first())
    rig = Rig()
    upload = rig.go(px4_change())
    assert (upload.result, upload.reasons, rig.vehicle.sets) == (UploadResult.REFUSED, (Reason.WRONG_VEHICLE,), [])


def test_S1_px4_armed_or_not_landed_is_refused_and_midway_is_pending() -> None:
    refused(Px4Rig(armed=True), Reason.ARMED)
    refused(Px4Rig(landed_state=2), Reason.NOT_LANDED)
    for step in range(12):
        rig = Px4Rig(step)
        vehicle = rig.vehicle
        vehicle.loss = 0.3
        vehicle.at.append((vehicle.now_ns + 2500 * MS + step * 100 * MS, lambda v=vehicle: setattr(v, "armed", True)))
        upload = rig.go()
        rig.check_S1()
        if upload.result is UploadResult.PENDING_RESTORE:
            vehicle.armed, vehicle.loss = False, 0.0
            vehicle.run(None, 2.0, rig.feed)
            vehicle.forget_sets()
            assert rig.go(undoes=7).result is UploadResult.ALL_OLD and rig.stored() == OLD
        else:
            assert rig.stored() == (OLD if upload.result is UploadResult.REFUSED else px4_change().new)


def test_AT_8a_px4_thirty_percent_loss_is_never_mixed() -> None:
    for seed in range(12):
        rig = Px4Rig(seed)
        dice = rig.vehicle.random
        rig.vehicle.loss, rig.vehicle.duplicate = 0.3, 0.1
        rig.vehicle.delay_ns = lambda d=dice: round(d.uniform(5, 2000) * MS)  # type: ignore[misc]
        upload = rig.go()
        assert upload.result in (UploadResult.WRITTEN_UNPROVEN, UploadResult.ALL_OLD), (seed, upload.reasons)
        assert rig.stored() == (px4_change().new if upload.result is UploadResult.WRITTEN_UNPROVEN else OLD)


def test_AT_8b_px4_what_the_autopilot_bends_is_not_taken_for_written() -> None:
    """A value read back one unit in the last place off is not the value (float32 equality)."""
    rig = Px4Rig()
    vehicle = rig.vehicle

    def bend(name: str) -> None:
        vehicle.params[name] = float(np.nextafter(np.float32(vehicle.params[name]), np.float32(1.0)))

    vehicle.on_set = bend
    upload = rig.go()
    assert upload.result is UploadResult.PENDING_RESTORE and Reason.OFFSETS_CHANGED in upload.reasons
