"""Message intervals: asked politely, re-asked rarely, given back."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect
from scripted_vehicle import MS, S, Wire

from magmav.mavlink.intervals import Intervals
from magmav.mavlink.presence import Presence

WIRE = Wire()
RAW_IMU, ATTITUDE, HIGHRES_IMU = 27, 30, 105


class Bench:
    """An autopilot that grants intervals; ``rate_hz`` says what it then really sends."""

    def __init__(self, wanted: dict[str, float]) -> None:
        self.presence = Presence(target_system=1)
        self.now_ns = 10 * S
        self.hear(dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3))
        self.machine = Intervals(wanted, self.presence)
        self.asked: list[tuple[float, int, float]] = []  # seconds, message id, interval in us
        self.rate_hz: dict[str, float] = {}
        self.answers: dict[int, int] = {}  # message id -> result; missing is ACCEPTED, -1 is silence
        self.twice = False  # every answer comes doubled
        self._acks: list[Any] = []  # on their way

    def hear(self, message: Any, component: int = 1, route: str = "a") -> Any:
        carried = WIRE.carry(message, 1, component)
        self.presence.on_message(carried, route, self.now_ns)
        return carried

    def run(self, seconds: float) -> None:
        for tick in range(round(seconds * 50)):
            acks, self._acks = self._acks, []
            for ack in acks:
                self.take(self.machine.on_message(WIRE.carry(ack, 1, 1), "a", self.now_ns))
            self.take(self.machine.poll(self.now_ns))
            for name, hz in self.rate_hz.items():
                if hz and tick % round(50 / hz) == 0:
                    arguments = (0,) * 12 if name == "RAW_IMU" else (0,) * 7
                    message = getattr(dialect, f"MAVLink_{name.lower()}_message")(*arguments)
                    self.take(self.machine.on_message(WIRE.carry(message, 1, 1), "a", self.now_ns))
            self.now_ns += 20 * MS

    def take(self, out: list[Any]) -> None:
        for item in out:
            m = WIRE.carry(item.message, 1, 191)
            assert (m.command, m.target_system, m.target_component, item.route) == (511, 1, 1, "a")
            self.asked.append(((self.now_ns - 10 * S) / S, round(m.param1), m.param2))
            result = self.answers.get(round(m.param1), 0)
            if result >= 0:
                ack = dialect.MAVLink_command_ack_message(511, result, 0, 0, 1, 191)
                self._acks += [ack] * (1 + self.twice)


def test_each_is_asked_once_with_its_interval() -> None:
    bench = Bench({"RAW_IMU": 20.0, "ATTITUDE": 25.0, "EXTENDED_SYS_STATE": 1.0})
    bench.rate_hz = {"RAW_IMU": 10.0, "ATTITUDE": 25.0, "EXTENDED_SYS_STATE": 0.0}
    bench.run(4.0)
    assert [(i, us) for _, i, us in bench.asked] == [(27, 50_000), (30, 40_000), (245, 1_000_000)]


def test_one_at_a_time_and_four_times_at_most_without_an_answer() -> None:
    bench = Bench({"RAW_IMU": 10.0, "ATTITUDE": 10.0})
    bench.answers = {RAW_IMU: -1}
    bench.rate_hz = {"RAW_IMU": 10.0, "ATTITUDE": 10.0}
    bench.run(9.0)
    assert [i for _, i, _ in bench.asked] == [RAW_IMU] * 4 + [ATTITUDE]
    assert [t for t, _, _ in bench.asked] == pytest.approx([0, 1, 2, 3, 4], abs=0.05)


def test_an_answer_to_somebody_else_frees_nothing() -> None:
    bench = Bench({"RAW_IMU": 10.0, "ATTITUDE": 10.0})
    bench.answers = {RAW_IMU: -1}
    bench.run(0.1)
    for ack in ((511, 0, 0, 0, 255, 190), (400, 0, 0, 0, 1, 191)):
        message = WIRE.carry(dialect.MAVLink_command_ack_message(*ack), 1, 1)
        bench.take(bench.machine.on_message(message, "a", bench.now_ns))
    from_gimbal = WIRE.carry(dialect.MAVLink_command_ack_message(511, 0, 0, 0, 1, 191), 1, 154)
    bench.take(bench.machine.on_message(from_gimbal, "a", bench.now_ns))
    assert [i for _, i, _ in bench.asked] == [RAW_IMU]


def test_denied_is_asked_once_more_alone_and_then_remembered() -> None:
    bench = Bench({"HIGHRES_IMU": 10.0, "ATTITUDE": 10.0})
    bench.answers = {HIGHRES_IMU: dialect.MAV_RESULT_DENIED}
    bench.rate_hz = {"ATTITUDE": 10.0}
    bench.run(600.0)
    assert [i for _, i, _ in bench.asked] == [HIGHRES_IMU, ATTITUDE, HIGHRES_IMU]
    assert bench.asked[2][0] - bench.asked[0][0] >= 10.0
    assert bench.machine.refused == {"HIGHRES_IMU"}


def test_a_refusal_that_was_another_messages_is_not_believed_for_good() -> None:
    """The answer says not which message it is about: doubled, it is taken for that of the next request."""
    bench = Bench({"HIGHRES_IMU": 10.0, "ATTITUDE": 10.0, "RAW_IMU": 10.0})
    bench.answers = {HIGHRES_IMU: dialect.MAV_RESULT_DENIED, ATTITUDE: -1}  # the request for ATTITUDE is lost
    bench.twice = True
    bench.rate_hz = {"RAW_IMU": 10.0}
    bench.run(1.0)
    assert [i for _, i, _ in bench.asked] == [HIGHRES_IMU, ATTITUDE, RAW_IMU]
    del bench.answers[ATTITUDE]
    bench.run(40.0)
    again = [i for _, i, _ in bench.asked[3:]]
    assert again.count(HIGHRES_IMU) == 1 and ATTITUDE in again
    assert bench.machine.refused == {"HIGHRES_IMU"}


def test_streams_that_end_are_asked_for_again_whatever_was_answered_once() -> None:
    """A reboot that nothing shows, since all that carries the boot clock ended with it."""
    bench = Bench({"HIGHRES_IMU": 10.0, "ATTITUDE": 10.0, "RAW_IMU": 10.0})
    bench.answers = {HIGHRES_IMU: dialect.MAV_RESULT_DENIED}
    bench.twice = True
    bench.rate_hz = {"ATTITUDE": 10.0, "RAW_IMU": 10.0}
    bench.run(60.0)
    count = len(bench.asked)
    bench.rate_hz = {}
    bench.run(30.0)
    assert {i for _, i, _ in bench.asked[count:]} == {ATTITUDE, RAW_IMU}


def test_S14_what_was_refused_by_mistake_and_came_is_given_back_too() -> None:
    bench = Bench({"HIGHRES_IMU": 10.0, "ATTITUDE": 10.0})
    bench.answers = {HIGHRES_IMU: dialect.MAV_RESULT_DENIED}
    bench.twice = True
    bench.rate_hz = {"ATTITUDE": 10.0}
    bench.run(60.0)
    assert [round(o.message.param1) for o in bench.machine.restore()] == [ATTITUDE]


def test_AT_9b_a_rate_that_drops_is_asked_for_again_ever_more_rarely() -> None:
    bench = Bench({"RAW_IMU": 10.0})
    bench.rate_hz = {"RAW_IMU": 10.0}
    bench.run(20.0)
    assert len(bench.asked) == 1
    assert bench.machine.rates["RAW_IMU"] == pytest.approx(10.0, abs=0.5)
    bench.rate_hz = {"RAW_IMU": 2.0}  # a ground station stomped it
    bench.run(300.0)
    times = [t for t, _, _ in bench.asked[1:]]
    assert 20.0 < times[0] <= 30.1, "noticed within two windows"
    gaps = [b - a for a, b in pairwise(times)]
    assert gaps == pytest.approx([10, 20, 40, 80, 80], abs=5.1)
    bench.rate_hz = {"RAW_IMU": 10.0}
    bench.run(20.0)
    bench.rate_hz = {"RAW_IMU": 2.0}
    count, begin = len(bench.asked), (bench.now_ns - 10 * S) / S
    bench.run(100.0)
    assert len(bench.asked) > count
    assert bench.asked[count][0] - begin <= 85.0


def test_AT_9b_never_twice_in_ten_seconds_after_the_start() -> None:
    bench = Bench({"RAW_IMU": 10.0, "ATTITUDE": 10.0})
    bench.run(400.0)
    for message_id in (RAW_IMU, ATTITUDE):
        times = [t for t, i, _ in bench.asked if i == message_id]
        assert len(times) >= 5
        assert min(b - a for a, b in pairwise(times)) >= 9.99


def test_a_reboot_or_a_new_route_starts_over() -> None:
    bench = Bench({"RAW_IMU": 10.0})
    bench.rate_hz = {"RAW_IMU": 10.0}
    bench.run(1.0)
    for boot_ms in (60_000, 60_500, 100, 600):
        bench.hear(dialect.MAVLink_system_time_message(0, boot_ms))
    bench.run(1.0)
    assert len(bench.asked) == 2
    bench.machine.restart()
    bench.run(1.0)
    assert len(bench.asked) == 3


def test_S14_everything_changed_is_given_back() -> None:
    bench = Bench({"RAW_IMU": 10.0, "HIGHRES_IMU": 10.0, "ATTITUDE": 10.0})
    bench.answers = {HIGHRES_IMU: dialect.MAV_RESULT_DENIED}
    assert bench.machine.restore() == [], "nothing was changed yet"
    bench.run(1.0)
    out = bench.machine.restore()
    assert [(round(o.message.param1), o.message.param2, o.route) for o in out] == [(27, 0, "a"), (30, 0, "a")]
    assert bench.machine.restore() == []


def test_nobody_latched_nothing_asked() -> None:
    machine = Intervals({"RAW_IMU": 10.0}, Presence())
    assert machine.poll(5 * S) == [] and machine.restore() == []


@pytest.mark.parametrize(("name", "hz"), [("RAW_IMUS", 1.0), ("RAW_IMU", 0.0), ("RAW_IMU", float("nan"))])
def test_wrong_calls_name_the_culprit(name: str, hz: float) -> None:
    with pytest.raises(ValueError, match=name):
        Intervals({name: hz}, Presence())
