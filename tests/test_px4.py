"""PX4's correction undone, against a forward model written from its source and not from ours."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from magmav.core.orientation import ARDUPILOT, PX4
from magmav.core.types import (
    AttitudeReading,
    MagReading,
    ParamReading,
    VehicleReading,
    vec3,
)
from magmav.mavlink.autopilot.ardupilot import Calibrations, plan_change
from magmav.mavlink.autopilot.px4 import Px4Calibrations
from magmav.settings import Settings, knobs, load
from magmav.vehicle import Vehicle

AXES = "XYZ"
DEVICE = 396809  # an external IST8310 on I2C
ON_BOARD = 0x0D0A12  # a compass on SPI
CORRECTED = "vehicle_magnetometer"


def turned(roll, pitch, yaw):
    """Rz Ry Rx from degrees, each written out."""
    (a, b, c), s = np.radians((roll, pitch, yaw)), np.sin
    k = np.cos
    rx = np.array([[1, 0, 0], [0, k(a), -s(a)], [0, s(a), k(a)]])
    ry = np.array([[k(b), 0, s(b)], [0, 1, 0], [-s(b), 0, k(b)]])
    rz = np.array([[k(c), -s(c), 0], [s(c), k(c), 0], [0, 0, 1]])
    return rz @ ry @ rx


def forward(p, raw_mg, n=0, power=0.0, level=True):
    """Magnetometer::Correct: rotation * (scale * ((data + power * compensation) - offset)), gauss, to body axes."""
    xyz = {w: np.array([p.get(f"CAL_MAG{n}_{a}{w}", d) for a in AXES]) for w, d in NEUTRAL.items()}
    (dx, dy, dz), (ox, oy, oz) = xyz["SCALE"], xyz["ODIAG"]
    scale = np.array([[dx, ox, oy], [ox, dy, oz], [oy, oz, dz]])
    tilt = turned(*(p.get(f"SENS_BOARD_{a}_OFF", 0.0) for a in AXES))
    rot = p.get(f"CAL_MAG{n}_ROT", -1)
    if rot < 0:
        r = tilt @ turned(*PX4[p.get("SENS_BOARD_ROT", 0)][1:])
    else:
        own = turned(*(p[f"CAL_MAG{n}_{w}"] for w in ("ROLL", "PITCH", "YAW"))) if rot == 100 else turned(*PX4[rot][1:])
        r = tilt @ own if level else own
    gauss = np.asarray(raw_mg) / 1000.0
    return 1000.0 * (r @ (scale @ ((gauss + power * xyz["COMP"]) - xyz["OFF"]))), r


NEUTRAL = {"OFF": 0.0, "SCALE": 1.0, "ODIAG": 0.0, "COMP": 0.0}


def slot(n=0, device=DEVICE, rot=0, **groups):
    """Every value of one slot; groups like OFF=(x, y, z) replace the neutral ones."""
    out = {f"CAL_MAG{n}_ID": device, f"CAL_MAG{n}_ROT": rot}
    for what, neutral in NEUTRAL.items():
        values = groups.get(what, (neutral,) * 3)
        out |= {f"CAL_MAG{n}_{a}{what}": v for a, v in zip(AXES, values, strict=True)}
    return out


def tell(held, params):
    return [c for name, v in params.items() for c in held.param(ParamReading(1, 1, name, float(v), 65535, 0))]


def holding(params, source=CORRECTED, device=DEVICE, compass=1):
    held = Px4Calibrations()
    tell(held, params)
    held.sensor(compass, device, source)
    return held


RAW = vec3((212.0, -154.0, 440.0), "sensor")

GAUSS = st.tuples(*[st.floats(-1, 1)] * 3)
SLOT = st.builds(
    lambda rot, off, scale, odiag, comp: slot(2, DEVICE, rot, OFF=off, SCALE=scale, ODIAG=odiag, COMP=comp),
    st.sampled_from([-1, *PX4]),
    GAUSS,
    st.tuples(*[st.floats(0.7, 1.4)] * 3),
    st.tuples(*[st.floats(-0.1, 0.1)] * 3),
    GAUSS,
)
LEVEL = st.tuples(*[st.floats(-10, 10)] * 3)


@given(SLOT, LEVEL, st.sampled_from(sorted(PX4)), GAUSS, st.sampled_from((0, 1, 2, 3)), st.floats(0, 1))
def test_both_streams_lead_back_to_one_sensor(values, level, board, raw, by, throttle):
    p = values | {f"SENS_BOARD_{a}_OFF": v for a, v in zip(AXES, level, strict=True)}
    p |= {"SENS_BOARD_ROT": board, "CAL_MAG_COMP_TYP": by}
    power = {0: 0.0, 1: throttle, 2: 0.042, 3: 0.042}[by]
    used, r = forward(p, 1000.0 * np.array(raw), 2, power)
    body = 1000.0 * r @ np.array(raw)
    for source, sent in (("sensor_mag", 1000.0 * np.array(raw)), (CORRECTED, used), ("sensor_combined", used)):
        held = holding(p, source)
        held.armed(True)
        held.throttle(throttle)
        held.current(42.0)
        assert held.undo(1, vec3(sent, "sent"), source) == pytest.approx(body, abs=1e-9)
        assert held.corrected(1, vec3(sent, "sent"), source) == pytest.approx(used, abs=1e-9)
        shaping = held.shaping(1)
        assert shaping.matrix @ (body + held.offsets(1)) + shaping.motor_b_mg == pytest.approx(used, abs=1e-9)
        assert held.undoable(1)


@pytest.mark.parametrize("rot", PX4)
def test_undo_and_corrected_are_inverse_for_every_mounting(rot):
    p = slot(0, DEVICE, rot, OFF=(0.1, -0.2, 0.3), SCALE=(1.1, 0.9, 1.05), ODIAG=(0.05, -0.03, 0.02))
    raw, sent = holding(p, "sensor_mag"), holding(p)
    used = raw.corrected(1, RAW, "sensor_mag")
    assert sent.undo(1, used, CORRECTED) == pytest.approx(raw.undo(1, RAW, "sensor_mag"), abs=1e-9)


def test_the_order_by_hand():
    """Compensate, subtract, scale, turn: any other order gives other numbers here."""
    p = slot(0, DEVICE, 2, OFF=(0.1, 0.0, 0.0), SCALE=(2.0, 1.0, 1.0), COMP=(1.0, 0.0, 0.0))  # 2: nose points right
    p |= {"CAL_MAG_COMP_TYP": 2}
    held = holding(p, "sensor_mag")
    held.armed(True)
    held.current(50.0)  # 0.05 kA: 50 mG more on the sensor's x
    # x: (200 + 50 - 100) * 2 = 300, and the sensor's x is the body's y.
    assert held.corrected(1, vec3((200.0, 30.0, 400.0), "raw"), "sensor_mag") == pytest.approx((-30.0, 300.0, 400.0))
    assert held.undo(1, vec3((200.0, 30.0, 400.0), "raw"), "sensor_mag") == pytest.approx((-30.0, 200.0, 400.0))
    assert held.offsets(1) == pytest.approx((0.0, -100.0, 0.0))  # what ArduPilot would add
    assert held.shaping(1).motor_b_mg == pytest.approx((0.0, 100.0, 0.0))  # scaled, as it goes in before the scale


@pytest.mark.parametrize("n", range(4))
def test_a_sensor_uses_the_slot_that_names_it(n):
    p = {}
    for other in range(4):
        p |= slot(other, DEVICE if other == n else 100 + other, 0, OFF=(0.1 * (other + 1), 0.0, 0.0))
    held = holding(p, compass=3)
    assert held.offsets(3) == pytest.approx((-100.0 * (n + 1), 0.0, 0.0))
    assert held.known(3) and held.device_id(3) == DEVICE
    assert held.stored(3)[f"CAL_MAG{n}_XOFF"] == pytest.approx(0.1 * (n + 1))
    assert not any(name.startswith("CAL_MAG") and name[7].isdigit() and name[7] != str(n) for name in held.stored(3))
    assert held.offsets(1) is None and held.stored(1) == {}


@pytest.mark.parametrize(
    ("source", "device"),
    [
        (CORRECTED, 0),
        (CORRECTED, DEVICE + 1),
        ("SCALED_IMU raw", DEVICE),
        ("HIGHRES_IMU", 0),
        ("vehicle_magnetometer less bias", DEVICE),
    ],
)
def test_what_is_not_known_to_be_corrected_is_left_and_relative(source, device):
    held = holding(slot(0, OFF=(0.1, 0.2, 0.3), SCALE=(2.0, 1.0, 1.0)), source, device)
    assert not held.known(1) and held.assumed(1) and held.offsets(1) is None and held.stored(1) == {}
    assert held.undo(1, RAW, source) == pytest.approx(RAW)
    assert np.array_equal(held.corrected(1, RAW, source), RAW)
    assert held.shaping(1).matrix == pytest.approx(np.eye(3)) and held.undoable(1)
    assert held.epoch(1) == 0


def test_two_offsets_of_three_are_none():
    p = slot(0, OFF=(0.1, 0.2, 0.3))
    del p["CAL_MAG0_YOFF"]
    assert not holding(p).known(1)
    assert not holding(slot(0, device=0), device=0).known(1)  # an empty slot is nobody's


def test_mountings():
    level = {"SENS_BOARD_ROT": 4, "SENS_BOARD_X_OFF": 2.0, "SENS_BOARD_Y_OFF": -1.0, "SENS_BOARD_Z_OFF": 0.5}
    tilt, board = turned(2.0, -1.0, 0.5), turned(0, 0, 180)

    def body(p, device=DEVICE):
        return holding(p, "sensor_mag", device).undo(1, RAW, "sensor_mag")

    new = slot(0, rot=2)
    old = {name: v for name, v in new.items() if "ODIAG" not in name}
    custom = slot(0, rot=100) | {"CAL_MAG0_ROLL": 10.0, "CAL_MAG0_PITCH": -20.0, "CAL_MAG0_YAW": 30.0}
    assert body(slot(0, rot=-1) | level) == pytest.approx(tilt @ board @ RAW)  # internal: the board's
    assert body(new | level) == pytest.approx(tilt @ turned(0, 0, 90) @ RAW)  # external: its own, levelled
    assert body(old | level) == pytest.approx(turned(0, 0, 90) @ RAW)  # but not by old releases
    assert body(custom | level) == pytest.approx(tilt @ turned(10, -20, 30) @ RAW)
    assert body(slot(0, rot=77)) == pytest.approx(RAW)  # PX4 takes it for none
    assert body(level) == pytest.approx(RAW)  # no slot, on I2C: taken for external
    assert body(level, ON_BOARD) == pytest.approx(tilt @ board @ RAW)
    assert PX4[42] != ARDUPILOT[42]
    assert body(slot(0, rot=42)) == pytest.approx(turned(270, 0, 270) @ RAW)


def test_throttle_counts_while_armed_and_current_in_kiloampere():
    p = slot(0, COMP=(0.2, 0.0, 0.0))
    held = holding(p | {"CAL_MAG_COMP_TYP": 1})
    assert not held.assumed(1)  # disarmed: nothing is added
    held.throttle(0.5)
    assert not held.shaping(1).motor_b_mg.any()
    held.armed(True)
    assert held.shaping(1).motor_b_mg == pytest.approx((100.0, 0.0, 0.0))
    held.armed(False)
    assert not held.shaping(1).motor_b_mg.any()
    tell(held, {"CAL_MAG_COMP_TYP": 2})
    assert held.assumed(1)  # nobody said how much flows
    held.current(20.0)
    assert held.shaping(1).motor_b_mg == pytest.approx((4.0, 0.0, 0.0))
    assert not held.assumed(1)


def test_what_a_release_does_not_have_is_not_assumed():
    p = slot(0)
    assert not holding({k: v for k, v in p.items() if "ODIAG" not in k and "COMP" not in k}).assumed(1)
    assert holding({k: v for k, v in p.items() if k != "CAL_MAG0_XODIAG"}).assumed(1)
    assert holding({k: v for k, v in p.items() if "SCALE" not in k}).assumed(1)


def test_offsets_that_move_are_undone_exactly_and_told_of_in_flight_only():
    held = holding(slot(0, OFF=(0.1, 0.0, 0.0)))
    assert held.epoch(1) == 0
    assert tell(held, {"CAL_MAG0_YOFF": 0.1}) == [1]  # after a landing PX4 moves them by itself
    assert (held.epoch(1), held.changed(1)) == (0, False)
    held.armed(True)
    assert tell(held, {"CAL_MAG0_XOFF": 0.2}) == [1]
    assert (held.epoch(1), held.changed(1)) == (0, True)
    assert held.offsets(1) == pytest.approx((-200.0, -100.0, 0.0))
    held.armed(False)
    assert tell(held, {"CAL_MAG0_XSCALE": 1.1}) == [1]
    assert held.epoch(1) == 1
    assert tell(held, {"CAL_MAG1_XOFF": 0.5, "CAL_MAG_SIDES": 63, "EKF2_MAG_DECL": 2.5, "CAL_MAG0_XSCALE": 1.1}) == []
    assert held.epoch(1) == 1
    assert tell(held, {"SENS_BOARD_X_OFF": 3.0}) == [1]  # no offset of a compass: it turns the axes
    assert held.epoch(1) == 2


def test_offsets_heard_for_the_first_time_begin_a_new_stretch():
    p = slot(0, OFF=(0.1, 0.2, 0.3))
    del p["CAL_MAG0_ZOFF"]
    held = holding(p)
    assert tell(held, {"CAL_MAG0_ZOFF": 0.3}) == [1]
    assert (held.epoch(1), held.changed(1)) == (1, False)


def test_our_own_doing_and_another_sensor():
    held = holding(slot(0))
    held.armed(True)
    held.expect(["CAL_MAG0_XOFF"], [0.25])
    tell(held, {"CAL_MAG0_XOFF": 0.25})
    assert (held.epoch(1), held.changed(1)) == (0, False)
    held.sensor(1, DEVICE, CORRECTED)
    assert held.epoch(1) == 0
    held.sensor(1, ON_BOARD, CORRECTED)
    assert held.epoch(1) == 1


def test_the_sensors_own_stream_does_not_care_for_offsets():
    held = holding(slot(0), "sensor_mag")
    held.armed(True)
    assert tell(held, {"CAL_MAG0_XOFF": 0.25}) == []
    assert tell(held, {"CAL_MAG0_ROT": 4}) == [1]
    assert held.epoch(1) == 1


def test_what_cannot_be_undone_is_said():
    held = holding(slot(0, SCALE=(0.0, 1.0, 1.0)))
    assert not held.undoable(1)
    with pytest.raises(ValueError, match="compass 1"):
        held.undo(1, RAW, CORRECTED)
    assert not holding(slot(0, OFF=(50.0, 0.0, 0.0))).undoable(1)


# ---------------------------------------------------------------- in a vehicle

PX4_AUTOPILOT, ARDUPILOT_AUTOPILOT = 12, 3


def nowhere(*_):
    return None


def vehicle(*readings, autopilot=PX4_AUTOPILOT):
    """A vehicle that heard these and its heartbeat, in that order."""
    out = Vehicle(1, Settings(), nowhere)
    for reading in (*readings, VehicleReading(1, 1, autopilot, 10, False, 3)):
        out.step(reading, 0, 0)
    return out


def params(values):
    return [ParamReading(1, 1, name, float(v), 65535, 0) for name, v in values.items()]


def last_record(v, source, device, field=RAW):
    got = None
    for i in range(10):
        at_ns = 10**9 * 20 + i * 10**8
        v.step(AttitudeReading(1, "vehicle_attitude", at_ns, 0.0, 0.0, 0.1 * i, vec3((0, 0, 1.0), "rate")), at_ns, 0)
        moved = vec3(field + np.array((i, 0, 0)), "field")
        got = v.step(MagReading(1, 1, source, at_ns, moved, device), at_ns, 0) or got
    return got, moved


def test_parameters_heard_before_the_heartbeat_are_not_lost():
    p = slot(0, DEVICE, 2, OFF=(0.1, 0.2, 0.3))
    record, sent = last_record(vehicle(*params(p)), "sensor_mag", DEVICE)
    used, r = forward(p, sent)
    assert record.mag_b_mg == pytest.approx(r @ sent)
    assert record.stored_b_mg == pytest.approx(used)
    assert (record.relative, record.device_id) == (False, DEVICE)
    assert record.age_s == 0.0  # stamped with the time of measurement


@pytest.mark.parametrize("source", ["SCALED_IMU", "HIGHRES_IMU"])
def test_px4_over_mavlink_gives_changes_only(source):
    v = vehicle(*params(slot(0, DEVICE, 2, OFF=(0.1, 0.2, 0.3))))
    record, sent = last_record(v, source, 0)
    assert record.mag_b_mg == pytest.approx(sent) and record.stored_b_mg == pytest.approx(sent)
    assert record.relative and record.device_id == 0
    assert plan_change(v.calibrations, 1, 1, RAW, RAW, (True, True, True)) is None


def test_an_ardupilot_vehicle_holds_what_it_always_held():
    values = {"COMPASS_OFS_X": 5.0, "COMPASS_OFS_Y": -7.0, "COMPASS_OFS_Z": 9.0, "COMPASS_DEV_ID": 97539.0}
    v = vehicle(*params(values | slot(0)), autopilot=ARDUPILOT_AUTOPILOT)
    alone = Calibrations()
    for reading in params(values):
        alone.param(reading)
    record, sent = last_record(v, "RAW_IMU", 0)
    assert np.array_equal(record.mag_b_mg, alone.undo(1, sent))
    assert np.array_equal(record.stored_b_mg, sent)
    assert (record.device_id, record.relative) == (97539, False)


def test_the_example_for_px4_loads_and_changes_nothing_unasked():
    got = load(Path(__file__).parent.parent / "config" / "px4.toml")
    for k in knobs():
        assert repr(getattr(getattr(got, k.section), k.key)) == repr(k.default), k.key
