"""A store of an older format becomes a new one without losing a bit; one vehicle's rows never serve another."""

from __future__ import annotations

import json
import sqlite3
from dataclasses import replace
from pathlib import Path

import pytest
from test_store import CHANGE, upload

from magmav.core.types import AxisState, Reason, State, UploadResult, Verdict
from magmav.mavlink.kept import Keeping
from magmav.mavlink.uid import has_uid, key, may_be_same
from magmav.store import SavedEstimate, Store, StoreError
from magmav.store_rows import pack

FORMAT_1 = """
CREATE TABLE writes (
    id INTEGER PRIMARY KEY, unix_ns INTEGER NOT NULL, system INTEGER NOT NULL, compass INTEGER NOT NULL,
    device_id INTEGER NOT NULL, vehicle TEXT NOT NULL, change TEXT NOT NULL,
    undoes INTEGER REFERENCES writes(id), result TEXT, reasons TEXT NOT NULL DEFAULT '[]',
    settled INTEGER NOT NULL DEFAULT 0, undone INTEGER NOT NULL DEFAULT 0
);
CREATE TABLE estimates (
    system INTEGER NOT NULL, device_id INTEGER NOT NULL, unix_ns INTEGER NOT NULL, vehicle TEXT NOT NULL,
    change TEXT NOT NULL, verdict TEXT NOT NULL, offsets_mg TEXT NOT NULL, sigma_mg TEXT NOT NULL,
    PRIMARY KEY (system, device_id)
);
PRAGMA user_version=1;
"""
"""As the first release wrote it; never to be changed."""
AXES = (AxisState.OBSERVED, AxisState.FROM_MODEL, AxisState.NOT_OBSERVED)
VERDICT = Verdict(State.READY, AXES, (Reason.Z_FROM_MODEL,))
SAVED = SavedEstimate(7, "1", CHANGE, VERDICT, (65.7, 1e-7, -300.3), (1.5, 2.5, 9.0))
A, B = key(1, "00aa"), key(1, "00bb")


def old_file(path: Path) -> None:
    """What format 1 left: a whole write, one that was cut short, and an estimate."""
    db = sqlite3.connect(path)
    db.executescript(FORMAT_1)
    row = (5, 1, 1, CHANGE.device_id, "1", pack(CHANGE))
    columns = "unix_ns, system, compass, device_id, vehicle, change"
    db.execute(f"INSERT INTO writes ({columns}, result) VALUES (?,?,?,?,?,?,'ALL_NEW')", row)
    db.execute(f"INSERT INTO writes ({columns}) VALUES (?,?,?,?,?,?)", row)
    verdict = {"state": "READY", "axes": [a.name for a in AXES], "reasons": ["Z_FROM_MODEL"]}
    held = (1, CHANGE.device_id, 7, "1", pack(CHANGE), *map(json.dumps, (verdict, SAVED.offsets_mg, SAVED.sigma_mg)))
    db.execute("INSERT INTO estimates VALUES (?,?,?,?,?,?,?,?)", held)
    db.commit()
    db.close()


def test_a_file_of_format_1_is_brought_up_to_date_and_nothing_of_it_is_lost(tmp_path: Path) -> None:
    old_file(path := tmp_path / "old.sqlite")
    with Store(path) as store, Store(path) as second:
        assert [(w.id, w.result, w.change, w.kept, w.boot_ms) for w in store.history()] == [
            (2, None, CHANGE, None, None), (1, UploadResult.ALL_NEW, CHANGE, None, None),
        ]  # fmt: skip
        assert [w.id for w in second.pending()] == [2]
        assert store.latest_estimate(1, CHANGE.device_id) == SAVED
        row = store.last_restorable(1, 1, CHANGE.device_id, A)
        assert row is not None and row.id == 2, "who it was is not known: that speaks against nobody"
        upload(store, row.change, UploadResult.ALL_OLD, undoes=row.id)
        assert store.pending() == []


def test_a_file_that_cannot_be_brought_up_to_date_is_left_as_it_was(tmp_path: Path) -> None:
    old_file(path := tmp_path / "old.sqlite")
    db = sqlite3.connect(path)
    db.execute("CREATE TABLE estimates_1 (x)")  # in the way
    db.commit()
    with pytest.raises(StoreError, match=r"old\.sqlite"):
        Store(path).open()
    assert db.execute("PRAGMA user_version").fetchone()[0] == 1
    assert db.execute("SELECT count(*) FROM estimates").fetchone()[0] == 1
    assert "kept" not in [row[1] for row in db.execute("PRAGMA table_info(writes)")]
    db.close()


def test_S19_what_is_of_another_vehicle_for_certain_is_not_found(tmp_path: Path) -> None:
    """Same system id, same device id, as two vehicles of one make have; only the number tells them apart."""
    device = CHANGE.device_id
    with Store(tmp_path / "s.sqlite") as store:
        of_a, of_b = (
            replace(SAVED, vehicle=A, unix_ns=5),
            replace(SAVED, vehicle=B, unix_ns=6, sigma_mg=(9.0, 9.0, 9.0)),
        )
        store.save_estimate(of_a)
        assert store.latest_estimate(1, device, B) is None
        store.save_estimate(of_b)
        assert (store.latest_estimate(1, device, A), store.latest_estimate(1, device, B)) == (of_a, of_b)
        row = store.begin(CHANGE, 5, vehicle=A)
        store.finish(row, UploadResult.ALL_NEW, ())
        assert store.last_restorable(1, 1, device, B) is None
        found = store.last_restorable(1, 1, device, A)
        assert found is not None and found.id == row
        assert store.last_restorable(1, 1, device, key(1, "")) is not None, "not known to be another"


def test_S19_keys() -> None:
    assert (A, key(1, ""), has_uid(A), has_uid("1")) == ("1 uid 00aa", "1", True, False)
    assert may_be_same(A, A) and may_be_same(A, "1") and may_be_same("1", B) and may_be_same("", B)
    assert not may_be_same(A, B) and not may_be_same(A, key(2, "00aa")) and not may_be_same("1", "2")


def test_AT_4c_the_latest_whole_write_of_each_compass_waits_for_the_reboot(tmp_path: Path) -> None:
    with Store(tmp_path / "s.sqlite") as store:
        first, second = upload(store), upload(store)
        other = upload(store, replace(CHANGE, device_id=2))
        for row in (first, second, other):
            store.ended_at(row, 1000 + row)
        assert {(w.id, w.boot_ms) for w in store.unchecked(1)} == {(second, 1000 + second), (other, 1000 + other)}
        store.checked(second, Keeping.LOST)
        assert [w.id for w in store.unchecked(1)] == [other]
        assert {w.id: w.kept for w in store.history()} == {first: None, second: Keeping.LOST, other: None}
        upload(store, replace(CHANGE, device_id=2), UploadResult.PENDING_RESTORE)
        assert store.unchecked(1) == [] == store.unchecked(2), "cut short: there is nothing known to look for"
