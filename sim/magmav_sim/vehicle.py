"""The simulated vehicle without any link or clock: bytes in, simulated time on, bytes out."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.mavlink.codec import Codec
from magmav_sim.airframe import FRAME_S
from magmav_sim.ardupilot import ArduPilot, LaterArduPilot
from magmav_sim.autopilot import Autopilot
from magmav_sim.faults import Reboot, SecondRoute, Signed
from magmav_sim.mission import Mission
from magmav_sim.protocol import WANTED, Protocol
from magmav_sim.px4 import Px4
from magmav_sim.scenario import Scenario, ScenarioError
from magmav_sim.second_route import Impostor
from magmav_sim.signing import Signer
from magmav_sim.streams import Streams
from magmav_sim.world import World

_FRAME_NS = round(FRAME_S * 1e9)
_KINDS: dict[tuple[str, str], type[Autopilot]] = {
    ("ardupilot", "older"): ArduPilot,
    ("ardupilot", "newer"): LaterArduPilot,
    ("px4", "older"): Px4,
    ("px4", "newer"): Px4,
}
_MOST_UNHEARD = 1000  # frames of the second route, where nobody takes them


class Truth(NamedTuple):
    """What is true now. heading_rad is true north, 0 to 2 pi; hard_iron_b_mg at zero current, one per
    compass in the order of the streams; ampere is what flows."""

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
            self.autopilot = _KINDS[scenario.autopilot.kind, scenario.autopilot.release](
                scenario, self.world, self.seed
            )
            self._streams = Streams(self.autopilot, scenario.autopilot.rates_hz)
        except ValueError as error:
            raise ScenarioError(f"scenario {scenario.name}: autopilot: {error}") from error
        self.mission = Mission(scenario, self.autopilot, self.seed)
        self._protocol = Protocol(self.autopilot, self._streams, scenario.faults, self.mission.call)
        self._codec = Codec(WANTED)
        self._received: list[Any] = []
        self._signed = [(f, Signer(bytes.fromhex(f.key), f.link_id)) for f in scenario.faults if isinstance(f, Signed)]
        self._impostors = [Impostor(f, self.autopilot) for f in scenario.faults if isinstance(f, SecondRoute)]
        self._second: deque[bytes] = deque(maxlen=_MOST_UNHEARD)
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
        signer = self._signer
        for message in self._codec.decode(data, "link", whole=whole):
            for impostor in self._impostors:
                impostor.hear(message)
            if signer is not None and not signer.believes(message, self.autopilot.unix_ns):
                continue
            if not self._protocol.answered(message):
                self._received.append(message)

    def ping(self, sequence: int) -> bytes:
        """A PING to everybody, for pacing by its answers."""
        a = self.autopilot
        message = dialect.MAVLink_ping_message(a.boot_ns // 1000, sequence, 0, 0)
        return self._encode(message)

    def second_route(self) -> list[bytes]:
        """Frames that somebody sent over another route since the last call, as though from this vehicle."""
        out = list(self._second)
        self._second.clear()
        return out

    @property
    def _signer(self) -> Signer | None:
        now_s = self.elapsed_ns / 1e9
        return next((signer for fault, signer in self._signed if fault.active(now_s)), None)

    def _encode(self, message: Any) -> bytes:
        a, signer = self.autopilot, self._signer
        if signer is not None:
            return signer.pack(message, a.system, a.component, a.unix_ns)
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
                if a.reboot_wanted:
                    break  # the rest finds nobody who listens
                self._protocol.handle(message)
        a.step(self.mission.step(), self.elapsed_ns, busy=self.mission.busy)
        if self._reboots_ns and self._reboots_ns[0] <= self.elapsed_ns:
            self._reboots_ns.pop(0)
            a.reboot_wanted = True
        for impostor in self._impostors:
            self._second.extend(impostor.frames())
        if a.reboot_wanted and not a.silent:
            self._send_outbox(out)
            self._protocol.forget()
            self._streams.reset()
            a.reboot()
        if a.silent:
            return
        self._protocol.trickle()
        self._send_outbox(out)
        for name in self._streams.due(a.boot_ns):
            built = a.builders[name](a)
            for message in built if isinstance(built, list) else [built]:
                if message is not None:
                    out.append(self._encode(message))

    def _send_outbox(self, out: list[bytes]) -> None:
        a = self.autopilot
        for message in a.outbox:
            out.append(self._encode(message))
        a.outbox.clear()
