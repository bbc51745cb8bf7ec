"""Commands on recordings: replay and compare."""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from magmav.commands.common import Refused, progress_bar, settings_of, show, spare_the_collector, stderr_console
from magmav.core.types import Reading, Record
from magmav.geomag import world_magnetic_model
from magmav.settings import SettingsError
from magmav.view.drawing import check_name


def replay(o: argparse.Namespace) -> int:
    """A recording through the pipeline."""
    from magmav.recording import open_recording
    from magmav.recording import replay as run
    from magmav.view.records import RecordWriter
    from magmav.view.table import replay_view
    from magmav.view.timeline import Timeline

    if o.learn_for is not None and not o.learn_for > 0.0:
        raise SettingsError(f"--learn-for: want seconds above 0, got {o.learn_for:g}")
    if o.after_flight and o.learn_for is not None:
        raise SettingsError("--after-flight: takes all of the flight; leave out --learn-for")
    if o.every is not None and not o.every > 0.0:
        raise SettingsError(f"--every: want seconds above 0, got {o.every:g}")
    spare_the_collector()
    settings = settings_of(o)
    if o.plot is not None:
        check_name(o.plot)
    with ExitStack() as stack:
        progress = progress_bar(stack, o.log.name)
        recording = open_recording(o.log, progress)
        stack.callback(recording.close)
        watchers: list[Callable[[Reading, Record | None], None]] = []
        if o.records is not None:
            writer = stack.enter_context(RecordWriter(o.records))
            watchers.append(lambda reading, record: None if record is None else writer.write(record))
        traces = None
        if o.plot is not None:
            from magmav.view.plots import TraceCollector

            traces = TraceCollector()
            watchers.append(lambda reading, record: None if record is None else traces.add(record))
        references: dict[int, Any] = {}
        afterwards = None
        if o.after_flight:
            from magmav.afterwards import Afterwards

            afterwards = Afterwards()
        timeline = Timeline(o.every) if o.every is not None else None
        if timeline is not None:
            watchers.append(timeline)
        result = run(
            recording,
            settings,
            world_magnetic_model,
            source=str(o.log),
            learn_for_s=o.learn_for,
            reference_csv=o.reference,
            watchers=watchers,
            references=references,
            tap=None if afterwards is None else afterwards.tap,
        )
    if afterwards is not None:
        afterwards.add_to(result, references)
    if timeline is not None:
        result["timeline"] = timeline.rows
    if traces is not None:
        from magmav.picture import draw_replay

        draw_replay(o.plot, traces.traces(), result, references)
    if timeline is not None and not o.json:
        for line in timeline.lines():
            sys.stdout.write(line + "\n")
    show(o, result, replay_view)
    return 0


def compare(o: argparse.Namespace) -> int:
    """Every estimator on one recording, or on one simulated flight."""
    from magmav_sim.scenario_file import scenario_files

    from magmav.comparison import compare as run
    from magmav.recording import open_recording
    from magmav.view.compare import compare_view

    settings = settings_of(o)
    if o.plot is not None:
        check_name(o.plot)
    only = [] if o.only is None else [name.strip() for name in o.only.split(",")]
    simulated = str(o.log) in scenario_files() and not o.log.is_file()
    if simulated and o.reference is not None:
        raise SettingsError(f"--reference: {o.log} is a simulated flight and is judged by its own truth")
    if not simulated and o.seed is not None:
        raise SettingsError(f"--seed: only a scenario has one, and {o.log} is none of {', '.join(scenario_files())}")
    with ExitStack() as stack:
        path, truth = o.log, [] if o.reference is None else [o.reference]
        if simulated:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="magmav-compare-")))
            path, truth = flown(str(o.log), folder, o.seed)
        recording = open_recording(path, progress_bar(stack, o.log.name))
        stack.callback(recording.close)
        console = stderr_console()
        tapes: Any = {} if o.plot is not None else None
        result = run(
            recording,
            settings,
            world_magnetic_model,
            clock=time.perf_counter,
            source=str(o.log),
            reference_csvs=truth,
            reference_name="the simulator's truth" if simulated else None,
            only=only,
            progress=lambda text: console.print(text, style="dim"),
            tapes=tapes,
        )
    if o.plot is not None:
        from magmav.view.plot_compare import Cloud, plot_compare

        clouds = {
            key: Cloud(c.sensor_b_mg[c.learn], c.roll_rad[c.learn], c.pitch_rad[c.learn]) for key, c in tapes.items()
        }
        plot_compare(o.plot, result, clouds)
    show(o, result, compare_view)
    return 0


def flown(scenario: str, folder: Path, seed: int | None) -> tuple[Path, list[Path]]:
    """A simulated flight on file: the recording, and its truth as reference files, one per boot."""
    from magmav_sim.__main__ import main as simulate

    path = folder / f"{scenario}.tlog"
    words = [scenario, "--write", str(path), "--truth", str(folder)]
    if simulate(words if seed is None else [*words, "--seed", str(seed)]) != 0:
        raise Refused(f"{scenario}: the simulated flight could not be flown")
    return path, by_boot(folder / "truth.csv")


def by_boot(truth: Path) -> list[Path]:
    """The simulator's truth cut where its boot time begins again."""
    header, *rows = truth.read_text(encoding="utf-8").splitlines()
    boots: list[list[str]] = []
    before = math.inf
    for row in rows:
        now = float(row.split(",", 1)[0])
        if now <= before:
            boots.append([header])
        boots[-1].append(row)
        before = now
    out = [truth.with_name(f"truth_{number}.csv") for number in range(len(boots))]
    for path, lines in zip(out, boots, strict=True):
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return out
