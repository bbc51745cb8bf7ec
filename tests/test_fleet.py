"""Several vehicles on one link: each served as itself, none told what is not for it."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
from fleet_rig import Airspace, Craft, S, ground
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.fleet import GONE_NS, MOST
from magmav.link import Packet
from magmav.mavlink.budget import link_of
from magmav.settings import Settings, with_value


def kinds(messages: list) -> Counter[str]:
    return Counter(m.get_type() for m in messages)


def speakers(messages: list) -> set[tuple[int, int]]:
    return {(m.get_srcSystem(), m.get_srcComponent()) for m in messages}


def strays(messages: list, system: int) -> list:
    """What a vehicle was sent that is addressed to another, or comes from another's companion."""
    return [
        m for m in messages if getattr(m, "target_system", system) not in (0, system) or m.get_srcSystem() != system
    ]


def test_each_vehicle_has_its_own_companion_and_hears_nothing_of_the_others(tmp_path: Path) -> None:
    craft = [Craft(n, f"udp:{n}") for n in (1, 2, 7)]
    sky = Airspace(tmp_path, *craft)
    sky.push(ground(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)), "gcs")
    sky.run(80.0)  # one budget for all of them
    assert sorted(sky.fleet.members) == [1, 2, 7]
    for c in craft:
        heard = kinds(c.heard)
        assert strays(c.heard, c.system) == []
        assert speakers(c.heard) == {(c.system, 191)}
        assert 75 <= heard["HEARTBEAT"] <= 81 and heard["PARAM_REQUEST_READ"] > 20 and heard["COMMAND_LONG"] > 5
        assert sky.fleet.members[c.system].settled
        assert sky.service.pipeline.vehicles[c.system].calibrations.known(1)
    at_ground = sky.link.sent["gcs"]
    assert speakers(at_ground) == {(1, 191), (2, 191), (7, 191)}, "a ground station hears of all of them"
    assert {m.get_type() for m in at_ground} <= {"HEARTBEAT", "PARAM_VALUE", "STATUSTEXT", "NAMED_VALUE_FLOAT"}


def test_AT_9c_vehicles_behind_one_router_share_its_route_and_its_budget(tmp_path: Path) -> None:
    """Any ten seconds hold at most ten times 500 bytes, however many vehicles there are (AT-9c)."""
    craft = [Craft(n, "udp:router") for n in (1, 2, 3)]
    sky = Airspace(tmp_path, *craft)
    sky.run(40.0)
    sent = []
    for _ in range(300):
        before = len(sky.link.raw["udp:router"])
        sky.run(0.1)
        sent.append(sum(map(len, sky.link.raw["udp:router"][before:])))
    assert speakers(sky.link.sent["udp:router"]) == {(1, 191), (2, 191), (3, 191)}
    assert max(sum(sent[i : i + 100]) for i in range(200)) <= 5000
    assert all(m.settled for m in sky.fleet.members.values())


def busiest_ten_seconds(sky: Airspace, seconds: float) -> dict[str, int]:
    """By link: the most bytes that went out over all of its routes in any ten seconds."""
    sent: dict[str, list[int]] = {}
    for tick in range(round(seconds * 10)):
        before = {r: len(frames) for r, frames in sky.link.raw.items()}
        sky.run(0.1)
        for route, frames in sky.link.raw.items():
            at = sent.setdefault(link_of(route), [0] * round(seconds * 10))
            at[tick] += sum(map(len, frames[before.get(route, 0) :]))
    return {link: max(sum(at[i : i + 100]) for i in range(len(at) - 99)) for link, at in sent.items()}


@pytest.mark.parametrize(("links", "grounds"), [(("", "", "", ""), 3), (("0>", "0>", "1>", "2>"), 1)])
def test_AT_9c_all_routes_and_vehicles_of_a_link_stay_under_the_budget_together(
    tmp_path: Path, links: tuple[str, ...], grounds: int
) -> None:
    """Also while all is read, and a ground station lists; what cannot wait goes out all the same."""
    chosen = with_value(with_value(Settings(), "learn", "on", False), "attitude", "own", "complementary")
    craft = [Craft(n, f"{link}udp:{n}") for n, link in enumerate(links, 1)]
    sky = Airspace(tmp_path, *craft, settings=chosen)
    stations = [f"{links[-1]}gcs{n}" for n in range(grounds)]
    for route in stations:
        sky.push(ground(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)), route)
    sky.run(8.0)
    for system in (1, 2, 3, 4):
        sky.push(ground(dialect.MAVLink_param_request_list_message(system, 191)), stations[0])
    before = {r: len(m) for r, m in sky.link.sent.items()}
    most = busiest_ten_seconds(sky, 25.0)
    assert all(n <= 5000 for n in most.values()), most
    assert most[link_of(stations[0])] > 3500, "the budget is used"
    for route in stations:
        got = Counter((m.get_type(), m.get_srcSystem()) for m in sky.link.sent[route][before[route] :])
        assert all(24 <= got["HEARTBEAT", system] <= 26 for system in (1, 2, 3, 4))
        shares = [sum(n for (_, s), n in got.items() if s == system) for system in (1, 2, 3, 4)]
        assert min(shares) > 0.5 * max(shares), "none takes all"
    sky.push(ground(dialect.MAVLink_param_set_message(2, 191, b"MMAG_HDG_RATE", 7.0, 9)), stations[0])
    sky.run(0.1)
    last = [m for m in sky.link.sent[stations[0]][-20:] if m.get_type() == "PARAM_VALUE"]
    assert [m.param_value for m in last if m.param_id == "MMAG_HDG_RATE"][-1:] == [7.0], "a SET is echoed at once"


def test_a_question_to_one_is_answered_by_that_one_on_the_askers_route(tmp_path: Path) -> None:
    sky = Airspace(tmp_path, Craft(1, "udp:1"), Craft(2, "udp:2"))
    sky.run(8.0)
    before = {r: len(m) for r, m in sky.link.sent.items()}
    read = dialect.MAVLink_param_request_read_message(2, 191, b"MMAG_RESULT", -1)
    sky.push(ground(read), "gcs")
    sky.push(ground(dialect.MAVLink_command_long_message(1, 191, 520, 0, 0, 0, 0, 0, 0, 0, 0)), "gcs")
    sky.run(0.5)
    new = {r: m[before.get(r, 0) :] for r, m in sky.link.sent.items()}
    values = [m for m in new["gcs"] if m.get_type() == "PARAM_VALUE"]
    assert [(m.get_srcSystem(), m.param_id) for m in values] == [(2, "MMAG_RESULT")]
    acks = [m for m in new["gcs"] if m.get_type() == "COMMAND_ACK"]
    assert [(m.get_srcSystem(), m.target_system, m.command) for m in acks] == [(1, 255, 520)]
    assert not {"PARAM_VALUE", "COMMAND_ACK"} & {m.get_type() for r in ("udp:1", "udp:2") for m in new[r]}


@pytest.mark.parametrize("target", [(3, 191), (3, 0), (1, 1), (1, 154), (2, 1)])
def test_S13_nothing_addressed_to_others_is_answered(tmp_path: Path, target: tuple[int, int]) -> None:
    sky = Airspace(tmp_path, Craft(1, "udp:1"), Craft(2, "udp:2"))
    sky.run(8.0)
    for message in (
        dialect.MAVLink_param_request_list_message(*target),
        dialect.MAVLink_param_request_read_message(*target, b"MMAG_RESULT", -1),
        dialect.MAVLink_param_set_message(*target, b"MMAG_HDG_RATE", 7.0, 9),
        dialect.MAVLink_command_long_message(*target, 520, 0, 0, 0, 0, 0, 0, 0, 0),
        dialect.MAVLink_ping_message(1, 1, *target),
        dialect.MAVLink_file_transfer_protocol_message(0, *target, [0] * 251),
    ):
        sky.push(ground(message), "gcs")
    sky.run(1.0)
    assert {m.get_type() for m in sky.link.sent["gcs"]} == {"HEARTBEAT"}
    assert {m.settings.wire.heading_hz for m in sky.fleet.members.values()} == {Settings().wire.heading_hz}


def test_what_is_said_to_all_on_a_vehicles_route_is_for_that_vehicle(tmp_path: Path) -> None:
    sky = Airspace(tmp_path, Craft(1, "udp:1"), Craft(2, "udp:2"))
    sky.run(8.0)
    for route, answers in (("udp:1", [1]), ("udp:2", [2]), ("gcs", [1, 2])):
        before = len(sky.link.sent[route])
        sky.push(ground(dialect.MAVLink_ping_message(7, 7, 0, 0)), route)
        got = [m.get_srcSystem() for m in sky.link.sent[route][before:] if m.get_type() == "PING"]
        assert sorted(got) == answers, route


def test_a_setting_of_one_vehicle_is_not_the_others(tmp_path: Path) -> None:
    sky = Airspace(tmp_path, Craft(1, "udp:1"), Craft(2, "udp:2"))
    sky.run(8.0)
    sky.push(ground(dialect.MAVLink_param_set_message(2, 191, b"MMAG_LEARN", 0.0, 9)), "udp:2")
    sky.run(2.0)
    vehicles = sky.service.pipeline.vehicles
    assert (vehicles[1].learning, vehicles[2].learning) == (True, False)
    sky.store.close()
    again = Airspace(tmp_path, Craft(1, "udp:1"), Craft(2, "udp:2"))
    again.run(8.0)
    vehicles = again.service.pipeline.vehicles
    assert (vehicles[1].learning, vehicles[2].learning) == (True, False), "kept for that vehicle over a restart"


def test_a_named_system_alone_is_served(tmp_path: Path) -> None:
    only = with_value(Settings(), "vehicle", "system", 2)
    craft = Craft(1, "udp:1"), Craft(2, "udp:2")
    sky = Airspace(tmp_path, *craft, settings=only)
    sky.run(8.0)
    assert sorted(sky.fleet.members) == [2] and sorted(sky.service.pipeline.vehicles) == [2]
    assert strays(craft[1].heard, 2) == []
    assert craft[0].heard == [] or sky.link.sent["udp:1"] == craft[0].heard
    late = [m for m in sky.link.sent["udp:1"] if m.get_type() != "HEARTBEAT"]
    assert late == [] and len(sky.link.sent["udp:1"]) <= 1, "one heartbeat may go out before anybody was heard"


def test_one_command_for_one_vehicle_says_nothing_to_the_other(tmp_path: Path) -> None:
    """The single companion of `magmav upload --system 2`, on a socket that also has vehicle 1."""
    chosen = with_value(Settings(), "vehicle", "system", 2)
    craft = Craft(1, "udp:1"), Craft(2, "udp:2")
    sky = Airspace(tmp_path, *craft, settings=chosen, single=True)
    sky.run(8.0)
    assert kinds(craft[1].heard)["PARAM_REQUEST_READ"] > 20
    assert len(sky.link.sent["udp:1"]) <= 1


def test_silent_vehicles_are_forgotten_and_come_back_fresh(tmp_path: Path) -> None:
    one, two = Craft(1, "udp:1"), Craft(2, "udp:2")
    sky = Airspace(tmp_path, one, two)
    sky.run(8.0)
    held = sky.service.pipeline.vehicles[2]
    two.talks = False
    seconds = GONE_NS // S
    for _ in range(seconds - 20):  # once a second will do while nothing happens
        sky.ms += 1000
        sky.push(one.heartbeat(), "udp:1")
    assert sky.service.pipeline.vehicles[2] is held, "behind a hill"
    for _ in range(40):
        sky.ms += 1000
        sky.push(one.heartbeat(), "udp:1")
    assert sorted(sky.fleet.members) == [1] and sorted(sky.service.pipeline.vehicles) == [1]
    assert sky.fleet.counts["forgotten"] == 1
    two.talks = True
    sky.ms -= sky.ms % 1000
    sky.run(5.0)
    assert sorted(sky.fleet.members) == [1, 2] and sky.service.pipeline.vehicles[2] is not held


def test_made_up_vehicles_are_capped_and_make_room_when_silent(tmp_path: Path) -> None:
    sky = Airspace(tmp_path)
    for system in range(1, 255):
        sky.push(Craft(system, "udp:x").heartbeat(), "udp:x")
    assert len(sky.fleet.members) == MOST
    assert sky.fleet.counts["too many vehicles"] == 254 - MOST
    sky.ms += 61_000
    sky.push(Craft(250, "udp:x").heartbeat(), "udp:x")
    assert 250 in sky.fleet.members and len(sky.fleet.members) == MOST


def test_before_anybody_is_heard_a_heartbeat_goes_out_and_then_no_more_from_nobody(tmp_path: Path) -> None:
    craft = Craft(5, "udp:5")
    craft.talks = False
    sky = Airspace(tmp_path, craft)
    sky.push(b"anybody there?", "udp:5")
    sky.run(5.0)
    first = kinds(sky.link.sent["udp:5"])
    assert set(first) == {"HEARTBEAT"} and 5 <= first["HEARTBEAT"] <= 6
    craft.talks = True
    sky.run(5.0)
    late = sky.link.sent["udp:5"][first["HEARTBEAT"] :]
    assert speakers(late) == {(5, 191)}


def test_every_write_is_unicast_and_nothing_addressed_goes_to_all(tmp_path: Path) -> None:
    sky = Airspace(tmp_path, Craft(1, "udp:1"), Craft(2, "udp:2"))
    sky.push(ground(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)), "gcs")
    sky.run(20.0)
    assert sky.link.sent["gcs"] and [m for m in sky.link.sent["gcs"] if getattr(m, "target_system", 0)] == []
    from magmav.mavlink.codec import Outgoing

    write = dialect.MAVLink_param_set_message(1, 1, b"COMPASS_OFS_X", 5.0, 9)
    sizes = {r: len(m) for r, m in sky.link.sent.items()}
    sky.service._send([Outgoing(write, "", (1, 191)), Outgoing(write, "udp:2", (1, 191))])
    assert {r: len(m) for r, m in sky.link.sent.items()} == sizes
    assert sky.service.counts()["not sent"] == {"no route": 1, "not for it": 1}
    sky.service._send([Outgoing(write, "udp:1", (1, 191))])
    assert len(sky.link.sent["udp:1"]) == sizes["udp:1"] + 1


def test_leaving_gives_each_vehicle_its_own_intervals_back(tmp_path: Path) -> None:
    craft = Craft(1, "udp:1"), Craft(2, "udp:2")
    sky = Airspace(tmp_path, *craft)
    sky.run(20.0)
    before = {c.route: len(sky.link.sent[c.route]) for c in craft}
    sky.service.leave()
    for c in craft:
        last = sky.link.sent[c.route][before[c.route] :]
        assert {m.get_type() for m in last} == {"COMMAND_LONG"} and len(last) >= 5
        assert {(m.get_srcSystem(), m.target_system, m.param2) for m in last} == {(c.system, c.system, 0.0)}


def test_a_packet_costs_one_vehicle_not_all(tmp_path: Path) -> None:
    """With fifty vehicles the others are looked after by time, not by packet."""
    craft = [Craft(n, f"udp:{n}") for n in range(1, 51)]
    sky = Airspace(tmp_path, *craft)
    for c in craft:
        sky.push(c.heartbeat(), c.route)
    polls: Counter[int] = Counter()
    for system, member in sky.fleet.members.items():
        inner = member.poll

        def poll(now_ns: int, system: int = system, inner=inner):
            polls[system] += 1
            return inner(now_ns)

        member.poll = poll
    sky.service.turn(Packet(sky.now_ns, b"", ""))
    polls.clear()
    for n in range(1000):
        sky.push(craft[0].imu(n), "udp:1")
    assert polls[1] == 1000 and sum(polls.values()) <= 1050
