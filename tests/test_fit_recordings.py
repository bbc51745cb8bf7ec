"""magmav fit of real recordings; others' fits, truth files and stored values are the judge."""

import os
from pathlib import Path

import numpy as np
import pytest

import magmav

_DATA = Path(os.environ.get("MAGMAV_DATA", Path(__file__).parents[2] / "shared" / "data"))
pytestmark = [
    pytest.mark.flights,
    pytest.mark.skipif(not _DATA.is_dir(), reason="no real recordings here: set MAGMAV_DATA"),
]


@pytest.fixture(scope="module")
def log171():
    return magmav.fit(_DATA / "logs" / "log171.bin")["vehicles"][0]["compasses"]


def codes(parts):
    return [p["code"] for p in parts]


def test_log171_compass_3_is_within_7_5_degrees_of_the_ekf_yaw_after_fit(log171):
    heading = log171[2]["fit"]["heading"]
    assert heading["reference"] == "ATT yaw"
    assert heading["after"]["rms_deg"] <= 7.5 and heading["full"]["rms_deg"] <= 7.5
    assert heading["after"]["n"] > 800
    assert log171[2]["heading"]["rms_deg"] == heading["full"]["rms_deg"]
    assert "NEVER_CALIBRATED" in codes(log171[2]["fit"]["causes"]) and log171[2]["fit"]["odd_one_out"]


def test_log171_compass_2s_stored_calibration_is_named_as_wrong_and_compass_1s_is_not(log171):
    one, two = (c["fit"] for c in log171[:2])
    (cause,) = [c for c in two["causes"] if c["code"] == "STORED_WRONG"]
    assert "wrong calibration stored" in cause["text"] and "ATT yaw" in cause["text"]
    assert cause["figure"]["before_rms_deg"] > 2.5 * cause["figure"]["after_rms_deg"]
    assert not {"STORED_WRONG", "NEVER_CALIBRATED"} & set(codes(one["causes"]))


def test_log171_the_tumble_at_the_end_is_cut_by_itself(log171):
    for compass in log171:
        cuts = {c["code"]: c for c in compass["fit"]["cut"]}
        assert 235.0 < cuts["TUMBLE"]["from_s"] < cuts["CRASHED"]["from_s"] < 245.0
        assert compass["fit"]["span_s"][1] < cuts["TUMBLE"]["from_s"]


def test_esc_status_log_comes_back_to_within_10_mg_of_what_px4_had_stored():
    (compass,) = magmav.fit(_DATA / "logs" / "esc_status_log.ulg")["vehicles"][0]["compasses"]
    fit = compass["fit"]
    stored = [-1000.0 * compass["stored"][f"CAL_MAG0_{axis}OFF"] for axis in "XYZ"]
    assert fit["old_offsets_mg"] == pytest.approx(stored, abs=0.01)
    assert fit["new_offsets_mg"] == pytest.approx(stored, abs=10.0)
    assert "STORED_WRONG" not in codes(fit["causes"])


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "on_s", "off_s", "magnet_mg"),
    [
        ("broad32", 48.8, 104.8, (-61.0, 11.0, -583.0)),
        ("broad34", 55.0, 109.8, (-16.0, -4.0, -136.0)),
        ("broad36", 46.8, 108.5, (4.0, 2.0, 57.0)),
    ],
)
def test_a_magnet_taped_on_and_taken_off_is_found_and_placed(name, on_s, off_s, magnet_mg):
    """The step of each is that of the data set's optical truth; when it came and went shows in the raw field."""
    result = magmav.fit(_DATA / "flights" / f"{name}_imu.tlog")
    changes_s = result["vehicles"][0]["compasses"][0]["fit"]["changes_s"]
    assert all(min(abs(t - on_s), abs(t - off_s)) < 1.5 for t in changes_s)
    assert all(min(abs(t - at_s) for t in changes_s) < 1.0 for at_s in (on_s, off_s))
    (arrays,) = result.arrays.values()
    boot_s, iron = arrays["boot_s"], arrays["hard_iron_b_mg"]
    with_it, after = (np.median(iron[(boot_s > a) & (boot_s < b)], axis=0) for a, b in ((on_s, off_s), (off_s, 999.0)))
    assert with_it - after == pytest.approx(magnet_mg, abs=15.0)


@pytest.mark.long
def test_thor_fitted_on_its_first_half_keeps_3_3_degrees_on_the_second():
    flights = _DATA / "flights"
    options = magmav.FitOptions(heading_reference=str(flights / "thor75_truth.csv"))
    (compass,) = magmav.fit(flights / "thor75.tlog", options=options)["vehicles"][0]["compasses"]
    heading = compass["fit"]["heading"]
    assert heading["reference"] == "file thor75_truth.csv"
    assert heading["held_out"]["after"]["n"] > 8000
    assert heading["held_out"]["after"]["rms_deg"] <= 3.3
    assert {"HANDS", "GROUND"} <= set(codes(compass["fit"]["cut"]))
