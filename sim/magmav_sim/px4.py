"""PX4's own ways: raw streams, byte-wise parameters, calibration by device id, and a filter that learns and saves.

(autopilots.md 4.) The filter's bias is what the offsets leave over, approached with one time constant in the air,
whatever is flown; how well a real one sees it is not simulated. Compasses are read at 10 Hz like ArduPilot's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav_sim.ahrs import READ_S
from magmav_sim.autopilot import Autopilot
from magmav_sim.faults import Vector
from magmav_sim.mounting import rotation_matrix
from magmav_sim.param_manners import HASH, byte_wise
from magmav_sim.parameters import Parameters
from magmav_sim.px4_correction import Px4Correction, moved, slot_of, stored, triple
from magmav_sim.px4_messages import BUILDERS
from magmav_sim.px4_table import rows
from magmav_sim.scenario import Scenario
from magmav_sim.world import World

_NOTHING: Vector = (0.0, 0.0, 0.0)
_UPDATE_NS = 1_000_000_000  # parameters are looked at once a second
_LEARNT_S = 30.0  # so long has the bias to be stable before it may be saved
_BIAS_VARIANCE_G2 = 1e-6
_EXTERNAL, _INTERNAL = 75, 50  # CAL_MAGn_PRIO


class Px4(Autopilot):
    """applied : the correction in use per compass.  bias_b_mg : what the filter takes off the field it follows."""

    vendor = dialect.MAV_AUTOPILOT_PX4
    refused = dialect.MAV_RESULT_TEMPORARILY_REJECTED
    unknown_stream = dialect.MAV_RESULT_FAILED
    MAIN_AUTO = 4
    resting_mode = 4 << 16 | 3 << 24  # auto, loiter
    builders = BUILDERS
    streams_hz: ClassVar[Mapping[str, float]] = {
        "ATTITUDE": 20, "GLOBAL_POSITION_INT": 10, "GPS_RAW_INT": 5, "SYS_STATUS": 5, "SYSTEM_TIME": 1, "VFR_HUD": 4,
        "BATTERY_STATUS": 0.5, "EXTENDED_SYS_STATE": 1,
    }  # fmt: skip

    def __init__(self, scenario: Scenario, world: World, seed: int) -> None:
        self._external = [compass.external for compass in scenario.compasses]
        self._mounting = [np.array(rotation_matrix(compass.orient, "px4")) for compass in scenario.compasses]
        self._keep = math.exp(-READ_S / scenario.autopilot.ekf_tau_s)
        self._updated_ns = -_UPDATE_NS
        self._dirty = self._unreported = True
        self.applied: list[Px4Correction] = []
        self.bias_b_mg = np.zeros(3)
        self._learnt_s = 0.0
        self.shown_reads = 0
        super().__init__(scenario, world, seed)
        # Up to this length a change of offsets is ignored, gauss; and the variance a saved offset is taken to have.
        self._ignored_g, self._saved_variance_g2 = (0.005, 1e-6) if self.newer else (0.01, 2.5e-7)

    def first_parameters(self, scenario: Scenario) -> Parameters:
        """One slot for each compass that was calibrated once."""
        table = Parameters(rows())
        table.put("MAV_SYS_ID", self.system)
        table.put("MAV_TYPE", self.kind)
        for n, compass in enumerate(scenario.compasses):
            if compass.committed:
                table.put(f"CAL_MAG{n}_ID", compass.device_id)
                table.put(f"CAL_MAG{n}_ROT", compass.orient if compass.external else -1)
                table.put(f"CAL_MAG{n}_PRIO", _EXTERNAL if compass.external else _INTERNAL)
        return table

    @property
    def flying_mode(self) -> int:
        """Auto, mission."""
        return 4 << 16 | 4 << 24

    def takes(self, component: int) -> bool:
        """Only its own, and what is for all."""
        return component in (0, self.component)

    # ------------------------------------------------------------ compasses

    def correct(self) -> None:
        """As stored when last looked at; then the filter learns from the selected compass."""
        if not self.applied or (self._dirty and self.elapsed_ns - self._updated_ns >= _UPDATE_NS):
            self._look()
        throttle = self.throttle if self.armed else 0.0
        for i, (raw, how) in enumerate(zip(self.raw_mg, self.applied, strict=True)):
            self.published_mg[i] = _NOTHING if raw is None else how.apply(raw, throttle, self.battery.measured_ampere)
        if self.armed and self.landed_state != dialect.MAV_LANDED_STATE_ON_GROUND:
            self._learn()

    def _look(self, *, boot: bool = False) -> None:
        """ParametersUpdate: older ones not while armed; a small change of offsets only at a boot."""
        if self.applied and ((self.armed and not self.newer) or not self.effective):
            return
        self._dirty, self._unreported, self._updated_ns = False, True, self.elapsed_ns
        new = [
            stored(self.parameters, device, external=external)
            for device, external in zip(self.detected, self._external, strict=True)
        ]
        if self.applied and not boot:
            new = [
                n if moved(n.offset_g, o.offset_g) > self._ignored_g else n._replace(offset_g=o.offset_g)
                for n, o in zip(new, self.applied, strict=True)
            ]
            if any(moved(n.offset_g, o.offset_g) > 0 for n, o in zip(new, self.applied, strict=True)):
                self._forget_bias()
        self.applied = new

    def _forget_bias(self) -> None:
        """Another calibration: what was learnt with the one before is of no use."""
        self.bias_b_mg, self._learnt_s = np.zeros(3), 0.0

    def _learn(self) -> None:
        i = self.selected
        iron = self._world.sensors[i].hard_iron_mg(self.elapsed_ns / 1e9)
        left_over = self.applied[i].left_over_mg(iron, self._mounting[i])
        self.bias_b_mg = left_over + (self.bias_b_mg - left_over) * self._keep
        self._learnt_s += READ_S

    def disarmed(self) -> None:
        """SENS_MAG_AUTOCAL: a share of the bias goes into the stored offsets, and nobody is told."""
        slot = slot_of(self.parameters, self.detected[self.selected])
        if self.parameters["SENS_MAG_AUTOCAL"] != 1 or self._learnt_s < _LEARNT_S - READ_S / 2 or slot is None:
            return
        used = self.applied[self.selected]
        share = self._saved_variance_g2 / (self._saved_variance_g2 + _BIAS_VARIANCE_G2)
        new = used.offset_g + share * (used.offset_for(self.bias_b_mg) - used.offset_g)
        if moved(new, used.offset_g) <= self._ignored_g:
            return
        for axis, value in zip("XYZ", new.tolist(), strict=True):
            self.parameters.put(f"CAL_MAG{slot}_{axis}OFF", value)
        self.note("autocal", slot=slot, offset_gauss=new.tolist())
        self._updated_ns = self.elapsed_ns - _UPDATE_NS
        self._dirty = True

    @property
    def selected(self) -> int:
        """The compass the filter follows, counted from 0: there, enabled, of the highest priority."""
        return max(range(len(self.detected)), key=lambda i: (self.raw_mg[i] is not None, self._priority(i), -i))

    def _priority(self, i: int) -> int:
        slot = slot_of(self.parameters, self.detected[i])
        prio = -1 if slot is None else int(self.parameters[f"CAL_MAG{slot}_PRIO"])
        return prio if prio >= 0 else _EXTERNAL if self._external[i] else _INTERNAL

    @property
    def trusted_mg(self) -> Vector:
        """The selected compass's field less the filter's bias: HIGHRES_IMU."""
        x, y, z = self.published_mg[self.selected]
        if (x, y, z) == _NOTHING:
            return _NOTHING
        bx, by, bz = self.bias_b_mg.tolist()
        return x - bx, y - by, z - bz

    @property
    def declination_rad(self) -> float:
        """From its own table of the field."""
        return self._world.declination_rad

    def changed(self, name: str) -> None:
        """Looked at within a second."""
        self._dirty = True

    def found(self, compass: int) -> None:
        """No slot names the new sensor, unless one does."""
        self._dirty = True

    def compass_refusal(self) -> str | None:
        """Each enabled compass wants a slot that names it."""
        if self.parameters["SYS_HAS_MAG"] == 0:
            return None
        for i, device in enumerate(self.detected):
            if slot_of(self.parameters, device) is None:
                return f"Preflight Fail: Compass {i} uncalibrated"
        return None

    def rebooted(self) -> None:
        """What was too small to matter matters now."""
        self._forget_bias()
        self._look(boot=True)

    @property
    def disarm_delay_s(self) -> int:
        """COM_DISARM_PRFLT."""
        return int(self.parameters["COM_DISARM_PRFLT"])

    # ------------------------------------------------------------ wire

    def reports(self) -> list[tuple[int, list[float], list[float], list[float], int]]:
        """MAG_CAL_REPORT of each calibrated compass, once after each look at the parameters: number, offsets (gauss),
        scales, cross terms, rotation."""
        if not self._unreported:
            return []
        self._unreported = False
        out = []
        for i, device in enumerate(self.detected):
            slot = slot_of(self.parameters, device)
            if slot is not None:
                values = (triple(self.parameters, slot, stem).tolist() for stem in ("OFF", "SCALE", "ODIAG"))
                off, scale, cross = values
                out.append((i, off, scale, cross, max(0, int(self.parameters[f"CAL_MAG{slot}_ROT"]))))
        return out

    def tell(self, name: str, *, indexed: bool = False) -> None:
        """The four bytes of the value, always with the true index."""
        table = self.parameters
        self.outbox.append(byte_wise(table, name, 0 if name == HASH else table.index(name)))
