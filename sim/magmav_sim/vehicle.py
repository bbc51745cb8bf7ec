"""The simulated vehicle without any link or clock: bytes in, simulated time on, bytes out."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.mavlink.codec import Codec
from magmav_sim.airframe import FRAME_S
from magmav_sim.autopilot import Autopilot
from magmav_sim.faults import Reboot
from magmav_sim.messages import BUILDERS
from magmav_sim.mission import Mission
from magmav_sim.protocol import WANTED, Protocol
from magmav_sim.scenario import Scenario, ScenarioError
from magmav_sim.streams import Streams
from magmav_sim.world import World

_FRAME_NS = round(FRAME_S * 1e9)


class Truth(NamedTuple):
    """What is true now. heading_rad is true north, 0 to 2 pi; hard_iron_b_mg at zero current, one per
    compass; ampere is what flows."""

    elapsed_s: float
    boot_s: float
    roll_rad: float
    pitch_rad: float
    heading_rad: float
    height_m: float
    ampere: float
    armed: bool
    hard_iron_b_mg: tuple[tuple[float, float, float], ...]


class Simulation:
    """One scenario being flown. Same scenario, seed and received bytes at the same times: the same bytes out.

    watchers : called after every frame of 10 ms with the frames it sent; they change nothing.
    seed replaces the scenario's own when given. ScenarioError when names in the scenario are not the
    autopilot's.
    """

    def __init__(self, scenario: Scenario, seed: int | None = None) -> None:
        self.scenario = scenario
        self.seed = scenario.seed if seed is None else seed
        self.world = World(scenario, self.seed)
        try:
            self.autopilot = Autopilot(scenario, self.world, self.seed)
            self._streams = Streams(scenario.autopilot.rates_hz)
        except ValueError as error:
            raise ScenarioError(f"scenario {scenario.name}: autopilot: {error}") from error
        self.mission = Mission(scenario, self.autopilot, self.seed)
        self._protocol = Protocol(self.autopilot, self._streams, scenario.faults, self.mission.call)
        self._codec = Codec(WANTED)
        self._received: list[Any] = []
        self._reboots_ns = sorted(round(f.at_s * 1e9) for f in scenario.faults if isinstance(f, Reboot))
        self._owed_ns = 0
        self.elapsed_ns = 0
        self.watchers: list[Callable[[list[bytes]], None]] = []
        self.autopilot.step(self.mission.state, 0, busy=False)

    @property
    def boot_ns(self) -> int:
        """The vehicle's own clock."""
        return self.autopilot.boot_ns

    @property
    def finished(self) -> bool:
        """Every flight is over, and the time on the ground after the last one too."""
        return self.mission.finished

    @property
    def pong(self) -> int:
        """Highest sequence number of our pings that somebody answered; -1 before the first."""
        return self._protocol.pong

    @property
    def truth(self) -> Truth:
        """What is true now."""
        s, t_s = self.autopilot.state, self.elapsed_ns / 1e9
        return Truth(
            t_s,
            self.boot_ns / 1e9,
            s.roll_rad,
            s.pitch_rad,
            s.heading_rad % math.tau,
            s.height_m,
            self.autopilot.battery.ampere,
            self.autopilot.armed,
            tuple(sensor.hard_iron_mg(t_s) for sensor in self.world.sensors),
        )

    def receive(self, data: bytes, *, whole: bool = True) -> None:
        """Bytes for the vehicle; it reacts in the next frame. ``whole``: a datagram of whole frames."""
        for message in self._codec.decode(data, "link", whole=whole):
            if not self._protocol.answered(message):
                self._received.append(message)

    def ping(self, sequence: int) -> bytes:
        """A PING to everybody, for pacing by its answers."""
        a = self.autopilot
        message = dialect.MAVLink_ping_message(a.boot_ns // 1000, sequence, 0, 0)
        return self._codec.encode(message, a.system, a.component)

    def advance(self, dt_s: float) -> list[bytes]:
        """Let simulated time go on (whole frames of 10 ms; the rest is kept for the next call). Frames to
        send."""
        self._owed_ns += round(dt_s * 1e9)
        out: list[bytes] = []
        while self._owed_ns >= _FRAME_NS and not self.finished:
            self._owed_ns -= _FRAME_NS
            self.elapsed_ns += _FRAME_NS
            before = len(out)
            self._frame(out)
            for watch in self.watchers:
                watch(out[before:])
        return out

    def _frame(self, out: list[bytes]) -> None:
        a = self.autopilot
        received, self._received = self._received, []
        if not a.silent:
            for message in received:
                self._protocol.handle(message)
        a.step(self.mission.step(), self.elapsed_ns, busy=self.mission.busy)
        if self._reboots_ns and self._reboots_ns[0] <= self.elapsed_ns:
            self._reboots_ns.pop(0)
            self._protocol.reboot_wanted = True
        if self._protocol.reboot_wanted and not a.silent:
            self._send_outbox(out)
            self._protocol.reboot_wanted = False
            self._protocol.forget()
            self._streams.reset()
            a.reboot()
        if a.silent:
            return
        self._protocol.trickle()
        self._send_outbox(out)
        for name in self._streams.due(a.boot_ns):
            message = BUILDERS[name](a)
            if message is not None:
                out.append(self._codec.encode(message, a.system, a.component))

    def _send_outbox(self, out: list[bytes]) -> None:
        a = self.autopilot
        for message in a.outbox:
            out.append(self._codec.encode(message, a.system, a.component))
        a.outbox.clear()
