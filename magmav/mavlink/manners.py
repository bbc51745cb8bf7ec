"""Answers that every polite component owes: to PING, to commands it does not know, to file requests.

Without them ground stations wait for their timeouts. All are addressed to the asker, on the asker's route. Nobody can
make us talk without end: PINGs of others than the vehicle are answered a few times a second, commands only while no
debt has grown.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.mavlink import metadata
from magmav.mavlink.budget import Budget
from magmav.mavlink.codec import Message, Outgoing
from magmav.mavlink.ftp import FileServer

_COMMANDS = ("COMMAND_LONG", "COMMAND_INT")
_PING_REPEATS = 3
_PINGS_PER_S = 5.0
_OWN_PINGS_PER_S = 400.0  # of the vehicle we belong to: a simulated one keeps step with us by them
_MOST_PINGERS = 64
_MOST_DEBT_S = 2.0  # a command is answered at once unless somebody floods us


class Manners:
    """Replies as (system, component) to what is addressed to exactly that, and to everybody's PING.

    budget : only asked for room; whoever sends the answers counts them there.  files : what the FTP server serves,
    and what COMPONENT_METADATA speaks of when there is a general file among them.
    counts : "pings dropped", "commands dropped" (too many at once).
    """

    def __init__(self, budget: Budget | None = None, files: Mapping[str, bytes] | None = None) -> None:
        self.counts: Counter[str] = Counter()
        self._budget = Budget() if budget is None else budget
        self._files = dict(files or {})
        self._server = FileServer(self._files, self._budget)
        self._pinged: dict[tuple[int, int], tuple[tuple[int, int], int]] = {}
        self._pings = {False: _PINGS_PER_S, True: _OWN_PINGS_PER_S}  # that may be answered now; of the vehicle's own
        self._ping_ns = {False: 0, True: 0}

    def reply(self, message: Message, route: str, system: int, component: int, now_ns: int) -> list[Outgoing]:
        """What is to be said to one message at once; broadcast or others' commands are nobody's business here."""
        kind = message.get_type()
        sender = message.get_srcSystem(), message.get_srcComponent()
        if kind == "PING":
            answer = self._ping(message, sender, (system, component), now_ns)
            return [] if answer is None else [Outgoing(answer, route)]
        if kind != "FILE_TRANSFER_PROTOCOL" and kind not in _COMMANDS:
            return []
        if _target(message) != (system, component):
            return []
        if kind in _COMMANDS:
            return [Outgoing(answer, route) for answer in self._command(message, sender, now_ns)]
        self._server.on_message(message, route, now_ns)
        return []

    def poll(self, now_ns: int) -> list[Outgoing]:
        """At most one answer of the file server."""
        return self._server.poll(now_ns)

    def _command(self, message: Message, sender: tuple[int, int], now_ns: int) -> list[Message]:
        if self._budget.debt(now_ns) > _MOST_DEBT_S * self._budget.bps:
            self.counts["commands dropped"] += 1
            return []
        asked = message.command == dialect.MAV_CMD_REQUEST_MESSAGE and message.param1 == metadata.ID
        known = asked and metadata.GENERAL in self._files
        result = dialect.MAV_RESULT_ACCEPTED if known else dialect.MAV_RESULT_UNSUPPORTED
        ack = dialect.MAVLink_command_ack_message(message.command, result, 0, 0, *sender)
        return [ack, metadata.announcement(self._files, now_ns)] if known else [ack]

    def _ping(self, message: Message, sender: tuple[int, int], we: tuple[int, int], now_ns: int) -> Message | None:
        """A request has target 0/0. One addressed to us may be a request or an answer to our answer, so
        the same one is answered a few times only: two such components would otherwise play for ever."""
        target = _target(message)
        if target not in ((0, 0), we) or sender == we:
            return None
        what = message.time_usec, message.seq
        last, times = self._pinged.pop(sender, (what, 0))
        times = times + 1 if last == what else 1
        self._pinged[sender] = what, times
        if len(self._pinged) > _MOST_PINGERS:
            del self._pinged[next(iter(self._pinged))]  # who has been silent longest
        if target == we and times > _PING_REPEATS:
            return None
        own = sender[0] == we[0]
        most = _OWN_PINGS_PER_S if own else _PINGS_PER_S
        self._pings[own] = min(most, self._pings[own] + max(now_ns - self._ping_ns[own], 0) * most / 1e9)
        self._ping_ns[own] = now_ns
        if self._pings[own] < 1.0:
            self.counts["pings dropped"] += 1
            return None
        self._pings[own] -= 1.0
        return dialect.MAVLink_ping_message(message.time_usec, message.seq, *sender)


def _target(message: Message) -> tuple[int, int]:
    return message.target_system, message.target_component
