"""Our parameters towards ground stations: whom we answer, what we say, how fast."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect
from scripted_vehicle import MS, S, Wire, f32

from magmav.mavlink.budget import Budget
from magmav.mavlink.entry import Entry
from magmav.mavlink.params import ParamServer
from magmav.mavlink.presence import Presence

WIRE = Wire()
NAN = float("nan")


class Bench:
    """A server with five parameters on vehicle 7, and what it said, decoded."""

    def __init__(self, bps: float = 100_000.0, extra: int = 0) -> None:
        self.presence = Presence(target_system=7)
        self.now_ns = 10 * S
        self.rate = 2.0
        self.calls: list[tuple[float, int]] = []
        self.accepts = True
        self.budget = Budget(bps)
        entries = [
            Entry("MMAG_HDG", lambda: NAN),
            Entry("MMAG_OFS_X", lambda: 0.1),
            Entry("MMAG_RATE", lambda: self.rate, self.set_rate),
            Entry("MMAG_UPLOAD", lambda: 0.0, self.trigger, trigger=True),
            Entry("MMAG_CONFIRM", lambda: 0.0, lambda value, now_ns: True),
            *(Entry(f"MMAG_EXTRA_{i}", lambda: 1.0) for i in range(extra)),
        ]
        self.count = len(entries)
        self.server = ParamServer(entries, self.presence, self.budget)
        self.said: list[tuple[float, Any, str]] = []
        self.server.poll(self.now_ns)
        self.run(1.0)

    def set_rate(self, value: float, now_ns: int) -> bool:
        if not 0 <= value <= 50:
            return False
        self.rate = value
        return True

    def trigger(self, value: float, now_ns: int) -> bool:
        self.calls.append((value, now_ns))
        return self.accepts

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * 50)):
            self.now_ns += 20 * MS
            self.take(self.server.poll(self.now_ns))

    def take(self, out: list[Any]) -> list[Any]:
        got = [WIRE.carry(item.message, 7, 191) for item in out]
        self.said += [(self.now_ns / S, m, item.route) for m, item in zip(got, out, strict=True)]
        return got

    def hear(self, message: Any, route: str = "gcs", sender: tuple[int, int] = (255, 190)) -> list[Any]:
        return self.take(self.server.on_message(WIRE.carry(message, *sender), route, self.now_ns))

    def set(self, name: str, value: float, *target: int) -> list[Any]:
        return self.hear(dialect.MAVLink_param_set_message(*(target or (7, 191)), name.encode(), value, 9))

    def read(self, name: str, index: int, *target: int, wait_s: float = 0.5) -> list[Any]:
        before = len(self.said)
        self.hear(dialect.MAVLink_param_request_read_message(*(target or (7, 191)), name.encode(), index))
        self.run(wait_s)
        return [m for _, m, _ in self.said[before:]]

    def values(self) -> list[tuple[str, int, int]]:
        return [(m.param_id, m.param_index, m.param_count) for _, m, _ in self.said if m.get_type() == "PARAM_VALUE"]


LIST = [
    ("MMAG_HDG", 0, 5),
    ("MMAG_OFS_X", 1, 5),
    ("MMAG_RATE", 2, 5),
    ("MMAG_UPLOAD", 3, 5),
    ("MMAG_CONFIRM", 4, 5),
]


@pytest.mark.parametrize("component", [0, 191])
def test_the_list_holds_every_value_once_as_real32_to_everybody(component: int) -> None:
    bench = Bench()
    bench.hear(dialect.MAVLink_param_request_list_message(7, component))
    bench.run(3.0)
    assert bench.values() == LIST
    assert {(m.param_type, route) for _, m, route in bench.said} == {(9, "")}
    assert math.isnan(bench.said[0][1].param_value) and bench.said[1][1].param_value == f32(0.1)


@pytest.mark.parametrize("target", [(7, 1), (8, 191), (8, 0), (0, 0), (0, 191), (7, 154)])
def test_S13_nothing_for_anybody_else(target: tuple[int, int]) -> None:
    bench = Bench()
    bench.hear(dialect.MAVLink_param_request_list_message(*target))
    bench.set("MMAG_RATE", 5.0, *target)
    assert bench.read("MMAG_RATE", -1, *target) == []
    assert bench.said == [] and bench.rate == 2.0


def test_list_is_paced_and_a_repeat_restarts_nothing() -> None:
    bench = Bench(extra=95)
    bench.hear(dialect.MAVLink_param_request_list_message(7, 0))
    bench.run(1.0)
    first = len(bench.said)
    assert 45 <= first <= 60, "50 values a second"
    bench.hear(dialect.MAVLink_param_request_list_message(7, 0))
    bench.run(5.0)
    assert [index for _, index, _ in bench.values()] == list(range(100))


def test_read_by_name_and_by_index() -> None:
    bench = Bench()
    for answer in (
        bench.read("MMAG_RATE", -1),
        bench.read("", 2),
        bench.read("MMAG_RATE", -1, 7, 0),
        bench.read("", 2, 7, 0),
    ):
        assert [(m.param_id, m.param_index, m.param_count, m.param_value) for m in answer] == [("MMAG_RATE", 2, 5, 2.0)]


def test_AT_9a_a_full_list_survives_thirty_percent_loss_by_index() -> None:
    bench = Bench(extra=25)
    import random

    dice = random.Random(4)
    heard: set[int] = set()
    bench.hear(dialect.MAVLink_param_request_list_message(7, 0))
    for _ in range(40):
        before = len(bench.said)
        bench.run(1.0)
        heard |= {m.param_index for _, m, _ in bench.said[before:] if dice.random() > 0.3}
        for index in set(range(bench.count)) - heard:
            if dice.random() > 0.3:
                bench.hear(dialect.MAVLink_param_request_read_message(7, 191, b"", index))
    assert heard == set(range(30))
    assert {m.param_count for _, m, _ in bench.said} == {30}


def test_unknown_names_are_an_error_to_us_and_silence_to_all() -> None:
    bench = Bench()
    for name in ("COMPASS_OFS_X", "MMAG_NO_SUCH"):
        assert bench.read(name, -1, 7, 0) == [] and bench.set(name, 1.0, 7, 0) == []
        for answer in (bench.read(name, -1), bench.set(name, 1.0)):
            (m,) = answer
            assert (m.get_type(), m.error, m.param_id) == ("PARAM_ERROR", 1, name)
            assert (m.target_system, m.target_component) == (255, 190)
    assert bench.read("", 5, 7, 0) == [] and bench.read("", 5)[0].error == 1


def test_set_is_echoed_at_once_with_true_index_to_everybody() -> None:
    bench = Bench()
    (echo,) = bench.set("MMAG_RATE", 5.1)
    assert (echo.param_value, echo.param_index, echo.param_count) == (f32(5.1), 2, 5)
    assert bench.said[-1][2] == "" and bench.rate == f32(5.1)
    bench.set("MMAG_RATE", 4.0, 7, 0)
    assert bench.rate == 4.0


@pytest.mark.parametrize(("name", "value", "old", "error"), [
    ("MMAG_OFS_X", 3.0, f32(0.1), 5), ("MMAG_RATE", 51.0, 2.0, 2), ("MMAG_RATE", NAN, 2.0, 2),
    ("MMAG_RATE", math.inf, 2.0, 2), ("MMAG_UPLOAD", NAN, 0.0, 2), ("MMAG_RATE", 7e-45, 2.0, 2),
])  # fmt: skip
def test_a_refused_set_gives_the_old_value_and_the_reason(name: str, value: float, old: float, error: int) -> None:
    bench = Bench()
    echo, why = bench.set(name, value)
    assert (echo.get_type(), echo.param_id, echo.param_value) == ("PARAM_VALUE", name, old)
    assert (why.get_type(), why.param_id, why.error) == ("PARAM_ERROR", name, error)
    assert bench.rate == 2.0 and bench.calls == []


def test_a_trigger_wants_exactly_our_component_and_echoes_what_was_written() -> None:
    bench = Bench()
    echo, why = bench.set("MMAG_UPLOAD", 1.0, 7, 0)
    assert (echo.param_value, why.error, bench.calls) == (0.0, 3, [])
    (echo,) = bench.set("MMAG_UPLOAD", 1.0)
    assert echo.param_value == 1.0 and len(bench.calls) == 1
    assert bench.read("MMAG_UPLOAD", -1)[0].param_value == 0.0


def test_a_trigger_repeated_within_thirty_seconds_starts_nothing_but_is_echoed() -> None:
    bench = Bench()
    for _ in range(5):  # a client that did not hear the echo
        assert bench.set("MMAG_UPLOAD", 1.0)[0].param_value == 1.0
        bench.run(1.0)
    assert [value for value, _ in bench.calls] == [1.0]
    bench.set("MMAG_UPLOAD", 2.0)  # another compass is another wish
    bench.set("MMAG_CONFIRM", 4711.0)  # and so is the same one with a code
    bench.set("MMAG_UPLOAD", 2.0)
    assert [value for value, _ in bench.calls] == [1.0, 2.0, 2.0]
    bench.run(31.0)
    bench.set("MMAG_UPLOAD", 2.0)
    assert len(bench.calls) == 4


def test_a_ground_station_gets_all_values_unasked_when_it_appears_once() -> None:
    bench = Bench()
    beat = dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
    for _ in range(20):
        bench.hear(beat)
        bench.run(1.0)
    assert bench.values() == LIST
    bench.hear(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3), sender=(7, 192))
    bench.run(1.0)
    assert len(bench.said) == 5, "another companion is no ground station"
    bench.hear(beat, route="radio")
    bench.run(1.0)
    assert bench.values() == LIST * 2


def test_list_and_reads_stay_in_the_budget() -> None:
    bench = Bench(bps=500.0, extra=40)
    wire = Wire()
    bench.hear(dialect.MAVLink_param_request_list_message(7, 0))
    for _ in range(100):
        for index in range(0, 45, 5):
            bench.hear(dialect.MAVLink_param_request_read_message(7, 191, b"", index))
        bench.run(0.1)
    for _, m, _ in bench.said:
        wire.carry(m, 7, 191)
    assert 2500 <= wire.bytes <= 10.0 * 500


def test_a_flood_of_sets_is_not_answered_one_for_one() -> None:
    bench = Bench(bps=500.0)
    for _ in range(500):
        bench.set("MMAG_RATE", 5.0)
    assert len(bench.said) <= 40 and bench.rate == 5.0
    bench.run(10.0)
    assert bench.values()[-1] == ("MMAG_RATE", 2, 5), "but the last word is said"


@given(
    st.text(st.characters(max_codepoint=255), max_size=16),
    st.floats(width=32),
    st.integers(-32768, 32767),
    st.sampled_from([0, 191]),
)
@settings(max_examples=60, deadline=None)
def test_whatever_is_asked_nothing_but_our_values_and_errors_come(
    name: str, value: float, index: int, component: int
) -> None:
    bench = Bench()
    encoded = name.encode("latin-1")
    bench.hear(dialect.MAVLink_param_request_read_message(7, component, encoded, index))
    bench.hear(dialect.MAVLink_param_set_message(7, component, encoded, value, 9))
    bench.run(1.0)
    for _, m, _ in bench.said:
        if m.get_type() == "PARAM_VALUE":
            assert (m.param_id, m.param_index, m.param_count) in LIST
        else:
            assert m.get_type() == "PARAM_ERROR" and component == 191


def test_a_value_too_large_for_the_wire_is_shown_as_infinite() -> None:
    server = ParamServer([Entry("MMAG_BIG", lambda: -1e300)], Presence(target_system=7), Budget())
    read = WIRE.carry(dialect.MAVLink_param_request_read_message(7, 191, b"MMAG_BIG", -1), 255, 190)
    server.on_message(read, "gcs", S)
    server.poll(S)
    (out,) = server.poll(3 * S)
    assert WIRE.carry(out.message, 7, 191).param_value == -math.inf


@pytest.mark.parametrize("names", [["COMPASS_OFS_X"], ["MMAG_A", "MMAG_A"], ["MMAG_12345678901X"], ["MMAG_"]])
def test_wrong_names_are_a_wrong_call(names: list[str]) -> None:
    with pytest.raises(ValueError, match="entries"):
        ParamServer([Entry(name, lambda: 0.0) for name in names], Presence(), Budget())
