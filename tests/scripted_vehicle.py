"""A scripted ArduPilot for the tests of the wire machines: plain Python, its own clock, seeded damage.

Written from what ArduPilot was observed to do (echo with index 65535, silence on unknown names, offsets
added to the stream at once, no arm check on PARAM_SET), not from the code under test. Messages cross a real
encode and decode.
"""

from __future__ import annotations

import heapq
import math
import random
import struct
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.mavlink.codec import Codec, Outgoing

MS = 1_000_000
S = 1_000 * MS


def f32(value: float) -> float:
    return float(struct.unpack("<f", struct.pack("<f", value))[0])


class Wire:
    """Real frames: what is sent is what a receiver would decode."""

    def __init__(self) -> None:
        self._codec = Codec()
        self.bytes = 0

    def carry(self, message: Any, system: int, component: int) -> Any:
        frame = self._codec.encode(message, system, component)
        self.bytes += len(frame)
        (out,) = self._codec.decode(frame, "wire", whole=True)
        return out


class Vehicle:
    """One ArduPilot with one compass, stepped every 20 ms. Knobs are the failures."""

    kind = 3  # MAV_AUTOPILOT

    def __init__(self, seed: int = 0) -> None:
        self.random = random.Random(seed)
        self.now_ns = 100 * S
        self.booted_ns = 0
        self.route = "udp:1"
        self.system, self.component = 1, 1
        self.params: dict[str, float] = {
            "COMPASS_OFS_X": f32(5.3),
            "COMPASS_OFS_Y": f32(-12.1),
            "COMPASS_OFS_Z": f32(40.7),
            "COMPASS_DEV_ID": 97539.0,
            "COMPASS_LEARN": 0.0,
            "COMPASS_OFFS_MAX": 1800.0,
        }
        self.applied = dict(self.params)  # what the stream is made with
        self.field = (210.0, -35.0, 390.0)
        self.noise_mg = 2.0
        self.armed = False
        self.landed_state: int | None = 1
        self.heartbeats = True
        self.streams = True
        self.applies = True
        self.deaf = False
        self.gyro_mrads = 2
        self.speed_cms: int | None = None
        self.calibrating = False
        self.committed = True  # the device id is on record; else it says "not calibrated"
        self.knows_prearm_checks = True
        self.loss = 0.0
        self.delay_ns = lambda: 5 * MS
        self.duplicate = 0.0
        self.sets: list[tuple[int, str, float]] = []  # as sent by us: when, name, value
        self.heard_at_set: list[int] = []  # and how many messages we had heard by then
        self.sent: list[tuple[int, Any]] = []  # everything we sent
        self.delivered: list[tuple[int, Any, str]] = []  # what reached us
        self.at: list[tuple[int, Callable[[], None]]] = []
        self.on_set: Callable[[str], None] = lambda name: None
        self.on_interval: Callable[[int, float], bool] = lambda message_id, interval_us: False  # whether it obeys
        self._wire = Wire()
        self._queue: list[tuple[int, int, str, Any]] = []
        self._count = 0

    @property
    def boot_ms(self) -> int:
        """Its own clock."""
        return (self.now_ns - self.booted_ns) // MS

    def clock(self, boot_ms: int) -> None:
        """From now on its clock goes on from here, and it says so."""
        self.booted_ns = self.now_ns - boot_ms * MS
        self.say(dialect.MAVLink_system_time_message(0, boot_ms))

    def _later(self, where: str, message: Any) -> None:
        copies = 1 + (self.random.random() < self.duplicate)
        for _ in range(copies):
            if self.random.random() < self.loss:
                continue
            self._count += 1
            heapq.heappush(self._queue, (self.now_ns + self.delay_ns(), self._count, where, message))

    def say(self, message: Any, route: str = "") -> None:
        self._later(route or self.route, self._wire.carry(message, self.system, self.component))

    def receive(self, out: list[Outgoing]) -> None:
        """What the machine wants sent."""
        for item in out:
            message = self._wire.carry(item.message, self.system, 191)
            self.sent.append((self.now_ns, message))
            if message.get_type() == "PARAM_SET":
                self.sets.append((self.now_ns, message.param_id, message.param_value))
                self.heard_at_set.append(len(self.delivered))
            self._later("vehicle", message)

    def forget_sets(self) -> None:
        self.sets.clear()
        self.heard_at_set.clear()

    def _handle(self, message: Any) -> None:
        kind = message.get_type()
        if kind == "COMMAND_LONG" and not self.deaf:
            self._command(message)
        if kind not in ("PARAM_SET", "PARAM_REQUEST_READ") or self.deaf:
            return
        name = message.param_id
        if (message.target_system, message.target_component) != (self.system, self.component):
            return
        if name not in self.params:
            return
        if kind == "PARAM_SET":
            self.params[name] = self._value_in(message)
            if self.applies:
                self.applied[name] = self.params[name]
        self.say(self._value_out(name))
        if kind == "PARAM_SET":
            self.on_set(name)

    def _value_in(self, message: Any) -> float:
        return f32(message.param_value)

    def _value_out(self, name: str) -> Any:
        return dialect.MAVLink_param_value_message(name.encode(), self.params[name], 9, 1000, 65535)

    def _imu(self) -> Any:
        mag = [
            math.trunc(b + self.applied[f"COMPASS_OFS_{axis}"] + self.random.gauss(0, self.noise_mg))
            for b, axis in zip(self.field, "XYZ", strict=True)
        ]
        return dialect.MAVLink_raw_imu_message(self.boot_ms * 1000, 0, 0, -1000, self.gyro_mrads, 0, 0, *mag)

    def _command(self, message: Any) -> None:
        """MAV_CMD_RUN_PREARM_CHECKS: acknowledged, and a text for what would not pass. Intervals: see on_interval."""
        checks = message.command == dialect.MAV_CMD_RUN_PREARM_CHECKS and self.knows_prearm_checks
        interval = message.command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL
        mine = checks or (interval and self.on_interval(round(message.param1), message.param2))
        result = dialect.MAV_RESULT_ACCEPTED if mine else dialect.MAV_RESULT_UNSUPPORTED
        self.say(dialect.MAVLink_command_ack_message(message.command, result, 0, 0, self.system, 191))
        if checks and not self.committed:
            self.say(dialect.MAVLink_statustext_message(2, b"PreArm: Compass not calibrated"))

    def heartbeat(self, armed: bool | None = None) -> Any:
        base = 128 if (self.armed if armed is None else armed) else 0
        return dialect.MAVLink_heartbeat_message(2, self.kind, base | 1, 0, 4, 3)

    def _talk(self, tick: int) -> None:
        if tick % 50 == 0 and self.heartbeats:
            self.say(self.heartbeat())
        if tick % 25 == 0 and self.landed_state is not None:
            self.say(dialect.MAVLink_extended_sys_state_message(0, self.landed_state))
        if tick % 25 == 10 and self.speed_cms is not None:
            self.say(dialect.MAVLink_global_position_int_message(self.boot_ms, 0, 0, 0, 0, self.speed_cms, 0, 0, 0))
        if tick % 50 == 7 and self.calibrating:
            self.say(dialect.MAVLink_mag_cal_progress_message(0, 1, 2, 1, 30, [0] * 10, 0, 0, 0))
        if tick % 5 == 0 and self.streams:
            self.say(self._imu())

    def run(self, machine: Any, until_s: float = 150.0, feed: Callable[..., Any] | None = None) -> None:
        """Step until the machine has a result, or the time is over. ``feed`` sees every message first."""
        end_ns = self.now_ns + round(until_s * S)
        while self.now_ns < end_ns and (machine is None or machine.result is None):
            tick = self.now_ns // (20 * MS)
            for item in [item for item in self.at if item[0] <= self.now_ns]:
                self.at.remove(item)
                item[1]()
            self._talk(tick)
            while self._queue and self._queue[0][0] <= self.now_ns:
                _, _, where, message = heapq.heappop(self._queue)
                if where == "vehicle":
                    self._handle(message)
                    continue
                self.delivered.append((self.now_ns, message, where))
                if feed is not None:
                    feed(message, where, self.now_ns)
                if machine is not None:
                    self.receive(machine.on_message(message, where, self.now_ns))
            if machine is not None:
                self.receive(machine.poll(self.now_ns))
            self.now_ns += 20 * MS


class Px4Vehicle(Vehicle):
    """One PX4 with one compass in slot 1, from what is known of its source (autopilots.md section 4).

    Numbers travel byte-wise, so an int32 of -1 is a NaN; offsets are gauss, subtracted, in the sensor's axes;
    SCALED_IMU is the sensor's own field whatever is stored; an unknown name gets a text and nothing else.
    """

    kind = 12
    INTS = ("CAL_MAG0_ID", "CAL_MAG1_ID", "CAL_MAG2_ID", "CAL_MAG3_ID", "CAL_MAG1_ROT", "SENS_MAG_AUTOCAL")

    def __init__(self, seed: int = 0) -> None:
        super().__init__(seed)
        self.params = {
            "CAL_MAG0_ID": 396809.0,
            "CAL_MAG1_ID": 97539.0,
            "CAL_MAG2_ID": 0.0,
            "CAL_MAG3_ID": 0.0,
            "CAL_MAG1_ROT": -1.0,
            "CAL_MAG1_XOFF": f32(0.0053),
            "CAL_MAG1_YOFF": f32(-0.0121),
            "CAL_MAG1_ZOFF": f32(0.0407),
            "SENS_MAG_AUTOCAL": 0.0,
        }
        self.applied = dict(self.params)

    def _imu(self) -> Any:
        mag = [round(b + self.random.gauss(0, self.noise_mg)) for b in self.field]
        return dialect.MAVLink_scaled_imu_message(self.boot_ms, 0, 0, -1000, self.gyro_mrads, 0, 0, *mag)

    def _value_in(self, message: Any) -> float:
        raw = message.get_msgbuf()[10:14]
        assert message.param_type == (6 if message.param_id in self.INTS else 9), "PX4 refuses another type"
        return float(struct.unpack("<i" if message.param_type == 6 else "<f", raw)[0])

    def _value_out(self, name: str) -> Any:
        value = self.params[name]
        if name not in self.INTS:
            return dialect.MAVLink_param_value_message(name.encode(), value, 9, 1000, 40)
        (bits,) = struct.unpack("<f", struct.pack("<i", int(value)))
        return dialect.MAVLink_param_value_message(name.encode(), bits, 6, 1000, 40)
