"""A .tlog as a recording, read by columns: reading for reading what LinkRecording gives of it, sooner."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from magmav.core.motion_run import AttitudeColumns, MotionRun, run_ends
from magmav.core.types import Reading
from magmav.logs import Progress
from magmav.logs.tlog import TlogColumns, TlogTable, read_tlog
from magmav.mavlink.decode import Decoder
from magmav.mavlink.decode_bulk import Attitudes, Bulk, bulk

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


class _Script(NamedTuple):
    """What is played when: of each message its time, kind, row, sender, and where a run that begins there ends."""

    t_ns: list[int]
    kinds: list[int]
    rows: list[int]
    systems: list[int]
    components: list[int]
    run_ends: list[int]
    attitudes: AttitudeColumns | None
    makers: list[Bulk]
    decoder: Decoder

    def one_by_one(self, begin: int, end: int) -> Iterator[tuple[int, Reading]]:
        """The readings of these messages, their senders judged."""
        for i in range(begin, end):
            maker, system = self.makers[self.kinds[i]], self.systems[i]
            if isinstance(maker, _Rare) or self.decoder.believes(system, self.components[i]):
                for reading in maker.readings(self.rows[i], system, self.decoder):
                    yield self.t_ns[i], reading

    def believes(self, begin: int, end: int) -> bool:
        """Whether the sender of a run counts; each of its messages is counted where it does not."""
        system, component = self.systems[begin], self.components[begin]
        if self.decoder.believes(system, component):
            return True
        for _ in range(begin + 1, end):
            self.decoder.believes(system, component)
        return False

    def run(self, begin: int, end: int) -> MotionRun:
        """Of a run's messages."""
        row, columns = self.rows[begin], self.attitudes
        if columns is None:
            raise RuntimeError("nothing was read in runs")
        until, again = row + end - begin, partial(self._again, begin, end)
        times = columns.boot_ns
        return MotionRun(self.systems[begin], columns, row, until, times[row], times[until - 1], again)

    def _again(self, begin: int, end: int) -> Iterator[tuple[int, Reading]]:
        """As one_by_one, their sender judged already."""
        for i in range(begin, end):
            for reading in self.makers[self.kinds[i]].readings(self.rows[i], self.systems[i], self.decoder):
                yield self.t_ns[i], reading


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
        for script in self._scripts(in_runs=False):
            yield from script.one_by_one(0, len(script.t_ns))

    def in_runs(self) -> Iterator[tuple[int, Reading | MotionRun]]:
        """The same with attitudes in runs, see Recording.in_runs."""
        for script in self._scripts(in_runs=True):
            place, size = 0, len(script.t_ns)
            while place < size:
                end = script.run_ends[place]
                if end <= place:
                    end = place + 1
                    yield from script.one_by_one(place, end)
                elif script.believes(place, end):
                    yield script.t_ns[place], script.run(place, end)
                place = end

    def _scripts(self, in_runs: bool) -> Iterator[_Script]:
        """The whole recording, some thousand messages at a time."""
        columns, self._columns = self._columns, None
        if columns is None or not columns.by_name:
            return
        makers: list[Bulk] = []
        for name, table in columns.by_name.items():
            makers.append(bulk(name, table.fields) or _Rare(name, table))
        tables = list(columns.by_name.values())
        order = np.concatenate([table.order for table in tables])
        place = np.argsort(order, kind="stable")
        kinds = np.repeat(np.arange(len(tables)), [len(table) for table in tables])[place]
        rows = np.concatenate([np.arange(len(table)) for table in tables])[place]
        told = ("t_ns", "system", "component")
        t_ns, system, component = (np.concatenate([getattr(t, what) for t in tables])[place] for what in told)
        attitudes, ends = None, np.zeros(len(place), dtype=np.int64)
        for which, (maker, table) in enumerate(zip(makers, tables, strict=True)):
            if in_runs and isinstance(maker, Attitudes):
                attitudes = maker.columns(table.system.astype(np.int64) << 8 | table.component)
                ends = run_ends(attitudes, np.where(kinds == which, rows, -1), np.full(len(place), -1))
        for begin in range(0, len(place), _EVERY):
            part = slice(begin, begin + _EVERY)
            t, kind, row, who, which = (column[part].tolist() for column in (t_ns, kinds, rows, system, component))
            until = np.clip(ends[part] - begin, 0, len(t)).tolist()
            yield _Script(t, kind, row, who, which, until, attitudes, makers, self._decoder)
            if self._progress is not None:
                self._progress(self._size * min(begin + _EVERY, len(place)) // len(place), self._size)

    def close(self) -> None:
        """Nothing is held."""
        self._columns = None
