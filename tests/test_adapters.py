"""What each autopilot's adapter promises a writer: names, encodings, and nothing but offsets."""

import struct
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.core.types import Change
from magmav.mavlink.autopilot.adapter import ADAPTERS, adapter_of
from magmav.mavlink.codec import Codec
from magmav.mavlink.float32 import float32
from magmav.mavlink.values import payload_bytes

ARDUPILOT, PX4 = ADAPTERS[3], ADAPTERS[12]
INT32, REAL32 = dialect.MAV_PARAM_TYPE_INT32, dialect.MAV_PARAM_TYPE_REAL32
WIDTH = {1: "<B", 2: "<b", 3: "<H", 4: "<h", 5: "<I", 6: "<i"}


def from_the_wire(data, kind, name=b"CAL_MAG0_ROT", number=22, version=2):
    """PARAM_VALUE with exactly these four bytes, cut as a sender cuts it; nothing of Python's floats is on the way."""
    codec = Codec()
    message = dialect.MAVLink_param_value_message(name, 1.0, kind, 9, 4)
    mav = dialect.MAVLink(None, 1, 1)
    frame = bytearray(message.pack(mav, force_mavlink1=version == 1))
    at = 10 if version == 2 else 6
    frame[at : at + 4] = data
    crc = dialect.x25crc(bytes(frame[1:-2]) + bytes((dialect.MAVLink_param_value_message.crc_extra,)))
    frame[-2:] = struct.pack("<H", crc.crc)
    (got,) = codec.decode(bytes(frame), "a", whole=True)
    return got


@pytest.mark.parametrize("version", [1, 2])
@given(st.integers(-(2**31), 2**31 - 1))
def test_AT_8b_px4_sends_an_int32_byte_wise_whatever_float_it_looks_like(version, number):
    message = from_the_wire(struct.pack("<i", number), INT32, version=version)
    assert PX4.value_of(message) == number
    assert payload_bytes(message) == struct.pack("<i", number)


@given(st.integers(-(2**24), 2**24))
def test_AT_8b_ardupilot_casts_an_int32(number):
    assert ARDUPILOT.value_of(from_the_wire(struct.pack("<f", number), INT32)) == number


@pytest.mark.parametrize("number", [-1, -4194305, -8388607, 2139095041, 2**31 - 1, -(2**31), 0, 1065353216])
def test_AT_8b_integers_that_look_like_something_else(number):
    """A NaN, four signalling ones, an infinity's neighbour, zero that MAVLink 2 need not cut, and 1.0."""
    assert PX4.value_of(from_the_wire(struct.pack("<i", number), INT32)) == number


@pytest.mark.parametrize("kind", WIDTH)
@pytest.mark.parametrize("adapter", [ARDUPILOT, PX4], ids=["ardupilot", "px4"])
def test_AT_8b_every_integer_type_comes_back_as_it_was_sent(adapter, kind):
    size = struct.calcsize(WIDTH[kind])
    most = 2 ** (8 * size - (kind % 2 == 0)) - 1
    for number in (0, 1, 2, 100, min(most, 2**24)):
        message = adapter.set_message(1, 1, "CAL_MAG0_ROT", float(number), kind)
        (got,) = Codec().decode(Codec().encode(message, 255, 190), "a", whole=True)
        assert adapter.value_of(got) == number
        assert adapter.value_of(message) == number  # also before it went anywhere
        expected = struct.pack(WIDTH[kind], number).ljust(4, b"\0") if adapter is PX4 else struct.pack("<f", number)
        assert payload_bytes(got) == expected


@given(st.floats(width=32, allow_nan=False, allow_infinity=False))
def test_AT_8b_a_float_is_a_float_to_both(value):
    for adapter in (ARDUPILOT, PX4):
        (got,) = Codec().decode(
            Codec().encode(adapter.set_message(1, 1, "X", value, REAL32), 255, 190), "a", whole=True
        )
        assert adapter.value_of(got) == value
        assert (got.param_type, got.target_system, got.target_component, got.param_id) == (REAL32, 1, 1, "X")


@pytest.mark.parametrize("bits", [0x7FC00000, 0x7F800000, 0xFF800000, 0xFFFFFFFF])
def test_a_float_that_is_not_finite_is_no_value(bits):
    message = from_the_wire(struct.pack("<I", bits), REAL32)
    assert ARDUPILOT.value_of(message) is None
    assert PX4.value_of(message) is None


def test_what_cannot_be_sent_is_not_sent():
    for adapter in (ARDUPILOT, PX4):
        for value in (float("nan"), float("inf")):
            with pytest.raises(ValueError, match="COMPASS_OFS_X"):
                adapter.set_message(1, 1, "COMPASS_OFS_X", value, REAL32)
    for value in (0.5, 2.0**31, -4194305.0):
        with pytest.raises(ValueError, match="CAL_MAG0_ROT"):
            PX4.set_message(1, 1, "CAL_MAG0_ROT", value, INT32)
    assert PX4.value_of(from_the_wire(b"\0\0\0\0", dialect.MAV_PARAM_TYPE_REAL64)) is None


# ---------------------------------------------------------------- the allow-list


def change(names, device, **other):
    values = {"old": (1.0,) * len(names), "new": (0.1,) * len(names), "step_mg": (0.9,) * len(names)} | other
    compass = values.pop("compass", 1)
    return Change(1, compass, device, 97539, tuple(names), values["old"], values["new"], (0,) * 3, (0,) * 3,
                  values["step_mg"])  # fmt: skip


GOOD = [
    (ARDUPILOT, ["COMPASS_OFS_X", "COMPASS_OFS_Z"], "COMPASS_DEV_ID"),
    (ARDUPILOT, ["COMPASS_OFS2_X", "COMPASS_OFS2_Y", "COMPASS_OFS2_Z"], "COMPASS_DEV_ID2"),
    (ARDUPILOT, ["COMPASS3_OFS_Y"], "COMPASS3_DEV_ID"),
    (PX4, ["CAL_MAG0_XOFF", "CAL_MAG0_YOFF", "CAL_MAG0_ZOFF"], "CAL_MAG0_ID"),
    (PX4, ["CAL_MAG3_ZOFF"], "CAL_MAG3_ID"),
]
BAD = [
    (ARDUPILOT, ["COMPASS_DIA_X"], "COMPASS_DEV_ID"),
    (ARDUPILOT, ["COMPASS_OFS_X"], "COMPASS_DEV_ID2"),
    (ARDUPILOT, ["COMPASS_OFS_X", "COMPASS_OFS2_Y"], "COMPASS_DEV_ID"),
    (ARDUPILOT, ["COMPASS_OFS_X", "COMPASS1_OFS_Y"], "COMPASS_DEV_ID"),
    (ARDUPILOT, ["COMPASS_OFS_X"], "COMPASS_OFS_Y"),
    (ARDUPILOT, ["COMPASS1_OFS_X"], "COMPASS_DEV_ID"),
    (ARDUPILOT, ["COMPASS_LEARN"], "COMPASS_DEV_ID"),
    (ARDUPILOT, ["CAL_MAG0_XOFF"], "CAL_MAG0_ID"),
    (PX4, ["COMPASS_OFS_X"], "COMPASS_DEV_ID"),
    (PX4, ["CAL_MAG0_XSCALE"], "CAL_MAG0_ID"),
    (PX4, ["CAL_MAG0_XODIAG"], "CAL_MAG0_ID"),
    (PX4, ["CAL_MAG0_XCOMP"], "CAL_MAG0_ID"),
    (PX4, ["CAL_MAG0_ROT"], "CAL_MAG0_ID"),
    (PX4, ["CAL_MAG0_XOFF", "CAL_MAG1_YOFF"], "CAL_MAG0_ID"),
    (PX4, ["CAL_MAG0_XOFF"], "CAL_MAG1_ID"),
    (PX4, ["CAL_MAG4_XOFF"], "CAL_MAG4_ID"),
    (PX4, ["SENS_MAG_AUTOCAL"], "CAL_MAG0_ID"),
    (PX4, ["CAL_MAG0_XOFF\n"], "CAL_MAG0_ID"),
]


@pytest.mark.parametrize(("adapter", "names", "device"), GOOD)
def test_S5_offsets_of_one_compass_may_be_written_and_are_exact_floats(adapter, names, device):
    got = adapter.checked(change(names, device))
    assert got.new == (float32(0.1),) * len(names)
    assert set(names) <= set(adapter.triple(got)) and len(set(adapter.triple(got))) == 3
    assert set(adapter.triple(got)) | {device} <= set(adapter.reads(got))


@pytest.mark.parametrize(("adapter", "names", "device"), BAD)
def test_S5_nothing_else_is_ever_written(adapter, names, device):
    with pytest.raises(ValueError, match=r"^change: "):
        adapter.checked(change(names, device))


@pytest.mark.parametrize("adapter", [ARDUPILOT, PX4], ids=["ardupilot", "px4"])
def test_S5_no_parameter_that_is_fetched_may_be_written_but_offsets(adapter):
    names = adapter.names((1, 2, 3))
    offsets = {n for n in names if "OFS" in n or n.endswith("OFF")} - {f"SENS_BOARD_{a}_OFF" for a in "XYZ"}
    assert len(offsets) >= 9
    devices = [n for n in names if "ID" in n]

    def passes(name, device):
        try:
            adapter.checked(change([name], device))
        except ValueError:
            return False
        return True

    assert {n for n in names if any(passes(n, d) for d in devices)} == offsets - {"COMPASS1_OFS_X"}  # a feeler


@pytest.mark.parametrize("adapter", [ARDUPILOT, PX4], ids=["ardupilot", "px4"])
def test_a_change_that_does_not_hang_together_is_refused(adapter):
    names, device = adapter.offset_names(1), adapter.device_name(1)
    adapter.checked(change(names, device))
    for wrong in (
        change([], device),
        change([names[0], names[0]], device),
        change(names, device, old=(1.0, 2.0)),
        change(names, device, compass=4),
    ):
        with pytest.raises(ValueError, match=r"^change: "):
            adapter.checked(wrong)


# ---------------------------------------------------------------- names, limits, others who write


def test_every_name_fits_and_comes_once():
    for adapter in ADAPTERS.values():
        names = adapter.names((1, 2, 3))
        assert len(set(names)) == len(names)
        assert all(1 <= len(n) <= 16 and n.isascii() for n in names)
        for compass in (1, 2, 3):
            assert {*adapter.offset_names(compass), adapter.device_name(compass)} <= set(names)
        for wrong in (0, 4):
            for ask in (adapter.offset_names, adapter.device_name):
                with pytest.raises(ValueError, match=f"got {wrong}"):
                    ask(wrong)


def test_AT_6c_the_other_naming_scheme_is_asked_for_when_the_vehicle_answers_to_it():
    at_first = ARDUPILOT.names((1, 2, 3))
    assert [n for n in at_first if n.startswith("COMPASS1")] == ["COMPASS1_OFS_X"]
    then = ARDUPILOT.names((1, 2, 3), {"COMPASS1_OFS_X", "COMPASS_MOTCT"})
    assert {"COMPASS2_OFS_X", "COMPASS3_DEV_ID", "COMPASS1_SCALE", "COMPASS1_ODI_Z", "COMPASS_PRIO2_ID"} <= set(then)
    assert not any(n.startswith(("COMPASS_OFS", "COMPASS_DIA", "COMPASS_DEV")) for n in then)
    classic = ARDUPILOT.names((1, 2, 3), {"COMPASS_OFS_X"})
    assert set(classic) == set(at_first) - {"COMPASS1_OFS_X"}


def test_S7_somebody_else_writes():
    assert ARDUPILOT.second_writer({"COMPASS_LEARN": 3.0}) and PX4.second_writer({"SENS_MAG_AUTOCAL": 1.0})
    for adapter, name in ((ARDUPILOT, "COMPASS_LEARN"), (PX4, "SENS_MAG_AUTOCAL")):
        assert not adapter.second_writer({name: 0.0})
        assert not adapter.second_writer({})  # but it must be read, so silence refuses too
        assert name in adapter.reads(change(adapter.offset_names(2), adapter.device_name(2)))
        assert adapter.second_writer({name: float("nan")})


@pytest.mark.parametrize("adapter", [ARDUPILOT, PX4], ids=["ardupilot", "px4"])
def test_AT_6b_one_device_id_in_two_slots_is_ambiguous(adapter):
    wish = change(adapter.offset_names(2), adapter.device_name(2))
    own, other = adapter.device_name(2), adapter.device_name(1)
    assert not adapter.ambiguous(wish, {})
    assert not adapter.ambiguous(wish, {own: 97539.0, other: 97540.0})
    assert adapter.ambiguous(wish, {own: 97539.0, other: 97539.0})
    assert adapter.ambiguous(replace(wish, device_id=0), {other: 0.0})


def test_units_limits_and_streams():
    assert (ARDUPILOT.unit_mg, PX4.unit_mg) == (1.0, 1000.0)
    assert (ARDUPILOT.least_step_mg, PX4.least_step_mg) == (0.0, 10.0)
    assert ARDUPILOT.most_mg({"COMPASS_OFFS_MAX": 1800.0}) == 1800.0
    assert ARDUPILOT.most_mg({}) is None
    assert ARDUPILOT.proof_streams(1) == ("RAW_IMU", "SCALED_IMU")
    assert (ARDUPILOT.proof_streams(2), ARDUPILOT.proof_streams(3)) == (("SCALED_IMU2",), ("SCALED_IMU3",))
    assert PX4.proof_streams(1) == ()
    with pytest.raises(ValueError, match="got 4"):
        ARDUPILOT.proof_streams(4)
    assert [adapter_of(k) for k in (3, 12, 0, 8)] == [ARDUPILOT, PX4, None, None]
