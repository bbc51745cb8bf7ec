"""What is kept between messages is what would be answered anew, and a pipeline at rest hears what one at work hears."""

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from magmav.core.types import (
    AttitudeReading,
    EarthField,
    InertialReading,
    MagReading,
    MotionReading,
    ParamReading,
    PositionReading,
    ThrottleReading,
    VehicleReading,
    vec3,
)
from magmav.mavlink.autopilot.ardupilot import Calibrations
from magmav.mavlink.autopilot.px4 import Px4Calibrations
from magmav.mavlink.autopilot.stored import standing_of
from magmav.pipeline import Pipeline
from magmav.recording import Keeper
from magmav.settings import Settings

MS = 10**6
ARDUPILOT = [
    *(f"COMPASS_{w}" for w in ("OFS_X", "OFS_Y", "OFS_Z", "DEV_ID", "DEV_ID2", "PRIO1_ID", "SCALE", "MOTCT", "MOT_X")),
    *("COMPASS_DIA_X", "COMPASS_OFS2_X", "COMPASS_DIA_Y", "COMPASS_DIA_Z", "COMPASS1_OFS_X"),
]
PX4 = [
    *(f"CAL_MAG0_{w}" for w in ("ID", "ROT", "XOFF", "YOFF", "ZOFF", "XSCALE", "YSCALE", "ZSCALE", "XCOMP")),
    *("CAL_MAG1_ID", "CAL_MAG2_ID", "CAL_MAG3_ID", "CAL_MAG_COMP_TYP", "SENS_BOARD_ROT"),
]
heard = st.lists(
    st.one_of(
        st.tuples(st.just("param"), st.sampled_from(ARDUPILOT + PX4), st.sampled_from([0.0, 1.0, 2.0, 7.0, 0.9])),
        st.tuples(st.just("sensor"), st.sampled_from([1, 2]), st.sampled_from(["SCALED_IMU raw", "sensor_mag", "MAG"])),
        st.tuples(st.sampled_from(["armed", "throttle", "current"]), st.just(0), st.sampled_from([0.0, 0.5, 1.0])),
    ),
    max_size=40,
)


def told(held, story):
    for what, name, value in story:
        if what == "param":
            held.param(ParamReading(1, 1, name, value, 0, 9))
        elif what == "sensor":
            held.sensor(name, 7, value)
        else:
            getattr(held, what)(bool(value) if what == "armed" else value)
        yield


@pytest.mark.parametrize("book", [Calibrations, Px4Calibrations])
@settings(max_examples=60, deadline=None)
@given(story=heard)
def test_what_stands_is_what_would_be_answered_anew(book, story):
    held = book()
    for _ in told(held, story):
        for compass in (1, 2):
            kept, anew = held.standing(compass), standing_of(held, compass)
            for f in fields(kept):
                one, other = getattr(kept, f.name), getattr(anew, f.name)
                if f.name == "shaping":
                    assert np.array_equal(one.matrix, other.matrix)
                    assert np.array_equal(one.motor_b_mg, other.motor_b_mg)
                else:
                    assert np.array_equal(one, other), f.name
            assert held.standing(compass) is kept


def field_model(lat_deg, lon_deg, alt_m, unix_ns):
    return EarthField(210.0, 15.0, 430.0)


ZERO = vec3((0, 0, 0), "r")
KINDS = ("attitude", "mag", "mag", "mag2", "again", "imu", "param", "throttle", "beat", "position", "up")
steps = st.lists(
    st.tuples(st.sampled_from(KINDS), st.sampled_from([20, 20, 100, 0, -20, 700, -3000, 12000]), st.integers(0, 9)),
    min_size=20,
    max_size=150,
)


def readings(story):
    """A stream with values said twice, values that come late, reboots and clocks that jump."""
    ms, value = 20_000, 0
    yield VehicleReading(1, 1, 3, 2, True, 4)
    for kind, dt_ms, n in story:
        ms = max(ms + dt_ms, 0)
        ns = ms * MS
        value += kind.startswith("mag")
        mag = vec3((value % 40 * (n != 9), 5 * n, 400 * (n != 9)), "field")  # at times no level field at all
        match kind:
            case "attitude":
                yield AttitudeReading(1, "ATTITUDE", ns, 0.1 * n, -0.05 * n, 0.3 * n, vec3((0.1, 0.02 * n, 0.2), "r"))
            case "mag" | "again":
                yield MagReading(1, 1, "RAW_IMU", ns, mag)
            case "mag2":
                yield MagReading(1, 2, "SCALED_IMU2", ns, mag)
            case "imu":
                yield InertialReading(1, "RAW_IMU", ns, vec3((0.1 * n, 0, -9.8), "f"), ZERO)
            case "param":
                yield ParamReading(1, 1, ARDUPILOT[n], float(n), 0, 9)
            case "throttle":
                yield ThrottleReading(1, n / 10.0)
            case "beat":
                yield VehicleReading(1, 1, 3, 2, n > 2, 4)
            case "position":
                yield PositionReading(1, "GLOBAL_POSITION_INT", ns, 47.0 + n, 8.0, 500.0)
            case "up":
                yield MotionReading(1, ns, 1.0, 0.0, 2.0 * n)


def played(story, idle):
    pipeline = Pipeline(Settings(), field_model, 0, None, idle)
    keeper, records = Keeper(pipeline, None), []
    for t_ns, reading in enumerate(readings(story)):
        record = pipeline.step(reading, t_ns)
        keeper(reading, record)
        records.append(record)
    return pipeline.vehicles[1], keeper, records


@settings(max_examples=60, deadline=None)
@given(story=steps)
def test_at_rest_it_hears_what_it_hears_at_work(story):
    """Sample for sample: times, ages, what would teach, where the declination is known, and what was left out."""
    (one, at_work, records), (other, at_rest, seldom) = played(story, False), played(story, True)
    assert at_work.compasses.keys() == at_rest.compasses.keys()
    assert one.assembler.counts == other.assembler.counts
    assert one.counts == other.counts
    for key, log in at_work.compasses.items():
        bare = at_rest.compasses[key]
        for name in ("boot_s", "age_s", "stored_magnetic_rad", "stored_true_rad", "declination_rad"):
            assert np.array_equal(getattr(log, name), getattr(bare, name), equal_nan=True), name
        assert bare.learnt == log.learnt
        assert (bare.last.relative, bare.last.device_id) == (log.last.relative, log.last.device_id)
        assert not np.isfinite(bare.true_rad).any()
        assert bare.last.estimate.samples == 0
    assert not [1 for r, s in zip(records, seldom, strict=True) if r is None and s is not None]


def test_at_rest_a_record_comes_with_news_only():
    story = [("position", 20, 1)] + [("attitude", 20, 1), ("mag", 80, 1)] * 30
    _, _, records = played([*story, ("param", 0, 3), *story], idle=True)
    mine = [i for i, r in enumerate(records) if r is not None]
    assert len(mine) == 2  # at the first sample, and where a device id became known
    assert mine[0] < len(story) < mine[1]
