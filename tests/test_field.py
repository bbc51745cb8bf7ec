"""Expected field: strength, dip, declination, and when the model is asked again."""

import math

import pytest

from magmav.core.field import FieldKeeper, expected
from magmav.core.types import EarthField

DAY_NS = 86_400 * 10**9


class CountingModel:
    """Says how often it was asked; north is the latitude, so that answers differ."""

    def __init__(self) -> None:
        self.asked = 0

    def __call__(self, lat_deg, lon_deg, alt_m, unix_ns):
        self.asked += 1
        return None if unix_ns < 0 else EarthField(lat_deg, 0.0, 430.0)


def test_strength_and_declination_by_hand():
    got = expected(EarthField(30.0, -40.0, 120.0))
    assert got.horizontal_mg == pytest.approx(50.0)
    assert got.down_mg == 120.0
    assert got.declination_rad == pytest.approx(math.atan2(-40, 30))
    assert got.total_mg == pytest.approx(130.0)


@pytest.mark.parametrize(
    ("then", "asked"),
    [
        ((47.0, 8.0, 500.0, DAY_NS), 1),
        ((47.008, 8.0, 500.0, DAY_NS), 1),  # 890 m
        ((47.010, 8.0, 500.0, DAY_NS), 2),  # 1112 m
        ((47.0, 8.0125, 500.0, DAY_NS), 1),  # 948 m at this latitude
        ((47.0, 8.0145, 500.0, DAY_NS), 2),  # 1100 m
        ((47.0, 8.0, 1490.0, DAY_NS), 1),
        ((47.0, 8.0, 1510.0, DAY_NS), 2),
        ((47.0, 8.0, 500.0, 2 * DAY_NS + 1), 2),
    ],
)
def test_the_model_is_asked_again_after_a_kilometre_or_a_day(then, asked):
    model = CountingModel()
    keeper = FieldKeeper(model)
    keeper.at(47.0, 8.0, 500.0, DAY_NS)
    got = keeper.at(*then)
    assert model.asked == asked
    assert got is not None
    assert got.horizontal_mg == (then[0] if asked == 2 else 47.0)


def test_small_steps_add_up_and_the_date_line_is_no_step():
    model = CountingModel()
    keeper = FieldKeeper(model)
    for i in range(100):
        keeper.at(47.0 + i * 0.001, 8.0, 0.0, DAY_NS)
    assert model.asked == pytest.approx(100 * 0.1112, abs=2)
    model.asked = 0
    keeper = FieldKeeper(model)
    keeper.at(0.0, 179.9999, 0.0, DAY_NS)
    keeper.at(0.0, -179.9999, 0.0, DAY_NS)
    assert model.asked == 1


def test_outside_the_models_years_there_is_no_field_and_it_is_not_asked_each_time():
    model = CountingModel()
    keeper = FieldKeeper(model)
    assert keeper.at(47.0, 8.0, 0.0, -5) is None
    assert keeper.at(47.0, 8.0, 0.0, -4) is None
    assert model.asked == 1
    assert keeper.at(47.0, 8.0, 0.0, DAY_NS + 5) is not None
