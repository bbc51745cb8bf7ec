"""A .tlog as a recording, read by columns: reading for reading what LinkRecording gives of it, sooner."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from magmav.core.types import Reading
from magmav.logs import Progress
from magmav.logs.tlog import TlogColumns, TlogTable, read_tlog
from magmav.mavlink.decode import Decoder
from magmav.mavlink.decode_bulk import Bulk, bulk

MOST_BYTES = 1 << 28
"""A longer file is heard packet by packet, in little memory: this one holds a few times the file's size."""
_EVERY = 1 << 13  # messages between two words of progress


class _Said:
    """One message, its values by name, as the Decoder wants to see it."""

    def __init__(self, name: str, system: int, component: int, values: dict[str, Any], payload: bytes) -> None:
        self.__dict__.update(values)
        self._name, self._system, self._component, self._payload = name, system, component, payload

    def get_type(self) -> str:
        """Name of the message."""
        return self._name

    def get_srcSystem(self) -> int:
        """System it came from."""
        return self._system

    def get_srcComponent(self) -> int:
        """Component it came from."""
        return self._component

    def get_msgbuf(self) -> bytes:
        """A frame with its payload, whole: what is read of it are the bytes of a parameter."""
        return b"\xfd" + bytes((len(self._payload),)) + bytes(8) + self._payload


class _Rare:
    """Messages of one kind, one at a time through the Decoder. Satisfies Bulk."""

    def __init__(self, name: str, table: TlogTable) -> None:
        self._name, self._table = name, table
        self._labels = table.fields.dtype.names or ()
        self._text = [label for label in self._labels if table.fields.dtype[label].kind == "S"]

    def readings(self, row: int, system: int, decoder: Decoder) -> list[Reading]:
        """What this one says, its sender judged."""
        one = self._table.fields[row]
        values: dict[str, Any] = dict(zip(self._labels, one.item(), strict=True))
        for label in self._text:  # as pymavlink: up to the first NUL, what is not ASCII is not known
            values[label] = values[label].split(b"\0", 1)[0].decode("ascii", errors="replace")
        component = int(self._table.component[row])
        return decoder.readings(_Said(self._name, system, component, values, one.tobytes()))


class TlogRecording:
    """Satisfies magmav.logs.Recording. Reads the file when made; LinkError as read_tlog's.

    heard and counts of link and codec are those of the whole file from the first.
    """

    def __init__(self, path: str | Path, progress: Progress | None = None) -> None:
        self.name = f"tlog:{path}"
        self.unix_offset_ns = 0  # as TlogLink's, before the recorder's clock was set
        self._decoder = Decoder()
        self._progress = progress
        self._size = Path(path).stat().st_size if Path(path).is_file() else 0
        self._columns: TlogColumns | None = read_tlog(path, self._decoder.wanted)
        self._told = {"link": self._columns.link, "codec": self._columns.codec}
        self.heard = self._columns.heard

    @property
    def counts(self) -> Counter[str]:
        """What was left out and why."""
        return self._told["link"] + self._told["codec"] + self._decoder.counts

    def by_storey(self) -> dict[str, dict[str, int]]:
        """The same, apart for link, codec and decoder."""
        return {**{k: dict(v) for k, v in self._told.items()}, "decode": dict(self._decoder.counts)}

    def readings(self) -> Iterator[tuple[int, Reading]]:
        """(t_ns, reading) in the order of arrival. Once through."""
        columns, self._columns = self._columns, None
        if columns is None or not columns.by_name:
            return
        makers: list[Bulk] = []
        rare = []
        for name, table in columns.by_name.items():
            frequent = bulk(name, table.fields)
            rare.append(frequent is None)
            makers.append(_Rare(name, table) if frequent is None else frequent)
        tables, decoder = list(columns.by_name.values()), self._decoder
        order = np.concatenate([table.order for table in tables])
        place = np.argsort(order, kind="stable")
        kinds = np.repeat(np.arange(len(tables)), [len(table) for table in tables])[place]
        rows = np.concatenate([np.arange(len(table)) for table in tables])[place]
        told = ("t_ns", "system", "component")
        t_ns, system, component = (np.concatenate([getattr(t, what) for t in tables])[place] for what in told)
        for begin in range(0, len(place), _EVERY):
            part = slice(begin, begin + _EVERY)
            some = (column[part].tolist() for column in (t_ns, kinds, rows, system, component))
            for t, kind, row, who, which in zip(*some, strict=True):
                if rare[kind] or decoder.believes(who, which):
                    for reading in makers[kind].readings(row, who, decoder):
                        yield t, reading
            if self._progress is not None:
                self._progress(self._size * min(begin + _EVERY, len(place)) // len(place), self._size)

    def close(self) -> None:
        """Nothing is held."""
        self._columns = None
