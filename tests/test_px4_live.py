"""PX4 over MAVLink, from bytes: its own field from SCALED_IMU, its parameters byte by byte, and whose they are."""

import struct

import numpy as np
import pytest
from honest_flight import MOTIONS, body_rates, field_in_body
from memory_flight import Bench, Teller
from pymavlink.dialects.v20 import ardupilotmega as dialect
from test_ardupilot import forward as corrected_by_ardupilot
from test_ardupilot import plain
from test_px4 import forward, slot, turned

from magmav.core.orientation import PX4
from magmav.core.types import CalibrationReading, MagReading, ParamReading, Reason, State, vec3
from magmav.mavlink.autopilot.adapter import ADAPTERS
from magmav.mavlink.autopilot.plan import plan_change
from magmav.mavlink.autopilot.px4 import Px4Calibrations
from magmav.mavlink.codec import Codec
from magmav.mavlink.decode import Decoder

HZ, AXES, STRAIGHT = 25, "XYZ", np.eye(3)
IRON = np.array([-88.0, 41.0, 62.0])
DEVICE, OTHER = 396809, 396825
SIGMA, ALL = vec3((3.0, 3.0, 3.0), "sigma"), (True, True, True)
INTEGERS = ("_ID", "_ROT", "_PRIO", "_TYP", "AUTOCAL")
MATRIX = {"SCALE": (1.1, 0.95, 1.05), "ODIAG": (0.02, -0.03, 0.01)}


def as_bytes(frame, at, data):
    """The frame with these bytes in its payload and a checksum that fits: no float of Python's touches them."""
    out = bytearray(frame)
    out[10 + at : 10 + at + len(data)] = data
    extra = dialect.mavlink_map[out[7] | out[8] << 8 | out[9] << 16].crc_extra
    out[-2:] = struct.pack("<H", dialect.x25crc(bytes(out[1:-2]) + bytes((extra,))).crc)
    return bytes(out)


class Px4Teller(Teller):
    """Speaks as one PX4 vehicle."""

    def heartbeat(self, armed=True, kind=2):
        return self(dialect.MAVLink_heartbeat_message(kind, 12, 128 * armed, 0, 4, 3))

    def param(self, name, value):
        whole = name.endswith(INTEGERS)
        data = struct.pack("<i", int(value)) if whole else struct.pack("<f", value)
        message = dialect.MAVLink_param_value_message(name.encode(), 1.0, 6 if whole else 9, 900, 65535)
        return as_bytes(self(message), 0, data)

    def scaled(self, ms, sensor_mg, number=1, force=-1000):
        kind = ("scaled_imu", "scaled_imu2", "scaled_imu3")[number - 1]
        message = getattr(dialect, f"MAVLink_{kind}_message")(ms, 0, 0, force, 0, 0, 0, *(int(v) for v in sensor_mg))
        return self(message)

    def highres(self, ms, body_mg):
        field = (v / 1e3 for v in body_mg)
        return self(dialect.MAVLink_highres_imu_message(
            ms * 1000, 0, 0, -9.8, 0, 0, 0, *field, 1013.0, 0, 100.0, 20.0, 511, 0
        ))  # fmt: skip

    def report(self, n, p):
        """MAG_CAL_REPORT of uORB instance n - 1 as PX4 fills it from the slot whose values are p."""
        off, diag, odiag = ([v for name, v in p.items() if name.endswith(w)] for w in ("OFF", "SCALE", "ODIAG"))
        return self(dialect.MAVLink_mag_cal_report_message(n - 1, 0, 4, 0, 0.0, *off, *diag, *odiag))


def params(*used):
    """All four slots, empty but for these."""
    out = {"SENS_BOARD_ROT": 0, "SENS_MAG_AUTOCAL": 0, "CAL_MAG_COMP_TYP": 0}
    for n in range(4):
        out |= slot(n, 0, -1)
    for one in used:
        out |= one
    return out


def flight(seconds=60.0, mounting=(STRAIGHT,), irons=(IRON,), seed=0, told=None, tail=None, soft=STRAIGHT):
    """Frames of a PX4 flight: what each sensor has is in its own axes. tail(teller, ms, i, body_mg) adds to each."""
    r = np.random.default_rng(seed)
    n = int(seconds * HZ)
    m = MOTIONS["figure eight"](np.arange(n) / HZ, r)
    body = [field_in_body(m) @ np.linalg.inv(soft) + iron + r.normal(0.0, 1.0, (n, 3)) for iron in irons]
    rates, tell, out = body_rates(m, 1 / HZ), Px4Teller(), []
    for i in range(n):
        ms = 10_000 + i * 1000 // HZ
        if i % HZ == 0:
            out.append((ms, tell.heartbeat() + tell.height(ms, 30.0)))
        if i == 0:
            out.append((ms, b"".join(tell.param(k, v) for k, v in (told or {}).items())))
        out.append((ms, tell.attitude(ms, m.roll_rad[i], m.pitch_rad[i], float(m.yaw_rad[i]), rates[i])))
        for number, (field, turn) in enumerate(zip(body, mounting, strict=True), 1):
            out.append((ms, tell.scaled(ms, np.rint(turn.T @ field[i]), number)))
        if tail is not None:
            out.append((ms, tail(tell, ms, i, body[0][i])))
    return out


def rotated(rot):
    return turned(*PX4[rot][1:])


SOFT = np.array([[1.1, 0.02, -0.03], [0.02, 0.95, 0.01], [-0.03, 0.01, 1.05]])
"""What makes the field of the vehicle's soft iron the Earth's again, body axes; both autopilots have it stored."""


def ardupilot_flight(seconds):
    """The same flight as ArduPilot sends it: in body axes, with everything that is stored applied, in its order."""
    scale, motor = 1.2, np.array([20.0, 0.0, -5.0])
    held = plain(ofs=(-31.0, 77.0, 15.0)) | {"COMPASS_SCALE": scale, "COMPASS_MOTCT": 2.0}
    held |= {f"COMPASS_DIA_{a}": SOFT[i, i] / scale for i, a in enumerate(AXES)}
    held |= {f"COMPASS_ODI_{a}": SOFT[at] / scale for a, at in (("X", (0, 1)), ("Y", (0, 2)), ("Z", (1, 2)))}
    held |= {f"COMPASS_MOT_{a}": v for a, v in zip(AXES, motor, strict=True)}
    r, n = np.random.default_rng(0), int(seconds * HZ)
    m = MOTIONS["figure eight"](np.arange(n) / HZ, r)
    body = (field_in_body(m) - 14.0 * motor) @ np.linalg.inv(SOFT) + IRON + r.normal(0.0, 1.0, (n, 3))
    rates, tell, frames = body_rates(m, 1 / HZ), Teller(), []
    for i in range(n):
        ms = 10_000 + i * 1000 // HZ
        if i % HZ == 0:
            battery = dialect.MAVLink_battery_status_message(0, 0, 0, 2000, [4000] * 10, 1400, 0, 0, 80)
            frames.append(tell.heartbeat() + tell.height(ms, 30.0) + tell(battery))
        frames += [tell.params(held)] if i == 0 else []
        frames.append(tell.attitude(ms, m.roll_rad[i], m.pitch_rad[i], float(m.yaw_rad[i]), rates[i]))
        frames.append(tell.imu(ms, np.rint(corrected_by_ardupilot(held, body[i], ampere=14.0))))
    return frames


@pytest.mark.parametrize("rot", [0, 38])
def test_AT_5b_px4s_own_field_gives_the_same_iron_as_ardupilots_corrected_one(rot):
    """One flight, one iron: PX4 sends it raw in the sensor's axes, ArduPilot corrected in the body's."""
    s = rotated(rot).T @ SOFT @ rotated(rot)
    matrix = {"SCALE": tuple(np.diag(s)), "ODIAG": (s[0, 1], s[0, 2], s[1, 2])}
    stored = slot(2, DEVICE, rot, OFF=(0.1, -0.2, 0.05), **matrix)
    px4 = Bench().play(flight(mounting=(rotated(rot),), told=params(stored), soft=SOFT))[-1]
    ardupilot = Bench().play(ardupilot_flight(60.0))[-1]
    for record in (px4, ardupilot):
        assert record.verdict.state is State.READY and not record.relative
        assert record.estimate.hard_iron_b_mg == pytest.approx(IRON, abs=2.0)
    assert px4.estimate.hard_iron_b_mg == pytest.approx(ardupilot.estimate.hard_iron_b_mg, abs=2.0)
    assert (px4.device_id, ardupilot.device_id) == (DEVICE, 97539)
    # What PX4 makes of it is what its own formula makes of it.
    used, mounting = forward(stored, rotated(rot).T @ px4.mag_b_mg, 2)
    assert px4.stored_b_mg == pytest.approx(used, abs=1e-4) and mounting == pytest.approx(rotated(rot))


@pytest.mark.parametrize("rot", [10])
def test_AT_5a_a_second_fit_after_the_first_was_written_changes_nothing(rot):
    stored = params(slot(1, DEVICE, rot, OFF=(0.05, -0.02, 0.01)))
    changes = []
    for seed in (1, 2):
        bench = Bench()
        record = bench.play(flight(mounting=(rotated(rot),), told=stored, seed=seed))[-1]
        held = bench.pipeline.vehicles[1].calibrations
        changes.append(plan_change(held, 1, 1, record.estimate.hard_iron_b_mg, record.sigma_mg, ALL))
        stored |= dict(zip(changes[-1].names, changes[-1].new, strict=True))
    assert max(changes[0].step_mg) > 30.0
    assert max(changes[1].step_mg) < 5.0


def test_highres_imu_beside_it_changes_nothing():
    """Both come: HIGHRES_IMU has PX4's own bias taken off, and says nothing that is stored."""
    told = params(slot(0, DEVICE, 2))

    def less_bias(tell, ms, i, body):
        return tell.highres(ms, forward(told, rotated(2).T @ body)[0] - (30.0, -20.0, 10.0))

    alone, both = Bench(), Bench()
    one = alone.play(flight(12.0, (rotated(2),), told=told))
    two = both.play(flight(12.0, (rotated(2),), told=told, tail=less_bias))
    assert len(one) == len(two) > 200
    for a, b in zip(one, two, strict=True):
        assert np.array_equal(a.mag_b_mg, b.mag_b_mg)
        assert np.array_equal(a.estimate.hard_iron_b_mg, b.estimate.hard_iron_b_mg)
    flown = both.pipeline.vehicles[1]
    assert flown.calibrations.epoch(1) == alone.pipeline.vehicles[1].calibrations.epoch(1)
    assert flown.counts["mag: same compass in a better message"] > 200


def test_highres_imu_before_it_is_another_stretch_and_never_comes_back():
    held = Px4Calibrations()
    assert held.sensor(1, 0, "HIGHRES_IMU") and held.epoch(1) == 0
    assert held.sensor(1, 0, "SCALED_IMU raw") and held.epoch(1) == 1
    for _ in range(5):
        assert not held.sensor(1, 0, "HIGHRES_IMU")
        assert held.sensor(1, 0, "SCALED_IMU raw")
    assert held.epoch(1) == 1


# ---------------------------------------------------------------- parameters


def heard(*frames):
    decoder = Decoder()
    messages = [m for frame in frames for m in Codec().decode(frame, "a", whole=True)]
    return [r for m in messages for r in decoder.readings(m)], decoder


def test_AT_8b_an_integer_arrives_as_it_is_stored():
    tell = Px4Teller()
    for values in ({"CAL_MAG0_ROT": -1.0}, {"CAL_MAG0_ID": 396809.0}, {"CAL_MAG0_ROT": -4194305.0}):
        ((name, value),) = values.items()
        for first in (b"", tell.heartbeat()):  # by the name before a heartbeat, by the autopilot after it
            readings, _ = heard(first, tell.param(name, value))
            assert [(r.name, r.value) for r in readings if isinstance(r, ParamReading)] == [(name, value)]
    readings, _ = heard(tell.heartbeat(), tell.param("CAL_MAG0_XOFF", -0.0125))
    assert readings[-1].value == np.float32(-0.0125)


def test_AT_8b_what_the_vehicle_says_of_its_encoding_counts_before_what_it_is():
    def version(capabilities):
        return dialect.MAVLink_autopilot_version_message(capabilities, 0, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 0)

    number = dialect.MAVLink_param_value_message(b"CAL_MAG0_ROT", 1.0, 6, 9, 65535)
    for tell in (Px4Teller(), Teller()):
        as_cast = tell(number)
        as_int = as_bytes(as_cast, 0, struct.pack("<i", 1))
        assert heard(tell.heartbeat(), tell(version(16)), as_int)[0][-1].value == 1.0
        assert heard(tell.heartbeat(), tell(version(131072)), as_cast)[0][-1].value == 1.0
        own = as_int if isinstance(tell, Px4Teller) else as_cast
        for silent in (0, 16 | 131072, 0xFBEF & ~16):
            assert heard(tell.heartbeat(), tell(version(silent)), own)[0][-1].value == 1.0


def test_the_hash_of_the_parameters_is_no_parameter():
    tell = Px4Teller()
    message = dialect.MAVLink_param_value_message(b"_HASH_CHECK", 1.0, 5, 900, 65535)
    assert heard(as_bytes(tell(message), 0, b"\xff\xff\xff\xff"))[0] == []


def test_a_report_of_nonsense_is_counted():
    tell = Px4Teller()
    bad = tell(dialect.MAVLink_mag_cal_report_message(0, 0, 4, 0, 0.0, float("nan"), 0, 0, 1, 1, 1, 0, 0, 0))
    readings, decoder = heard(tell.heartbeat(), bad)
    assert not any(isinstance(r, CalibrationReading) for r in readings)
    assert decoder.counts["MAG_CAL_REPORT: not a number"] == 1
    ardupilot = Teller()
    running = ardupilot(dialect.MAVLink_mag_cal_report_message(0, 0, 4, 0, 5.0, 1, 2, 3, 1, 1, 1, 0, 0, 0))
    assert not any(isinstance(r, CalibrationReading) for r in heard(ardupilot.heartbeat(), running)[0])


# ---------------------------------------------------------------- whose parameters


def live(told, streams=(1,)):
    held = Px4Calibrations()
    for n in streams:
        held.sensor(n, 0, RAWS[n])
    for name, value in told.items():
        held.param(ParamReading(1, 1, name, float(np.float32(value)), 65535, 0))
    return held


RAWS = {1: "SCALED_IMU raw", 2: "SCALED_IMU2 raw", 3: "SCALED_IMU3 raw"}
TWO = {1: slot(3, DEVICE, 0, OFF=(0.1, 0.2, 0.3)), 2: slot(0, OTHER, 4, OFF=(-0.3, 0.0, 0.1))}


def reported(compass, p):
    groups = [[v for n, v in p.items() if n.endswith(w)] for w in ("OFF", "SCALE", "ODIAG")]
    return CalibrationReading(1, compass, tuple(groups[0]), (*groups[1], *groups[2]))


def test_AT_6a_one_slot_and_one_compass_belong_together():
    held = live(params(TWO[1]))
    assert held.refuses(1) is None and held.known(1) and held.device_id(1) == DEVICE
    assert held.names(1) == (*(f"CAL_MAG3_{a}OFF" for a in AXES), "CAL_MAG3_ID")
    part = params(TWO[1])
    del part["CAL_MAG1_ID"]  # another compass may be in it
    assert not live(part).known(1)


def test_AT_6b_two_slots_or_two_compasses_are_not_told_apart_and_refused():
    for held, compasses in ((live(params(*TWO.values())), (1,)), (live(params(TWO[1]), (1, 2)), (1, 2))):
        for c in compasses:
            assert held.refuses(c) is Reason.MAPPING_UNCLEAR and not held.known(c) and held.device_id(c) == 0
            assert plan_change(held, 1, c, vec3(IRON, "iron"), SIGMA, ALL) is None
    twice = live(params(slot(0, DEVICE, 0), slot(1, DEVICE, 0)))
    assert twice.refuses(1) is Reason.MAPPING_UNCLEAR


def test_AT_6b_a_second_compass_that_shows_later_unsettles_the_first():
    held = live(params(TWO[1]))
    epoch = held.epoch(1)
    held.sensor(2, 0, RAWS[2])
    assert held.refuses(1) is held.refuses(2) is Reason.MAPPING_UNCLEAR
    assert held.epoch(1) == epoch + 1


def test_AT_6a_px4s_report_says_which_slot_a_stream_uses():
    held = live(params(*TWO.values()), (1, 2))
    for c in (2, 1):
        epoch = held.epoch(c)
        assert held.report(reported(c, TWO[c])) == (c,)
        assert held.epoch(c) == epoch + 1 and held.refuses(c) is None and held.known(c)
        assert held.report(reported(c, TWO[c])) == ()
        assert held.epoch(c) == epoch + 1
    assert [held.device_id(c) for c in (1, 2)] == [DEVICE, OTHER]
    # Our own write: parameters are new before the report is. Nothing is unsettled by it.
    epochs = [held.epoch(c) for c in (1, 2)]
    held.expect(["CAL_MAG3_XOFF"], [0.5])
    held.param(ParamReading(1, 1, "CAL_MAG3_XOFF", 0.5, 65535, 0))
    assert held.device_id(1) == DEVICE and held.refuses(1) is None
    assert [held.epoch(c) for c in (1, 2)] == epochs
    # Another device in the slot voids all conclusions.
    assert 1 in held.param(ParamReading(1, 1, "CAL_MAG3_ID", 7.0, 65535, 0))
    assert held.device_id(1) == 0 and held.device_id(2) == OTHER and held.changed(1)


def test_AT_6b_a_report_that_fits_two_slots_or_none_says_nothing():
    alike = {1: slot(1, DEVICE, 0, OFF=(0.1, 0.2, 0.3)), 2: slot(2, OTHER, 4, OFF=(0.1, 0.2, 0.3))}
    for told, said in ((params(*alike.values()), alike[1]), (params(*TWO.values()), alike[1] | {"CAL_MAG1_XOFF": 0.9})):
        held = live(told, (1, 2))
        held.report(reported(1, said))
        assert held.refuses(1) is Reason.MAPPING_UNCLEAR


def test_two_compasses_on_the_wire_each_find_their_own():
    """Other irons, other mountings, slots in the other order: the report settles it, and both are learnt absolutely."""
    told, irons = params(*TWO.values()), (IRON, np.array([120.0, -60.0, 20.0]))

    def reports(tell, ms, i, body):
        return tell.report(1, TWO[1]) + tell.report(2, TWO[2]) if i == 5 else b""

    bench = Bench()
    bench.play(flight(60.0, (STRAIGHT, rotated(4)), irons, told=told, tail=reports))
    for c, device in ((1, DEVICE), (2, OTHER)):
        last = bench.of(1, c)[-1]
        assert (last.device_id, last.relative) == (device, False)
        assert last.estimate.hard_iron_b_mg == pytest.approx(irons[c - 1], abs=3.0)
    without = Bench()
    last = without.play(flight(6.0, (STRAIGHT, rotated(4)), irons, told=told))[-1]
    assert last.verdict.state is State.REFUSED and last.verdict.reasons[0] is Reason.MAPPING_UNCLEAR


# ---------------------------------------------------------------- a change, in the sensor's axes

RIGHT_ANGLES = [n for n, o in PX4.items() if not any(a % 90 for a in o[1:])]


@pytest.mark.parametrize("rot", RIGHT_ANGLES)
def test_AT_18b_the_offset_is_written_in_the_sensors_axes_and_takes_the_iron_away(rot):
    told = params(slot(2, DEVICE, rot, OFF=(0.05, -0.11, 0.21), **MATRIX))
    held = live(told)
    change = plan_change(held, 1, 1, vec3(IRON, "iron"), SIGMA, ALL)
    assert ADAPTERS[12].checked(change) == change
    assert change.device_name == "CAL_MAG2_ID" and change.names == tuple(f"CAL_MAG2_{a}OFF" for a in AXES)
    new = told | dict(zip(change.names, change.new, strict=True))
    earth = np.array([200.0, -30.0, 430.0])
    sensor = rotated(rot).T @ (earth + IRON)
    clean = params(slot(2, DEVICE, rot, **MATRIX))
    assert forward(new, sensor, 2)[0] == pytest.approx(forward(clean, rotated(rot).T @ earth, 2)[0], abs=1e-3)
    assert change.shift_b_mg == pytest.approx(forward(new, sensor, 2)[0] - forward(told, sensor, 2)[0], abs=1e-4)
    for value, old, step in zip(change.new, change.old, change.step_mg, strict=True):
        assert step == pytest.approx(1000.0 * abs(value - old), abs=1e-9)
        assert value == float(np.float32(value))


@pytest.mark.parametrize("rot", RIGHT_ANGLES)
@pytest.mark.parametrize("write", [(True, True, False), (False, False, True)])
def test_S4_an_axis_of_the_body_that_was_not_observed_stays(rot, write):
    told = params(slot(0, DEVICE, rot, OFF=(0.05, -0.11, 0.21)))
    held = live(told)
    before = np.array(held.offsets(1))
    change = plan_change(held, 1, 1, vec3(IRON, "iron"), SIGMA, write)
    assert len(change.names) == sum(write)
    for name, value in zip(change.names, change.new, strict=True):
        held.param(ParamReading(1, 1, name, value, 65535, 0))
    kept = ~np.array(write)
    assert np.array_equal(held.offsets(1)[kept], before[kept])
    assert held.offsets(1)[list(write)] == pytest.approx(-IRON[list(write)], abs=1e-4)


def test_S4_an_oblique_sensor_moves_in_the_observed_plane_only():
    held = live(params(slot(0, DEVICE, 38, OFF=(0.05, -0.11, 0.21))))
    change = plan_change(held, 1, 1, vec3(IRON, "iron"), SIGMA, (True, True, False))
    assert len(change.names) == 3  # every axis of the sensor has a part in the level plane
    assert abs(change.shift_b_mg[2]) < 1e-4
    assert np.hypot(*change.shift_b_mg[:2]) > 50.0


def test_values_of_others_are_split_off_not_mixed():
    """Who turns the sensor in the parameters begins a new stretch; who moves offsets does not touch the sensor."""
    held = live(params(slot(0, DEVICE, 0)))
    epoch = held.epoch(1)
    held.param(ParamReading(1, 1, "CAL_MAG0_XOFF", 0.4, 65535, 0))
    assert held.epoch(1) == epoch
    assert held.param(ParamReading(1, 1, "CAL_MAG0_ROT", 4.0, 65535, 0)) == (1,)
    assert held.epoch(1) == epoch + 1


def test_before_the_heartbeat_and_after_it_do_not_mix():
    """Until it is known who speaks, SCALED_IMU is taken as ArduPilot's: what was learnt of that is dropped."""
    frames = flight(6.0, (rotated(2),), told=params(slot(0, DEVICE, 2)))
    late = [(ms, data) for ms, data in frames if data[7:10] != b"\0\0\0" or ms >= 13_000]
    assert sum(len(d) for _, d in late) < sum(len(d) for _, d in frames)
    record = Bench().play(late)[-1]
    early = sum(ms < 13_000 and data[7] == 26 for ms, data in frames)
    assert 0 < record.estimate.samples <= 6 * HZ - early + 1


def test_two_readings_of_one_name_are_kept_once_and_others_not_at_all():
    held = Px4Calibrations()
    for i in range(500):
        held.param(ParamReading(1, 1, f"CAL_MAG{i}_XOFF", 1.0, 65535, 0))
        held.param(ParamReading(1, 1, f"SENS_BOARD_{i}", 1.0, 65535, 0))
    assert sum(held.value(f"CAL_MAG{i}_XOFF") is not None for i in range(500)) == 4
    assert not any(held.value(f"SENS_BOARD_{i}") for i in range(500))
    assert len(held._held) == 4


def test_the_message_tells_who_sends_it():
    field = Px4Teller().scaled(20_000, (1, 2, 3))
    for tell, source in ((Px4Teller(), "SCALED_IMU raw"), (Teller(), "SCALED_IMU")):
        readings, _ = heard(tell.heartbeat(), field)
        assert [r.source for r in readings if isinstance(r, MagReading)] == [source]
