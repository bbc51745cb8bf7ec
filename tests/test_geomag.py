"""The world magnetic model against NOAA's own test values, and its edges."""

import json
from datetime import UTC, datetime
from pathlib import Path

import pytest

from magmav.geomag import decimal_year, world_magnetic_model

NOAA = json.loads((Path(__file__).parent / "authorities" / "wmm_test_values.json").read_text())


def unix_ns(year: float) -> int:
    """UNIX time of a decimal year."""
    start = datetime(int(year), 1, 1, tzinfo=UTC)
    end = datetime(int(year) + 1, 1, 1, tzinfo=UTC)
    return int((start + (end - start) * (year % 1)).timestamp() * 1e9)


@pytest.mark.parametrize("row", NOAA["rows"], ids=lambda r: f"WMM{r[0]}-{r[1]:g}-{r[2]}km-{r[3]}-{r[4]}")
def test_noaa_test_values(row):
    _, year, alt_km, lat, lon, *want_nt = row
    got = world_magnetic_model(lat, (lon + 180.0) % 360.0 - 180.0, alt_km * 1000.0, unix_ns(year))
    assert got is not None
    assert [v * 100.0 for v in got] == pytest.approx(want_nt, abs=0.06)


def test_the_date_picks_the_model():
    """Across a change of model the field jumps by more than it drifts in a day."""
    place = (-80.0, -120.0, 0.0)
    for year in (2015, 2020, 2025):
        before = world_magnetic_model(*place, unix_ns(year) - 1_000_000_000)
        after = world_magnetic_model(*place, unix_ns(year))
        assert before is not None
        assert after is not None
        assert max(abs(a - b) for a, b in zip(before, after, strict=True)) > 0.02
        week = world_magnetic_model(*place, unix_ns(year) + 7 * 86_400 * 10**9)
        assert week is not None
        assert max(abs(a - b) for a, b in zip(week, after, strict=True)) < 0.05


@pytest.mark.parametrize("year", [1969.5, 1970.0, 2009.999, 2030.0, 2030.5, 2099.0, 2400.0])
def test_no_answer_outside_the_models_years(year):
    assert world_magnetic_model(47.0, 8.0, 500.0, unix_ns(year)) is None


def test_the_first_and_the_last_moment_have_one():
    assert world_magnetic_model(47.0, 8.0, 500.0, unix_ns(2010.0)) is not None
    assert world_magnetic_model(47.0, 8.0, 500.0, unix_ns(2030.0) - 1_000_000_000) is not None


@pytest.mark.parametrize(
    "place", [(90.1, 0, 0), (-91, 0, 0), (0, 180.1, 0), (0, -181, 0), (float("nan"), 0, 0), (0, 0, float("inf"))]
)
def test_a_place_off_earth_is_a_wrong_call(place):
    with pytest.raises(ValueError, match="not a place on Earth"):
        world_magnetic_model(*place, unix_ns(2024.0))


def test_poles_and_date_line_are_on_earth():
    now = unix_ns(2026.0)
    for lat, lon in ((90.0, 0.0), (-90.0, 0.0), (10.0, 180.0), (10.0, -180.0)):
        assert world_magnetic_model(lat, lon, 0.0, now) is not None
    assert world_magnetic_model(10.0, 180.0, 0.0, now) == pytest.approx(world_magnetic_model(10.0, -180.0, 0.0, now))


def test_decimal_year_counts_leap_days():
    assert decimal_year(int(datetime(2024, 7, 2, tzinfo=UTC).timestamp()) * 10**9) == pytest.approx(2024.5, abs=1e-9)
    assert decimal_year(int(datetime(2023, 7, 2, 12, tzinfo=UTC).timestamp()) * 10**9) == pytest.approx(2023.5)
