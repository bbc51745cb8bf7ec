"""Commands on a live link: run, upload, restore; and history, what they left on record."""

from __future__ import annotations

import argparse
import logging
import math
import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType
from typing import Any

from rich.console import Group

from magmav.commands.common import Refused, Result, settings_of, show, signer_of, stderr_console
from magmav.core.types import Change, Reading, Reason, Record
from magmav.geomag import world_magnetic_model
from magmav.link import Link, LinkError
from magmav.settings import SettingsError, with_value

_log = logging.getLogger("magmav")


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


def run(o: argparse.Namespace) -> int:
    """The service, until stopped."""
    from magmav.coaching import Coaching
    from magmav.fleet import serve
    from magmav.link.many import open_links
    from magmav.link.recorder import TlogRecorder
    from magmav.notify import Notifier
    from magmav.store import Store, default_path
    from magmav.view.records import RecordWriter
    from magmav.view.reporter import Reporter

    settings = settings_of(o)
    if o.no_requests:
        for key in ("imu_hz", "attitude_hz", "slow_hz"):
            settings = with_value(settings, "wire", key, 0.0)
    with ExitStack() as stack:
        store = stack.enter_context(Store(o.store or default_path()))
        signer = signer_of(o, store.path)
        link = bare = open_links([_alive(text) for text in o.link])
        if o.record is not None:
            link = TlogRecorder(link, o.record)
        stopped = stack.enter_context(_until_signal(link))
        watchers: list[Callable[[Reading, Record | None], None]] = [Reporter(o.json)]
        if o.records is not None:
            writer = stack.enter_context(RecordWriter(o.records))
            watchers.append(lambda reading, record: None if record is None else writer.write(record))
        service = serve(link, settings, world_magnetic_model, store, watchers, signer=signer)
        coaching = Coaching(service.pipeline.vehicles, lambda text, _: _log.warning("%s", text))
        service.watchers += (lambda reading, record: None if record is None else coaching.on_record(record),)
        _warn(bare)  # a recorder around it has no port and warns of nothing
        ports = ", ".join(str(one.port) for one in getattr(bare, "links", (bare,)) if hasattr(one, "port"))
        _log.warning("listening on %s%s; stop with Ctrl-C", link.name, f" (port {ports})" if ports else "")
        until = _Deadline(o.for_s)
        notifier = Notifier.from_environment()
        notifier.ready(f"listening on {link.name}")

        def over() -> bool:
            """Asked after every packet and quiet tick, so who watches us sees that the work goes on."""
            ends = stopped() or until(service.now_ns)
            if ends:
                notifier.stopping()
            else:
                notifier.beat(service.now_ns)
            return ends

        service.run(over)
    return 0


class _Deadline:
    """True once so many seconds of link time have passed."""

    def __init__(self, for_s: float | None) -> None:
        self._for_ns = math.inf if for_s is None else for_s * 1e9
        self._first_ns: int | None = None

    def __call__(self, now_ns: int) -> bool:
        self._first_ns = now_ns if self._first_ns is None else self._first_ns
        return now_ns - self._first_ns >= self._for_ns


def _alive(text: str) -> str:
    """The text of a live link; a recording is no place to send anything to (S15)."""
    if text.lower().endswith((".tlog", ".bin", ".log", ".ulg")):
        raise LinkError(f"{text}: a recording is not a live link; use `magmav replay`")
    return text


def _warn(link: Link) -> None:
    warning = getattr(link, "warning", "")
    if warning:
        _log.warning("%s", warning)


def _transact(o: argparse.Namespace, pick: Callable[[Any, Any, int], Any], confirm: int | None) -> Result:
    from magmav.link.open import open_link
    from magmav.live import Session, transact
    from magmav.store import Store, default_path

    settings = settings_of(o)
    with ExitStack() as stack:
        store = stack.enter_context(Store(o.store or default_path()))
        signer = signer_of(o, store.path)
        link = open_link(_alive(o.link))
        stopped = stack.enter_context(_until_signal(link))
        _warn(link)
        session = Session.on(link, settings, world_magnetic_model, store, ask=False, signer=signer)
        say = stderr_console()
        return transact(
            session,
            link,
            o.compass,
            lambda device: pick(store, session.companion, device),
            confirm=confirm,
            dry=o.dry_run,
            wait_s=o.wait,
            progress=lambda text: say.print(text),
            stop=stopped,
        )


def upload(o: argparse.Namespace) -> int:
    """Write what was learnt, with proof."""
    from magmav.saved_result import NotReady, change_from_result

    try:
        given = None if o.source is None else change_from_result(o.source, o.compass)
    except NotReady as error:
        raise Refused(str(error)) from None

    def pick(store: Any, companion: Any, device: int) -> Change | Reason:
        if given is not None:
            return given
        saved = store.latest_estimate(companion.presence.system, device, companion.writer.vehicle)
        return Reason.NO_CALIBRATION if saved is None else saved.change

    return _ended(o, _transact(o, pick, o.confirm_change), ("ALL_NEW",))


def restore(o: argparse.Namespace) -> int:
    """Undo the last upload."""

    def pick(store: Any, companion: Any, device: int) -> Any:
        system, vehicle = companion.presence.system, companion.writer.vehicle
        return store.last_restorable(system, o.compass, device, vehicle) or Reason.NO_SNAPSHOT

    return _ended(o, _transact(o, pick, None), ("ALL_OLD",))


def _ended(o: argparse.Namespace, result: Result, good: tuple[str, ...]) -> int:
    from magmav.view.table import write_view

    show(o, result, write_view)
    return 0 if result.get("dry_run") or result.get("result") in good else 1


def history(o: argparse.Namespace) -> int:
    """Every write on record, and what every flight taught."""
    from magmav.learnt import shadows
    from magmav.live import history_entry
    from magmav.store import Store, default_path
    from magmav.view.learnt import learnt_view
    from magmav.view.table import history_view

    if o.limit < 1:
        raise SettingsError(f"--limit: want 1 or more, got {o.limit}")
    path = o.store or default_path()
    rows: list[Result] = []
    learnt: list[Result] = []
    if path.exists():
        with Store(path) as store:
            if o.dismiss is not None:
                if o.dismiss not in {row.id for row in store.pending()}:
                    raise Refused(f"{path}: no write {o.dismiss} waits to be undone")
                store.dismiss(o.dismiss)
            rows = [history_entry(row) for row in store.history(o.limit)]
            learnt = shadows(store.learnt())[: o.limit]
    result = {"store": str(path), "writes": rows, "learnt": learnt}
    show(o, result, lambda result: Group(history_view(result["writes"]), learnt_view(result["learnt"])))
    return 0
