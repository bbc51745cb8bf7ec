"""Tables: what the JSON says, in words, and nothing it does not say."""

import copy

import pytest

from magmav.core.types import UploadResult
from magmav.view.table import RESULTS, demo_view, history_view, replay_view, summary_view, to_text

COMPASS = {
    "compass": 2,
    "device_id": 97539,
    "offsets_mg": [-310.04, 140.26, -220.0],
    "stored": {"COMPASS_OFS2_X": 12.5, "COMPASS_OFS2_Y": -3.0},
    "hard_iron_mg": [310.04, -140.26, 220.0],
    "sigma_mg": [2.04, 3.1, 24.7],
    "axes": ["OBSERVED", "FROM_MODEL", "NOT_OBSERVED"],
    "state": "LEARNING",
    "reasons": [{"code": "Z_NOT_OBSERVED", "text": "down axis not observed: bank or pitch the vehicle"}],
    "heading": {
        "reference": "file truth.csv",
        "rms_deg": 3.21,
        "p95_deg": 6.54,
        "bias_deg": -0.75,
        "uncalibrated_rms_deg": 96.78,
        "uncalibrated_bias_deg": 12.25,
        "stored_rms_deg": 41.5,
        "stored_bias_deg": 8.5,
        "sigma_deg": 2.5,
        "n": 18359,
        "from_s": 220.0,
        "to_s": 588.0,
        "excluded": {"disarmed": 123},
    },
    "heading_offsets_only": {"reference": "file truth.csv", "rms_deg": 4.32},
    "samples": 20000,
}
RESULT = {
    "source": "thor75.tlog",
    "vehicles": [{"system": 7, "autopilot": 3, "compasses": [COMPASS]}],
    "counts": {"codec": {"bad crc": 3, "unknown": 0, "skipped": 2}, "link": {}, "late": 4, "early": 0},
}


def changed(**compass):
    out = copy.deepcopy(RESULT)
    out["vehicles"][0]["compasses"][0].update(compass)
    return out


def text_of(result):
    return to_text(replay_view(result), width=120)


def test_a_recordings_table_says_what_the_json_says():
    text = text_of(RESULT)
    rows = {line.split()[0]: line for line in text.splitlines() if line.strip()[:2] in ("x ", "y ", "z ")}
    assert rows["x"].split() == ["x", "forward", "-310.0", "2.0", "observed"]
    assert rows["y"].split() == ["y", "right", "+140.3", "3.1", "from", "the", "field", "model"]
    assert rows["z"].split() == ["z", "down", "-220.0", "24.7", "not", "observed"]
    for words in (
        "thor75.tlog",
        "System 7, ArduPilot",
        "Compass 2 (device 97539): learning",
        "- down axis not observed: bank or pitch the vehicle",
        "Heading RMS against file truth.csv:",
        "uncalibrated 96.78, as stored 41.50 → corrected 3.21 deg (95 % within 6.54,",
        " within 6.54, one sigma claimed: 2.50)",
        "mean error: uncalibrated +12.25, as stored +8.50 → corrected -0.75 deg",
        "with an upload of offsets alone: 4.32 deg",
        "over 18359 samples, 220 to 588 s of boot time; left out: disarmed 123",
        "The autopilot holds: COMPASS_OFS2_X 12.5, COMPASS_OFS2_Y -3",
        "  codec: bad crc 3, skipped 2",
        "  late: 4",
    ):
        assert words in text
    assert (
        "unknown 0" not in text and "link" not in text and "early" not in text and "follows its own compass" not in text
    )


def test_what_is_null_is_not_known_and_never_a_number():
    nothing = {name: None for name in COMPASS if name not in ("compass", "state", "reasons")}
    text = text_of(changed(**nothing, state="NO_DATA", reasons=[]))
    assert "Compass 2 (device not known): no data" in text
    assert text.count("not known") == 12  # device, nine cells, what is stored, heading
    assert "None" not in text and " 0.0" not in text
    assert "Heading error: not known, there is no reference to measure it against" in text


def test_single_unknown_numbers_do_not_hide_the_known_ones():
    text = text_of(changed(offsets_mg=[1.0, None, 3.0], sigma_mg=[0.5, None, 0.5]))
    (line,) = [line for line in text.splitlines() if line.strip().startswith("y right")]
    assert line.split()[2:6] == ["not", "known", "not", "known"]
    unheld = {**COMPASS["heading"], "stored_rms_deg": None, "stored_bias_deg": None}
    assert "mean error: uncalibrated +12.25 → corrected -0.75 deg" in text_of(changed(heading=unheld))
    empty = {**COMPASS["heading"], "n": 0, "rms_deg": None, "from_s": None, "to_s": None}
    assert "against file truth.csv: no sample to score; left out: disarmed 123" in text_of(changed(heading=empty))


def test_a_change_relative_to_unknown_offsets_is_called_a_change():
    text = text_of(changed(offsets_mg=None, offsets_change_mg=[5.0, 6.0, 7.0]))
    assert "change of offset, mG" in text and "offset to store" not in text and "+6.0" in text


def test_yaw_that_follows_the_compass_is_called_so():
    for name, warned in (("ATTITUDE yaw", True), ("SIMSTATE yaw", False)):
        text = text_of(changed(heading={**COMPASS["heading"], "reference": name}))
        assert ("usually follows its own compass" in text) is warned
        assert f"against {name}" in text


def test_names_from_files_and_wires_cannot_draw_or_escape():
    text = text_of({**changed(stored={"[red]X[/red]": 1.0}), "source": "[bold]a\x1b[31m\x07.tlog"})
    assert text.splitlines()[0] == "[bold]a?[31m?.tlog"
    assert "[red]X[/red] 1" in text and "\x1b" not in text


def test_an_empty_recording_says_so():
    assert "System 7, autopilot 8" in text_of({"vehicles": [{"system": 7, "autopilot": 8}]})
    assert "no vehicle was seen" in text_of({"source": "x.bin", "vehicles": [], "counts": {}})
    bare = {"source": "x.bin", "vehicles": [{"system": 1, "autopilot": None, "compasses": []}]}
    assert "no compass was seen" in text_of(bare) and "no compass" in to_text(summary_view([bare]))


def test_many_recordings_make_one_table_with_a_row_per_compass():
    text = to_text(summary_view([RESULT, changed(heading=None, state="READY", sigma_mg=None)]), width=140)
    first, second = [line for line in text.splitlines() if "thor75" in line]
    assert "7/2" in first and "-310, +140, -220" in first and "2.0, 3.1, 24.7" in first
    assert "learning" in first and "96.78 → 3.21" in first and first.endswith("file truth.csv")
    assert "ready" in second and "not known → not known" in second and "96.78" not in second


def test_the_demo_shows_before_after_and_the_way_back():
    result = {
        "before": {"heading_rms_deg": 83.123},
        "after": {"heading_rms_deg": 0.714},
        "compasses": [
            {"offset_error_mg": [0.8, -0.4, 1.6]},
            {"offset_error_mg": 2.5},
            {"offset_error_mg": None},
        ],
        "upload": {"result": "ALL_NEW"},
        "restore": {"result": "ALL_OLD"},
        "wall_s": 21.5,
    }
    text = to_text(demo_view(result))
    (line,) = [line for line in text.splitlines() if "heading RMS" in line]
    assert line.split("against simulated truth")[1].split() == ["83.12", "deg", "0.71", "deg"]
    assert "Compass 1: offsets off the truth by +0.8, -0.4, +1.6 mG" in text
    assert "Compass 2: offsets off the truth by 2.50 mG" in text
    assert "Compass 3: offsets off the truth by not known mG" in text
    assert "Upload: ALL_NEW (all new values are in place and proven)" in text
    assert "Restore: ALL_OLD (all old values are in place)" in text
    text = to_text(demo_view({**result, "after": None, "upload": None}))
    assert "83.12 deg" in text and "Upload: not known" in text and "0.71" not in text


def test_every_way_a_write_can_end_has_words():
    assert set(RESULTS) == {r.name for r in UploadResult}


def test_history_shows_when_what_and_how_it_ended():
    entry = {
        "unix_s": 1_795_305_600.0,
        "system": 1,
        "compass": 1,
        "device_id": 97539,
        "action": "upload",
        "result": "ALL_NEW",
        "undone": True,
        "old": {"COMPASS_OFS_X": 0.0, "COMPASS_OFS_Y": 5.25},
        "new": {"COMPASS_OFS_X": -310.5, "COMPASS_OFS_Y": None},
    }
    text = to_text(history_view([entry, {**entry, "result": None, "undone": False}]), width=180)
    assert "2026-11-22 00:00:00" in text and "97539" in text and "upload" in text
    assert "COMPASS_OFS_X 0 → -310.5" in text and "COMPASS_OFS_Y 5.25 → not known" in text
    assert "proven); undone later" in text and "cut short" in text
    assert to_text(history_view([])) == "nothing was ever written\n"


@pytest.mark.parametrize("width", [60, 80, 120])
def test_no_line_is_wider_than_the_terminal(width):
    for view in (replay_view(RESULT), summary_view([RESULT])):
        assert max(map(len, to_text(view, width).splitlines())) <= width
