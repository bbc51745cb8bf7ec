"""magmav fit: the best answer after the flight."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from magmav.commands.common import progress_bar, settings_of, show, spare_the_collector


def fit(o: argparse.Namespace) -> int:
    """One log or many."""
    from magmav.commands.fit_many import LOGS, remember, run_many, wanted, write_logs
    from magmav.fitting import FitOptions
    from magmav.fitting import fit as run
    from magmav.view.fit import fit_view

    spare_the_collector()
    settings = settings_of(o)
    options = FitOptions(o.soft_iron, o.motor, o.scale, None if o.reference is None else str(o.reference))
    if wanted(o):
        return run_many(o, settings, options)
    if o.report is not None:
        from magmav.view.report import check_report_name, write_report

        check_report_name(o.report)  # before minutes of work, not after
    entries: list[dict[str, Any]] = []
    for path in o.logs:
        with ExitStack() as stack:
            entries.append(run(path, settings, options=options, progress=progress_bar(stack, path.name)))
    if o.params is not None:
        write_parameters(entries[0], o.params)
    if o.report is not None:
        write_report(entries[0], o.report)
    if o.out is not None:
        write_logs(entries, o.out / LOGS)
    if o.store is not None:
        remember(o.store, entries)
    show(o, {"logs": entries}, fit_view)
    return 0


def write_parameters(entry: dict[str, Any], path: Path) -> None:
    """What changed, as the file's ending says: .params for QGroundControl, else NAME,VALUE."""
    from magmav.fitting.parameters import file_of

    text = file_of(entry, path.suffix)
    half = path.with_name(f"{path.name}.part")
    half.write_text(text, encoding="utf-8")
    half.replace(path)  # whole or not at all
