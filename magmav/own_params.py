"""The MMAG_ parameters: what they mean, in one list (DESIGN.md, wire identity).

Values come from the latest Record of each compass; what is not known is NaN, never a frozen number. Settings come
from the one table; what each may be, and what it means, goes out with it (mavlink.metadata).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np

from magmav.core.types import Reason, Record, State
from magmav.mavlink.entry import About, Entry
from magmav.settings import Knob, Settings, knobs

COMPASSES = (1, 2, 3)
_NONE_YET = "nan when not known"
_STATES = tuple((float(s.value), s.name.lower().replace("_", " ")) for s in State)
_TABLE = {(k.section, k.key): k for k in knobs()}
_WHY_NOT = [r for r in Reason if r.number >= 30 or r is Reason.NO_CALIBRATION]
_RESULTS = (
    (0.0, "none yet"),
    (1.0, "busy"),
    (2.0, "all new"),
    (3.0, "all old"),
    (4.0, "written, unproven"),
    (5.0, "pending restore"),
    *((-float(r.number), f"refused: {r.text}") for r in _WHY_NOT),
)


class Board(Protocol):
    """What the parameters show and move; the companion is one."""

    settings: Settings
    confirm: float

    @property
    def result(self) -> float:
        """How the last write that was asked for ended."""
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
        """Change one setting in flight, given as its number on the wire; False when it is refused."""
        ...


def entries(board: Board, clock: Callable[[], int]) -> list[Entry]:
    """Every parameter we serve, in an order that never changes. ``clock`` is the latest arrival time."""
    return [*_headings(board, clock), *_offsets(board, clock), *_actions(board), *_knobs(board)]


def meant(section: str, key: str, number: float) -> object:
    """The setting's value that a number on the wire stands for; the number itself where it stands for none.

    A 32-bit float is taken for the shortest decimal that reads back as it: 0.3 is the limit 0.3, not a bit above.
    """
    knob = _TABLE[section, key]
    number = float(str(np.float32(number)))
    if knob.kind == "bool":
        return bool(number) if number in (0.0, 1.0) else number
    if knob.kind == "int":
        return int(number) if number.is_integer() else number
    if knob.choices:
        place = int(number) if number.is_integer() else -1
        return knob.choices[place] if 0 <= place < len(knob.choices) else number
    return number


def _suffix(compass: int) -> str:
    return "" if compass == 1 else str(compass)


def _headings(board: Board, clock: Callable[[], int]) -> list[Entry]:
    def show(compass: int, pick: Callable[[Record], float | None]) -> Callable[[], float]:
        def get() -> float:
            record = board.record(compass, clock())
            value = None if record is None or not record.published.valid else pick(record)
            return math.nan if value is None else math.degrees(value)

        return get

    def about(what: str) -> About:
        return About(f"{what}, {_NONE_YET}", "deg")

    magnetic = "corrected heading of compass {}, magnetic"
    out = [
        Entry("MMAG_HDG", show(1, lambda r: r.published.magnetic_rad), about=about(magnetic.format(1))),
        Entry(
            "MMAG_HDG_T",
            show(1, lambda r: r.published.true_rad if r.published.true_valid else None),
            about=about("corrected heading of compass 1, true"),
        ),
        Entry("MMAG_HDG_SD", show(1, lambda r: r.published.sigma_rad), about=about("one sigma of the heading")),
    ]
    for c in (2, 3):
        show_it = show(c, lambda r: r.published.magnetic_rad)
        out.append(Entry(f"MMAG_HDG{c}", show_it, about=about(magnetic.format(c))))
    return out


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
        for name, pick, what in (
            ("OFS", _offset, "offset compass {} should have, body axes, to be added"),
            ("SD", _sigma, "one sigma of the offset of compass {}"),
        ):
            text = f"{what.format(compass)}, {_NONE_YET}"
            out += [
                Entry(f"MMAG_{name}{n}_{'XYZ'[axis]}", show(compass, pick(axis)), about=About(text, "mG"))
                for axis in range(3)
            ]
        about = About(f"state of compass {compass}; reasons come by STATUSTEXT", values=_STATES)
        out.append(Entry(f"MMAG_STATE{n}", state(compass), about=about))
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

    def about(what: str) -> About:
        values = ((0.0, "nothing"), *((float(c), f"compass {c}") for c in COMPASSES))
        return About(what, low=0.0, high=float(COMPASSES[-1]), values=values)

    code = About("confirmation code of a large change, as it was announced", low=0.0, high=9999.0)
    upload = about("write a compass number: upload its offsets to the autopilot")
    restore = about("write a compass number: bring back what was there before its last upload")
    return [
        Entry("MMAG_UPLOAD", lambda: 0.0, act(board.request_upload), trigger=True, about=upload),
        Entry("MMAG_RESTORE", lambda: 0.0, act(board.request_restore), trigger=True, about=restore),
        Entry("MMAG_CONFIRM", lambda: board.confirm, confirm, pinned=True, about=code),
        Entry("MMAG_RESULT", lambda: board.result, about=About("how the last write ended", values=_RESULTS)),
    ]


def _knobs(board: Board) -> list[Entry]:
    out = []
    for knob in knobs():
        if not knob.param:
            continue

        def get(knob: Knob = knob) -> float:
            return _number(knob, getattr(getattr(board.settings, knob.section), knob.key))

        def put(value: float, now_ns: int, knob: Knob = knob) -> bool:
            return board.choose(knob.section, knob.key, value)

        # What decides whether a write wants a code is moved only where a write may be asked for.
        out.append(Entry(knob.param, get, put, pinned=knob.section == "upload", about=_about(knob)))
    return out


def _number(knob: Knob, value: object) -> float:
    """A setting's value on the wire: a choice by its place in the list."""
    if isinstance(value, str):
        return float(knob.choices.index(value))
    assert isinstance(value, (bool, int, float))
    return float(value)


def _about(knob: Knob) -> About:
    low, high, values = knob.low, knob.high, tuple((float(i), c) for i, c in enumerate(knob.choices))
    if knob.kind == "bool":
        low, high, values = 0.0, 1.0, ((0.0, "off"), (1.0, "on"))
    elif knob.choices:
        low, high = 0.0, float(len(knob.choices) - 1)
    return About(knob.text, knob.unit, low, high, _number(knob, knob.default), values)
