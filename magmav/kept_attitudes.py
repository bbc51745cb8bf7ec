"""One vehicle's attitudes over a recording, kept to score headings against."""

from __future__ import annotations

from array import array

import numpy as np
from numpy.typing import NDArray

from magmav.core.motion_run import AttitudeColumns
from magmav.core.types import AttitudeReading


class KeptAttitudes:
    """Since the vehicle's last boot, of one message, in the order of time."""

    def __init__(self) -> None:
        self.source = ""
        self._latest_ns = -1
        self._parts: list[NDArray[np.float64]] = []
        self._single: array[float] = array("d")  # newer than the parts
        self._run: tuple[AttitudeColumns, int, int, bool, bool] | None = None  # newer than both: rows, flags

    def wants(self, source: str, boot_ns: int) -> bool:
        """Whether this one goes on from what there is."""
        return self._latest_ns < boot_ns and self.source in ("", source)

    def add(self, r: AttitudeReading, armed: bool, airborne: bool) -> None:
        """Take the next, where it is wanted."""
        self._settle()
        self.source, self._latest_ns = r.source, r.boot_ns
        self._single.extend((r.boot_ns, r.roll_rad, r.pitch_rad, r.yaw_rad, armed, airborne))

    def add_rows(self, columns: AttitudeColumns, begin: int, end: int, armed: bool, airborne: bool) -> None:
        """Take the next, many at once, where they are wanted."""
        now = self._run
        if now is not None and now[0] is columns and now[2:] == (begin, armed, airborne):
            begin = now[1]
        else:
            self._settle()
        self._run = columns, begin, end, armed, airborne
        self.source, self._latest_ns = columns.source, columns.boot_ns[end - 1]

    def table(self) -> NDArray[np.float64]:
        """(N, 6) boot time ns, roll, pitch, yaw rad, armed, airborne."""
        self._settle()
        return np.concatenate([*self._parts, np.array(self._single).reshape(-1, 6)])

    def _settle(self) -> None:
        """The run among the parts."""
        if self._run is None:
            return
        columns, begin, end, armed, airborne = self._run
        rows = np.empty((end - begin, 6))
        rows[:, 0], rows[:, 1:4], rows[:, 4], rows[:, 5] = (
            columns.boot_ns[begin:end],
            columns.rows[begin:end, :3],
            armed,
            airborne,
        )
        self._parts += [np.array(self._single).reshape(-1, 6), rows]
        self._single, self._run = array("d"), None
