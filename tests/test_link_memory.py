"""The pair in memory, and bad weather around it: order, time, and the same damage for the same seed."""

from __future__ import annotations

from itertools import islice

import pytest

from magmav.link import Packet
from magmav.link.damage import Lossy
from magmav.link.memory import MemoryLink, SetClock, memory_pair


def taken(link: MemoryLink | Lossy, count: int) -> list[Packet]:
    return list(islice(link.packets(), count))


def test_what_one_end_sends_the_other_yields_in_order_at_the_clocks_time() -> None:
    clock = SetClock(5)
    here, there = memory_pair(clock, names=("companion", "vehicle"), unix_offset_ns=100)
    here.send(b"one")
    here.send(b"two", "vehicle")
    turns = there.packets()
    assert next(turns) == Packet(5, b"one", "companion")
    clock.advance(1.5)
    assert next(turns) == Packet(1_500_000_005, b"two", "companion")
    assert next(turns) == Packet(1_500_000_005, b"", "")
    there.send(b"back")
    assert taken(here, 2) == [Packet(1_500_000_005, b"back", "vehicle"), Packet(1_500_000_005, b"", "")]
    assert here.unix_offset_ns == there.unix_offset_ns == 100 and here.datagrams and not here.counts


def test_what_can_reach_nobody_is_counted() -> None:
    here, there = memory_pair(SetClock())
    here.send(b"x", "somebody else")
    there.close()
    here.send(b"x")
    assert here.counts["not sent"] == 2 and taken(here, 1) == [Packet(0, b"", "")]
    assert list(there.packets()) == []


def test_bytes_sent_are_a_copy() -> None:
    here, there = memory_pair(SetClock())
    buffer = bytearray(b"before")
    here.send(buffer)
    buffer[:] = b"after!"
    assert taken(there, 1)[0].data == b"before"


def test_a_reader_that_never_reads_does_not_fill_the_memory() -> None:
    here, there = memory_pair(SetClock())
    for _ in range(70_000):
        here.send(b"x")
    assert here.counts["dropped sends"] == 70_000 - 65_536
    assert sum(bool(p.data) for p in taken(there, 70_000)) == 65_536


def test_time_and_names_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="seconds"):
        SetClock().advance(-1.0)
    with pytest.raises(ValueError, match="names"):
        memory_pair(SetClock(), names=("a", "a"))


# ---------------------------------------------------------------- bad weather


def numbered(count: int) -> list[bytes]:
    return [i.to_bytes(8, "big") for i in range(count)]


def heard(seed: int, count: int = 2000, **rates: float) -> tuple[list[bytes], Lossy]:
    """What a reader behind bad weather gets of ``count`` packets."""
    here, there = memory_pair(SetClock())
    for data in numbered(count):
        here.send(data)
    lossy = Lossy(there, seed, **rates)
    return [p.data for p in taken(lossy, 2 * count + 10) if p.data], lossy


def told(seed: int, count: int = 2000, **rates: float) -> list[bytes]:
    """What arrives of ``count`` sends into bad weather."""
    here, there = memory_pair(SetClock())
    lossy = Lossy(here, seed, **rates)
    for data in numbered(count):
        lossy.send(data)
    taken(lossy, 1)
    return [p.data for p in taken(there, 2 * count + 10) if p.data]


def test_without_rates_nothing_changes() -> None:
    assert heard(1)[0] == told(1) == numbered(2000)


def test_the_same_seed_gives_the_same_weather_and_each_direction_its_own() -> None:
    rates = {"drop": 0.1, "duplicate": 0.05, "reorder": 0.1, "flip": 0.05}
    assert heard(7, **rates)[0] == heard(7, **rates)[0]
    assert told(7, **rates) == told(7, **rates)
    assert heard(7, **rates)[0] != heard(8, **rates)[0]
    assert heard(7, **rates)[0] != told(7, **rates)


@pytest.mark.parametrize("way", [lambda **rates: heard(3, **rates)[0], lambda **rates: told(3, **rates)])
def test_each_rate_does_its_own_damage_and_no_other(way: object) -> None:
    assert callable(way)
    all_of = numbered(2000)
    dropped = way(drop=0.1)
    assert dropped == [d for d in all_of if d in set(dropped)] and 1740 < len(dropped) < 1860
    twice = way(duplicate=0.1)
    assert sorted(set(twice)) == all_of and 2140 < len(twice) < 2260 and twice == sorted(twice)
    mixed = way(reorder=0.1)
    moved = sum(a != b for a, b in zip(mixed, all_of, strict=True))
    assert sorted(mixed) == all_of and 250 < moved < 500
    assert all(abs(mixed.index(d) - i) <= 1 for i, d in enumerate(all_of[:300]))
    hurt = way(flip=0.1)
    bits = [(int.from_bytes(a) ^ int.from_bytes(b)).bit_count() for a, b in zip(hurt, all_of, strict=True)]
    assert set(bits) == {0, 1} and 140 < sum(bits) < 260


def test_everything_dropped_still_lets_time_pass() -> None:
    clock = SetClock()
    here, there = memory_pair(clock)
    lossy = Lossy(there, 1, drop=1.0)
    turns = lossy.packets()
    for _ in range(3):
        here.send(b"x")
        clock.advance(1.0)
        assert next(turns) == Packet(clock.now_ns, b"", "")
    assert lossy.counts["weather: drop"] == 3
    lossy.close()
    assert list(turns) == [] and list(there.packets()) == []


def test_what_is_held_back_comes_out_with_the_next_quiet_tick() -> None:
    clock = SetClock()
    here, there = memory_pair(clock)
    lossy = Lossy(there, 1, reorder=1.0)
    here.send(b"late")
    turns = lossy.packets()
    assert next(turns).data == b""
    clock.advance(1.0)
    assert next(turns) == Packet(1_000_000_000, b"late", here.name)
    lossy.send(b"also late")
    assert next(here.packets()).data == b""
    next(turns)
    assert next(here.packets()).data == b"also late"


def test_a_rate_that_is_no_probability_is_refused_by_name() -> None:
    here, _ = memory_pair(SetClock())
    for name in ("drop", "duplicate", "reorder", "flip"):
        for rate in (-0.1, 1.1, float("nan")):
            with pytest.raises(ValueError, match=name):
                Lossy(here, 1, **{name: rate})
