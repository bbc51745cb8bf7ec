"""Records on disk: what is written is what was known, and reading gives it back."""

import json
import math
import os
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from magmav.core.types import AxisState, Estimate, Heading, Reason, Record, State, Verdict, vec3
from magmav.view.records import COLUMNS, RecordWriter, ViewError, read_records, row

UNKNOWN = Heading(False, False, 0.0, 0.0, 0.0)


def make(seed: int = 0, **changes: object) -> Record:
    """A record of a compass that is learning, with awkward decimals."""
    rng = np.random.default_rng(seed)

    def v(size: float) -> np.ndarray:
        return vec3(rng.normal(0, size, 3), "v")

    age = {"age_s": 0.02} if "age_s" in Record.__slots__ else {}  # a field on its way in
    estimate = Estimate(v(300), np.eye(3), v(5), 200.0, 400.0, 3.0, 1.0, 100, 1e9)
    out = Record(
        t_ns=1_700_000_000_123_456_789 + seed * 20_000_000,
        system=1,
        compass=2,
        device_id=97539,
        boot_ns=12_345_678_901 + seed * 20_000_000,
        mag_b_mg=v(400),
        corrected_b_mg=vec3((300.0, 400.0, 0.0), "c"),
        stored_b_mg=v(400),
        roll_rad=0.1,
        pitch_rad=-0.2,
        estimate=estimate,
        offsets_mg=v(300),
        sigma_mg=v(5),
        heading=Heading(True, True, math.radians(-10), math.radians(350.5), math.radians(1.25)),
        stored_heading=Heading(True, False, math.radians(720.25), 0.0, 0.1),
        verdict=Verdict(
            State.LEARNING,
            (AxisState.OBSERVED, AxisState.FROM_MODEL, AxisState.NOT_OBSERVED),
            (Reason.Z_NOT_OBSERVED, Reason.STILL_MOVING),
        ),
        learnt=True,
        **age,
    )
    return replace(out, **changes)


def unknown_things() -> list[Record]:
    nothing = Verdict(State.NO_DATA, (AxisState.NOT_OBSERVED,) * 3, ())
    unlearnt = replace(make(2).estimate, samples=0)
    sigma = np.array([1.5, math.inf, math.nan])
    return [
        make(1, device_id=0, heading=UNKNOWN, stored_heading=UNKNOWN, sigma_mg=sigma),
        make(2, verdict=nothing, estimate=unlearnt),
    ]


@pytest.mark.parametrize("name", ["r.jsonl", "r.json", "r.csv"])
def test_reading_back_gives_what_was_written(tmp_path, name):
    records = [make(i) for i in range(20)] + unknown_things()
    with RecordWriter(tmp_path / name) as out:
        for record in records:
            out.write(record)
    assert out.written == 22
    back = list(read_records(tmp_path / name))
    assert back == [row(r) for r in records]
    assert [type(v) for v in back[0].values()] == [type(v) for v in row(records[0]).values()]


def test_a_row_says_what_the_record_says():
    record = make(3)
    got = row(record)
    assert list(got) == [c.name for c in COLUMNS]
    for i, axis in enumerate("xyz"):
        assert got[f"mag_{axis}_mg"] == pytest.approx(record.mag_b_mg[i], abs=5.1e-5)
        assert got[f"offsets_{axis}_mg"] == pytest.approx(record.offsets_mg[i], abs=5.1e-5)
        assert got[f"sigma_{axis}_mg"] == pytest.approx(record.sigma_mg[i], abs=5.1e-5)
    assert got["boot_s"] == pytest.approx(12.405678901, abs=1e-6)
    assert got["t_s"] == pytest.approx(1_700_000_000.183457, abs=1e-6)
    assert (got["heading_deg"], got["heading_true_deg"], got["heading_sigma_deg"]) == (350.0, 350.5, 1.25)
    assert (got["stored_heading_deg"], got["stored_heading_true_deg"]) == (0.25, None)
    assert (got["roll_deg"], got["pitch_deg"]) == (5.7296, -11.4592)
    assert got["corrected_norm_mg"] == 500.0
    assert (got["state"], got["learnt"], got["device_id"]) == ("LEARNING", True, 97539)
    assert got["axes"] == ["OBSERVED", "FROM_MODEL", "NOT_OBSERVED"]
    assert got["reasons"] == ["Z_NOT_OBSERVED", "STILL_MOVING"]


def test_a_heading_just_under_north_is_zero_and_never_360():
    assert row(make(heading=Heading(True, True, -1e-12, 2 * math.pi - 1e-9, 0.1)))["heading_deg"] == 0.0
    assert row(make(heading=Heading(True, True, -1e-12, 2 * math.pi - 1e-9, 0.1)))["heading_true_deg"] == 0.0


def test_a_heading_without_declination_is_magnetic_only():
    got = row(make(heading=Heading(True, False, 1.0, 2.0, 0.1), stored_heading=Heading(True, True, 1.0, 2.0, 0.1)))
    assert (got["heading_deg"], got["heading_true_deg"]) == (57.2958, None)
    assert (got["stored_heading_deg"], got["stored_heading_true_deg"]) == (57.2958, 114.5916)


def test_what_is_not_known_is_none_and_never_zero():
    blind, empty = map(row, unknown_things())
    for name in ("device_id", "heading_deg", "heading_true_deg", "heading_sigma_deg", "stored_heading_deg"):
        assert blind[name] is None, name
    assert (blind["sigma_x_mg"], blind["sigma_y_mg"], blind["sigma_z_mg"]) == (1.5, None, None)
    for name in ("offsets_x_mg", "sigma_z_mg", "corrected_norm_mg"):
        assert empty[name] is None, name
    assert empty["mag_x_mg"] is not None and empty["reasons"] == []


def test_the_text_has_null_or_empty_cells(tmp_path):
    for name in ("u.jsonl", "u.csv"):
        with RecordWriter(tmp_path / name) as out:
            out.write(unknown_things()[0])
    assert json.loads((tmp_path / "u.jsonl").read_text())["heading_deg"] is None
    header, line = (tmp_path / "u.csv").read_text().splitlines()
    cells = dict(zip(header.split(","), line.split(","), strict=True))
    assert cells["heading_deg"] == "" and cells["learnt"] == "true"
    assert cells["axes"] == "OBSERVED FROM_MODEL NOT_OBSERVED"
    assert "nan" not in line.lower() and "inf" not in line.lower()


def test_every_line_is_on_disk_as_soon_as_it_is_written(tmp_path):
    with RecordWriter(tmp_path / "live.jsonl") as out:
        for count in range(1, 4):
            out.write(make(count))
            assert len(list(read_records(tmp_path / "live.jsonl"))) == count


def test_a_killed_run_leaves_whole_lines(tmp_path):
    program = (
        "import sys; sys.path.insert(0, sys.argv[2])\n"
        "from test_records import make; from magmav.view.records import RecordWriter\n"
        "out = RecordWriter(sys.argv[1]); record = make()\n"
        "for i in range(50): out.write(record)\n"
        "print('half way', flush=True)\n"
        "while True: out.write(record)\n"
    )
    path = tmp_path / "killed.csv"
    args = [sys.executable, "-c", program, str(path), os.path.dirname(__file__)]
    with subprocess.Popen(args, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None and child.stdout.readline() == b"half way\n"
        child.send_signal(signal.SIGKILL)
    rows = list(read_records(path))
    assert len(rows) >= 50 and rows[0] == rows[-1] == row(make())


def test_a_torn_last_line_is_forgiven_and_a_torn_middle_is_named(tmp_path):
    path = tmp_path / "torn.jsonl"
    with RecordWriter(path) as out:
        for i in range(3):
            out.write(make(i))
    whole = path.read_bytes()
    path.write_bytes(whole[:-40])
    assert list(read_records(path)) == [row(make(0)), row(make(1))]
    lines = whole.splitlines(keepends=True)
    path.write_bytes(lines[0] + lines[1][:50] + b"\n" + lines[2])
    with pytest.raises(ViewError, match=r"torn\.jsonl, line 2"):
        list(read_records(path))


def test_a_bad_cell_is_named_by_file_line_and_column(tmp_path):
    path = tmp_path / "bad.csv"
    with RecordWriter(path) as out:
        out.write(make())
    path.write_text(path.read_text().replace(",97539,", ",seven,"))
    with pytest.raises(ViewError, match=r"bad\.csv, line 2, column device_id: cannot read 'seven'"):
        list(read_records(path))


def test_a_name_that_cannot_be_written_is_refused_by_name(tmp_path):
    with pytest.raises(ViewError, match=r"no/such/dir.*No such file or directory"):
        RecordWriter(tmp_path / "no/such/dir/r.csv")
    with pytest.raises(ViewError, match=r"r\.txt: records want a name ending in"):
        RecordWriter(tmp_path / "r.txt")
    (tmp_path / "d.csv").mkdir()
    with pytest.raises(ViewError, match=r"d\.csv.*directory"):
        RecordWriter(tmp_path / "d.csv")


def test_another_kind_of_file_is_never_overwritten_but_an_earlier_record_file_is(tmp_path):
    truth = tmp_path / "truth.csv"
    truth.write_text("boot_time_s,roll_deg,pitch_deg,heading_true_deg\n1,2,3,4\n")
    with pytest.raises(ViewError, match=r"truth\.csv: exists and holds no records"):
        RecordWriter(truth)
    assert truth.read_text().endswith("1,2,3,4\n")
    mine = tmp_path / "mine.csv"
    for count in (3, 1):
        with RecordWriter(mine) as out:
            for i in range(count):
                out.write(make(i))
    assert list(read_records(mine)) == [row(make(0))]


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full here")
def test_a_full_disk_is_an_error_that_names_the_file(tmp_path):
    path = tmp_path / "full.jsonl"
    path.symlink_to("/dev/full")
    with RecordWriter(path) as out, pytest.raises(ViewError, match=r"full\.jsonl.*No space left"):
        out.write(make())


def test_a_disk_that_fills_up_in_the_middle_of_a_line_leaves_whole_lines(tmp_path):
    program = (
        "import resource, sys; sys.path.insert(0, sys.argv[2])\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))\n"
        "from test_records import make; from magmav.view.records import RecordWriter, ViewError\n"
        "out = RecordWriter(sys.argv[1])\n"
        "try:\n"
        "    while True: out.write(make())\n"
        "except ViewError as error: print(out.written, error)\n"
    )
    path = tmp_path / "short.jsonl"
    args = [sys.executable, "-c", program, str(path), os.path.dirname(__file__)]
    said = subprocess.run(args, capture_output=True, text=True, check=True).stdout
    assert "short.jsonl: cannot write records: File too large" in said
    assert path.read_bytes().endswith(b"\n") and path.stat().st_size > 1000
    assert len(list(read_records(path))) == int(said.split()[0])


def test_writing_after_close_is_a_wrong_call(tmp_path):
    out = RecordWriter(tmp_path / "c.csv")
    out.close()
    out.close()
    with pytest.raises(ValueError, match="already closed"):
        out.write(make())
