"""What a DataFlash log holds, as columns: one table per message definition, binary or text alike.

A log describes itself: FMT names a message, the C type of each value (one letter) and its label; FMTU and MULT say the
unit and its power of ten. The letters are those of ArduPilot's AP_Logger/LogStructure.h.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

HEADER = 3  # two sync bytes and the number of the message


class Letter(NamedTuple):
    """One format letter: numpy's type of the stored value, and what to divide it by."""

    stored: str
    divisor: float = 1.0


LETTERS: dict[str, Letter] = {
    "a": Letter("(32,)<i2"),
    "b": Letter("<i1"),
    "B": Letter("<u1"),
    "h": Letter("<i2"),
    "H": Letter("<u2"),
    "i": Letter("<i4"),
    "I": Letter("<u4"),
    "q": Letter("<i8"),
    "Q": Letter("<u8"),
    "f": Letter("<f4"),
    "d": Letter("<f8"),
    "g": Letter("<f2"),
    "n": Letter("S4"),
    "N": Letter("S16"),
    "Z": Letter("S64"),
    "c": Letter("<i2", 100.0),
    "C": Letter("<u2", 100.0),
    "e": Letter("<i4", 100.0),
    "E": Letter("<u4", 100.0),
    "L": Letter("<i4", 1e7),
    "M": Letter("<u1"),
}
STRINGS, WHOLE = "nNZ", "bBhHiIqQM"
_INSTANCE = ("I", "Inst", "Instance", "C")


@dataclass(frozen=True, slots=True)
class Definition:
    """One FMT record. size : bytes of a record, header included."""

    number: int
    size: int
    name: str
    letters: str
    labels: tuple[str, ...]

    @property
    def layout(self) -> np.dtype[Any] | None:
        """Numpy's type of a whole record; None when the definition contradicts itself, so that only its size counts."""
        if any(c not in LETTERS for c in self.letters):
            return None
        stored = [np.dtype(LETTERS[c].stored) for c in self.letters]
        ends = np.cumsum([HEADER, *(d.itemsize for d in stored)]).tolist()
        if ends[-1] != self.size:
            return None
        return np.dtype({"names": list(self.labels), "formats": stored, "offsets": ends[:-1], "itemsize": self.size})


def define(number: int, size: int, name: str, letters: str, columns: str) -> Definition:
    """A Definition whose labels fit its letters: one that is missing, empty or said twice is named after its place.

    The list of labels is cut at 64 characters, so the last may be short or missing.
    """
    said = columns.split(",")[: len(letters)] if columns else []
    labels: list[str] = []
    for place in range(len(letters)):
        label = said[place].strip() if place < len(said) else ""
        labels.append(label if label and label not in labels else f"_{place}")
    return Definition(number, size, name, letters, tuple(labels))


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """All records of one message under one definition, in the order of the file.

    at : (n,) where each record begins (byte, or line), which is the order in which they were written.
    stored : label -> (n,) values as they stand in the file.  scaled : True where those already carry the letter's
    power of ten, as in text.  mults : label -> FMTU's multiplier, where it says one.
    """

    name: str
    letters: dict[str, str]
    at: Ints
    stored: Callable[[str], NDArray[Any]]
    scaled: bool = False
    mults: Mapping[str, float] = field(default_factory=dict)
    instance_label: str | None = None

    def __contains__(self, label: str) -> bool:
        """Whether this is a column of numbers: damage to a definition may make it anything."""
        return self.letters.get(label, "a") not in STRINGS + "a"

    def has_text(self, label: str) -> bool:
        """Whether this is a column of strings."""
        return self.letters.get(label, "a") in STRINGS

    def __len__(self) -> int:
        return len(self.at)

    def values(self, label: str) -> NDArray[Any]:
        """(n,) numbers with the letter's power of ten applied (c, C, e, E: hundredths; L: 1e-7 degrees)."""
        divisor = LETTERS[self.letters[label]].divisor
        out = self.stored(label)
        return out if self.scaled or divisor == 1.0 else out / divisor

    def texts(self, label: str) -> list[str]:
        """(n,) strings, each up to its first NUL; what is not UTF-8 is read as Latin-1."""
        return [clean(raw) for raw in self.stored(label).tolist()]

    def base(self, label: str, otherwise: float = 1.0, per: float = 1.0) -> Floats:
        """(n,) in FMTU's base unit (gauss, ampere, metre, rad/s ...) divided by ``1 / per``.

        ``otherwise`` is the multiplier of a log that gives none. A letter that scales by itself already is in base
        units: ArduPilot's MULT repeats the letter's power of ten, and at places gets it wrong (GPS.HDop).
        """
        plain = LETTERS[self.letters[label]].divisor == 1.0
        mult = self.mults.get(label, otherwise) if plain else 1.0
        with np.errstate(all="ignore"):  # damage may spell a signalling NaN; callers ask what is finite
            out: Floats = np.asarray(self.values(label), dtype=np.float64) * (mult * per)
        return out

    def instance(self) -> Ints:
        """(n,) number of the sensor or filter core, from 0; zeros where the message tells none apart."""
        label = next((c for c in (self.instance_label, *_INSTANCE) if c is not None and c in self), None)
        if label is None:
            return np.zeros(len(self), dtype=np.int64)
        return whole(self.values(label))


@dataclass(frozen=True, slots=True, eq=False)
class Tables:
    """A whole log. counts : what was left out and why.  heard : records per message name."""

    by_name: Mapping[str, Sequence[Table]]
    counts: Counter[str]
    heard: Counter[str]

    def of(self, name: str) -> Sequence[Table]:
        """The tables of this message, several where its definition changed; none where the log has none."""
        return self.by_name.get(name, ())


def whole(values: NDArray[Any]) -> Ints:
    """(n,) as int64; -1 for what is no number or does not fit."""
    if values.dtype.kind in "iu":
        return values.astype(np.int64)
    sane = np.isfinite(values) & (np.abs(values) < 2.0**53)
    return np.where(sane, values, -1.0).astype(np.int64)


def clean(raw: bytes | str) -> str:
    """Text up to the first NUL."""
    if isinstance(raw, str):
        return raw.partition("\0")[0]
    raw = raw.partition(b"\0")[0]
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError:
        return raw.decode("latin-1")


def multipliers(definition: Definition, mult_letters: str, power_of: Mapping[str, float]) -> dict[str, float]:
    """Label -> multiplier, where FMTU names one. ``-`` is none and ``?`` not known."""
    out: dict[str, float] = {}
    for label, letter in zip(definition.labels, mult_letters, strict=False):
        power = power_of.get(letter, 0.0)
        if letter not in "-?" and np.isfinite(power) and power > 0.0:
            out[label] = power
    return out


def instance_label(definition: Definition, unit_letters: str) -> str | None:
    """The column that FMTU marks as the instance."""
    place = unit_letters.find("#")
    return definition.labels[place] if 0 <= place < len(definition.labels) else None
