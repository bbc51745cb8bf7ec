"""The whole companion on the simulated PX4, and on a vehicle that signs: the two share nothing but bytes."""

from __future__ import annotations

import numpy as np
import pytest
from flight_rig import Flight, error_mg, observed, ready, scenario
from magmav_sim import SimulatedLink, Simulation, load_scenario
from sim_rig import Ground, body_from_ned, mag

from magmav.geomag import world_magnetic_model
from magmav.live import Session
from magmav.mavlink.change import code_needed
from magmav.mavlink.signing import Signing
from magmav.settings import Settings
from magmav.store import Store

IRON_SENSOR_GAUSS = np.array((-120.0, -180.0, 240.0)) / 1000  # (180, -120, 240) mG of the body, on a mount yawed by 90


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """PX4 with a compass yawed by 90 degrees on its mount, flown once; then its offsets are asked for."""
    f = Flight(scenario("px4"), tmp_path_factory.mktemp("px4"))
    f.land()
    f.learnt = f.last()
    f.change = f.companion.plan(1)
    f.set("MMAG_CONFIRM", float(code_needed(f.change) or 0))
    f.set("MMAG_UPLOAD", 1.0)
    f.fly(lambda: f.companion.result >= 2 or f.companion.result < 0, 60.0)
    f.result = f.companion.result
    yield f
    f.end()


def test_estimate_from_the_raw_stream_of_px4_converges_to_the_true_hard_iron(flown):
    record = flown.learnt
    assert ready(record) and observed(record).all()
    assert (record.device_id, record.relative) == (97539, False)
    off = error_mg(flown.sim, record)
    assert (np.abs(off) <= 3.5 * record.sigma_mg).all() and np.linalg.norm(off) < 12.0


def test_AT_18b_offsets_of_a_turned_sensor_are_written_in_its_own_axes_in_gauss_to_subtract(flown):
    assert flown.change.names == ("CAL_MAG0_XOFF", "CAL_MAG0_YOFF", "CAL_MAG0_ZOFF")
    stored = np.array([flown.value(name) for name in flown.change.names])
    np.testing.assert_array_equal(stored, np.float32(flown.change.new))
    np.testing.assert_allclose(stored, IRON_SENSOR_GAUSS, atol=0.012)
    assert flown.result == 4.0  # MMAG_RESULT: written but unproven


def test_after_a_reboot_px4_flies_by_the_true_field(flown):
    ground = Ground(flown.sim)
    assert ground.command(246, 1) == 0
    ground.run(3.0)
    ground.stream(105, 20)
    field = np.mean([mag(m) for m in ground.run(2.0) if m.get_type() == "HIGHRES_IMU"], axis=0) * 1000
    s = flown.sim.autopilot.state
    true = body_from_ned(s.roll_rad, s.pitch_rad, s.heading_rad) @ np.array(flown.sim.world.field_ned_mg)
    np.testing.assert_allclose(field, true, atol=12.0)


# ---------------------------------------------------------------- signed


def session(folder, sim: Simulation, signer: Signing | None) -> tuple[Session, Store]:
    link = SimulatedLink(sim, until_s=25.0)
    store = Store(folder / "signed.sqlite").open()
    return Session.on(link, Settings(), world_magnetic_model, store, signer=signer), store


def fly(made: Session) -> None:
    for packet in made.service.link.packets():
        made.service.turn(packet)


@pytest.mark.parametrize("keyed", [True, False])
def test_vehicle_that_signs_believes_us_with_its_key_and_not_a_word_without(tmp_path, keyed):
    sim = Simulation(load_scenario("signed"))
    (fault, vehicle), *_ = sim._signed
    made, store = session(tmp_path, sim, Signing(bytes.fromhex(fault.key), 2) if keyed else None)
    fly(made)
    store.close()
    records = made.pipeline.vehicles[1].calibrations if 1 in made.pipeline.vehicles else None
    assert (records is not None and records.known(1)) is keyed  # it answered for its parameters
    assert (made.service.heard["RAW_IMU"] > 100) is keyed  # and sends what was asked for
    if keyed:
        assert not vehicle.counts
    else:
        assert vehicle.counts["unsigned"] == sum(vehicle.counts.values())


def test_another_key_is_heard_by_neither_side(tmp_path):
    sim = Simulation(load_scenario("signed"))
    made, store = session(tmp_path, sim, Signing(bytes(32), 2))
    fly(made)
    store.close()
    assert not made.pipeline.vehicles and not sum(made.service.heard.values())
