"""May the vehicle be written to right now, and what ends a write that is under way (S1, S3, S7, rule 11)."""

from __future__ import annotations

from magmav.core.types import Reason
from magmav.mavlink.terms import UploadSettings
from magmav.mavlink.watch import Watch


def stop_reasons(watch: Watch, pin: tuple[int, int, str], boots: int, now_ns: int) -> list[Reason]:
    """What forbids any write and will not pass by waiting a moment.

    pin and boots : the autopilot, its route and its reboots as they were when the write began.
    """
    presence = watch.presence
    autopilot = presence.autopilot
    why = []
    if watch.armed(now_ns) or (autopilot is not None and autopilot.armed):
        why.append(Reason.ARMED)
    if presence.second_route:
        why.append(Reason.SECOND_ROUTE)
    if watch.in_air(now_ns):
        why.append(Reason.NOT_LANDED)
    if watch.calibrating(now_ns):
        why.append(Reason.SECOND_WRITER)
    if autopilot is None or autopilot.pin != pin or presence.boots != boots:
        why.append(Reason.LINK_LOST)
    return why


def is_lost(watch: Watch, settings: UploadSettings, now_ns: int) -> bool:
    """Nothing at all for five seconds, or other messages but no heartbeat for ten."""
    silent_ns, age_ns = watch.silent_ns(now_ns), watch.heartbeat_age_ns(now_ns)
    silent = silent_ns is None or silent_ns >= settings.silent_ns
    return silent or age_ns is None or age_ns >= settings.heartbeat_lost_ns


def wait_reasons(watch: Watch, settings: UploadSettings, now_ns: int) -> list[Reason]:
    """What forbids a write at this moment; waiting may cure it."""
    age_ns = watch.heartbeat_age_ns(now_ns)
    fresh = age_ns is not None and age_ns <= settings.heartbeat_age_ns
    why = [] if fresh else [Reason.HEARTBEAT_OLD]
    return why if watch.landed(now_ns) else [*why, Reason.NOT_LANDED]
