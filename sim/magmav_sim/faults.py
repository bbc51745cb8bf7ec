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
    """Another sensor is found where this compass was: ArduPilot shows it as COMPASS_DEV_ID; no slot of PX4
    names it."""

    compass: CompassNumber
    device_id: int


class Slow(Fault, frozen=True, kw_only=True, tag="slow"):
    """What is asked by parameter messages and commands is done at once, but the answers come seconds later."""

    seconds: Annotated[float, msgspec.Meta(gt=0)] = 3.0


class RebootAfterSets(Fault, frozen=True, kw_only=True, tag="reboot_after_sets"):
    """The autopilot restarts right after it echoed the n-th PARAM_SET; ``lost``: before that value was saved."""

    sets: Annotated[int, msgspec.Meta(ge=1)]
    lost: bool = False


class SecondWriter(Fault, frozen=True, kw_only=True, tag="second_writer"):
    """Somebody else stores a value: at ``at_s``, or right after the n-th PARAM_SET that was heard.

    echoed : the new value is told to everybody, as after a PARAM_SET on another link; else nothing is said.
    """

    name: str
    value: float
    sets: Annotated[int, msgspec.Meta(ge=1)] | None = None
    echoed: bool = False


class Signed(Fault, frozen=True, kw_only=True, tag="signed"):
    """The vehicle signs what it sends (MAVLink 2) and believes only what is signed with the same key.

    key : 32 bytes as 64 hexadecimal digits.
    """

    key: Annotated[str, msgspec.Meta(pattern="^[0-9a-fA-F]{64}$")]
    link_id: Annotated[int, msgspec.Meta(ge=0, le=255)] = 7


class SecondRoute(Fault, frozen=True, kw_only=True, tag="second_route"):
    """Somebody on another route says to be this autopilot.

    armed, landed : what its heartbeat and its EXTENDED_SYS_STATE claim.  echoes : it answers for parameters, as
    though every write had been stored.  triggers : it asks component 191 to upload for this compass (0: it does not).
    """

    armed: bool = False
    landed: bool = True
    echoes: bool = True
    triggers: Annotated[int, msgspec.Meta(ge=0, le=3)] = 0


AnyFault = (
    IronStep | Drift | Frozen | Absent | Deaf | NoEffect | ArmsAfterSets | Reboot | DeviceId
    | Slow | RebootAfterSets | SecondWriter | Signed | SecondRoute
)  # fmt: skip


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
