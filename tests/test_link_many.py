"""Several links as one: order, routes, sending, ending; and a vehicle that is heard on two of them."""

from __future__ import annotations

import socket
from collections import Counter
from pathlib import Path

import pytest
from fleet_rig import Craft
from memory_flight import earth_model
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.fleet import serve
from magmav.link import LinkError, Packet
from magmav.link.many import ManyLinks, open_links
from magmav.link.memory import SetClock, memory_pair
from magmav.link.open import open_link
from magmav.settings import Settings
from magmav.store import Store


def pairs(count: int, clock: SetClock, datagrams: tuple[bool, ...] = ()):
    made = [
        memory_pair(clock, names=(f"here{n}", f"there{n}"), datagrams=(datagrams or (True,) * count)[n])
        for n in range(count)
    ]
    return [h for h, _ in made], [t for _, t in made]


def test_packets_of_all_links_come_with_routes_told_apart() -> None:
    clock = SetClock(10**9)
    here, there = pairs(3, clock)
    many = ManyLinks(here)
    packets = many.packets()
    there[2].send(b"two")
    there[0].send(b"zero")
    got = [next(packets), next(packets)]
    assert {(p.route, p.data) for p in got} == {("0>there0", b"zero"), ("2>there2", b"two")}
    assert next(packets) == Packet(10**9, b"", "")
    assert many.routes == ("0>there0", "1>there1", "2>there2")


def test_a_route_is_sent_to_alone_and_an_empty_one_to_all() -> None:
    clock = SetClock(10**9)
    here, there = pairs(2, clock)
    many, ends = ManyLinks(here), [t.packets() for t in there]
    many.send(b"one", "1>there1")
    many.send(b"all")
    assert [next(ends[0]).data for _ in range(2)] == [b"all", b""]
    assert [next(ends[1]).data for _ in range(3)] == [b"one", b"all", b""]
    for nowhere in ("there1", "7>there1", "x>there1", ">", "1>there0"):
        many.send(b"lost", nowhere)
    assert many.counts["not sent"] == 5 and [next(e).data for e in ends] == [b"", b""]


def test_streams_and_datagrams_side_by_side_are_each_cut_their_own_way(tmp_path: Path) -> None:
    """Half a frame over a stream waits for its rest, while whole ones come over the other link."""
    clock = SetClock(10**9)
    here, there = pairs(2, clock, (False, True))
    many = ManyLinks(here)
    assert (many.whole("0>there0"), many.whole("1>there1"), many.whole("9>x")) == (False, True, False)
    with Store(tmp_path / "m.sqlite") as store:
        service = serve(many, Settings(), earth_model, store)
        packets, one, two = many.packets(), Craft(1, ""), Craft(2, "")
        frame = one.heartbeat()
        for part in (frame[:7], frame[7:]):
            there[0].send(part)
            there[1].send(two.heartbeat())
            for _ in range(3):
                service.turn(next(packets))
        assert sorted(service.companion.members) == [1, 2]
        assert service.heard["HEARTBEAT"] == 3


def test_it_ends_with_its_last_link_and_close_closes_all() -> None:
    clock = SetClock(0)
    here, _ = pairs(2, clock)
    many = ManyLinks(here)
    packets = many.packets()
    next(packets)
    here[0].close()
    assert next(packets).data == b""
    many.close()
    assert list(packets) == []
    with pytest.raises(ValueError, match="at least one"):
        ManyLinks([])


def udp(port: int = 0) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(("127.0.0.1", port))
    sock.settimeout(5.0)
    return sock


def test_sockets_one_busy_one_quiet_and_both_answered() -> None:
    link = open_links(["udpin:127.0.0.1:0", "udpin:127.0.0.1:0"])
    assert isinstance(link, ManyLinks)
    busy, quiet = udp(), udp()
    try:
        ports = [one.port for one in link.links]
        packets = link.packets()
        for n in range(300):
            busy.sendto(b"%d" % n, ("127.0.0.1", ports[0]))
        quiet.sendto(b"me too", ("127.0.0.1", ports[1]))
        got = []
        while len(got) < 301:
            packet = next(packets)
            got += [packet] if packet.data else []
        assert [p.data for p in got if p.route.startswith("0>")] == [b"%d" % n for n in range(300)]
        assert [p.data for p in got].index(b"me too") < 10, "not behind the busy one's three hundred"
        assert [p.t_ns for p in got] == sorted(p.t_ns for p in got)
        route = next(p.route for p in got if p.data == b"me too")
        link.send(b"you", route)
        assert quiet.recv(100) == b"you"
        link.send(b"all")
        assert (busy.recv(100), quiet.recv(100)) == (b"all", b"all")
        # The same peer on both ports has a route on each.
        busy.sendto(b"again", ("127.0.0.1", ports[1]))
        packet = next(p for p in packets if p.data)
        assert packet.route.startswith("1>") and packet.route[2:] == got[0].route[2:]
    finally:
        link.close()
        busy.close()
        quiet.close()


class Scripted:
    """A link with a descriptor that is always, or never, readable; every look moves its time by 5 ms."""

    datagrams, unix_offset_ns = True, 0

    def __init__(self, name: str, clock: SetClock, busy: bool) -> None:
        self.name, self.clock, self.busy = name, clock, busy
        self.counts: Counter[str] = Counter()
        self.mine, self.other = socket.socketpair()
        if busy:
            self.other.send(b"x")

    def fileno(self) -> int:
        return self.mine.fileno()

    def packets(self):
        while True:
            self.counts[f"looks at {self.name}"] += 1
            self.clock.advance(0.005 if self.busy else 0.0)
            yield Packet(self.clock(), b"data" if self.busy else b"", self.name if self.busy else "")

    def send(self, data: bytes, route: str = "") -> None:
        pass

    def close(self) -> None:
        self.mine.close()
        self.other.close()


def test_a_busy_link_never_keeps_a_quiet_one_from_being_looked_after() -> None:
    clock = SetClock(10**9)
    many = ManyLinks([Scripted("busy", clock, True), Scripted("quiet", clock, False)])
    packets = many.packets()
    got = [next(packets) for _ in range(200)]
    assert all(p.data for p in got)
    assert 40 <= many.counts["looks at quiet"] <= 60, "every 20 ms of a second"
    many.close()


def test_one_text_is_that_link_and_a_bad_one_leaves_none_open() -> None:
    one = open_links(["udpin:127.0.0.1:0"])
    assert not isinstance(one, ManyLinks)
    one.close()
    with udp() as free:
        port = free.getsockname()[1]
    with pytest.raises(LinkError, match="nonsense"):
        open_links([f"udpin:127.0.0.1:{port}", "nonsense:1:2"])
    with pytest.raises(LinkError, match="taken"):
        open_links([f"udpin:127.0.0.1:{port}"] * 2)
    again = open_link(f"udpin:127.0.0.1:{port}")
    again.close()


def test_the_same_vehicle_on_two_links_is_pinned_to_one_and_moves_only_after_silence(tmp_path: Path) -> None:
    clock = SetClock(10**9)
    here, there = pairs(2, clock)
    many = ManyLinks(here)
    craft = Craft(1, "")
    with Store(tmp_path / "m.sqlite") as store:
        records = []
        watch = (lambda reading, record: None if record is None else records.append(record),)
        service = serve(many, Settings(), earth_model, store, watch)
        packets, ends = many.packets(), [t.packets() for t in there]
        sent: list[list] = [[], []]
        parser = dialect.MAVLink(None)

        def tenth(n: int, *links: int) -> None:
            clock.advance(0.1)
            for frame in craft.talk(n * 100):
                for link in links:
                    there[link].send(frame)
            for _ in range(3 * len(links) + 2):
                service.turn(next(packets))
            for k, end in enumerate(ends):
                while data := next(end).data:
                    sent[k] += parser.parse_buffer(data) or []

        for n in range(100):
            tenth(n, 1, 0) if n else tenth(n, 1)
        member = service.companion.members[1]
        assert member.presence.autopilot.pin == (1, 1, "1>there1") and member.presence.second_route == "0>there0"
        heard_once = len(records)
        assert heard_once <= 101, "each field once, though it came twice"
        asked = [[m for m in s if getattr(m, "target_system", 0)] for s in sent]
        assert asked[0] == [] and len(asked[1]) > 20, "what is asked of it goes over the pinned link alone"
        for n in range(100, 130):
            tenth(n, 0)
        assert len(records) == heard_once and member.presence.autopilot.route == "1>there1"
        for n in range(130, 190):
            tenth(n, 0)
        assert member.presence.autopilot.route == "0>there0" and len(records) > heard_once
        asked = [[m for m in s if getattr(m, "target_system", 0)] for s in sent]
        assert len(asked[0]) > 5
