"""Mountings are rotations, named and numbered as MAVLink and the autopilots do."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.core.orientation import ARDUPILOT, CUSTOM, MAVLINK, PX4, body_from_sensor, rotation

TABLES = {"mavlink": MAVLINK, "px4": PX4, "ardupilot": ARDUPILOT}
EVERY = [(t, n) for t, table in TABLES.items() for n in table]
X, Y, Z = np.eye(3)
ENUM = {
    number: entry
    for number, entry in dialect.enums["MAV_SENSOR_ORIENTATION"].items()
    if entry.name.startswith("MAV_SENSOR_ROTATION_") and number != CUSTOM
}


@pytest.mark.parametrize(("table", "number"), EVERY)
def test_each_is_a_rotation(table, number):
    r = rotation(number, TABLES[table])
    assert r @ r.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(r) == pytest.approx(1.0, abs=1e-12)
    assert not r.flags.writeable


def test_numbers_names_and_angles_are_those_of_mavlink():
    """pymavlink writes the angles in words; an axis it leaves out is zero."""
    assert set(MAVLINK) == set(ENUM)
    for number, entry in ENUM.items():
        said = {axis: float(v) for axis, v in re.findall(r"(Roll|Pitch|Yaw): (\d+)", entry.description)}
        got = MAVLINK[number]
        assert (got.roll_deg, got.pitch_deg, got.yaw_deg) == tuple(said.get(a, 0.0) for a in ("Roll", "Pitch", "Yaw"))
        assert f"MAV_SENSOR_ROTATION_{got.name}" == entry.name


def test_the_autopilots_share_the_numbers_of_mavlink_only():
    for number, common in MAVLINK.items():
        assert PX4[number] == common
        assert ARDUPILOT[number].name == common.name
    assert [PX4[n].name for n in (41, 44, 45)] == ["ROLL_270_YAW_180", "PITCH_9_YAW_180", "PITCH_45"]
    assert [ARDUPILOT[n].name for n in (41, 42, 43)] == ["PITCH_7", "ROLL_45", "ROLL_315"]


@pytest.mark.parametrize(
    ("name", "x", "y", "z"),
    [
        ("YAW_90", Y, -X, Z),  # the sensor's nose points right
        ("YAW_180", -X, -Y, Z),
        ("ROLL_180", X, -Y, -Z),  # upside down
        ("PITCH_180", -X, Y, -Z),
        ("ROLL_90", X, Z, -Y),
        ("PITCH_90", -Z, Y, X),  # nose up
        ("ROLL_90_YAW_90", Y, Z, X),
        ("PITCH_180_YAW_90", -Y, -X, -Z),
        ("ROLL_90_PITCH_180_YAW_90", -Y, -Z, X),
        ("YAW_45", (X + Y) / np.sqrt(2), (Y - X) / np.sqrt(2), Z),
    ],
)
def test_where_the_sensors_axes_point(name, x, y, z):
    number = next(n for n, o in MAVLINK.items() if o.name == name)
    assert rotation(number) == pytest.approx(np.column_stack([x, y, z]), abs=1e-12)


def test_right_angles_are_exact():
    """Signs and swaps only: a calibration must not gain 1e-16 of another axis."""
    for number, o in MAVLINK.items():
        if not any(a % 90 for a in o[1:]):
            assert set(abs(rotation(number)).ravel()) <= {0.0, 1.0}, o.name


@pytest.mark.parametrize(
    ("table", "number", "ones"),
    [
        # What ArduPilot's own test of Vector3::rotate expects of (1, 1, 1).
        (ARDUPILOT, 38, (-0.40663092252764576, -1.5839677018260314, -0.5706992311334198)),
        (ARDUPILOT, 41, (1.1144154950464695, 1.0, 0.8706768082761745)),
        (ARDUPILOT, 42, (1.0, 0.0, 2**0.5)),
        (ARDUPILOT, 43, (1.0, 2**0.5, 0.0)),
        (ARDUPILOT, 40, (0.0, -1.0, 2**0.5)),
        # What PX4's rotate_3f computes for it.
        (PX4, 38, (0.146371 + 0.362280 - 0.920505, -0.344827 - 0.853477 - 0.390731, -0.927184 + 0.374607)),
        (PX4, 7, (2**0.5, 0.0, 1.0)),
    ],
)
def test_the_autopilots_own_figures(table, number, ones):
    assert rotation(number, table) @ np.ones(3) == pytest.approx(ones, abs=2e-6)


@pytest.mark.parametrize(
    ("there", "back"),
    [("YAW_90", "YAW_270"), ("ROLL_90", "ROLL_270"), ("PITCH_90", "PITCH_270"), ("YAW_45", "YAW_315")]
    + [(n, n) for n in ("ROLL_180", "PITCH_180", "YAW_180", "ROLL_180_YAW_90", "ROLL_180_YAW_45")]
    + [("ROLL_90_YAW_90", "ROLL_270_PITCH_270")],
)
def test_pairs_that_undo_each_other(there, back):
    named = {o.name: rotation(n) for n, o in MAVLINK.items()}
    assert named[there] @ named[back] == pytest.approx(np.eye(3), abs=1e-12)


ANGLE = st.floats(-360, 360)


@given(ANGLE, ANGLE, ANGLE)
def test_angles_add_where_the_axis_is_the_same(a, b, yaw):
    both = body_from_sensor(0, 0, a) @ body_from_sensor(0, 0, b)
    assert both == pytest.approx(body_from_sensor(0, 0, a + b), abs=1e-12)
    assert body_from_sensor(a, b, yaw) == pytest.approx(
        body_from_sensor(0, 0, yaw) @ body_from_sensor(0, b, 0) @ body_from_sensor(a, 0, 0), abs=1e-12
    )


@pytest.mark.parametrize("number", [-1, 41, CUSTOM, 10**9])
def test_a_number_nobody_knows(number):
    with pytest.raises(ValueError, match=f"orientation {number}"):
        rotation(number)
