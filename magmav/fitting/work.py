"""One log of many, wherever it is worked on: an entry, or what is wrong with it. Never an error of its own."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from magmav.fitting import FitOptions, fit
from magmav.fitting.ledger import sha256_of
from magmav.link import LinkError
from magmav.logs import LogError, Progress
from magmav.recording import NothingToLearnFrom
from magmav.reference import TruthError
from magmav.settings import Settings

Result = dict[str, Any]
INPUT, FAULT = 3, 1
"""Codes of an error, as the exit codes of the command: the file's, or ours."""


@dataclass(frozen=True, slots=True)
class Job:
    """One log to be done.

    path : as the user gave it, which is how it is called in every text.  place : where it is found from anywhere.
    """

    path: str
    place: str
    sha256: str
    size: int


def refused(text: str, code: int = INPUT, *, lasting: bool = False) -> Result:
    """An outcome that is none. lasting : the same bytes would end the same way, so it need not be tried again."""
    return {"error": {"code": code, "text": text}, "lasting": lasting}


def work(job: Job, settings: Settings, options: FitOptions, progress: Progress | None = None) -> Result:
    """{"entry": ...}, or what ``refused`` gives. Only a fault of ours is raised."""
    try:
        entry = fit(job.place, settings, options=options, progress=progress)
    except (LogError, LinkError, NothingToLearnFrom) as error:
        return refused(str(error).replace(job.place, job.path), lasting=_lasting(error, job))
    except TruthError as error:
        return refused(str(error))
    except OSError as error:
        why = error.strerror or str(error)
        return refused(f"{job.path}: cannot be read: {why}; look at its permissions, or copy it again")
    except MemoryError:
        return refused(f"{job.path}: there was not enough memory; try again with --jobs 1")
    if entry["file"]["sha256"] != job.sha256:
        return refused(f"{job.path}: changed while it was read; run the same command again when it is complete")
    entry["source"] = entry["file"]["path"] = job.path
    return {"entry": entry}


def _lasting(error: Exception, job: Job) -> bool:
    """The file's content is to blame, not the way to it, and the content is what was meant."""
    if isinstance(error.__cause__ or error.__context__, OSError):
        return False
    try:
        return sha256_of(Path(job.place))[0] == job.sha256
    except OSError:
        return False


def named(outcome: Result, path: str) -> Result:
    """The outcome of the same bytes under another name, as a fit of that name would have told it."""
    entry, error = outcome.get("entry"), outcome.get("error")
    if entry is not None:
        return {"entry": entry | {"source": path, "file": entry["file"] | {"path": path}}}
    if error is not None and error.get("path", path) != path:
        return outcome | {"error": error | {"path": path, "text": error["text"].replace(error["path"], path)}}
    return outcome
