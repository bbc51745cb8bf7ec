"""One ULog file through pyulog, whatever state it is in: columns of numbers, or a LogError.

pyulog prints, trusts lengths and swallows damage. Here nothing is printed, a file that lies about lengths costs
neither hours nor memory, and what was lost is counted.
"""

from __future__ import annotations

import contextlib
import io
import os
import struct
from collections import Counter
from collections.abc import Collection
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from pyulog import ULog
from pyulog.exceptions import ULogException

from magmav.logs import LogError, Progress, open_log

_TELL_EVERY = 1 << 18
_LONGEST = 1 << 16  # a message is no longer than this
_MOST_FIELDS = 20_000  # of one message; PX4's largest has some hundreds
_STEP_BACK = 1 << 12  # a step back through damage costs as much time as reading so many bytes again
_MOST_AGAIN = 1 << 32  # whatever the size of the file: some seconds
_NEAR_US = 60_000_000  # from the middle one of three neighbours; a gap puts none of them further off
_LOG_US = 7 * 86_400_000_000  # no log is longer than a week


class _Watched(io.BufferedIOBase):
    """The open file, counting what is read of it.

    It ends where only zeros follow (a card fills a file it never finished with them), and once too much was read again:
    pyulog searches damage byte by byte, up to 64 kB for each; a sound file is read once. ``gave_up`` says that it came
    to that.
    """

    def __init__(self, file: BinaryIO, size: int, progress: Progress | None) -> None:
        self._file, self._size, self._progress = file, size, progress
        self._end = _end_of_data(file, size)
        self._read_bytes = self._told = self._farthest = self._again = 0
        self.gave_up = False

    def read(self, size: int | None = -1, /) -> bytes:
        if self._again > _MOST_AGAIN:
            self.gave_up = True
            return b""
        start = self._file.tell()
        left = max(0, self._end - start)
        data = self._file.read(left if size is None or size < 0 else min(size, left))
        stop = start + len(data)
        self._again += max(0, min(stop, self._farthest) - start)
        self._farthest = max(stop, self._farthest)
        self._read_bytes += len(data)
        if self._progress is not None and self._read_bytes - self._told > _TELL_EVERY:
            self._told = self._read_bytes
            self._progress(self._file.tell(), self._size)
        return data

    def seek(self, offset: int, whence: int = 0, /) -> int:
        before = self._file.tell()
        after = self._file.seek(offset, whence)
        self._again += _STEP_BACK if after < before else 0
        return after

    def tell(self) -> int:
        return self._file.tell()


def _end_of_data(file: BinaryIO, size: int) -> int:
    """Where nothing but zeros follows, and a last message that ends in zeros is over."""
    end = size
    while end > 0:
        start = max(0, end - _LONGEST)
        file.seek(start)
        kept = file.read(end - start).rstrip(b"\0")
        if kept:
            end = start + len(kept)
            break
        end = start
    file.seek(0)
    return min(size, end + _LONGEST)


class _Guarded(ULog):  # type: ignore[misc]
    """pyulog with a limit on how many fields one message may claim to have."""

    class _MessageAddLogged(ULog._MessageAddLogged):  # type: ignore[misc]
        def _parse_nested_type(self, prefix_str: str, type_name: str, message_formats: Any) -> None:
            claimed = sum(max(1, size) for _, size, _ in message_formats[type_name].fields)
            if len(self.field_data) + claimed > _MOST_FIELDS or prefix_str.count(".") > 20:
                raise ValueError(f"{type_name}: too many fields")
            super()._parse_nested_type(prefix_str, type_name, message_formats)


class Topic:
    """One instance of one topic as columns, rows in the order of time.

    t_us : (n,) int64, boot time, of measurement where the topic says so. Rows whose time cannot be are left out.
    """

    def __init__(self, name: str, instance: int, columns: dict[str, NDArray[Any]], start_us: int) -> None:
        self.name, self.instance = name, instance
        published = _int64(columns["timestamp"])
        keep = _believable(published, start_us)
        taken = _int64(columns["timestamp_sample"]) if "timestamp_sample" in columns else published
        sane = (taken > 0) & (np.abs(published - taken) < 1_000_000)
        times = np.where(sane, taken, published)
        order = np.flatnonzero(keep)
        order = order[np.argsort(times[order], kind="stable")]
        self.t_us = times[order]
        self.dropped = len(keep) - len(order)
        self._columns = {k: v[order] for k, v in columns.items()}

    def __len__(self) -> int:
        return len(self.t_us)

    def __contains__(self, field: str) -> bool:
        return field in self._columns

    def column(self, field: str) -> NDArray[Any]:
        """(n,) of one field; KeyError when the topic has no such field."""
        return self._columns[field]

    def first(self, *fields: str) -> NDArray[Any] | None:
        """(n,) of the first of these fields that is there: releases rename them."""
        return next((self._columns[f] for f in fields if f in self._columns), None)

    def vectors(self, field: str) -> NDArray[np.float64] | None:
        """(n, 3) of ``field[0]`` to ``field[2]``, or None."""
        names = [f"{field}[{i}]" for i in range(3)]
        if any(n not in self._columns for n in names):
            return None
        return np.column_stack([self._columns[n].astype(np.float64) for n in names])

    def rows(self, chosen: NDArray[Any]) -> Topic:
        """The same topic with the chosen rows only; chosen indexes or masks."""
        out = object.__new__(Topic)
        out.name, out.instance, out.dropped = self.name, self.instance, 0
        out.t_us, out._columns = self.t_us[chosen], {k: v[chosen] for k, v in self._columns.items()}
        return out


def _int64(column: NDArray[Any]) -> NDArray[np.int64]:
    """Times as int64; what does not fit becomes 0, which no clock shows."""
    if column.dtype.kind not in "iu":
        return np.zeros(len(column), dtype=np.int64)
    fits = column < np.iinfo(np.int64).max
    return np.where(fits, column, 0).astype(np.int64)


def _believable(t_us: NDArray[np.int64], start_us: int) -> NDArray[np.bool_]:
    """Rows whose time is one: after zero, within a week of the file's start, and near a neighbour's."""
    keep: NDArray[np.bool_] = (t_us > 0) & (np.abs(t_us - start_us) < _LOG_US)
    if len(t_us) >= 3:
        padded = np.concatenate([t_us[1:2], t_us, t_us[-2:-1]])
        middle = np.median(np.stack([padded[:-2], padded[1:-1], padded[2:]]), axis=0)
        keep &= np.abs(t_us - middle) < _NEAR_US
    return keep


class UlogFile:
    """What one file holds of the wanted topics. ``parameters`` as at the start, ``changes`` as (time us, name, value).

    LogError naming the file and the cause when it is no ULog or nothing can be read of it.
    """

    def __init__(self, path: Path, wanted: Collection[str], progress: Progress | None) -> None:
        self.path = path
        self.counts: Counter[str] = Counter()
        log = self._load(wanted, progress)
        self.start_us = min(int(log.start_timestamp), np.iinfo(np.int64).max // 2)
        self.topics: dict[str, list[Topic]] = {}
        for data in log.data_list:
            if "timestamp" in data.data:
                self._add(data)
        self.parameters = _numbers(log.initial_parameters)
        self.changes = [
            (int(t), name, number)
            for t, name, value in log.changed_parameters
            for number in _numbers({name: value}).values()
        ]
        dropouts = log.dropouts
        self.counts["dropouts"] = len(dropouts)
        self.counts["dropouts: milliseconds lost"] = sum(int(d.duration) for d in dropouts)
        self.counts["damaged in places"] = int(bool(log.file_corruption))
        self.counts = +self.counts

    def _add(self, data: Any) -> None:
        topic = Topic(data.name, data.multi_id, data.data, self.start_us)
        if topic.dropped:
            self.counts[f"{topic.name}: time beyond belief"] += topic.dropped
        if len(topic):
            self.topics.setdefault(topic.name, []).append(topic)

    def _load(self, wanted: Collection[str], progress: Progress | None) -> Any:
        with open_log(self.path, ".ulg") as file:
            size = os.fstat(file.fileno()).st_size
            watched = _Watched(file, size, progress)
            try:
                with contextlib.redirect_stdout(io.StringIO()):
                    log = _Guarded(watched, list(wanted))
            except ULogException as error:
                hint = "check that the copy is whole, or read it with a newer magmav"
                raise LogError(f"{self.path}: not a ULog that can be read: {error}; {hint}") from error
            except _BROKEN as error:
                cause = str(error) or type(error).__name__
                raise LogError(f"{self.path}: damaged ULog: {cause}; check that the copy is whole") from error
            self.counts["gave up searching through damage"] = int(watched.gave_up)
            if progress is not None:
                progress(size, size)
            return log


_BROKEN = (
    ValueError,
    KeyError,
    IndexError,
    TypeError,
    AttributeError,
    OverflowError,
    RecursionError,
    MemoryError,
    OSError,
    struct.error,
)


def _numbers(parameters: dict[str, Any]) -> dict[str, float]:
    """Parameters that are finite numbers, as float."""
    return {
        name: float(value)
        for name, value in parameters.items()
        if isinstance(value, int | float) and abs(value) < float("inf")
    }
