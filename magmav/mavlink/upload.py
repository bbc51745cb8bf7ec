"""Writing offsets to an autopilot as a transaction, and taking them back: all new, all old, never in between.

    PREFLIGHT -> BASELINE -> (on record) -> WRITE -> READ_BACK -> SETTLE -> PROOF -> SEEN_OUT -> ARMING -> DONE
                                              ^  \\________ retreat ________/
                                              '-> LINGER -> READ_BACK -> SEEN_OUT

One vector goes out back to back, right after a heartbeat that says disarmed. No autopilot writes it at once, so a
record on disk comes first, every name is read back, and the corrected stream has to move as predicted; otherwise the
old values are written back with the same care. What is heard may be old: only a heartbeat long after the last write
shows that the vehicle had not armed before it landed (S1). Where no stream shows it (PX4), BASELINE and PROOF fall
away and the end is WRITTEN_UNPROVEN. Whatever happens in between that forbids writing (the vehicle arms, the link is
lost) stops everything at once: PENDING_RESTORE, to be undone at the next disarm by an Upload with ``undoes``. Every
wait is bounded, so the machine always ends.

Results are named by what the vehicle then holds: ALL_NEW, WRITTEN_UNPROVEN or ALL_OLD as read back, in terms of the
change, for an undo too (an undo that works ends ALL_OLD). REFUSED: nothing was sent.
"""

from __future__ import annotations

from collections.abc import Callable

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.core.types import Change, Reason, UploadResult
from magmav.mavlink import change as changes
from magmav.mavlink.arming import MANUAL_STEP, ArmingCheck
from magmav.mavlink.autopilot.adapter import adapter_of
from magmav.mavlink.codec import Message, Outgoing
from magmav.mavlink.dialogue import Dialogue
from magmav.mavlink.float32 import same
from magmav.mavlink.preflight import is_lost, stop_reasons, wait_reasons
from magmav.mavlink.proof import Window, moved_as_predicted
from magmav.mavlink.terms import Journal, Phase, UploadSettings
from magmav.mavlink.watch import Watch

_STOPPED = b"Compass write cut short: restore when disarmed"


class Upload:
    """One change, or with ``undoes`` (the journal row it undoes) its way back. Feed it everything.

    watch : long-lived, may be fed by others too.  confirm : the code, for a change above 150 mG (never asked
    of an undo).  vehicle : key for the journal.  against : what those who know more of this vehicle have against it,
    asked until the first write.  mapped : whether they know it; nothing is written before.
    row : of the journal, once there is one.  result : None until the end; ``reasons`` say why.
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
        against: Callable[[], Reason | None] = lambda: None,
        mapped: Callable[[], bool] = lambda: True,
    ) -> None:
        self._adapter = changes.adapter_for(change)
        self.change = self._adapter.checked(change)
        self.row: int | None = None
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
            Phase.SEEN_OUT: self._seen_out,
            Phase.ARMING: self._arming,
        }
        self._against, self._mapped = against, mapped
        self._streams = self._adapter.proof_streams(change.compass)
        self._talk = Dialogue(self._adapter, (0, 0, ""), ())
        self._arming_check: ArmingCheck | None = None
        self._ending: UploadResult | None = None  # decided and on record, while ARMING
        self._were_zero = False
        self._window: Window | None = None
        self._before: Window | None = None
        self._measured = False  # at least one whole window after the write
        self._retreating = False
        self._round = 0
        self._start_ns = self._since_ns = 0
        self._waits_ns = 0  # when the last heartbeat fresh enough to write by was there
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
        unproven = self.result is UploadResult.WRITTEN_UNPROVEN
        advice = "reboot before take-off" if unproven else "reboot or wait half a minute before take-off"
        if not self._talk.wrote:
            advice = ""
        elif {Reason.NOT_COMMITTED, Reason.PERHAPS_NOT_COMMITTED}.intersection(self.reasons):
            advice = MANUAL_STEP
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
            if adapter_of(autopilot.kind) is None:
                why.append(Reason.NOT_SUPPORTED)
            elif autopilot.system != self.change.system or autopilot.kind != self._adapter.kind:
                why.append(Reason.WRONG_VEHICLE)
        if all(same(self._old[name], self._new[name]) for name in self._old):
            why.append(Reason.NOTHING_TO_DO)
        elif not self._undo and changes.is_too_small(self.change):
            why.append(Reason.TOO_SMALL)
        why += self._value_refusals()
        code = None if self._undo else changes.code_needed(self.change, self._set.confirm_above_mg)
        if code is not None and self._confirm != code:
            why.append(Reason.CONFIRM_CHANGE)
        self._start_ns = now_ns
        if why:
            self._end(UploadResult.REFUSED, *why)
            return
        tries = self._set.preflight_ns // self._set.retry_ns
        self._talk = Dialogue(self._adapter, self._pin, self._adapter.reads(self.change))
        self._talk.turn_to(self._adapter.reads(self.change), self._set.retry_ns, tries)
        self._enter(Phase.PREFLIGHT, now_ns)

    def on_message(self, message: Message, route: str, now_ns: int) -> list[Outgoing]:
        """Learn from one message, then do what is due."""
        if self.phase in (Phase.IDLE, Phase.DONE):
            return []
        self._watch.on_message(message, route, now_ns)
        if (message.get_srcSystem(), message.get_srcComponent(), route) == self._pin:
            kind = message.get_type()
            if self._arming_check is not None:
                self._arming_check.on_message(message, now_ns)
            elif kind == "PARAM_VALUE":
                asking = self.phase in (Phase.PREFLIGHT, Phase.READ_BACK)
                wanted = None if asking else self._target if self.phase is Phase.WRITE else {}
                self._talk.heard(message, wanted, self._watch.bytewise)
            elif kind == "PARAM_ERROR" and message.param_id in self._talk.asking.open:
                if self.phase is Phase.PREFLIGHT and message.error == dialect.MAV_PARAM_ERROR_DOES_NOT_EXIST:
                    self._end(UploadResult.REFUSED, Reason.UNKNOWN_PARAM)
            elif self._window is not None and self._watch.still(now_ns):
                self._window.add(message)
            elif self._window is not None and len(self._window):
                self._window = Window(self._streams, now_ns)
        return self.poll(now_ns)

    def poll(self, now_ns: int) -> list[Outgoing]:
        """Do what is due now."""
        if self.phase in (Phase.IDLE, Phase.DONE):
            return []
        self._watch.tick(now_ns)
        why = [] if self.phase is Phase.ARMING else self._interruption(now_ns)
        if why:
            self._stop(*why)
        else:
            self._steps[self.phase](now_ns)
        out, self._out = self._out, []
        return out

    def _interruption(self, now_ns: int) -> list[Reason]:
        """Reasons to stop at once, in any phase."""
        why = stop_reasons(self._watch, self._pin, self._boots, now_ns)
        if not self._talk.wrote:
            why += self._value_refusals()
        # PREFLIGHT bears a lost link: it has its own, more telling end.
        lost = self.phase is not Phase.PREFLIGHT and is_lost(self._watch, self._set, now_ns)
        if lost or now_ns - self._start_ns > self._set.whole_ns:
            why.append(Reason.LINK_LOST)
        return why

    def _value_refusals(self) -> tuple[Reason, ...]:
        why, limit = self._against(), self._set.offs_max_mg
        read = changes.value_refusals(self.change, self._talk.stored, undo=self._undo, offs_max_mg=limit)
        return read if why is None else (why, *read)

    # ------------------------------------------------------------ the steps

    def _preflight(self, now_ns: int) -> None:
        waiting = wait_reasons(self._watch, self._set, now_ns)
        if self._talk.asking.open or not self._mapped():
            waiting.insert(0, Reason.UNKNOWN_PARAM)
        since_ns = self._watch.since_ns
        watched = since_ns is not None and now_ns - since_ns >= self._set.watch_ns
        if watched and not waiting:
            self._enter(Phase.BASELINE, now_ns)
        elif now_ns - self._since_ns >= self._set.preflight_ns:
            self._end(UploadResult.REFUSED, *(waiting or [Reason.HEARTBEAT_OLD]))
        else:
            self._out += self._talk.read(now_ns)

    def _baseline(self, now_ns: int) -> None:
        window = self._window
        if not self._streams:
            self._record(now_ns)
            return
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
        stored = self._talk.stored
        if not all(same(stored[name], value) for name, value in start.items()):
            self._before = None
        self._were_zero = not any(stored[name] for name in self._adapter.triple(self.change))
        try:
            unix_ns = now_ns + self._unix_offset_ns
            self.row = self._journal.begin(self.change, unix_ns, self._undoes, self._vehicle)
        except BlockingIOError:
            self._end(UploadResult.REFUSED, Reason.BUSY)
        except OSError:
            self._end(UploadResult.REFUSED, Reason.NOT_RECORDED)
        else:
            self._enter(Phase.WRITE, now_ns, at_once=False)  # the disk may have taken long: first look at the time

    def _write(self, now_ns: int) -> None:
        if not self._talk.asking.open or self._talk.asking.spent(now_ns):
            back = self._retreating or self._undo
            self._enter(Phase.LINGER if back else Phase.READ_BACK, now_ns)
            return
        not_now = wait_reasons(self._watch, self._set, now_ns)
        if not not_now:
            self._waits_ns = now_ns
        elif now_ns - max(self._waits_ns, self._since_ns) >= self._set.heartbeat_lost_ns:
            self._stop(*not_now)  # a link that only stammers is waited for: the wait is counted from the last fresh one
            return
        age_ns = self._watch.heartbeat_age_ns(now_ns)
        late = self._talk.asking.untouched and (age_ns is None or age_ns > self._set.first_write_age_ns)
        if late or not_now:
            return
        self._out += self._talk.write(self._target, now_ns)

    def _linger(self, now_ns: int) -> None:
        if now_ns - self._since_ns >= self._set.linger_ns:
            self._enter(Phase.READ_BACK, now_ns)

    def _read_back(self, now_ns: int) -> None:
        if self._talk.asking.open:
            if self._talk.asking.spent(now_ns):
                self._retreat(Reason.UNKNOWN_PARAM, now_ns)
            else:
                self._out += self._talk.read(now_ns)
            return
        stored = {name: self._talk.stored[name] for name in self._target}
        if any(not same(v, self._old[n]) and not same(v, self._new[n]) for n, v in stored.items()):
            self._stop(Reason.OFFSETS_CHANGED)
        elif any(not same(value, self._target[name]) for name, value in stored.items()):
            self._round += 1
            if self._round < self._set.rounds:
                self._enter(Phase.WRITE, now_ns)
            else:
                self._retreat(Reason.UNKNOWN_PARAM, now_ns)
        elif self._retreating or self._before is None:
            self._arrive(now_ns)
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
                self._arrive(now_ns)
                return
            self._measured = True
            self._window = Window(self._streams, now_ns)  # a late packet may have spoilt this one
        if now_ns - self._since_ns >= self._set.proof_ns:
            if not self._measured:
                self.reasons = (*self.reasons, Reason.NO_STREAM)
            self._retreat(Reason.UNPROVEN, now_ns)

    # ------------------------------------------------------------ moving between them

    def _enter(self, phase: Phase, now_ns: int, *, at_once: bool = True) -> None:
        """The one place where the phase changes, but for the end."""
        self.phase, self._since_ns = phase, now_ns
        measuring = phase in (Phase.BASELINE, Phase.PROOF)
        self._window = Window(self._streams, now_ns) if measuring else None
        if phase is Phase.WRITE:
            held = self._talk.stored
            todo = [n for n, v in self._target.items() if n not in held or not same(held[n], v)]
            self._talk.turn_to(todo, self._set.retry_ns, self._set.write_tries)
        elif phase is Phase.READ_BACK:
            self._talk.turn_to(self._target, self._set.retry_ns, self._set.read_tries)
        if at_once and phase is not Phase.PREFLIGHT:
            self._steps[phase](now_ns)

    def _retreat(self, why: Reason, now_ns: int) -> None:
        """Back to the old values. From the way back there is no further way back."""
        self.reasons = (*self.reasons, why)
        if self._undo and why is Reason.UNPROVEN:
            self._arrive(now_ns)
        elif self._undo or self._retreating:
            self._stop()
        else:
            self._retreating, self._round, self._target = True, 0, self._old
            self._enter(Phase.WRITE, now_ns)

    def _arrive(self, now_ns: int) -> None:
        """Everything read back as it should be."""
        self._enter(Phase.SEEN_OUT, now_ns)

    def _seen_out(self, now_ns: int) -> None:
        """Said to be done when it is known that no write landed on an armed vehicle. Whoever is silent is lost."""
        wrote_ns, heard_ns = self._talk.wrote_ns, self._watch.heartbeat_ns
        if wrote_ns is None or (heard_ns is not None and heard_ns - wrote_ns >= self._set.seen_out_ns):
            self._done(now_ns)

    def _done(self, now_ns: int) -> None:
        """New values still have to please the autopilot's own checks."""
        if self._target is self._old:
            self._end(UploadResult.ALL_OLD)
        elif not self._streams:
            self._end(UploadResult.WRITTEN_UNPROVEN, Reason.REBOOT_TO_APPLY)
        else:
            self._ending = UploadResult.ALL_NEW
            self._on_record(self._ending)
            self._arming_check = ArmingCheck(self._pin, now_ns, were_zero=self._were_zero)
            self._enter(Phase.ARMING, now_ns)

    def _arming(self, now_ns: int) -> None:
        check = self._arming_check
        if check is None or self._ending is None:
            raise AssertionError("ARMING is entered by _done")
        if not check.done(now_ns) and not stop_reasons(self._watch, self._pin, self._boots, now_ns):
            self._out += check.poll(now_ns)
        else:
            self._end(self._ending, *([] if check.reason is None else [check.reason]))

    def _stop(self, *why: Reason) -> None:
        """No further write. What was sent stays on record to be undone at the next disarm."""
        if not self._talk.wrote:
            self._end(UploadResult.REFUSED, *why)
            return
        self._end(UploadResult.PENDING_RESTORE, *why)
        text = dialect.MAVLink_statustext_message(dialect.MAV_SEVERITY_CRITICAL, _STOPPED)
        self._out = [Outgoing(text)]

    def _end(self, result: UploadResult, *why: Reason) -> None:
        self.phase, self._window, self._out = Phase.DONE, None, []
        self.reasons = tuple(dict.fromkeys((*self.reasons, *why)))
        self.result = result
        if self._ending is None or why:
            self._on_record(result)

    def _on_record(self, result: UploadResult) -> None:
        if self.row is not None:
            try:
                self._journal.finish(self.row, result, self.reasons)
            except OSError:
                self.reasons = (*self.reasons, Reason.NOT_RECORDED)  # stays pending on record, which is safe
