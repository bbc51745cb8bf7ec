"""The writes we are asked to make: planned, begun, ended, said, and taken back when they were cut short.

One write at a time. Nothing is ever written to a vehicle unasked (S18), but for the way back of a write that was
cut short (design, rule 10).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping

from magmav.core.types import AxisState, Change, Reason, Record, State, UploadResult
from magmav.mavlink.announce import Announcer
from magmav.mavlink.autopilot.adapter import ADAPTERS, adapter_of
from magmav.mavlink.autopilot.plan import plan_change
from magmav.mavlink.change import adapter_for, code_needed, largest_step_mg
from magmav.mavlink.codec import Message, Outgoing
from magmav.mavlink.fetch import ParamFetch
from magmav.mavlink.kept import Keeping, Kept
from magmav.mavlink.terms import UploadSettings
from magmav.mavlink.uid import Uid, has_uid, may_be_same
from magmav.mavlink.upload import Upload
from magmav.mavlink.watch import Watch
from magmav.pipeline import Pipeline
from magmav.settings import Settings
from magmav.store import Store, StoreError, Write
from magmav.vehicle import Vehicle as Flown

_log = logging.getLogger("magmav")
STALE_NS = 2_000_000_000
_RETRY_RESTORE_NS = 30_000_000_000
_ASK_AGAIN_NS = 500_000_000
_CRITICAL, _WARNING, _INFO = 2, 4, 6
_ARDUPILOT = 3  # MAV_AUTOPILOT_ARDUPILOTMEGA
_WHOLE = (UploadResult.ALL_NEW, UploadResult.WRITTEN_UNPROVEN, UploadResult.ALL_OLD)
_NOT_OURS = frozenset({Reason.OFFSETS_CHANGED, Reason.DEVICE_CHANGED, Reason.WRONG_VEHICLE})


class Writer:
    """Writes to the vehicle of ``watch.presence``. ``job`` is the write under way; ``ended`` the last that ended.

    records : the latest Record of each compass, kept up to date by the owner.  settings : read anew each time.
    serves : False for one write of the caller's and nothing else, no trigger and no pending restore.
    confirm, result : what MMAG_CONFIRM and MMAG_RESULT show.  refusal : why nothing was begun, when asked last.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        watch: Watch,
        fetch: ParamFetch,
        store: Store,
        announcer: Announcer,
        *,
        records: Mapping[int, Record],
        settings: Callable[[], Settings],
        unix_offset_ns: int,
        serves: bool,
    ) -> None:
        self.confirm = 0.0
        self.result = 0.0
        self.job: Upload | None = None
        self.ended: Upload | None = None
        self.refusal: Reason | None = None
        self._pipeline = pipeline
        self._presence = watch.presence
        self._watch = watch
        self._fetch = fetch
        self._store = store
        self._announcer = announcer
        self._records = records
        self._settings = settings
        self._unix_offset_ns = unix_offset_ns
        self._serves = serves
        self._retry_ns = 0
        self._restoring: int | None = None
        self._left_alone: set[int] = set()
        self._uid = Uid(watch.presence)
        self._kept: dict[int, tuple[Write, Kept]] = {}  # by device id
        self._looked_for = ""  # the vehicle whose earlier writes were looked up

    # ------------------------------------------------------------ what is asked of it

    @property
    def vehicle(self) -> str:
        """Key of the served vehicle in the store: its system id, and its own number where that is known (S19)."""
        return self._uid.key

    @property
    def identified(self) -> bool:
        """Its number is known, or it was asked often enough."""
        return self._uid.settled

    @property
    def mapped(self) -> bool:
        """Which compass is in which slot was read, as far as the vehicle says it; only then a write is sure (S6)."""
        autopilot = self._presence.autopilot
        adapter = (None if autopilot is None else adapter_of(autopilot.kind)) or ADAPTERS[_ARDUPILOT]
        return self._fetch.settled(adapter.whose(self._fetch.heard))

    def flown(self) -> Flown | None:
        """The served vehicle in the pipeline."""
        return None if self._presence.autopilot is None else self._pipeline.vehicles.get(self._presence.system)

    def fresh(self, compass: int, now_ns: int) -> Record | None:
        """Latest Record of a compass, None when it is over two seconds old."""
        record = self._records.get(compass)
        return record if record is not None and now_ns - record.t_ns <= STALE_NS else None

    def request_upload(self, compass: int, now_ns: int) -> None:
        """Upload what is known now, if the gate says it may be."""
        record, flown = self.fresh(compass, now_ns), self.flown()
        change = self.plan(compass)
        unclear = None if flown is None else flown.calibrations.refuses(compass)
        if self.job is not None or not self._serves:
            self.refuse(Reason.BUSY, now_ns)
        elif record is None or record.verdict.state is not State.READY:
            self.refuse(Reason.NO_CALIBRATION, now_ns)
        elif change is None:
            self.refuse(unclear or Reason.NOT_OBSERVED, now_ns)
        else:
            self.start(change, int(self.confirm), now_ns)

    def request_restore(self, compass: int, now_ns: int) -> None:
        """Bring back the values from before the last upload of this compass."""
        try:
            row = self.restorable(compass)
        except StoreError as error:
            _log.error("%s", error)
            row = None
        if self.job is not None or not self._serves:
            self.refuse(Reason.BUSY, now_ns)
        elif row is None:
            self.refuse(Reason.NO_SNAPSHOT, now_ns)
        else:
            self.start(row.change, None, now_ns, undoes=row.id)

    def restorable(self, compass: int) -> Write | None:
        """The last upload of this compass that can be taken back. StoreError where the record cannot be read."""
        flown = self.flown()
        device = 0 if flown is None else flown.calibrations.device_id(compass)
        return self._store.last_restorable(self._presence.system, compass, device, self.vehicle)

    def plan(self, compass: int) -> Change | None:
        """The change the present estimate asks for, on the axes that are known; None when there is none."""
        flown, record = self.flown(), self._records.get(compass)
        if flown is None or record is None or record.estimate.samples == 0:
            return None
        x, y, z = (axis is not AxisState.NOT_OBSERVED for axis in record.verdict.axes)
        iron = record.estimate.hard_iron_b_mg
        return plan_change(flown.calibrations, self._presence.system, compass, iron, record.sigma_mg, (x, y, z))

    def start(self, change: Change, confirm: int | None, now_ns: int, undoes: int | None = None) -> None:
        """Begin a write; its messages come out of poll. ValueError while another one runs."""
        if self.job is not None:
            raise ValueError("start: a write is under way; wait for its end")
        limits = UploadSettings(confirm_above_mg=self._settings().upload.confirm_above_mg)
        self.refusal = None
        flown = self.flown()
        self.job = Upload(
            change,
            self._watch,
            journal=self._store,
            confirm=confirm,
            undoes=undoes,
            vehicle=self.vehicle,
            against=lambda: None if flown is None else flown.calibrations.refuses(change.compass),
            mapped=lambda: self.mapped,
            unix_offset_ns=self._unix_offset_ns,
            settings=limits,
        )
        self.result = 1.0
        if flown is not None:
            # The stream will jump by what we ourselves write: undone exactly, nothing is learnt again.
            flown.calibrations.expect(change.names, change.old)
            flown.calibrations.expect(change.names, change.new)
        self.job.start(now_ns)
        self._finish(self.job, now_ns)

    # ------------------------------------------------------------ while it runs

    def on_message(self, message: Message, route: str, now_ns: int) -> list[Outgoing]:
        """For the write under way."""
        self._uid.on_message(message, route)
        for _, kept in self._kept.values():
            kept.on_message(message, route, now_ns)
        return [] if self.job is None else self.job.on_message(message, route, now_ns)

    def poll(self, now_ns: int) -> list[Outgoing]:
        """What the write under way sends; without one, see whether an earlier one is to be taken back."""
        out = self._uid.poll(now_ns)
        if self.job is not None:
            flown = self.flown()
            if flown is not None:
                flown.settle(self.job.change.compass)  # the stream jumps a moment before the echo says so
            out += self.job.poll(now_ns)
            self._finish(self.job, now_ns)
        elif self._serves and now_ns >= self._retry_ns:
            self._restore_pending(now_ns)
        if self.job is None and self._serves:
            out += self._look_again(now_ns)
        return out

    def _finish(self, job: Upload, now_ns: int) -> None:
        if job.result is None:
            return
        self.job, self.ended = None, job
        self._await_reboot(job)
        if self._restoring is not None and _NOT_OURS.intersection(job.reasons):
            # Somebody else's values are there now: never overwritten unasked (design, rule 10).
            self._left_alone.add(self._restoring)
            text = f"MMAG write {self._restoring} not undone: magmav history"
            self._announcer.say(_CRITICAL, text, now_ns)
        self._restoring = None
        code = float(job.result.value)
        if job.result is UploadResult.REFUSED:
            code = -float(job.reasons[0].number) if job.reasons else -1.0
        self.result = code
        severity = {UploadResult.PENDING_RESTORE: _CRITICAL, UploadResult.WRITTEN_UNPROVEN: _WARNING}
        words = "; ".join(r.text for r in job.reasons)
        _log.info("compass %d: %s", job.change.compass, job.progress)
        text = f"MMAG c{job.change.compass} {job.result.name}" + (f": {words}" if words else "")
        self._announcer.say(severity.get(job.result, _INFO), text, now_ns)
        code_text = code_needed(job.change, self._settings().upload.confirm_above_mg)
        if Reason.CONFIRM_CHANGE in job.reasons and code_text is not None:
            step = largest_step_mg(job.change)
            self._announcer.say(_WARNING, f"MMAG change of {step:.0f} mG: MMAG_CONFIRM {code_text}", now_ns)

    def refuse(self, reason: Reason, now_ns: int) -> None:
        """Say why nothing is begun."""
        self.refusal = reason
        if self.job is None:  # while a write runs, the result is that it runs
            self.result = -float(reason.number)
        self._announcer.say(_WARNING, f"MMAG refused: {reason.text}", now_ns)

    def _restore_pending(self, now_ns: int) -> None:
        """A write that was cut short is taken back at the next chance; the machine itself checks that it may."""
        autopilot = self._presence.autopilot
        if autopilot is None or autopilot.armed or not self._watch.landed(now_ns):
            return
        self._retry_ns = now_ns + _RETRY_RESTORE_NS
        try:
            rows = [r for r in self._store.pending() if r.change.system == autopilot.system]
        except StoreError as error:
            _log.error("%s", error)
            return
        rows = [r for r in rows if r.id not in self._left_alone and may_be_same(r.vehicle, self.vehicle)]
        if rows and not self.identified and has_uid(rows[0].vehicle):
            self._retry_ns = now_ns + _ASK_AGAIN_NS  # another vehicle with the same numbers is soon told apart (S19)
            return
        if rows:
            self._restoring = rows[0].id
            self._announcer.say(_WARNING, "MMAG restoring a write that was cut short", now_ns)
            self.start(rows[0].change, None, now_ns, undoes=rows[0].id)

    # ------------------------------------------------------------ after a reboot

    def _await_reboot(self, job: Upload) -> None:
        """Note the autopilot's clock with a write that left known values; see Kept."""
        if job.row is None:
            return
        self._kept.pop(job.change.device_id, None)  # what an earlier write left is not there any more
        boot_ms = self._presence.clock.ms
        if boot_ms is None or job.result not in _WHOLE:
            return
        try:
            self._store.ended_at(job.row, boot_ms)
            rows = self._store.unchecked(self._presence.system)
        except StoreError as error:
            _log.error("%s", error)
            return
        self._watch_over([row for row in rows if row.id == job.row])

    def _watch_over(self, rows: Iterable[Write]) -> None:
        for row in rows:
            if row.boot_ms is None or not may_be_same(row.vehicle, self.vehicle):
                continue
            old, new = (dict(zip(row.change.names, v, strict=True)) for v in (row.change.old, row.change.new))
            written, before = (old, new) if row.result is UploadResult.ALL_OLD else (new, old)
            kept = Kept(adapter_for(row.change), self._presence, written, before, row.boot_ms)
            self._kept[row.change.device_id] = row, kept

    def _look_again(self, now_ns: int) -> list[Outgoing]:
        """Writes of earlier companions are looked up once; then each is read once the autopilot has rebooted."""
        if self._presence.autopilot is None or not self.identified:
            return []
        out: list[Outgoing] = []
        try:
            if self._looked_for != self.vehicle:
                self._looked_for = self.vehicle
                self._watch_over(self._store.unchecked(self._presence.system))
            for device, (row, kept) in tuple(self._kept.items()):
                out += kept.poll(now_ns)
                if kept.found is not None:
                    self._store.checked(row.id, kept.found)
                    self._say_kept(row, kept.found, now_ns)
                if kept.found is not None or kept.given_up:
                    del self._kept[device]
        except StoreError as error:
            _log.error("%s", error)
            self._kept.clear()
        return out

    def _say_kept(self, row: Write, found: Keeping, now_ns: int) -> None:
        text = f"MMAG c{row.change.compass} {found.name}: {found.value}"
        _log.log(logging.INFO if found is Keeping.PERSISTED else logging.WARNING, "%s", text)
        self._announcer.say(_INFO if found is Keeping.PERSISTED else _WARNING, text, now_ns)
        if row.result is UploadResult.WRITTEN_UNPROVEN and found is Keeping.PERSISTED:
            _log.warning("compass %d stays WRITTEN_UNPROVEN: %s", row.change.compass, adapter_for(row.change).unproven)
            self._announcer.say(_INFO, f"MMAG c{row.change.compass} stays unproven: look at its heading", now_ns)
