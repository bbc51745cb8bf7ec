"""Parameters of one autopilot, asked for and written by name: what is open, and what it said it holds."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.mavlink.autopilot.adapter import Adapter
from magmav.mavlink.codec import Message, Outgoing
from magmav.mavlink.exchange import Exchange
from magmav.mavlink.float32 import same
from magmav.mavlink.values import bytewise, cast


class Dialogue:
    """stored : values as last heard, by name; a name just written is not known until it is heard again.

    names : only these are listened to.  wrote_ns : when the last PARAM_SET was made.
    """

    def __init__(self, adapter: Adapter, pin: tuple[int, int, str], names: Iterable[str]) -> None:
        self.stored: dict[str, float] = {}
        self.wrote_ns: int | None = None
        self.asking = Exchange((), 0, 0)
        self._adapter = adapter
        self._pin = pin
        self._names = frozenset(names)

    @property
    def wrote(self) -> bool:
        """At least one PARAM_SET was made."""
        return self.wrote_ns is not None

    def turn_to(self, names: Iterable[str], retry_ns: int, tries: int) -> None:
        """From now on these names are open."""
        self.asking = Exchange(names, retry_ns, tries)

    def heard(self, message: Message, wanted: Mapping[str, float] | None, by_bytes: bool | None = None) -> None:
        """Take a PARAM_VALUE. A name is answered by any value, or with ``wanted`` only by the one that is wanted.

        by_bytes : how the vehicle says that it encodes integers, before what its kind is known for (AT-8b).
        """
        name = message.param_id
        read = self._adapter.value_of if by_bytes is None else bytewise if by_bytes else cast
        value = read(message) if name in self._names else None
        if value is None:
            return
        self.stored[name] = value
        if wanted is None or (name in wanted and same(value, wanted[name])):
            self.asking.answered(name)

    def read(self, now_ns: int) -> list[Outgoing]:
        """PARAM_REQUEST_READ of what is open and due."""
        out = []
        for name in self.asking.due(now_ns):
            self.asking.asked(name, now_ns)
            out.append(self._to(dialect.MAVLink_param_request_read_message(*self._pin[:2], name.encode(), -1)))
        return out

    def write(self, values: Mapping[str, float], now_ns: int) -> list[Outgoing]:
        """PARAM_SET of what is open and due; offsets are floats on every autopilot."""
        out = []
        for name in self.asking.due(now_ns):
            self.asking.asked(name, now_ns)
            self.stored.pop(name, None)
            self.wrote_ns = now_ns
            kind = dialect.MAV_PARAM_TYPE_REAL32
            out.append(self._to(self._adapter.set_message(*self._pin[:2], name, values[name], kind)))
        return out

    def _to(self, message: Message) -> Outgoing:
        return Outgoing(message, self._pin[2])
