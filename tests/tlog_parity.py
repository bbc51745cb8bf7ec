"""A tlog of every kind of frame, ways to damage it, and what link and codec give of it one message at a time."""

from __future__ import annotations

import random
import struct
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.link.tlog import TlogLink
from magmav.logs.tlog import TlogColumns
from magmav.mavlink.codec import Codec

Row = tuple[str, int, int, int, bytes]
Harm = Callable[[bytearray, random.Random], None]
START_US = 1_700_000_000_000_000


def messages(rng: random.Random) -> list[Any]:
    """One of each kind that is read, and two that are not, with numbers that trim to any length."""
    small = [rng.choice((0, 0, 1, 255, -1)) for _ in range(9)]
    angles = [rng.choice((0.0, 0.5, -3.1, float("nan"))) for _ in range(6)]
    return [
        dialect.MAVLink_heartbeat_message(2, rng.choice((3, 3, 12, 8)), 128, rng.choice((0, 4)), 0, 3),
        dialect.MAVLink_raw_imu_message(rng.randrange(2**40), *small),
        dialect.MAVLink_scaled_imu2_message(rng.randrange(2**31), *small),
        dialect.MAVLink_attitude_message(rng.randrange(2**31), *angles),
        dialect.MAVLink_param_value_message(b"COMPASS_OFS_X", rng.choice(angles), 9, 900, rng.randrange(900)),
        dialect.MAVLink_battery_status_message(0, 0, 0, 0, [rng.randrange(5)] * 10, rng.randrange(900), 0, 0, -1),
        dialect.MAVLink_global_position_int_message(1, 2, 3, 4, 5, 6, 7, 8, 0),
        dialect.MAVLink_mag_cal_report_message(0, 0, 4, 1, 1.0, *angles, *angles[:3]),
        dialect.MAVLink_statustext_message(6, b"a text with \xfd and \xfe in it"),
        dialect.MAVLink_rc_channels_message(1, 8, *([1500] * 18), 100),
    ]


def flight(seed: int, count: int = 120) -> list[bytes]:
    """Records of both versions, signed and plain, of three systems, two of them with a second component."""
    rng = random.Random(seed)
    out = []
    stamp_us = START_US
    for _ in range(count):
        mav = dialect.MAVLink(None, srcSystem=rng.choice((1, 1, 2, 255)), srcComponent=rng.choice((1, 1, 100)))
        mav.seq = rng.randrange(256)
        signed = rng.random() < 0.2
        if signed:
            mav.signing.secret_key, mav.signing.sign_outgoing = bytes(32), True
        frame = rng.choice(messages(rng)).pack(mav, force_mavlink1=not signed and rng.random() < 0.3)
        stamp_us += rng.choice((0, 1000, 20_000, 20_000, 20_000, -300, 2_500_000))
        out.append(stamp_us.to_bytes(8, "big") + bytes(frame))
    return out


def flip(data: bytearray, rng: random.Random) -> None:
    data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def cut(data: bytearray, rng: random.Random) -> None:
    del data[rng.randrange(len(data)) :]


def lose(data: bytearray, rng: random.Random) -> None:
    at = rng.randrange(len(data))
    del data[at : at + rng.randrange(1, 200)]


def stuff(data: bytearray, rng: random.Random) -> None:
    at = rng.randrange(len(data))
    data[at:at] = rng.choice((rng.randbytes(rng.randrange(1, 400)), b"\xfd" * 30, b"\0\x05" * 40, bytes(90)))


def lie(data: bytearray, rng: random.Random) -> None:
    """A length or a flag that is not true."""
    at = data.find(b"\xfd", rng.randrange(len(data)))
    if at >= 0 and at + 2 < len(data):
        data[at + rng.choice((1, 2))] = rng.randrange(256)


def repeat(data: bytearray, rng: random.Random) -> None:
    """Some of it comes twice: times go back, and frames stand within frames."""
    at = rng.randrange(len(data))
    data[at:at] = data[rng.randrange(len(data)) :][: rng.randrange(1, 900)]


HARM: list[Harm] = [flip, cut, lose, stuff, lie, repeat]


def harmed(seed: int, harm: list[Harm]) -> bytes:
    """A short flight with these harms done to it one after the other."""
    data, rng = bytearray(b"".join(flight(seed % 50, 60))), random.Random(seed)
    for one in harm:
        if len(data) > 1:
            one(data, rng)
    return bytes(data)


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
