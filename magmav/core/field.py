"""What the Earth's field should be where the vehicle is. The model itself is handed in."""

from __future__ import annotations

import math
from dataclasses import dataclass

from magmav.core.types import EarthField, FieldModel

MODEL_SIGMA_MG = 5.0
"""One sigma of the world magnetic model per axis, crust included (estimation.md section 5, priors)."""
_DAY_NS = 86_400_000_000_000


@dataclass(frozen=True, slots=True)
class ExpectedField:
    """Horizontal and downward strength (mG) and declination (rad, east positive)."""

    horizontal_mg: float
    down_mg: float
    declination_rad: float

    @property
    def total_mg(self) -> float:
        """Length of the whole vector, mG."""
        return math.hypot(self.horizontal_mg, self.down_mg)


def expected(field: EarthField) -> ExpectedField:
    """The same field as strength, dip and declination."""
    return ExpectedField(
        math.hypot(field.north_mg, field.east_mg), field.down_mg, math.atan2(field.east_mg, field.north_mg)
    )


class FieldKeeper:
    """Remembers the expected field and asks the model again only after 1 km or a day."""

    def __init__(self, model: FieldModel) -> None:
        self._model = model
        self._asked: tuple[float, float, float, int] | None = None
        self._near: tuple[float, float, float] | None = None  # where it was last found to hold
        self.now: ExpectedField | None = None

    def at(self, lat_deg: float, lon_deg: float, alt_m: float, unix_ns: int) -> ExpectedField | None:
        """Field at a place (deg, deg, m above sea level) and time; None outside the model's years."""
        here = lat_deg, lon_deg, alt_m
        if self._asked is not None and here == self._near and abs(unix_ns - self._asked[3]) <= _DAY_NS:
            return self.now
        if self._asked is None or self._moved(lat_deg, lon_deg, alt_m, unix_ns):
            self._asked = (lat_deg, lon_deg, alt_m, unix_ns)
            answer = self._model(lat_deg, lon_deg, alt_m, unix_ns)
            self.now = None if answer is None else expected(answer)
        self._near = here
        return self.now

    def _moved(self, lat_deg: float, lon_deg: float, alt_m: float, unix_ns: int) -> bool:
        lat, lon, alt, unix = self._asked or (0.0, 0.0, 0.0, 0)
        shrink = max(math.cos(math.radians(lat)), 0.01)
        turn = math.remainder(lon_deg - lon, 360.0)
        return (
            math.hypot(lat_deg - lat, turn * shrink) * 111.2 > 1.0
            or abs(alt_m - alt) > 1000.0
            or abs(unix_ns - unix) > _DAY_NS
        )
