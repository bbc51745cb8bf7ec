"""The attitudes heard lately, each with what was integrated up to it: one by one, or as rows of columns."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from magmav.core.motion_run import AttitudeColumns, MotionRun
from magmav.core.own_frame import Frame, Vector, inverse, product
from magmav.core.types import AttitudeReading

_RECENT = 12
_LEVEL = 1e-9


class Heard(NamedTuple):
    """One attitude, with what was integrated up to it."""

    boot_ns: int
    reading: AttitudeReading
    rate_b_rads: Vector
    euler_rads: Vector  # rates of roll, pitch and yaw
    yaw_rad: float
    own_frame: Frame


class _Going:
    """Columns that are being gone through, and what takes what they add up to to what was integrated here.

    begin : their first row that counts, which was heard as ``heard``.  end : past the last one so far.
    """

    def __init__(self, columns: AttitudeColumns, row: int, system: int, heard: Heard) -> None:
        self.columns, self.begin, self.end, self._system = columns, row, row + 1, system
        w, x, y, z, turned = columns.rows[row, 9:].tolist()
        self._yaw_rad = heard.yaw_rad - turned
        turn = product(inverse((w, x, y, z)), heard.own_frame)
        self._turn = None if heard.own_frame == (w, x, y, z) else turn
        self.level = max(abs(turn[1]), abs(turn[2])) < _LEVEL  # only turns about the vertical add up
        self._made = {row: heard}

    def until(self, end: int) -> None:
        """Some rows further."""
        self.end = end
        self._made.clear()

    def nearest(self, boot_ns: int) -> int:
        """The row nearest to a boot time, of equals the earlier, among those heard lately."""
        times, i = self.columns.boot_ns, self.end - 1
        least, away = max(self.begin, self.end - _RECENT), abs(boot_ns - times[i])
        while i > least and (further := abs(boot_ns - times[i - 1])) <= away:
            i, away = i - 1, further
        return i

    def heard(self, i: int) -> Heard:
        """One row, as it would have been heard."""
        made = self._made.get(i)
        if made is None:
            columns = self.columns
            roll, pitch, yaw, dr, dp, dy, p, q, r, w, x, y, z, turned = columns.rows[i].tolist()
            boot_ns, rate = columns.boot_ns[i], columns.rate_b_rads[i]
            reading = AttitudeReading(self._system, columns.source, boot_ns, roll, pitch, yaw, rate)
            frame = (w, x, y, z) if self._turn is None else product((w, x, y, z), self._turn)
            made = self._made[i] = Heard(boot_ns, reading, (p, q, r), (dr, dp, dy), turned + self._yaw_rad, frame)
        return made


class Lately:
    """One vehicle's, in the order of boot time."""

    def __init__(self) -> None:
        self._latest_ns: int | None = None
        self._single: deque[Heard] = deque(maxlen=_RECENT)
        self._going: _Going | None = None  # its first row is the last single one

    def before(self, boot_ns: int) -> bool:
        """Were all heard before this boot time?"""
        return self._latest_ns is None or boot_ns > self._latest_ns

    def newest(self) -> Heard | None:
        """The last one."""
        if self._going is not None:
            return self._going.heard(self._going.end - 1)
        return self._single[-1] if self._single else None

    def nearest(self, boot_ns: int, within_ns: int) -> Heard | None:
        """The one nearest to a boot time, of equals the earlier; None where the newest is not so near."""
        if self._latest_ns is None or abs(boot_ns - self._latest_ns) > within_ns:
            return None
        if self._going is not None:
            row = self._going.nearest(boot_ns)
            if row > self._going.begin:
                return self._going.heard(row)
        out = self._single[-1]
        away = abs(boot_ns - out.boot_ns)
        for earlier in reversed(self._single):
            further = abs(boot_ns - earlier.boot_ns)
            if further > away:
                break
            out, away = earlier, further
        return out

    def add(self, heard: Heard) -> None:
        """Take the next."""
        going, self._going = self._going, None
        if going is not None:
            rows = range(max(going.begin + 1, going.end - _RECENT), going.end)
            self._single.extend(map(going.heard, rows))
        self._single.append(heard)
        self._latest_ns = heard.boot_ns

    def clear(self) -> None:
        """Nothing from before counts."""
        self._single.clear()
        self._going = None

    def goes_on(self, r: MotionRun, row: int) -> bool:
        """Does this row of a run go on where the columns gone through stand?"""
        going = self._going
        here = going is not None and going.columns is r.attitudes and going.end == row
        return here and bool(r.attitudes.joined[row])

    def go(self, r: MotionRun, row: int, first: Heard) -> None:
        """Go through columns from this row of a run on, which was heard already; not from a frame that is not level."""
        going = _Going(r.attitudes, row, r.system, first)
        self._going = going if going.level else None

    def until(self, end: int) -> float:
        """Further through the columns; seconds between the last two."""
        going = self._going
        if going is None:
            raise RuntimeError("no columns are gone through")
        going.until(end)
        times = going.columns.boot_ns
        self._latest_ns = times[end - 1]
        return (times[end - 1] - times[end - 2]) / 1e9
