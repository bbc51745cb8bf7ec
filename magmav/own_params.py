"""The MMAG_ parameters: what they mean, in one list (DESIGN.md, wire identity).

Values come from the latest Record of each compass; what is not known is NaN, never a frozen number.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

from magmav.core.types import Record, State
from magmav.mavlink.params import Entry
from magmav.settings import Settings, knobs

COMPASSES = (1, 2, 3)


class Board(Protocol):
    """What the parameters show and move; the companion is one."""

    settings: Settings
    confirm: float

    @property
    def result(self) -> float:
        """How the last write went; see MMAG_RESULT."""
        ...

    def record(self, compass: int, now_ns: int) -> Record | None:
        """Latest Record of a compass of the served vehicle, None when there is none or it is stale."""
        ...

    def request_upload(self, compass: int, now_ns: int) -> None:
        """Somebody asked for an upload."""
        ...

    def request_restore(self, compass: int, now_ns: int) -> None:
        """Somebody asked for the values before the last upload."""
        ...

    def choose(self, section: str, key: str, value: float) -> bool:
        """Change one setting in flight; False when it is refused."""
        ...


def entries(board: Board, clock: Callable[[], int]) -> list[Entry]:
    """Every parameter we serve, in an order that never changes. ``clock`` is the latest arrival time."""
    return [*_headings(board, clock), *_offsets(board, clock), *_actions(board), *_knobs(board)]


def _suffix(compass: int) -> str:
    return "" if compass == 1 else str(compass)


def _headings(board: Board, clock: Callable[[], int]) -> list[Entry]:
    def show(compass: int, pick: Callable[[Record], float | None]) -> Callable[[], float]:
        def get() -> float:
            record = board.record(compass, clock())
            value = None if record is None or not record.published.valid else pick(record)
            return math.nan if value is None else math.degrees(value)

        return get

    out = [
        Entry("MMAG_HDG", show(1, lambda r: r.published.magnetic_rad)),
        Entry("MMAG_HDG_T", show(1, lambda r: r.published.true_rad if r.published.true_valid else None)),
        Entry("MMAG_HDG_SD", show(1, lambda r: r.published.sigma_rad)),
    ]
    return out + [Entry(f"MMAG_HDG{c}", show(c, lambda r: r.published.magnetic_rad)) for c in (2, 3)]


def _offsets(board: Board, clock: Callable[[], int]) -> list[Entry]:
    def show(compass: int, pick: Callable[[Record], float]) -> Callable[[], float]:
        def get() -> float:
            record = board.record(compass, clock())
            known = record is not None and record.estimate.samples > 0 and not record.relative
            return pick(record) if record is not None and known else math.nan

        return get

    def state(compass: int) -> Callable[[], float]:
        def get() -> float:
            record = board.record(compass, clock())
            return float(State.NO_DATA if record is None else record.verdict.state)

        return get

    out = []
    for compass in COMPASSES:
        n = _suffix(compass)
        for name, pick in (("OFS", _offset), ("SD", _sigma)):
            out += [Entry(f"MMAG_{name}{n}_{'XYZ'[axis]}", show(compass, pick(axis))) for axis in range(3)]
        out.append(Entry(f"MMAG_STATE{n}", state(compass)))
    return out


def _offset(axis: int) -> Callable[[Record], float]:
    return lambda record: float(record.offsets_mg[axis])


def _sigma(axis: int) -> Callable[[Record], float]:
    return lambda record: float(record.sigma_mg[axis])


def _actions(board: Board) -> list[Entry]:
    def act(do: Callable[[int, int], None]) -> Callable[[float, int], bool]:
        def start(value: float, now_ns: int) -> bool:
            if value not in COMPASSES:
                return value == 0.0
            do(int(value), now_ns)
            return True

        return start

    def confirm(value: float, now_ns: int) -> bool:
        board.confirm = value
        return True

    return [
        Entry("MMAG_UPLOAD", lambda: 0.0, act(board.request_upload), trigger=True),
        Entry("MMAG_RESTORE", lambda: 0.0, act(board.request_restore), trigger=True),
        Entry("MMAG_CONFIRM", lambda: board.confirm, confirm),
        Entry("MMAG_RESULT", lambda: board.result),
    ]


def _knobs(board: Board) -> list[Entry]:
    out = []
    for knob in knobs():
        if not knob.param:
            continue
        section, key = knob.section, knob.key

        def get(section: str = section, key: str = key) -> float:
            return float(getattr(getattr(board.settings, section), key))

        def put(value: float, now_ns: int, section: str = section, key: str = key) -> bool:
            return board.choose(section, key, value)

        out.append(Entry(knob.param, get, put))
    return out
