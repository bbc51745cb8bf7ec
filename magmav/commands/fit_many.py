"""magmav fit for folders and several logs: processes or a cluster, a ledger, one table."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from magmav.commands.common import Refused, finite, show, stderr_console
from magmav.fitting import FitOptions
from magmav.fitting.ledger import Ledger, work_key
from magmav.fitting.many import Run, Told, fit_many
from magmav.reference import Reference
from magmav.settings import Settings, SettingsError

FOLDER, LEDGER, LOGS = Path("magmav-fit"), "ledger.jsonl", "logs"
INPUT = 3


def wanted(o: argparse.Namespace) -> bool:
    """Is this a run over many logs?"""
    return len(o.logs) > 1 or o.dask is not None or o.resume or any(path.is_dir() for path in o.logs)


def run_many(o: argparse.Namespace, settings: Settings, options: FitOptions) -> int:
    """Exit code 0 where at least one log gave an answer, else 3. Each log's error is told on standard error."""
    from magmav.view.many import many_view

    if o.params is not None or o.report is not None:
        raise SettingsError("--params, --report: one file is for one log; --out DIR gives every log its own")
    if o.jobs is not None and o.jobs < 1:
        raise SettingsError(f"--jobs: want 1 or more, got {o.jobs}")
    if o.reference is not None:
        Reference.from_csv(o.reference)  # said once, not for every log
    out = o.out or FOLDER
    if o.resume and not (out / LEDGER).is_file():
        raise Refused(f"{out / LEDGER}: no ledger to go on from; give the --out of the run that was cut short")
    with ExitStack() as stack:
        ledger = stack.enter_context(Ledger(out / LEDGER, work_key(settings, options)))
        with Watching() as watching:
            run = fit_many(o.logs, settings, options, ledger, jobs=o.jobs, dask=o.dask, tell=watching)
        table = finite(run.table(ledger))
        files = write_tables(table, out)
        write_logs(run.entries(ledger), out / LOGS)
        if o.store is not None:
            remember(o.store, run.entries(ledger))
        if o.json:
            _write_json(run, ledger, table)
        else:
            show(o, table, many_view)
            sys.stdout.write(f"written: {', '.join(map(str, files))}\n")
    return 0 if run.logs else INPUT


def write_tables(table: dict[str, Any], out: Path) -> list[Path]:
    """fits.json, fits.csv and fits.html, each whole or not at all."""
    from magmav.view.many import many_csv, many_html

    texts = {"json": json.dumps(table, indent=1) + "\n", "csv": many_csv(table), "html": many_html(table)}
    files = []
    for ending, text in texts.items():
        path = out / f"fits.{ending}"
        part = path.with_name(f"{path.name}.part")
        part.write_text(text, encoding="utf-8")
        os.replace(part, path)
        files.append(path)
    return files


def write_logs(entries: Iterable[dict[str, Any]], folder: Path) -> None:
    """A report of each log, and a parameter file of each vehicle in it that has something to change."""
    from magmav.fitting.parameters import file_of
    from magmav.view.many import report_name
    from magmav.view.report import write_report, write_whole

    folder.mkdir(parents=True, exist_ok=True)
    for entry in entries:
        path = folder / report_name(entry["file"]["path"], entry["file"]["sha256"])
        write_report(finite(entry), path)
        for vehicle in entry["vehicles"]:
            several = f"-system{vehicle['system']}" if len(entry["vehicles"]) > 1 else ""
            fits = [compass["fit"] for compass in vehicle["compasses"] if compass["fit"] is not None]
            if any(fit["parameters"]["changed"] for fit in fits):
                text = file_of(entry | {"vehicles": [vehicle]}, ".param")
                write_whole(path.with_name(f"{path.stem}{several}.param"), text)


def remember(path: Path, entries: Iterable[dict[str, Any]]) -> None:
    """Put what was learnt into the store's history; doing it again changes nothing."""
    from magmav.learnt import learnt_of_entry
    from magmav.store import Store

    with Store(path) as store:
        for entry in entries:
            store.learn(learnt_of_entry(entry))


def _write_json(run: Run, ledger: Ledger, table: dict[str, Any]) -> None:
    """One document, an entry at a time: a fleet's entries together may not fit into memory."""
    sys.stdout.write('{"logs": [')
    for number, entry in enumerate(run.entries(ledger)):
        sys.stdout.write((", " if number else "") + json.dumps(finite(entry)))
    sys.stdout.write(f'], "table": {json.dumps(table)}}}\n')


class Watching:
    """Progress on standard error where somebody watches; what went wrong is told there in any case, a line a log."""

    def __init__(self) -> None:
        self._bars: Progress | None = None
        self._all = TaskID(0)
        self._ones: dict[str, TaskID] = {}

    def __enter__(self) -> Callable[[Told], None]:
        if sys.stderr.isatty():
            columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
            self._bars = Progress(*columns, console=stderr_console())
            self._all = self._bars.add_task("logs", total=None)
            self._bars.start()
        return self._tell

    def __exit__(self, *error: object) -> None:
        if self._bars is not None:
            self._bars.stop()

    def _tell(self, told: Told) -> None:
        bars = self._bars
        if told.error:
            line = "".join(c if c.isprintable() else "?" for c in f"magmav: {told.error}")
            if bars is not None:
                bars.console.print(line, markup=False)
            else:
                sys.stderr.write(f"{line}\n")
        if bars is None:
            return
        if told.what == "found":
            bars.update(self._all, total=told.total)
        elif told.what == "begun":
            self._ones[told.path] = bars.add_task(Path(told.path).name.replace("[", "("), total=None)
        elif told.what == "progress" and told.path in self._ones:
            bars.update(self._ones[told.path], completed=told.done, total=told.total)
        elif told.what == "ended":
            bars.advance(self._all)
            if told.path in self._ones:
                bars.remove_task(self._ones.pop(told.path))
