"""The autopilot's clock tells a reboot, however short the silence; what overtakes, lies or is held back tells none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fleet_rig import Airspace, Craft
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.core.types import Change, UploadResult
from magmav.mavlink.boot_clock import BootClock
from magmav.settings import Settings, with_value

MS = 1_000_000


def attitude(boot_ms: int) -> Any:
    return dialect.MAVLink_attitude_message(boot_ms, 0, 0, 0, 0, 0, 0)


def raw_imu(boot_ms: int) -> Any:
    return dialect.MAVLink_raw_imu_message(boot_ms * 1000, *(0,) * 9)


def heard(*at: tuple[int, int], make: Any = attitude) -> BootClock:
    """(boot time, arrival) in ms."""
    clock = BootClock()
    for boot_ms, now_ms in at:
        clock.on_message(make(boot_ms), now_ms * MS)
    return clock


def steady(from_ms: int, until_ms: int, booted_ms: int = 0, every_ms: int = 100) -> list[tuple[int, int]]:
    """A vehicle that booted then is heard without delay; arrival times."""
    return [(t - booted_ms, t) for t in range(from_ms, until_ms, every_ms)]


@pytest.mark.parametrize("make", [attitude, raw_imu])
@pytest.mark.parametrize("silent_ms", [100, 500, 3_000, 40_000])
@pytest.mark.parametrize("up_ms", [4_000, 600_000])
def test_a_reboot_is_seen_however_long_the_silence_and_however_soon_after_the_boot(
    make: Any, silent_ms: int, up_ms: int
) -> None:
    back_ms = up_ms + silent_ms
    booted_ms = back_ms - 500 if silent_ms <= 3_000 else up_ms + 8_000  # 8 s to boot, then heard 32 s later
    clock = heard(*steady(100, up_ms), *steady(back_ms, back_ms + 3_000, booted_ms), make=make)
    assert clock.boots == 1
    assert clock.ms == back_ms + 2_900 - booted_ms


def test_a_reboot_is_no_second_one_when_packets_from_before_still_arrive() -> None:
    mixed = [(10_400, 10_600), (100, 10_650), (10_450, 10_700)]
    assert heard(*steady(100, 10_500), *mixed, *steady(10_800, 20_000, 10_500)).boots == 1


@given(st.lists(st.integers(0, 2_000), min_size=60, max_size=60), st.integers(0, 4_000_000_000))
@settings(max_examples=200, deadline=None)
def test_packets_that_overtake_one_another_by_two_seconds_are_no_reboot(late_ms: list[int], up_ms: int) -> None:
    sent = [(up_ms + 100 * i, 100 * i + late) for i, late in enumerate(late_ms)]
    assert heard(*sorted(sent, key=lambda at: at[1])).boots == 0


@given(st.lists(st.tuples(st.integers(0, 59), st.integers(0, 2**32 - 1)), max_size=10, unique_by=lambda lie: lie[0]))
@settings(max_examples=200, deadline=None)
def test_single_packets_that_lie_are_no_reboot(lies: list[tuple[int, int]]) -> None:
    """Each between two true ones; the clock that is believed stays the true one, too."""
    at = steady(600_000, 606_000)
    for place, boot_ms in sorted(lies, reverse=True):
        at.insert(place + 1, (boot_ms, at[place][1]))
    clock = heard(*at[:1], *at)
    assert clock.boots == 0
    assert clock.ms is not None and abs(clock.ms - 605_900) <= 10_000


def test_a_link_that_holds_packets_back_and_then_delivers_them_is_no_reboot() -> None:
    """Nothing for 20 s, then all of it within a second: the first of it seems 20 s behind."""
    backlog = [(t, 30_000 + (t - 10_000) // 25) for t in range(10_000, 30_000, 100)]
    assert heard(*steady(100, 10_000), *backlog, *steady(30_900, 40_000)).boots == 0


def test_a_clock_that_is_slow_for_ever_is_no_reboot() -> None:
    """A simulator at half speed."""
    assert heard(*((t // 2, t) for t in range(0, 600_000, 100))).boots == 0


def test_a_time_of_the_day_is_no_boot_clock() -> None:
    clock = BootClock()
    for us in (1_790_000_000_000_000, 5_000_000, 1_790_000_001_000_000, 5_500_000):
        clock.on_message(dialect.MAVLink_raw_imu_message(us, *(0,) * 9), 0)
    assert (clock.ms, clock.boots) == (5_500, 0)


# ------------------------------------------------------------ and everybody who has to know it


class Reboots(Craft):
    """A craft that boots anew: other offsets, no stream but what is asked for."""

    def __init__(self, route: str = "udp:1") -> None:
        super().__init__(1, route)
        self.booted_ms = -600_000
        self.params |= {"COMPASS_LEARN": 0.0, "COMPASS_OFFS_MAX": 1800.0}
        self.wanted: set[int] = set()
        self.only_slow = False  # SYSTEM_TIME and heartbeats alone come unasked

    def reboot(self, now_ms: int) -> None:
        self.booted_ms = now_ms
        self.wanted.clear()
        self.params["COMPASS_OFS_X"] = 77.0

    def talk(self, ms: int) -> list[bytes]:
        if not self.talks:
            return []
        out = [self.heartbeat(), self.pack(dialect.MAVLink_extended_sys_state_message(0, 1))] if ms % 1000 == 0 else []
        boot_ms = ms - self.booted_ms
        if ms % 500 == 0:
            out.append(self.pack(dialect.MAVLink_system_time_message(0, boot_ms)))
        if 27 in self.wanted or not self.only_slow:
            out.append(self.imu(boot_ms))
        return out

    def answer(self, message: Any) -> list[bytes]:
        """It knows no other names than it has, and no rate but that of RAW_IMU and SYSTEM_TIME."""
        kind = message.get_type()
        if kind == "PARAM_REQUEST_READ" and message.param_id not in self.params:
            return [self.pack(dialect.MAVLink_param_error_message(1, 191, message.param_id.encode(), -1, 1))]
        if kind == "COMMAND_LONG" and message.command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL:
            known = message.param1 in (2, 27)
            self.wanted |= {int(message.param1)} if known else set()
            return [self.pack(dialect.MAVLink_command_ack_message(message.command, 0 if known else 3, 0, 0, 1, 191))]
        return super().answer(message)


def settled(folder: Path, only_slow: bool = False) -> tuple[Airspace, Reboots, Any]:
    craft = Reboots()
    craft.only_slow = only_slow
    air = Airspace(folder, craft, settings=with_value(Settings(), "wire", "imu_hz", 8.0))
    air.run(12.0)
    member = air.fleet.members[1]
    assert member.settled and member.flown().calibrations.known(1)
    craft.heard.clear()
    return air, craft, member


def asked(craft: Craft) -> tuple[set[int], set[str]]:
    """Intervals and parameters that were asked for."""
    commands = [m for m in craft.heard if m.get_type() == "COMMAND_LONG"]
    intervals = {int(m.param1) for m in commands if m.command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL}
    return intervals, {m.param_id for m in craft.heard if m.get_type() == "PARAM_REQUEST_READ"}


@pytest.mark.parametrize("only_slow", [False, True])
def test_half_a_second_of_silence_and_all_is_asked_for_again(tmp_path: Path, only_slow: bool) -> None:
    """Intervals, offsets, the sensor clock; and what is read after the reboot is not thrown away by it."""
    air, craft, member = settled(tmp_path, only_slow)
    craft.talks = False
    air.run(0.5)
    craft.talks = True
    craft.reboot(air.ms)
    air.run(12.0)
    intervals, names = asked(craft)
    assert {27, 30} <= intervals, "RAW_IMU and ATTITUDE"
    assert {"COMPASS_OFS_X", "COMPASS_DEV_ID", "COMPASS_DIA_X"} <= names
    flown = member.flown()
    assert (member.presence.boots, flown.assembler.reboots) == (1, 1)
    assert flown.calibrations.offsets(1)[0] == 77.0 and flown.calibrations.known(1)
    assert abs(flown.assembler.clock.latest_ns / MS - (air.ms - craft.booted_ms)) < 500
    air.store.close()


def _quiet(air: Airspace, craft: Reboots, member: Any) -> None:
    assert (member.presence.boots, member.flown().assembler.reboots) == (0, 0)
    intervals, names = asked(craft)
    assert 27 not in intervals and not names
    air.store.close()


def test_packets_two_seconds_late_change_nothing(tmp_path: Path) -> None:
    air, craft, member = settled(tmp_path)
    for _ in range(20):
        late = air.ms - craft.booted_ms - 1_900
        air.push(craft.pack(attitude(late)), craft.route)
        air.push(craft.imu(late), craft.route)
        air.push(craft.pack(attitude(late + 50)), craft.route)
        air.run(0.1)
    _quiet(air, craft, member)


@pytest.mark.parametrize(("route", "component"), [("udp:2", 1), ("udp:1", 154), ("udp:1", 100)])
def test_a_reboot_told_over_a_second_route_or_by_another_component_is_none(
    tmp_path: Path, route: str, component: int
) -> None:
    air, craft, member = settled(tmp_path)
    other = Craft(1, route, component=component)
    for boot_ms in range(100, 4_000, 100):
        air.push(other.pack(dialect.MAVLink_system_time_message(0, boot_ms)), route)
        air.push(other.imu(boot_ms), route)
        air.run(0.1)
    assert np.isfinite(member.flown().assembler.clock.latest_ns)
    _quiet(air, craft, member)


def test_one_packet_that_lies_on_the_own_route_changes_nothing(tmp_path: Path) -> None:
    air, craft, member = settled(tmp_path)
    for boot_ms in (50, 4_000_000_000, 300_000):
        air.push(craft.pack(attitude(boot_ms)), craft.route)
        air.push(craft.imu(boot_ms % 2_000_000), craft.route)
        air.run(0.3)
    _quiet(air, craft, member)


def test_a_write_under_way_stops_at_a_reboot_without_silence_and_is_taken_back(tmp_path: Path) -> None:
    """S1, S2: nothing is written on; what was written is undone once the vehicle is known anew."""
    air, craft, member = settled(tmp_path)
    flown = member.flown()
    names = tuple(f"COMPASS_OFS_{axis}" for axis in "XYZ")
    old = tuple(float(craft.params[n]) for n in names)
    new = tuple(v + 40.0 for v in old)
    device = flown.calibrations.device_id(1)
    change = Change(1, 1, "COMPASS_DEV_ID", device, names, old, new, (40.0,) * 3, (2.0,) * 3, tuple(map(abs, new)))
    member.start(change, None, air.now_ns)
    for _ in range(400):
        air.run(0.1)
        if craft.params[names[0]] != old[0]:
            break
    assert member.job is not None, member.ended.reasons
    craft.booted_ms = air.ms
    air.run(1.0)
    assert member.ended.result is UploadResult.PENDING_RESTORE
    air.run(60.0)
    assert tuple(craft.params[n] for n in names) == pytest.approx(old)
    assert member.ended.result is UploadResult.ALL_OLD
    air.store.close()
