"""ArduPilot 4.5's own ways: C-cast parameters, corrected streams, device ids that a PARAM_SET does not commit.

(autopilots.md 1 to 3.) The order of the compasses is that of COMPASS_PRIOn_ID as it was at the last boot; a boot
moves the parameter blocks so that block n is compass n again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav_sim.autopilot import Autopilot
from magmav_sim.correction import Correction, stored_correction
from magmav_sim.faults import Vector
from magmav_sim.messages import BUILDERS, highres_of_a_bad_build
from magmav_sim.parameters import Parameters, compass_name
from magmav_sim.scenario import Scenario
from magmav_sim.world import World

_NO_INDEX = 65535
_NOTHING: Vector = (0.0, 0.0, 0.0)
_BLOCK = ("OFS", "DIA", "ODI", "MOT")
_SINGLE = ("SCALE", "USE", "ORIENT", "EXTERNAL", "DEV_ID")
_GROUPS = {
    1: ("RAW_IMU", "SCALED_IMU2", "SCALED_IMU3"),
    2: ("SYS_STATUS", "GPS_RAW_INT"),
    3: (),
    6: ("GLOBAL_POSITION_INT",),
    10: ("ATTITUDE",),
    11: ("VFR_HUD",),
    12: ("BATTERY_STATUS", "SYSTEM_TIME"),
}


class ArduPilot(Autopilot):
    """committed : the device id that is stored with each compass's calibration; not to be seen from outside."""

    vendor = dialect.MAV_AUTOPILOT_ARDUPILOTMEGA
    builders: ClassVar[Mapping[str, Callable[[Any], Any]]] = BUILDERS
    groups = _GROUPS

    def __init__(self, scenario: Scenario, world: World, seed: int) -> None:
        self._declination_rad = world.declination_rad
        self._corrections: list[Correction] = []
        super().__init__(scenario, world, seed)
        self.committed = [c.device_id if c.committed else 0 for c in scenario.compasses]
        self._priority = self._wanted_priority()

    def first_parameters(self, scenario: Scenario) -> Parameters:
        """Device ids, mountings and the declination it has learnt."""
        table = Parameters(renamed=scenario.autopilot.naming == "new")
        table.put("SYSID_THISMAV", self.system)
        for n, compass in enumerate(scenario.compasses, start=1):
            table.put(compass_name("DEV_ID", n), compass.device_id)
            table.put(f"COMPASS_PRIO{n}_ID", compass.device_id)
            table.put(compass_name("EXTERNAL", n), int(compass.external))
            table.put(compass_name("ORIENT", n), compass.orient)
        table.put("COMPASS_DEC", self._declination_rad)
        return table

    # ------------------------------------------------------------ compasses

    def correct(self) -> None:
        """As stored, at once: nothing waits for a boot."""
        if not self._corrections:
            self._corrections = [stored_correction(self.parameters, n + 1) for n in range(len(self.raw_mg))]
        for i, (raw, how) in enumerate(zip(self.raw_mg, self._corrections, strict=True)):
            self.published_mg[i] = (
                _NOTHING if raw is None else how.apply(raw, self.throttle, self.battery.measured_ampere)
            )

    def changed(self, name: str) -> None:
        """Used from the next reading on. Storing a device id commits it; storing offsets does not."""
        if self.effective:
            self._corrections.clear()
        for i in range(len(self.detected)):
            if name == self.parameters.said(compass_name("DEV_ID", i + 1)):
                self.committed[i] = int(self.parameters[name])

    def commit(self) -> None:
        """PREFLIGHT_CALIBRATION with 76: what is there now counts as calibrated."""
        self.committed = list(self.detected)

    def found(self, compass: int) -> None:
        """The device id shown is that of the sensor."""
        self.parameters.put(compass_name("DEV_ID", compass), self.detected[compass - 1])

    def calibrated(self, compass: int) -> bool:
        """Compass::configured: offsets, and the id stored with them is that of the sensor."""
        set_up = self.parameters.vector("OFS", compass) != _NOTHING
        return set_up and self.committed[compass - 1] == self.detected[compass - 1]

    def compass_refusal(self) -> str | None:
        """Of the compasses in use; none with ARMING_CHECK 0."""
        if self.parameters["ARMING_CHECK"] == 0:
            return None
        if self._wanted_priority() != self._priority:
            return "PreArm: Compass order change requires reboot"
        for n in range(1, len(self.detected) + 1):
            if self.parameters[compass_name("USE", n)] != 0 and not self.calibrated(n):
                return "PreArm: Compass not calibrated"
        return None

    def _wanted_priority(self) -> list[int]:
        return [int(self.parameters[f"COMPASS_PRIO{n}_ID"]) for n in range(1, len(self.detected) + 1)]

    def rebooted(self) -> None:
        """Device ids as found; blocks, sensors and streams in the order of the priorities."""
        for n in range(1, len(self.detected) + 1):
            self.found(n)
        self._priority = wanted = self._wanted_priority()
        if sorted(wanted) == sorted(self.detected) and len(set(wanted)) == len(wanted):
            self._reorder([self.detected.index(device) for device in wanted])
        if self.effective:
            self._corrections.clear()

    def _reorder(self, order: list[int]) -> None:
        """Block n becomes what block order[n] was."""
        held = [{name(i + 1): self.parameters[name(i + 1)] for name in _NAMES} for i in order]
        for n, block in enumerate(held, start=1):
            for name, value in zip(_NAMES, block.values(), strict=True):
                self.parameters.put(name(n), value)
        self._world.sensors[:] = [self._world.sensors[i] for i in order]
        self.detected = [self.detected[i] for i in order]
        self.committed = [self.committed[i] for i in order]
        self.raw_mg = [self.raw_mg[i] for i in order]
        self.published_mg = [self.published_mg[i] for i in order]

    def disarmed(self) -> None:
        """Nothing: COMPASS_LEARN is not simulated."""

    @property
    def declination_rad(self) -> float:
        """COMPASS_DEC."""
        return self.parameters["COMPASS_DEC"]

    @property
    def disarm_delay_s(self) -> int:
        """DISARM_DELAY."""
        return int(self.parameters["DISARM_DELAY"])

    # ------------------------------------------------------------ wire

    def tell(self, name: str, *, indexed: bool = False) -> None:
        """A number as a float, whatever its type; no index but in a list."""
        table = self.parameters
        name = table.said(name)
        index = table.index(name) if indexed else _NO_INDEX
        self.outbox.append(
            dialect.MAVLink_param_value_message(name.encode(), table[name], table.kind(name), len(table), index)
        )


class LaterArduPilot(ArduPilot):
    """A release that can send HIGHRES_IMU too, and has its units wrong."""

    builders: ClassVar[Mapping[str, Callable[[Any], Any]]] = {**BUILDERS, "HIGHRES_IMU": highres_of_a_bad_build}


def _naming(stem: str, axis: str) -> Any:
    return lambda compass: compass_name(stem, compass, axis)


_NAMES = [_naming(stem, axis) for stem in _BLOCK for axis in "XYZ"] + [_naming(stem, "") for stem in _SINGLE]
