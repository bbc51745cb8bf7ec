"""A bench for the simulator's tests: scenarios from a few words, and a ground station with its own parser."""

from __future__ import annotations

from typing import Any

import numpy as np
from magmav_sim import Simulation, parse_scenario
from pymavlink.dialects.v20 import ardupilotmega as dialect

HEAD = """
seed = 5
airframe = "F450"
date = 2026-11-22T10:00:00Z
place = { lat_deg = 47.3977, lon_deg = 8.5456, alt_m = 488.0 }
heading_deg = 70.0
"""
COMPASS = """
[[compass]]
device_id = 97539
hard_iron_mg = [100.0, -50.0, 200.0]
noise_mg = 0.0
"""


def simulation(
    body: str = COMPASS, top: str = "stay = true", seed: int | None = None, airframe: str = "F450"
) -> Simulation:
    """Standing on the ground for ever, unless the words say otherwise."""
    return Simulation(parse_scenario((HEAD.replace("F450", airframe) + top + "\n" + body).encode(), "bench.toml"), seed)


def iron_free(parameters: str = "", rest: str = "") -> Simulation:
    """One compass without iron or noise, and stored parameters."""
    body = "[[compass]]\ndevice_id = 97539\nhard_iron_mg = [0.0, 0.0, 0.0]\nnoise_mg = 0.0\n"
    return simulation(body + rest + "\n[autopilot.parameters]\n" + parameters)


class Ground:
    """Somebody on the other end: sends as (system, component), hears everything, remembers it."""

    def __init__(self, sim: Simulation, system: int = 255, component: int = 190) -> None:
        self.sim = sim
        self.heard: list[Any] = []
        self._mav = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
        self._mav.robust_parsing = False

    def send(self, message: Any) -> None:
        self.sim.receive(bytes(message.pack(self._mav)))

    def run(self, seconds: float) -> list[Any]:
        """Messages of the next seconds of simulated time."""
        new = []
        for frame in self.sim.advance(seconds):
            new += self._mav.parse_buffer(frame) or []
        self.heard += new
        return new

    def of(self, name: str, seconds: float) -> list[Any]:
        """The messages of one name in the next seconds."""
        return [m for m in self.run(seconds) if m.get_type() == name]

    def command(self, number: int, *params: float, component: int = 1) -> int:
        """Send a COMMAND_LONG; its result."""
        values = [*params, *[0.0] * (7 - len(params))]
        self.send(dialect.MAVLink_command_long_message(1, component, number, 0, *values))
        (ack,) = [m for m in self.run(0.02) if m.get_type() == "COMMAND_ACK"]
        assert ack.command == number
        return int(ack.result)

    def stream(self, message: int, hertz: float) -> int:
        return self.command(511, message, 1e6 / hertz)

    def set(self, name: str, value: float, component: int = 1) -> list[Any]:
        """PARAM_SET; the PARAM_VALUEs that follow."""
        self.send(dialect.MAVLink_param_set_message(1, component, name.encode(), value, 9))
        return self.of("PARAM_VALUE", 0.02)

    def read(self, name: str = "", index: int = -1) -> list[Any]:
        """PARAM_REQUEST_READ; the PARAM_VALUEs that follow."""
        self.send(dialect.MAVLink_param_request_read_message(1, 1, name.encode(), index))
        return self.of("PARAM_VALUE", 0.02)

    def field(self) -> np.ndarray:
        """The latest RAW_IMU field after settling for 0.3 s, mG (its stream must be on)."""
        return mag(self.of("RAW_IMU", 0.3)[-1])


def mag(message: Any) -> np.ndarray:
    return np.array([message.xmag, message.ymag, message.zmag], dtype=float)


def body_from_ned(roll: float, pitch: float, heading: float) -> np.ndarray:
    """Direction cosines, earth to body, built from three elementary turns."""
    cr, sr, cp, sp, ch, sh = (f(a) for a in (roll, pitch, heading) for f in (np.cos, np.sin))
    about_x = np.array([[1, 0, 0], [0, cr, sr], [0, -sr, cr]])
    about_y = np.array([[cp, 0, -sp], [0, 1, 0], [sp, 0, cp]])
    about_z = np.array([[ch, sh, 0], [-sh, ch, 0], [0, 0, 1]])
    return about_x @ about_y @ about_z
