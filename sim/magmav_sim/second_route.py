"""Somebody on another route who says to be the autopilot: a router gone wrong, or worse."""

from __future__ import annotations

from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.mavlink.codec import Codec
from magmav_sim.autopilot import Autopilot
from magmav_sim.faults import SecondRoute

_HZ_NS = 1_000_000_000
_REAL32, _NO_INDEX = 9, 65535
_COMPANION, _GROUND = 191, (255, 190)


class Impostor:
    """What it sends while its fault lasts. It hears what the true vehicle hears, and remembers what was written."""

    def __init__(self, fault: SecondRoute, autopilot: Autopilot) -> None:
        self._fault = fault
        self._a = autopilot
        self._codec = Codec(frozenset())
        self._written: dict[str, float] = {}
        self._answers: list[Any] = []
        self._next_ns = round(fault.at_s * 1e9)
        self._triggered = False

    def hear(self, message: Any) -> None:
        """A message that went to the vehicle."""
        if not self._fault.echoes:
            return
        kind = message.get_type()
        if kind == "PARAM_SET":
            self._written[message.param_id] = message.param_value
        if kind in ("PARAM_SET", "PARAM_REQUEST_READ") and message.param_id in self._written:
            name = message.param_id
            self._answers.append(
                dialect.MAVLink_param_value_message(name.encode(), self._written[name], _REAL32, 1, _NO_INDEX)
            )

    def frames(self) -> list[bytes]:
        """What it sends in this frame of 10 ms."""
        a, now_ns = self._a, self._a.elapsed_ns
        if not self._fault.active(now_ns / 1e9):
            self._answers.clear()
            return []
        out = [self._codec.encode(m, a.system, a.component) for m in self._answers]
        self._answers.clear()
        if now_ns >= self._next_ns:
            self._next_ns += _HZ_NS
            landed = dialect.MAV_LANDED_STATE_ON_GROUND if self._fault.landed else dialect.MAV_LANDED_STATE_IN_AIR
            mode = 0x51 | (0x80 if self._fault.armed else 0)
            beat = dialect.MAVLink_heartbeat_message(a.kind, a.vendor, mode, 0, dialect.MAV_STATE_STANDBY, 3)
            for m in (beat, dialect.MAVLink_extended_sys_state_message(0, landed)):
                out.append(self._codec.encode(m, a.system, a.component))
        if self._fault.triggers and not self._triggered:
            self._triggered = True
            asked = dialect.MAVLink_param_set_message(
                a.system, _COMPANION, b"MMAG_UPLOAD", float(self._fault.triggers), _REAL32
            )
            out.append(self._codec.encode(asked, *_GROUND))
        return out
