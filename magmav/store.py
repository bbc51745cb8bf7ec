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
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

from magmav.core.types import AxisState, Change, Reason, State, UploadResult, Verdict

FORMAT = 1
_TABLES = """
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
"""
_KNOWN = (UploadResult.ALL_NEW, UploadResult.ALL_OLD)
_T = TypeVar("_T")


class StoreError(OSError):
    """The store cannot be opened, read or written; the text names the file and the cause."""


class StoreBusy(StoreError, BlockingIOError):
    """Another process is in the middle of a write to a vehicle."""


@dataclass(frozen=True, slots=True)
class Write:
    """One write to a vehicle; result None: cut short. Upload(change, ..., undoes=id) undoes it."""

    id: int
    unix_ns: int
    vehicle: str
    change: Change
    undoes: int | None
    result: UploadResult | None
    reasons: tuple[Reason, ...]
    undone: bool  # its old values were brought back later


@dataclass(frozen=True, slots=True)
class SavedEstimate:
    """The latest answer for one compass: what an upload would change, and how good it is.

    offsets_mg, sigma_mg : (x, y, z), mG, body axes, as ArduPilot would add them.
    """

    unix_ns: int
    vehicle: str
    change: Change
    verdict: Verdict
    offsets_mg: tuple[float, float, float]
    sigma_mg: tuple[float, float, float]


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
                self._db = self._connect()
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
        row = (unix_ns, change.system, change.compass, change.device_id, vehicle, _pack(change), undoes)
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

    def last_restorable(self, system: int, compass: int, device_id: int) -> Write | None:
        """The newest write whose old values can still be brought back, for exactly this compass."""
        where = (
            "system=? AND compass=? AND device_id=? AND NOT undone AND undoes IS NULL AND (result IN "
            "('ALL_NEW', 'WRITTEN_UNPROVEN') OR (ifnull(result, 'PENDING_RESTORE')='PENDING_RESTORE' "
            "AND NOT settled)) ORDER BY id DESC LIMIT 1"
        )
        return next(iter(self._writes(where, (system, compass, device_id))), None)

    def history(self, limit: int = 50) -> list[Write]:
        """The latest writes, newest first."""
        return self._writes("1 ORDER BY id DESC LIMIT ?", (limit,))

    # ------------------------------------------------------------ estimates

    def save_estimate(self, estimate: SavedEstimate) -> None:
        """Keep the latest per system and device id."""
        verdict = {
            "state": estimate.verdict.state.name,
            "axes": [axis.name for axis in estimate.verdict.axes],
            "reasons": [reason.name for reason in estimate.verdict.reasons],
        }
        row = (
            estimate.change.system,
            estimate.change.device_id,
            estimate.unix_ns,
            estimate.vehicle,
            _pack(estimate.change),
            json.dumps(verdict),
            json.dumps(estimate.offsets_mg),
            json.dumps(estimate.sigma_mg),
        )
        self._do(lambda db: db.execute("INSERT OR REPLACE INTO estimates VALUES (?,?,?,?,?,?,?,?)", row))

    def latest_estimate(self, system: int, device_id: int) -> SavedEstimate | None:
        """What was learnt last about this very compass, or None."""
        sql = (
            "SELECT unix_ns, vehicle, change, verdict, offsets_mg, sigma_mg FROM estimates "
            "WHERE system=? AND device_id=?"
        )
        found = self._do(lambda db: db.execute(sql, (system, device_id)).fetchone())
        return None if found is None else self._read(_saved, found)

    # ------------------------------------------------------------ inside

    def _connect(self) -> sqlite3.Connection:
        db = sqlite3.connect(self.path, isolation_level=None, timeout=5.0)
        try:
            db.execute("BEGIN")  # both at one instant: another process may be creating it right now
            version = db.execute("PRAGMA user_version").fetchone()[0]
            tables = db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
            db.execute("COMMIT")
            if version == 0 and tables:
                raise StoreError(f"{self.path}: a database of something else, not a magmav store")
            if version > FORMAT:
                raise StoreError(f"{self.path}: format {version} is newer than this magmav's {FORMAT}; update magmav")
            db.execute("PRAGMA journal_mode=WAL")
            db.execute("PRAGMA synchronous=FULL")
            if version == 0:
                self._create(db)
        except BaseException:
            db.close()
            raise
        return db

    def _create(self, db: sqlite3.Connection) -> None:
        db.execute("BEGIN IMMEDIATE")
        if db.execute("PRAGMA user_version").fetchone()[0] == 0:  # nobody else was quicker
            for statement in filter(str.strip, _TABLES.split(";")):
                db.execute(statement)
            db.execute(f"PRAGMA user_version={FORMAT}")
        db.execute("COMMIT")

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
        sql = f"SELECT id, unix_ns, vehicle, change, undoes, result, reasons, undone FROM writes WHERE {where}"
        return [self._read(_write, row) for row in self._do(lambda db: db.execute(sql, values).fetchall())]

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
    names = set(_unpack(this[2]).names)
    earlier = db.execute(
        "SELECT id, change FROM writes WHERE id<? AND system=? AND device_id=? AND NOT settled",
        (row, *this[:2]),
    ).fetchall()
    for other, change in earlier:
        if names >= set(_unpack(change).names):
            db.execute("UPDATE writes SET settled=1 WHERE id=?", (other,))


def _mark_undone(db: sqlite3.Connection, row: int) -> None:
    """The write this one undid, and the one that one had undone, if it was cut short itself."""
    found = db.execute("SELECT undoes FROM writes WHERE id=?", (row,)).fetchone()
    while found is not None and found[0] is not None:
        db.execute("UPDATE writes SET undone=1 WHERE id=?", found)
        found = db.execute("SELECT undoes FROM writes WHERE id=?", found).fetchone()


def _pack(change: Change) -> str:
    """JSON; every float32 survives exactly: Python writes doubles so that they read back the same."""
    return json.dumps(asdict(change), allow_nan=False)


def _unpack(text: str) -> Change:
    held: dict[str, Any] = json.loads(text)
    fields: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in held.items()}
    return Change(**fields)


def _write(row: Sequence[Any]) -> Write:
    number, unix_ns, vehicle, change, undoes, result, reasons, undone = row
    named = tuple(Reason[name] for name in json.loads(reasons))
    ended = None if result is None else UploadResult[result]
    return Write(number, unix_ns, vehicle, _unpack(change), undoes, ended, named, bool(undone))


def _saved(row: Sequence[Any]) -> SavedEstimate:
    unix_ns, vehicle, change, verdict, offsets_mg, sigma_mg = row
    said = json.loads(verdict)
    x, y, z = (AxisState[name] for name in said["axes"])
    judged = Verdict(State[said["state"]], (x, y, z), tuple(Reason[name] for name in said["reasons"]))
    offsets, sigma = (tuple(map(float, json.loads(text))) for text in (offsets_mg, sigma_mg))
    return SavedEstimate(unix_ns, vehicle, _unpack(change), judged, _three(offsets), _three(sigma))


def _three(values: tuple[float, ...]) -> tuple[float, float, float]:
    x, y, z = values
    return x, y, z
