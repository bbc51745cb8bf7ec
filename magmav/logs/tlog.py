"""A tlog read by columns: every message of the wanted kinds, each kind one structured array.

The same messages with the same numbers, times and counts as link.TlogLink and mavlink.codec.Codec give one by one, also
where the file is damaged: clean runs of records are taken in one step (tlog_chain), their checksums made together
(tlog_check), and a record whose checksum fails is given to the Codec itself.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.link import LinkError
from magmav.link.frames import V1
from magmav.link.tlog import TlogLink
from magmav.logs import Progress
from magmav.logs.tlog_chain import Records, records
from magmav.logs.tlog_check import good, rows
from magmav.mavlink.codec import Codec

Ints = NDArray[np.int64]
Bytes = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class TlogTable:
    """All messages of one kind, from whomever, in the order of the file; (N,) each.

    order : place among all messages of the file, so that kinds can be woven together again.
    t_ns : arrival, as link.Packet's.  fields : structured, names as MAVLink's; text is bytes without trailing NULs,
    a list of numbers is (N, k). What MAVLink 2 trimmed off the end is zero.
    """

    order: Ints
    t_ns: Ints
    system: NDArray[np.uint8]
    component: NDArray[np.uint8]
    fields: NDArray[Any]

    def __len__(self) -> int:
        return len(self.order)

    def of(self, system: int, component: int | None = None) -> TlogTable:
        """Only what this system, or this component of it, said."""
        mine = self.system == system
        if component is not None:
            mine &= self.component == component
        return self.where(mine)

    def where(self, which: NDArray[Any]) -> TlogTable:
        """Some of them."""
        columns = (self.order, self.t_ns, self.system, self.component, self.fields)
        return TlogTable(*(column[which] for column in columns))


@dataclass(frozen=True, slots=True, eq=False)
class TlogColumns:
    """A whole tlog. counts : the link's and the codec's.  heard : messages by name, of those wanted."""

    by_name: Mapping[str, TlogTable]
    link: Counter[str]
    codec: Counter[str]
    heard: Counter[str]

    @property
    def counts(self) -> Counter[str]:
        """What was left out and why, of link and codec together."""
        return self.link + self.codec

    def of(self, name: str) -> TlogTable:
        """The messages of this kind, as many as there are. KeyError for a name that is no message's."""
        found = self.by_name.get(name)
        return _empty(_KINDS[name]) if found is None else found


def read_tlog(path: str | Path, wanted: frozenset[str], progress: Progress | None = None) -> TlogColumns:
    """The messages of the wanted kinds.

    LinkError as TlogLink's: no such file, not readable, empty, not a tlog. Damage inside is counted.
    KeyError for a name that is no message's.
    """
    unknown = wanted - _KINDS.keys()
    if unknown:
        raise KeyError(f"no MAVLink message called {sorted(unknown)[0]!r}")
    TlogLink(path).close()  # it says what is wrong with a file that is none
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise LinkError(f"tlog:{path}: cannot be read: {error.strerror}") from error
    out = columns(data, wanted)
    if progress is not None:
        progress(len(data), len(data))
    return out


def columns(data: bytes, wanted: frozenset[str]) -> TlogColumns:
    """The same from the file's bytes."""
    link: Counter[str] = Counter()
    found = records(data, link)
    raw = np.frombuffer(data, dtype=np.uint8)
    number = _numbers(raw, found.begin)
    seeds, ids = _seeds(), {_KINDS[name].id: name for name in wanted}
    known = (number < len(seeds)) & (seeds[np.minimum(number, len(seeds) - 1)] >= 0)
    fine = np.zeros(len(number), dtype=bool)
    sure = np.flatnonzero(known)
    seed = seeds[number[sure]].astype(np.uint8)
    fine[sure] = good(raw, found.begin[sure], found.end[sure], seed)
    kept = fine & np.isin(number, list(ids))
    codec = Counter({"messages": int(kept.sum()), "skipped": int((fine & ~kept).sum())})
    tables = _tables(raw, found, np.flatnonzero(kept), number, ids)
    hidden = _hidden(data, found, np.flatnonzero(~fine), wanted, codec)
    for name, extra in hidden.items():
        tables[name] = _merged(tables[name], extra) if name in tables else extra
    tables = _ordered(tables)
    heard = Counter({name: len(table) for name, table in tables.items()})
    return TlogColumns(tables, +link, +codec, heard)


def _numbers(raw: Bytes, begin: Ints) -> Ints:
    """(N,) message numbers."""
    end = len(raw) - 1
    one, two, three, old = (raw[np.minimum(begin + i, end)].astype(np.int64) for i in (7, 8, 9, 5))
    return np.where(raw[begin] == V1, old, one | two << 8 | three << 16)


def _tables(raw: Bytes, found: Records, which: Ints, number: Ints, ids: Mapping[int, str]) -> dict[str, TlogTable]:
    """Each kind among the records ``which``."""
    out = {}
    mine = number[which]
    for one in np.unique(mine).tolist():
        some = which[mine == one]
        out[ids[one]] = _table(raw, found.begin[some], found.t_ns[some], some << 16, _KINDS[ids[one]])
    return out


def _table(raw: Bytes, begin: Ints, t_ns: Ints, order: Ints, kind: Any) -> TlogTable:
    version1 = raw[begin] == V1
    payload = begin + np.where(version1, 6, 10)
    length = raw[begin + 1].astype(np.int64)
    form = _form(kind)
    out = np.zeros(len(begin), dtype=form)
    plain = out.view(np.uint8).reshape(len(begin), form.itemsize)
    for size in np.unique(length).tolist():
        some = length == size
        plain[some, : min(size, form.itemsize)] = rows(raw, payload[some], min(size, form.itemsize))
    who = np.where(version1, 3, 5)
    return TlogTable(order, t_ns, raw[begin + who], raw[begin + who + 1], out)


def _hidden(
    data: bytes, found: Records, which: Ints, wanted: frozenset[str], counts: Counter[str]
) -> dict[str, TlogTable]:
    """What the Codec still finds within records that are no good frame."""
    codec = Codec(wanted)
    frames: dict[str, list[tuple[bytes, int, int]]] = {}
    for one in which.tolist():
        whole = data[found.begin[one] : found.end[one]]
        for place, message in enumerate(codec.decode(whole, "", whole=True)):
            entry = (bytes(message.get_msgbuf()), int(found.t_ns[one]), (one << 16) + place)
            frames.setdefault(message.get_type(), []).append(entry)
    counts.update(codec.counts)
    out = {}
    for name, some in frames.items():
        raw = np.frombuffer(b"".join(frame for frame, _, _ in some), dtype=np.uint8)
        begin = np.cumsum([0, *(len(frame) for frame, _, _ in some[:-1])])
        t_ns, order = (np.array([entry[i] for entry in some], dtype=np.int64) for i in (1, 2))
        out[name] = _table(raw, begin, t_ns, order, _KINDS[name])
    return out


def _merged(one: TlogTable, other: TlogTable) -> TlogTable:
    both = [np.concatenate(pair) for pair in zip(_columns(one), _columns(other), strict=True)]
    table = TlogTable(*both)
    return table.where(np.argsort(table.order, kind="stable"))


def _ordered(tables: Mapping[str, TlogTable]) -> dict[str, TlogTable]:
    """The same with ``order`` counted from 0 without a gap."""
    if not tables:
        return {}
    everything = np.sort(np.concatenate([table.order for table in tables.values()]))
    return {
        name: TlogTable(np.searchsorted(everything, table.order), *_columns(table)[1:])
        for name, table in tables.items()
    }


def _columns(table: TlogTable) -> tuple[NDArray[Any], ...]:
    return table.order, table.t_ns, table.system, table.component, table.fields


def _empty(kind: Any) -> TlogTable:
    none, byte = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.uint8)
    return TlogTable(none, none, byte, byte, np.zeros(0, dtype=_form(kind)))


def _form(kind: Any) -> np.dtype[Any]:
    """Numpy's type of a whole payload, as the dialect has it on the wire."""
    letters = kind.native_format.decode()[1:]
    form: list[Any] = []
    for name, letter, count in zip(kind.ordered_fieldnames, letters, kind.array_lengths, strict=True):
        if letter == "c":
            form.append((name, f"S{max(count, 1)}"))
        else:
            form.append((name, f"<{letter}", (count,)) if count else (name, f"<{letter}"))
    return np.dtype(form)


def _seeds() -> NDArray[np.int16]:
    """By message number the byte of its own that each checksum ends with; -1 where there is no such message."""
    told = Codec(frozenset()).seeds
    out = np.full(max(told) + 1, -1, dtype=np.int16)
    out[list(told)] = list(told.values())
    return out


_KINDS: dict[str, Any] = {kind.msgname: kind for kind in dialect.mavlink_map.values()}
