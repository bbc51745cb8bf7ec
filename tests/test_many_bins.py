"""AT-14d: a folder of .bin files makes one table. How long a 60-minute .bin takes is in benchmarks/logs.py --hour."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from random import Random

import pytest
from dataflash_writer import flight

from magmav.cli import main

LOGS = ("2026/a.bin", "2026/deep/B.BIN", "c.bin")


def test_AT_14d_a_folder_of_bin_files_makes_one_table_with_every_log_in_it_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "logs" / "2026" / "deep").mkdir(parents=True)
    for number, name in enumerate(LOGS):
        log = flight(12.0, start_s=5.0 + number, offset_mg=10.0 * number, turn_rads=0.5 + 0.1 * number)
        (tmp_path / "logs" / name).write_bytes(log.binary())
    (tmp_path / "logs" / "noise.bin").write_bytes(Random(3).randbytes(4000))
    (tmp_path / "logs" / "notes.txt").write_text("no log")
    monkeypatch.chdir(tmp_path)
    assert main(["fit", "logs", "--out", "out", "--jobs", "1"]) == 0
    said = capsys.readouterr()
    assert said.err.startswith("magmav: logs/noise.bin: ") and said.err.count("\n") == 1

    paths = [f"logs/{name}" for name in LOGS]
    table = json.loads(Path("out/fits.json").read_text())
    assert table["logs"] == len(LOGS) and [error["path"] for error in table["errors"]] == ["logs/noise.bin"]
    (vehicle,) = table["vehicles"]
    assert vehicle["system"] == 7 and [c["device_id"] for c in vehicle["compasses"]] == [97539, 131874]
    for compass in vehicle["compasses"]:
        assert sorted(row["path"] for row in compass["logs"]) == paths

    rows = list(csv.DictReader(Path("out/fits.csv").read_text().splitlines()))
    assert len(rows) == 2 * len(LOGS)
    page = Path("out/fits.html").read_text()
    for path in paths:
        assert sorted(row["device_id"] for row in rows if row["path"] == path) == ["131874", "97539"]
        report = f"out/logs/{Path(path).stem}-"
        (written,) = [str(p) for p in Path("out/logs").glob("*.html") if str(p).startswith(report)]
        assert f'href="{Path(written).relative_to("out")}"' in page and path in page
