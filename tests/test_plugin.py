"""magmav in somebody else's console: the link that is fed, the commands, and the thread they run in.

The shim that puts it into MAVProxy is tested with MAVProxy itself, in tests/peers.
"""

from __future__ import annotations

import ast
import time
from collections import Counter
from pathlib import Path

import pytest
from flight_rig import Flight, ready, staying
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect
from test_dry_run import line

from magmav.core.types import Reason
from magmav.geomag import world_magnetic_model
from magmav.link.fed import FedLink
from magmav.link.memory import SetClock
from magmav.mavlink.change import code_needed
from magmav.plugin import USAGE, Desk, Plugin
from magmav.settings import Settings, with_value

ROOT = Path(__file__).parents[1]
_OFFSETS = ("COMPASS_OFS_X", "COMPASS_OFS_Y", "COMPASS_OFS_Z")
_PATIENCE_S = 60.0


def fed(**options):
    clock = SetClock(5_000_000_000)
    link = FedLink("host", tick_s=0.001, clock_ns=clock, unix_ns=lambda: 7_000_000_000, **options)
    return link, clock


# ------------------------------------------------------------ the link that is fed


@given(
    steps=st.lists(st.tuples(st.sampled_from(("push", "read", "wait")), st.floats(0.0, 1.0)), max_size=40),
)
def test_every_frame_pushed_comes_out_once_in_order_or_is_counted(steps):
    link, clock = fed(late_s=0.5)
    packets = link.packets()
    pushed, out, times = [], [], []
    for what, seconds in steps:
        if what == "wait":
            clock.advance(seconds)
        elif what == "push":
            pushed.append((str(len(pushed)).encode(), clock.now_ns))
            link.push(pushed[-1][0], "host:1")
        else:
            packet = next(packets)
            times.append(packet.t_ns)
            out += [(packet.data, clock.now_ns)] if packet.data else []
    for _ in range(len(pushed) - len(out)):
        packet = next(packets)
        times.append(packet.t_ns)
        out += [(packet.data, clock.now_ns)] if packet.data else []
    assert times == sorted(times)
    came = [data for data, _ in out]
    assert came == [data for data, _ in pushed if data in came]
    assert link.counts["received"] == len(out)
    assert link.counts["received"] + link.counts["late"] == len(pushed)
    waited = {data: read_ns - dict(pushed)[data] for data, read_ns in out}
    assert all(ns <= 500_000_000 for ns in waited.values())


def test_S1_a_heartbeat_that_waited_in_the_host_is_not_taken_for_a_fresh_one():
    link, clock = fed()
    link.push(b"disarmed", "host:1")
    clock.advance(0.6)
    link.push(b"armed", "host:1")
    packets = link.packets()
    assert next(packets).data == b""
    assert next(packets).data == b"armed"
    assert link.counts == {"late": 1, "received": 1}


def test_a_reader_that_hangs_does_not_eat_the_hosts_memory():
    link, _ = fed()
    for _ in range(6000):
        link.push(b"x" * 20, "host:1")
        link.send(b"y")
    assert link.counts["dropped"] == link.counts["dropped sends"] == 6000 - 4096
    assert len(link.take()) == 4096
    assert link.take() == []


def test_closing_ends_the_packets_and_last_words_can_still_be_taken():
    link, _ = fed()
    packets = link.packets()
    assert next(packets).data == b""
    link.close()
    assert list(packets) == []
    link.send(b"farewell", "host:2")
    assert link.take() == [(b"farewell", "host:2")]
    link.push(b"too late", "host:1")
    assert link.counts["received"] == 0


def test_what_the_link_does_not_take():
    link, _ = fed()
    assert link.unix_offset_ns == 2_000_000_000
    with pytest.raises(ValueError, match="route"):
        link.push(b"x", "")
    with pytest.raises(ValueError, match="tick_s"):
        FedLink("host", tick_s=0.0)
    with pytest.raises(ValueError, match="late_s"):
        FedLink("host", late_s=-1.0)


# ------------------------------------------------------------ the commands


class Story:
    """What an operator asks in the course of one flight, and what the desk answers."""

    def __init__(self, folder):
        f = self.f = Flight(staying(), folder)
        desk = self.desk = Desk(f.session, f.store)
        f.service.watchers += (desk.watch,)
        self.before = {name: desk.answer([name]) for name in ("status", "upload", "restore", "history")}
        assert f.fly(lambda: f.companion.settled, 30.0)
        self.unready = desk.answer(["upload"]), desk.answer(["upload", "--dry-run"])
        f.fly(lambda: ready(f.last()), 200.0)
        self.flying = desk.answer(["status"])
        f.fly(lambda: not f.sim.autopilot.armed, 300.0)
        f.fly(seconds=3.0)
        desk.news()
        self.old = [f.value(n) for n in _OFFSETS]
        self.uncoded = desk.answer(["upload", "1"]), desk.news()
        self.dry = desk.answer(["upload", "--dry-run"])
        self.quiet = self.sets()
        self.code = code_needed(f.companion.plan(1))
        self.confirm_before = f.companion.confirm
        f.said()
        self.begun = desk.answer(["upload", "--confirm-change", str(self.code)])
        f.fly(seconds=1.0)
        self.busy = desk.answer(["upload"]), desk.answer(["restore"]), desk.answer(["status"])
        f.fly(lambda: f.companion.job is None, 60.0)
        f.fly(seconds=2.0)
        self.sent = {line(m) for m in f.said()}
        self.uploaded = desk.news()
        self.new = [f.value(n) for n in _OFFSETS]
        self.other = desk.answer(["restore", "2"])
        self.dry_back = desk.answer(["restore", "--dry-run"]), desk.answer(["restore", "2", "--dry-run"])
        f.fly(seconds=2.0)
        self.quiet += self.sets()
        self.still = [f.value(n) for n in _OFFSETS]
        self.back = desk.answer(["restore"])
        f.fly(lambda: f.companion.job is None, 60.0)
        self.sent_back = {line(m) for m in f.said()}
        self.restored = desk.news()
        self.last = [f.value(n) for n in _OFFSETS]
        self.history = desk.answer(["history"]), desk.answer(["history", "1"]), desk.answer(["status"])
        f.end()
        self.unusable = desk.answer(["history"])

    def sets(self):
        return [m for m in self.f.said() if m.get_type() == "PARAM_SET" and m.param_id in _OFFSETS]


@pytest.fixture(scope="module")
def story(tmp_path_factory):
    return Story(tmp_path_factory.mktemp("desk"))


def test_before_a_vehicle_is_heard_every_command_says_so(story):
    for name in ("status", "upload", "restore"):
        assert story.before[name] == ["no vehicle yet: no autopilot's heartbeat was heard"]
    assert story.before["history"] == ["nothing was ever written"]


def test_status_tells_vehicle_and_compasses(story):
    head, compass = story.flying[0], story.flying[1]
    assert head.startswith("system 1, ArduPilot, armed, ")
    assert compass.startswith("compass 1 of system 1: ready, offsets x ")


def test_an_upload_before_anything_was_learnt_is_refused_in_words(story):
    real, dry = story.unready
    assert real[0].startswith("refused: ")
    assert dry[0].startswith("compass 1: nothing to write") or "not READY" in dry[0]


def test_S8_a_large_change_wants_the_code_and_the_console_names_it(story):
    answer, news = story.uncoded
    assert answer == []
    assert any(f"magmav upload 1 --confirm-change {story.code}" in line for line in news)
    assert any(str(story.code) in line for line in story.dry)
    assert story.quiet == []  # neither the dry run nor the refusal wrote anything


def test_the_dry_run_names_every_message_of_the_write_and_the_code_and_sends_none(story):
    said = {text.split(" (")[0] for text in story.dry}
    always = {"NAMED_VALUE_FLOAT"}  # the heading that goes out whether something is written or not
    assert story.sent - said <= always, sorted(story.sent - said)
    assert {text for text in said if text.startswith("PARAM_SET COMPASS_OFS")} <= story.sent
    assert {"HEARTBEAT", "PARAM_REQUEST_READ COMPASS_OFS_X"} <= said
    assert any(text.startswith("COMMAND_LONG MAV_CMD_SET_MESSAGE_INTERVAL RAW_IMU") for text in said)
    assert any(f"confirm with code {story.code}" in text for text in story.dry)
    assert story.quiet == []


def test_the_dry_run_of_a_restore_names_every_message_of_the_way_back_and_sends_none(story):
    dry, other = story.dry_back
    said = {text.split(" (")[0] for text in dry}
    assert story.sent_back - said <= {"NAMED_VALUE_FLOAT"}, sorted(story.sent_back - said)
    sets = {text for text in said if text.startswith("PARAM_SET")}
    assert sets == {f"PARAM_SET {n} {v!r}" for n, v in zip(_OFFSETS, story.old, strict=True)} <= story.sent_back
    assert not any("confirm with code" in text for text in dry)
    assert story.still == story.new and story.quiet == []
    assert other == [f"refused: {Reason.NO_SNAPSHOT.text}"] == story.other


def test_upload_and_restore_go_through_the_transaction(story):
    assert story.begun == ["compass 1: upload begun"]
    assert any("ALL_NEW" in line for line in story.uploaded)
    assert story.new != story.old
    assert story.back == ["compass 1: restore begun"]
    assert any("ALL_OLD" in line for line in story.restored)
    assert story.last == story.old
    assert story.other[0].startswith("refused: ")
    assert story.f.companion.confirm == story.confirm_before  # the code was for that one request


def test_while_a_write_runs_nothing_else_begins(story):
    upload, restore, status = story.busy
    assert upload == restore
    assert upload[0].startswith("a write is under way (compass 1: ")
    assert status[-1].startswith("compass 1: ")


def test_history_is_the_stores(story):
    whole, one, status = story.history
    assert len(whole) == 2
    assert whole[:1] == one
    assert "undo of 1 ALL_OLD" in whole[0]
    assert "upload ALL_NEW: COMPASS_OFS_X 0 to " in whole[1]
    assert status[-1].startswith("last write: compass 1: ALL_OLD")
    assert story.unusable == [f"{story.f.store.path}: the store is not open"]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["uplaod"], "there is no 'uplaod'"),
        (["upload", "4"], "upload: compass: want a whole number from 1 to 3, got '4'"),
        (["upload", "1", "2"], "upload: not understood: '2'"),
        (["upload", "--confirm-change"], "wants the code"),
        (["upload", "--confirm-change", "-5"], "got '-5'"),
        (["restore", "x"], "restore: compass: want a whole number from 1 to 3, got 'x'"),
        (["history", "0"], "history: want a whole number from 1 to 200, got '0'"),
        (["status", "now"], "status: not understood: 'now'"),
    ],
)
def test_a_command_that_is_not_understood_says_what_is_wrong_and_does_nothing(story, words, says):
    sent = len(story.f.link.sent)
    assert says in story.desk.answer(words)[0]
    assert len(story.f.link.sent) == sent


def test_help_names_every_command(story):
    assert story.desk.answer([]) == story.desk.answer(["help"]) == list(USAGE)
    assert set(USAGE) <= set(story.desk.answer(["no such"]))


def test_several_vehicles_and_none_chosen_is_said(tmp_path):
    f = Flight(staying(), tmp_path)
    desk = Desk(f.session, f.store)
    other = dialect.MAVLink(None, srcSystem=2, srcComponent=1)
    from magmav.link import Packet

    for _ in range(250):
        f.fly(seconds=0.02)
        beat = dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3).pack(other)
        f.service.turn(Packet(f.service.now_ns, bytes(beat), f.link.name))
    assert f.companion.presence.ambiguous == (1, 2)
    assert desk.answer(["upload"])[0].startswith("several vehicles (1, 2): ")
    f.end()


# ------------------------------------------------------------ the thread


def wait_for(plugin, text):
    """Lines up to and with the one that holds the text."""
    lines, end = [], time.monotonic() + _PATIENCE_S
    while time.monotonic() < end:
        lines += plugin.lines()
        if any(text in line for line in lines):
            return lines
        time.sleep(0.01)
    raise AssertionError(f"no {text!r} in {lines}")


def test_a_host_feeds_it_and_gets_answers_frames_and_last_words(tmp_path):
    plugin = Plugin(FedLink("host"), Settings(), world_magnetic_model, tmp_path / "s.sqlite")
    plugin.command(["status"])
    lines = wait_for(plugin, "no vehicle yet")
    assert lines[0] == "still loading; the answer follows"
    vehicle = dialect.MAVLink(None, srcSystem=9, srcComponent=1)
    reader, sent = dialect.MAVLink(None), []
    end = time.monotonic() + _PATIENCE_S
    answers = []
    while time.monotonic() < end and not any("system 9" in line for line in answers):
        plugin.link.push(bytes(dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3).pack(vehicle)), "host:1")
        sent += [m for data, _ in plugin.link.take() for m in reader.parse_buffer(data) or []]
        plugin.command(["status"])
        time.sleep(0.1)
        answers += plugin.lines()
    assert "system 9, ArduPilot, disarmed, host:1" in answers
    assert plugin.stop()
    sent += [m for data, _ in plugin.link.take() for m in reader.parse_buffer(data) or []]
    kinds = Counter(m.get_type() for m in sent)
    assert kinds["HEARTBEAT"] > 0
    assert {(m.get_srcSystem(), m.get_srcComponent()) for m in sent if m.get_type() == "COMMAND_LONG"} == {(9, 191)}
    plugin.command(["status"])
    assert plugin.lines()[-1] == "not running; load the module again"


def test_a_second_vehicle_is_said_and_the_one_the_host_speaks_to_is_served(tmp_path):
    plugin = Plugin(FedLink("host"), Settings(), world_magnetic_model, tmp_path / "s.sqlite")
    ends = {n: dialect.MAVLink(None, srcSystem=n, srcComponent=1) for n in (1, 2)}
    reader, sent = dialect.MAVLink(None), []

    def until(text, *systems):
        lines, end = [], time.monotonic() + _PATIENCE_S
        while time.monotonic() < end and not any(text in line for line in lines):
            for n in systems:
                plugin.vehicle(n)
                plugin.link.push(bytes(dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3).pack(ends[n])), f"host:{n}")
            sent.extend(m for data, _ in plugin.link.take() for m in reader.parse_buffer(data) or [])
            plugin.command(["status"])
            time.sleep(0.1)
            lines += plugin.lines()
        assert any(text in line for line in lines), lines
        return lines

    plugin.follow(1)  # as MAVProxy does with the first one it hears
    lines = until("system 1, ArduPilot", 1)
    assert not any("served" in line for line in lines)
    lines = until("also heard: system 2; only system 1 is served here", 1, 2)
    plugin.follow(2)
    lines = until("system 2, ArduPilot", 1, 2)
    assert "system 2 is served from here on; learning begins anew" in lines
    until("also heard: system 1; only system 2 is served here", 1, 2)
    assert plugin.stop()
    by = {m.get_srcSystem() for m in sent if m.get_type() == "COMMAND_LONG" and m.target_system == 2}
    assert by == {2}
    plugin = Plugin(
        FedLink("host"), with_value(Settings(), "vehicle", "system", 1), world_magnetic_model, tmp_path / "s.sqlite"
    )
    plugin.follow(2)
    assert not any("served from" in line for line in until("system 1, ArduPilot", 1, 2)), (
        "the settings file has said it"
    )
    assert plugin.stop()


def test_several_at_once_are_nobody_until_the_host_names_one(tmp_path):
    plugin = Plugin(FedLink("host"), Settings(), world_magnetic_model, tmp_path / "s.sqlite")
    ends = {n: dialect.MAVLink(None, srcSystem=n, srcComponent=1) for n in (1, 2)}
    lines, end = [], time.monotonic() + _PATIENCE_S
    while time.monotonic() < end and not any("system 1, ArduPilot" in line for line in lines):
        for n, mav in ends.items():
            plugin.link.push(bytes(dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3).pack(mav)), f"host:{n}")
        plugin.link.take()
        plugin.command(["status"])
        time.sleep(0.1)
        lines += plugin.lines()
        if any(line.startswith("several vehicles (1, 2): choose one") for line in lines):
            plugin.follow(1)
    assert any("system 1, ArduPilot" in line for line in lines), lines
    assert plugin.stop()


def test_a_store_that_cannot_be_opened_is_said_in_the_console(tmp_path):
    (tmp_path / "file").write_text("")
    plugin = Plugin(FedLink("host"), Settings(), world_magnetic_model, tmp_path / "file" / "s.sqlite")
    assert str(tmp_path / "file") in wait_for(plugin, "stopped: ")[-1]
    assert plugin.stop()


# ------------------------------------------------------------ the licence of the one file that imports MAVProxy


def test_only_the_shim_imports_mavproxy_and_nobody_imports_the_shim():
    imports = {}
    for path in [*(ROOT / "magmav").rglob("*.py"), *(ROOT / "sim").rglob("*.py")]:
        names = imports[path.relative_to(ROOT).as_posix()] = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names.update(alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                names.update({str(node.module), *(f"{node.module}.{alias.name}" for alias in node.names)})
    of_mavproxy = {name for name, got in imports.items() if any(n.partition(".")[0] == "MAVProxy" for n in got)}
    assert of_mavproxy == {"magmav/mavproxy.py"}
    assert [name for name, got in imports.items() if "magmav.mavproxy" in got] == []


def test_the_shim_bears_its_own_licence_and_no_other_file_does():
    spdx = "SPDX-License-Identifier: GPL"
    marked = [p for p in (ROOT / "magmav").rglob("*.py") if spdx in p.read_text()]
    assert marked == [ROOT / "magmav" / "mavproxy.py"]
    assert (ROOT / "magmav" / "mavproxy.py").read_text().startswith("# SPDX-License-Identifier: GPL-3.0-or-later\n")
    text = (ROOT / "LICENSES" / "GPL-3.0-or-later.txt").read_text()
    assert "GNU GENERAL PUBLIC LICENSE" in text
    assert "Version 3, 29 June 2007" in text
    assert 'license = "Apache-2.0 AND GPL-3.0-or-later"' in (ROOT / "pyproject.toml").read_text()
