"""An upload against the scripted ArduPilot: all latched and ready, and what must hold of whatever was written."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from scripted_vehicle import MS, S, Vehicle, f32

from magmav.core.types import Change, Reason, UploadResult
from magmav.mavlink.presence import Presence
from magmav.mavlink.upload import Upload
from magmav.mavlink.watch import Watch

NAMES = ("COMPASS_OFS_X", "COMPASS_OFS_Y", "COMPASS_OFS_Z")
OLD = (f32(5.3), f32(-12.1), f32(40.7))


def a_change(*step: float, **other: Any) -> Change:
    step = step or (60.0, -45.0, 80.0)
    new = tuple(f32(o + s) for o, s in zip(OLD, step, strict=True))
    made = Change(1, 1, "COMPASS_DEV_ID", 97539, NAMES, OLD, new, step, (1.0, 1.0, 1.0), tuple(map(abs, step)))
    return replace(made, **other)


class Notes:
    """A journal in memory that knows what had been sent when it was asked to begin."""

    def __init__(self, vehicle: Vehicle) -> None:
        self.vehicle = vehicle
        self.began: list[int] = []
        self.ended: list[tuple[int, UploadResult, tuple[Reason, ...]]] = []
        self.fails: OSError | None = None

    def begin(self, change: Change, unix_ns: int, undoes: int | None = None, vehicle: str = "") -> int:
        if self.fails is not None:
            raise self.fails
        assert not self.vehicle.sets, "S2: on record before the first write"
        self.began.append(unix_ns)
        return 7

    def finish(self, row: int, result: UploadResult, reasons: Sequence[Reason]) -> None:
        self.ended.append((row, result, tuple(reasons)))


class Rig:
    """Vehicle, presence, watch and journal, latched and ready."""

    make: type[Vehicle] = Vehicle
    names = NAMES
    first = staticmethod(a_change)

    def __init__(self, seed: int = 0, latch_s: float = 4.0, **knobs: Any) -> None:
        self.vehicle = self.make(seed)
        for name, value in knobs.items():
            setattr(self.vehicle, name, value)
        self.presence = Presence()
        self.watch = Watch(self.presence)
        self.journal = Notes(self.vehicle)
        self.vehicle.run(None, latch_s, self.feed)
        self.upload: Upload | None = None

    def feed(self, message: Any, route: str, now_ns: int) -> None:
        self.presence.on_message(message, route, now_ns)
        self.presence.poll(now_ns)
        self.watch.on_message(message, route, now_ns)

    def go(self, change: Change | None = None, *, until_s: float = 150.0, **more: Any) -> Upload:
        self.upload = upload = Upload(change or self.first(), self.watch, journal=self.journal, **more)
        upload.start(self.vehicle.now_ns)
        self.vehicle.run(upload, until_s, self.feed)
        assert upload.result is not None, f"it always ends, but is in {upload.phase}"
        return upload

    def stored(self) -> tuple[float, ...]:
        return tuple(self.vehicle.params[name] for name in self.names)

    def check_S1(self) -> None:
        """No PARAM_SET without a disarmed heartbeat at most 1.2 s old, nor after one that says armed."""
        for (when, name, _), heard in zip(self.vehicle.sets, self.vehicle.heard_at_set, strict=True):
            beats = [
                (t, bool(m.base_mode & 128))
                for t, m, _ in self.vehicle.delivered[:heard]
                if m.get_type() == "HEARTBEAT"
            ]
            last_ns, armed = beats[-1]
            assert not armed, f"{name} was written after a heartbeat that said armed"
            assert when - last_ns <= 1200 * MS, f"{name} was written {(when - last_ns) / S} s after a heartbeat"
            assert name in self.names, f"S5, S9: {name} was written"


def refused(rig: Rig, *why: Reason, **more: Any) -> None:
    upload = rig.go(**more)
    assert (upload.result, upload.reasons) == (UploadResult.REFUSED, why)
    assert not rig.vehicle.sets and not rig.journal.began
    assert rig.stored() == OLD
