"""What is finished of a run over many logs: one JSON line per log, on disk before it counts.

A run that was killed goes on from here. A line says which bytes were worked on (sha256), with which settings and
which magmav, so a line of another file, other settings or another version never stands in for the one asked for.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any

import msgspec

from magmav import __version__
from magmav.fitting import FitOptions
from magmav.settings import Settings

Result = dict[str, Any]
_CHUNK = 1 << 20
_FORMAT = 1
"""Of the lines; counts in the key, so that lines of another shape are left alone and their logs done again."""


class LedgerError(Exception):
    """A ledger that cannot be used; the text names the file, what is wrong and what to do."""


def sha256_of(path: Path) -> tuple[str, int]:
    """Hash and size of a file. OSError."""
    digest, size = hashlib.sha256(), 0
    with path.open("rb") as file:
        while block := file.read(_CHUNK):
            digest.update(block)
            size += len(block)
    return digest.hexdigest(), size


def work_key(settings: Settings, options: FitOptions) -> str:
    """Hash of all that an answer depends on besides the log: settings, options, a truth file's content, versions.

    OSError where the truth file cannot be read.
    """
    told = asdict(options)
    if options.heading_reference is not None:
        told["heading_reference"] = sha256_of(Path(options.heading_reference))[0]
    rests_on = [_FORMAT, __version__, told, msgspec.to_builtins(settings)]
    return hashlib.sha256(json.dumps(rests_on, sort_keys=True).encode()).hexdigest()


class Ledger:
    """One file of finished logs. For one process at a time; use it as a context manager. Errors are LedgerError.

    work : see work_key; lines of other work stay in the file and are not looked at.
    damaged : lines that could not be read back and were left out; their logs are done again.
    """

    def __init__(self, path: Path, work: str) -> None:
        self.path, self.work = path, work
        self.damaged = 0
        self._lines: dict[str, tuple[int, int]] = {}
        self._fd = -1

    def __enter__(self) -> Ledger:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            new = not self.path.exists()
            self._fd = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_BINARY", 0), 0o666)
        except OSError as error:
            raise LedgerError(f"{self.path}: cannot be opened: {error.strerror}; choose another --out") from error
        try:
            self._lock()
            self._read()
            if new:
                _sync_folder(self.path.parent)
        except OSError as error:
            self._close()
            raise LedgerError(f"{self.path}: cannot be read: {error.strerror}; choose another --out") from error
        except LedgerError:
            self._close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()

    def __contains__(self, sha256: object) -> bool:
        return sha256 in self._lines

    def __len__(self) -> int:
        return len(self._lines)

    def add(self, sha256: str, size: int, outcome: Mapping[str, Any]) -> None:
        """A finished log. On disk when this returns; a log that is in already is not written twice."""
        if sha256 in self._lines:
            return
        head = {"sha256": sha256, "bytes": size, "work": self.work, "magmav": __version__}
        line = msgspec.json.encode(head | {"outcome": outcome}, enc_hook=_plain) + b"\n"  # NaN becomes null
        try:
            begin = os.lseek(self._fd, 0, os.SEEK_END)
            _write_all(self._fd, line)
            os.fsync(self._fd)
        except OSError as error:
            text = f"{self.path}: cannot be written: {error.strerror}; make room, then run the same command again"
            raise LedgerError(text) from error
        self._lines[sha256] = begin, len(line)

    def outcome(self, sha256: str) -> Result:
        """What was put in for this log. KeyError where nothing was."""
        begin, size = self._lines[sha256]
        os.lseek(self._fd, begin, os.SEEK_SET)
        found: Result = json.loads(_read_all(self._fd, size))["outcome"]
        return found

    def _lock(self) -> None:
        """Two runs on one ledger would do every log twice. The lock is the system's: it dies with the process."""
        if sys.platform == "win32":
            return
        import fcntl

        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            text = f"{self.path}: another run is working on it; wait for it, stop it, or choose another --out"
            raise LedgerError(text) from None

    def _read(self) -> None:
        """Every whole line; what a kill left of a last one is cut off."""
        os.lseek(self._fd, 0, os.SEEK_SET)
        at = 0
        with os.fdopen(os.dup(self._fd), "rb") as file:
            for line in file:
                if not line.endswith(b"\n"):
                    break
                sha256 = self._mine(line)
                if sha256 is not None:
                    self._lines[sha256] = at, len(line)
                at += len(line)
        if os.fstat(self._fd).st_size > at:
            os.ftruncate(self._fd, at)
            os.fsync(self._fd)

    def _mine(self, line: bytes) -> str | None:
        try:
            held = json.loads(line)
            sha256, work, outcome = held["sha256"], held["work"], held["outcome"]
        except (ValueError, KeyError, TypeError):
            self.damaged += 1
            return None
        if work != self.work or not isinstance(sha256, str) or not isinstance(outcome, dict):
            return None
        return sha256

    def _close(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


def _plain(value: Any) -> Any:
    """numpy's numbers and arrays as Python's."""
    return value.tolist()


def _write_all(fd: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(fd, view) :]


def _read_all(fd: int, size: int) -> bytes:
    parts = []
    while size and (part := os.read(fd, size)):
        parts.append(part)
        size -= len(part)
    return b"".join(parts)


def _sync_folder(folder: Path) -> None:
    """The file's name is on disk too. Where a folder cannot be opened as a file, the system does it by itself."""
    if sys.platform == "win32":
        return
    fd = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
