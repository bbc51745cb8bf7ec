"""The store's tables, and how an older file becomes a newer one: in one transaction, or not at all."""

from __future__ import annotations

import sqlite3
from pathlib import Path

FORMAT = 3
_WRITES = """
CREATE TABLE writes (
    id INTEGER PRIMARY KEY, unix_ns INTEGER NOT NULL, system INTEGER NOT NULL, compass INTEGER NOT NULL,
    device_id INTEGER NOT NULL, vehicle TEXT NOT NULL, change TEXT NOT NULL,
    undoes INTEGER REFERENCES writes(id), result TEXT, reasons TEXT NOT NULL DEFAULT '[]',
    settled INTEGER NOT NULL DEFAULT 0, undone INTEGER NOT NULL DEFAULT 0, boot_ms INTEGER, kept TEXT
)
"""
_ESTIMATES = """
CREATE TABLE estimates (
    system INTEGER NOT NULL, device_id INTEGER NOT NULL, unix_ns INTEGER NOT NULL, vehicle TEXT NOT NULL,
    change TEXT NOT NULL, verdict TEXT NOT NULL, offsets_mg TEXT NOT NULL, sigma_mg TEXT NOT NULL,
    PRIMARY KEY (system, device_id, vehicle)
)
"""
# What each flight taught, written to the vehicle or not. One row a flight, compass and source of it.
_LEARNT = """
CREATE TABLE learnt (
    id INTEGER PRIMARY KEY, unix_ns INTEGER, system INTEGER NOT NULL, compass INTEGER NOT NULL,
    device_id INTEGER NOT NULL, vehicle TEXT NOT NULL, source TEXT NOT NULL, origin TEXT NOT NULL,
    learnt TEXT NOT NULL, UNIQUE (source, origin, system, compass, device_id, vehicle)
)
"""
_STEPS = {
    0: (_WRITES, _ESTIMATES, _LEARNT),
    # Format 1 knew a vehicle by its system id alone, and did not look again after a reboot.
    1: (
        "ALTER TABLE writes ADD COLUMN boot_ms INTEGER",
        "ALTER TABLE writes ADD COLUMN kept TEXT",
        "ALTER TABLE estimates RENAME TO estimates_1",
        _ESTIMATES,
        "INSERT INTO estimates SELECT system, device_id, unix_ns, vehicle, change, verdict, offsets_mg, sigma_mg "
        "FROM estimates_1",
        "DROP TABLE estimates_1",
        _LEARNT,
    ),
    # Format 2 kept the latest estimate of a compass and not what each flight had taught.
    2: (_LEARNT,),
}
"""What brings a file from each format to the present one."""


class StoreError(OSError):
    """The store cannot be opened, read or written; the text names the file and the cause."""


def connect(path: Path) -> sqlite3.Connection:
    """Open, create or bring up to date. StoreError for a newer format or another program's file; sqlite3.Error."""
    db = sqlite3.connect(path, isolation_level=None, timeout=5.0)
    try:
        db.execute("BEGIN")  # both at one instant: another process may be creating it right now
        version = _version(db)
        tables = db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
        db.execute("COMMIT")
        if version == 0 and tables:
            raise StoreError(f"{path}: a database of something else, not a magmav store")
        if version > FORMAT:
            raise StoreError(f"{path}: format {version} is newer than this magmav's {FORMAT}; update magmav")
        db.execute("PRAGMA journal_mode=WAL")
        db.execute("PRAGMA synchronous=FULL")
        if version < FORMAT:
            _bring_up_to_date(db)
    except BaseException:
        db.close()
        raise
    return db


def _version(db: sqlite3.Connection) -> int:
    return int(db.execute("PRAGMA user_version").fetchone()[0])


def _bring_up_to_date(db: sqlite3.Connection) -> None:
    db.execute("BEGIN IMMEDIATE")
    for statement in _STEPS.get(_version(db), ()):  # nothing left to do where somebody else was quicker
        db.execute(statement)
    db.execute(f"PRAGMA user_version={FORMAT}")
    db.execute("COMMIT")
