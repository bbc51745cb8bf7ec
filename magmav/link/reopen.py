"""When to try again: at once would storm, never would strand."""

from __future__ import annotations


class Backoff:
    """Waits first_s, then twice as long each time up to longest_s, until bytes have come again."""

    def __init__(self, first_s: float, longest_s: float) -> None:
        if not 0 < first_s <= longest_s:
            raise ValueError(f"first_s, longest_s: want 0 < first <= longest, got {first_s!r}, {longest_s!r}")
        self._first_ns = round(first_s * 1e9)
        self._longest_ns = round(longest_s * 1e9)
        self._wait_ns = self._first_ns
        self._due_ns = 0

    def failed(self, now_ns: int) -> None:
        """It was lost, or could not be opened. An opening that never gave a byte counts as the latter."""
        self._due_ns = now_ns + self._wait_ns
        self._wait_ns = min(2 * self._wait_ns, self._longest_ns)

    def alive(self) -> None:
        """Bytes came."""
        self._wait_ns = self._first_ns

    def left_ns(self, now_ns: int) -> int:
        """Until the next try; 0 when it is due."""
        return max(0, self._due_ns - now_ns)
