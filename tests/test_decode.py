"""Messages to readings: every unit by hand, and everything that must give no reading."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.core.types import (
    AttitudeReading,
    CurrentReading,
    InertialReading,
    Landed,
    LandedReading,
    MagReading,
    MotionReading,
    ParamReading,
    PositionReading,
    ThrottleReading,
    TimeReading,
    VehicleReading,
)
from magmav.mavlink.codec import Codec
from magmav.mavlink.decode import Decoder

NAN = math.nan


def over_the_wire(message, system=7, component=1):
    """The message as a receiver gets it: through real bytes."""
    (got,) = Codec().decode(Codec().encode(message, system, component), "a", whole=True)
    return got


def read(message, decoder=None, component=1):
    return (decoder or Decoder()).readings(over_the_wire(message, component=component))


def heartbeat(autopilot=3, mode=0, kind=2, status=4):
    return dialect.MAVLink_heartbeat_message(kind, autopilot, mode, 0, status, 3)


def attitude(roll=0.1, pitch=-0.2, yaw=3.0, rate=0.01):
    return dialect.MAVLink_attitude_message(12345, roll, pitch, yaw, rate, -0.02, 0.03)


def raw_imu(acc=(10, -20, -1000), gyro=(100, -200, 1500), mag=(205, -14, 430), usec=12_345_678):
    return dialect.MAVLink_raw_imu_message(usec, *acc, *gyro, *mag)


def test_raw_imu_in_our_units():
    inertial, mag = read(raw_imu())
    assert isinstance(inertial, InertialReading)
    assert inertial.force_b_mss == pytest.approx([0.0980665, -0.196133, -9.80665], abs=1e-12)
    assert inertial.rate_b_rads == pytest.approx([0.1, -0.2, 1.5], abs=1e-15)
    assert isinstance(mag, MagReading)
    assert list(mag.field_b_mg) == [205.0, -14.0, 430.0]
    assert (mag.system, mag.compass, mag.source) == (7, 1, "RAW_IMU")
    assert mag.boot_ns == inertial.boot_ns == 12_345_678_000


@pytest.mark.parametrize(("name", "compass"), [("scaled_imu", 1), ("scaled_imu2", 2), ("scaled_imu3", 3)])
def test_scaled_imu_names_its_compass(name, compass):
    make = getattr(dialect, f"MAVLink_{name}_message")
    inertial, mag = read(make(4_000_000_000, 0, 0, -1000, 0, 0, 500, -300, 20, 1))
    assert (mag.compass, mag.source, mag.boot_ns) == (compass, name.upper(), 4_000_000_000_000_000)
    assert list(mag.field_b_mg) == [-300.0, 20.0, 1.0]
    assert inertial.rate_b_rads == pytest.approx([0, 0, 0.5])


def test_an_all_zero_compass_is_no_compass():
    decoder = Decoder()
    readings = read(raw_imu(mag=(0, 0, 0)), decoder)
    assert [type(r) for r in readings] == [InertialReading]
    assert decoder.counts["RAW_IMU: no compass (all zero)"] == 1
    assert [type(r) for r in read(raw_imu(acc=(0, 0, 0)))] == [MagReading]
    assert read(raw_imu(acc=(0, 0, 0), mag=(0, 0, 0))) == []


def test_unix_time_in_raw_imu_is_not_a_boot_time():
    decoder = Decoder()
    assert read(raw_imu(usec=1_700_000_000_000_000), decoder) == []
    assert decoder.counts["RAW_IMU: time is not since boot"] == 1
    assert len(read(raw_imu(usec=2**32 * 1000))) == 2  # 50 days after boot


def highres(mag, fields=0b111111111, usec=2_000_000, number=0):
    return dialect.MAVLink_highres_imu_message(
        usec, 0.1, 0.2, -9.8, 0.01, 0.02, 0.03, *mag, 1013.0, 0.0, 100.0, 20.0, fields, number
    )


def test_highres_imu_is_gauss():
    inertial, mag = read(highres((0.205, -0.014, 0.43)))
    assert mag.field_b_mg == pytest.approx([205.0, -14.0, 430.0], abs=1e-4)
    assert inertial.force_b_mss == pytest.approx([0.1, 0.2, -9.8], abs=1e-6)
    assert inertial.rate_b_rads == pytest.approx([0.01, 0.02, 0.03], abs=1e-8)
    assert (mag.boot_ns, mag.compass) == (2_000_000_000, 1)
    assert read(highres((0.2, 0, 0.4), number=2))[1].compass == 3


def test_highres_imu_a_million_times_too_large():
    assert read(highres((205000.0, -14000.0, 430000.0)))[1].field_b_mg == pytest.approx([205.0, -14.0, 430.0])


def test_highres_imu_says_which_fields_are_new():
    good = (0.2, 0.0, 0.4)
    assert [type(r) for r in read(highres(good, 0b000111111))] == [InertialReading]
    assert [type(r) for r in read(highres(good, 0b111000000))] == [MagReading]
    assert [type(r) for r in read(highres(good, 0b011000000))] == []
    assert [type(r) for r in read(highres(good, 0b111011111))] == [MagReading]
    assert [type(r) for r in read(highres((0.0, 0.0, 0.0)))] == [InertialReading]


def test_highres_imu_that_cannot_be_used():
    decoder = Decoder()
    assert read(highres((0.2, 0, 0.4), usec=1_700_000_000_000_000), decoder) == []
    assert read(highres((0.2, 0, 0.4), number=3), decoder) == []
    assert sum(decoder.counts.values()) == 2
    assert [type(r) for r in read(highres((NAN, 0, 0.4)), decoder)] in ([], [InertialReading])
    assert decoder.counts["HIGHRES_IMU: not a number"] == 1


def test_attitude_is_already_in_radians():
    (r,) = read(attitude())
    assert isinstance(r, AttitudeReading)
    assert (r.roll_rad, r.pitch_rad, r.yaw_rad) == pytest.approx((0.1, -0.2, 3.0), abs=1e-7)
    assert r.rate_b_rads == pytest.approx([0.01, -0.02, 0.03], abs=1e-9)
    assert r.boot_ns == 12_345_000_000


@pytest.mark.parametrize("field", ["roll", "pitch", "yaw", "rate"])
@pytest.mark.parametrize("bad", [NAN, math.inf, -math.inf])
def test_attitude_that_is_not_a_number_is_counted(field, bad):
    decoder = Decoder()
    assert read(attitude(**{field: bad}), decoder) == []
    assert decoder.counts["ATTITUDE: not a number"] == 1


@pytest.mark.parametrize(
    ("field", "bad"), [("roll", 7.0), ("pitch", -1e30), ("yaw", 6.4), ("rate", 101.0), ("rate", -1e38)]
)
def test_attitude_beyond_belief_is_counted(field, bad):
    decoder = Decoder()
    assert read(attitude(**{field: bad}), decoder) == []
    assert decoder.counts["ATTITUDE: beyond belief"] == 1
    assert len(read(attitude(yaw=6.28, rate=60.0), decoder)) == 1  # some send 0 to 360 degrees


def test_highres_imu_beyond_belief_is_counted():
    decoder = Decoder()
    assert not any(isinstance(r, MagReading) for r in read(highres((1e30, 0, 0)), decoder))
    assert decoder.counts["HIGHRES_IMU: beyond belief"] == 1


def test_attitude_quaternion_turns_body_to_earth():
    half = math.radians(30.0) / 2
    message = dialect.MAVLink_attitude_quaternion_message(500, math.cos(half), 0, 0, math.sin(half), 0, 0, 0.2)
    (r,) = read(message)
    assert (r.roll_rad, r.pitch_rad, r.yaw_rad) == pytest.approx((0.0, 0.0, math.radians(30.0)), abs=1e-6)
    decoder = Decoder()
    for bad in ((0, 0, 0, 0), (NAN, 0, 0, 1)):
        assert read(dialect.MAVLink_attitude_quaternion_message(500, *bad, 0, 0, 0), decoder) == []
    assert sum(decoder.counts.values()) == 2


def test_global_position_in_degrees_and_metres():
    message = dialect.MAVLink_global_position_int_message(
        9000, 473977421, -85455934, 488_123, 12_500, 310, -420, 5, 9000
    )
    place, motion = read(message)
    assert isinstance(place, PositionReading)
    assert (place.lat_deg, place.lon_deg, place.alt_m) == pytest.approx((47.3977421, -8.5455934, 488.123))
    assert isinstance(motion, MotionReading)
    assert (motion.north_mps, motion.east_mps, motion.height_m) == pytest.approx((3.1, -4.2, 12.5))
    assert place.boot_ns == motion.boot_ns == 9_000_000_000


@pytest.mark.parametrize(("lat", "lon"), [(0, 0), (910000000, 0), (0, 1810000000), (2147483647, 2147483647)])
def test_no_place_where_there_is_none(lat, lon):
    decoder = Decoder()
    message = dialect.MAVLink_global_position_int_message(9000, lat, lon, 0, 0, 0, 0, 0, 0)
    assert [type(r) for r in read(message, decoder)] == [MotionReading]
    assert decoder.counts["GLOBAL_POSITION_INT: no position"] == 1


@pytest.mark.parametrize(("fix", "n"), [(0, 0), (1, 0), (2, 0), (3, 1), (4, 1), (6, 1)])
def test_gps_counts_from_a_three_dimensional_fix(fix, n):
    message = dialect.MAVLink_gps_raw_int_message(9_000_000, fix, 473977421, 85455934, 488_000, 100, 100, 0, 0, 9)
    places = read(message)
    assert len(places) == n
    assert [p.boot_ns for p in places] == [9_000_000_000] * n  # microseconds on this message


def test_battery_current():
    def battery(ampere_100, number=0):
        return dialect.MAVLink_battery_status_message(number, 0, 0, 2000, [4000] * 10, ampere_100, 0, 0, 80)

    def status(ampere_100):
        return dialect.MAVLink_sys_status_message(0, 0, 0, 500, 16000, ampere_100, 80, 0, 0, 0, 0, 0, 0)

    for message in (battery(1234), status(1234)):
        (r,) = read(message)
        assert isinstance(r, CurrentReading)
        assert r.ampere == pytest.approx(12.34)
    assert read(battery(-1)) == read(status(-1)) == []
    assert read(battery(1234, number=1)) == []
    assert read(battery(0))[0].ampere == 0.0


def test_throttle_time_and_landed_state():
    (r,) = read(dialect.MAVLink_vfr_hud_message(10.0, 9.0, 90, 37, 100.0, 0.5))
    assert isinstance(r, ThrottleReading)
    assert r.share == pytest.approx(0.37)
    assert read(dialect.MAVLink_vfr_hud_message(10.0, 9.0, 90, 65535, 100.0, 0.5)) == []
    (r,) = read(dialect.MAVLink_system_time_message(1_700_000_000_123_456, 5000))
    assert isinstance(r, TimeReading)
    assert (r.unix_ns, r.boot_ns) == (1_700_000_000_123_456_000, 5_000_000_000)
    for unset in (0, 315_964_800_000_000, 2**63):
        assert read(dialect.MAVLink_system_time_message(unset, 5000)) == []
    (r,) = read(dialect.MAVLink_extended_sys_state_message(0, 2))
    assert isinstance(r, LandedReading)
    assert r.state is Landed.IN_AIR
    for unknown in (0, 5, 255):
        assert read(dialect.MAVLink_extended_sys_state_message(0, unknown)) == []


def test_heartbeat():
    (r,) = read(heartbeat(mode=128 | 1, kind=1))
    assert isinstance(r, VehicleReading)
    assert (r.system, r.component, r.autopilot, r.kind, r.armed, r.status) == (7, 1, 3, 1, True, 4)
    assert read(heartbeat(mode=127))[0].armed is False
    assert read(heartbeat(autopilot=8)) == []


def test_a_gimbals_attitude_is_not_the_vehicles():
    decoder = Decoder()
    read(heartbeat(), decoder)
    assert read(attitude(), decoder, component=154) == []
    assert read(raw_imu(), decoder, component=154) == []
    assert decoder.counts["not from the autopilot"] == 2
    assert len(read(attitude(), decoder)) == 1


def test_a_companions_heartbeat_does_not_make_it_the_autopilot():
    decoder = Decoder()
    assert read(heartbeat(autopilot=8), decoder, component=191) == []
    read(heartbeat(), decoder, component=1)
    assert len(read(attitude(), decoder, component=1)) == 1
    assert read(heartbeat(), decoder, component=2) == []
    assert decoder.counts["second autopilot component"] == 1


def test_param_values():
    def param(name, value, index=5):
        return dialect.MAVLink_param_value_message(name, value, 9, 900, index)

    (r,) = read(param(b"COMPASS_OFS_X", -12.3))
    assert isinstance(r, ParamReading)
    assert (r.name, r.index, r.count, r.component) == ("COMPASS_OFS_X", 5, 900, 1)
    assert r.value == pytest.approx(-12.3, abs=1e-6)
    assert read(param(b"COMPASS_OFS_X", 1.0, 65535))[0].index == 65535
    assert read(param(b"_HASH_CHECK", 1.0)) == []
    for bad in (NAN, math.inf):
        assert read(param(b"COMPASS_OFS_X", bad)) == []
    (r,) = read(param(b"COMPASS_MOTCT_XYZ", 1.0))
    assert r.name == "COMPASS_MOTCT_XY"  # sixteen characters, no terminator


def test_what_is_not_wanted_gives_nothing():
    decoder = Decoder()
    assert read(dialect.MAVLink_statustext_message(4, b"hello"), decoder) == []
    assert sum(decoder.counts.values()) == 0
    assert "RAW_IMU" in decoder.wanted
    assert "STATUSTEXT" not in decoder.wanted


FLOAT = st.floats(width=32)


@given(st.lists(FLOAT, min_size=6, max_size=6), st.integers(0, 2**32 - 1))
def test_no_float_on_the_wire_makes_a_reading_that_is_not_finite(v, ms):
    decoder = Decoder()
    messages = [
        dialect.MAVLink_attitude_message(ms, *v),
        dialect.MAVLink_attitude_quaternion_message(ms, *v, v[0]),
        dialect.MAVLink_highres_imu_message(ms, *v, *v[:3], *v[:4], 511, 0),
        dialect.MAVLink_param_value_message(b"COMPASS_OFS_X", v[0], 9, 9, 0),
    ]
    for message in messages:
        for r in read(message, decoder):
            for name in type(r).__slots__:
                value = getattr(r, name)
                if not isinstance(value, str):
                    assert all(math.isfinite(x) for x in (value if hasattr(value, "__len__") else [value])), name
