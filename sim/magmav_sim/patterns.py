"""What a scenario may ask the vehicle to fly. Frozen, checked when the file is read."""

from __future__ import annotations

from typing import Annotated

import msgspec

Metres = Annotated[float, msgspec.Meta(gt=0, le=20000)]
Seconds = Annotated[float, msgspec.Meta(gt=0, le=36000)]
Count = Annotated[int, msgspec.Meta(ge=1, le=1000)]


class Pattern(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="kind"):
    """One leg of a flight; ``kind`` names which."""


class Takeoff(Pattern, frozen=True, kw_only=True, tag="takeoff"):
    """Climb to a height above home. A plane is launched to it at constant heading."""

    height_m: Metres = 15.0
    climb_mps: Annotated[float, msgspec.Meta(gt=0, le=10)] = 2.0


class Hover(Pattern, frozen=True, kw_only=True, tag="hover"):
    """Quadrotor: hold position and heading."""

    seconds: Seconds = 10.0


class Yaw(Pattern, frozen=True, kw_only=True, tag="yaw"):
    """Quadrotor: turn in place. Negative turns are to the left."""

    turns: Annotated[float, msgspec.Meta(ge=-100, le=100)] = 1.0
    rate_dps: Annotated[float, msgspec.Meta(gt=0, le=40)] = 30.0


class FigureEight(Pattern, frozen=True, kw_only=True, tag="figure8"):
    """Quadrotor: a lemniscate of the given half length, nose along the path."""

    laps: Count = 1
    half_length_m: Metres = 15.0
    speed_mps: Annotated[float, msgspec.Meta(gt=0, le=10)] = 4.0


class Survey(Pattern, frozen=True, kw_only=True, tag="survey"):
    """Quadrotor: parallel lanes there and back, nose along the lane."""

    lanes: Count = 4
    length_m: Metres = 40.0
    spacing_m: Metres = 10.0
    speed_mps: Annotated[float, msgspec.Meta(gt=0, le=10)] = 4.0
    heading_deg: Annotated[float, msgspec.Meta(ge=0, lt=360)] = 20.0


class Bob(Pattern, frozen=True, kw_only=True, tag="bob"):
    """Quadrotor: up and down on the spot, so that throttle and current swing."""

    cycles: Count = 4
    height_m: Annotated[float, msgspec.Meta(gt=0, le=50)] = 6.0
    period_s: Annotated[float, msgspec.Meta(ge=3, le=60)] = 5.0


class Straight(Pattern, frozen=True, kw_only=True, tag="straight"):
    """Plane: wings level on the present course."""

    seconds: Seconds = 10.0


class Loiter(Pattern, frozen=True, kw_only=True, tag="loiter"):
    """Plane: full circles at a bank angle; negative is to the left. Height is held."""

    turns: Annotated[float, msgspec.Meta(gt=0, le=100)] = 2.0
    bank_deg: Annotated[float, msgspec.Meta(ge=-45, le=45)] = 25.0


class STurns(Pattern, frozen=True, kw_only=True, tag="s_turns"):
    """Plane: heading changes of ``sweep_deg`` to alternating sides."""

    count: Count = 4
    sweep_deg: Annotated[float, msgspec.Meta(gt=0, le=270)] = 90.0
    bank_deg: Annotated[float, msgspec.Meta(gt=0, le=45)] = 30.0


class Climb(Pattern, frozen=True, kw_only=True, tag="climb"):
    """Plane: climb (or, below zero, descend) by a height, in a gentle turn when a bank is given."""

    by_m: Annotated[float, msgspec.Meta(ge=-2000, le=2000)] = 50.0
    rate_mps: Annotated[float, msgspec.Meta(gt=0, le=6)] = 2.5
    bank_deg: Annotated[float, msgspec.Meta(ge=-45, le=45)] = 0.0


class Land(Pattern, frozen=True, kw_only=True, tag="land"):
    """Come down and stop. Ends a flight."""

    sink_mps: Annotated[float, msgspec.Meta(gt=0, le=5)] = 1.0


AnyPattern = Takeoff | Hover | Yaw | FigureEight | Survey | Bob | Straight | Loiter | STurns | Climb | Land
QUAD_ONLY = (Hover, Yaw, FigureEight, Survey, Bob)
PLANE_ONLY = (Straight, Loiter, STurns, Climb)
