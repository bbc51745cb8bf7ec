"""JSBSim airframes in the air, and the true state they give. On the ground see ``ground.py``.

JSBSim is used for motion only: never its magnetometer (wrong epoch, wrong place for the first thousand
samples) and never its clock. Its ground is put far below, so that touching down is ours to decide.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import jsbsim

FRAME_S = 0.01
"""One simulated frame: controls, wind and sensors change at this rate."""

_STEPS_PER_FRAME = 2
_FT = 0.3048
GRAVITY_MSS = 9.80665
_EARTH_A_M = 6378137.0
_EARTH_E2 = 6.69437999014e-3
_DEEP_FT = 3000.0  # JSBSim's terrain lies this far below our ground


class State(NamedTuple):
    """What is true of the vehicle at one instant. Angles rad, rates rad/s in body axes, specific force
    m/s^2 in body axes (level and still is -g on z), position m from home, velocity m/s north-east-down."""

    roll_rad: float
    pitch_rad: float
    heading_rad: float  # true north, 0 to 2 pi
    p_rads: float
    q_rads: float
    r_rads: float
    force_x_mss: float
    force_y_mss: float
    force_z_mss: float
    north_m: float
    east_m: float
    height_m: float
    vn_mps: float
    ve_mps: float
    vd_mps: float
    airspeed_mps: float
    throttle: float  # share of full, 0 to 1
    load: float  # sum over motors of throttle squared, what current follows


class Controls(NamedTuple):
    """Normalised commands as JSBSim takes them; ``elevator`` positive lowers a plane's nose and raises a
    quad's."""

    aileron: float
    elevator: float
    rudder: float
    throttle: float


class Home(NamedTuple):
    """Where local coordinates start."""

    lat_deg: float
    lon_deg: float
    alt_m: float

    def at(self, north_m: float, east_m: float) -> tuple[float, float]:
        """Latitude and longitude, deg, of a point near home."""
        north, east = self._metres_per_degree()
        return self.lat_deg + north_m / north, self.lon_deg + east_m / east

    def local(self, lat_deg: float, lon_deg: float) -> tuple[float, float]:
        """North and east of home, m."""
        north, east = self._metres_per_degree()
        return (lat_deg - self.lat_deg) * north, (lon_deg - self.lon_deg) * east

    def _metres_per_degree(self) -> tuple[float, float]:
        lat = math.radians(self.lat_deg)
        w2 = 1 - _EARTH_E2 * math.sin(lat) ** 2
        meridian = _EARTH_A_M * (1 - _EARTH_E2) / w2**1.5
        parallel = _EARTH_A_M / math.sqrt(w2) * math.cos(lat)
        return math.radians(meridian + self.alt_m), math.radians(parallel + self.alt_m * math.cos(lat))


@contextmanager
def _quiet() -> Iterator[None]:
    """JSBSim writes to standard output whatever its debug level; its logger for this thread is the way to
    stop it."""
    before = jsbsim.get_logger()
    jsbsim.set_logger(jsbsim.DefaultLogger(jsbsim.LogLevel.FATAL))
    try:
        yield
    finally:
        jsbsim.set_logger(before)


_READ = (
    "attitude/phi-rad",
    "attitude/theta-rad",
    "attitude/psi-rad",
    "velocities/p-rad_sec",
    "velocities/q-rad_sec",
    "velocities/r-rad_sec",
    "accelerations/a-pilot-x-ft_sec2",
    "accelerations/a-pilot-y-ft_sec2",
    "accelerations/a-pilot-z-ft_sec2",
    "position/lat-geod-deg",
    "position/long-gc-deg",
    "position/h-sl-ft",
    "velocities/v-north-fps",
    "velocities/v-east-fps",
    "velocities/v-down-fps",
    "velocities/vtrue-fps",
)
_WRITE = (
    "fcs/aileron-cmd-norm",
    "fcs/elevator-cmd-norm",
    "fcs/rudder-cmd-norm",
    "fcs/throttle-cmd-norm",
    "atmosphere/wind-north-fps",
    "atmosphere/wind-east-fps",
    "atmosphere/wind-down-fps",
)


def _node(nodes: jsbsim.FGPropertyManager, name: str) -> jsbsim.FGPropertyNode:
    node = nodes.get_node(name, True)
    if node is None:
        raise ValueError(f"airframe: JSBSim has no property {name}")
    return node


class Airframe:
    """One flight of one JSBSim model, from the state it is let go in. A new flight is a new Airframe.

    model : "F450", "c172x" or "minisgs".
    """

    def __init__(self, model: str, home: Home, start: State) -> None:
        self.model = model
        self._home = home
        with _quiet():
            self._fdm = fdm = jsbsim.FGFDMExec(None)
            fdm.set_debug_level(0)
            if not fdm.load_model(model):
                raise ValueError(f"airframe: JSBSim has no model {model!r}")
            # c172x logs to a CSV in the working directory, and disabling that still makes the file.
            fdm.set_output_filename(0, os.devnull)
            fdm.disable_output()
            fdm.set_dt(FRAME_S / _STEPS_PER_FRAME)
            lat_deg, lon_deg = home.at(start.north_m, start.east_m)
            for name, value in (
                ("ic/lat-geod-deg", lat_deg),
                ("ic/long-gc-deg", lon_deg),
                ("ic/terrain-elevation-ft", home.alt_m / _FT - _DEEP_FT),
                ("ic/h-sl-ft", (home.alt_m + start.height_m) / _FT),
                ("ic/phi-rad", start.roll_rad),
                ("ic/theta-rad", start.pitch_rad),
                ("ic/psi-true-rad", start.heading_rad),
                ("ic/vn-fps", start.vn_mps / _FT),
                ("ic/ve-fps", start.ve_mps / _FT),
                ("ic/vd-fps", start.vd_mps / _FT),
            ):
                fdm[name] = value
            if model == "F450":
                fdm["fcs/ScasEngage"] = 1.0
            fdm.run_ic()
            if model == "c172x":
                fdm["fcs/mixture-cmd-norm"] = 1.0
                fdm["propulsion/set-running"] = -1
        nodes = fdm.get_property_manager()
        motors = 4 if model == "F450" else 1 if model == "c172x" else 0
        names = [f"fcs/throttle-pos-norm[{i}]" for i in range(motors)]
        self._read = [_node(nodes, name).get_double_value for name in _READ]
        self._motors = [_node(nodes, name).get_double_value for name in names]
        self._write = [_node(nodes, name).set_double_value for name in _WRITE]

    def step(self, controls: Controls, wind_ned_mps: tuple[float, float, float]) -> State:
        """The state one frame later."""
        for write, value in zip(self._write, controls, strict=False):
            write(value)
        for write, value in zip(self._write[4:], wind_ned_mps, strict=True):
            write(value / _FT)
        for _ in range(_STEPS_PER_FRAME):
            self._fdm.run()
        return self._state(controls.throttle)

    def _state(self, throttle: float) -> State:
        phi, theta, psi, p, q, r, ax, ay, az, lat, lon, h, vn, ve, vd, va = [read() for read in self._read]
        north_m, east_m = self._home.local(lat, lon)
        motors = [read() for read in self._motors]
        return State(
            phi, theta, psi, p, q, r, ax * _FT, ay * _FT, az * _FT,
            north_m, east_m, h * _FT - self._home.alt_m, vn * _FT, ve * _FT, vd * _FT, va * _FT,
            throttle if motors else 0.0, sum(m * m for m in motors),
        )  # fmt: skip
