"""Ask for several names at once and repeat what stays unanswered, a bounded number of times."""

from __future__ import annotations

from collections.abc import Iterable


class Exchange:
    """Names still open, how often each was asked, and when it may be asked again."""

    def __init__(self, names: Iterable[str], retry_ns: int, tries: int) -> None:
        self._tries = dict.fromkeys(names, 0)
        self._due_ns = dict.fromkeys(self._tries, 0)
        self._retry_ns = retry_ns
        self._most = tries

    @property
    def open(self) -> tuple[str, ...]:
        """Names without an answer."""
        return tuple(self._tries)

    @property
    def untouched(self) -> bool:
        """Nothing was asked yet."""
        return not any(self._tries.values())

    def due(self, now_ns: int) -> tuple[str, ...]:
        """Names to ask now; the caller says ``asked`` for each that it does ask."""
        return tuple(n for n, k in self._tries.items() if k < self._most and now_ns >= self._due_ns[n])

    def asked(self, name: str, now_ns: int) -> None:
        """One more request for this name went out."""
        self._tries[name] += 1
        self._due_ns[name] = now_ns + self._retry_ns

    def answered(self, name: str) -> None:
        """This name needs no more asking. Unknown names are nobody's fault."""
        self._tries.pop(name, None)

    def spent(self, now_ns: int) -> bool:
        """Some name was asked as often as allowed, and its last wait is over."""
        return any(k >= self._most and now_ns >= self._due_ns[n] for n, k in self._tries.items())
