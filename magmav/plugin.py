"""magmav inside a ground station's console: text commands over a Session, turned in a thread of its own.

Knows no ground station; magmav/mavproxy.py puts it into MAVProxy. The host pushes frames into a FedLink, gives
commands as words, and shows the lines that come back. Loading and learning never hold the host up.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path

from magmav.coaching import Coaching
from magmav.companion import MagCompanion, wanted_rates
from magmav.core.types import Change, FieldModel, Reading, Reason, Record, State
from magmav.dry import every_message
from magmav.link.fed import FedLink
from magmav.live import Session, history_entry
from magmav.mavlink.change import code_needed
from magmav.mavlink.upload import Upload
from magmav.own_params import COMPASSES
from magmav.settings import Settings, with_value
from magmav.store import Store, StoreError
from magmav.view.reporter import sentence

COMMANDS = ("status", "upload", "restore", "history")
USAGE = (
    "magmav status                            what is known of each compass, and what is being written",
    "magmav upload [1|2|3] [--dry-run] [--confirm-change CODE]   write what was learnt, with proof",
    "magmav restore [1|2|3] [--dry-run]       bring back the values from before the last upload",
    "magmav history [N]                       the last writes, and how they ended",
)
_HISTORY, _MOST_HISTORY = 10, 200
_KINDS = {3: "ArduPilot", 12: "PX4"}  # MAV_AUTOPILOT


class Desk:
    """Answers commands and tells news; call it from the thread that turns the session, between packets."""

    def __init__(self, session: Session, store: Store, heard: Callable[[], Iterable[int]] = tuple) -> None:
        self._session = session
        self._heard = heard
        self._told: set[int] = set()
        self._companion = session.companion
        self._store = store
        self._latest: dict[tuple[int, int], Record] = {}
        self._states: dict[tuple[int, int], State] = {}
        self._news: list[str] = []
        self._ended: Upload | None = session.companion.ended
        self._shown = ""
        self._coaching = Coaching(session.pipeline.vehicles, lambda text, _: self._news.append(text))

    def watch(self, reading: Reading, record: Record | None) -> None:
        """A service's watcher: keeps the latest Record of every compass."""
        if record is None:
            return
        key = record.system, record.compass
        self._latest[key] = record
        self._coaching.on_record(record)
        if self._states.get(key) is not record.verdict.state:
            self._states[key] = record.verdict.state
            self._news.append(sentence(record))

    def news(self) -> list[str]:
        """Lines nobody asked for, since the last call: verdicts, advice, and how the write goes on."""
        job, ended = self._companion.job, self._companion.ended
        shown = "" if job is None else f"compass {job.change.compass}: {job.progress}"
        if shown and shown != self._shown:
            self._news.append(shown)
        self._shown = shown
        if ended is not None and ended is not self._ended:
            self._news += self._outcome(ended)
        self._ended = ended
        if self._companion.presence.autopilot is not None and not self._told.issuperset(others := self._others()):
            self._told |= others
            self._news.append(self._alone(others))
        out, self._news = self._news, []
        return out

    def answer(self, words: Sequence[str]) -> list[str]:
        """The lines to show for one command. What is wrong with it is an answer too, never an exception."""
        name, rest = (words[0] if words else "help"), list(words[1:])
        try:
            match name:
                case "status":
                    _no_more("status", rest)
                    return self._status()
                case "upload":
                    return self._upload(rest)
                case "restore":
                    return self._restore(rest)
                case "history":
                    return self._history(rest)
                case "help" | "-h" | "--help":
                    return list(USAGE)
        except ValueError as error:
            return [str(error)]
        except StoreError as error:
            return [f"the record of writes cannot be used: {error}"]
        return [f"there is no {name!r}; there are:", *USAGE]

    # ------------------------------------------------------------ the commands

    def _status(self) -> list[str]:
        presence, job = self._companion.presence, self._companion.job
        nobody = self._nobody()
        if nobody:
            return [nobody]
        autopilot = presence.autopilot
        assert autopilot is not None  # _nobody says so
        kind = _KINDS.get(autopilot.kind, f"autopilot {autopilot.kind}")
        out = [f"system {autopilot.system}, {kind}, {'armed' if autopilot.armed else 'disarmed'}, {autopilot.route}"]
        if presence.second_route:
            out.append(f"a second route claims to be the same vehicle: {presence.second_route}; uploads are refused")
        if self._companion.sealed:
            out.append(f"{Reason.LINK_SIGNED_READ_ONLY.name}: {Reason.LINK_SIGNED_READ_ONLY.text}")
        if self._others():
            out.append(self._alone(self._others()))
        mine = [r for (system, _), r in sorted(self._latest.items()) if system == autopilot.system]
        for r in mine:
            old_s = (self._session.service.now_ns - r.t_ns) / 1e9
            out.append(sentence(r) + (f", {old_s:.0f} s ago" if old_s > 2.0 else ""))
        if not mine:
            out.append("no compass heard yet; is RAW_IMU streamed?")
        ended = self._companion.ended
        if job is not None:
            out.append(f"compass {job.change.compass}: {job.progress}")
        elif ended is not None:
            out.append(f"last write: compass {ended.change.compass}: {ended.progress}")
        return out

    def _upload(self, words: list[str]) -> list[str]:
        companion, now_ns = self._companion, self._session.service.now_ns
        compass, code, dry = _upload_words(words)
        problem = self._nobody() or self._busy()
        if problem:
            return [problem]
        if dry:
            return self._dry(compass)
        # The code is for this one request; what MMAG_CONFIRM holds stays somebody else's.
        held = companion.confirm
        companion.confirm = held if code is None else float(code)
        try:
            companion.request_upload(compass, now_ns)
        finally:
            companion.confirm = held
        return self._begun(compass, "upload")

    def _restore(self, words: list[str]) -> list[str]:
        dry, rest = "--dry-run" in words, [word for word in words if word != "--dry-run"]
        compass = _compass("restore", rest)
        problem = self._nobody() or self._busy()
        if problem:
            return [problem]
        if dry:
            row = self._companion.writer.restorable(compass)
            return [f"refused: {Reason.NO_SNAPSHOT.text}"] if row is None else self._messages(row.change, undo=True)
        self._companion.request_restore(compass, self._session.service.now_ns)
        return self._begun(compass, "restore")

    def _history(self, words: list[str]) -> list[str]:
        many = _whole(words[0], "history", 1, _MOST_HISTORY) if words else _HISTORY
        _no_more("history", words[1:])
        out = []
        for row in self._store.history(many):
            e = history_entry(row)
            when = datetime.fromtimestamp(e["unix_s"], UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
            how = e["result"] or "cut short" + (", undone since" if e["undone"] else "")
            moved = ", ".join(f"{n} {o:g} to {e['new'][n]:g}" for n, o in e["old"].items())
            why = "".join(f"; {text}" for text in (*(r["text"] for r in e["reasons"]), e["note"]) if text)
            out.append(f"{e['id']}: {when}, system {e['system']}, {e['action']} {how}: {moved}{why}")
        return out or ["nothing was ever written"]

    # ------------------------------------------------------------ inside

    def _others(self) -> set[int]:
        return set(self._heard()) - {self._companion.presence.system}

    def _alone(self, others: set[int]) -> str:
        names = ", ".join(str(system) for system in sorted(others))
        return f"also heard: system {names}; only system {self._companion.presence.system} is served here"

    def _nobody(self) -> str:
        presence = self._companion.presence
        if presence.ambiguous:
            return f"several vehicles {presence.ambiguous}: choose one here, or vehicle.system in the settings file"
        return "no vehicle yet: no autopilot's heartbeat was heard" if presence.autopilot is None else ""

    def _busy(self) -> str:
        job = self._companion.job
        return "" if job is None else f"a write is under way (compass {job.change.compass}: {job.progress}); wait"

    def _begun(self, compass: int, what: str) -> list[str]:
        refusal = self._companion.refusal
        if refusal is not None:
            return [f"refused: {refusal.text}"]
        return [] if self._companion.job is None else [f"compass {compass}: {what} begun"]

    def _dry(self, compass: int) -> list[str]:
        record, change = self._latest.get((self._companion.presence.system, compass)), self._companion.plan(compass)
        if change is None:
            return [f"compass {compass}: nothing to write; magmav status says what is missing"]
        ready = record is not None and record.verdict.state is State.READY
        lines = self._messages(change, undo=False)
        return [*([] if ready else [f"compass {compass} is not READY: an upload would be refused"]), *lines]

    def _messages(self, change: Change, *, undo: bool) -> list[str]:
        flown, settings = self._companion.flown(), self._companion.settings
        held = [] if flown is None else [name for c in COMPASSES for name in flown.calibrations.stored(c)]
        rates = wanted_rates(settings, self._companion.kind)
        return every_message(change, rates, held, settings.upload.confirm_above_mg, undo=undo)

    def _outcome(self, ended: Upload) -> list[str]:
        compass = ended.change.compass
        out = [f"compass {compass}: {ended.progress}"]
        code = code_needed(ended.change, self._companion.settings.upload.confirm_above_mg)
        if any(reason.name == "CONFIRM_CHANGE" for reason in ended.reasons) and code is not None:
            out.append(f"a change this large wants its code: magmav upload {compass} --confirm-change {code}")
        return out


class Plugin:
    """A Session on a FedLink in a thread of its own. Everything here may be called from the host's thread.

    The thread opens the store, so that nobody else ever touches it; a store that cannot be opened is said in
    ``lines``. One vehicle is served: the one the settings name, else the one the host names (``follow``), else the
    only one there is. When the host names another, that one is met anew as soon as no write is under way.
    """

    def __init__(self, link: FedLink, settings: Settings, model: FieldModel, store: Path) -> None:
        self.link = link
        self._settings = settings
        self._model = model
        self._path = store
        self._asked: queue.SimpleQueue[tuple[str, ...]] = queue.SimpleQueue()
        self._said: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._loaded = threading.Event()
        self._system = settings.vehicle.system
        self._chosen = 0  # by the host
        self._vehicles: set[int] = set()
        self._thread = threading.Thread(target=self._work, name="magmav", daemon=True)
        self._thread.start()

    def follow(self, system: int) -> None:
        """The host speaks to this vehicle now; 0 for none in particular."""
        self._chosen = system

    def vehicle(self, system: int) -> None:
        """The host heard an autopilot of this system."""
        if system not in self._vehicles:
            self._vehicles = self._vehicles | {system}  # the other thread may be looking at the old one

    def command(self, words: Sequence[str]) -> None:
        """One command; its answer comes out of ``lines``."""
        if not self._thread.is_alive():
            self._said.put("not running; load the module again")
            return
        if not self._loaded.is_set():
            self._said.put("still loading; the answer follows")
        self._asked.put(tuple(words))

    def lines(self) -> list[str]:
        """What is to be shown since the last call."""
        out = []
        while not self._said.empty():
            out.append(self._said.get_nowait())
        return out

    def stop(self, timeout_s: float = 4.0) -> bool:
        """End the work; False when it did not end in time. Last words can then be taken from the link."""
        self.link.close()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _work(self) -> None:
        try:
            with Store(self._path) as store:
                self._said.put("at work; magmav help shows the commands")
                while self._serve(store):
                    self._system = self._chosen
                    self._said.put(f"system {self._system} is served from here on; learning begins anew")
        except StoreError as error:
            self._said.put(f"stopped: {error}")

    def _serve(self, store: Store) -> bool:
        """One vehicle, until the link is closed; True where it ends because the host chose another one."""
        session = Session.on(
            self.link, with_value(self._settings, "vehicle", "system", self._system), self._model, store
        )
        desk = Desk(session, store, lambda: self._vehicles)
        session.service.watchers += (desk.watch,)
        session.service.run(lambda: self._between(desk) or self._elsewhere(session.companion))
        if session.companion.job is not None:
            self._said.put("stopped in the middle of a write: it is undone when magmav runs again")
        return self._elsewhere(session.companion) and not self.link.closed

    def _elsewhere(self, companion: MagCompanion) -> bool:
        """The host speaks to another vehicle, nothing forbids to follow, and nothing is being written."""
        fixed = self._settings.vehicle.system
        if fixed or self._chosen in (0, self._system) or companion.job is not None:
            return False
        presence = companion.presence
        met = presence.autopilot is not None or self._system != 0  # else the one there is will be found
        return bool(presence.ambiguous) or (met and presence.system != self._chosen)

    def _between(self, desk: Desk) -> bool:
        """Between two packets: commands, answers, news. Never ends the work."""
        self._loaded.set()
        while not self._asked.empty():
            for line in desk.answer(self._asked.get_nowait()):
                self._said.put(line)
        for line in desk.news():
            self._said.put(line)
        return False


def _upload_words(words: list[str]) -> tuple[int, int | None, bool]:
    """Compass, code and whether it is a dry run. ValueError says what is not understood."""
    code, dry, rest = None, False, list(words)
    if "--dry-run" in rest:
        rest.remove("--dry-run")
        dry = True
    if "--confirm-change" in rest:
        at = rest.index("--confirm-change")
        if at + 1 == len(rest):
            raise ValueError("upload: --confirm-change wants the code that the dry run shows")
        code = _whole(rest[at + 1], "upload: --confirm-change", 1, 9999)
        del rest[at : at + 2]
    return _compass("upload", rest), code, dry


def _compass(command: str, words: list[str]) -> int:
    _no_more(command, words[1:])
    return _whole(words[0], f"{command}: compass", 1, 3) if words else 1


def _whole(word: str, what: str, least: int, most: int) -> int:
    if not (word.isascii() and word.isdecimal()) or not least <= int(word) <= most:
        raise ValueError(f"{what}: want a whole number from {least} to {most}, got {word!r}")
    return int(word)


def _no_more(command: str, words: list[str]) -> None:
    if words:
        raise ValueError(f"{command}: not understood: {' '.join(words)!r}; magmav help shows what there is")
