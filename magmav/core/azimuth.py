"""Azimuth from two horizontal components (Sytnyk, Honcharov, Raievskyi 2014, eq. (4) and its eight rules).

The paper measures from its Y axis towards X; our levelled field is (ahead, right). ``azimuth_of_level`` is the bridge.
All angles in rad, headings in [0, 2 pi).
"""

from __future__ import annotations

import math

from magmav.core.rotation import wrap_tau


def finite(**values: float) -> None:
    """ValueError naming the first value that is not a finite number."""
    for name, value in values.items():
        if not math.isfinite(value):
            raise ValueError(f"{name}: want a finite number, got {value!r}")


def azimuth_by_rules(x: float, y: float) -> float | None:
    """The paper's eight rules, in its own order: the angle from the Y axis towards X, any unit of field.

    They are atan2(x, y) mod 2 pi. DEVIATES: the rules leave (0, 0) open: None. Rule 8 can round to a full turn
    (x = -1e-20): that is 0. ValueError unless both are finite.
    """
    finite(x=x, y=y)
    if y > 0.0 and x == 0.0:
        return 0.0
    if y > 0.0 and x > 0.0:
        return math.atan(x / y)
    if y == 0.0 and x > 0.0:
        return math.pi / 2.0
    if y < 0.0 and x == 0.0:
        return math.pi
    if y == 0.0 and x < 0.0:
        return 1.5 * math.pi
    if y < 0.0:  # rules 6 and 7 print the same formula
        return math.pi + math.atan(x / y)
    if y > 0.0:
        return wrap_tau(math.tau + math.atan(x / y))
    return None


def azimuth(x: float, y: float) -> float | None:
    """Eq. (4) in one call: atan2(x, y) mod 2 pi; None for (0, 0). ValueError unless both are finite."""
    finite(x=x, y=y)
    return None if x == 0.0 and y == 0.0 else wrap_tau(math.atan2(x, y))


def azimuth_of_level(ahead_mg: float, right_mg: float) -> float | None:
    """Magnetic heading from the levelled field, mG; None for a field of zero.

    DEVIATES: eq. (4) takes Y for the reference axis while the paper's tilt equations take X, and is written with
    the vector before back-rotation. With forward and right put in as they stand it gives the heading plus 90 degrees.
    Right is (X, Y) := (-right, ahead).
    """
    return azimuth(-right_mg, ahead_mg)


def true_azimuth(magnetic_rad: float, declination_rad: float) -> float:
    """True heading: magnetic plus declination, east positive."""
    finite(magnetic_rad=magnetic_rad, declination_rad=declination_rad)
    return wrap_tau(magnetic_rad + declination_rad)
