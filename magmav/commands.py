"""What each command does, from parsed options to an exit code. Results go to standard output, progress to error."""

from __future__ import annotations

import argparse
import json
import logging
import math
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import msgspec
from rich.console import Console, RenderableType
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from magmav.core.types import Change, Reading, Reason, Record
from magmav.geomag import world_magnetic_model
from magmav.link import Link, LinkError
from magmav.settings import Settings, SettingsError, as_toml, checked, load, with_value

_log = logging.getLogger("magmav")
Result = dict[str, Any]


class Refused(Exception):
    """An action that was asked for and not done."""


def _settings(o: argparse.Namespace) -> Settings:
    settings = load(o.config)
    for option, section, key in (
        ("system", "vehicle", "system"),
        ("lat", "place", "lat_deg"),
        ("lon", "place", "lon_deg"),
        ("alt", "place", "alt_m"),
    ):
        value = getattr(o, option, None)
        if value is not None:
            part = msgspec.structs.replace(getattr(settings, section), **{key: value})
            settings = msgspec.structs.replace(settings, **{section: part})
    settings = msgspec.convert(msgspec.to_builtins(settings), Settings)
    return checked(settings, "command line")


def _show(o: argparse.Namespace, result: Result, view: Callable[[Any], RenderableType]) -> None:
    if o.json:
        sys.stdout.write(json.dumps(finite(result)) + "\n")
    else:
        width = None if sys.stdout.isatty() else 120  # a pipe has no width of its own
        Console(file=sys.stdout, highlight=False, width=width).print(view(result))


def finite(value: Any) -> Any:
    """The same tree with every number that is not finite as None: JSON knows no NaN."""
    if isinstance(value, dict):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value


def _console() -> Console:
    return Console(stderr=True, highlight=False)


@contextmanager
def _until_signal(link: Link) -> Iterator[Callable[[], bool]]:
    """SIGTERM and Ctrl-C end the work cleanly: one more turn, then last words."""
    hit: list[int] = []

    def stop(number: int, frame: FrameType | None) -> None:
        hit.append(number)

    before = {n: signal.signal(n, stop) for n in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield lambda: bool(hit)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        link.close()


# ---------------------------------------------------------------- recordings


def replay(o: argparse.Namespace) -> int:
    """A recording through the pipeline."""
    from magmav.recording import open_recording
    from magmav.recording import replay as run
    from magmav.view.records import RecordWriter
    from magmav.view.table import replay_view
    from magmav.view.timeline import Timeline

    if o.learn_for is not None and not o.learn_for > 0.0:
        raise SettingsError(f"--learn-for: want seconds above 0, got {o.learn_for:g}")
    if o.every is not None and not o.every > 0.0:
        raise SettingsError(f"--every: want seconds above 0, got {o.every:g}")
    settings = _settings(o)
    with ExitStack() as stack:
        progress = _progress(stack, o.log.name)
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
        )
    if timeline is not None:
        result["timeline"] = timeline.rows
    if traces is not None:
        from magmav.picture import draw_replay

        draw_replay(o.plot, traces.traces(), result, references)
    if timeline is not None and not o.json:
        for line in timeline.lines():
            sys.stdout.write(line + "\n")
    _show(o, result, replay_view)
    return 0


def _progress(stack: ExitStack, name: str) -> Callable[[int, int], None] | None:
    """A bar on standard error, where somebody watches."""
    if not sys.stderr.isatty():
        return None
    bar = stack.enter_context(
        Progress(TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn(), console=_console())
    )
    task = bar.add_task(name)
    return lambda done, total: bar.update(task, completed=done, total=total)


# ---------------------------------------------------------------- live


def run(o: argparse.Namespace) -> int:
    """The service, until stopped."""
    from magmav.link.open import open_link
    from magmav.link.recorder import TlogRecorder
    from magmav.live import Session
    from magmav.store import Store, default_path
    from magmav.view.records import RecordWriter
    from magmav.view.reporter import Reporter

    settings = _settings(o)
    if o.no_requests:
        for key in ("imu_hz", "attitude_hz", "slow_hz"):
            settings = with_value(settings, "wire", key, 0.0)
    with ExitStack() as stack:
        store = stack.enter_context(Store(o.store or default_path()))
        link: Link = _live(o.link, open_link)
        if o.record is not None:
            link = TlogRecorder(link, o.record)
        stopped = stack.enter_context(_until_signal(link))
        watchers: list[Callable[[Reading, Record | None], None]] = [Reporter(o.json)]
        if o.records is not None:
            writer = stack.enter_context(RecordWriter(o.records))
            watchers.append(lambda reading, record: None if record is None else writer.write(record))
        session = Session.on(link, settings, world_magnetic_model, store, watchers)
        _warn(link)
        port = getattr(link, "port", None)
        _log.warning("listening on %s%s; stop with Ctrl-C", link.name, f" (port {port})" if port else "")
        until = _Deadline(o.for_s)
        session.service.run(lambda: stopped() or until(session.service.now_ns))
    return 0


class _Deadline:
    """True once so many seconds of link time have passed."""

    def __init__(self, for_s: float | None) -> None:
        self._for_ns = math.inf if for_s is None else for_s * 1e9
        self._first_ns: int | None = None

    def __call__(self, now_ns: int) -> bool:
        self._first_ns = now_ns if self._first_ns is None else self._first_ns
        return now_ns - self._first_ns >= self._for_ns


def _live(text: str, open_link: Callable[..., Link]) -> Link:
    """A live link; a recording is no place to send anything to (S15)."""
    if text.lower().endswith((".tlog", ".bin", ".log", ".ulg")):
        raise LinkError(f"{text}: a recording is not a live link; use `magmav replay`")
    return open_link(text)


def _warn(link: Link) -> None:
    warning = getattr(link, "warning", "")
    if warning:
        _log.warning("%s", warning)


def _transact(o: argparse.Namespace, pick: Callable[[Any, int, int], Any], confirm: int | None) -> Result:
    from magmav.link.open import open_link
    from magmav.live import Session, transact
    from magmav.store import Store, default_path

    settings = _settings(o)
    with ExitStack() as stack:
        store = stack.enter_context(Store(o.store or default_path()))
        link = _live(o.link, open_link)
        stopped = stack.enter_context(_until_signal(link))
        _warn(link)
        session = Session.on(link, settings, world_magnetic_model, store, ask=False)
        console = _console()
        return transact(
            session,
            link,
            o.compass,
            lambda device: pick(store, session.companion.presence.system, device),
            confirm=confirm,
            dry=o.dry_run,
            wait_s=o.wait,
            progress=lambda text: console.print(text),
            stop=stopped,
        )


def upload(o: argparse.Namespace) -> int:
    """Write what was learnt, with proof."""
    from magmav.saved_result import NotReady, change_from_result

    try:
        given = None if o.source is None else change_from_result(o.source, o.compass)
    except NotReady as error:
        raise Refused(str(error)) from None

    def pick(store: Any, system: int, device: int) -> Change | Reason:
        if given is not None:
            return given
        saved = store.latest_estimate(system, device)
        return Reason.NO_CALIBRATION if saved is None else saved.change

    return _ended(o, _transact(o, pick, o.confirm_change), ("ALL_NEW",))


def restore(o: argparse.Namespace) -> int:
    """Undo the last upload."""

    def pick(store: Any, system: int, device: int) -> Any:
        return store.last_restorable(system, o.compass, device) or Reason.NO_SNAPSHOT

    return _ended(o, _transact(o, pick, None), ("ALL_OLD",))


def _ended(o: argparse.Namespace, result: Result, good: tuple[str, ...]) -> int:
    from magmav.view.table import write_view

    _show(o, result, write_view)
    return 0 if result.get("dry_run") or result.get("result") in good else 1


def history(o: argparse.Namespace) -> int:
    """Every write on record."""
    from magmav.live import history_entry
    from magmav.store import Store, default_path
    from magmav.view.table import history_view

    if o.limit < 1:
        raise SettingsError(f"--limit: want 1 or more, got {o.limit}")
    path = o.store or default_path()
    rows: list[Result] = []
    if path.exists():
        with Store(path) as store:
            if o.dismiss is not None:
                if o.dismiss not in {row.id for row in store.pending()}:
                    raise Refused(f"{path}: no write {o.dismiss} waits to be undone")
                store.dismiss(o.dismiss)
            rows = [history_entry(row) for row in store.history(o.limit)]
    _show(o, {"store": str(path), "writes": rows}, lambda result: history_view(result["writes"]))
    return 0


def settings(o: argparse.Namespace) -> int:
    """The table of knobs."""
    if o.json:
        from magmav.settings import knobs

        sys.stdout.write(json.dumps(finite([msgspec.to_builtins(k) for k in knobs()])) + "\n")
    else:
        sys.stdout.write(as_toml())
    return 0


def demo(o: argparse.Namespace) -> int:
    """The main job, on a simulated aircraft."""
    from magmav.demo import demo as play
    from magmav.view.table import demo_view

    console = _console()
    with ExitStack() as stack:
        folder = o.out or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="magmav-demo-")))
        plot = o.plot or (o.out / "demo.png" if o.out is not None else None)
        result = play(
            _settings(o),
            world_magnetic_model,
            folder,
            seed=o.seed,
            plot=plot,
            progress=lambda text: console.print(text),
        )
        if o.out is None:
            result["folder"] = None
        else:
            (o.out / "demo.json").write_text(json.dumps(finite(result), indent=1) + "\n", encoding="utf-8")
    _show(o, result, demo_view)
    if not o.json:
        sys.stdout.write(json.dumps(finite(result)) + "\n")
    good = result["upload"]["result"] == "ALL_NEW" and result["restore"]["result"] == "ALL_OLD"
    return 0 if good else 1


COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {
    "demo": demo,
    "run": run,
    "replay": replay,
    "upload": upload,
    "restore": restore,
    "history": history,
    "settings": settings,
}
