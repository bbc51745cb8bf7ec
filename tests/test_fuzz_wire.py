"""Rubbish on the wire, in short: what benchmarks/fuzz_wire.py does with 10 million bytes, and hypothesis looking on."""

from __future__ import annotations

import random
import sys
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from fuzz_wire import DAMAGE, KINDS, OWN_ROUTE, TURNS, Mutator, damaged, packed, run, signed
from scripted_vehicle import S
from soak_rig import Crew

from magmav.core.types import UploadResult
from magmav.link import Packet
from magmav.mavlink.codec import Codec
from magmav.store import Store

FRAMES = tuple(sorted(KINDS))
A_SET = {"target_system": 1, "target_component": 191, "param_id": b"MMAG_UPLOAD", "param_value": 1.0, "param_type": 9}


_SHORT = ("armed", "disarmed")  # where something may be written; all of them in the soak


@pytest.mark.parametrize("turn", [t if t in _SHORT else pytest.param(t, marks=pytest.mark.long) for t in TURNS])
def test_a_hundred_thousand_bytes_of_rubbish_do_no_harm(turn: str) -> None:
    """The bytes are a fifth of that for each turn; growth is for the long run, which has time to become flat."""
    done = run(turn, 20_000, seed=3)
    assert done.bytes_in >= 20_000
    assert (done.raised, done.unasked_sets, done.changed, done.ends["broken word"]) == ([], 0, {}, 0)
    assert not done.ends["PENDING_RESTORE"] or turn == "disarmed"


@given(st.sampled_from(FRAMES), st.sampled_from(DAMAGE), st.integers(0, 2**32))
@settings(max_examples=150, deadline=None)
def test_no_damage_leaves_the_frame_in_it_and_none_of_it_is_believed(name: str, how: str, seed: int) -> None:
    mutator = Mutator(seed)
    frame = packed(name, mutator.values(name, None), (1, 1))
    hurt = damaged(frame, how, mutator.dice)
    assert frame not in hurt
    codec = Codec()
    hurt_believed = codec.decode(hurt, "udp:1", whole=True)
    whole_believed = codec.decode(frame, "udp:1", whole=True)
    assert all(bytes(m.get_msgbuf()) != frame for m in hurt_believed)
    # The one message that carries somebody's key is never decoded, so that no part of us can hold or print it.
    assert [bytes(m.get_msgbuf()) for m in whole_believed] == ([] if name == "SETUP_SIGNING" else [frame])


class Shaken:
    """A service that has latched its vehicle, kept over all examples: what one leaves behind, the next meets."""

    def __init__(self, folder: Path, armed: bool) -> None:
        self.store = Store(folder / "fuzz.sqlite").open()
        self.crew = Crew(5, self.store)
        self.crew.latch()
        self.crew.run(6.0)
        self.crew.vehicle.armed = armed
        self.crew.run(1.5)
        self.before = dict(self.crew.vehicle.params)

    def hear(self, data: bytes, route: str) -> None:
        crew = self.crew
        crew.vehicle.receive([o for o in crew.take(Packet(crew.vehicle.now_ns, data, route)) if o.route == OWN_ROUTE])
        crew.run(0.02)

    def unharmed(self) -> bool:
        return self.crew.vehicle.params == self.before and self.crew.witness.sets == 0


@pytest.fixture(scope="module")
def armed(tmp_path_factory: pytest.TempPathFactory) -> Shaken:
    return Shaken(tmp_path_factory.mktemp("armed"), True)


ROUTES = st.sampled_from((OWN_ROUTE, "udp:2", "udp:3"))


@given(st.binary(min_size=1, max_size=400), ROUTES)
@settings(max_examples=150, deadline=None)
def test_any_bytes_are_survived(armed: Shaken, data: bytes, route: str) -> None:
    armed.hear(data, route)
    assert armed.unharmed()


@given(
    st.sampled_from(FRAMES),
    st.integers(0, 2**32),
    st.sampled_from(((255, 190), (1, 154), (1, 191), (0, 0), (2, 1), (1, 1))),
    st.sampled_from(((1, 191), (1, 0), (0, 0), (1, 1), None)),
    st.booleans(),
    ROUTES,
)
@settings(max_examples=400, deadline=None)
def test_wild_values_with_the_right_checksum_are_survived(
    armed: Shaken,
    name: str,
    seed: int,
    source: tuple[int, int],
    target: tuple[int, int] | None,
    sealed: bool,
    route: str,
) -> None:
    mutator = Mutator(seed)
    frame = packed(name, mutator.values(name, target), source)
    armed.hear(signed(frame, name, mutator.dice) if sealed else frame, route)
    assert armed.unharmed()


@given(st.lists(st.floats(width=32), min_size=1, max_size=8), st.sampled_from(("MMAG_UPLOAD", "MMAG_RESTORE")))
@settings(max_examples=60, deadline=None)
def test_triggers_with_any_number_start_nothing_while_nothing_is_known(
    armed: Shaken, values: list[float], name: str
) -> None:
    for value in values:
        fields = A_SET | {"param_id": name.encode(), "param_value": value}
        armed.hear(packed("PARAM_SET", fields, (255, 190)), "udp:2")
    assert armed.unharmed() and armed.crew.session.companion.job is None


def test_an_upload_in_a_storm_of_damaged_copies_still_ends_all_new(tmp_path: Path) -> None:
    """Every frame of the vehicle comes with three damaged copies of itself, over its own route."""
    dice = random.Random(11)
    with Store(tmp_path / "storm.sqlite") as store:
        crew = Crew(11, store)
        whole = crew.on_message

        def echoed(message, route, now_ns):
            out = whole(message, route, now_ns)
            for how in dice.sample(DAMAGE, 3):
                out += crew.take(Packet(now_ns, damaged(bytes(message.get_msgbuf()), how, dice), route))
            return out

        crew.on_message = echoed  # type: ignore[method-assign]
        crew.latch()
        change = crew.change()
        assert crew.write(change) is UploadResult.ALL_NEW
        assert crew.held() == change.new and crew.witness.broken == 0
        counts = crew.session.service.counts()["codec"]
        assert counts["bad crc"] > 50 and counts["garbage bytes"] > 1000


def test_a_flood_for_our_component_does_not_stop_our_heartbeat(tmp_path: Path) -> None:
    with Store(tmp_path / "flood.sqlite") as store:
        crew, beats = Crew(12, store), []
        crew.latch()
        crew.run(3.0)
        crew.on_sent = lambda m, now_ns: beats.append(now_ns) if m.get_type() == "HEARTBEAT" else None
        mutator, begun_ns = Mutator(12), crew.vehicle.now_ns
        while crew.vehicle.now_ns < begun_ns + 10 * S:
            crew.run(0.02)
            for _ in range(4):
                crew.take(Packet(crew.vehicle.now_ns, *mutator.next("flood")))
        gaps_s = [(b - a) / S for a, b in pairwise(beats)]
        assert 9 <= len(beats) <= 11 and max(gaps_s) <= 1.02 and min(gaps_s) >= 0.98
