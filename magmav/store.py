"""What must outlive the process: every write with the values before it, and the latest estimates.

The first is for the undo, the second lets `magmav upload` use what `magmav run` learnt.

One SQLite file in WAL mode with synchronous=FULL: what `begin` returned for is on disk. Whoever writes to a
vehicle also holds a second file's lock from `begin` to `finish`; the system frees it when the process dies,
so a row without an outcome is pending exactly when nobody is still working on it.
"""

from __future__ import annotations

import json
import os
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

from magmav.core.types import Change, Reason, UploadResult
from magmav.mavlink.kept import Keeping
from magmav.mavlink.uid import may_be_same
from magmav.store_rows import (
    ESTIMATE_COLUMNS,
    LEARNT_COLUMNS,
    WRITE_COLUMNS,
    Learnt,
    SavedEstimate,
    Write,
    estimate_of,
    estimate_row,
    learnt_of,
    learnt_row,
    pack,
    unpack,
    write_of,
)
from magmav.store_schema import StoreError, connect

__all__ = ["Learnt", "SavedEstimate", "Store", "StoreBusy", "StoreError", "Write", "default_path"]
_KNOWN = (UploadResult.ALL_NEW, UploadResult.WRITTEN_UNPROVEN, UploadResult.ALL_OLD)
_T = TypeVar("_T")


class StoreBusy(StoreError, BlockingIOError):
    """Another process is in the middle of a write to a vehicle."""


def default_path(environ: Mapping[str, str] | None = None) -> Path:
    """$MAGMAV_STATE, else systemd's $STATE_DIRECTORY, else the user's state directory; then magmav.sqlite."""
    env = os.environ if environ is None else environ
    for folder in (env.get("MAGMAV_STATE"), env.get("STATE_DIRECTORY", "").split(":")[0]):
        if folder:
            return Path(folder) / "magmav.sqlite"
    state = env.get("XDG_STATE_HOME") or str(Path(env.get("HOME") or Path.home()) / ".local" / "state")
    return Path(state) / "magmav" / "magmav.sqlite"


class Store:
    """For one thread; close it, or use it as a context manager. Errors are StoreError."""

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self._db: sqlite3.Connection | None = None
        self._lock: sqlite3.Connection | None = None

    def open(self) -> Store:
        """Open or create. A file of a newer format, or one that is no store, is refused."""
        if self._db is None:
            try:
                self.path.parent.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise StoreError(f"{self.path}: its folder cannot be made ({error.strerror})") from error
            try:
                self._db = connect(self.path)
            except sqlite3.Error as error:
                raise StoreError(f"{self.path}: {error}") from error
        return self

    def close(self) -> None:
        """Close; safe to call twice."""
        self._release()
        if self._db is not None:
            self._db.close()
            self._db = None

    def __enter__(self) -> Store:
        return self.open()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # ------------------------------------------------------------ writes to a vehicle

    def begin(self, change: Change, unix_ns: int, undoes: int | None = None, vehicle: str = "") -> int:
        """Put a change on record, on disk when this returns; StoreBusy while another process is writing."""
        self._claim()
        row = (unix_ns, change.system, change.compass, change.device_id, vehicle, pack(change), undoes)
        columns = "unix_ns, system, compass, device_id, vehicle, change, undoes"
        sql = f"INSERT INTO writes ({columns}) VALUES (?,?,?,?,?,?,?)"
        try:
            return self._do(lambda db: int(db.execute(sql, row).lastrowid or 0))
        except StoreError:
            self._release()
            raise

    def finish(self, row: int, result: UploadResult, reasons: Sequence[Reason]) -> None:
        """How it ended. Values known to be whole also settle earlier writes of the same names."""

        def work(db: sqlite3.Connection) -> None:
            names = json.dumps([reason.name for reason in reasons])
            done = db.execute("UPDATE writes SET result=?, reasons=? WHERE id=?", (result.name, names, row))
            if not done.rowcount:
                raise ValueError(f"row: {row} was never begun")
            if result in _KNOWN:
                _settle(db, row)
            if result is UploadResult.ALL_OLD:
                _mark_undone(db, row)

        try:
            self._do(work)
        finally:
            self._release()

    def pending(self) -> list[Write]:
        """Writes that may have left a mixed vector and were not put right since, newest first.

        Cut short counts only when nobody is working on it any more.
        """
        cut = "" if self._is_somebody_writing() else " OR result IS NULL"
        return self._writes(f"NOT settled AND (result='PENDING_RESTORE'{cut}) ORDER BY id DESC")

    def dismiss(self, row: int) -> None:
        """The user looked at a pending write and wants it left as it is."""
        self._do(lambda db: db.execute("UPDATE writes SET settled=1 WHERE id=?", (row,)))

    def last_restorable(self, system: int, compass: int, device_id: int, vehicle: str = "") -> Write | None:
        """The newest write whose old values can still be brought back, for exactly this compass.

        vehicle : key of the vehicle; writes to one that is another for certain do not count (S19).
        """
        where = (
            "system=? AND compass=? AND device_id=? AND NOT undone AND undoes IS NULL AND (result IN "
            "('ALL_NEW', 'WRITTEN_UNPROVEN') OR (ifnull(result, 'PENDING_RESTORE')='PENDING_RESTORE' "
            "AND NOT settled)) ORDER BY id DESC"
        )
        rows = self._writes(where, (system, compass, device_id))
        return next((row for row in rows if not vehicle or may_be_same(row.vehicle, vehicle)), None)

    def ended_at(self, row: int, boot_ms: int) -> None:
        """The autopilot's boot clock when this write ended: a smaller one later means that it rebooted since."""
        self._do(lambda db: db.execute("UPDATE writes SET boot_ms=? WHERE id=?", (boot_ms, row)))

    def unchecked(self, system: int) -> list[Write]:
        """The latest write to each compass that left known values and was not looked at again after a reboot."""
        where = "system=? AND result IN ('ALL_NEW', 'WRITTEN_UNPROVEN', 'ALL_OLD', 'PENDING_RESTORE') ORDER BY id DESC"
        latest: dict[tuple[str, int], Write] = {}
        for row in self._writes(where, (system,)):
            latest.setdefault((row.vehicle, row.change.device_id), row)
        whole = (UploadResult.ALL_NEW, UploadResult.WRITTEN_UNPROVEN, UploadResult.ALL_OLD)
        return [r for r in latest.values() if r.kept is None and r.boot_ms is not None and r.result in whole]

    def checked(self, row: int, kept: Keeping) -> None:
        """What was found after the reboot."""
        self._do(lambda db: db.execute("UPDATE writes SET kept=? WHERE id=?", (kept.name, row)))

    def history(self, limit: int = 50) -> list[Write]:
        """The latest writes, newest first."""
        return self._writes("1 ORDER BY id DESC LIMIT ?", (limit,))

    # ------------------------------------------------------------ estimates

    def save_estimate(self, estimate: SavedEstimate) -> None:
        """Keep the latest per vehicle and device id."""
        place = estimate.change.system, estimate.change.device_id
        sql = f"INSERT OR REPLACE INTO estimates (system, device_id, {ESTIMATE_COLUMNS}) VALUES (?,?,?,?,?,?,?,?)"
        self._do(lambda db: db.execute(sql, (*place, *estimate_row(estimate))))

    def latest_estimate(self, system: int, device_id: int, vehicle: str = "") -> SavedEstimate | None:
        """What was learnt last about this very compass, or None.

        vehicle : key of the vehicle; what is of another one for certain does not count (S19).
        """
        sql = f"SELECT {ESTIMATE_COLUMNS} FROM estimates WHERE system=? AND device_id=? ORDER BY unix_ns DESC"
        found = self._do(lambda db: db.execute(sql, (system, device_id)).fetchall())
        saved = (self._read(estimate_of, row) for row in found)
        return next((one for one in saved if not vehicle or may_be_same(one.vehicle, vehicle)), None)

    # ------------------------------------------------------------ what flights taught

    def learn(self, learnt: Sequence[Learnt]) -> None:
        """Keep what a flight taught; told again of the same flight, the newer word takes the older one's place."""
        sql = (
            f"INSERT INTO learnt ({LEARNT_COLUMNS}, learnt) VALUES (?,?,?,?,?,?,?,?) "
            "ON CONFLICT (source, origin, system, compass, device_id, vehicle) "
            "DO UPDATE SET unix_ns=excluded.unix_ns, learnt=excluded.learnt"
        )
        rows = [learnt_row(one) for one in learnt]
        self._do(lambda db: db.executemany(sql, rows))

    def learnt(self) -> list[Learnt]:
        """What every flight taught, the oldest first; those without a date before all others."""
        sql = f"SELECT id, {LEARNT_COLUMNS}, learnt FROM learnt ORDER BY unix_ns, origin, system, compass"
        return [self._read(learnt_of, row) for row in self._do(lambda db: db.execute(sql).fetchall())]

    # ------------------------------------------------------------ inside

    def _do(self, work: Callable[[sqlite3.Connection], _T]) -> _T:
        """Run in one transaction; whatever goes wrong, nothing of it stays."""
        if self._db is None:
            raise ValueError(f"{self.path}: the store is not open")
        try:
            self._db.execute("BEGIN IMMEDIATE")
            try:
                out = work(self._db)
            except BaseException:
                self._db.execute("ROLLBACK")
                raise
            self._db.execute("COMMIT")
        except sqlite3.Error as error:
            raise StoreError(f"{self.path}: {error}") from error
        return out

    def _writes(self, where: str, values: tuple[int, ...] = ()) -> list[Write]:
        sql = f"SELECT {WRITE_COLUMNS} FROM writes WHERE {where}"
        return [self._read(write_of, row) for row in self._do(lambda db: db.execute(sql, values).fetchall())]

    def _read(self, make: Callable[[Sequence[Any]], _T], row: Sequence[Any]) -> _T:
        try:
            return make(row)
        except (KeyError, TypeError, ValueError) as error:
            raise StoreError(f"{self.path}: a row cannot be understood ({error!r})") from error

    def _claim(self) -> None:
        """Be the one process that writes to a vehicle. The lock is the system's: it dies with us."""
        if self._lock is not None:
            raise StoreBusy(f"{self.path}: a write is on record and not finished yet")
        try:
            lock = sqlite3.connect(f"{self.path}-writer", isolation_level=None, timeout=0.0)
        except sqlite3.Error as error:
            raise StoreError(f"{self.path}-writer: {error}") from error
        try:
            lock.execute("BEGIN EXCLUSIVE")
        except sqlite3.OperationalError as error:
            lock.close()
            if error.sqlite_errorcode & 0xFF == sqlite3.SQLITE_BUSY:
                raise StoreBusy(f"{self.path}: another process is writing to a vehicle") from error
            raise StoreError(f"{self.path}-writer: {error}") from error
        self._lock = lock

    def _release(self) -> None:
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def _is_somebody_writing(self) -> bool:
        try:
            self._claim()
        except StoreBusy:
            return True
        self._release()
        return False


def _settle(db: sqlite3.Connection, row: int) -> None:
    """Earlier writes of no other names than this one's: the vector is known to be whole again."""
    this = db.execute("SELECT system, device_id, change FROM writes WHERE id=?", (row,)).fetchone()
    names = set(unpack(this[2]).names)
    earlier = db.execute(
        "SELECT id, change FROM writes WHERE id<? AND system=? AND device_id=? AND NOT settled",
        (row, *this[:2]),
    ).fetchall()
    for other, change in earlier:
        if names >= set(unpack(change).names):
            db.execute("UPDATE writes SET settled=1 WHERE id=?", (other,))


def _mark_undone(db: sqlite3.Connection, row: int) -> None:
    """The write this one undid, and the one that one had undone, if it was cut short itself."""
    found = db.execute("SELECT undoes FROM writes WHERE id=?", (row,)).fetchone()
    while found is not None and found[0] is not None:
        db.execute("UPDATE writes SET undone=1 WHERE id=?", found)
        found = db.execute("SELECT undoes FROM writes WHERE id=?", found).fetchone()
