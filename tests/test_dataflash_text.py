"""The text form of a DataFlash log says the same as the binary, and a bad line costs itself."""

from __future__ import annotations

import random
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dataflash_writer import EV, MSG, Log, flight

from magmav.core.types import Reading
from magmav.logs import LogError
from magmav.logs.dataflash_readings import DataflashRecording
from magmav.logs.dataflash_text import read_text


def told(path: Path) -> list[tuple[int, Reading]]:
    return list(DataflashRecording(path).readings())


def plain(reading: Reading) -> list[Any]:
    out: list[Any] = [type(reading).__name__]
    for f in fields(reading):
        value = getattr(reading, f.name)
        out.append(value.tolist() if isinstance(value, np.ndarray) else value)
    return out


def test_text_and_binary_of_one_log_give_the_same_readings(tmp_path: Path) -> None:
    log = flight(3.0)
    (tmp_path / "a.bin").write_bytes(log.binary())
    (tmp_path / "a.log").write_text(log.text())
    binary, text = told(tmp_path / "a.bin"), told(tmp_path / "a.log")
    assert len(binary) == len(text) > 300
    for (t_b, b), (t_t, t) in zip(binary, text, strict=True):
        assert t_b == t_t
        for ours, theirs in zip(plain(b), plain(t), strict=True):
            assert ours == (
                pytest.approx(theirs, rel=1e-12, abs=1e-12) if isinstance(theirs, (float, list)) else theirs
            )


def test_a_greeting_a_cut_line_and_a_word_for_a_number_cost_themselves() -> None:
    log = Log([(EV, (i, i)) for i in range(5)])
    lines = ["ArduCopter V3.1", "Free RAM: 1000", "", *log.text().splitlines()]
    lines[-2] = "EV, 3"
    lines.append("EV, 7, seven")
    tables = read_text("\r\n".join(lines).encode(), "x.log")
    (events,) = tables.of("EV")
    assert events.values("TimeUS").tolist() == [0, 1, 2, 4, 7]
    assert events.values("Id")[:4].tolist() == [0, 1, 2, 4] and np.isnan(events.values("Id")[4])
    assert tables.counts == {"EV: line cut short": 1, "lines of a message never defined": 2}


def test_a_byte_order_mark_costs_nothing(tmp_path: Path) -> None:
    """Notepad puts one there; without care the first line, which may be a definition, is lost to it."""
    log = flight(3.0)
    (tmp_path / "plain.log").write_text(log.text())
    (tmp_path / "marked.log").write_text(log.text(), encoding="utf-8-sig")
    marked, plainly = (DataflashRecording(tmp_path / n) for n in ("marked.log", "plain.log"))
    assert marked.counts == plainly.counts
    assert [t for t, _ in marked.readings()] == [t for t, _ in plainly.readings()]


def test_commas_inside_a_text_stay_in_it() -> None:
    log = Log([(MSG, (1, "Frame: QUAD, plus, sensors")), (MSG, (2, "ArduCopter V4.5.1"))])
    (said,) = read_text(log.text().encode(), "x.log").of("MSG")
    assert said.texts("Message") == ["Frame: QUAD, plus, sensors", "ArduCopter V4.5.1"]


def test_microseconds_survive_beyond_the_precision_of_a_float() -> None:
    big = 2**60 + 1
    (events,) = read_text(Log([(EV, (big, 1))]).text().encode(), "x.log").of("EV")
    assert events.values("TimeUS").tolist() == [big]


def test_a_message_defined_anew_is_read_by_each_definition_in_its_place() -> None:
    text = (
        "FMT, 9, 9, XYZ, Ih, TimeMS,A\nXYZ, 1, 10\nXYZ, 2, 20\nFMT, 9, 17, XYZ, Qfh, TimeUS,B,A\nXYZ, 3000, 0.5, 30\n"
    )
    first, second = read_text(text.encode(), "x.log").of("XYZ")
    assert first.values("A").tolist() == [10, 20] and second.values("A").tolist() == [30]
    assert second.values("B").tolist() == [0.5]


def test_damage_gives_readings_or_a_log_error(tmp_path: Path) -> None:
    path, rng = tmp_path / "hurt.log", random.Random(7)
    log = flight(0.5)
    whole = log.text().encode()
    head = len("".join(log.text().splitlines(keepends=True)[: len(log.head())]))
    good = 0
    for i in range(100):
        copy = bytearray(whole)
        for _ in range(rng.choice((1, 5, 50))):
            copy[rng.randrange(head if i % 2 else len(copy))] = rng.randrange(256)
        path.write_bytes(copy[: rng.randrange(len(copy))] if i % 10 == 0 else copy)
        try:
            times = [t for t, _ in told(path)]
        except LogError:
            continue
        assert times == sorted(times)
        good += len(times) > 50
    assert good > 50
