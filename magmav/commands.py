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

from magmav.core.types import Change, Reading, Reason, Record, vec3
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
        Console(file=sys.stdout, highlight=False).print(view(result))


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
    from magmav.link.tlog import TlogLink
    from magmav.replay import replay as run
    from magmav.view.records import RecordWriter
    from magmav.view.table import replay_view

    if o.learn_for is not None and not o.learn_for > 0.0:
        raise SettingsError(f"--learn-for: want seconds above 0, got {o.learn_for:g}")
    if o.every is not None and not o.every > 0.0:
        raise SettingsError(f"--every: want seconds above 0, got {o.every:g}")
    settings = _settings(o)
    with ExitStack() as stack:
        progress = _progress(stack, o.log.name)
        link = TlogLink(o.log, progress)
        stack.callback(link.close)
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
            link,
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


class Timeline:
    """What was known every so many seconds of each compass's boot time, with the error against ATTITUDE yaw."""

    def __init__(self, every_s: float) -> None:
        self._every_ns = every_s * 1e9
        self._next: dict[tuple[int, int], float] = {}
        self._yaw: dict[int, float] = {}
        self.rows: list[Result] = []

    def __call__(self, reading: Reading, record: Record | None) -> None:
        """Watch one reading."""
        from magmav.core.types import AttitudeReading

        if isinstance(reading, AttitudeReading):
            self._yaw[reading.system] = reading.yaw_rad
        if record is None:
            return
        key = (record.system, record.compass)
        if record.boot_ns < self._next.get(key, -math.inf) - 2 * self._every_ns:
            self._next[key] = -math.inf  # the vehicle rebooted
        if record.boot_ns >= self._next.get(key, -math.inf):
            self._next[key] = record.boot_ns + self._every_ns
            self.rows.append(self._row(record))

    def _row(self, r: Record) -> Result:
        known = r.estimate.samples > 0
        yaw = self._yaw.get(r.system)
        error = None
        if yaw is not None and r.heading.true_valid:
            error = round(math.degrees(math.remainder(r.heading.true_rad - yaw, math.tau)), 2)
        return {
            "boot_s": round(r.boot_ns / 1e9, 3),
            "system": r.system,
            "compass": r.compass,
            "offsets_mg": [round(float(v), 1) for v in r.offsets_mg] if known else None,
            "sigma_mg": [round(float(v), 1) for v in r.sigma_mg] if known else None,
            "axes": [a.value for a in r.verdict.axes],
            "state": r.verdict.state.name,
            "reasons": [x.name for x in r.verdict.reasons],
            "heading_error_deg": error,
            "learnt": r.learnt,
        }

    def lines(self) -> Iterator[str]:
        """The rows for people."""
        yield "boot s     compass  offsets x y z mG (+- sigma)                     state     heading error deg"
        for r in self.rows:
            if r["offsets_mg"] is None:
                offsets = "not known"
            else:
                pairs = zip(r["offsets_mg"], r["sigma_mg"], strict=True)
                offsets = "  ".join(f"{o:7.1f} +-{s:5.1f}" for o, s in pairs)
            error = "not known" if r["heading_error_deg"] is None else f"{r['heading_error_deg']:+.1f}"
            yield f"{r['boot_s']:9.1f}  {r['compass']:^7}  {offsets:<48}  {r['state']:<9} {error}"


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
    from magmav.reporter import Reporter
    from magmav.store import Store, default_path
    from magmav.view.records import RecordWriter

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
        _log.warning("listening on %s; stop with Ctrl-C", link.name)
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
    if text.lower().endswith(".tlog"):
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
        session = Session.on(link, settings, world_magnetic_model, store)
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
    given = None if o.source is None else from_result(o.source, o.compass)

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


def from_result(path: Path, compass: int) -> Change:
    """The change that a saved `magmav replay --json` asks for. SettingsError naming what is missing in the file."""
    from magmav.mavlink.autopilot.ardupilot import Calibrations, plan_change

    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise LinkError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, UnicodeDecodeError):
        raise SettingsError(f"{path}: not JSON; save the output of `magmav replay --json` there") from None
    found = [(v, c) for v in tree.get("vehicles", []) for c in v["compasses"] if c["compass"] == compass]
    if len(found) != 1:
        raise SettingsError(f"{path}: want one vehicle with compass {compass}, found {len(found)}")
    vehicle, entry = found[0]
    if entry["state"] != "READY" or entry["hard_iron_mg"] is None:
        why = "; ".join(r["text"] for r in entry["reasons"]) or entry["state"]
        raise Refused(f"{path}: compass {compass} is not ready to be written: {why}")
    held = Calibrations()
    from magmav.core.types import ParamReading

    for name, value in entry["stored"].items():
        held.param(ParamReading(vehicle["system"], 1, name, float(value), 65535, 0))
    x, y, z = (axis != "NOT_OBSERVED" for axis in entry["axes"])
    iron, sigma = vec3(entry["hard_iron_mg"], "hard_iron_mg"), vec3(entry["sigma_mg"], "sigma_mg")
    change = plan_change(held, vehicle["system"], compass, iron, sigma, (x, y, z))
    if change is None:
        raise Refused(f"{path}: stored offsets or device id of compass {compass} are not in it")
    return change


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
    _show(o, result, demo_view)
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
