"""What we say unasked: never too much, never stale."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect
from scripted_vehicle import MS, S, Wire, f32

from magmav.mavlink.announce import Announcer
from magmav.mavlink.budget import Budget
from magmav.mavlink.entry import Entry
from magmav.mavlink.params import ParamServer
from magmav.mavlink.presence import Presence

NAN = float("nan")


class Bench:
    def __init__(self, bps: float = 500.0, heading_hz: float = 2.0) -> None:
        self.budget = Budget(bps)
        self.announcer = Announcer(self.budget, heading_hz)
        self.wire = Wire()
        self.now_ns = 100 * S
        self.said: list[tuple[float, Any]] = []
        self.announcer.poll(self.now_ns)
        self.run(2.0)

    def run(self, seconds: float, heading: Any = None) -> None:
        """``heading`` : time in s -> degrees, for compass 1, ten times a second."""
        for tick in range(round(seconds * 50)):
            self.now_ns += 20 * MS
            if heading is not None and tick % 5 == 0:
                self.announcer.heading(1, heading(self.now_ns / S), self.now_ns - 90 * S, self.now_ns)
            self.take(self.announcer.poll(self.now_ns))

    def take(self, out: list[Any]) -> None:
        for item in out:
            assert item.route == ""
            self.said.append((self.now_ns / S, self.wire.carry(item.message, 7, 191)))

    def of(self, kind: str) -> list[Any]:
        return [m for _, m in self.said if m.get_type() == kind]


def test_headings_go_out_at_their_rate_with_name_value_and_boot_time() -> None:
    bench = Bench()
    bench.run(10.0, heading=lambda t: t - 102.0 + 355.0)
    sent = bench.of("NAMED_VALUE_FLOAT")
    assert 19 <= len(sent) <= 21
    assert {m.name for m in sent} == {"MMAG_HDG"}
    for t, m in bench.said:
        assert 0.0 <= m.value < 360.0
        assert m.value == pytest.approx((t + 253.0) % 360.0, abs=0.2)
        assert m.time_boot_ms / 1000 == pytest.approx(t - 90.0, abs=0.2)


def test_S12_unknown_or_stale_is_silent_never_frozen() -> None:
    bench = Bench()
    bench.run(2.0, heading=lambda t: 10.0)
    count = len(bench.said)
    bench.run(5.0, heading=lambda t: NAN)
    bench.run(5.0)
    assert len(bench.said) == count
    bench.run(2.0, heading=lambda t: 20.0)
    assert [m.value for m in bench.of("NAMED_VALUE_FLOAT")[count:]] == [20.0] * (len(bench.said) - count)
    late = Bench()
    late.run(2.0, heading=lambda t: 10.0)
    late.said.clear()
    late.announcer.heading(1, 5.0, S, late.now_ns)
    late.now_ns += 2 * S
    late.take(late.announcer.poll(late.now_ns))
    assert late.said == [], "older than a second"
    again = Bench()
    for _ in range(50):  # the same instant of the vehicle, told again and again
        again.announcer.heading(1, 5.0, S, again.now_ns)
        again.run(0.1)
    assert len(again.said) == 1


def test_three_compasses_have_three_names_and_zero_hertz_is_off() -> None:
    bench = Bench()
    for compass in (1, 2, 3):
        bench.announcer.heading(compass, 90.0 * compass, S, bench.now_ns)
    bench.run(1.0)
    assert {m.name: m.value for m in bench.of("NAMED_VALUE_FLOAT")} == {
        "MMAG_HDG": 90.0, "MMAG_HDG2": 180.0, "MMAG_HDG3": 270.0
    }  # fmt: skip
    off = Bench(heading_hz=0.0)
    off.run(3.0, heading=lambda t: 1.0)
    assert off.said == []


@given(st.text(st.characters(min_codepoint=32, max_codepoint=126), min_size=1, max_size=400))
@settings(max_examples=60, deadline=None)
def test_long_texts_are_chunked_and_come_together_again(text: str) -> None:
    bench = Bench(bps=100_000.0)
    bench.announcer.say(6, text, bench.now_ns)
    bench.run(0.5)
    chunks = bench.of("STATUSTEXT")
    assert "".join(m.text for m in chunks) == text[:249]
    assert [m.chunk_seq for m in chunks] == list(range(len(chunks)))
    if len(chunks) == 1:
        assert chunks[0].id == 0
    else:
        assert len({m.id for m in chunks}) == 1 and chunks[0].id != 0
        assert len(chunks[-1].text) < 50, "the zero byte that ends it"


def test_texts_never_break_on_what_is_not_ascii() -> None:
    bench = Bench()
    bench.announcer.say(6, "déclinaison 3° \x00\U0001f9ed", bench.now_ns)
    bench.run(0.5)
    assert bench.of("STATUSTEXT")[0].text.startswith("d?clinaison 3?")


def test_the_same_text_is_not_repeated_within_thirty_seconds() -> None:
    bench = Bench()
    for _ in range(60):
        bench.announcer.say(4, "magnet or steel near compass", bench.now_ns)
        bench.announcer.say(6, "turn right", bench.now_ns)
        bench.run(1.0)
    assert len(bench.of("STATUSTEXT")) == 4
    assert bench.announcer.counts["repeats"] == 116


def test_critical_texts_pass_an_empty_budget_and_are_paid_back() -> None:
    bench = Bench()
    for number in range(15):
        bench.announcer.say(6, f"{number} " + "x" * 45, bench.now_ns)
    bench.announcer.say(2, "armed in the middle of a write", bench.now_ns)
    bench.take(bench.announcer.poll(bench.now_ns))
    assert bench.of("STATUSTEXT")[0].severity == 2
    before = bench.wire.bytes
    bench.run(10.0)
    assert bench.wire.bytes <= before + 10 * 500


def test_a_full_queue_drops_the_least_important() -> None:
    bench = Bench()
    for number in range(19):
        bench.announcer.say(4, f"warning {number}", bench.now_ns)
    bench.announcer.say(7, "debug", bench.now_ns)
    bench.announcer.say(4, "one more", bench.now_ns)
    bench.run(30.0)
    texts = [m.text for m in bench.of("STATUSTEXT")]
    assert "debug" not in texts and "one more" in texts and len(texts) == 20
    assert bench.announcer.counts["dropped"] == 1


def test_AT_9c_everything_together_stays_at_or_under_500_bytes_a_second() -> None:
    """Heartbeat, headings of three compasses, chatter, lists and reads for a minute; real encoded frames."""
    bench = Bench(heading_hz=10.0)
    presence = Presence(target_system=7)
    entries = [Entry(f"MMAG_P{i}", lambda: 1.25) for i in range(40)]
    server = ParamServer(entries, presence, bench.budget)
    ask = bench.wire.carry(dialect.MAVLink_param_request_list_message(7, 0), 255, 190)
    sizes: list[tuple[int, int]] = []
    begin_ns, kinds = bench.now_ns, set()
    for tick in range(60 * 50):
        bench.now_ns += 20 * MS
        now_ns = bench.now_ns
        for compass in (1, 2, 3):
            bench.announcer.heading(compass, tick % 360, now_ns, now_ns)
        if tick % 50 == 0:
            bench.announcer.say(6, f"chatter {tick} and so on and on and on", now_ns)
        if tick % 250 == 0:
            server.on_message(ask, "gcs", now_ns)
        beats = presence.poll(now_ns)
        for beat in beats:
            bench.budget.force(beat.message, now_ns)
        for item in [*beats, *bench.announcer.poll(now_ns), *server.poll(now_ns)]:
            before = bench.wire.bytes
            kinds.add(bench.wire.carry(item.message, 7, 191).get_type())
            sizes.append((now_ns - begin_ns, bench.wire.bytes - before))
    assert kinds == {"HEARTBEAT", "NAMED_VALUE_FLOAT", "STATUSTEXT", "PARAM_VALUE"}
    total = sum(size for _, size in sizes)
    assert 0.85 * 30_000 < total <= 30_000, "the budget is used, and kept"
    for start_s in range(50):
        window = sum(size for t, size in sizes if start_s * S <= t < (start_s + 10) * S)
        assert window <= 10 * 500, f"ten seconds from {start_s} s"


def test_headings_and_texts_go_on_while_a_list_runs() -> None:
    bench = Bench()
    entries = [Entry(f"MMAG_P{i}", lambda: 1.25) for i in range(200)]
    server = ParamServer(entries, Presence(target_system=7), bench.budget)
    ask = bench.wire.carry(dialect.MAVLink_param_request_list_message(7, 0), 255, 190)
    server.on_message(ask, "gcs", bench.now_ns)
    for tick in range(500):
        bench.now_ns += 20 * MS
        bench.take(server.poll(bench.now_ns))
        for compass in (1, 2, 3):
            bench.announcer.heading(compass, tick % 360, bench.now_ns, bench.now_ns)
        if tick % 100 == 0:
            bench.announcer.say(6, f"{tick} is a text of almost fifty bytes, which is a lot", bench.now_ns)
        bench.take(bench.announcer.poll(bench.now_ns))
    assert len(bench.of("NAMED_VALUE_FLOAT")) >= 57, "2 Hz each, for ten seconds"
    said = "".join(m.text for m in bench.of("STATUSTEXT"))
    assert said == "".join(f"{t} is a text of almost fifty bytes, which is a lot" for t in range(0, 500, 100))
    assert len(bench.of("PARAM_VALUE")) >= 60


def test_any_ten_seconds_hold_at_most_ten_times_the_rate_even_after_a_rest() -> None:
    budget = Budget(500.0)
    message = dialect.MAVLink_statustext_message(6, b"x" * 50)
    budget.take(message, 0)
    sent = sum(budget.size(message) for ms in range(10_000) if budget.take(message, 60 * S + ms * MS))
    assert 4700 <= sent <= 5000


def test_budget_counts_what_the_wire_carries() -> None:
    budget, wire = Budget(), Wire()
    messages = [
        dialect.MAVLink_statustext_message(6, b"short"),
        dialect.MAVLink_param_value_message(b"MMAG_HDG", f32(0.1), 9, 40, 3),
        dialect.MAVLink_named_value_float_message(0, b"MMAG_HDG", 0.0),
    ]
    for message in messages:
        before = wire.bytes
        wire.carry(message, 1, 191)
        assert budget.size(message) == wire.bytes - before
        assert Budget(signed=True).size(message) == wire.bytes - before + 13


def test_wrong_calls_name_the_culprit() -> None:
    bench = Bench()
    for call, name in (
        (lambda: bench.announcer.heading(4, 0.0, 0, 0), "compass"),
        (lambda: bench.announcer.say(8, "x", 0), "severity"),
        (lambda: Announcer(bench.budget, -1.0), "heading_hz"),
        (lambda: Budget(NAN), "bps"),
    ):
        with pytest.raises(ValueError, match=name):
            call()
