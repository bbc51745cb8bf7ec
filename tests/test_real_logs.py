"""Real DataFlash and ULog flights; others' fits and stored values are the judge."""

import json
import os
from pathlib import Path

import pytest

from magmav.cli import main
from magmav.core.types import Reason
from magmav.geomag import world_magnetic_model
from magmav.recording import open_recording, replay
from magmav.settings import Settings

_DATA = Path(os.environ.get("MAGMAV_DATA", Path(__file__).parents[2] / "shared" / "data")) / "logs"
pytestmark = [
    pytest.mark.flights,
    pytest.mark.skipif(not _DATA.is_dir(), reason="no real recordings here: set MAGMAV_DATA"),
]


def replayed(name):
    recording = open_recording(_DATA / name)
    try:
        return replay(recording, Settings(), world_magnetic_model)
    finally:
        recording.close()


@pytest.fixture(scope="module")
def log171():
    return replayed("log171.bin")["vehicles"][0]


def test_a_dataflash_flight_is_told_from_arming_to_its_tumble(log171):
    (flight,) = log171["flights"]
    assert flight["armed_s"] < flight["takeoff_s"] < 100.0 < 230.0 < flight["crash_s"] < 245.0
    assert log171["autopilot"] == 3


def test_the_compass_nobody_calibrated_is_found(log171):
    compass = log171["compasses"][2]
    assert compass["heading"]["rms_deg"] < 0.5 * compass["heading"]["uncalibrated_rms_deg"]


def test_a_wrong_stored_calibration_shows_beside_a_right_one(log171):
    """Compass 2's stored values are known to be wrong, compass 1's are good."""
    one, two = (c["heading"] for c in log171["compasses"][:2])
    assert two["stored_rms_deg"] > 2.5 * two["rms_deg"]
    assert one["stored_rms_deg"] < 1.2 * one["rms_deg"]
    assert two["stored_rms_deg"] > 2.5 * one["stored_rms_deg"]


def test_stored_values_come_from_the_parameters_not_from_rounded_columns(log171):
    stored = log171["compasses"][0]["stored"]
    assert stored["COMPASS_OFS_X"] == pytest.approx(-97.79, abs=0.01)  # the MAG message says -97
    assert stored["COMPASS_OFS_X"] != round(stored["COMPASS_OFS_X"])


def test_a_px4_flight_comes_back_to_what_px4_had_stored():
    """Offsets within 10 mG of CAL_MAG0 in the log, in ArduPilot's sense: PX4 subtracts, gauss."""
    (compass,) = replayed("esc_status_log.ulg")["vehicles"][0]["compasses"]
    stored = [-1000.0 * compass["stored"][f"CAL_MAG0_{axis}OFF"] for axis in "XYZ"]
    assert compass["offsets_mg"] == pytest.approx(stored, abs=10.0)
    assert compass["state"] == "READY"
    assert Reason.RELATIVE_ONLY.name not in [r["code"] for r in compass["reasons"]]


@pytest.mark.long
@pytest.mark.parametrize("name", ["log171.bin", "esc_status_log.ulg"])
def test_every_estimator_can_be_compared_on_it(name, capsys):
    words = ["compare", str(_DATA / name), "--only", "kalman,bullock,minmax_level", "--json"]
    assert main(words) == 0
    result = json.loads(capsys.readouterr().out)
    for compass in result["vehicles"][0]["compasses"]:
        rows = {r["name"]: r for r in compass["estimators"]}
        assert rows["kalman"]["second_half"]["rms_deg"] < 10.0
        assert rows["kalman"]["offsets_mg"] is not None
        assert compass["reference"]
