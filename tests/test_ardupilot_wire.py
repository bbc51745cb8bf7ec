"""ArduPilot over MAVLink, from bytes: fit, write, fit again for all three compasses; and fields in a wrong unit."""

import numpy as np
import pytest
from honest_flight import MOTIONS, body_rates, field_in_body
from memory_flight import Bench, Teller
from pymavlink.dialects.v20 import ardupilotmega as dialect
from test_ardupilot import forward, plain

from magmav.core.types import Reason, State
from magmav.mavlink.autopilot.plan import plan_change

HZ, COMPASSES, SUFFIX = 25, (1, 2, 3), {1: "", 2: "2", 3: "3"}
IRONS = {1: np.array([-88.0, 41.0, 30.0]), 2: np.array([150.0, -20.0, 60.0]), 3: np.array([20.0, 210.0, -45.0])}
DEVICES = {1: 97539, 2: 131874, 3: 263178}


def frames(held, seed, seconds=40.0, imu=None):
    """A flight with three compasses; each message carries what ArduPilot makes of its sensor with what it holds."""
    r, n = np.random.default_rng(seed), int(seconds * HZ)
    m = MOTIONS["figure eight"](np.arange(n) / HZ, r)
    sensors = {c: field_in_body(m) + IRONS[c] + r.normal(0.0, 1.0, (n, 3)) for c in COMPASSES}
    rates, tell = body_rates(m, 1 / HZ), Teller()
    for i in range(n):
        ms = 10_000 + i * 1000 // HZ
        if i % HZ == 0:
            yield tell.heartbeat() + tell.height(ms, 30.0)
        if i == 0:
            yield tell.params(held)
        yield tell.attitude(ms, m.roll_rad[i], m.pitch_rad[i], float(m.yaw_rad[i]), rates[i])
        if imu is not None:
            yield imu(tell, ms, forward(held, sensors[1][i]))
            continue
        for c in COMPASSES:
            sent = np.rint(forward(held, sensors[c][i], SUFFIX[c])).astype(int)
            if c < 3:
                yield tell.imu(ms, sent, c)
            else:
                yield tell(dialect.MAVLink_scaled_imu3_message(ms, 0, 0, -1000, 0, 0, 0, *(int(v) for v in sent)))


def three(offsets):
    out = {}
    for c in COMPASSES:
        out |= plain(SUFFIX[c], offsets, DEVICES[c])
    return out


def test_AT_5a_a_second_fit_after_the_first_was_written_changes_nothing():
    """With offsets stored already, as every vehicle has; each compass is fitted, written, and fitted on other data."""
    held, steps = three((15.0, -40.0, 25.0)), []
    for seed in (1, 2):
        bench = Bench()
        bench.play(frames(held, seed))
        book, written = bench.pipeline.vehicles[1].calibrations, {}
        for c in COMPASSES:
            last = bench.of(1, c)[-1]
            change = plan_change(book, 1, c, last.estimate.hard_iron_b_mg, last.sigma_mg, (True, True, True))
            assert (change.compass, change.device_id) == (c, DEVICES[c])
            written |= dict(zip(change.names, change.new, strict=True))
            steps.append(max(change.step_mg))
        held = held | written
    assert min(steps[:3]) > 50.0
    assert max(steps[3:]) < 5.0
    for c in COMPASSES:
        stored = [held[f"COMPASS_OFS{SUFFIX[c]}_{a}"] for a in "XYZ"]
        assert stored == pytest.approx(-IRONS[c], abs=5.0)


# ---------------------------------------------------------------- wrong units


def highres(factor):
    """HIGHRES_IMU in gauss, times this factor."""

    def imu(tell, ms, field_mg):
        x, y, z = (float(v) / 1e3 * factor for v in field_mg)
        rest = (1013.0, 0.0, 100.0, 20.0, 511, 0)
        return tell(dialect.MAVLink_highres_imu_message(ms * 1000, 0, 0, -9.8, 0, 0, 0, x, y, z, *rest))

    return imu


def raw(factor):
    """RAW_IMU times this factor, as far as 16 bits go."""
    return lambda tell, ms, field_mg: tell.imu(ms, np.clip(field_mg * factor, -32768, 32767))


def wrapped(tell, ms, field_mg):
    """A thousand times too large, and cut to 16 bits as a cast in C may."""
    return tell.imu(ms, np.rint(field_mg * 1e3).astype(np.int64).astype(np.int16))


@pytest.fixture(scope="module")
def in_gauss():
    bench = Bench()
    return bench.play(frames(three((0.0,) * 3), 3, 15.0, highres(1.0)))[-1], bench


@pytest.mark.parametrize("factor", [1e3, 1e6])
def test_AT_5d_highres_imu_in_another_unit_is_put_right_and_told_of(in_gauss, factor):
    right, proper = in_gauss
    bench = Bench()
    last = bench.play(frames(three((0.0,) * 3), 3, 15.0, highres(factor)))[-1]
    assert last.mag_b_mg == pytest.approx(right.mag_b_mg, abs=1e-3)
    assert last.estimate.hard_iron_b_mg == pytest.approx(right.estimate.hard_iron_b_mg, abs=0.05)
    notice = f"HIGHRES_IMU: field {factor:.0f} times too large, put right"
    assert bench.service.counts()["decode"][notice] == 15 * HZ
    assert not any("too large" in key for key in proper.service.counts()["decode"])


@pytest.mark.parametrize("imu", [highres(1e-3), raw(0.1), wrapped], ids=["gauss/1000", "uT", "mG*1000 cast"])
def test_AT_5d_a_field_that_is_no_earths_in_its_unit_is_refused(imu):
    bench = Bench()
    records = bench.play(frames(three((0.0,) * 3), 3, 15.0, imu))
    assert not any(r.verdict.state is State.READY for r in records)
    codes = [cause.code for cause in bench.pipeline.vehicles[1].causes.latest(1)]
    if imu is wrapped:  # no two values fit: the estimator takes none of them, and the strength is told of at once
        assert records[-1].verdict.state is State.LEARNING and "MAGNET_NEARBY" in codes
    else:
        assert records[-1].verdict.state is State.REFUSED
        assert Reason.FIELD_NOT_EARTHLIKE in records[-1].verdict.reasons


def test_AT_5d_a_field_at_the_end_of_its_scale_is_no_field():
    bench = Bench()
    records = bench.play(frames(three((0.0,) * 3), 3, 8.0, raw(1e3)))
    assert not any(r.verdict.state is State.READY for r in records)
    assert len(records) < 20  # all the rest had an axis at 32767
    assert bench.service.counts()["decode"]["RAW_IMU: field at the end of its scale"] > 180


def test_AT_5d_a_thousandth_of_a_milligauss_is_no_compass_at_all():
    bench = Bench()
    assert bench.play(frames(three((0.0,) * 3), 3, 4.0, raw(1e-3))) == []
    assert bench.service.counts()["decode"]["RAW_IMU: no compass (all zero)"] == 4 * HZ
