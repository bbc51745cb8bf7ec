"""The autopilot's state: clock, arming, compass correction, attitude, battery. What it says is in
``messages``, how it answers in ``protocol``."""

from __future__ import annotations

from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav_sim.ahrs import READ_S, Ahrs
from magmav_sim.airframe import FRAME_S, Home, State
from magmav_sim.battery import Battery
from magmav_sim.correction import Correction, heading_rad, stored_correction
from magmav_sim.faults import ArmsAfterSets, DeviceId, NoEffect, Vector
from magmav_sim.parameters import Parameters, compass_name
from magmav_sim.scenario import Scenario
from magmav_sim.world import World

_BLOCK = 4096
_READ_FRAMES = round(READ_S / FRAME_S)


class Autopilot:
    """Stepped once a frame with what is true; other modules read its fields.

    published_mg : corrected field per compass as last read (10 Hz), mG; zeros where there is none.
    raw_mg : the same before any correction, mG, the sensor's own axes.  reads : how often they were read.
    outbox : messages to send besides the streams.  ampere is true, measured_ampere what the battery
    monitor says.
    """

    def __init__(self, scenario: Scenario, world: World, seed: int) -> None:
        spec = scenario.autopilot
        self.system, self.component, self.imus = spec.system, 1, spec.imus
        self.home = Home(*(getattr(scenario.place, k) for k in ("lat_deg", "lon_deg", "alt_m")))
        self.quad = scenario.airframe == "F450"
        self.kind = dialect.MAV_TYPE_QUADROTOR if self.quad else dialect.MAV_TYPE_FIXED_WING
        self.uid = 0x6D61676D + scenario.seed
        self.outbox: list[Any] = []
        self.events: list[dict[str, object]] = []
        self.ahrs = Ahrs(spec, seed)
        self.gyro_bias_rads = self.ahrs.gyro_bias_rads
        self.parameters = Parameters()
        self._faults = scenario.faults
        self._world = world
        self._rng = np.random.default_rng([seed, 4])
        self._noise: list[float] = []
        self._unix_ns = round(scenario.date.timestamp() * 1e9)
        self._boot_at_ns = self._quiet_until_ns = 0
        self._boot_silence_ns = round(spec.boot_s * 1e9)
        self.elapsed_ns = 0
        self.armed = False
        self._armed_at_ns, self._disarm_at_ns, self._sets = 0, 0, 0
        self.mode = 0
        self.landed_state = dialect.MAV_LANDED_STATE_ON_GROUND
        self.throttle = 0.0
        self.battery = Battery(quad=self.quad, seed=seed)
        self.published_mg: list[Vector] = [(0.0, 0.0, 0.0)] * len(world.sensors)
        self.raw_mg: list[Vector | None] = [None] * len(world.sensors)
        self.reads = 0
        self._corrections: list[Correction] = []
        self._swapped: set[DeviceId] = set()
        self._frame = 0
        self._store_first(scenario)

    def _store_first(self, scenario: Scenario) -> None:
        put = self.parameters.put
        put("SYSID_THISMAV", self.system)
        for n, compass in enumerate(scenario.compasses, start=1):
            put(compass_name("DEV_ID", n), compass.device_id)
            put(f"COMPASS_PRIO{n}_ID", compass.device_id)
            put(compass_name("EXTERNAL", n), int(compass.external))
            put(compass_name("ORIENT", n), compass.orient)
        put("COMPASS_DEC", self._world.declination_rad)
        for name, value in scenario.autopilot.parameters.items():
            put(name, value)

    # ------------------------------------------------------------ clock

    @property
    def boot_ns(self) -> int:
        """Time since the last boot, ns."""
        return self.elapsed_ns - self._boot_at_ns

    @property
    def boot_ms(self) -> int:
        """Time since the last boot, ms."""
        return self.boot_ns // 1_000_000

    @property
    def unix_ns(self) -> int:
        """UNIX time by the vehicle's GPS."""
        return self._unix_ns + self.elapsed_ns

    @property
    def silent(self) -> bool:
        """Still booting: hears and says nothing."""
        return self.elapsed_ns < self._quiet_until_ns

    def reboot(self) -> None:
        """Start again: clock near zero, yaw from the compass, arming as before (a watchdog keeps it)."""
        self.note("reboot")
        self._boot_at_ns = self.elapsed_ns
        self._quiet_until_ns = self.elapsed_ns + self._boot_silence_ns
        self.outbox.clear()
        self.ahrs.align()

    # ------------------------------------------------------------ arming

    def arm(self, *, force: bool = False) -> bool:
        """Arm unless a check refuses; says why."""
        if self.armed:
            return True
        if not force and self.parameters["ARMING_CHECK"] != 0:
            for n in range(1, len(self.published_mg) + 1):
                used = self.parameters[compass_name("USE", n)] != 0
                if used and self.parameters.vector("OFS", n) == (0.0, 0.0, 0.0):
                    self.say(dialect.MAV_SEVERITY_CRITICAL, "PreArm: Compass not calibrated")
                    return False
        self.armed, self._armed_at_ns, self._disarm_at_ns = True, self.elapsed_ns, 0
        self.say(dialect.MAV_SEVERITY_INFO, "Arming motors")
        self.note("arm")
        return True

    def disarm(self) -> bool:
        """Disarm; refused in the air."""
        if self.landed_state != dialect.MAV_LANDED_STATE_ON_GROUND:
            return False
        if self.armed:
            self.armed = False
            self.say(dialect.MAV_SEVERITY_INFO, "Disarming motors")
            self.note("disarm")
        return True

    def param_was_set(self, name: str, value: float) -> None:
        """Keep what follows from a stored parameter."""
        self._sets += 1
        if not self._holds(NoEffect):
            self._corrections.clear()
        self.note("param_set", name=name, value=value)
        for fault in self._faults:
            if isinstance(fault, ArmsAfterSets) and fault.sets == self._sets:
                self.arm(force=True)
                self._disarm_at_ns = self.elapsed_ns + round(fault.seconds * 1e9)

    def _holds(self, kind: type) -> bool:
        return any(isinstance(f, kind) and f.active(self.elapsed_ns / 1e9) for f in self._faults)

    # ------------------------------------------------------------ frame

    def step(self, state: State, elapsed_ns: int, *, busy: bool) -> None:
        """One frame of truth. ``busy``: a flight is under way, so arming does not time out."""
        self.state, self.elapsed_ns = state, elapsed_ns
        self._frame += 1
        self._world.sample(state, self.battery.flow(state.load, self.armed), elapsed_ns / 1e9)
        self.ahrs.step(state)
        if self._frame % _READ_FRAMES == 0:
            self._read()
        if self.armed and not busy and self.landed_state == dialect.MAV_LANDED_STATE_ON_GROUND:
            timeout = self._armed_at_ns + int(self.parameters["DISARM_DELAY"]) * 10**9
            if elapsed_ns >= (self._disarm_at_ns or timeout):
                self.disarm()

    def _read(self) -> None:
        """The 10 Hz task: battery monitor and compasses."""
        self.reads += 1
        self.throttle = self.state.throttle
        self.battery.read(READ_S)
        self._swap_devices()
        if not self._corrections:
            count = len(self.published_mg)
            self._corrections = [stored_correction(self.parameters, n + 1) for n in range(count)]
        for i, sensor in enumerate(self._world.sensors):
            raw = self.raw_mg[i] = sensor.read()
            self.published_mg[i] = (
                (0.0, 0.0, 0.0)
                if raw is None
                else self._corrections[i].apply(raw, self.throttle, self.battery.measured_ampere)
            )
        if any(self.published_mg[0]):
            magnetic = heading_rad(self.published_mg[0], self.ahrs.roll_rad, self.ahrs.pitch_rad)
            self.ahrs.pull(magnetic + self.parameters["COMPASS_DEC"])

    def _swap_devices(self) -> None:
        for fault in self._faults:
            if isinstance(fault, DeviceId) and fault not in self._swapped and fault.active(self.elapsed_ns / 1e9):
                self._swapped.add(fault)
                self.parameters.put(compass_name("DEV_ID", fault.compass), fault.device_id)
                self.note("device_id", compass=fault.compass, device_id=fault.device_id)

    # ------------------------------------------------------------ small talk

    @property
    def roll_rad(self) -> float:
        """Roll as the autopilot believes it."""
        return self.ahrs.roll_rad

    @property
    def pitch_rad(self) -> float:
        """Pitch as the autopilot believes it."""
        return self.ahrs.pitch_rad

    @property
    def yaw_rad(self) -> float:
        """Yaw as the autopilot believes it, true north, any turn."""
        return self.ahrs.yaw_rad

    def jitter(self) -> float:
        """Accelerometer noise, m/s^2, sigma 0.05."""
        if not self._noise:
            self._noise = (self._rng.standard_normal(_BLOCK) * 0.05).tolist()
        return self._noise.pop()

    def say(self, severity: int, text: str) -> None:
        """STATUSTEXT."""
        self.outbox.append(dialect.MAVLink_statustext_message(severity, text.encode()))

    def note(self, what: str, **more: object) -> None:
        """Remember an event for the truth file."""
        self.events.append({"boot_s": self.boot_ns / 1e9, "elapsed_s": self.elapsed_ns / 1e9, "what": what, **more})
