"""One table for every knob: default, unit, limits, TOML key, parameter name, and what it does.

The TOML file, `--help`, the parameter server and config/default.toml all come from these classes. An unknown key and
a value out of range are refused by name.
"""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta, Struct, field

from magmav.core.estimators import ESTIMATORS
from magmav.core.motion import OWN_TILTS
from magmav.core.published import SMOOTHINGS


class SettingsError(ValueError):
    """A settings file or value that cannot be used; the text names file, key and limits."""


def _knob(
    text: str,
    unit: str = "",
    param: str = "",
    ge: float | None = None,
    le: float | None = None,
    choices: tuple[str, ...] = (),
) -> Meta:
    """``param``: its name on the wire. Without one it is fixed from the start: who we are, where we are, what kind of
    sensor and estimator, and what only makes sense on the bench."""
    return Meta(description=text, ge=ge, le=le, extra={"unit": unit, "param": param, "choices": choices})


class Vehicle(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Who is listened to, and who we are."""

    system: Annotated[int, _knob("system id to serve; 0: the one autopilot heard", ge=0, le=255)] = 0
    component: Annotated[int, _knob("our own component id", ge=1, le=250)] = 191


class Place(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A position given by hand, for vehicles without GPS. Used until the vehicle reports its own."""

    lat_deg: Annotated[float, _knob("latitude; nan: not given", "deg")] = math.nan
    lon_deg: Annotated[float, _knob("longitude; nan: not given", "deg")] = math.nan
    alt_m: Annotated[float, _knob("altitude above mean sea level", "m", ge=-500.0, le=20000.0)] = 0.0


class Compass(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What kind of sensor the compass is."""

    axes: Annotated[
        int, _knob("3, or 2: only x and y are used, the third comes from the dip of the place", ge=2, le=3)
    ] = 3


class Attitude(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where the tilt comes from while the vehicle sends no ATTITUDE; the yaw never teaches anything."""

    own: Annotated[str, _knob("taken at the start: " + ", ".join(OWN_TILTS))] = "marg_gn"


class Heading(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How the published heading is made of the measured ones."""

    smooth: Annotated[
        str,
        _knob(
            "one of " + ", ".join(SMOOTHINGS) + "; fixed_lag is smoothest and late",
            param="MMAG_SMOOTH",
            choices=tuple(SMOOTHINGS),
        ),
    ] = "off"
    lag: Annotated[int, _knob("how late fixed_lag publishes", "samples", "MMAG_LAG", 1, 200)] = 10


class Learn(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What is learnt from, and how."""

    on: Annotated[bool, _knob("learn at all; off: what is known is kept and published", param="MMAG_LEARN")] = True
    estimator: Annotated[str, _knob("one of " + ", ".join(ESTIMATORS), ge=None)] = "adaptive"
    on_ground: Annotated[bool, _knob("--bench: what flies learns, and may be ready, on the ground too")] = False
    settle_s: Annotated[
        float, _knob("not learnt from after a change of compass parameters", "s", "MMAG_SETTLE", 0.2, 10.0)
    ] = 1.0


class Gate(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """When an estimate is ready to be written."""

    axis_sigma_mg: Annotated[
        float, _knob("an axis is written only at or under this sigma", "mG", "MMAG_GATE_SD", 2.0, 10.0)
    ] = 10.0
    heading_sigma_deg: Annotated[
        float, _knob("heading sigma the offsets may cause", "deg", "MMAG_GATE_HDG", 0.5, 5.0)
    ] = 3.0
    residual_mg: Annotated[float, _knob("largest RMS of the fit", "mG", "MMAG_GATE_RES", 5.0, 60.0)] = 30.0
    field_share: Annotated[
        float,
        _knob("largest misfit of field strength, as a share of the model's", "", "MMAG_GATE_FLD", 0.02, 0.3),
    ] = 0.15
    steady_s: Annotated[
        float, _knob("the estimate must have stood still this long", "s", "MMAG_GATE_STDY", 2.0, 60.0)
    ] = 10.0
    change_s: Annotated[float, _knob("wait this long after a sudden change", "s", "MMAG_GATE_CHG", 2.0, 120.0)] = 15.0
    samples: Annotated[int, _knob("least number of distinct readings", "", "MMAG_GATE_N", 20, 10000)] = 100


class Wire(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What is sent, and how much of it."""

    heading_hz: Annotated[float, _knob("NAMED_VALUE_FLOAT heading", "Hz", "MMAG_HDG_RATE", 0.0, 20.0)] = 2.0
    budget_bps: Annotated[float, _knob("own downlink at most", "B/s", "MMAG_BUDGET", 100.0, 100000.0)] = 500.0
    imu_hz: Annotated[float, _knob("RAW_IMU, SCALED_IMU2, SCALED_IMU3 asked for", "Hz", "MMAG_IMU_HZ", 0.0, 100.0)] = (
        20.0
    )
    attitude_hz: Annotated[float, _knob("ATTITUDE asked for", "Hz", "MMAG_ATT_HZ", 0.0, 100.0)] = 20.0
    slow_hz: Annotated[
        float, _knob("position, battery, throttle, time, landed state asked for", "Hz", "MMAG_SLOW_HZ", 0.0, 10.0)
    ] = 2.0


class Upload(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Limits of a write. Nothing is ever written unasked."""

    confirm_above_mg: Annotated[
        float, _knob("a larger change of an axis wants the confirmation code", "mG", "MMAG_CONF_ABOVE", 10.0, 150.0)
    ] = 150.0


class Coach(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The next motion that would teach most, and what is wrong with a compass, in words."""

    say: Annotated[
        bool, _knob("say it by STATUSTEXT too, at most every 30 s; `magmav run` always shows it", param="MMAG_COACH")
    ] = False


class Settings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Everything that can be chosen."""

    vehicle: Vehicle = field(default_factory=Vehicle)
    place: Place = field(default_factory=Place)
    compass: Compass = field(default_factory=Compass)
    attitude: Attitude = field(default_factory=Attitude)
    heading: Heading = field(default_factory=Heading)
    learn: Learn = field(default_factory=Learn)
    gate: Gate = field(default_factory=Gate)
    wire: Wire = field(default_factory=Wire)
    upload: Upload = field(default_factory=Upload)
    coach: Coach = field(default_factory=Coach)


class Knob(Struct, frozen=True):
    """One row of the table."""

    section: str
    key: str
    default: Any
    kind: str
    unit: str
    param: str
    low: float | None
    high: float | None
    text: str
    choices: tuple[str, ...] = ()  # of a text; on the wire its place in this list


@cache
def knobs() -> tuple[Knob, ...]:
    """The whole table, in order."""
    rows = []
    for section in msgspec.structs.fields(Settings):
        for f in msgspec.structs.fields(section.type):
            info: Any = msgspec.inspect.type_info(f.type)
            meta = f.type.__metadata__[0]
            kind = type(info.type if hasattr(info, "type") else info).__name__.removesuffix("Type").lower()
            rows.append(
                Knob(
                    section.name,
                    f.name,
                    f.default,
                    kind,
                    meta.extra["unit"],
                    meta.extra["param"],
                    meta.ge,
                    meta.le,
                    meta.description,
                    meta.extra["choices"],
                )
            )
    return tuple(rows)


def load(path: Path | None) -> Settings:
    """Settings from a TOML file over the defaults. SettingsError names file, key and what is allowed."""
    if path is None:
        return Settings()
    try:
        text = path.read_bytes()
    except OSError as error:
        raise SettingsError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        got = msgspec.toml.decode(text, type=Settings)
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path}: {error}") from None
    return checked(got, str(path))


def checked(settings: Settings, where: str) -> Settings:
    """The same settings, once rules that span values hold. SettingsError otherwise."""
    place = settings.place
    if math.isnan(place.lat_deg) != math.isnan(place.lon_deg):
        raise SettingsError(f"{where}: place: give lat_deg and lon_deg together")
    if abs(place.lat_deg) > 90.0 or abs(place.lon_deg) > 180.0:
        raise SettingsError(f"{where}: place: {place.lat_deg}, {place.lon_deg} is not on Earth")
    if settings.learn.estimator not in ESTIMATORS:
        raise SettingsError(f"{where}: learn.estimator: {settings.learn.estimator!r}; choose {', '.join(ESTIMATORS)}")
    if settings.attitude.own not in OWN_TILTS:
        raise SettingsError(f"{where}: attitude.own: {settings.attitude.own!r}; choose {', '.join(OWN_TILTS)}")
    if settings.heading.smooth not in SMOOTHINGS:
        raise SettingsError(f"{where}: heading.smooth: {settings.heading.smooth!r}; choose {', '.join(SMOOTHINGS)}")
    return settings


def with_value(settings: Settings, section: str, key: str, value: object) -> Settings:
    """A copy with one value changed. SettingsError when it is out of range or no such key exists."""
    tree = msgspec.to_builtins(settings)
    if section not in tree or key not in tree[section]:
        raise SettingsError(f"no setting called {section}.{key}")
    tree[section][key] = value
    try:
        return checked(msgspec.convert(tree, Settings, strict=True), f"{section}.{key}")
    except msgspec.ValidationError as error:
        raise SettingsError(f"{section}.{key}: {error}") from None


def as_toml() -> str:
    """config/default.toml: every knob at its default, with unit, limits and meaning."""
    lines = ["# Every setting of magmav at its default. Made by `magmav settings`; do not edit, copy what you change."]
    section = ""
    for k in knobs():
        if k.section != section:
            section = k.section
            lines += ["", f"[{section}]"]
        limits = f", {k.low:g} to {k.high:g}" if k.low is not None and k.high is not None else ""
        unit = f" [{k.unit}{limits}]" if k.unit else f" [{limits[2:]}]" if limits else ""
        param = f" ({k.param})" if k.param else ""
        lines.append(f"{k.key} = {_toml(k.default)}  # {k.text}{unit}{param}")
    return "\n".join(lines) + "\n"


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else str(value)
