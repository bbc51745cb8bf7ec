"""Every message a write would put on the wire, before it does: not only the transaction, all that goes with it.

What serves to find the vehicle and to read what it holds has been sent by the time this is shown; nothing was written.
"""

from __future__ import annotations

from collections.abc import Iterable

from magmav.core.types import Change
from magmav.mavlink.change import adapter_for, dry_run
from magmav.own_params import COMPASSES


def every_message(
    change: Change, rates: Iterable[str], held: Iterable[str], above_mg: float, *, undo: bool = False
) -> list[str]:
    """A line per message, in order; what is repeated says so.

    rates : messages asked for, since they do not come by themselves.  held : parameters the vehicle answered for.
    """
    adapter, rates = adapter_for(change), tuple(rates)
    names = dict.fromkeys((*adapter.names(COMPASSES), *adapter.names(COMPASSES, set(held))))
    return [
        "HEARTBEAT (once a second, to the end)",
        "COMMAND_LONG MAV_CMD_REQUEST_MESSAGE AUTOPILOT_VERSION (or, to older releases, the next)",
        "COMMAND_LONG MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES (only where the one before has no answer)",
        *(f"PARAM_REQUEST_READ {name}" for name in names),
        *(f"COMMAND_LONG MAV_CMD_SET_MESSAGE_INTERVAL {name}" for name in rates),
        *dry_run(change, above_mg, undo=undo),
        "STATUSTEXT (what is known of each compass, and how the write ended)",
        "PARAM_VALUE MMAG_ (our own parameters, to a ground station that appears or asks)",
        *(f"COMMAND_LONG MAV_CMD_SET_MESSAGE_INTERVAL {name} (back to its default)" for name in rates),
    ]
