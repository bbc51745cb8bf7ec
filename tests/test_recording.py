"""A recording through the service's own loop: the same answer as live, frozen when told, and honest about gaps."""

from __future__ import annotations

import numpy as np
import pytest
from flight_rig import IRON_MG, Flight, staying

from magmav.core.types import Record
from magmav.geomag import world_magnetic_model
from magmav.link.recorder import TlogRecorder
from magmav.logs import LogError
from magmav.recording import NothingToLearnFrom, open_recording, replay
from magmav.settings import Settings

# The contract of DESIGN.md: these keys stay.
_COMPASS_KEYS = {
    "compass", "device_id", "offsets_mg", "stored", "hard_iron_mg", "sigma_mg", "axes", "state", "reasons", "heading",
    "heading_offsets_only", "samples",
}  # fmt: skip
_HEADING_KEYS = {"reference", "rms_deg", "p95_deg", "uncalibrated_rms_deg", "sigma_deg", "n", "from_s", "to_s"}


class Recorded:
    """A flight that was recorded while the service learnt from it."""

    def __init__(self, folder):
        self.path = folder / "flight.tlog"
        f = Flight(staying(), folder)
        link = TlogRecorder(f.link, self.path)
        f.service.link, f._packets = link, link.packets()
        f.land()
        f.end()
        link.close()
        self.live = f.last()
        self.samples = len(f.records)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    return Recorded(tmp_path_factory.mktemp("recorded"))


def again(recorded, data=None, **options):
    """(result, records) of a replay, or of a replay of these bytes."""
    path = recorded.path
    if data is not None:
        path = path.with_name("part.tlog")
        path.write_bytes(data)
    records: list[Record] = []
    options.setdefault("watchers", [lambda reading, record: None if record is None else records.append(record)])
    link = open_recording(path)
    try:
        return replay(link, Settings(), world_magnetic_model, source="x", **options), records
    finally:
        link.close()


def without(recorded, *numbers):
    """The recording less some messages, by number."""
    data, kept, at = recorded.path.read_bytes(), bytearray(), 0
    while at < len(data):
        size = 8 + 12 + data[at + 9] + 13 * (data[at + 10] & 1)
        if int.from_bytes(data[at + 15 : at + 18], "little") not in numbers:
            kept += data[at : at + size]
        at += size
    return bytes(kept)


@pytest.mark.long
def test_replay_knows_what_live_knew(recorded):
    result, records = again(recorded)
    assert len(records) == recorded.samples
    last = records[-1]
    assert last.boot_ns == recorded.live.boot_ns
    assert last.estimate.hard_iron_b_mg == pytest.approx(recorded.live.estimate.hard_iron_b_mg, abs=1e-6)
    assert last.verdict == recorded.live.verdict
    (compass,) = result["vehicles"][0]["compasses"]
    assert np.abs(np.array(compass["offsets_mg"]) + IRON_MG).max() <= 3.5 * max(compass["sigma_mg"])
    assert compass["stored"]["COMPASS_OFS_X"] == 0.0 and compass["device_id"] == 97539


def test_result_has_the_keys_that_others_rely_on(recorded):
    result, _ = again(recorded)
    assert {"source", "vehicles", "counts"} <= set(result)
    (vehicle,) = result["vehicles"]
    assert vehicle["system"] == 1 and vehicle["autopilot"] == 3
    (compass,) = vehicle["compasses"]
    assert set(compass) >= _COMPASS_KEYS
    assert set(compass["heading"]) >= _HEADING_KEYS and set(compass["heading_offsets_only"]) >= _HEADING_KEYS


@pytest.mark.long
def test_freezing_stops_learning_at_that_second_after_take_off(recorded):
    whole, _ = again(recorded)
    result, records = again(recorded, learn_for_s=20.0)
    learnt = [r for r in records if r.learnt]
    assert 0.0 < (learnt[-1].boot_ns - learnt[0].boot_ns) / 1e9 <= 20.0
    end = learnt[-1].boot_ns
    after = [r.estimate.hard_iron_b_mg for r in records if r.boot_ns > end + 1e9]
    assert len(after) > 50 and all((a == after[0]).all() for a in after)
    (compass,) = result["vehicles"][0]["compasses"]
    assert compass["heading"]["from_s"] >= end / 1e9
    assert compass["samples_learnt"] < whole["vehicles"][0]["compasses"][0]["samples_learnt"]


def test_without_the_stored_offsets_the_answer_is_relative(recorded):
    result, _ = again(recorded, without(recorded, 22))  # PARAM_VALUE
    (compass,) = result["vehicles"][0]["compasses"]
    assert compass["offsets_mg"] is None and compass["hard_iron_mg"] is None and compass["relative"]
    assert compass["device_id"] is None and compass["state"] != "READY"
    assert np.abs(np.array(compass["offsets_change_mg"]) + IRON_MG).max() <= 3.5 * max(compass["sigma_mg"])
    assert {"RELATIVE_ONLY", "ASSUMED_DEFAULT"} <= {r["code"] for r in compass["reasons"]}


def test_without_a_position_no_true_heading_is_claimed(recorded):
    result, records = again(recorded, without(recorded, 24, 33))  # GPS_RAW_INT, GLOBAL_POSITION_INT
    assert not any(r.heading.true_valid or r.stored_heading.true_valid for r in records)
    (compass,) = result["vehicles"][0]["compasses"]
    assert "NO_POSITION" in {r["code"] for r in compass["reasons"]}
    assert "magnetic" in compass["heading"]["reference"]


def test_without_attitude_there_is_nothing_to_score_against_and_it_says_so(recorded):
    result, _ = again(recorded, without(recorded, 30))
    (compass,) = result["vehicles"][0]["compasses"]
    assert compass["heading"] is None and compass["heading_offsets_only"] is None
    assert "NO_ATTITUDE" in {r["code"] for r in compass["reasons"]}


def test_without_magnetometer_messages_the_error_says_what_was_found(recorded):
    with pytest.raises(NothingToLearnFrom, match=r"ATTITUDE.*RAW_IMU"):
        again(recorded, without(recorded, 26, 27, 116, 129, 105))


def test_what_flies_but_never_took_off_learns_nothing(recorded):
    data, at = recorded.path.read_bytes(), 0
    start = int.from_bytes(data[:8], "big")
    while int.from_bytes(data[at : at + 8], "big") - start < 7_000_000:
        at += 8 + 12 + data[at + 9] + 13 * (data[at + 10] & 1)
    result, records = again(recorded, data[:at])
    assert records and not any(r.learnt for r in records)
    (compass,) = result["vehicles"][0]["compasses"]
    assert compass["offsets_mg"] is None and compass["sigma_mg"] is None
    assert "NOT_FLYING" in {r["code"] for r in compass["reasons"]}


def a_text_log():
    """The least a text log may hold."""
    return b"FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\nFMT, 130, 45, PARM, QNf, TimeUS,Name,Value\n"


@pytest.mark.parametrize(
    ("name", "front"),
    [
        ("plain.txt", b""),
        ("named.tlog", b""),
        ("greeting.log", b"Mission log of 12 March\r\n"),
        ("marked.log", b"\xef\xbb\xbf"),
    ],
)
def test_a_log_is_known_by_its_content_whatever_it_is_called(tmp_path, name, front):
    path = tmp_path / name
    path.write_bytes(front + a_text_log())
    recording = open_recording(path)
    assert type(recording).__name__ == "DataflashRecording"
    recording.close()


def test_a_directory_is_refused_with_every_kind_of_file_it_may_hold(tmp_path):
    with pytest.raises(LogError, match=r"\.tlog, \.bin, \.log or \.ulg"):
        open_recording(tmp_path)
