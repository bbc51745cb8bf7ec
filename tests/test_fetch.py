"""Reading what we need, by name, and no more."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect
from scripted_vehicle import MS, S, Wire

from magmav.mavlink.fetch import ParamFetch
from magmav.mavlink.presence import Presence

WIRE = Wire()


class Bench:
    def __init__(self, names: list[str], known: set[str]) -> None:
        self.presence = Presence(target_system=1)
        self.now_ns = 0
        self.presence.on_message(
            WIRE.carry(dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3), 1, 1), "a", self.now_ns
        )
        self.fetch = ParamFetch(names, self.presence)
        self.known = known
        self.asked: list[tuple[float, str]] = []

    def value(self, name: str, component: int = 1, route: str = "a") -> None:
        message = dialect.MAVLink_param_value_message(name.encode(), 1.5, 9, 900, 65535)
        self.take(self.fetch.on_message(WIRE.carry(message, 1, component), route, self.now_ns))

    def take(self, out: list[Any]) -> None:
        for item in out:
            m = WIRE.carry(item.message, 1, 191)
            assert m.get_type() == "PARAM_REQUEST_READ", "S14: never a full list"
            assert (m.target_system, m.target_component, m.param_index, item.route) == (1, 1, -1, "a")
            self.asked.append((self.now_ns / S, m.param_id))
            if m.param_id in self.known:
                self.value(m.param_id)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * 50)):
            self.take(self.fetch.poll(self.now_ns))
            self.now_ns += 20 * MS


def test_each_name_is_read_once_ten_a_second() -> None:
    names = [f"COMPASS_{i:08d}" for i in range(30)]  # 16 characters, the longest there are
    bench = Bench(names, set(names))
    bench.run(10.0)
    assert [name for _, name in bench.asked] == names
    times = [t for t, _ in bench.asked]
    assert min(b - a for a, b in pairwise(times)) >= 0.099
    assert times[-1] < 3.5 and bench.fetch.done and bench.fetch.heard == set(names)


def test_silence_means_absent_after_four_requests_with_ever_rarer_chances_after_that() -> None:
    bench = Bench(["COMPASS_SCALE", "COMPASS_MOTCT"], {"COMPASS_MOTCT"})
    bench.run(6.0)
    assert [t for t, n in bench.asked if n == "COMPASS_SCALE"] == pytest.approx([0, 1, 2, 3], abs=0.15)
    assert bench.fetch.absent == {"COMPASS_SCALE"} and bench.fetch.done
    bench.run(240.0)
    times = [t for t, n in bench.asked if n == "COMPASS_SCALE"]
    assert [b - a for a, b in pairwise(times[3:])] == pytest.approx([6.0, 10.0, 20.0, 40.0, 80.0], abs=0.2)
    bench.value("COMPASS_SCALE")  # it was the link after all
    assert bench.fetch.absent == frozenset() and bench.fetch.heard == {"COMPASS_SCALE", "COMPASS_MOTCT"}


@pytest.mark.parametrize(("x", "y"), [("COMPASS_OFS_X", "COMPASS_OFS_Y"), ("CAL_MAG0_XOFF", "CAL_MAG0_YOFF")])
def test_who_has_one_of_three_axes_has_the_others_and_silence_was_the_links(x: str, y: str) -> None:
    bench = Bench([x, y, "COMPASS_MOTCT"], {y})
    bench.run(20.0)
    asked = [t for t, name in bench.asked if name == x]
    assert max(b - a for a, b in pairwise(asked)) < 2.2 and len(asked) >= 10
    assert bench.fetch.absent == {"COMPASS_MOTCT"}
    bench.run(40.0)  # sixteen times are enough for any link that carries anything
    assert bench.fetch.absent == {"COMPASS_MOTCT", x} and bench.fetch.done
    assert len([t for t, name in bench.asked if name == x]) < 22


def test_an_error_means_absent_at_once() -> None:
    bench = Bench(["COMPASS_X"], set())
    bench.run(0.1)
    error = dialect.MAVLink_param_error_message(1, 191, b"COMPASS_X", -1, 1)
    bench.take(bench.fetch.on_message(WIRE.carry(error, 1, 1), "a", bench.now_ns))
    bench.run(60.0)
    assert len(bench.asked) == 1 and bench.fetch.absent == {"COMPASS_X"}


def test_what_is_heard_anyway_is_not_asked_and_others_values_do_not_count() -> None:
    bench = Bench(["COMPASS_X", "COMPASS_Y", "COMPASS_Z"], {"COMPASS_Z"})
    bench.value("COMPASS_X")
    bench.value("COMPASS_Y", component=154)
    bench.value("COMPASS_Y", route="b")
    bench.run(1.0)
    assert [n for _, n in bench.asked] == ["COMPASS_Y", "COMPASS_Z"]


def test_a_reboot_reads_everything_again_and_again_reads_some() -> None:
    bench = Bench(["COMPASS_X", "COMPASS_Y"], {"COMPASS_X", "COMPASS_Y", "COMPASS_Z"})
    bench.run(1.0)
    bench.fetch.again(["COMPASS_Y", "COMPASS_Z"])
    bench.run(1.0)
    assert [n[-1] for _, n in bench.asked] == ["X", "Y", "Y", "Z"]
    for boot_ms in (60_000, 60_500, 100, 600):
        message = WIRE.carry(dialect.MAVLink_system_time_message(0, boot_ms), 1, 1)
        bench.presence.on_message(message, "a", bench.now_ns)
    bench.run(1.0)
    assert [n[-1] for _, n in bench.asked[4:]] == ["X", "Y", "Z"]


def test_wrong_calls_name_the_culprit() -> None:
    with pytest.raises(ValueError, match="COMPASS_12345678X"):
        ParamFetch(["COMPASS_12345678X"], Presence())
