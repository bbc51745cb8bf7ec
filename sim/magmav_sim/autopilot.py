"""What every autopilot does: clock, arming, compasses read at 10 Hz, attitude, battery, faults.

``ardupilot`` and ``px4`` say how theirs differs; what is in a message is in ``messages`` and ``px4_messages``, how
parameters and commands are answered in ``param_manners`` and ``protocol``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav_sim.ahrs import READ_S, Ahrs
from magmav_sim.airframe import FRAME_S, Home, State
from magmav_sim.battery import Battery
from magmav_sim.correction import heading_rad
from magmav_sim.faults import ArmsAfterSets, DeviceId, NoEffect, RebootAfterSets, SecondWriter, Vector
from magmav_sim.parameters import Parameters
from magmav_sim.scenario import Scenario
from magmav_sim.world import World

_BLOCK = 4096
_READ_FRAMES = round(READ_S / FRAME_S)
_NOTHING: Vector = (0.0, 0.0, 0.0)


class Autopilot(ABC):
    """Stepped once a frame with what is true; other modules read its fields.

    published_mg : corrected field per compass as last read (10 Hz), mG, body axes; zeros where there is none.
    raw_mg : the same before any correction, mG, the sensor's own axes.  reads : how often they were read.
    detected : device id of the sensor that is there, one per compass..
    outbox : messages to send besides the streams.  ampere is true, measured_ampere what the battery
    monitor says.  reboot_wanted : it restarts at the end of this frame.
    """

    vendor: ClassVar[int]
    refused: ClassVar[int] = dialect.MAV_RESULT_FAILED
    """MAV_RESULT of what is not done now."""
    unknown_stream: ClassVar[int] = dialect.MAV_RESULT_DENIED
    """MAV_RESULT of SET_MESSAGE_INTERVAL for a message it does not have."""
    resting_mode: ClassVar[int] = 0
    builders: ClassVar[Mapping[str, Callable[[Any], Any]]]
    groups: ClassVar[Mapping[int, tuple[str, ...]]] = {}
    """Messages of REQUEST_DATA_STREAM, by group."""
    streams_hz: ClassVar[Mapping[str, float]] = {}
    """What it sends without being asked."""

    def __init__(self, scenario: Scenario, world: World, seed: int) -> None:
        spec = scenario.autopilot
        self.system, self.component, self.imus = spec.system, 1, spec.imus
        self.newer = spec.release == "newer"
        self.home = Home(*(getattr(scenario.place, k) for k in ("lat_deg", "lon_deg", "alt_m")))
        self.quad = scenario.airframe == "F450"
        self.kind = dialect.MAV_TYPE_QUADROTOR if self.quad else dialect.MAV_TYPE_FIXED_WING
        self.uid = 0x6D61676D + scenario.seed if spec.uid is None else spec.uid
        self.outbox: list[Any] = []
        self.events: list[dict[str, object]] = []
        self.ahrs = Ahrs(spec, seed)
        self.gyro_bias_rads = self.ahrs.gyro_bias_rads
        self._faults = scenario.faults
        self._world = world
        self._rng = np.random.default_rng([seed, 4])
        self._noise: list[float] = []
        self._unix_ns = round(scenario.date.timestamp() * 1e9)
        self._boot_at_ns = self._quiet_until_ns = 0
        self._boot_silence_ns = round(spec.boot_s * 1e9)
        self.elapsed_ns = 0
        self.armed = self.reboot_wanted = False
        self._armed_at_ns, self._disarm_at_ns, self._sets = 0, 0, 0
        self._unsaved: list[tuple[str, float]] = []  # as it was before, and is again after a boot
        self.mode = self.resting_mode
        self.landed_state = dialect.MAV_LANDED_STATE_ON_GROUND
        self.throttle = 0.0
        self.battery = Battery(quad=self.quad, seed=seed)
        self.published_mg: list[Vector] = [_NOTHING] * len(world.sensors)
        self.raw_mg: list[Vector | None] = [None] * len(world.sensors)
        self.detected = [compass.device_id for compass in scenario.compasses]
        self.reads = 0
        self._happened: set[DeviceId | SecondWriter] = set()
        self._frame = 0
        self.parameters = self.first_parameters(scenario)
        for name, value in spec.parameters.items():
            self.parameters.put(name, value)
        for fault in scenario.faults:
            if isinstance(fault, SecondWriter) and fault.name not in self.parameters:
                raise ValueError(f"fault second_writer: no parameter {fault.name!r}")

    # ------------------------------------------------------------ what is its own

    @abstractmethod
    def first_parameters(self, scenario: Scenario) -> Parameters:
        """The table before the scenario's own values."""

    @abstractmethod
    def correct(self) -> None:
        """From raw_mg to published_mg, by what is stored, after each reading."""

    @abstractmethod
    def changed(self, name: str) -> None:
        """A stored value is another one now."""

    @abstractmethod
    def compass_refusal(self) -> str | None:
        """What the compasses have against arming, as the autopilot says it."""

    @abstractmethod
    def tell(self, name: str, *, indexed: bool = False) -> None:
        """Put a PARAM_VALUE into the outbox; ``indexed``: as part of a list."""

    @property
    @abstractmethod
    def declination_rad(self) -> float:
        """What it adds to a magnetic heading."""

    @property
    def flying_mode(self) -> int:
        """custom_mode of a mission."""
        return 3 if self.quad else 10

    @property
    def trusted_mg(self) -> Vector:
        """The field its heading follows, mG, body axes; zeros: none."""
        return self.published_mg[0]

    def takes(self, component: int) -> bool:
        """Whether a message for this component of its system is its own business."""
        return True

    @abstractmethod
    def rebooted(self) -> None:
        """Read anew what is read at a boot."""

    @abstractmethod
    def disarmed(self) -> None:
        """Do what follows a disarm."""

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
        self.reboot_wanted = False
        for name, value in reversed(self._unsaved):
            self.parameters.put(name, value)
        self._unsaved.clear()
        self._boot_at_ns = self.elapsed_ns
        self._quiet_until_ns = self.elapsed_ns + self._boot_silence_ns
        self.outbox.clear()
        self.ahrs.align()
        self.rebooted()

    # ------------------------------------------------------------ arming

    def arm(self, *, force: bool = False) -> bool:
        """Arm unless a check refuses; says why."""
        if self.armed:
            return True
        why = None if force else self.compass_refusal()
        if why is not None:
            self.say(dialect.MAV_SEVERITY_CRITICAL, why)
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
            self.disarmed()
        return True

    # ------------------------------------------------------------ parameters

    def param_was_set(self, name: str, before: float) -> None:
        """A PARAM_SET was stored over ``before``: what follows from it."""
        self._sets += 1
        self.changed(name)
        self.note("param_set", name=name, value=self.parameters[name])
        for fault in self._faults:
            if getattr(fault, "sets", None) != self._sets:
                continue
            if isinstance(fault, ArmsAfterSets):
                self.arm(force=True)
                self._disarm_at_ns = self.elapsed_ns + round(fault.seconds * 1e9)
            elif isinstance(fault, RebootAfterSets):
                self.reboot_wanted = True
                if fault.lost:
                    self._unsaved.append((name, before))
            elif isinstance(fault, SecondWriter):
                self._written_by_another(fault)

    def _written_by_another(self, fault: SecondWriter) -> None:
        self.parameters.put(fault.name, fault.value)
        self.changed(fault.name)
        self.note("second_writer", name=fault.name, value=self.parameters[fault.name])
        if fault.echoed:
            self.tell(fault.name)

    def holds(self, kind: type) -> bool:
        """Whether a fault of this kind is happening."""
        return any(isinstance(f, kind) and f.active(self.elapsed_ns / 1e9) for f in self._faults)

    @property
    def effective(self) -> bool:
        """Whether stored values are used at all."""
        return not self.holds(NoEffect)

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
            timeout = self._armed_at_ns + 10**9 * self.disarm_delay_s
            if elapsed_ns >= (self._disarm_at_ns or timeout):
                self.disarm()

    @property
    def disarm_delay_s(self) -> int:
        """How long it stands armed before it disarms by itself."""
        return 10

    def _read(self) -> None:
        """The 10 Hz task: battery monitor and compasses."""
        self.reads += 1
        self.throttle = self.state.throttle
        self.battery.read(READ_S)
        self._timed_faults()
        for i, sensor in enumerate(self._world.sensors):
            self.raw_mg[i] = sensor.read()
        self.correct()
        if any(self.trusted_mg):
            magnetic = heading_rad(self.trusted_mg, self.ahrs.roll_rad, self.ahrs.pitch_rad)
            self.ahrs.pull(magnetic + self.declination_rad)

    def _timed_faults(self) -> None:
        for fault in self._faults:
            if not isinstance(fault, (DeviceId, SecondWriter)) or fault in self._happened:
                continue
            if not fault.active(self.elapsed_ns / 1e9):
                continue
            self._happened.add(fault)
            if isinstance(fault, DeviceId):
                self.detected[fault.compass - 1] = fault.device_id
                self.found(fault.compass)
                self.note("device_id", compass=fault.compass, device_id=fault.device_id)
            elif fault.sets is None:
                self._written_by_another(fault)

    @abstractmethod
    def found(self, compass: int) -> None:
        """Another sensor is where this compass was."""

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
