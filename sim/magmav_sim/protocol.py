"""How the autopilot answers: parameters, commands, stream requests, pings. ArduPilot takes everything addressed to
its system, whatever the component, because a message it cannot forward to another link is its own (the routing
trap); PX4 takes its own component's and what is for all."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav_sim.ardupilot import ArduPilot
from magmav_sim.autopilot import Autopilot
from magmav_sim.faults import AnyFault, Deaf, Slow
from magmav_sim.param_manners import ArduPilotParams, ParamManners, Px4Params
from magmav_sim.streams import Streams

WANTED = frozenset(
    {
        "PARAM_REQUEST_LIST",
        "PARAM_REQUEST_READ",
        "PARAM_SET",
        "COMMAND_LONG",
        "COMMAND_INT",
        "REQUEST_DATA_STREAM",
        "SET_MODE",
        "PING",
    }
)
_FORCE, _FORCE_CALIBRATION = 21196, 76


class Protocol:
    """Takes messages, answers into the autopilot's outbox.

    fly : called by MISSION_START; False when there is no flight waiting for it.
    pong : the sequence number of the last PING of ours that somebody answered; -1 before the first.
    """

    def __init__(
        self, autopilot: Autopilot, streams: Streams, faults: Sequence[AnyFault], fly: Callable[[], bool]
    ) -> None:
        self._a = autopilot
        self._streams = streams
        self._slow = [f for f in faults if isinstance(f, Slow)]
        self._fly = fly
        ardupilot = isinstance(autopilot, ArduPilot)
        self._params: ParamManners = ArduPilotParams(autopilot) if ardupilot else Px4Params(autopilot)
        self._late: deque[tuple[int, list[Any]]] = deque()
        self._numbers = {
            kind.id: name
            for name in autopilot.builders
            if (kind := getattr(dialect, f"MAVLink_{name.lower()}_message"))
        }
        self.pong = -1

    def forget(self) -> None:
        """As after a boot."""
        self._params.forget()
        self._late.clear()

    def handle(self, message: Any) -> None:
        """React to one message from the link."""
        sender = (message.get_srcSystem(), message.get_srcComponent())
        if sender == (self._a.system, self._a.component):
            return
        if getattr(message, "target_system", 0) not in (0, self._a.system):
            return
        if not self._a.takes(getattr(message, "target_component", 0)):
            return
        kind = message.get_type()
        if kind == "PING":
            self._ping(message, sender)
        elif kind in ("COMMAND_LONG", "COMMAND_INT"):
            self._answer_later(lambda: self._command(message, sender))
        elif kind == "REQUEST_DATA_STREAM":
            self._streams.request(
                message.req_stream_id, message.req_message_rate, message.start_stop == 1, self._a.boot_ns
            )
        elif kind == "SET_MODE":
            self._a.mode = message.custom_mode
        elif kind.startswith("PARAM_") and not self._a.holds(Deaf):
            self._answer_later(lambda: self._params.handle(message))

    def answered(self, message: Any) -> bool:
        """Whether this answers a PING of ours: noted at once, also while booting, because pacing waits for
        it."""
        to = (getattr(message, "target_system", 0), getattr(message, "target_component", 0))
        if message.get_type() != "PING" or to != (self._a.system, self._a.component):
            return False
        self.pong = max(self.pong, message.seq)
        return True

    def trickle(self) -> None:
        """Send on with a parameter list that was asked for, and answers that took their time."""
        self._answer_later(self._params.trickle)
        while self._late and self._late[0][0] <= self._a.elapsed_ns:
            self._a.outbox.extend(self._late.popleft()[1])

    def _answer_later(self, act: Callable[[], None]) -> None:
        """Do it now; while the autopilot is slow what it says about it waits."""
        before = len(self._a.outbox)
        act()
        wait_s = max((f.seconds for f in self._slow if f.active(self._a.elapsed_ns / 1e9)), default=0.0)
        if wait_s or self._late:  # nothing overtakes
            said = self._a.outbox[before:]
            del self._a.outbox[before:]
            due_ns = self._a.elapsed_ns + round(wait_s * 1e9)
            if said:
                self._late.append((max(due_ns, self._late[-1][0] if self._late else 0), said))

    # ------------------------------------------------------------ the rest

    def _ping(self, message: Any, sender: tuple[int, int]) -> None:
        if message.target_system == 0 and message.target_component == 0:
            self._a.outbox.append(dialect.MAVLink_ping_message(message.time_usec, message.seq, *sender))

    def _command(self, message: Any, sender: tuple[int, int]) -> None:
        result = self._run(message.command, message)
        ack = dialect.MAVLink_command_ack_message(message.command, result, 0, 0, *sender)
        self._a.outbox.append(ack)

    def _run(self, command: int, m: Any) -> int:
        accepted, refused = int(dialect.MAV_RESULT_ACCEPTED), int(self._a.refused)
        a = self._a
        if command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL:
            name = self._numbers.get(int(m.param1))
            if name is None or not math.isfinite(m.param2):
                return int(a.unknown_stream)
            self._streams.set_interval(name, m.param2, a.boot_ns)
        elif command == dialect.MAV_CMD_GET_MESSAGE_INTERVAL:
            name = self._numbers.get(int(m.param1))
            us = 0 if name is None else self._streams.interval_us(name)
            a.outbox.append(dialect.MAVLink_message_interval_message(int(m.param1), us))
        elif command == dialect.MAV_CMD_REQUEST_MESSAGE:
            name = self._numbers.get(int(m.param1))
            built = None if name is None else a.builders[name](a)
            if not built:
                return int(dialect.MAV_RESULT_FAILED)
            a.outbox.extend(built if isinstance(built, list) else [built])
        elif command == dialect.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES:
            if m.param1 == 1:
                a.outbox.append(a.builders["AUTOPILOT_VERSION"](a))
        elif command == dialect.MAV_CMD_RUN_PREARM_CHECKS and isinstance(a, ArduPilot):
            if a.armed:
                return int(dialect.MAV_RESULT_TEMPORARILY_REJECTED)
            why = a.compass_refusal()
            if why is not None:
                a.say(dialect.MAV_SEVERITY_CRITICAL, why)
        elif command == dialect.MAV_CMD_COMPONENT_ARM_DISARM:
            done = a.arm(force=m.param2 == _FORCE) if m.param1 == 1 else a.disarm()
            return accepted if done else refused
        elif command == dialect.MAV_CMD_DO_SET_MODE:
            a.mode = int(m.param2) if isinstance(a, ArduPilot) else int(m.param2) << 16 | int(m.param3) << 24
        elif command == dialect.MAV_CMD_MISSION_START:
            return accepted if self._fly() else refused
        elif command == dialect.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN and m.param1 == 1:
            if a.armed:
                return refused
            a.reboot_wanted = True
        elif command == dialect.MAV_CMD_PREFLIGHT_CALIBRATION and a.armed:
            return refused
        elif (
            command == dialect.MAV_CMD_PREFLIGHT_CALIBRATION
            and m.param2 == _FORCE_CALIBRATION
            and isinstance(a, ArduPilot)
        ):
            a.commit()
        else:
            return int(dialect.MAV_RESULT_UNSUPPORTED)
        return accepted
