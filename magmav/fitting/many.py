"""Many logs: found, hashed, worked on by several processes or a cluster, and kept in a ledger as they end.

What was finished before a kill is not done again. The results come out in the order of the files' names, whatever
the order of the arguments and whichever log was ready first.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from magmav import __version__
from magmav.fitting import FitOptions
from magmav.fitting.cluster import on_cluster
from magmav.fitting.ledger import Ledger, sha256_of
from magmav.fitting.pool import in_pool
from magmav.fitting.trend import RULE, rows_of, table
from magmav.fitting.work import Job, named, refused
from magmav.settings import Settings

Result = dict[str, Any]
ENDINGS = (".tlog", ".bin", ".log", ".ulg")


@dataclass(frozen=True, slots=True)
class Told:
    """What is told while it goes on: "found" (in all), "begun", "progress" (done, in all of one log), "ended".

    error : of a log that ended without an answer, else "".  again : it was in the ledger already.
    """

    what: str
    path: str = ""
    done: int = 0
    total: int = 0
    error: str = ""
    again: bool = False


@dataclass(slots=True)
class Run:
    """What a run came to. Entries stay in the ledger and are read when they are wanted: they may be many.

    logs : (path, sha256) of what has an answer, in the order of paths.  same : path to the path of equal content.
    """

    logs: list[tuple[str, str]] = field(default_factory=list)
    errors: list[Result] = field(default_factory=list)
    same: dict[str, str] = field(default_factory=dict)

    def entries(self, ledger: Ledger) -> Iterator[Result]:
        """Each log's entry, in the order of paths."""
        for path, sha256 in self.logs:
            yield named(ledger.outcome(sha256), path)["entry"]

    def table(self, ledger: Ledger) -> Result:
        """Vehicles, compasses, logs by date, trends; what gave no answer, and what was there twice."""
        rows = [row for entry in self.entries(ledger) for row in rows_of(entry)]
        return {
            "logs": len(self.logs),
            "rule": RULE,
            "vehicles": table(rows),
            "errors": self.errors,
            "same_content": [{"path": path, "as": first} for path, first in sorted(self.same.items())],
            "made_by": {"magmav": __version__, "at": None},
        }


def find_logs(given: Iterable[Path], on_error: Callable[[str, str], None]) -> list[Path]:
    """Files as given, and every log in and below the folders given; each once, by name.

    In a folder what ends in .tlog, .bin, .log or .ulg counts, in any case; links to folders are not followed.
    on_error : told (path, text) of what is not there or a folder that cannot be read.
    """
    found: dict[str, Path] = {}
    for path in given:
        if path.is_dir():
            for file in _below(path, on_error):
                found.setdefault(os.path.realpath(file), file)
    for path in given:  # a file that was named itself is called as it was named
        if not path.is_dir():
            if path.exists():
                found[os.path.realpath(path)] = path
            else:
                on_error(str(path), f"{path}: no such file; check the path")
    return sorted(found.values(), key=str)


def _below(folder: Path, on_error: Callable[[str, str], None]) -> Iterator[Path]:
    def failed(error: OSError) -> None:
        on_error(str(error.filename), f"{error.filename}: cannot be read: {error.strerror}; look at its permissions")

    for root, folders, files in os.walk(folder, onerror=failed):
        folders.sort()
        yield from (Path(root, name) for name in sorted(files) if name.lower().endswith(ENDINGS))


def fit_many(
    given: Sequence[Path],
    settings: Settings,
    options: FitOptions,
    ledger: Ledger,
    *,
    jobs: int | None = None,
    dask: str | None = None,
    tell: Callable[[Told], None] = lambda told: None,
) -> Run:
    """Do what is not in the ledger yet. Raises LedgerError, and ClusterError where ``dask`` names no cluster.

    jobs : processes; None: one a core.  One log's error never stops the others: it is told, and listed in the run.
    """
    out = Run()

    def failed(path: str, text: str) -> None:
        _put(out, shown(path), refused(shown(text)), tell)

    paths = find_logs(given, failed)
    tell(Told("found", total=len(paths)))
    first: dict[str, str] = {}

    def waiting() -> Iterator[Job]:
        """What is still to be done, hashed just before its turn."""
        for path in paths:
            job = _hashed(path, failed)
            if job is None:
                continue
            earlier = first.setdefault(job.sha256, job.path)
            if earlier != job.path:
                out.same[job.path] = earlier
                tell(Told("ended", job.path))
            elif job.sha256 in ledger:
                outcome = named(ledger.outcome(job.sha256), job.path)
                _put(out, job.path, outcome, tell, sha256=job.sha256, again=True)
            else:
                yield job

    def watch(job: Job, done: int, total: int) -> None:
        tell(Told("progress" if total else "begun", job.path, done, total))

    work = (
        in_pool(waiting(), max(1, jobs or cores()), settings, options, watch)
        if dask is None
        else on_cluster(dask, waiting(), settings, options, watch)
    )
    for job, outcome in work:
        if "error" in outcome:
            outcome["error"]["path"] = job.path
        if "entry" in outcome or outcome["lasting"]:
            ledger.add(job.sha256, job.size, outcome)
        _put(out, job.path, outcome, tell, sha256=job.sha256)
    out.logs.sort()
    out.errors.sort(key=lambda error: (error["path"], error["text"]))
    return out


def _hashed(path: Path, failed: Callable[[str, str], None]) -> Job | None:
    try:
        if not path.is_file():
            failed(str(path), f"{path}: is not a regular file; give a .tlog, .bin, .log or .ulg file")
            return None
        sha256, size = sha256_of(path)
    except OSError as error:
        failed(str(path), f"{path}: cannot be read: {error.strerror}; look at its permissions, or copy it again")
        return None
    return Job(shown(path), os.path.abspath(path), sha256, size)


def shown(path: str | Path) -> str:
    """The name as text that any file can hold; a name's bytes need not be UTF-8."""
    return str(path).encode("utf-8", "surrogateescape").decode("utf-8", "replace")


def _put(
    out: Run, path: str, outcome: Result, tell: Callable[[Told], None], *, sha256: str = "", again: bool = False
) -> None:
    error = outcome.get("error")
    if error is None:
        out.logs.append((path, sha256))
    else:
        out.errors.append({"path": path, "code": error["code"], "text": error["text"]})
    tell(Told("ended", path, error="" if error is None else error["text"], again=again))


def cores() -> int:
    """How many this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
