"""From a name or a TOML file to a checked Scenario, or to an error that names file, key and value."""

from __future__ import annotations

import math
import re
import tomllib
from pathlib import Path
from typing import Any

import msgspec

from magmav_sim.patterns import PLANE_ONLY, QUAD_ONLY, Land, Takeoff
from magmav_sim.scenario import Scenario, ScenarioError


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
