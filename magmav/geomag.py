"""The world magnetic model behind one call (pygeomag), for the date of the data and not of today."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from functools import lru_cache

from pygeomag import GeoMag

from magmav.core.types import EarthField

FIRST_YEAR, LAST_YEAR = 2010, 2030
_NT_PER_MG = 100.0


@lru_cache(maxsize=4)
def _model(epoch: int) -> GeoMag:
    # NOAA replaced the 2015 model in mid-term; "v2" is the one that holds for 2015 to 2020.
    name = "WMM_2015v2" if epoch == 2015 else f"WMM_{epoch}"
    return GeoMag(coefficients_file=f"wmm/{name}.COF")


def decimal_year(unix_ns: int) -> float:
    """The UTC year with its elapsed part as a fraction."""
    when = datetime.fromtimestamp(unix_ns / 1e9, UTC)
    start = datetime(when.year, 1, 1, tzinfo=UTC)
    end = datetime(when.year + 1, 1, 1, tzinfo=UTC)
    return when.year + (when - start) / (end - start)


def world_magnetic_model(lat_deg: float, lon_deg: float, alt_m: float, unix_ns: int) -> EarthField | None:
    """Field in mG, true north-east-down, or None outside 2010 to 2030 (the models pygeomag ships).

    ValueError for a place that is not on Earth.
    """
    if not (-90.0 <= lat_deg <= 90.0 and -180.0 <= lon_deg <= 180.0 and math.isfinite(alt_m)):
        raise ValueError(f"position: latitude {lat_deg}, longitude {lon_deg}, altitude {alt_m} is not a place on Earth")
    if not 0 <= unix_ns < 4_000_000_000 * 10**9:
        return None
    year = decimal_year(unix_ns)
    if not FIRST_YEAR <= year < LAST_YEAR:
        return None
    epoch = int(year - FIRST_YEAR) // 5 * 5 + FIRST_YEAR
    got = _model(epoch).calculate(glat=lat_deg, glon=lon_deg, alt=alt_m / 1000.0, time=year)
    return EarthField(got.x / _NT_PER_MG, got.y / _NT_PER_MG, got.z / _NT_PER_MG)
