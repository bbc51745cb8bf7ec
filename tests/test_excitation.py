"""Coverage counts directions in body axes and headings: a ring is not a sphere."""

import math

import numpy as np
import pytest
from synthetic_flight import turn

from magmav.core.excitation import SECTORS, Excitation, sectors_of


def look(directions, headings=()):
    seen = Excitation()
    for d in directions:
        seen.see(400.0 * np.asarray(d, dtype=float), None)
    for h in headings:
        seen.see(np.array([1.0, 0.0, 0.0]), h)
    return seen


def test_nothing_seen_is_nothing_covered():
    assert Excitation().coverage == 0.0
    assert Excitation().sectors == 0
    assert look([(0, 0, 0)]).coverage == 0.0


def test_every_direction_covers_all():
    r = np.random.default_rng(1)
    assert look(r.normal(size=(4000, 3))).coverage == 1.0


def test_a_level_turn_fills_one_ring_only():
    """At a dip of 64 degrees all headings lie on one narrow ring: six of 24 cells."""
    ring = [turn(2, a) @ (205, 0, 430) for a in np.linspace(0, 2 * math.pi, 400)]
    assert look(ring).coverage == pytest.approx(6 / 24)
    still = [turn(2, 0.3) @ (205, 0, 430)] * 50
    assert look(still).coverage == pytest.approx(1 / 24)


def test_coverage_depends_on_direction_and_not_on_strength():
    one, two = Excitation(), Excitation()
    for v in np.random.default_rng(2).normal(size=(30, 3)):
        one.see(v, None)
        two.see(v * 1000.0, None)
    assert one.coverage == two.coverage


def test_cells_are_about_equal_in_area():
    r, n = np.random.default_rng(3), 48000
    points = r.normal(size=(n, 3))
    hits: dict[tuple[int, int], int] = {}
    for p in points:
        seen = Excitation()
        seen.see(p, None)
        (cell,) = seen._cells
        hits[cell] = hits.get(cell, 0) + 1
        if len(hits) == 24 and sum(hits.values()) >= 6000:
            break
    shares = np.array(list(hits.values())) / sum(hits.values())
    assert len(hits) == 24
    assert shares.min() > 0.4 / 24
    assert shares.max() < 1.8 / 24


def test_headings_fall_into_twelve_sectors():
    assert look([], [0.01]).sectors == 1
    assert look([], [math.radians(a) for a in (1, 29)]).sectors == 1
    assert look([], [math.radians(a) for a in (29, 31)]).sectors == 2
    assert look([], [math.radians(a) for a in range(0, 360, 10)]).sectors == SECTORS == 12
    assert look([], [math.nextafter(2 * math.pi, 0)]).sectors == 1


@pytest.mark.parametrize("n", [0, 1, 5, 20, 300])
def test_many_headings_at_once_see_the_sectors_that_they_see_one_by_one(n):
    headings = np.random.default_rng(n).uniform(0.0, math.tau, n)
    edges = np.arange(SECTORS)[: n // 4] * math.tau / SECTORS
    for seen in (headings, edges, np.full(n, np.nextafter(math.tau, 0.0)), np.full(n, math.tau)):
        assert sectors_of(seen) == look([], seen).sectors
