"""ArduPilot DataFlash logs, .bin or .log, as readings in the order of time: the door to the other dataflash files.

bytes -> dataflash, dataflash_text: Tables -> dataflash_clock: when -> dataflash_series: columns in plain units
      -> dataflash_sensors, dataflash_vehicle, dataflash_state: Streams -> here: one order
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from magmav.core.motion_run import MotionRun
from magmav.core.types import Reading
from magmav.logs import HEAD, LogError, Progress, kind_of, open_log
from magmav.logs import dataflash_sensors as sensors
from magmav.logs import dataflash_state as state
from magmav.logs import dataflash_vehicle as vehicle
from magmav.logs.columns import Ints
from magmav.logs.dataflash import SYNC, read_binary
from magmav.logs.dataflash_clock import clock_of
from magmav.logs.dataflash_runs import Order, Runs
from magmav.logs.dataflash_series import Log, Stream
from magmav.logs.dataflash_text import read_text

_EVERY = 4096
_LATE = 3  # rank of what waits until a reboot has been noticed


class DataflashRecording:
    """One DataFlash log, told apart by content: binary or text.

    Reads the whole file at once. LogError: no such file, not readable, not a DataFlash log. Damage is counted.
    t_ns of a reading is the boot clock. Where the file holds several boots, that of a later one goes on a second after
    the former ended, so that it never turns back; the readings carry each boot's own time.
    progress : called with (readings given, readings in all).
    """

    def __init__(self, path: str | Path, progress: Progress | None = None) -> None:
        self.name = f"dataflash:{path}"
        self.counts: Counter[str] = Counter()
        self._progress = progress
        self._told = -1
        self._streams: list[Stream] = []
        self._shift_ns: list[int] = []
        log = _open(Path(path), self.counts)
        self.heard = log.tables.heard
        self.unix_offset_ns = self._read(log)
        self._drop_zeros()

    def readings(self) -> Iterator[tuple[int, Reading]]:
        """(t_ns, reading) in the order of time, once through."""
        streams, order = self._played()
        makers = [s.make for s in streams]
        for done, (t, which, i) in enumerate(zip(*(column.tolist() for column in order), strict=True)):
            self._tell(done, len(order.t_ns))
            yield t, makers[which](i)
        self._tell(len(order.t_ns), len(order.t_ns), at_once=True)

    def in_runs(self) -> Iterator[tuple[int, Reading | MotionRun]]:
        """The same with attitudes in runs, see Recording.in_runs."""
        streams, order = self._played()
        runs, makers = Runs(streams, order), [s.make for s in streams]
        place, size = 0, len(order.t_ns)
        for begin in range(0, size, _EVERY):
            self._tell(begin, size)
            some = (column[begin : begin + _EVERY].tolist() for column in (*order, runs.ends))
            for here, (t, which, i, end) in enumerate(zip(*some, strict=True), begin):
                if here < place:
                    continue  # it was in a run
                place = max(end, here + 1)
                yield t, runs.at(here) if end > here else makers[which](i)
        self._tell(size, size, at_once=True)

    def _tell(self, done: int, size: int, at_once: bool = False) -> None:
        """The progress, now and then."""
        if self._progress is not None and (at_once or done // _EVERY != self._told):
            self._told = done // _EVERY
            self._progress(done, size)

    def _played(self) -> tuple[list[Stream], Order]:
        """What was read, let go of here, and in which order it is played."""
        streams, self._streams, self._told = self._streams, [], -1
        boot, ns, _, _, stream, row = _in_order(streams)
        return streams, Order(ns + np.array(self._shift_ns or [0], dtype=np.int64)[boot], stream, row)

    def close(self) -> None:
        """Let go of what was read. Safe to call twice."""
        self._streams = []

    def _read(self, log: Log) -> int:
        """Make the streams; what takes boot time to UNIX time."""
        params = state.parameters(log)
        held = state.last_values(params)
        system, kind = state.system_of(held), state.kind_of(log, held)
        clocked = [*sensors.inertial(log, system), *sensors.attitude(log, system), *sensors.mags(log, system)]
        times, offset_ns = vehicle.unix_times(log, system)
        armed = state.arming(log, held, vehicle.throttle(log, kind))
        self._streams = [
            *state.param_streams(params, system, _reboot_noticed(clocked, log.clock.boots)),
            *state.vehicle_stream(log, system, kind, armed),
            *state.landed_stream(log, system),
            *times,
            *vehicle.positions(log, system),
            *vehicle.motions(log, system),
            *vehicle.currents(log, system),
            *vehicle.throttles(log, system, kind),
            *clocked,
        ]
        self._shift_ns = log.clock.shift_ns
        return offset_ns

    def _drop_zeros(self) -> None:
        for key in [k for k, n in self.counts.items() if not n]:
            del self.counts[key]


def _reboot_noticed(clocked: list[Stream], boots: int) -> dict[int, int]:
    """Boot -> time of the second clocked reading of every boot after the first: a reboot is believed by then."""
    out: dict[int, int] = {}
    for boot in range(1, boots):
        ns = sorted({t for s in clocked for t in np.unique(s.when.ns[s.when.boot == boot])[:2].tolist()})
        if len(ns) > 1:
            out[boot] = ns[1]
    return out


def _in_order(streams: list[Stream]) -> tuple[Ints, ...]:
    """Boot, time, rank, place, stream and row of every reading, in the order of time.

    Parameters go before other readings of their time; in a later boot, after those that give the reboot away.
    """
    sizes = [len(s.when.ns) for s in streams]
    stream = np.repeat(np.arange(len(streams)), sizes)
    row = np.concatenate([np.arange(n) for n in sizes] or [np.zeros(0, dtype=np.int64)])
    boot, ns, at = (
        np.concatenate([getattr(s.when, f) for s in streams] or [np.zeros(0, dtype=np.int64)])
        for f in ("boot", "ns", "at")
    )
    rank = np.repeat(np.array([s.rank for s in streams], dtype=np.int64), sizes)
    rank = np.where((rank == 0) & (boot > 0), _LATE, rank)
    order = np.lexsort((at, rank, ns, boot))
    return tuple(a[order] for a in (boot, ns, rank, at, stream, row))


def _open(path: Path, counts: Counter[str]) -> Log:
    """The file as a Log; LogError naming path, cause and cure."""
    with open_log(path, ".bin or .log") as file:
        data = np.fromfile(file, dtype=np.uint8)
    if not len(data):
        raise LogError(f"{path}: is empty; the recording holds nothing, take another one")
    head = data[:HEAD].tobytes()
    if kind_of(head) == "text":
        tables = read_text(data.tobytes(), str(path))
    elif SYNC in head:
        tables = read_binary(data, str(path))
    else:
        raise LogError(
            f"{path}: is no DataFlash log (neither 0xA3 0x95 records nor FMT lines near its front); "
            "give a .bin or .log as an ArduPilot vehicle wrote it"
        )
    counts.update(tables.counts)
    return Log(tables, clock_of(tables, counts), counts)
