"""When a recording was made, as it says itself."""

from __future__ import annotations

from magmav.core.types import Reading, Record

_2000_NS, _2100_NS = 946_684_800 * 10**9, 4_102_444_800 * 10**9


class Dated:
    """Watches a replay; the first record's time is the recording's date."""

    def __init__(self) -> None:
        self._first_ns: int | None = None

    def __call__(self, reading: Reading, record: Record | None) -> None:
        """Take one reading and the Record it led to."""
        if record is not None and self._first_ns is None:
            self._first_ns = record.t_ns

    def unix_s(self, unix_offset_ns: int) -> float | None:
        """UNIX time of the first record, None where the file does not know the date.

        unix_offset_ns : of the recording.  A .tlog's times are UNIX times already; a log without a GPS time counts
        from power-on, which is no date.
        """
        if self._first_ns is None:
            return None
        unix_ns = self._first_ns + unix_offset_ns
        return round(unix_ns / 1e9, 3) if _2000_NS <= unix_ns < _2100_NS else None
