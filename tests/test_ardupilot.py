"""ArduPilot's correction undone, against a forward model written from its source and not from ours."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from magmav.core.types import ParamReading, vec3
from magmav.mavlink.autopilot.ardupilot import Calibrations, plan_change, wanted_names

AXES = "XYZ"


def forward(p, sensor, n="", throttle=0.0, ampere=0.0):
    """AP_Compass_Backend::correct_field, in its own order: offsets, scale, matrix, motor."""
    field = [sensor[i] + p.get(f"COMPASS_OFS{n}_{a}", 0.0) for i, a in enumerate(AXES)]
    scale = p.get(f"COMPASS_SCALE{n}", 0.0)
    if 1 / 1.5 <= scale <= 1.5:
        field = [v * scale for v in field]
    d = [p.get(f"COMPASS_DIA{n}_{a}", 1.0) for a in AXES]
    o = [p.get(f"COMPASS_ODI{n}_{a}", 0.0) for a in AXES]
    if any(d):
        x, y, z = field
        field = [d[0] * x + o[0] * y + o[1] * z, o[0] * x + d[1] * y + o[2] * z, o[1] * x + o[2] * y + d[2] * z]
    by = {1: throttle, 2: ampere}.get(int(p.get("COMPASS_MOTCT", 0)), 0.0)
    return np.array([v + p.get(f"COMPASS_MOT{n}_{a}", 0.0) * by for v, a in zip(field, AXES, strict=True)])


def tell(held, params, system=1):
    return [c for name, value in params.items() for c in held.param(ParamReading(system, 1, name, float(value), 0, 9))]


def plain(n="", ofs=(0.0, 0.0, 0.0), device=97539):
    out = {f"COMPASS_OFS{n}_{a}": v for a, v in zip(AXES, ofs, strict=True)}
    out[f"COMPASS_DEV_ID{n}"] = device
    out[f"COMPASS_SCALE{n}"] = 0.0
    out |= {f"COMPASS_DIA{n}_{a}": 1.0 for a in AXES} | {f"COMPASS_ODI{n}_{a}": 0.0 for a in AXES}
    return out | {f"COMPASS_MOT{n}_{a}": 0.0 for a in AXES} | {"COMPASS_MOTCT": 0.0}


def holding(params, throttle=None, ampere=None):
    held = Calibrations()
    tell(held, params)
    if throttle is not None:
        held.throttle(throttle)
    if ampere is not None:
        held.current(ampere)
    return held


SENSOR = vec3((512.0, -154.0, 640.0), "sensor")


@pytest.mark.parametrize("n", ["", "2", "3"])
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"OFS_X": 103.5, "OFS_Y": -20.0, "OFS_Z": 7.25},
        {"SCALE": 1.2},
        {"SCALE": 1.5},
        {"SCALE": 1 / 1.5},
        {"SCALE": 1.51},
        {"SCALE": 0.66},
        {"SCALE": -1.0},
        {"DIA_X": 1.1, "DIA_Y": 0.9, "DIA_Z": 1.02, "ODI_X": 0.05, "ODI_Y": -0.03, "ODI_Z": 0.02},
        {"DIA_X": 0.0, "DIA_Y": 0.0, "DIA_Z": 0.0, "ODI_X": 0.3},
        {"MOT_X": 30.0, "MOT_Y": -4.0, "MOT_Z": 11.0, "CT": 1},
        {"MOT_X": 3.0, "MOT_Y": -0.4, "MOT_Z": 1.1, "CT": 2},
        {"MOT_X": 30.0, "CT": 0},
        {"OFS_X": -200.0, "SCALE": 1.1, "DIA_Y": 0.95, "ODI_Z": 0.04, "MOT_Z": 20.0, "CT": 1},
    ],
    ids=lambda c: "-".join(c) or "none",
)
def test_undo_returns_the_sensors_field(n, changes):
    params = plain(n)
    for key, value in changes.items():
        name = "COMPASS_MOTCT" if key == "CT" else "COMPASS_" + key.replace("_", n + "_", 1)
        params["COMPASS_SCALE" + n if key == "SCALE" else name] = value
    sent = forward(params, SENSOR, n, throttle=0.6, ampere=14.0)
    held = holding(params, 0.6, 14.0)
    assert held.undo(int(n or 1), vec3(sent, "sent")) == pytest.approx(SENSOR, abs=1e-9)
    shaping = held.shaping(int(n or 1))
    offsets = held.offsets(int(n or 1))
    assert shaping.matrix @ (SENSOR + offsets) + shaping.motor_b_mg == pytest.approx(sent, abs=1e-9)


MG = st.floats(-900, 900)
TERM = st.floats(-60, 60)


@given(
    st.tuples(MG, MG, MG),
    st.tuples(MG, MG, MG),
    st.floats(0.5, 1.7),
    st.tuples(*[st.floats(0.8, 1.2)] * 3, *[st.floats(-0.15, 0.15)] * 3),
    st.tuples(TERM, TERM, TERM),
    st.sampled_from((0, 1, 2)),
    st.floats(0, 1),
    st.floats(0, 80),
)
def test_undo_of_anything_a_calibration_holds(sensor, ofs, scale, matrix, motor, mode, throttle, ampere):
    p = plain("2", ofs) | {"COMPASS_SCALE2": scale, "COMPASS_MOTCT": mode}
    p |= {
        f"COMPASS_{g}2_{a}": v for (g, a), v in zip([(g, a) for g in ("DIA", "ODI") for a in AXES], matrix, strict=True)
    }
    p |= {f"COMPASS_MOT2_{a}": v for a, v in zip(AXES, motor, strict=True)}
    sent = forward(p, sensor, "2", throttle, ampere)
    assert holding(p, throttle, ampere).undo(2, vec3(sent, "sent")) == pytest.approx(sensor, abs=1e-8)


def test_offsets_unknown_are_undone_as_zero():
    assert holding({}).undo(1, SENSOR) == pytest.approx(SENSOR)
    assert holding({"COMPASS_OFS_X": 50.0}).undo(1, SENSOR) == pytest.approx(SENSOR)


def test_a_singular_matrix_is_named():
    held = holding(plain() | {"COMPASS_DIA_X": 0.0})
    with pytest.raises(ValueError, match=r"compass 1.*singular"):
        held.undo(1, SENSOR)
    assert not held.undoable(1)
    assert held.undoable(2)
    assert not holding(plain() | {"COMPASS_DIA_X": 1e-12}).undoable(1)
    assert not holding(plain() | {"COMPASS_ODI_X": 1.0}).undoable(1)
    assert holding(SHAPED).undoable(1)
    assert holding(plain(ofs=(1800, -1800, 0))).undoable(1)
    for mad in ({"COMPASS_OFS_Y": -1e30}, {f"COMPASS_DIA_{a}": 1e30 for a in AXES}, {"COMPASS_DIA_Z": 30.0}):
        assert not holding(plain() | mad).undoable(1)
    assert not holding(plain() | {"COMPASS_MOT_X": 1e30, "COMPASS_MOTCT": 1.0}, throttle=0.5).undoable(1)


def test_compasses_are_numbered_one_to_three():
    with pytest.raises(ValueError, match="compass: want 1, 2 or 3, got 4"):
        Calibrations().offsets(4)


# ------------------------------------------------------------ epochs: what mixes with what


def test_the_epoch_grows_only_when_the_correction_of_that_compass_changes():
    held = holding(plain() | plain("2"))
    one, two = held.epoch(1), held.epoch(2)
    assert tell(held, plain()) == []  # told again
    assert tell(held, {"COMPASS_LEARN": 3, "COMPASS_USE": 0, "BATT_CAPACITY": 5}) == []
    assert tell(held, {"COMPASS_MOT_X": 12.0}) == []  # no motor compensation is on
    assert tell(held, {"COMPASS_SCALE": 1.6}) == []  # out of range like 0: no scale either way
    assert (held.epoch(1), held.epoch(2)) == (one, two)
    assert tell(held, {"COMPASS_OFS_X": 40.0}) == [1]  # told, but undone exactly: the sensor's own field goes on
    assert (held.epoch(1), held.epoch(2)) == (one, two)
    assert tell(held, {"COMPASS_DIA_X": 1.1}) == [1]
    assert (held.epoch(1), held.epoch(2)) == (one + 1, two)
    assert tell(held, {"COMPASS_DIA_X": 1.0}) == [1]
    assert held.epoch(1) == one + 2
    assert tell(held, {"COMPASS_MOTCT": 1.0}) == [1, 2, 3]
    assert tell(held, {"COMPASS_MOT_X": 13.0}) == [1]
    assert held.epoch(1) == one + 4


def test_offsets_that_were_not_known_before_begin_a_new_stretch():
    known = plain(ofs=(5, 6, 7))
    for unheard in ("COMPASS_OFS_X", "COMPASS_OFS_Y", "COMPASS_OFS_Z"):
        held = holding({n: v for n, v in known.items() if n != unheard})
        before = held.epoch(1)
        assert tell(held, {unheard: known[unheard]}) == [1]
        assert held.epoch(1) == before + 1
        assert not held.changed(1)


def test_another_device_begins_a_new_stretch_and_the_first_one_does_not():
    held = holding(plain())
    before = held.epoch(1)
    assert tell(held, {"COMPASS_DEV_ID": 97539}) == []
    assert tell(held, {"COMPASS_DEV_ID": 466441}) == [1]
    assert (held.epoch(1), held.changed(1)) == (before + 1, True)
    held = holding({n: v for n, v in plain().items() if "DEV" not in n})
    before = held.epoch(1)
    assert tell(held, {"COMPASS_DEV_ID": 97539}) == []
    assert (held.epoch(1), held.changed(1)) == (before, False)


def test_changed_is_said_when_something_known_was_changed_and_not_when_it_is_first_heard():
    held = holding(plain(ofs=(5, 6, 7)))
    assert not held.changed(1)
    tell(held, {"COMPASS_OFS_Y": 90.0})
    assert held.changed(1)
    assert not held.changed(2)


def test_our_own_change_is_undone_at_once_and_not_told_of():
    held = holding(plain(ofs=(10, 20, 30)))
    before, names = held.epoch(1), [f"COMPASS_OFS_{a}" for a in AXES]
    held.expect(names, (100.0, -50.0, 5.0))
    for name, value in zip(names, (100.0, -50.0, 5.0), strict=True):
        tell(held, {name: value})
    assert held.epoch(1) == before
    assert not held.changed(1)
    assert held.undo(1, SENSOR) == pytest.approx(SENSOR - [100, -50, 5])
    tell(held, {"COMPASS_OFS_X": 101.0})  # somebody else's
    assert held.epoch(1) == before
    assert held.changed(1)


# ------------------------------------------------------------ absolute, relative, assumed


def test_absolute_wants_all_offsets_and_the_device():
    needed = [*(f"COMPASS_OFS3_{a}" for a in AXES), "COMPASS_DEV_ID3"]
    for missing in needed:
        assert not holding({n: 1.0 for n in needed if n != missing}).known(3)
    assert holding(dict.fromkeys(needed, 1.0)).known(3)


def test_assumed_until_scale_matrix_and_the_motor_switch_are_heard():
    full = plain()
    assert not holding(full).assumed(1)
    for name in ("COMPASS_SCALE", "COMPASS_DIA_Y", "COMPASS_ODI_Z", "COMPASS_MOTCT"):
        assert holding({n: v for n, v in full.items() if n != name}).assumed(1), name
    no_motor = {n: v for n, v in full.items() if "MOT_" not in n}
    assert not holding(no_motor).assumed(1)  # switched off, so the terms do not matter
    assert holding(no_motor | {"COMPASS_MOTCT": 1.0}, throttle=0.5).assumed(1)
    assert holding(full | {"COMPASS_MOTCT": 1.0}).assumed(1)  # throttle never heard
    assert not holding(full | {"COMPASS_MOTCT": 1.0}, throttle=0.5).assumed(1)
    assert holding(full | {"COMPASS_MOTCT": 2.0}, throttle=0.5).assumed(1)
    assert not holding(full | {"COMPASS_MOTCT": 2.0}, ampere=9.0).assumed(1)


def test_what_is_asked_of_the_vehicle_is_what_knowing_needs():
    held = Calibrations()
    tell(held, dict.fromkeys(wanted_names((1, 3)), 0.0))
    assert held.known(1)
    assert held.known(3)
    assert not held.assumed(1)
    assert not held.assumed(3)
    assert not held.known(2)
    assert all(len(n) <= 16 for n in wanted_names((1, 2, 3)))
    assert len(set(wanted_names((1, 2, 3)))) == len(wanted_names((1, 2, 3)))


# ------------------------------------------------------------ planning a change

IRON = vec3((-88.125, 41.7, 12.3), "iron")
SIGMA = vec3((3.0, 4.0, 5.0), "sigma")
SHAPED = plain(ofs=(10, -5, 2)) | {
    "COMPASS_SCALE": 1.1,
    "COMPASS_DIA_X": 1.05,
    "COMPASS_DIA_Y": 0.96,
    "COMPASS_ODI_X": 0.03,
    "COMPASS_MOT_Z": 25.0,
    "COMPASS_MOTCT": 1.0,
}


@pytest.mark.parametrize("write", [(True, True, True), (True, True, False), (False, False, True)])
def test_the_sent_field_moves_exactly_as_planned(write):
    held = holding(SHAPED, throttle=0.4)
    change = plan_change(held, 1, 1, IRON, SIGMA, write)
    assert change is not None
    new = SHAPED | dict(zip(change.names, change.new, strict=True))
    moved = forward(new, SENSOR, throttle=0.4) - forward(SHAPED, SENSOR, throttle=0.4)
    assert moved == pytest.approx(change.shift_b_mg, abs=1e-9)
    assert change.names == tuple(f"COMPASS_OFS_{a}" for a, w in zip(AXES, write, strict=True) if w)
    assert change.old == tuple(SHAPED[n] for n in change.names)
    assert change.step_mg == pytest.approx([abs(b - a) for a, b in zip(change.old, change.new, strict=True)])


def test_the_written_offset_is_minus_the_hard_iron_in_32_bits():
    change = plan_change(holding(SHAPED, throttle=0.4), 1, 1, IRON, SIGMA, (True, True, True))
    assert change is not None
    assert change.new == tuple(float(np.float32(-v)) for v in IRON)
    assert (change.device_name, change.device_id) == ("COMPASS_DEV_ID", 97539)
    corrected = forward(SHAPED | dict(zip(change.names, change.new, strict=True)), IRON + np.array([200, 0, 430]))
    by_hand = forward(plain() | {k: v for k, v in SHAPED.items() if "OFS" not in k}, [200, 0, 430])
    assert corrected == pytest.approx(by_hand, abs=1e-4)


def test_the_sigma_of_the_shift_covers_only_what_is_written():
    change = plan_change(holding(plain("2", (1, 2, 3))), 1, 2, IRON, SIGMA, (True, False, False))
    assert change is not None
    assert change.shift_sigma_mg == pytest.approx((3.0, 0.0, 0.0))
    assert change.names == ("COMPASS_OFS2_X",)


def test_no_plan_without_known_offsets_or_axes():
    assert plan_change(holding({}), 1, 1, IRON, SIGMA, (True, True, True)) is None
    assert plan_change(holding(plain()), 1, 1, IRON, SIGMA, (False, False, False)) is None
    no_device = {n: v for n, v in plain().items() if "DEV" not in n}
    assert plan_change(holding(no_device), 1, 1, IRON, SIGMA, (True, True, True)) is None


@given(st.tuples(MG, MG, MG), st.tuples(MG, MG, MG), st.floats(0.67, 1.5))
def test_after_the_change_the_iron_is_gone(iron, ofs, scale):
    p = plain(ofs=ofs) | {"COMPASS_SCALE": scale}
    assume(all(math.isfinite(v) for v in iron))
    change = plan_change(holding(p), 1, 1, vec3(iron, "iron"), SIGMA, (True, True, True))
    assert change is not None
    new = p | dict(zip(change.names, change.new, strict=True))
    assert forward(new, np.array(iron)) == pytest.approx([0, 0, 0], abs=1e-3)
