"""What flights taught is remembered at landing and from logs, and its shadow says what applying it would have done."""

from __future__ import annotations

import json
import sqlite3
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flight_rig import IRON_MG, LEVEL, Flight
from magmav_sim import Simulation, parse_scenario
from many_rig import IRON, flown
from test_store_format import AXES, FORMAT_1, SAVED, old_file

from magmav.cli import main
from magmav.learnt import learnt_of_entry, shadows
from magmav.mavlink.uid import key
from magmav.store import Learnt, Store, StoreError
from magmav.store_rows import pack
from magmav.view.learnt import learnt_view
from magmav.view.table import to_text

pytestmark = pytest.mark.long  # whole flights

FORMAT_2 = (
    FORMAT_1.replace(
        "undone INTEGER NOT NULL DEFAULT 0\n", "undone INTEGER NOT NULL DEFAULT 0, boot_ms INTEGER, kept TEXT\n"
    )
    .replace("PRIMARY KEY (system, device_id)\n", "PRIMARY KEY (system, device_id, vehicle)\n")
    .replace("=1;", "=2;")
)
"""As the release before wrote it; never to be changed."""
ROW = Learnt(
    unix_ns=10**18, system=1, compass=1, device_id=97539, vehicle="1", source="fit", origin="a" * 64, name="a.bin",
    state="READY", reasons=("Z_FROM_MODEL",), axes=tuple(a.name for a in AXES), old_offsets_mg=(0.0, 0.0, 5.0),
    new_offsets_mg=(100.0, -50.0, 5.0), change_mg=(100.0, -50.0, 0.0), sigma_mg=(3.0, 4.0, 60.0),
    old={"COMPASS_OFS_X": 0.1}, new={"COMPASS_OFS_X": 100.1},
    card=((0.0, -20.0, 0.5), (45.0, None, None), (90.0, 7.0, -1.5)),
    heading={"reference": "ATT yaw", "before_rms_deg": 20.0, "after_rms_deg": 2.0},
)  # fmt: skip
DAY_NS = 86_400 * 10**9


# ------------------------------------------------------------ the store


def test_a_file_of_format_2_is_brought_up_to_date_and_nothing_of_it_is_lost(tmp_path: Path) -> None:
    path = tmp_path / "two.sqlite"
    db = sqlite3.connect(path)
    db.executescript(FORMAT_2)
    columns = "unix_ns, system, compass, device_id, vehicle, change, result, boot_ms, kept"
    row = (5, 1, 1, SAVED.change.device_id, "1", pack(SAVED.change), "ALL_NEW", 77, "PERSISTED")
    db.execute(f"INSERT INTO writes ({columns}) VALUES (?,?,?,?,?,?,?,?,?)", row)
    db.commit()
    db.close()
    with Store(path) as store, Store(path) as second:
        (write,) = store.history()
        assert (write.change, write.boot_ms, write.kept and write.kept.name) == (SAVED.change, 77, "PERSISTED")
        assert store.learnt() == []
        store.learn([ROW])
        assert [replace(r, id=0) for r in second.learnt()] == [ROW]


def test_a_file_of_format_1_learns_too(tmp_path: Path) -> None:
    old_file(path := tmp_path / "old.sqlite")
    with Store(path) as store:
        store.learn([ROW])
        assert len(store.learnt()) == 1 and len(store.history()) == 2
        assert store.latest_estimate(1, SAVED.change.device_id) == SAVED


def test_told_again_of_a_flight_the_newer_word_counts_and_nothing_is_doubled(tmp_path: Path) -> None:
    with Store(tmp_path / "s.sqlite") as store:
        others = [
            replace(ROW, origin="b" * 64), replace(ROW, source="live"), replace(ROW, system=2), replace(ROW, compass=2),
            replace(ROW, device_id=5), replace(ROW, vehicle=key(1, "00aa")),
        ]  # fmt: skip
        store.learn([ROW, *others])
        was = {r.id for r in store.learnt()}
        store.learn([better := replace(ROW, state="REFUSED", name="moved.bin")])
        assert {r.id for r in store.learnt()} == was and len(was) == 7
        assert better in [replace(r, id=0) for r in store.learnt()] and ROW not in [
            replace(r, id=0) for r in store.learnt()
        ]


def test_what_cannot_be_stored_leaves_nothing_of_it(tmp_path: Path) -> None:
    with Store(tmp_path / "s.sqlite") as store:
        with pytest.raises(ValueError, match="not JSON compliant"):
            store.learn([ROW, replace(ROW, system=2, sigma_mg=(float("nan"),) * 3)])
        assert store.learnt() == []
        store.learn([ROW])
    db = sqlite3.connect(tmp_path / "s.sqlite")
    db.execute("UPDATE learnt SET learnt='{}'")
    db.commit()
    db.close()
    with Store(tmp_path / "s.sqlite") as store, pytest.raises(StoreError, match="a row cannot be understood"):
        store.learnt()


# ------------------------------------------------------------ the shadow


def shadow(*rows: Learnt) -> list[Any]:
    """next_flight of each row, in the order of the rows."""
    entries = shadows([replace(row, id=i + 1) for i, row in enumerate(rows)])
    return [entry["would_have_changed"]["next_flight"] for entry in entries][::-1]


def test_the_next_flight_judges_what_was_learnt_beside_what_it_flew_with() -> None:
    later = replace(ROW, unix_ns=ROW.unix_ns + DAY_NS, new_offsets_mg=(96.0, -47.0, 9.0), sigma_mg=(4.0, 3.0, 8.0))
    first, last = shadow(ROW, later)
    assert first == {
        "id": 2, "unix_s": later.unix_ns / 1e9, "was_applied": False, "applied_off_mg": [4.0, -3.0, None],
        "stored_off_mg": [-96.0, 47.0, None], "sigma_mg": [5.0, 5.0, None],
    }  # fmt: skip
    assert last is None
    text = " ".join(to_text(learnt_view(shadows([ROW, later])), width=200).split())
    assert "it off by +4, -3, - mG" in text and "20.0 -> 1.5 deg" in text


def test_what_was_applied_is_said_to_have_been() -> None:
    later = replace(
        ROW, unix_ns=ROW.unix_ns + DAY_NS, old_offsets_mg=(100.2, -50.0, 80.0), new_offsets_mg=(101.0, -50.0, 5.0)
    )
    found = shadow(ROW, later)[0]
    assert found["was_applied"] and found["applied_off_mg"] == [-1.0, 0.0, None]


@pytest.mark.parametrize(
    "other",
    [
        {"unix_ns": ROW.unix_ns}, {"unix_ns": None}, {"state": "LEARNING"}, {"new_offsets_mg": None}, {"device_id": 5},
        {"system": 2}, {"source": "live"}, {"vehicle": key(2, "")},
    ],
)  # fmt: skip
def test_only_a_later_good_flight_of_this_very_compass_judges(other: dict[str, Any]) -> None:
    later = replace(ROW, unix_ns=ROW.unix_ns + DAY_NS)
    assert shadow(ROW, later)[0] is not None
    rows = sorted((ROW, replace(later, origin="b", **other)), key=lambda r: (r.unix_ns is not None, r.unix_ns or 0))
    assert shadow(*rows) == [None, None]


def test_S19_another_vehicle_with_the_same_ids_judges_nothing() -> None:
    a, b = replace(ROW, vehicle=key(1, "00aa")), replace(ROW, vehicle=key(1, "00bb"), unix_ns=ROW.unix_ns + DAY_NS)
    assert shadow(a, b) == [None, None]


# ------------------------------------------------------------ live


@pytest.fixture(scope="module")
def two_flights(tmp_path_factory: pytest.TempPathFactory) -> tuple[Flight, list[Learnt], list[Learnt], list[Learnt]]:
    """Up, down, up, down, and nothing ever uploaded; what was remembered in the air, between, and at the end."""
    pattern = LEVEL[LEVEL.index("[[flight]]") :]
    text = (LEVEL + pattern).format(seed=31).replace("stay = true\n", "")
    f = Flight(Simulation(parse_scenario(text.encode(), "twice.toml")), tmp_path_factory.mktemp("live"))
    f.fly(lambda: f.sim.autopilot.armed, 60.0)
    f.fly(seconds=12.0)
    aloft = f.store.learnt()
    f.fly(lambda: not f.sim.autopilot.armed, 300.0)
    f.fly(lambda: f.sim.autopilot.armed, 60.0)
    between = f.store.learnt()
    f.fly()
    return f, aloft, between, f.store.learnt()


def test_what_a_flight_taught_is_remembered_at_its_landing_and_once(
    two_flights: tuple[Flight, list[Learnt], list[Learnt], list[Learnt]],
) -> None:
    _, aloft, between, end = two_flights
    assert aloft == [] and len(between) == 1 and len(end) == 2 and end[0] == between[0]
    for row in end:
        assert (row.source, row.system, row.compass, row.device_id, row.state) == ("live", 1, 1, 97539, "READY")
        assert row.new_offsets_mg is not None and row.old_offsets_mg == (0.0, 0.0, 0.0)
        assert np.abs(np.add(row.new_offsets_mg, IRON_MG) / row.sigma_mg).max() < 4.0
        assert len(row.card) == 8 and set(row.new) == {"COMPASS_OFS_X", "COMPASS_OFS_Y", "COMPASS_OFS_Z"}
    one, two = (row.unix_ns or 0 for row in end)
    assert 30e9 < two - one < 300e9


def test_the_shadow_of_flights_says_that_applying_it_would_have_been_right(
    two_flights: tuple[Flight, list[Learnt], list[Learnt], list[Learnt]], capsys: pytest.CaptureFixture[str]
) -> None:
    f, *_ = two_flights
    assert main(["history", "--store", str(f.store.path), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["writes"] == [] and [e["unix_s"] for e in told["learnt"]] == sorted(
        (e["unix_s"] for e in told["learnt"]), reverse=True
    )
    changes = told["learnt"][1]["would_have_changed"]
    later = changes["next_flight"]
    assert later["id"] == told["learnt"][0]["id"] and later["was_applied"] is False
    assert np.linalg.norm(later["applied_off_mg"][:2]) < 10.0 < 150.0 < np.linalg.norm(later["stored_off_mg"][:2])
    assert changes["level_heading_error_deg"]["before"] > 30.0 > 3.0 > changes["level_heading_error_deg"]["after"]
    assert set(changes["parameters"]) == {"COMPASS_OFS_X", "COMPASS_OFS_Y", "COMPASS_OFS_Z"}
    assert main(["history", "--store", str(f.store.path), "--limit", "1"]) == 0
    text = capsys.readouterr().out
    assert "nothing was ever written" in text and text.count("READY") == 1


# ------------------------------------------------------------ from logs


def test_fit_with_a_store_remembers_each_log_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, store = tmp_path / "a.tlog", tmp_path / "s.sqlite"
    log.write_bytes(flown(0, seed=1))
    for _ in range(2):
        assert main(["fit", str(log), "--store", str(store), "--json"]) == 0
        entry = json.loads(capsys.readouterr().out)["logs"][0]
    (learnt,) = learnt_of_entry(entry)
    with Store(store) as held:
        (row,) = held.learnt()
    assert replace(row, id=0) == learnt and row.origin == entry["file"]["sha256"] and row.name == str(log)
    assert row.new_offsets_mg is not None and np.abs(np.add(row.new_offsets_mg, IRON)[:2]).max() < 12.0
    assert main(["history", "--store", str(store), "--json"]) == 0
    (told,) = json.loads(capsys.readouterr().out)["learnt"]
    assert told["recording"] == str(log) and told["heading"]["reference"] == "ATTITUDE yaw"
