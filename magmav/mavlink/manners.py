"""Answers that every polite component owes: to PING, to commands it does not know, to file requests.

Without them ground stations wait for their timeouts. All are addressed to the asker, on the asker's route.
"""

from __future__ import annotations

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.mavlink.codec import Message, Outgoing

_ADDRESSED = ("COMMAND_LONG", "COMMAND_INT", "FILE_TRANSFER_PROTOCOL")
_PING_REPEATS = 3
_FTP_NAK = 129
_FTP_FILE_NOT_FOUND = 10
_FTP_FIRST_REPLY = 128  # opcodes from here on are answers; answering an answer would never end


class Manners:
    """Replies as (system, component) to what is addressed to exactly that, and to everybody's PING."""

    def __init__(self) -> None:
        self._pinged: dict[tuple[int, int], tuple[tuple[int, int], int]] = {}

    def reply(self, message: Message, route: str, system: int, component: int) -> list[Outgoing]:
        """Zero or one answer to one message; broadcast or others' commands are nobody's business here."""
        kind = message.get_type()
        sender = message.get_srcSystem(), message.get_srcComponent()
        if kind == "PING":
            answer = self._ping(message, sender, (system, component))
        elif kind not in _ADDRESSED or (message.target_system, message.target_component) != (
            system,
            component,
        ):
            return []
        elif kind == "FILE_TRANSFER_PROTOCOL":
            answer = _no_such_file(message, sender)
        else:
            answer = dialect.MAVLink_command_ack_message(message.command, dialect.MAV_RESULT_UNSUPPORTED, 0, 0, *sender)
        return [] if answer is None else [Outgoing(answer, route)]

    def _ping(self, message: Message, sender: tuple[int, int], we: tuple[int, int]) -> Message | None:
        """A request has target 0/0. One addressed to us may be a request or an answer to our answer, so
        the same one is answered a few times only: two such components would otherwise play for ever."""
        target = _target(message)
        if target not in ((0, 0), we) or sender == we:
            return None
        what = message.time_usec, message.seq
        last, times = self._pinged.get(sender, (what, 0))
        times = times + 1 if last == what else 1
        if target == we and times > _PING_REPEATS:
            return None
        self._pinged[sender] = what, times
        return dialect.MAVLink_ping_message(message.time_usec, message.seq, *sender)


def _target(message: Message) -> tuple[int, int]:
    return message.target_system, message.target_component


def _no_such_file(message: Message, sender: tuple[int, int]) -> Message | None:
    """MAVLink FTP NAK: sequence one up, same session, size 1, FileNotFound."""
    asked = bytes(message.payload)
    opcode = asked[3]
    if opcode >= _FTP_FIRST_REPLY:
        return None
    sequence = (int.from_bytes(asked[0:2], "little") + 1) & 0xFFFF
    head = sequence.to_bytes(2, "little") + bytes((asked[2], _FTP_NAK, 1, opcode, 0, 0)) + asked[8:12]
    payload = (head + bytes((_FTP_FILE_NOT_FOUND,))).ljust(251, b"\0")
    return dialect.MAVLink_file_transfer_protocol_message(0, *sender, list(payload))
