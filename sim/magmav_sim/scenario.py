"""A scenario: where, when, what airframe, what iron, what is flown, what goes wrong. Read by
``scenario_file``."""

from __future__ import annotations

import datetime
from typing import Annotated, Any, Literal

import msgspec

from magmav_sim.faults import AnyFault, SecondRoute, Vector
from magmav_sim.patterns import AnyPattern

_Share = Annotated[float, msgspec.Meta(ge=0)]


class ScenarioError(Exception):
    """A scenario that is not there or not right; the text names the file, the key and the value."""


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    pass


class Place(_Table, frozen=True, kw_only=True):
    """Home: WGS84 degrees, metres above sea level."""

    lat_deg: Annotated[float, msgspec.Meta(ge=-89, le=89)]
    lon_deg: Annotated[float, msgspec.Meta(ge=-180, le=180)]
    alt_m: Annotated[float, msgspec.Meta(ge=-400, le=9000)] = 0.0


class WindSpec(_Table, frozen=True, kw_only=True):
    """Steady wind and where it comes from; ``turbulence_mps`` is the sigma of a horizontal gust component."""

    speed_mps: Annotated[float, msgspec.Meta(ge=0, le=15)] = 2.0
    from_deg: float = 270.0
    turbulence_mps: Annotated[float, msgspec.Meta(ge=0, le=5)] = 0.5


class CompassSpec(_Table, frozen=True, kw_only=True):
    """sensor = mounting^-1 (soft @ (earth field + motor field) + hard iron) + noise, read ``delay_ms`` late.

    hard_iron_mg and motor_mg_per_a are in body axes; noise_mg is the sigma of each 100 Hz sample.
    orient is the mounting (MAV_SENSOR_ORIENTATION), which COMPASS_ORIENT of an external compass undoes.
    committed: its device id is stored as that of the calibrated one; else the autopilot calls it not calibrated.
    """

    device_id: int
    hard_iron_mg: Vector
    soft: tuple[Vector, Vector, Vector] = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    motor_mg_per_a: Vector = (0, 0, 0)
    noise_mg: _Share = 3.0
    delay_ms: Annotated[float, msgspec.Meta(ge=0, le=500)] = 0.0
    drift_mg_per_s: Vector = (0, 0, 0)
    external: bool = True
    orient: Annotated[int, msgspec.Meta(ge=0, le=40)] = 0
    committed: bool = True


class Anomaly(_Table, frozen=True, kw_only=True):
    """Iron in the ground under home: ``ned_mg`` at the ground, falling with (scale / (scale + height))
    cubed."""

    ned_mg: Vector
    scale_m: Annotated[float, msgspec.Meta(gt=0)] = 1.0


class AutopilotSpec(_Table, frozen=True, kw_only=True):
    """How the autopilot behaves. yaw "compass" follows its own corrected compass 1, "truth" does not.

    release : of ArduPilot, "older" is 4.5, silent about what it does not take; "newer" answers with PARAM_ERROR, has a
    HIGHRES_IMU in wrong units. Of PX4, "older" ignores a change of offsets up to 10 mG and applies changes only
    disarmed, "newer" ignores up to 5 mG and applies always.
    naming : ArduPilot's COMPASS_OFS2_X ("old") or COMPASS2_OFS_X ("new").
    uid : what AUTOPILOT_VERSION says of the board; from the seed where it is not given.
    ekf_tau_s : how fast PX4's filter learns what its calibration left over, in the air.
    rates_hz : messages streamed after boot without being asked, name to rate.
    parameters : stored values that differ from the defaults, the autopilot's own names.
    """

    kind: Literal["ardupilot", "px4"] = "ardupilot"
    release: Literal["older", "newer"] = "older"
    naming: Literal["old", "new"] = "old"
    uid: Annotated[int, msgspec.Meta(ge=1, le=0xFFFFFFFFFFFF)] | None = None
    ekf_tau_s: Annotated[float, msgspec.Meta(gt=0)] = 20.0
    yaw: Literal["compass", "truth"] = "compass"
    system: Annotated[int, msgspec.Meta(ge=1, le=250)] = 1
    imus: Annotated[int, msgspec.Meta(ge=1, le=3)] = 2
    tilt_sigma_deg: _Share = 0.5
    tilt_tau_s: Annotated[float, msgspec.Meta(gt=0)] = 12.0
    gyro_bias_dps: _Share = 0.05
    velocity_noise_mps: _Share = 0.15
    boot_s: _Share = 1.5
    rates_hz: dict[str, Annotated[float, msgspec.Meta(gt=0, le=100)]] = {}
    parameters: dict[str, float] = {}


class Flight(_Table, frozen=True, kw_only=True):
    """One flight. "auto" starts after ``ground_s`` on the ground; "command" waits for MISSION_START.

    When it cannot start (nobody commands, arming is refused) within ``wait_s``, the scenario ends.
    """

    pattern: Annotated[list[AnyPattern], msgspec.Meta(min_length=1)]
    start: Literal["auto", "command"] = "auto"
    ground_s: _Share = 8.0
    wait_s: _Share = 600.0


class Scenario(_Table, frozen=True, kw_only=True):
    """Everything a simulation is made from. ``stay``: go on after the last flight until stopped."""

    name: str = ""
    about: str = ""
    seed: int
    airframe: Literal["F450", "c172x", "minisgs"]
    date: datetime.datetime
    place: Place
    heading_deg: Annotated[float, msgspec.Meta(ge=0, lt=360)] = 0.0
    wind: WindSpec = WindSpec()
    compasses: Annotated[list[CompassSpec], msgspec.Meta(min_length=1, max_length=3)] = msgspec.field(name="compass")
    anomaly: Anomaly | None = None
    autopilot: AutopilotSpec = AutopilotSpec()
    faults: list[AnyFault] = msgspec.field(name="fault", default_factory=list)
    flights: list[Flight] = msgspec.field(name="flight", default_factory=list)
    end_ground_s: _Share = 5.0
    stay: bool = False

    @property
    def year(self) -> float:
        """The date as a decimal year."""
        start = datetime.datetime(self.date.year, 1, 1, tzinfo=self.date.tzinfo)
        end = start.replace(year=start.year + 1)
        return self.date.year + (self.date - start) / (end - start)


def with_autopilot(scenario: Scenario, kind: Literal["ardupilot", "px4"]) -> Scenario:
    """The same scenario under the other autopilot. ScenarioError where it stores parameters of its own autopilot."""
    if kind == scenario.autopilot.kind:
        return scenario
    named: list[Any] = [*scenario.autopilot.parameters, *(getattr(f, "name", None) for f in scenario.faults)]
    odd = next((name for name in named if name is not None), None)
    if odd is not None:
        raise ScenarioError(f"scenario {scenario.name}: it names {odd}, which is not for {kind}")
    replace = msgspec.structs.replace
    return replace(scenario, autopilot=replace(scenario.autopilot, kind=kind))


def has_second_route(scenario: Scenario) -> bool:
    """Whether somebody speaks over a route of its own."""
    return any(isinstance(fault, SecondRoute) for fault in scenario.faults)
