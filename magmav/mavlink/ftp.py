"""A read-only MAVLink FTP server for a few files in memory (mavlink.io/en/services/ftp.html).

Kept simple by what clients really do (QGroundControl, MAVSDK and pymavlink, as their sources read):
one file is open per client, always as session 0 (MAVSDK never looks at the number it is given); a burst is one packet,
marked as complete, so a slow link never has to hold a stream; a repeat, the same bytes again, gets the same answer
again, but a request with an old number and another offset is a new one. Reads may be answered short, which the
protocol allows: an answer is never longer than the budget ever lets through.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.mavlink.budget import Budget
from magmav.mavlink.codec import Message, Outgoing
from magmav.mavlink.metadata import crc32

MOST_CLIENTS = 4
SILENT_NS = 60_000_000_000
_ACK, _NAK = dialect.MAV_FTP_OPCODE_ACK, dialect.MAV_FTP_OPCODE_NAK
_OPEN, _READ = dialect.MAV_FTP_OPCODE_OPENFILERO, dialect.MAV_FTP_OPCODE_READFILE
_BURST, _LIST = dialect.MAV_FTP_OPCODE_BURSTREADFILE, dialect.MAV_FTP_OPCODE_LISTDIRECTORY
_TERMINATE, _RESET = dialect.MAV_FTP_OPCODE_TERMINATESESSION, dialect.MAV_FTP_OPCODE_RESETSESSION
_WRITES = range(dialect.MAV_FTP_OPCODE_CREATEFILE, dialect.MAV_FTP_OPCODE_RENAME + 1)
_FULL = dialect.MAV_FTP_ERR_NOSESSIONSAVAILABLE
_HEAD, _DATA = 12, 239
_OVERHEAD = 12 + 3 + _HEAD  # MAVLink 2 frame, network and target, FTP header

_Who = tuple[int, int, str]


@dataclass(slots=True)
class _Client:
    heard_ns: int
    held: bytes | None = None  # the open file
    asked: bytes = b""  # the last request
    answer: bytes = b""
    waiting: bool = False  # the answer is not out yet


class _Refused(Exception):
    """Carries the error code of a NAK."""


class FileServer:
    """Serves ``files`` (name -> content), all in the root folder, to at most MOST_CLIENTS clients at once.

    A client is (system, component, route), forgotten after a minute of silence; one too many hears that all sessions
    are taken. Answers wait for room in the budget: ``poll`` gives at most one a call, and its caller counts it there.
    """

    def __init__(self, files: Mapping[str, bytes], budget: Budget) -> None:
        self._files = dict(files)
        self._budget = budget
        self._clients: dict[_Who, _Client] = {}
        self._away: tuple[_Who, bytes] | None = None  # the last who came when all places were taken

    def on_message(self, message: Message, route: str, now_ns: int) -> None:
        """Take a FILE_TRANSFER_PROTOCOL that is addressed to us. An answer is not answered."""
        raw = bytes(message.payload)
        if len(raw) < _HEAD or raw[3] >= _ACK:
            return
        who = message.get_srcSystem(), message.get_srcComponent(), route
        client = self._client(who, now_ns)
        if client is None:
            self._away = who, _reply(raw, _NAK, bytes((_FULL,)))
            return
        asked = raw[: _HEAD + raw[4]]
        if asked != client.asked:
            client.asked, client.answer = asked, self._answer(raw, client)
        client.waiting = True  # the latest word counts: who asks anew no longer waits for what was before

    def poll(self, now_ns: int) -> list[Outgoing]:
        """One answer, if any is due and there is room for it; the clients take turns."""
        due = next(((who, client.answer) for who, client in self._clients.items() if client.waiting), self._away)
        if due is None:
            return []
        who, answer = due
        payload = list(answer.ljust(_HEAD + _DATA, b"\0"))
        message = dialect.MAVLink_file_transfer_protocol_message(0, *who[:2], payload)
        if not self._budget.has(message, now_ns, self._budget.reserve, who[2]):
            return []
        if due is self._away:
            self._away = None
        else:
            client = self._clients.pop(who)
            client.waiting = False
            self._clients[who] = client  # behind the others
        return [Outgoing(message, who[2])]

    def _client(self, who: _Who, now_ns: int) -> _Client | None:
        """Who asks; None when all places are taken."""
        client = self._clients.get(who)
        if client is None:
            self._clients = {w: c for w, c in self._clients.items() if now_ns - c.heard_ns < SILENT_NS}
            if len(self._clients) >= MOST_CLIENTS:
                return None
            client = self._clients[who] = _Client(now_ns)
        client.heard_ns = now_ns
        return client

    def _answer(self, raw: bytes, client: _Client) -> bytes:
        try:
            return _reply(raw, _ACK, self._do(raw, client))
        except _Refused as refused:
            return _reply(raw, _NAK, bytes(refused.args))

    def _do(self, raw: bytes, client: _Client) -> bytes:
        """The data of the ACK. Raises _Refused."""
        session, opcode, size = raw[2:5]
        if size > _DATA:
            raise _Refused(dialect.MAV_FTP_ERR_INVALIDDATASIZE)
        if opcode in (_READ, _BURST, _TERMINATE) and (session != 0 or client.held is None):
            raise _Refused(dialect.MAV_FTP_ERR_INVALIDSESSION)
        if opcode in (_READ, _BURST):
            return self._read(raw, client.held or b"")
        if opcode in (_TERMINATE, _RESET):
            client.held = None  # a reset too: other clients' files are not this one's to close
            return b""
        if opcode == _OPEN:
            client.held = self._file(raw)
            return len(client.held).to_bytes(4, "little")
        if opcode == dialect.MAV_FTP_OPCODE_CALCFILECRC:
            return crc32(self._file(raw)).to_bytes(4, "little")
        if opcode == _LIST:
            return self._list(raw)
        if opcode == dialect.MAV_FTP_OPCODE_NONE:
            return b""
        protected, unknown = dialect.MAV_FTP_ERR_FILEPROTECTED, dialect.MAV_FTP_ERR_UNKNOWNCOMMAND
        raise _Refused(protected if opcode in _WRITES else unknown)

    @property
    def _room(self) -> int:
        """Bytes of data in one answer."""
        return min(_DATA, self._budget.largest - _OVERHEAD)

    def _read(self, raw: bytes, content: bytes) -> bytes:
        size, offset = raw[4], int.from_bytes(raw[8:12], "little")
        if size == 0:
            raise _Refused(dialect.MAV_FTP_ERR_INVALIDDATASIZE)
        if offset >= len(content):
            raise _Refused(dialect.MAV_FTP_ERR_EOF)
        return content[offset : offset + min(size, self._room)]

    def _file(self, raw: bytes) -> bytes:
        content = self._files.get(_path(raw))
        if content is None:
            raise _Refused(dialect.MAV_FTP_ERR_FILENOTFOUND)
        return content

    def _list(self, raw: bytes) -> bytes:
        """Whole entries from the wanted one on, as many as fit."""
        if _path(raw) not in ("", "."):
            raise _Refused(dialect.MAV_FTP_ERR_FILENOTFOUND)
        rows = [f"F{name}\t{len(content)}\0".encode("ascii") for name, content in self._files.items()]
        out = b""
        for row in rows[int.from_bytes(raw[8:12], "little") :]:
            if len(out) + len(row) > self._room:
                break
            out += row
        if not out:
            raise _Refused(dialect.MAV_FTP_ERR_EOF)
        return out


def _path(raw: bytes) -> str:
    """The path asked for, without the slashes of its ends; some clients count a closing zero, some do not."""
    return raw[_HEAD : _HEAD + raw[4]].split(b"\0")[0].decode("ascii", "replace").strip("/")


def _reply(raw: bytes, code: int, data: bytes) -> bytes:
    """Sequence one up, session 0 for a file that was opened, else the one asked for; offset as asked."""
    sequence = (int.from_bytes(raw[0:2], "little") + 1) & 0xFFFF
    opcode = raw[3]
    session = 0 if (opcode, code) == (_OPEN, _ACK) else raw[2]
    burst_done = int(opcode == _BURST and code == _ACK)
    return sequence.to_bytes(2, "little") + bytes((session, code, len(data), opcode, burst_done, 0)) + raw[8:12] + data
