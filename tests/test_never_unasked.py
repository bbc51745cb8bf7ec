"""S18: with the default settings nothing is ever uploaded by itself, however ready it is; every write was asked for."""

from __future__ import annotations

from pathlib import Path

import pytest
from flight_rig import Flight, ready, staying
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.mavlink.change import code_needed
from magmav.settings import Settings, knobs


@pytest.fixture(scope="module")
def landed(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    """READY in flight, landed, disarmed, and left alone for a minute."""
    folder: Path = tmp_path_factory.mktemp("unasked")
    flight = Flight(staying(), folder, settings=Settings())
    flight.land()
    assert ready(flight.last())
    flight.fly(seconds=60.0)
    return flight


def writes(flight: Flight) -> list[str]:
    return [m.param_id for m in flight.said() if m.get_type() == "PARAM_SET"]


def test_S18_default_config_never_uploads_by_itself(landed: Flight) -> None:
    assert writes(landed) == []
    assert landed.value("COMPASS_OFS_X") == 0.0 and landed.companion.ended is None
    assert landed.store.history() == []


def test_S18_there_is_no_setting_that_would_turn_it_on() -> None:
    names = [f"{knob.section}.{knob.key}" for knob in knobs()]
    assert len(names) > 20
    assert [n for n in names if n.startswith("upload.")] == ["upload.confirm_above_mg"]
    assert not [n for n in names if "auto" in n or "apply" in n]


def test_S18_each_upload_wants_its_own_action_and_one_action_makes_one_upload(landed: Flight) -> None:
    change = landed.companion.plan(1)
    assert change is not None
    landed.set("MMAG_CONFIRM", float(code_needed(change) or 0))
    landed.set("MMAG_UPLOAD", 1.0)
    assert landed.fly(lambda: landed.companion.ended is not None, 60.0)
    assert sorted(set(writes(landed))) == sorted(change.names)
    landed.fly(seconds=40.0)
    assert writes(landed) == [] and len(landed.store.history()) == 1
    for _ in range(6):
        landed.operator(dialect.MAVLink_param_request_read_message(1, 191, b"MMAG_UPLOAD", -1))
    landed.fly(seconds=5.0)
    assert writes(landed) == []
    landed.end()
