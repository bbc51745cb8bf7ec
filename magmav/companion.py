"""Our component on the wire: who we are, what we ask for, what we publish, and the writes we are asked to make.

Puts the protocol machines together; each of them takes messages and the time and gives messages back. Nothing is
ever written to a vehicle unasked (S18).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping

import numpy as np

from magmav import __version__
from magmav.choices import Choices, beside
from magmav.coaching import Coaching
from magmav.core.types import Change, Reason, Record, State, Verdict
from magmav.hearing import same_end
from magmav.logbook import Logbook
from magmav.mavlink.announce import Announcer
from magmav.mavlink.autopilot.adapter import ADAPTERS, adapter_of
from magmav.mavlink.budget import Budget
from magmav.mavlink.codec import Message, Outgoing
from magmav.mavlink.fetch import ParamFetch
from magmav.mavlink.intervals import Intervals
from magmav.mavlink.manners import Manners
from magmav.mavlink.metadata import files
from magmav.mavlink.params import ParamServer
from magmav.mavlink.presence import Presence
from magmav.mavlink.signing import Seal
from magmav.mavlink.upload import Upload
from magmav.mavlink.watch import Watch
from magmav.own_params import COMPASSES, entries, meant
from magmav.pipeline import Pipeline
from magmav.settings import Settings, SettingsError, with_value
from magmav.store import SavedEstimate, Store, StoreError
from magmav.vehicle import Vehicle as Flown
from magmav.writing import Writer

_log = logging.getLogger("magmav")
_SAVE_EVERY_NS = 10_000_000_000
_WARNING, _INFO = 4, 6
_ARDUPILOT = 3  # MAV_AUTOPILOT_ARDUPILOTMEGA
_SLOW = (
    "GLOBAL_POSITION_INT", "GPS_RAW_INT", "BATTERY_STATUS", "VFR_HUD", "SYSTEM_TIME", "EXTENDED_SYS_STATE",
)  # fmt: skip


def wanted_rates(settings: Settings, kind: int = _ARDUPILOT) -> dict[str, float]:
    """The messages we live on, as this MAV_AUTOPILOT calls them, and how often we ask for them."""
    w, adapter = settings.wire, adapter_of(kind) or ADAPTERS[_ARDUPILOT]
    rates = dict.fromkeys(adapter.compass_streams, w.imu_hz)
    rates |= {"ATTITUDE": w.attitude_hz} | dict.fromkeys((*_SLOW, *adapter.slow_streams), w.slow_hz)
    return {name: hz for name, hz in rates.items() if hz > 0.0}


class MagCompanion:
    """Serves one vehicle. ``writer`` makes the writes.

    serves : False for one write of the caller's and nothing else, no trigger and no pending restore.
    keyed : what we send is signed.  budget : of its own unless given.
    What was chosen in flight for this vehicle counts as soon as it is known which one it is, see magmav.choices.
    """

    def __init__(
        self,
        settings: Settings,
        pipeline: Pipeline,
        store: Store,
        unix_offset_ns: int,
        *,
        ask: bool = True,
        serves: bool = True,
        keyed: bool = False,
        budget: Budget | None = None,
    ) -> None:
        named = settings.vehicle.system
        self._choices = Choices(beside(store.path, named) if named else None, settings)
        self.settings = settings = self._choices.settings()
        pipeline.apply(settings, named or None)
        self._asks_for: frozenset[str] | None = None if ask else frozenset()
        self._pipeline = pipeline
        self._store = store
        self._unix_offset_ns = unix_offset_ns
        self._now_ns = 0
        self._records: dict[int, Record] = {}
        self._states: dict[int, State] = {}
        self._saved_ns: dict[int, int] = {}
        self._said_ambiguous = False
        v = settings.vehicle
        own = entries(self, lambda: self._now_ns)
        self.budget = budget or Budget(settings.wire.budget_bps, signed=keyed)
        self._seal = Seal(keyed)
        self._said_sealed = False
        self._taken_up = False
        self._boots = self._known_boots = 0
        self._source: tuple[int, str] | None = None
        self.presence = Presence(v.component, v.system or None, Manners(self.budget, files(own, __version__)))
        self._watch = Watch(self.presence)
        self.kind = _ARDUPILOT  # MAV_AUTOPILOT of the vehicle, once it is known
        self._intervals = Intervals(self._rates(), self.presence, self.budget.room)
        self._fetch = ParamFetch(ADAPTERS[self.kind].names(COMPASSES), self.presence, self.budget.room)
        self.announcer = Announcer(self.budget, settings.wire.heading_hz)
        self._coaching = Coaching(pipeline.vehicles, lambda text, now: self.announcer.say(_INFO, f"MMAG {text}", now))
        self.writer = Writer(
            pipeline,
            self._watch,
            self._fetch,
            store,
            self.announcer,
            records=self._records,
            settings=lambda: self.settings,
            unix_offset_ns=unix_offset_ns,
            serves=serves,
        )
        self._logbook = Logbook(store, unix_offset_ns, self.writer.plan)
        self._server = ParamServer(own, self.presence, self.budget, denied=self._denied)

    def _take_up(self) -> None:
        """The vehicle is known now, and with it what was chosen for it before."""
        if self._taken_up or self.presence.autopilot is None:
            return
        self._taken_up = True
        if self._choices.path is None:
            self._choices.path = beside(self._store.path, self.presence.system)
            self.settings = self._choices.settings()
        self._hold_by(self.settings)

    def _hold_by(self, settings: Settings) -> None:
        self._pipeline.apply(settings, self.presence.system)
        self.budget.rate(settings.wire.budget_bps)
        self.announcer.rate(settings.wire.heading_hz)
        self._intervals.want(self._rates())

    def ask_for(self, names: Iterable[str]) -> None:
        """Ask the vehicle for these messages only; whoever else asked for the others keeps them."""
        self._asks_for = frozenset(names)
        self._intervals = Intervals(self._rates(), self.presence, self.budget.room)

    def _rates(self) -> dict[str, float]:
        wanted = wanted_rates(self.settings, self.kind)
        return {n: hz for n, hz in wanted.items() if self._asks_for is None or n in self._asks_for}

    # ------------------------------------------------------------ what the service calls

    @property
    def settled(self) -> bool:
        """The vehicle is known, and everything that must be read from it was read or is not there."""
        return self.presence.autopilot is not None and self._fetch.done

    def identity(self) -> tuple[int, int]:
        """System and component we speak as."""
        return self.presence.system, self.presence.component

    def on_message(self, message: Message, route: str, now_ns: int) -> list[Outgoing]:
        """Every machine hears everything."""
        self._now_ns = now_ns
        self._seal.on_message(message, route)
        out = self.presence.on_message(message, route, now_ns)
        self._watch.on_message(message, route, now_ns)
        self._take_up()
        self._begin_anew()
        self._after_reboot()
        if not self.sealed:
            for machine in (self._intervals, self._fetch):
                out += machine.on_message(message, route, now_ns)
            if message.get_type() == "PARAM_VALUE":
                self._suit()
        out += self.writer.on_message(message, route, now_ns)
        return self._counted(out, now_ns) + self._server.on_message(message, route, now_ns)

    def believes(self, message: Message, route: str) -> bool:
        """Whether what it says of a vehicle counts (design, rule 11)."""
        return self.presence.believes(message, route)

    def reached(self, system: int, copies: Mapping[str, int]) -> None:
        """What is said to everybody goes out so often."""
        self.budget.reaches(copies)

    @property
    def sealed(self) -> bool:
        """LINK_SIGNED_READ_ONLY: the vehicle signs and we hold no key, so it would hear nothing; nothing is asked."""
        autopilot = self.presence.autopilot
        return autopilot is not None and self._seal.shuts_out(autopilot.pin)

    def _begin_anew(self) -> None:
        """Another component, or another end of the link, speaks for the vehicle now: what was learnt rests on one."""
        autopilot = self.presence.autopilot
        source = None if autopilot is None else (autopilot.component, same_end(autopilot.route))
        if source == self._source:
            return
        if self._source is not None:
            _log.warning("system %d is now heard over %s: learning begins anew", self.presence.system, source)
            for kept in (self._records, self._states, self._saved_ns):
                kept.clear()
            self._fetch.restart()
        self._source = source

    def _after_reboot(self) -> None:
        """What was learnt and read goes before anything is read again: the other way round it would be lost."""
        clock, flown = self.presence.clock, self.flown()
        if clock.boots != self._boots and clock.ms is not None:
            self._boots = clock.boots
            _log.warning("system %d has rebooted", self.presence.system)
            if flown is not None:
                flown.rebooted(clock.ms * 1_000_000)
        known = 0 if flown is None else flown.assembler.reboots
        if known != self._known_boots:
            self._known_boots = known
            self._fetch.restart()  # readings may show it sooner

    def _suit(self) -> None:
        """Ask for the parameters and messages this autopilot has, by the names it answers to."""
        autopilot = self.presence.autopilot
        if autopilot is None:
            return
        adapter = adapter_of(autopilot.kind) or ADAPTERS[_ARDUPILOT]
        self._fetch.want(adapter.names(COMPASSES, self._fetch.heard))
        if autopilot.kind != self.kind:
            self.kind = autopilot.kind
            self._intervals.want(self._rates())

    def on_record(self, record: Record, now_ns: int) -> None:
        """Publish what is new about a compass of the served vehicle."""
        if record.system != self.presence.system:
            return
        self._records[record.compass] = record
        heading = record.published
        degrees = math.degrees(heading.magnetic_rad) if heading.valid else math.nan
        self.announcer.heading(record.compass, degrees, record.published_boot_ns, now_ns)
        if self.settings.coach.say:
            self._coaching.on_record(record)
        if self._states.get(record.compass) is not record.verdict.state:
            self._states[record.compass] = record.verdict.state
            self._say_verdict(record, now_ns)
        saved_ns = self._saved_ns.get(record.compass, -_SAVE_EVERY_NS)
        if record.verdict.state is State.READY and now_ns - saved_ns >= _SAVE_EVERY_NS:
            self._save(record.compass, now_ns)

    def poll(self, now_ns: int) -> list[Outgoing]:
        """What is due from every machine, the write under way first."""
        self._now_ns = now_ns
        self._watch.tick(now_ns)
        if self.presence.ambiguous and not self._said_ambiguous:
            self._said_ambiguous = True
            _log.warning("several vehicles %s; choose one with --system ID", self.presence.ambiguous)
        self._choices.poll(now_ns)
        self._logbook.look(self.flown(), self._records, self.writer.vehicle)
        self._tell_sealed(now_ns)
        out = [] if self.sealed and self.job is None else self.writer.poll(now_ns)
        out += self.presence.poll(now_ns)
        self._take_up()
        self._begin_anew()
        if not self.sealed:
            if self.presence.autopilot is not None and self.presence.autopilot.kind != self.kind:
                self._suit()
            for machine in (self._intervals, self._fetch):
                out += machine.poll(now_ns)
        return self._counted(out, now_ns) + self._server.poll(now_ns) + self.announcer.poll(now_ns)

    def _tell_sealed(self, now_ns: int) -> None:
        if self.sealed and not self._said_sealed:
            why = Reason.LINK_SIGNED_READ_ONLY
            _log.warning("system %d: %s: %s; give --key-file", self.presence.system, why.name, why.text)
            self.announcer.say(_WARNING, f"MMAG {why.name}", now_ns)
        self._said_sealed = self.sealed

    def _counted(self, out: list[Outgoing], now_ns: int) -> list[Outgoing]:
        """What must go out at once is paid back by what can wait: the whole stays in the budget (AT-9c)."""
        for item in out:
            self.budget.force(item.message, now_ns, item.route)
        return out

    def leave(self, now_ns: int) -> list[Outgoing]:
        """Keep what is known and chosen, give the message intervals back."""
        self._choices.keep()
        for compass, record in self._records.items():
            if record.verdict.state is State.READY:
                self._save(compass, now_ns)
        return [] if self.sealed else self._intervals.restore()

    # ------------------------------------------------------------ what the parameters show and move

    def record(self, compass: int, now_ns: int) -> Record | None:
        """Latest Record of a compass, None when it is over two seconds old."""
        return self.writer.fresh(compass, now_ns)

    def choose(self, section: str, key: str, value: float, *, keep: bool = True) -> bool:
        """Change one setting in flight; False when it is out of its limits.

        value : as on the wire, see own_params.meant.  keep : after a restart too.
        """
        wanted = meant(section, key, value)
        try:
            self.settings = with_value(self.settings, section, key, wanted)
        except SettingsError:
            return False
        if keep:
            self._choices.chose(section, key, wanted, self._now_ns)
        if self._choices.problem:
            self.announcer.say(_WARNING, "MMAG choice not kept: see the log", self._now_ns)
        self._hold_by(self.settings)
        return True

    def _denied(self, name: str, now_ns: int) -> None:
        """Rule 11: what moves a write comes over the vehicle's own route."""
        self.announcer.say(_WARNING, f"MMAG refused {name}: another route", now_ns)

    # ------------------------------------------------------------ writing

    @property
    def job(self) -> Upload | None:
        """The write under way."""
        return self.writer.job

    @property
    def ended(self) -> Upload | None:
        """The last write that came to an end."""
        return self.writer.ended

    @ended.setter
    def ended(self, job: Upload | None) -> None:
        self.writer.ended = job

    @property
    def refusal(self) -> Reason | None:
        """Why nothing was begun, when asked last."""
        return self.writer.refusal

    @property
    def confirm(self) -> float:
        """The confirmation code that was given."""
        return self.writer.confirm

    @confirm.setter
    def confirm(self, code: float) -> None:
        self.writer.confirm = code

    @property
    def result(self) -> float:
        """How the last write went, as MMAG_RESULT shows it."""
        return self.writer.result

    def request_upload(self, compass: int, now_ns: int) -> None:
        """Upload what is known now, if the gate says it may be."""
        if self.sealed:
            self.writer.refuse(Reason.LINK_SIGNED_READ_ONLY, now_ns)
        else:
            self.writer.request_upload(compass, now_ns)

    def request_restore(self, compass: int, now_ns: int) -> None:
        """Bring back the values from before the last upload of this compass."""
        if self.sealed:
            self.writer.refuse(Reason.LINK_SIGNED_READ_ONLY, now_ns)
        else:
            self.writer.request_restore(compass, now_ns)

    def flown(self) -> Flown | None:
        """The served vehicle in the pipeline."""
        return self.writer.flown()

    def plan(self, compass: int) -> Change | None:
        """The change the present estimate asks for, on the axes that are known; None when there is none."""
        return self.writer.plan(compass)

    def start(self, change: Change, confirm: int | None, now_ns: int, undoes: int | None = None) -> None:
        """Begin a write; its messages come out of poll. ValueError while another one runs."""
        self.writer.start(change, confirm, now_ns, undoes)

    # ------------------------------------------------------------ keeping and telling

    def _save(self, compass: int, now_ns: int) -> None:
        change, record = self.plan(compass), self._records[compass]
        self._saved_ns[compass] = now_ns
        if change is None:
            return
        x, y, z = (float(v) for v in record.offsets_mg)
        sx, sy, sz = (float(v) for v in record.sigma_mg)
        unix_ns = now_ns + self._unix_offset_ns
        saved = SavedEstimate(unix_ns, self.writer.vehicle, change, record.verdict, (x, y, z), (sx, sy, sz))
        try:
            self._store.save_estimate(saved)
        except StoreError as error:
            _log.error("%s", error)

    def _say_verdict(self, record: Record, now_ns: int) -> None:
        text = verdict_text(record.compass, record.verdict, float(np.max(record.sigma_mg[:2])))
        _log.info("%s", text)
        self.announcer.say(_WARNING if record.verdict.state is State.REFUSED else _INFO, text, now_ns)


def verdict_text(compass: int, verdict: Verdict, sigma_mg: float) -> str:
    """One line for a ground station: the state, and the first reason or how good it is."""
    if verdict.state is State.READY:
        return f"MMAG c{compass} READY, offsets +-{sigma_mg:.0f} mG"
    first = f": {verdict.reasons[0].text}" if verdict.reasons else ""
    return f"MMAG c{compass} {verdict.state.name}{first}"
