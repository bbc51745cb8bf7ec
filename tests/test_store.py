"""What survives: kills, other processes, newer versions."""

from __future__ import annotations

import signal
import sqlite3
import struct
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from magmav.core.types import AxisState, Change, Reason, State, UploadResult, Verdict
from magmav.store import SavedEstimate, Store, StoreBusy, StoreError, default_path

NAMES = ("COMPASS_OFS_X", "COMPASS_OFS_Y", "COMPASS_OFS_Z")
OLD = tuple(struct.unpack("<3f", struct.pack("<3f", 5.3, -12.1, 0.1)))
NEW = tuple(struct.unpack("<3f", struct.pack("<3f", 65.7, 1e-7, -300.3)))
CHANGE = Change(
    1, 1, "COMPASS_DEV_ID", 97539, NAMES, OLD, NEW, (60.0, 12.0, -300.0), (1.0, 2.0, 3.0), (60.0, 12.0, 300.0)
)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store(tmp_path / "deep" / "magmav.sqlite") as opened:
        yield opened


def upload(store: Store, change: Change = CHANGE, result: UploadResult = UploadResult.ALL_NEW, **more: int) -> int:
    row = store.begin(change, 5, **more)
    store.finish(row, result, ())
    return row


def test_a_write_is_kept_exactly(store: Store) -> None:
    row = store.begin(CHANGE, 1_795_000_000_123_456_789, vehicle="uid 42")
    store.finish(row, UploadResult.ALL_OLD, (Reason.UNPROVEN, Reason.NO_STREAM))
    (held,) = store.history()
    assert held.change == CHANGE and held.unix_ns == 1_795_000_000_123_456_789 and held.vehicle == "uid 42"
    assert (held.result, held.reasons) == (UploadResult.ALL_OLD, (Reason.UNPROVEN, Reason.NO_STREAM))


@given(st.lists(st.floats(width=32, allow_nan=False, allow_infinity=False), min_size=3, max_size=3))
@settings(max_examples=20, deadline=None)
def test_AT_4b_every_float32_comes_back_bit_for_bit(
    tmp_path_factory: pytest.TempPathFactory, values: list[float]
) -> None:
    path = tmp_path_factory.getbasetemp() / "exact.sqlite"
    with Store(path) as store:
        upload(store, replace(CHANGE, old=tuple(values)))
    with Store(path) as store:
        assert struct.pack("<3f", *store.history(1)[0].change.old) == struct.pack("<3f", *values)


def test_pending_until_a_later_write_of_the_same_names_is_whole(store: Store) -> None:
    row = upload(store, result=UploadResult.PENDING_RESTORE)
    assert [held.id for held in store.pending()] == [row]
    upload(store, replace(CHANGE, device_id=1))  # another compass
    upload(store, replace(CHANGE, names=NAMES[:2], old=OLD[:2], new=NEW[:2]))  # Z may still be mixed
    upload(store, result=UploadResult.REFUSED)
    assert [held.id for held in store.pending()] == [row]
    upload(store, result=UploadResult.ALL_OLD, undoes=row)
    assert store.pending() == [] and store.history()[-1].undone


def test_dismissed_by_the_user_is_no_longer_pending(store: Store) -> None:
    row = upload(store, result=UploadResult.PENDING_RESTORE)
    store.dismiss(row)
    assert store.pending() == [] and store.last_restorable(1, 1, 97539) is None


def test_restore_goes_back_step_by_step_and_only_for_this_compass(store: Store) -> None:
    first, second = upload(store), upload(store, replace(CHANGE, old=NEW, new=OLD))
    upload(store, replace(CHANGE, device_id=2))
    upload(store, replace(CHANGE, compass=2, device_id=3))
    upload(store, result=UploadResult.REFUSED)
    upload(store, result=UploadResult.ALL_OLD)
    for row in (second, first):
        found = store.last_restorable(1, 1, 97539)
        assert found is not None and found.id == row
        upload(store, found.change, UploadResult.ALL_OLD, undoes=row)
    assert store.last_restorable(1, 1, 97539) is None
    assert store.last_restorable(2, 1, 97539) is None and store.last_restorable(1, 2, 3) is not None


def test_an_undo_that_was_cut_short_is_undone_in_its_turn(store: Store) -> None:
    row = upload(store)
    cut = upload(store, result=UploadResult.PENDING_RESTORE, undoes=row)
    (held,) = store.pending()
    assert held.id == cut and held.change == CHANGE
    upload(store, held.change, UploadResult.ALL_OLD, undoes=held.id)
    assert store.pending() == [] and store.last_restorable(1, 1, 97539) is None


CHILD = """
import os, signal, sys
from magmav.core.types import Change, Reason, UploadResult
from magmav.store import Store
CHANGE = {change!r}
store = Store(sys.argv[1]).open()
steps = sys.argv[2]
if "begin" in steps:
    row = store.begin(CHANGE, 5)
if "finish" in steps:
    store.finish(row, UploadResult.ALL_NEW, ())
sys.stdout.write("ready\\n"); sys.stdout.flush()
if "wait" in steps:
    sys.stdin.read()
os.kill(os.getpid(), signal.SIGKILL)
"""


def child(path: Path, steps: str) -> subprocess.Popen[str]:
    program = CHILD.format(change=CHANGE)
    arguments = [sys.executable, "-c", program, str(path), steps]
    process = subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "ready\n"
    return process


@pytest.mark.parametrize(("steps", "pending"), [("open", 0), ("begin", 1), ("begin finish", 0)])
def test_S2_killed_at_any_step_it_opens_again_and_knows(tmp_path: Path, steps: str, pending: int) -> None:
    path = tmp_path / "magmav.sqlite"
    process = child(path, steps)
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    with Store(path) as store:
        assert [held.change for held in store.pending()] == [CHANGE] * pending
        assert [held.result for held in store.pending()] == [None] * pending
        row = store.last_restorable(1, 1, 97539)
        assert (row is not None) == (steps != "open")
        if row is not None:  # AT-4b: and the way back is open
            upload(store, row.change, UploadResult.ALL_OLD, undoes=row.id)
            assert store.pending() == []


def test_while_another_process_writes_its_row_is_not_pending_and_we_may_not_begin(tmp_path: Path) -> None:
    path = tmp_path / "magmav.sqlite"
    process = child(path, "begin wait")
    with Store(path) as store:
        assert store.pending() == []
        with pytest.raises(StoreBusy, match=r"magmav\.sqlite"):
            store.begin(CHANGE, 6)
        assert len(store.history()) == 1
        process.communicate()  # ends it with SIGKILL
        assert [held.id for held in store.pending()] == [1]
        upload(store)


def test_our_own_running_write_is_busy_and_not_pending(store: Store) -> None:
    row = store.begin(CHANGE, 5)
    assert store.pending() == []
    with pytest.raises(StoreBusy):
        store.begin(CHANGE, 5)
    store.finish(row, UploadResult.ALL_NEW, ())
    upload(store)


def test_what_run_learnt_another_process_can_use(tmp_path: Path) -> None:
    path = tmp_path / "magmav.sqlite"
    axes = (AxisState.OBSERVED, AxisState.FROM_MODEL, AxisState.NOT_OBSERVED)
    verdict = Verdict(State.READY, axes, (Reason.Z_FROM_MODEL,))
    saved = SavedEstimate(7, "uid", CHANGE, verdict, (65.7, 1e-7, -300.3), (1.5, 2.5, 9.0))
    with Store(path) as writer, Store(path) as reader:
        assert reader.latest_estimate(1, 97539) is None
        writer.save_estimate(replace(saved, unix_ns=6))
        writer.save_estimate(saved)
        assert reader.latest_estimate(1, 97539) == saved
        assert reader.latest_estimate(2, 97539) is None and reader.latest_estimate(1, 1) is None


def test_a_newer_format_or_another_file_is_refused_by_name(tmp_path: Path) -> None:
    newer = tmp_path / "newer.sqlite"
    Store(newer).open().close()
    db = sqlite3.connect(newer)
    db.execute("PRAGMA user_version=99")
    db.close()
    other = tmp_path / "other.sqlite"
    db = sqlite3.connect(other)
    db.execute("CREATE TABLE mine (x)")
    db.close()
    noise = tmp_path / "noise.sqlite"
    noise.write_bytes(b"not a database at all" * 100)
    for path, why in (
        (newer, "newer"),
        (other, "something else"),
        (noise, "not a database"),
        (tmp_path, "tmp|test"),
    ):
        before = path.read_bytes() if path.is_file() else b""
        with pytest.raises(StoreError, match=why) as error:
            Store(path).open()
        assert str(path) in str(error.value)
        assert not path.is_file() or path.read_bytes() == before
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(StoreError, match="folder"):
        Store(file / "x" / "magmav.sqlite").open()


def test_snapshots_are_synchronous_full_and_wal(store: Store) -> None:
    assert store._db is not None
    assert store._db.execute("PRAGMA journal_mode").fetchone()[0] == "wal"
    assert store._db.execute("PRAGMA synchronous").fetchone()[0] == 2


def test_wrong_calls_are_wrong_calls(tmp_path: Path, store: Store) -> None:
    with pytest.raises(ValueError, match="not open"):
        Store(tmp_path / "x.sqlite").history()
    with pytest.raises(ValueError, match="99"):
        store.finish(99, UploadResult.ALL_NEW, ())


@pytest.mark.parametrize(
    ("environ", "path"),
    [
        ({"MAGMAV_STATE": "/a", "STATE_DIRECTORY": "/b", "HOME": "/h"}, "/a/magmav.sqlite"),
        ({"STATE_DIRECTORY": "/b:/c", "XDG_STATE_HOME": "/x", "HOME": "/h"}, "/b/magmav.sqlite"),
        ({"XDG_STATE_HOME": "/x", "HOME": "/h"}, "/x/magmav/magmav.sqlite"),
        ({"HOME": "/h"}, "/h/.local/state/magmav/magmav.sqlite"),
    ],
)
def test_default_path(environ: dict[str, str], path: str) -> None:
    assert default_path(environ) == Path(path)
