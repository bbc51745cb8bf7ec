"""Which of ArduPilot's parameters are a compass's: by device id and priority, in both naming schemes, or refused."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from memory_flight import Bench, Teller, flight

from magmav.core.types import ParamReading, Reason, State, vec3
from magmav.mavlink.autopilot.adapter import ADAPTERS
from magmav.mavlink.autopilot.ardupilot import Calibrations, plan_change

AXES = "XYZ"
IDS = {1: 97539.0, 2: 131874.0, 3: 263178.0}
OFFSETS = {1: (10.0, -20.0, 30.0), 2: (-110.0, 5.0, 60.0), 3: (250.0, 40.0, -70.0)}  # of slot 1, 2, 3
IRON, SIGMA, ALL = vec3((-88.0, 41.0, 12.0), "iron"), vec3((3.0, 3.0, 3.0), "sigma"), (True, True, True)
SENT = vec3((212.0, -154.0, 440.0), "sent")


def classic(n, what, axis=""):
    return f"COMPASS_{what}{'' if n == 1 else n}" + (f"_{axis}" if axis else "")


def numbered(n, what, axis=""):
    return f"COMPASS{n}_{what}" + (f"_{axis}" if axis else "")


def slots(name=classic, ids=IDS):
    """All that three slots hold; scale and matrix of each are its own too."""
    out = {"COMPASS_MOTCT": 0.0}
    for n in (1, 2, 3):
        out |= {name(n, "OFS", a): v for a, v in zip(AXES, OFFSETS[n], strict=True)}
        out |= {name(n, "DIA", a): 1.0 + 0.1 * n for a in AXES} | {name(n, "ODI", a): 0.0 for a in AXES}
        out |= {name(n, "MOT", a): 0.0 for a in AXES} | {name(n, "SCALE"): 0.0, name(n, "DEV_ID"): ids[n]}
    return out


def priorities(*ids):
    return {f"COMPASS_PRIO{i}_ID": device for i, device in enumerate(ids, 1)}


def holding(*params):
    held = Calibrations()
    for some in params:
        tell(held, some)
    return held


def tell(held, params):
    return [c for name, value in params.items() for c in held.param(ParamReading(1, 1, name, float(value), 65535, 0))]


def plan(held, compass):
    return plan_change(held, 1, compass, IRON, SIGMA, ALL)


@pytest.mark.parametrize("order", list(permutations((1, 2, 3))))
@pytest.mark.parametrize("name", [classic, numbered])
def test_AT_6a_values_land_in_the_slot_whose_device_id_is_that_of_the_stream(order, name):
    """Stream i carries the device in COMPASS_PRIOi_ID, whichever slot holds that device's id."""
    told = priorities(*(IDS[n] for n in order))
    for params in ((slots(name), told), (told, slots(name))):  # whichever is heard first
        held = holding(*params)
        for stream, n in enumerate(order, 1):
            assert held.refuses(stream) is None and held.known(stream) and not held.assumed(stream)
            assert held.device_id(stream) == IDS[n]
            assert tuple(held.offsets(stream)) == OFFSETS[n]
            assert held.undo(stream, SENT) == pytest.approx(SENT / (1.0 + 0.1 * n) - OFFSETS[n])
            change = plan(held, stream)
            assert change.names == tuple(name(n, "OFS", a) for a in AXES)
            assert (change.device_name, change.device_id) == (name(n, "DEV_ID"), IDS[n])
            assert change.old == OFFSETS[n] and change.new == tuple(-IRON)
            assert ADAPTERS[3].checked(change) == change
            assert ADAPTERS[3].triple(change) == change.names


def test_AT_6a_without_priorities_the_number_in_the_name_is_the_stream():
    for params in ((slots(),), (slots(), priorities(0, 0, 0))):
        held = holding(*params)
        assert [plan(held, c).device_id for c in (1, 2, 3)] == [IDS[c] for c in (1, 2, 3)]


def test_AT_6a_an_order_that_moves_a_stream_to_another_slot_begins_a_new_stretch():
    held = holding(slots())
    epochs = [held.epoch(c) for c in (1, 2, 3)]
    assert tell(held, priorities(IDS[2], IDS[1], IDS[3])) == [1, 2]  # each when its own place in the order is heard
    assert [held.epoch(c) - e for c, e in zip((1, 2, 3), epochs, strict=True)] == [1, 1, 0]
    assert not held.changed(1)  # nobody changed anything: it was heard for the first time
    tell(held, priorities(IDS[1], IDS[2], IDS[3]))  # takes effect with the next boot, so nothing is what it says
    assert held.device_id(1) == IDS[2]
    for c in (1, 2, 3):
        assert held.refuses(c) is Reason.MAPPING_UNCLEAR and plan(held, c) is None


@pytest.mark.parametrize(
    ("params", "unclear"),
    [
        (slots(ids={1: 7.0, 2: 7.0, 3: 9.0}), (1, 2)),  # twice the same
        (slots(ids=IDS) | priorities(IDS[1], IDS[2], 12345), (3,)),  # of no slot
        (slots(ids=IDS) | priorities(IDS[1], IDS[2], 0), (3,)),  # there is no third, yet it streams
        (slots(ids={1: 7.0, 2: 7.0, 3: 9.0}) | priorities(7, 9, 0), (1, 3)),
    ],
)
def test_AT_6b_a_device_that_is_there_twice_or_nowhere_is_refused(params, unclear):
    held = holding(params)
    for c in (1, 2, 3):
        assert (held.refuses(c) is Reason.MAPPING_UNCLEAR) == (c in unclear), c
        assert (plan(held, c) is None) == (c in unclear)


def test_AT_6b_a_missing_device_id_is_refused():
    for gone in ({}, {"COMPASS_DEV_ID": 0.0}):
        params = {n: v for n, v in slots().items() if n != "COMPASS_DEV_ID"} | gone
        assert plan(holding(params), 1) is None
        assert plan(holding(params), 2) is not None


def test_AT_6b_a_device_that_changed_is_another_stretch_and_its_own_change():
    held = holding(slots())
    before, epoch = plan(held, 1), held.epoch(1)
    assert tell(held, {"COMPASS_DEV_ID": 466441}) == [1]
    assert held.epoch(1) == epoch + 1 and held.changed(1)
    assert plan(held, 1).device_id == 466441 != before.device_id  # the old change no longer fits: DEVICE_CHANGED


def test_AT_6b_an_unclear_compass_is_never_ready_and_says_why():
    bench = Bench()
    bench.play([*flight(seconds=4.0, told={}), Teller().params(slots(ids={1: 7.0, 2: 7.0, 3: 9.0}))])
    last = bench.play(flight(seconds=4.0, told=None, from_ms=14_000))[-1]
    assert last.verdict.state is State.REFUSED and last.verdict.reasons[0] is Reason.MAPPING_UNCLEAR


def test_AT_6c_both_naming_schemes_say_the_same():
    one, other = holding(slots()), holding(slots(numbered))
    for c in (1, 2, 3):
        assert np.array_equal(one.undo(c, SENT), other.undo(c, SENT))
        assert one.shaping(c).matrix == pytest.approx(other.shaping(c).matrix)
        assert (one.known(c), one.assumed(c)) == (other.known(c), other.assumed(c)) == (True, False)
        assert other.names(c) == (*(numbered(c, "OFS", a) for a in AXES), numbered(c, "DEV_ID"))
        assert len(one.stored(c)) == len(other.stored(c)) == 15
        assert set(other.stored(c)) <= set(slots(numbered))


def test_AT_6c_a_vehicle_without_a_third_compass():
    for name in (classic, numbered):
        two = {n: v for n, v in slots(name).items() if not n.startswith("COMPASS3") and "3" not in n}
        held = holding(two, priorities(IDS[1], IDS[2]))
        assert plan(held, 1) and plan(held, 2)
        assert not held.known(3) and plan(held, 3) is None and held.stored(3).keys() <= {"COMPASS_MOTCT"}


def test_AT_6c_an_unknown_scheme_is_refused():
    strange = {n.replace("OFS", "OFFSET"): v for n, v in slots().items()}
    held = holding(strange)
    assert all(not held.known(c) and plan(held, c) is None for c in (1, 2, 3))
    both = holding(slots(), slots(numbered))
    assert all(both.refuses(c) is Reason.MAPPING_UNCLEAR and plan(both, c) is None for c in (1, 2, 3))


def test_what_is_asked_for_is_what_knowing_needs_in_both_schemes():
    adapter = ADAPTERS[3]
    for name in (classic, numbered):
        vehicle, held, answered = slots(name) | priorities(*IDS.values()), Calibrations(), set()
        for _ in range(2):  # the feeler, then the rest
            for asked in adapter.names((1, 2, 3), answered):
                if asked in vehicle:
                    answered.add(asked)
                    tell(held, {asked: vehicle[asked]})
        assert answered == set(vehicle)
        assert all(held.known(c) and not held.assumed(c) for c in (1, 2, 3))


@given(st.lists(st.tuples(st.from_regex(r"COMPASS[A-Z0-9_]{0,9}", fullmatch=True), st.floats(-9, 9)), max_size=60))
def test_names_that_mean_nothing_here_are_not_kept(params):
    held = Calibrations()
    for name, value in params:
        held.param(ParamReading(1, 1, name, value, 65535, 0))
    known = set(slots()) | set(slots(numbered)) | set(priorities(1, 2, 3))
    assert {name for name, _ in params if held.value(name) is not None} <= known
