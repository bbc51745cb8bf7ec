"""Writing offsets to ArduPilot as a transaction, and taking them back: all new, all old, never in between.

    PREFLIGHT -> BASELINE -> (on record) -> WRITE -> READ_BACK -> SETTLE -> PROOF -> DONE
                                              ^  \\________ retreat ________/
                                              '-> LINGER -> READ_BACK

One vector goes out back to back, right after a heartbeat that says disarmed. There is no atomic write in
ArduPilot, so a record on disk comes first, every name is read back, and the corrected stream has to move as
predicted; otherwise the old values are written back with the same care. Whatever happens in between that
forbids writing (the vehicle arms, the link is lost) stops everything at once: PENDING_RESTORE, to be undone
at the next disarm by an Upload with ``undoes``. Every wait is bounded, so the machine always ends.

Results are named by what the vehicle then holds: ALL_NEW or ALL_OLD as read back, in terms of the change,
for an undo too (an undo that works ends ALL_OLD). REFUSED: nothing was sent.
"""

from __future__ import annotations

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.core.types import Change, Reason, UploadResult
from magmav.mavlink import change as changes
from magmav.mavlink.codec import Message, Outgoing
from magmav.mavlink.exchange import Exchange
from magmav.mavlink.float32 import same
from magmav.mavlink.preflight import is_lost, stop_reasons, wait_reasons
from magmav.mavlink.proof import Window, moved_as_predicted
from magmav.mavlink.terms import Journal, Phase, UploadSettings
from magmav.mavlink.watch import Watch

_STOPPED = b"Compass write cut short: restore when disarmed"


class Upload:
    """One change, or with ``undoes`` (the journal row it undoes) its way back. Feed it everything.

    watch : long-lived, may be fed by others too.  confirm : the code, for a change above 150 mG (never asked
    of an undo).  vehicle : key for the journal.  result : None until the end; ``reasons`` say why.
    """

    def __init__(
        self,
        change: Change,
        watch: Watch,
        *,
        journal: Journal,
        confirm: int | None = None,
        undoes: int | None = None,
        vehicle: str = "",
        unix_offset_ns: int = 0,
        settings: UploadSettings | None = None,
    ) -> None:
        self.change = changes.checked(change)
        self.result: UploadResult | None = None
        self.reasons: tuple[Reason, ...] = ()
        self.phase = Phase.IDLE
        self._watch = watch
        self._journal = journal
        self._confirm = confirm
        self._undoes = undoes
        self._undo = undoes is not None
        self._vehicle = vehicle
        self._unix_offset_ns = unix_offset_ns
        self._set = settings or UploadSettings()
        old, new = (dict(zip(change.names, v, strict=True)) for v in (self.change.old, self.change.new))
        self._old, self._new = old, new
        self._target = old if self._undo else new
        self._steps = {
            Phase.PREFLIGHT: self._preflight,
            Phase.BASELINE: self._baseline,
            Phase.WRITE: self._write,
            Phase.LINGER: self._linger,
            Phase.READ_BACK: self._read_back,
            Phase.SETTLE: self._settle,
            Phase.PROOF: self._proof,
        }
        self._stored: dict[str, float] = {}  # as last heard; a name just written is not known
        self._ask = Exchange((), 0, 0)
        self._window: Window | None = None
        self._before: Window | None = None
        self._row: int | None = None
        self._sent = False  # at least one PARAM_SET
        self._measured = False  # at least one whole window after the write
        self._retreating = False
        self._round = 0
        self._start_ns = self._since_ns = 0
        self._pin: tuple[int, int, str] = (0, 0, "")
        self._boots = 0
        self._out: list[Outgoing] = []

    @property
    def progress(self) -> str:
        """One line for people."""
        if self.result is None:
            back = ", back to the old values" if self._retreating or self._undo else ""
            return self.phase.value + back
        why = "; ".join(reason.text for reason in self.reasons)
        advice = "reboot or wait half a minute before take-off" if self._sent else ""
        return ": ".join((self.result.name, *filter(None, (why, advice))))

    def start(self, now_ns: int) -> None:
        """Begin; messages come out of poll. What needs no vehicle to be refused is refused here."""
        if self.phase is not Phase.IDLE:
            raise ValueError("start: this upload was started before")
        autopilot = self._watch.presence.autopilot
        why = []
        if autopilot is None:
            why.append(Reason.HEARTBEAT_OLD)
        else:
            self._pin, self._boots = autopilot.pin, self._watch.presence.boots
            if autopilot.kind != dialect.MAV_AUTOPILOT_ARDUPILOTMEGA:
                why.append(Reason.NOT_SUPPORTED)
            if autopilot.system != self.change.system:
                why.append(Reason.WRONG_VEHICLE)
        if all(same(self._old[name], self._new[name]) for name in self._old):
            why.append(Reason.NOTHING_TO_DO)
        why += self._value_refusals()
        code = None if self._undo else changes.code_needed(self.change, self._set.confirm_above_mg)
        if code is not None and self._confirm != code:
            why.append(Reason.CONFIRM_CHANGE)
        self._start_ns = now_ns
        if why:
            self._end(UploadResult.REFUSED, *why)
            return
        tries = self._set.preflight_ns // self._set.retry_ns
        self._ask = Exchange(changes.reads(self.change), self._set.retry_ns, tries)
        self._enter(Phase.PREFLIGHT, now_ns)

    def on_message(self, message: Message, route: str, now_ns: int) -> list[Outgoing]:
        """Learn from one message, then do what is due."""
        if self.phase in (Phase.IDLE, Phase.DONE):
            return []
        self._watch.on_message(message, route, now_ns)
        if (message.get_srcSystem(), message.get_srcComponent(), route) == self._pin:
            kind = message.get_type()
            if kind == "PARAM_VALUE":
                self._heard(message.param_id, message.param_value)
            elif kind == "PARAM_ERROR" and message.param_id in self._ask.open:
                if self.phase is Phase.PREFLIGHT and message.error == dialect.MAV_PARAM_ERROR_DOES_NOT_EXIST:
                    self._end(UploadResult.REFUSED, Reason.UNKNOWN_PARAM)
            elif self._window is not None and self._watch.still(now_ns):
                self._window.add(message)
            elif self._window is not None and len(self._window):
                self._window = Window(self.change.compass, now_ns)
        return self.poll(now_ns)

    def poll(self, now_ns: int) -> list[Outgoing]:
        """Do what is due now."""
        if self.phase in (Phase.IDLE, Phase.DONE):
            return []
        why = self._interruption(now_ns)
        if why:
            self._stop(*why)
        else:
            self._steps[self.phase](now_ns)
        out, self._out = self._out, []
        return out

    def _interruption(self, now_ns: int) -> list[Reason]:
        """Reasons to stop at once, in any phase."""
        why = stop_reasons(self._watch, self._pin, self._boots, now_ns)
        if not self._sent:
            why += self._value_refusals()
        # PREFLIGHT bears a lost link: it has its own, more telling end.
        lost = self.phase is not Phase.PREFLIGHT and is_lost(self._watch, self._set, now_ns)
        if lost or now_ns - self._start_ns > self._set.whole_ns:
            why.append(Reason.LINK_LOST)
        return why

    def _value_refusals(self) -> tuple[Reason, ...]:
        limit = self._set.offs_max_mg
        return changes.value_refusals(self.change, self._stored, undo=self._undo, offs_max_mg=limit)

    # ------------------------------------------------------------ the steps

    def _preflight(self, now_ns: int) -> None:
        waiting = wait_reasons(self._watch, self._set, now_ns)
        if self._ask.open:
            waiting.insert(0, Reason.UNKNOWN_PARAM)
        since_ns = self._watch.since_ns
        watched = since_ns is not None and now_ns - since_ns >= self._set.watch_ns
        if watched and not waiting:
            self._enter(Phase.BASELINE, now_ns)
        elif now_ns - self._since_ns >= self._set.preflight_ns:
            self._end(UploadResult.REFUSED, *(waiting or [Reason.HEARTBEAT_OLD]))
        else:
            self._request(now_ns)

    def _baseline(self, now_ns: int) -> None:
        window = self._window
        if window is not None and window.ready(now_ns):
            self._before = window
            self._record(now_ns)
        elif now_ns - self._since_ns >= self._set.baseline_ns:
            if self._undo:
                self._record(now_ns)  # the way back is not barred by a stream that is missing
            else:
                moves = self._watch.moving(now_ns)
                self._end(UploadResult.REFUSED, Reason.NOT_LANDED if moves else Reason.NO_STREAM)

    def _record(self, now_ns: int) -> None:
        """On disk before the first write (S2)."""
        # A vector that is partly old and partly new moves the stream by an unknown part of the shift.
        start = self._new if self._undo else self._old
        if not all(same(self._stored[name], value) for name, value in start.items()):
            self._before = None
        try:
            unix_ns = now_ns + self._unix_offset_ns
            self._row = self._journal.begin(self.change, unix_ns, self._undoes, self._vehicle)
        except BlockingIOError:
            self._end(UploadResult.REFUSED, Reason.BUSY)
        except OSError:
            self._end(UploadResult.REFUSED, Reason.NOT_RECORDED)
        else:
            self._enter(Phase.WRITE, now_ns)

    def _write(self, now_ns: int) -> None:
        if not self._ask.open or self._ask.spent(now_ns):
            back = self._retreating or self._undo
            self._enter(Phase.LINGER if back else Phase.READ_BACK, now_ns)
            return
        not_now = wait_reasons(self._watch, self._set, now_ns)
        if not_now and now_ns - self._since_ns >= self._set.heartbeat_lost_ns:
            self._stop(*not_now)
            return
        age_ns = self._watch.heartbeat_age_ns(now_ns)
        late = self._ask.untouched and (age_ns is None or age_ns > self._set.first_write_age_ns)
        if late or not_now:
            return
        for name in self._ask.due(now_ns):
            self._ask.asked(name, now_ns)
            self._stored.pop(name, None)
            self._sent = True
            self._say(
                dialect.MAVLink_param_set_message(
                    *self._pin[:2], name.encode(), self._target[name], dialect.MAV_PARAM_TYPE_REAL32
                )
            )

    def _linger(self, now_ns: int) -> None:
        if now_ns - self._since_ns >= self._set.linger_ns:
            self._enter(Phase.READ_BACK, now_ns)

    def _read_back(self, now_ns: int) -> None:
        if self._ask.open:
            if self._ask.spent(now_ns):
                self._retreat(Reason.UNKNOWN_PARAM, now_ns)
            else:
                self._request(now_ns)
            return
        stored = {name: self._stored[name] for name in self._target}
        if any(not same(v, self._old[n]) and not same(v, self._new[n]) for n, v in stored.items()):
            self._stop(Reason.OFFSETS_CHANGED)
        elif any(not same(value, self._target[name]) for name, value in stored.items()):
            self._round += 1
            if self._round < self._set.rounds:
                self._enter(Phase.WRITE, now_ns)
            else:
                self._retreat(Reason.UNKNOWN_PARAM, now_ns)
        elif self._retreating or self._before is None:
            self._end(self._arrived())
        else:
            self._enter(Phase.SETTLE, now_ns)

    def _settle(self, now_ns: int) -> None:
        if now_ns - self._since_ns >= self._set.settle_ns:
            self._enter(Phase.PROOF, now_ns)

    def _proof(self, now_ns: int) -> None:
        window, before = self._window, self._before
        if window is not None and before is not None and window.ready(now_ns):
            sign = -1.0 if self._undo else 1.0
            x, y, z = (sign * value for value in self.change.shift_b_mg)
            if moved_as_predicted(before, window, (x, y, z)):
                self._end(self._arrived())
                return
            self._measured = True
            self._window = Window(self.change.compass, now_ns)  # a late packet may have spoilt this one
        if now_ns - self._since_ns >= self._set.proof_ns:
            if not self._measured:
                self.reasons = (*self.reasons, Reason.NO_STREAM)
            self._retreat(Reason.UNPROVEN, now_ns)

    # ------------------------------------------------------------ moving between them

    def _enter(self, phase: Phase, now_ns: int) -> None:
        """The one place where the phase changes, but for the end."""
        self.phase, self._since_ns = phase, now_ns
        measuring = phase in (Phase.BASELINE, Phase.PROOF)
        self._window = Window(self.change.compass, now_ns) if measuring else None
        if phase is Phase.WRITE:
            todo = [n for n, v in self._target.items() if n not in self._stored or not same(self._stored[n], v)]
            self._ask = Exchange(todo, self._set.retry_ns, self._set.write_tries)
        elif phase is Phase.READ_BACK:
            self._ask = Exchange(self._target, self._set.retry_ns, self._set.read_tries)
        if phase is not Phase.PREFLIGHT:
            self._steps[phase](now_ns)

    def _retreat(self, why: Reason, now_ns: int) -> None:
        """Back to the old values. From the way back there is no further way back."""
        self.reasons = (*self.reasons, why)
        if self._undo and why is Reason.UNPROVEN:
            self._end(self._arrived())
        elif self._undo or self._retreating:
            self._stop()
        else:
            self._retreating, self._round, self._target = True, 0, self._old
            self._enter(Phase.WRITE, now_ns)

    def _arrived(self) -> UploadResult:
        return UploadResult.ALL_OLD if self._target is self._old else UploadResult.ALL_NEW

    def _stop(self, *why: Reason) -> None:
        """No further write. What was sent stays on record to be undone at the next disarm."""
        if not self._sent:
            self._end(UploadResult.REFUSED, *why)
            return
        self._end(UploadResult.PENDING_RESTORE, *why)
        text = dialect.MAVLink_statustext_message(dialect.MAV_SEVERITY_CRITICAL, _STOPPED)
        self._out = [Outgoing(text)]

    def _end(self, result: UploadResult, *why: Reason) -> None:
        self.phase, self._window, self._out = Phase.DONE, None, []
        self.reasons = tuple(dict.fromkeys((*self.reasons, *why)))
        self.result = result
        if self._row is not None:
            try:
                self._journal.finish(self._row, result, self.reasons)
            except OSError:
                self.reasons = (*self.reasons, Reason.NOT_RECORDED)  # stays pending on record, which is safe

    # ------------------------------------------------------------ parameters

    def _heard(self, name: str, value: float) -> None:
        if name not in changes.reads(self.change):
            return
        self._stored[name] = value
        asking = self.phase in (Phase.PREFLIGHT, Phase.READ_BACK)
        written = self.phase is Phase.WRITE and name in self._target and same(value, self._target[name])
        if asking or written:
            self._ask.answered(name)

    def _request(self, now_ns: int) -> None:
        for name in self._ask.due(now_ns):
            self._ask.asked(name, now_ns)
            self._say(dialect.MAVLink_param_request_read_message(*self._pin[:2], name.encode(), -1))

    def _say(self, message: Message) -> None:
        self._out.append(Outgoing(message, self._pin[2]))
