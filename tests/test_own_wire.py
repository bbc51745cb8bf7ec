"""Our own parameters and manners on a whole companion with a simulated vehicle: choices, files, storms, rates."""

from __future__ import annotations

import json
import lzma
from itertools import pairwise

import numpy as np
import pytest
from flight_rig import Flight, error_mg, observed, ready, staying
from ftp_client import HEAD, parsed
from magmav_sim.link import ROUTE
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.link import Packet
from magmav.mavlink.metadata import ID
from magmav.own_params import entries
from magmav.settings import Settings, with_value

S = 1_000_000_000
IDS = {kind.msgname: number for number, kind in dialect.mavlink_map.items()}


def meet(folder, settings=None):
    f = Flight(staying(), folder, settings=settings)
    assert f.fly(lambda: f.companion.settled, 40.0)
    f.said()
    return f


def values(f, name):
    return [m.param_value for m in f.said() if m.get_type() == "PARAM_VALUE" and m.param_id == name]


def sizes(f, from_ns=0):
    return [(s.t_ns, len(s.data)) for s in f.link.sent if s.t_ns >= from_ns]


def most_in_ten_seconds(frames):
    best, start, total = 0, 0, 0
    for t_ns, size in frames:
        total += size
        while t_ns - frames[start][0] >= 10 * S:
            total -= frames[start][1]
            start += 1
        best = max(best, total)
    return best


def test_a_choice_of_flight_outlives_the_process_and_a_later_configuration_wins(tmp_path):
    f = meet(tmp_path)
    for name, number in (("MMAG_GATE_RES", 42.5), ("MMAG_LEARN", 0.0), ("MMAG_GATE_N", 250.0), ("MMAG_SMOOTH", 1.0)):
        f.set(name, number)
        assert values(f, name) == [number]
        f.fly(seconds=1.1)
    f.store.close()  # no last words: as after a kill
    again = meet(tmp_path)
    got = again.companion.settings
    assert (got.gate.residual_mg, got.learn.on, got.gate.samples, got.heading.smooth) == (42.5, False, 250, "kalman")
    assert again.session.pipeline.vehicles[1].settings is got or not again.session.pipeline.vehicles[1].learning
    again.operator(dialect.MAVLink_param_request_read_message(1, 191, b"MMAG_GATE_RES", -1))
    again.fly(seconds=2.0)
    assert values(again, "MMAG_GATE_RES") == [42.5]
    again.end()
    edited = with_value(Settings(), "gate", "residual_mg", 20.0)
    third = meet(tmp_path, edited)
    assert third.companion.settings.gate.residual_mg == 20.0 and not third.companion.settings.learn.on
    third.end()


def test_every_setting_takes_hold_in_flight(tmp_path):
    f = meet(tmp_path)
    f.fly(seconds=3.0)
    f.said()
    f.set("MMAG_IMU_HZ", 50.0)
    f.set("MMAG_SLOW_HZ", 0.0)
    f.fly(seconds=12.0)
    asked = {round(m.param1): m.param2 for m in f.said() if m.get_type() == "COMMAND_LONG"}
    assert asked[IDS["RAW_IMU"]] == 20_000 and asked[IDS["VFR_HUD"]] == asked[IDS["BATTERY_STATUS"]] == 0.0
    assert IDS["ATTITUDE"] not in asked, "what did not change is not asked for again"
    f.set("MMAG_GATE_STDY", 33.0)
    f.set("MMAG_BUDGET", 150.0)
    f.set("MMAG_COACH", 1.0)
    f.fly(seconds=1.0)
    flown = f.session.pipeline.vehicles[1]
    assert {c.steady_s for c in flown.channels.values()} == {33.0} and f.companion.settings.coach.say
    f.fly(seconds=10.0)
    began_ns = f.sim.elapsed_ns
    f.operator(dialect.MAVLink_param_request_list_message(1, 0))
    f.fly(seconds=30.0)
    assert most_in_ten_seconds(sizes(f, began_ns)) <= 1500
    f.end()


def test_limits_hold_on_the_wire_and_a_refusal_says_the_old_value(tmp_path):
    f = meet(tmp_path)
    own = {e.name: e for e in entries(f.companion, lambda: 0)}
    for name, entry in own.items():
        about = entry.about
        if entry.set is None or entry.trigger or about.default is None:
            continue
        for bad in (about.low - 1.0, about.high * 1.1 + 1.0):
            before = entry.get()
            f.set(name, bad)
            said = f.said()
            (value,) = [m for m in said if m.get_type() == "PARAM_VALUE"]
            (error,) = [m for m in said if m.get_type() == "PARAM_ERROR"]
            assert value.param_value == pytest.approx(before) and error.error == 2, name
            f.fly(seconds=0.5)
            f.said()
    assert repr(f.companion.settings) == repr(Settings())
    f.end()


def ftp(opcode, sequence, data=b"", size=-1, offset=0):
    n = len(data) if size < 0 else size
    head = sequence.to_bytes(2, "little") + bytes((0, opcode, n, 0, 0, 0)) + offset.to_bytes(4, "little")
    return dialect.MAVLink_file_transfer_protocol_message(0, 1, 191, list((head + data).ljust(239 + HEAD, b"\0")))


def download(f, path, sequence):
    """By bursts, one answer at a time."""

    def ask(message):
        f.operator(message)
        got = []

        def arrived():
            got.extend(parsed(bytes(m.payload)) for m in f.said() if m.get_type() == "FILE_TRANSFER_PROTOCOL")
            return bool(got)

        assert arrived() or f.fly(arrived, 5.0)
        return got[0]

    size = int.from_bytes(ask(ftp(4, sequence, path)).data, "little")
    out = b""
    while len(out) < size:
        sequence += 1
        out += ask(ftp(15, sequence, size=239, offset=len(out))).data
    assert ask(ftp(1, sequence + 1)).opcode == 128
    return out


def test_AT_9c_metadata_is_read_end_to_end_beside_the_usual_traffic_in_500_bytes_a_second(tmp_path):
    f = meet(tmp_path)
    f.fly(seconds=20.0)
    f.said()
    began_ns = f.sim.elapsed_ns
    f.operator(dialect.MAVLink_command_long_message(1, 191, 512, 0, ID, *(0,) * 6))
    frames = [s.data for s in f.link.sent if s.t_ns >= began_ns]
    assert any(int.from_bytes(d[7:10], "little") == ID and b"mftp://general.json" in d for d in frames)
    f.said()
    general = json.loads(download(f, b"general.json", 0))
    path = general["metadataTypes"][0]["uri"].removeprefix("mftp://").encode()
    said = json.loads(lzma.decompress(download(f, path, 100)))
    assert [row["name"] for row in said["parameters"]] == [e.name for e in entries(f.companion, lambda: 0)]
    assert (f.sim.elapsed_ns - began_ns) / S < 30.0
    assert most_in_ten_seconds(sizes(f, began_ns)) <= 5000
    f.end()


def test_S14_a_parameter_storm_stays_in_the_budget_and_learning_goes_on(tmp_path):
    f = meet(tmp_path)
    assert f.fly(lambda: f.sim.autopilot.armed, 60.0)
    began_ns, records = f.sim.elapsed_ns, len(f.records)
    for n in range(1000):
        f.operator(dialect.MAVLink_param_request_list_message(1, n % 2 * 191))
        f.set("MMAG_HDG_RATE", float(n % 7))
        f.operator(dialect.MAVLink_param_request_read_message(1, 191, b"", n % 50))
        f.fly(seconds=0.02)
    f.set("MMAG_HDG_RATE", 2.0)
    f.fly(seconds=20.0)
    assert most_in_ten_seconds(sizes(f, began_ns)) <= 5000 + 2 * 500 + 100
    assert sum(n for _, n in sizes(f, began_ns)) <= 40 * 500 + 1000
    assert len(f.records) - records > 250
    f.said()
    f.operator(dialect.MAVLink_param_request_list_message(1, 191))
    f.fly(seconds=20.0)
    assert {m.param_index for m in f.said() if m.get_type() == "PARAM_VALUE"} == set(
        range(len(entries(f.companion, int)))
    )
    f.end()


def test_a_trigger_over_another_route_is_refused_and_said(tmp_path):
    f = meet(tmp_path)

    def over(route, name, value):
        message = dialect.MAVLink_param_set_message(1, 191, name.encode(), value, 9)
        data = bytes(message.pack(dialect.MAVLink(None, srcSystem=255, srcComponent=190)))
        f.service.turn(Packet(f.service.now_ns, data, route))
        f.fly(seconds=0.5)
        return f.said()

    for name in ("MMAG_UPLOAD", "MMAG_RESTORE", "MMAG_CONFIRM"):
        said = over("udp:10.0.0.9:14550", name, 1.0)
        assert [m.param_value for m in said if m.get_type() == "PARAM_VALUE" and m.param_id == name] == [0.0]
        assert [m.error for m in said if m.get_type() == "PARAM_ERROR"] == [dialect.MAV_PARAM_ERROR_PERMISSION_DENIED]
        assert any(f"refused {name}" in m.text for m in said if m.get_type() == "STATUSTEXT")
        assert f.companion.result == 0.0 and f.companion.confirm == 0.0
    said = over(ROUTE, "MMAG_UPLOAD", 1.0)
    assert [m.param_value for m in said if m.get_type() == "PARAM_VALUE" and m.param_id == "MMAG_UPLOAD"] == [1.0]
    assert f.companion.result < 0.0, "taken, and refused for its own reason: nothing is learnt yet"
    f.end()


def test_AT_9b_another_station_sets_two_hertz_in_mid_run_and_the_answer_still_comes(tmp_path):
    """Every 30 s, as a ground station does: asked for again, none twice within 10 s, and still ready and right."""
    f = meet(tmp_path)
    assert f.fly(lambda: f.sim.autopilot.armed, 60.0)
    f.said()
    began_ns = f.sim.elapsed_ns
    station = dialect.MAVLink(None, srcSystem=254, srcComponent=190)
    stomp = [dialect.MAVLink_request_data_stream_message(1, 1, group, 2, 1) for group in (1, 2, 3, 6, 10, 11, 12)]
    stomped = 0
    while f.sim.autopilot.armed and f.sim.elapsed_ns - began_ns < 120 * S:
        for message in stomp:
            f.link._link.send(bytes(message.pack(station)))
        stomped += 1
        f.fly(lambda: not f.sim.autopilot.armed, 30.0)
    mav = dialect.MAVLink(None)
    requests = [
        (s.t_ns, round(m.param1))
        for s in f.link.sent
        if s.t_ns > began_ns
        for m in (mav.parse_buffer(s.data) or [])
        if m.get_type() == "COMMAND_LONG" and m.command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL
    ]
    assert stomped >= 2 and IDS["RAW_IMU"] in {i for _, i in requests}
    for number in {i for _, i in requests}:
        times = [t for t, i in requests if i == number]
        assert all(b - a >= 9.99 * S for a, b in pairwise(times)), number
    f.fly(seconds=3.0)
    last = next(r for r in reversed(f.records) if ready(r))
    assert np.all(np.abs(error_mg(f.sim, last))[observed(last)] <= 15.0)
    f.end()
