"""The service against the simulator, which shares no code with the core: no sign error can cancel here."""

from __future__ import annotations

import numpy as np
import pytest
from flight_rig import Flight, error_mg, observed, ready, scenario
from magmav_sim import Simulation, parse_scenario

_TWO = """
seed = 41
airframe = "F450"
date = 2026-11-22T10:00:00Z
place = { lat_deg = %s, lon_deg = 8.5456, alt_m = 488.0 }
heading_deg = 200.0
wind = { speed_mps = 3.0, from_deg = 120.0, turbulence_mps = 1.0 }

[[compass]]
device_id = 97539
hard_iron_mg = [-210.0, 70.0, 130.0]
noise_mg = 4.0

[autopilot]
yaw = "%s"
[autopilot.parameters]
%s

[[flight]]
pattern = [
    { kind = "takeoff", height_m = 12.0, climb_mps = 3.0 },
    { kind = "yaw", turns = 1.5, rate_dps = 36.0 },
    { kind = "figure8", laps = 1, half_length_m = 12.0, speed_mps = 4.5 },
    { kind = "land", sink_mps = 2.0 },
]
"""


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """Flies one to its end, once; returns it with the true heading over time."""
    made = {}

    def fly(simulation, name=None):
        if name in made:
            return made[name]
        f = Flight(simulation, tmp_path_factory.mktemp("flown"))
        made[name or len(made)] = f
        f.true = []
        f.fly(lambda: f.true.append((f.sim.elapsed_ns, f.sim.truth.heading_rad)))
        return f

    yield fly
    for f in made.values():
        f.end()


def vehicle(lat="47.3977", yaw="compass", parameters=""):
    return Simulation(parse_scenario((_TWO % (lat, yaw, parameters)).encode(), "two.toml"))


def heading_errors(f, compass=1):
    """Published true heading minus the true one, and the published sigma, both (N,) rad."""
    mine = [r for r in f.records if r.compass == compass and r.heading.true_valid]
    times, true = (np.array(v, dtype=float) for v in zip(*f.true, strict=True))
    truth = np.interp([float(r.t_ns) for r in mine], times, np.unwrap(true))
    off = np.angle(np.exp(1j * (np.array([r.heading.true_rad for r in mine]) - truth)))
    return off, np.array([r.heading.sigma_rad for r in mine])


@pytest.mark.long
def test_three_compasses_on_different_mounts_are_each_right(flown):
    f = flown(scenario("three_compasses"))
    for compass, device in ((1, 97539), (2, 131874), (3, 263178)):
        record = f.last(compass)
        assert record.device_id == device
        assert ready(record)
        assert (np.abs(error_mg(f.sim, record)) <= 3.5 * record.sigma_mg).all()


@pytest.mark.parametrize("yaw", ["compass", "truth"])
def test_published_heading_is_true_whatever_the_autopilot_believes(flown, yaw):
    """The autopilot's own yaw is 70 degrees out while it follows the bad compass: it must not be learnt from."""
    f = flown(vehicle(yaw=yaw), yaw)
    off, sigma = heading_errors(f)
    late = slice(len(off) // 3, None)
    assert np.degrees(np.sqrt(np.mean(off[late] ** 2))) < 3.0
    assert 0.2 < np.sqrt(np.mean((off[late] / sigma[late]) ** 2)) < 1.5  # its sigma is no boast and no excuse
    assert ready(f.last()) and (np.abs(error_mg(f.sim, f.last())) <= 3.5 * f.last().sigma_mg).all()


@pytest.mark.long
def test_southern_hemisphere_has_the_field_pointing_up_and_the_same_answer(flown):
    f = flown(vehicle(lat="-33.9"))
    record = f.last()
    assert ready(record) and (np.abs(error_mg(f.sim, record)) <= 3.5 * record.sigma_mg).all()
    assert record.estimate.down_mg < -100.0
    off, _ = heading_errors(f)
    assert np.degrees(np.sqrt(np.mean(off[len(off) // 3 :] ** 2))) < 3.0


def test_what_the_autopilot_corrects_already_is_undone_exactly(flown):
    """Stored offsets shift the stream from its first value on; the answer is the sensor's own iron all the same."""
    stored = (-120.0, 60.0, -35.0)
    words = "\n".join(f"COMPASS_OFS_{a} = {v}" for a, v in zip("XYZ", stored, strict=True))
    f = flown(vehicle(parameters=words))
    record = f.last()
    assert (np.abs(error_mg(f.sim, record)) <= 3.5 * record.sigma_mg)[observed(record)].all()
    moved = record.stored_b_mg - record.mag_b_mg
    assert moved == pytest.approx(stored, abs=1.0)
    assert ready(record)


def test_uncorrected_heading_is_as_wrong_as_its_iron(flown):
    """The reference of every before-and-after figure: the stream as it is, against the truth."""
    f = flown(vehicle(), "compass")
    mine = [r for r in f.records if r.stored_heading.true_valid]
    times, true = (np.array(v, dtype=float) for v in zip(*f.true, strict=True))
    truth = np.interp([float(r.t_ns) for r in mine], times, np.unwrap(true))
    off = np.angle(np.exp(1j * (np.array([r.stored_heading.true_rad for r in mine]) - truth)))
    assert np.degrees(np.sqrt(np.mean(off**2))) > 40.0  # 221 mG of iron across a 215 mG field
