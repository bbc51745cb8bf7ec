"""The real recordings: what a replay says of them must be right, and what cannot be known must be said."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from magmav.cli import main
from magmav.commands.common import finite
from magmav.geomag import world_magnetic_model
from magmav.recording import open_recording, replay
from magmav.settings import Settings

_DATA = Path(os.environ.get("MAGMAV_DATA", Path(__file__).parents[2] / "shared" / "data"))
pytestmark = [
    pytest.mark.flights,
    pytest.mark.skipif(not (_DATA / "flights").is_dir(), reason="no real recordings: set MAGMAV_DATA"),
]
_SECONDS = 120.0


def in_process(name, **options):
    link = open_recording(_DATA / name)
    try:
        return replay(link, Settings(), world_magnetic_model, source=str(_DATA / name), **options)
    finally:
        link.close()


def command_line(*words):
    """(exit code, standard output) of the program in a process of its own."""
    command = [sys.executable, "-m", "magmav.cli", *(str(w) for w in words)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=_SECONDS, check=False)
    assert "Traceback" not in done.stderr
    return done.returncode, done.stdout


def codes(compass):
    return {r["code"] for r in compass["reasons"]}


@pytest.mark.long
def test_thor_frozen_after_a_minute_keeps_its_heading_and_repeats_byte_for_byte():
    here = in_process("flights/thor75.tlog", learn_for_s=60.0)
    code, text = command_line("replay", _DATA / "flights/thor75.tlog", "--learn-for", 60, "--json")
    assert code == 0
    assert text == json.dumps(finite(here)) + "\n"
    (compass,) = here["vehicles"][0]["compasses"]
    heading = compass["heading"]
    assert heading["rms_deg"] <= 3.4
    assert heading["uncalibrated_rms_deg"] > 90.0
    assert heading["reference"] == "ATTITUDE yaw"
    assert heading["n"] > 10_000 and heading["from_s"] > 280.0
    assert compass["state"] == "READY"
    assert compass["axes"][:2] == ["OBSERVED", "OBSERVED"]
    # An attitude-aided fit of the whole flight, made by others (data/README.md).
    assert np.abs(-np.array(compass["offsets_mg"]) - (389, -162, 395)).max() < 25.0
    assert compass["device_id"] == 97539 and not compass["relative"]


@pytest.mark.long
def test_thor_half_a_minute_is_enough_for_what_it_claims():
    (compass,) = in_process("flights/thor75.tlog", learn_for_s=30.0)["vehicles"][0]["compasses"]
    assert compass["heading"]["rms_deg"] <= 5.0
    error = np.abs(np.array(compass["hard_iron_mg"]) - (389, -162, 395))
    assert compass["state"] != "READY" or (error <= 3.5 * np.array(compass["sigma_mg"])).all()


def with_last_records(name):
    """The result, the last Record of each compass, and the boot times in s of what each compass learnt from."""
    last, learnt = {}, {}

    def watch(reading, record):
        if record is not None:
            last[record.compass] = record
            if record.learnt:
                learnt.setdefault(record.compass, []).append(record.boot_ns / 1e9)

    return in_process(name, watchers=[watch]), last, learnt


def last_change_s(path, stem):
    """Boot time in s of the last PARAM_VALUE that changed a COMPASS_OFS of compass 1, read with pymavlink's own
    parser, and times taken from the ATTITUDE before it."""
    from pymavlink.dialects.v20 import ardupilotmega as dialect

    data, at, boot_s, held, changed_s = path.read_bytes(), 0, 0.0, {}, None
    mav = dialect.MAVLink(None)
    while at + 8 < len(data):
        head = data[at + 8 : at + 11]
        size = 12 + head[1] + 13 * (head[2] & 1) if head[0] == 0xFD else 8 + head[1]
        message = mav.decode(bytearray(data[at + 8 : at + 8 + size]))
        at += 8 + size
        if message.get_type() == "ATTITUDE":
            boot_s = message.time_boot_ms / 1e3
        elif message.get_type() == "PARAM_VALUE" and message.param_id.startswith(stem):
            if held.get(message.param_id, message.param_value) != message.param_value:
                changed_s = boot_s
            held[message.param_id] = message.param_value
    return changed_s, held


def check_compass_1(name):
    path = _DATA / name
    changed_s, held = last_change_s(path, "COMPASS_OFS_")
    assert changed_s is not None and [held[f"COMPASS_OFS_{a}"] for a in "XYZ"] == [5.0, 13.0, -18.0]
    result, last, learnt = with_last_records(name)
    first, second, third = result["vehicles"][0]["compasses"]
    after = sum(boot_s > changed_s for boot_s in learnt[1])
    assert 0 < last[1].estimate.samples <= after  # nothing from before the change is in the answer
    off = np.abs(np.array(first["offsets_mg"]) - (5, 13, -18))
    seen = [a == "OBSERVED" for a in first["axes"]]
    assert first["axes"][:2] == ["OBSERVED", "OBSERVED"]
    assert off[seen].max() <= 15.0
    assert {"PARAMETERS_CHANGED", "ASSUMED_DEFAULT"} <= codes(first)
    for other in (second, third):
        assert other["relative"] and other["offsets_mg"] is None and other["hard_iron_mg"] is None
        assert other["state"] != "READY"
        assert {"RELATIVE_ONLY", "ASSUMED_DEFAULT"} <= codes(other)
        # The simulated compasses are right as they are: nothing is to be changed.
        change = np.abs(np.array(other["offsets_change_mg"]))
        assert (change <= 3.5 * np.array(other["sigma_mg"])).all()
    return result


@pytest.mark.long
def test_copter_figure_eight_does_not_mix_what_was_changed_with_what_is():
    result = check_compass_1("sitl/copter-fig8.tlog")
    assert result["vehicles"][0]["compasses"][0]["heading"]["rms_deg"] < 3.0


@pytest.mark.long
def test_plane_circles_the_same_on_a_plane():
    result = check_compass_1("sitl/plane-circles.tlog")
    assert result["vehicles"][0]["compasses"][0]["heading"]["rms_deg"] < 5.0


@pytest.fixture
def broad32(capsys, tmp_path):
    """Through the command's own entry: a truth file, a look every five seconds, every record kept."""
    words = ["--json", "--every", "5", "--reference", _DATA / "flights/broad32_truth.csv"]
    words += ["--records", tmp_path / "records.csv"]
    assert main(["replay", str(_DATA / "flights/broad32_imu.tlog"), *map(str, words)]) == 0
    with (tmp_path / "records.csv").open(newline="") as file:
        return json.loads(capsys.readouterr().out), list(csv.DictReader(file))


@pytest.mark.long
def test_broad32_says_what_it_cannot_know_and_follows_the_magnet(broad32):
    result, records = broad32
    (compass,) = result["vehicles"][0]["compasses"]
    assert {"NO_ATTITUDE", "NO_POSITION"} <= codes(compass)
    # No position, so no declination: a true heading is never claimed, and the score says what it compared.
    assert len(records) > 8000
    assert {r["heading_true_deg"] for r in records} == {r["stored_heading_true_deg"] for r in records} == {""}
    assert any(r["heading_deg"] for r in records)
    assert "file broad32_truth.csv" in compass["heading"]["reference"]
    assert "magnetic" in compass["heading"]["reference"]
    assert compass["heading"]["rms_deg"] < 0.6 * compass["heading"]["uncalibrated_rms_deg"]
    rows = result["timeline"]
    # Magnet on from 47 to 105 s: (-61, 11, -583) mG, so offsets are minus that; gone afterwards (data/README.md).
    on = next(r for r in rows if r["boot_s"] >= 99.0)
    assert on["boot_s"] < 104.0
    assert np.abs(np.array(on["offsets_mg"]) - (61, -11, 583)).max() <= 20.0
    assert np.abs(np.array(compass["offsets_mg"])).max() <= 20.0
    during = [r for r in rows if 106.0 < r["boot_s"] < 112.0]
    assert during and all(r["state"] != "READY" for r in during)  # the old answer was withdrawn
