"""How the autopilot answers: parameters, commands, stream requests, pings. Everything addressed to its
system is taken, whatever the component, because a message it cannot forward to another link is its own
(the routing trap)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav_sim.autopilot import Autopilot
from magmav_sim.faults import AnyFault, Deaf
from magmav_sim.messages import BUILDERS, NAMES
from magmav_sim.streams import Streams

WANTED = frozenset(
    {
        "PARAM_REQUEST_LIST",
        "PARAM_REQUEST_READ",
        "PARAM_SET",
        "COMMAND_LONG",
        "REQUEST_DATA_STREAM",
        "SET_MODE",
        "PING",
    }
)
_LIST_PER_FRAME = 3
_NOT_A_NUMBER_INDEX = 65535
_FORCE = 21196


class Protocol:
    """Takes messages, answers into the autopilot's outbox.

    fly : called by MISSION_START; False when there is no flight waiting for it.
    pong : the sequence number of the last PING of ours that somebody answered; -1 before the first.
    """

    def __init__(self, autopilot: Autopilot, streams: Streams, faults: list[AnyFault], fly: Callable[[], bool]) -> None:
        self._a = autopilot
        self._streams = streams
        self._deaf = [f for f in faults if isinstance(f, Deaf)]
        self._fly = fly
        self._list: Iterator[int] = iter(())
        self.pong = -1
        self.reboot_wanted = False

    def forget(self) -> None:
        """As after a boot."""
        self._list = iter(())

    def handle(self, message: Any) -> None:
        """React to one message from the link."""
        sender = (message.get_srcSystem(), message.get_srcComponent())
        if sender == (self._a.system, self._a.component):
            return
        if getattr(message, "target_system", 0) not in (0, self._a.system):
            return
        kind = message.get_type()
        if kind == "PING":
            self._ping(message, sender)
        elif kind == "COMMAND_LONG":
            self._command(message, sender)
        elif kind == "REQUEST_DATA_STREAM":
            self._streams.request(
                message.req_stream_id, message.req_message_rate, message.start_stop == 1, self._a.boot_ns
            )
        elif kind == "SET_MODE":
            self._a.mode = message.custom_mode
        elif kind.startswith("PARAM_") and not any(f.active(self._a.elapsed_ns / 1e9) for f in self._deaf):
            self._parameter(kind, message)

    def answered(self, message: Any) -> bool:
        """Whether this answers a PING of ours: noted at once, also while booting, because pacing waits for
        it."""
        to = (getattr(message, "target_system", 0), getattr(message, "target_component", 0))
        if message.get_type() != "PING" or to != (self._a.system, self._a.component):
            return False
        self.pong = max(self.pong, message.seq)
        return True

    def trickle(self) -> None:
        """Send on with a parameter list that was asked for."""
        for _ in range(_LIST_PER_FRAME):
            index = next(self._list, None)
            if index is None:
                return
            self._tell(self._a.parameters.names[index], index)

    # ------------------------------------------------------------ parameters

    def _parameter(self, kind: str, message: Any) -> None:
        table = self._a.parameters
        if kind == "PARAM_REQUEST_LIST":
            self._list = iter(range(len(table)))
        elif kind == "PARAM_REQUEST_READ":
            if message.param_index >= 0:
                if message.param_index < len(table):
                    self._tell(table.names[message.param_index], message.param_index)
            elif message.param_id in table:
                self._tell(message.param_id, _NOT_A_NUMBER_INDEX)
        elif kind == "PARAM_SET" and message.param_id in table and math.isfinite(message.param_value):
            table.put(message.param_id, message.param_value)
            self._tell(message.param_id, _NOT_A_NUMBER_INDEX)
            self._a.param_was_set(message.param_id, table[message.param_id])

    def _tell(self, name: str, index: int) -> None:
        table = self._a.parameters
        self._a.outbox.append(
            dialect.MAVLink_param_value_message(name.encode(), table[name], table.kind(name), len(table), index)
        )

    # ------------------------------------------------------------ the rest

    def _ping(self, message: Any, sender: tuple[int, int]) -> None:
        if message.target_system == 0 and message.target_component == 0:
            self._a.outbox.append(dialect.MAVLink_ping_message(message.time_usec, message.seq, *sender))

    def _command(self, message: Any, sender: tuple[int, int]) -> None:
        result = self._run(message.command, message)
        ack = dialect.MAVLink_command_ack_message(message.command, result, 0, 0, *sender)
        self._a.outbox.append(ack)

    def _run(self, command: int, m: Any) -> int:
        accepted, failed = dialect.MAV_RESULT_ACCEPTED, dialect.MAV_RESULT_FAILED
        a = self._a
        if command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL:
            name = NAMES.get(int(m.param1))
            if name is None or not math.isfinite(m.param2):
                return int(dialect.MAV_RESULT_DENIED)
            self._streams.set_interval(name, m.param2, a.boot_ns)
        elif command == dialect.MAV_CMD_GET_MESSAGE_INTERVAL:
            name = NAMES.get(int(m.param1))
            us = 0 if name is None else self._streams.interval_us(name)
            a.outbox.append(dialect.MAVLink_message_interval_message(int(m.param1), us))
        elif command == dialect.MAV_CMD_REQUEST_MESSAGE:
            name = NAMES.get(int(m.param1))
            built = None if name is None else BUILDERS[name](a)
            if built is None:
                return int(failed)
            a.outbox.append(built)
        elif command == dialect.MAV_CMD_COMPONENT_ARM_DISARM:
            done = a.arm(force=m.param2 == _FORCE) if m.param1 == 1 else a.disarm()
            return int(accepted if done else failed)
        elif command == dialect.MAV_CMD_DO_SET_MODE:
            a.mode = int(m.param2)
        elif command == dialect.MAV_CMD_MISSION_START:
            return int(accepted if self._fly() else failed)
        elif command == dialect.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN and m.param1 == 1:
            if a.armed:
                return int(failed)
            self.reboot_wanted = True
        elif command == dialect.MAV_CMD_PREFLIGHT_CALIBRATION and a.armed:
            return int(failed)
        else:
            return int(dialect.MAV_RESULT_UNSUPPORTED)
        return int(accepted)
