"""A scenario: where, when, what airframe, what iron, what is flown, what goes wrong. Read from TOML,
checked once."""

from __future__ import annotations

import datetime
import math
import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from magmav_sim.faults import AnyFault, Vector
from magmav_sim.patterns import PLANE_ONLY, QUAD_ONLY, AnyPattern, Land, Takeoff

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
    """

    device_id: int
    hard_iron_mg: Vector
    soft: tuple[Vector, Vector, Vector] = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    motor_mg_per_a: Vector = (0, 0, 0)
    noise_mg: _Share = 3.0
    delay_ms: Annotated[float, msgspec.Meta(ge=0, le=500)] = 0.0
    drift_mg_per_s: Vector = (0, 0, 0)
    external: bool = True
    orient: Annotated[int, msgspec.Meta(ge=0, le=25)] = 0


class Anomaly(_Table, frozen=True, kw_only=True):
    """Iron in the ground under home: ``ned_mg`` at the ground, falling with (scale / (scale + height))
    cubed."""

    ned_mg: Vector
    scale_m: Annotated[float, msgspec.Meta(gt=0)] = 1.0


class AutopilotSpec(_Table, frozen=True, kw_only=True):
    """How the autopilot behaves. yaw "compass" follows its own corrected compass 1, "truth" does not.

    rates_hz : messages streamed after boot without being asked, name to rate.
    parameters : stored values that differ from the defaults, ArduPilot's names.
    """

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
    compasses: Annotated[list[CompassSpec], msgspec.Meta(min_length=1, max_length=3)] = msgspec.field(
        name="compass"
    )
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


def scenario_files() -> dict[str, Path]:
    """Scenarios by bare name: those of the checkout, or those in the wheel."""
    here = Path(__file__).resolve().parent
    for folder in (
        here.parents[1] / "config" / "scenarios",
        here.parent / "magmav" / "_config" / "scenarios",
    ):
        if folder.is_dir():
            return {path.stem: path for path in sorted(folder.glob("*.toml"))}
    return {}


def load_scenario(name_or_path: str | Path) -> Scenario:
    """A scenario by bare name or by the path of a TOML file. Raises ScenarioError."""
    path = Path(name_or_path)
    known = scenario_files()
    if str(name_or_path) in known:
        path = known[str(name_or_path)]
    elif path.suffix != ".toml":
        raise ScenarioError(
            f"scenario {str(name_or_path)!r}: not one of {', '.join(known) or 'none'}, nor a .toml file"
        )
    try:
        text = path.read_bytes()
    except OSError as error:
        raise ScenarioError(f"scenario {path}: {error.strerror}") from error
    return parse_scenario(text, str(path))


def parse_scenario(text: bytes, file: str) -> Scenario:
    """A scenario from TOML text; ``file`` is named in errors and gives the name where the text does not."""
    try:
        tree = tomllib.loads(text.decode())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ScenarioError(f"scenario {file}: not TOML: {error}") from error
    tree.setdefault("name", Path(file).stem)
    odd = _not_finite(tree, "")
    if odd:
        raise ScenarioError(f"scenario {file}: {odd}")
    try:
        scenario = msgspec.convert(tree, Scenario)
    except msgspec.ValidationError as error:
        raise ScenarioError(f"scenario {file}: {_explain(str(error), tree)}") from error
    problem = _problem(scenario)
    if problem:
        raise ScenarioError(f"scenario {file}: {problem}")
    return scenario


def _not_finite(value: object, path: str) -> str | None:
    """Where in the tree a NaN or infinity stands (TOML has them), and which; None where all is well."""
    if isinstance(value, float) and not math.isfinite(value):
        return f"{path}: want a finite number, got {value}"
    inside: list[tuple[str, object]] = []
    if isinstance(value, dict):
        inside = [(f"{path}.{key}" if path else str(key), item) for key, item in value.items()]
    elif isinstance(value, list):
        inside = [(f"{path}[{i}]", item) for i, item in enumerate(value)]
    return next((odd for where, item in inside if (odd := _not_finite(item, where))), None)


def _explain(text: str, tree: object) -> str:
    """msgspec names the path; add the value found there."""
    found = re.search(r"`\$([^`]*)`$", text)
    if not found:
        unknown = re.search(r"unknown field `(\w+)`", text)
        return f"{text} = {tree.get(unknown[1])!r}" if unknown and isinstance(tree, dict) else text
    value: Any = tree
    for key, index in re.findall(r"\.(\w+)|\[(\d+)\]", found[1]):
        try:
            value = value[int(index)] if index else value[key]
        except (KeyError, IndexError, TypeError):
            return text
    unknown = re.search(r"unknown field `(\w+)`", text)
    if unknown and isinstance(value, dict):
        value = value.get(unknown[1])
    return f"{text}: {value!r}"


def _problem(scenario: Scenario) -> str | None:
    """What types cannot say: the first thing that is wrong, or None."""
    if scenario.date.tzinfo is None:
        return f"date: want a UTC offset such as 2026-11-22T10:00:00Z, got {scenario.date.isoformat()}"
    if not 2010 <= scenario.year < 2030:
        return f"date: the field models cover 2010 to 2029, got {scenario.date.isoformat()}"
    for i, fault in enumerate(scenario.faults):
        number = getattr(fault, "compass", 1)
        if number > len(scenario.compasses):
            return f"fault[{i}].compass: there are {len(scenario.compasses)} compasses, got {number}"
    banned: tuple[type, ...] = PLANE_ONLY if scenario.airframe == "F450" else QUAD_ONLY
    for i, flight in enumerate(scenario.flights):
        for j, leg in enumerate(flight.pattern):
            where = f"flight[{i}].pattern[{j}].kind"
            if isinstance(leg, banned):
                return f"{where}: {scenario.airframe} cannot fly {type(leg).__name__}"
            if isinstance(leg, Takeoff) != (j == 0):
                return f"{where}: a flight has one takeoff, first; got {type(leg).__name__}"
            if isinstance(leg, Land) != (j == len(flight.pattern) - 1):
                return f"{where}: a flight has one land, last; got {type(leg).__name__}"
    return None
