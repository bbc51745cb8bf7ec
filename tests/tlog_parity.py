"""What link and codec give of a tlog one message at a time, in the shape of the columns."""

from __future__ import annotations

import struct
from collections import Counter
from pathlib import Path
from typing import Any

from magmav.link.tlog import TlogLink
from magmav.logs.tlog import TlogColumns
from magmav.mavlink.codec import Codec

Row = tuple[str, int, int, int, bytes]


def one_by_one(path: Path, wanted: frozenset[str]) -> tuple[list[Row], Counter[str], Counter[str]]:
    """(name, t_ns, system, component, whole payload) of each message in turn; the link's and the codec's counts."""
    link, codec = TlogLink(path), Codec(wanted)
    out = []
    for packet in link.packets():
        if packet.data:
            for m in codec.decode(packet.data, packet.route, whole=True):
                out.append((m.get_type(), packet.t_ns, m.get_srcSystem(), m.get_srcComponent(), _packed(m)))
    return out, +link.counts, +codec.counts


def _packed(message: Any) -> bytes:
    """The payload as the dialect's own unpacker saw it: every bit of every number, trimmed zeros put back."""
    frame = bytes(message.get_msgbuf())
    version2 = frame[0] == 0xFD
    signed = version2 and frame[2] & 1
    body = frame[10 if version2 else 6 : -(15 if signed else 2)]
    size = type(message).unpacker.size
    return body[:size].ljust(size, b"\0")


def woven(columns: TlogColumns) -> list[Row]:
    """The same of the columns, in the order of the file."""
    rows: list[tuple[int, Row]] = []
    for name, table in columns.by_name.items():
        places = zip(
            table.order.tolist(),
            table.t_ns.tolist(),
            table.system.tolist(),
            table.component.tolist(),
            [table.fields[i : i + 1].tobytes() for i in range(len(table))],
            strict=True,
        )
        rows += [(order, (name, t_ns, system, component, body)) for order, t_ns, system, component, body in places]
    rows.sort(key=lambda entry: entry[0])
    assert [order for order, _ in rows] == list(range(len(rows)))
    return [row for _, row in rows]


def values_of(message: Any) -> list[Any]:
    """A message's numbers and texts as the columns name them, lists as tuples, floats by their bits."""
    out = []
    for name in message.ordered_fieldnames:
        value = getattr(message, name)
        if isinstance(value, float):
            value = struct.pack("<d", value)
        out.append(tuple(value) if isinstance(value, list) else value)
    return out
