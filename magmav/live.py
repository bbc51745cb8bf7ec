"""Live work on a link: the service until it is stopped, and one write or its undo from start to end."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.companion import MagCompanion, wanted_rates
from magmav.core.types import Change, FieldModel, Reason, UploadResult
from magmav.dry import every_message
from magmav.link import Link
from magmav.mavlink.autopilot.adapter import ADAPTERS, adapter_of
from magmav.mavlink.change import CONFIRM_ABOVE_MG, adapter_for, code_needed, largest_step_mg
from magmav.mavlink.kept import Keeping
from magmav.mavlink.signing import Signing
from magmav.own_params import COMPASSES
from magmav.pipeline import Pipeline
from magmav.service import Service, Watcher
from magmav.settings import Settings
from magmav.store import Store, Write

Result = dict[str, Any]
_SECOND = 1_000_000_000
_SETTLE_NS, _LISTEN_NS = 1_200_000_000, 2_700_000_000


class NoVehicle(Exception):
    """Nobody to talk to within the time given; the text says what was waited for."""


@dataclass(slots=True)
class Session:
    """A link with the whole machinery on it."""

    service: Service
    companion: MagCompanion
    pipeline: Pipeline

    @classmethod
    def on(
        cls,
        link: Link,
        settings: Settings,
        model: FieldModel,
        store: Store,
        watchers: Sequence[Watcher] = (),
        *,
        ask: bool = True,
        signer: Signing | None = None,
    ) -> Session:
        """Build pipeline, companion and service for a link.

        ask : the long-running service: requests message rates, obeys triggers, restores what was cut short. False for
        one write and nothing else.
        """
        pipeline = Pipeline(settings, model, link.unix_offset_ns)
        keyed = signer is not None
        companion = MagCompanion(settings, pipeline, store, link.unix_offset_ns, ask=ask, serves=ask, keyed=keyed)
        return cls(Service(link, pipeline, companion, watchers, signer), companion, pipeline)


def transact(
    session: Session,
    link: Link,
    compass: int,
    pick: Callable[[int], Change | Write | Reason],
    *,
    confirm: int | None,
    dry: bool,
    wait_s: float,
    progress: Callable[[str], None],
    stop: Callable[[], bool] = lambda: False,
) -> Result:
    """Find the vehicle, read what it holds, then carry one change (or an undo) through, or only show it.

    ``pick`` gets the device id and says what is to be written, or why nothing is. Raises NoVehicle.
    """
    companion = session.companion
    begun_ns: int | None = None
    shown, asked = "", False
    rates: list[str] = []
    before: Counter[str] | None = None
    chosen: Change | Write | Reason | None = None
    packets = link.packets()
    try:
        for packet in packets:
            session.service.turn(packet)
            begun_ns = packet.t_ns if begun_ns is None else begun_ns
            if before is None and packet.t_ns - begun_ns > _SETTLE_NS:
                before = session.service.heard.copy()  # what an earlier command had asked for may still have run out
            elif not asked and before is not None and packet.t_ns - begun_ns > _LISTEN_NS:
                # Another program may have set the rates; only what does not come anyway is asked for, and returned.
                asked, heard = True, session.service.heard - before
                rates = [n for n in wanted_rates(companion.settings, companion.kind) if not heard[n]]
                companion.ask_for(rates)
            if stop():
                break
            if companion.ended is not None:
                job, above_mg = companion.ended, companion.settings.upload.confirm_above_mg
                return outcome(job.change, job.result, job.reasons, confirm, above_mg)
            if companion.sealed and companion.job is None:
                return {"result": "REFUSED", "compass": compass, "reasons": _reasons((Reason.LINK_SIGNED_READ_ONLY,))}
            ready = companion.writer.identified or companion.presence.autopilot is None
            if chosen is None and ready and (asked or not dry):
                device = _device(session, compass) if companion.writer.mapped else 0
                if device:
                    chosen = pick(device)
                    change = chosen.change if isinstance(chosen, Write) else chosen
                    if isinstance(change, Reason):
                        return {"result": "REFUSED", "compass": compass, "reasons": _reasons((change,))}
                    if dry:
                        return _shown(session, change, rates, undo=isinstance(chosen, Write))
                    undoes = chosen.id if isinstance(chosen, Write) else None
                    companion.start(change, confirm, packet.t_ns, undoes)
                elif packet.t_ns - begun_ns > wait_s * _SECOND:
                    return _nobody(session, compass, link)
            if companion.job is not None and companion.job.progress != shown:
                shown = companion.job.progress
                progress(shown)
    finally:
        with suppress(OSError):
            session.service.leave()
    return {"result": "REFUSED", "compass": compass, "reasons": _reasons((Reason.LINK_LOST,))}


def _device(session: Session, compass: int) -> int:
    """Device id once everything the write rests on has been read, else 0."""
    flown = session.companion.flown()
    if flown is None or not flown.calibrations.known(compass):
        return 0
    return flown.calibrations.device_id(compass)


def _nobody(session: Session, compass: int, link: Link) -> Result:
    presence = session.companion.presence
    if presence.ambiguous:
        raise NoVehicle(f"{link.name}: several vehicles {presence.ambiguous}; choose one with --system")
    if presence.autopilot is None:
        refused = session.service.hearing.codec.counts["not believed"]
        if refused:
            raise NoVehicle(f"{link.name}: {refused} messages came, none signed with this key; check --key-file")
        raise NoVehicle(f"{link.name}: no autopilot heard; is the vehicle on, and does it send to this link?")
    adapter = adapter_of(presence.autopilot.kind) or ADAPTERS[dialect.MAV_AUTOPILOT_ARDUPILOTMEGA]
    names = ", ".join(adapter.offset_names(compass))
    return {
        "result": "REFUSED",
        "compass": compass,
        "reasons": _reasons((Reason.UNKNOWN_PARAM,)),
        "detail": f"no answer for {names} and the device id of compass {compass}",
    }


def _shown(session: Session, change: Change, rates: Sequence[str], *, undo: bool) -> Result:
    flown = session.companion.flown()
    held = [] if flown is None else [name for c in COMPASSES for name in flown.calibrations.stored(c)]
    above_mg = session.companion.settings.upload.confirm_above_mg
    lines = every_message(change, rates, held, above_mg, undo=undo)
    return outcome(change, None, (), None, above_mg) | {"dry_run": True, "messages": lines}


def outcome(
    change: Change,
    result: UploadResult | None,
    reasons: Sequence[Reason],
    confirm: int | None,
    above_mg: float = CONFIRM_ABOVE_MG,
) -> Result:
    """What a write did, as the JSON that the command prints. above_mg : larger changes want a code."""
    code = code_needed(change, above_mg)
    return {
        "result": None if result is None else result.name,
        "reasons": _reasons(reasons),
        "system": change.system,
        "compass": change.compass,
        "device_id": change.device_id,
        "old": dict(zip(change.names, change.old, strict=True)),
        "new": dict(zip(change.names, change.new, strict=True)),
        "largest_change_mg": round(largest_step_mg(change), 3),
        "confirm_code": code,
        "confirmed": code is not None and confirm == code,
    }


def _reasons(reasons: Sequence[Reason]) -> list[dict[str, str]]:
    return [{"code": r.name, "text": r.text} for r in reasons]


def note(row: Write) -> str:
    """What was found after the reboot, and why it proves no more than that; "" where there is nothing to say."""
    said = [] if row.kept is None else [f"{row.kept.name}, {row.kept.value}"]
    if row.result is UploadResult.WRITTEN_UNPROVEN and row.kept in (None, Keeping.PERSISTED):
        said.append(adapter_for(row.change).unproven)
    return "; ".join(filter(None, said))


def history_entry(row: Write) -> Result:
    """One line of ``magmav history``."""
    result = row.result
    return {
        "id": row.id,
        "unix_s": row.unix_ns / 1e9,
        "system": row.change.system,
        "compass": row.change.compass,
        "device_id": row.change.device_id,
        "action": "upload" if row.undoes is None else f"undo of {row.undoes}",
        "result": None if result is None else result.name,
        "reasons": _reasons(row.reasons),
        "undone": row.undone,
        "vehicle": row.vehicle,
        "kept": None if row.kept is None else row.kept.name,
        "note": note(row),
        "old": dict(zip(row.change.names, row.change.old, strict=True)),
        "new": dict(zip(row.change.names, row.change.new, strict=True)),
    }
