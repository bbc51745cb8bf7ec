"""What may go wrong, as a scenario names it. Times are seconds since the simulation began (not boot time).

``iron_at`` and ``drift_at`` say what the faults add to a compass; the rest is asked for where it acts.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated

import msgspec

Vector = tuple[float, float, float]
At = Annotated[float, msgspec.Meta(ge=0)]
CompassNumber = Annotated[int, msgspec.Meta(ge=1, le=3)]
_NEVER = 1e9


class Fault(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="kind"):
    """One thing that goes wrong; ``kind`` names which. It lasts from ``at_s`` to ``until_s``."""

    at_s: At = 0.0
    until_s: At = _NEVER

    def active(self, t_s: float) -> bool:
        """Whether it is happening at this time."""
        return self.at_s <= t_s < self.until_s


class IronStep(Fault, frozen=True, kw_only=True, tag="iron_step"):
    """Something magnetic is taken on board (a payload), and perhaps dropped again: mG, body axes."""

    compass: CompassNumber
    mg: Vector


class Drift(Fault, frozen=True, kw_only=True, tag="drift"):
    """Hard iron that moves steadily while the fault lasts, and stays where it got to: mG/s, body axes."""

    compass: CompassNumber
    mg_per_s: Vector


class Frozen(Fault, frozen=True, kw_only=True, tag="frozen"):
    """The sensor repeats its last value."""

    compass: CompassNumber


class Absent(Fault, frozen=True, kw_only=True, tag="absent"):
    """The sensor is gone: the autopilot sends zeros for it."""

    compass: CompassNumber


class Deaf(Fault, frozen=True, kw_only=True, tag="deaf"):
    """The autopilot does not react to any parameter message."""


class NoEffect(Fault, frozen=True, kw_only=True, tag="no_effect"):
    """Parameters are stored and echoed, but the correction keeps the values from before the fault."""


class ArmsAfterSets(Fault, frozen=True, kw_only=True, tag="arms_after_sets"):
    """The pilot arms on the ground right after the n-th PARAM_SET, and disarms again later."""

    sets: Annotated[int, msgspec.Meta(ge=1)]
    seconds: Annotated[float, msgspec.Meta(gt=0)] = 10.0


class Reboot(Fault, frozen=True, kw_only=True, tag="reboot"):
    """The autopilot's watchdog restarts it at ``at_s``: clock back, streams at their defaults, still
    armed."""


class DeviceId(Fault, frozen=True, kw_only=True, tag="device_id"):
    """Another sensor is found where this compass was: COMPASS_DEV_ID changes."""

    compass: CompassNumber
    device_id: int


AnyFault = IronStep | Drift | Frozen | Absent | Deaf | NoEffect | ArmsAfterSets | Reboot | DeviceId


def iron_at(faults: Iterable[AnyFault], compass: int, t_s: float) -> Vector:
    """What steps and drifts add to the hard iron of a compass, mG, body axes."""
    x = y = z = 0.0
    for fault in faults:
        if isinstance(fault, IronStep) and fault.compass == compass and fault.active(t_s):
            x, y, z = x + fault.mg[0], y + fault.mg[1], z + fault.mg[2]
        elif isinstance(fault, Drift) and fault.compass == compass:
            lasted = max(0.0, min(t_s, fault.until_s) - fault.at_s)
            d = fault.mg_per_s
            x, y, z = x + d[0] * lasted, y + d[1] * lasted, z + d[2] * lasted
    return x, y, z
