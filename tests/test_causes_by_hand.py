"""What the cause finder makes of a vehicle turned in somebody's hands: mounting yes, field and ground no."""

from dataclasses import replace

import numpy as np
import pytest
from ground_frames import COPTER, frames, tumble
from honest_flight import EXPECTED, samples
from memory_flight import Bench
from synthetic_flight import EARTH_MG, HARD_IRON_MG
from test_causes import GRID, NOTHING, about, bent, codes

from magmav.core.causes import Causes
from magmav.core.types import vec3

STEEL_N = np.array([60.0, -40.0, 70.0])


def see(found, flight, *, by_hand=False, grounded=False, from_s=0.0):
    """Watch these samples; by hand and at rest they are of a vehicle that has not flown."""
    for s in flight:
        late = replace(s, boot_ns=s.boot_ns + int(from_s * 1e9), gap=s.gap and not from_s)
        s = replace(late, by_hand=by_hand, learn=not grounded)
        found.step(s, NOTHING, EXPECTED, vec3(s.mag_b_mg - HARD_IRON_MG, "u"), by_hand or grounded)
    return found


def rest(seconds, earth_mg=EARTH_MG):
    """Standing still: the first sample of a level flight again and again."""
    first = samples("hover turns", 3, seconds=1.0, earth_mg=earth_mg)[0]
    return [
        replace(first, boot_ns=first.boot_ns + int(i * 1e8), dt_s=0.1 if i else 0.0, gap=i == 0)
        for i in range(int(10 * seconds))
    ]


def test_a_tumble_by_steel_on_the_ground_names_nothing():
    """The service's whole path: a sound copter, disarmed, turned over where the field is another than the model's."""
    bench = Bench()
    bench.play(frames(tumble, COPTER, 50.0, 5, near_mg=STEEL_N, iron_mg=0.3 * HARD_IRON_MG))
    causes = bench.pipeline.vehicles[1].causes
    assert causes.of(1) == ()
    watched = causes._watched[1]
    assert watched.fitted is not None and watched.blocks.by_hand  # it did look
    assert watched.blocks.ground is None  # and what it held in the hand is not how the ground is


def test_without_the_hands_the_same_field_would_be_called_a_wrong_scale():
    """So it is the hands that make the difference, not a blunt test."""
    stronger = bent(samples("figure eight", 31), 1.2 * GRID)
    assert "SCALE_WRONG" in codes(see(Causes(), stronger))
    assert codes(see(Causes(), stronger, by_hand=True)) == set()


@pytest.mark.parametrize("turned", [about(z=90), about(y=30)], ids=["right angle", "crooked"])
def test_a_wrong_mounting_shows_in_the_hands(turned):
    got = codes(see(Causes(), bent(samples("figure eight", 32), turned.T), by_hand=True))
    assert len(got) == 1 and got < {"MOUNTED_WRONG", "MOUNTED_CROOKED"}


def test_flight_forgets_the_hands():
    """Among steel by hand, then 40 s in the clean: only the flight is left, and its field is judged again."""
    found = see(Causes(), samples("figure eight", 33, seconds=40.0, earth_mg=EARTH_MG + STEEL_N), by_hand=True)
    see(found, bent(samples("figure eight", 34, seconds=40.0), 1.3 * GRID), from_s=50.0)
    blocks = found._watched[1].blocks
    assert not blocks.by_hand
    assert min(b.begin_s for b in blocks.all()) >= 60.0  # honest flights begin at 10 s
    assert codes(found) == {"SCALE_WRONG"}


def test_after_a_flight_the_hands_teach_nothing_more():
    found = see(Causes(), samples("figure eight", 35, seconds=40.0))
    before = found._watched[1].blocks.all()
    see(found, bent(samples("figure eight", 36, seconds=40.0), about(z=90)), by_hand=True, from_s=50.0)
    assert [b.begin_s for b in found._watched[1].blocks.all()] == [b.begin_s for b in before]
    assert codes(found) == set()


def test_the_ground_is_where_it_was_put_down():
    """At rest on steel, taken up, put down in the clean, flown: the ground before it was taken up says nothing."""
    strong = np.array([150.0, -150.0, 100.0])
    found = see(Causes(), rest(25.0, EARTH_MG + strong), grounded=True)
    assert found._watched[1].blocks.ground is not None
    see(found, samples("figure eight", 37, seconds=15.0), by_hand=True, from_s=26.0)
    assert found._watched[1].blocks.ground is None
    see(found, rest(25.0), grounded=True, from_s=42.0)
    assert found._watched[1].blocks.ground is not None
    assert found._watched[1].blocks.ground.begin_s >= 52.0
