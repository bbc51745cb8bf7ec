"""The whole companion against the simulated PX4: learn, land, write, reboot, take back; and who writes besides us."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from flight_rig import IRON_MG, Flight, ready, scenario
from magmav_sim import Simulation, parse_scenario
from test_upload_far import GROUND

from magmav.core.types import Change, Reason, UploadResult
from magmav.live import history_entry
from magmav.mavlink.autopilot.plan import plan_change
from magmav.mavlink.change import code_needed
from magmav.mavlink.kept import Keeping
from magmav.view.table import history_view, to_text

PX4 = GROUND + b'[autopilot]\nkind = "px4"\n[autopilot.parameters]\nSENS_MAG_AUTOCAL = %d\n'


def wanted(flight: Flight) -> Change:
    """What takes away the simulated iron, once the companion has read all it needs."""

    def known() -> bool:
        flown = flight.companion.flown()
        return flown is not None and flown.calibrations.known(1) and flight.companion.writer.identified

    assert flight.fly(known, 60.0)
    flown = flight.companion.flown()
    assert flown is not None
    change = plan_change(flown.calibrations, 1, 1, IRON_MG, np.full(3, 2.0), (True, True, True))
    assert change is not None
    return change


def ended(flight: Flight, change: Change, undoes: int | None = None) -> tuple[UploadResult | None, tuple[Reason, ...]]:
    flight.companion.ended = None
    flight.companion.start(change, code_needed(change), flight.service.now_ns, undoes)
    assert flight.fly(lambda: flight.companion.ended is not None, 120.0)
    job = flight.companion.ended
    assert job is not None
    return job.result, job.reasons


def held(flight: Flight, change: Change) -> tuple[float, ...]:
    return tuple(flight.value(name) for name in change.names)


def test_px4_flies_learns_and_is_written_with_the_advice_to_reboot(tmp_path: Path) -> None:
    flight = Flight(scenario("px4"), tmp_path)
    flight.land()
    assert ready(flight.last())
    change = flight.companion.plan(1)
    assert change is not None and change.names[0].startswith("CAL_MAG")
    assert ended(flight, change) == (UploadResult.WRITTEN_UNPROVEN, (Reason.REBOOT_TO_APPLY,))
    assert held(flight, change) == change.new
    # The compass sits turned by 90 degrees (orient 2): the sensor's own y shows the vehicle's -x.
    assert np.array(change.new) * 1000.0 == pytest.approx([-120.0, -180.0, 240.0], abs=15.0)
    flight.end()


@pytest.mark.parametrize("loses", [False, True])
def test_AT_4c_px4_after_the_reboot_it_is_said_whether_the_values_held_and_the_restore_is_exact(
    tmp_path: Path, loses: bool
) -> None:
    flight = Flight(Simulation(parse_scenario(PX4 % 0, "px4.toml"), 2), tmp_path)
    change = wanted(flight)
    assert ended(flight, change)[0] is UploadResult.WRITTEN_UNPROVEN
    (row,) = flight.store.history()
    assert row.kept is None and history_entry(row)["note"].startswith("no stream of PX4 shows their effect")
    flight.said()
    flight.fly(seconds=15.0)
    flight.sim.autopilot.reboot()
    if loses:
        for name, value in zip(change.names, change.old, strict=True):
            flight.sim.autopilot.parameters.put(name, value)
    flight.fly(seconds=30.0)
    found = Keeping.LOST if loses else Keeping.PERSISTED
    texts = [m.text for m in flight.said() if m.get_type() == "STATUSTEXT"]
    assert any(found.name in text for text in texts), texts
    (row,) = flight.store.history()
    assert row.kept is found
    assert row.result is UploadResult.WRITTEN_UNPROVEN, "what no stream can show is never called proven (S11)"
    assert any("stays unproven" in text for text in texts) is not loses
    entry = history_entry(row)
    assert entry["note"].startswith(found.name) and ("no stream of PX4" in entry["note"]) is not loses
    assert " ".join(entry["note"].split()[:4]) in " ".join(to_text(history_view([entry]), width=300).split())
    if not loses:
        assert ended(flight, row.change, row.id) == (UploadResult.ALL_OLD, ())
        assert held(flight, change) == change.old
    flight.end()


def test_S7_AT_18a_px4_that_calibrates_in_flight_is_not_written_to(tmp_path: Path) -> None:
    flight = Flight(Simulation(parse_scenario(PX4 % 1, "px4.toml"), 2), tmp_path)
    change = wanted(flight)
    assert ended(flight, change) == (UploadResult.REFUSED, (Reason.SECOND_WRITER,))
    assert held(flight, change) == change.old
    assert not [m for m in flight.said() if m.get_type() == "PARAM_SET"]
    flight.end()
