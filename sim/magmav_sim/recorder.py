"""A flight written to files as it happens: what a ground station or the autopilot itself would have kept.

One pass writes all of them, so they hold the same flight and the same noise. The same seed gives the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Protocol

import msgspec
import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.mavlink.codec import Codec
from magmav_sim.airframe import FRAME_S
from magmav_sim.autopilot import Autopilot
from magmav_sim.faults import Vector
from magmav_sim.record_dataflash import DataFlashWriter, as_bytes, as_text
from magmav_sim.record_moment import Inertial, Moment
from magmav_sim.record_ulog import ULogWriter
from magmav_sim.scenario import Scenario
from magmav_sim.vehicle import Simulation

_FRAME_NS = round(FRAME_S * 1e9)
_JITTER_MSS = 0.05
_BLOCK = 4096
_GROUND = (255, 190)
_LISTENED_HZ = {
    "RAW_IMU": 20.0, "SCALED_IMU2": 20.0, "SCALED_IMU3": 20.0, "ATTITUDE": 20.0, "GLOBAL_POSITION_INT": 5.0,
    "GPS_RAW_INT": 5.0, "BATTERY_STATUS": 10.0, "SYS_STATUS": 2.0, "VFR_HUD": 5.0, "SYSTEM_TIME": 1.0,
    "EXTENDED_SYS_STATE": 2.0,
}  # fmt: skip
_LISTENED_PX4_HZ = {"RAW_IMU": "SCALED_IMU"}  # where PX4 has another message
_ARDUPILOTS = (".bin", ".log")


class Writer(Protocol):
    """One kind of file."""

    def write(self, m: Moment) -> None:
        """Take one frame."""
        ...


class TlogWriter:
    """The frames the vehicle sent, each behind 8 bytes of big-endian UNIX microseconds."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file

    def write(self, m: Moment) -> None:
        """Append what was sent."""
        stamp = (m.autopilot.unix_ns // 1000).to_bytes(8, "big")
        self._file.write(b"".join(stamp + frame for frame in m.sent))


_KINDS: dict[str, Callable[[BinaryIO], Writer]] = {
    ".tlog": TlogWriter,
    ".bin": lambda file: DataFlashWriter(file, as_bytes),
    ".log": lambda file: DataFlashWriter(file, as_text),
    ".ulg": ULogWriter,
}


def kinds() -> str:
    """The endings of the files that can be written, for messages."""
    return ", ".join(_KINDS)


def recordable(path: Path) -> bool:
    """Whether the name says which kind of file to write."""
    return path.suffix.lower() in _KINDS


def unattended(scenario: Scenario) -> Scenario:
    """The scenario as flown when only files listen: flights start by themselves, the end is the end, and the
    vehicle streams without being asked what a ground station would have asked for."""
    replace = msgspec.structs.replace
    listened = _LISTENED_HZ
    if scenario.autopilot.kind == "px4":
        listened = {_LISTENED_PX4_HZ.get(name, name): hz for name, hz in listened.items()}
    flights = [replace(flight, start="auto") for flight in scenario.flights]
    autopilot = replace(scenario.autopilot, rates_hz=listened | scenario.autopilot.rates_hz)
    return replace(scenario, flights=flights, stay=False, autopilot=autopilot)


class Recorder:
    """Writes everything a simulation does into files, each by its name's ending (see ``kinds``), until closed.

    files : what was written, in order. Nothing is overwritten (FileExistsError). An autopilot begins a new log when
    it boots, so after a reboot .bin, .log and .ulg go on in NAME_2, a .tlog goes on as it is.
    fetch : ask for all parameters after each boot, as a ground station does.
    ValueError for an unknown ending, or one that this autopilot does not keep, OSError where a file cannot be made.
    """

    def __init__(self, simulation: Simulation, paths: Iterable[Path], *, fetch: bool = True) -> None:
        self._sim = simulation
        self._paths = list(paths)
        self._fetch = fetch
        self._codec = Codec()
        self._asked = False
        self._boots = 1
        self._last_ns = 0
        self._reads = 0
        self._rng = np.random.default_rng([simulation.seed, 7])
        self._noise: list[list[float]] = []
        self._open: dict[Path, tuple[BinaryIO, Writer]] = {}
        self.files: list[Path] = []
        odd = next((p for p in self._paths if not recordable(p)), None)
        if odd is not None:
            raise ValueError(f"{odd}: want a name that ends in one of {kinds()}")
        odd = next((p for p in self._paths if p.suffix.lower() in _ARDUPILOTS), None)
        if odd is not None and simulation.scenario.autopilot.kind == "px4":
            raise ValueError(f"{odd}: PX4 keeps no such log; want .ulg or .tlog")
        try:
            for path in self._paths:
                self._begin(path, path)
        except OSError:
            self.close()
            raise
        simulation.watchers.append(self.frame)

    def frame(self, sent: list[bytes]) -> None:
        """Take the frame that has just been simulated, and the MAVLink frames it sent."""
        a = self._sim.autopilot
        if a.boot_ns < self._last_ns:
            self._reboot()
        self._last_ns = a.boot_ns
        if a.silent:
            return
        if self._fetch and not self._asked:
            self._asked = True
            request = dialect.MAVLink_param_request_list_message(a.system, a.component)
            self._sim.receive(self._codec.encode(request, *_GROUND))
        fresh, self._reads = a.reads != self._reads, a.reads
        moment = Moment(a.boot_ns // _FRAME_NS, a.boot_ns // 1000, a, sent, fresh, self._inertial(a))
        for _, writer in self._open.values():
            writer.write(moment)

    def close(self) -> None:
        """Write what waits and close the files. Safe to call twice."""
        if self.frame in self._sim.watchers:
            self._sim.watchers.remove(self.frame)
        for file, _ in self._open.values():
            file.close()
        self._open.clear()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _begin(self, path: Path, name: Path) -> None:
        file = name.open("xb")
        self._open[path] = file, _KINDS[path.suffix.lower()](file)
        self.files.append(name)

    def _reboot(self) -> None:
        self._boots += 1
        self._asked = False
        for path in self._paths:
            if path.suffix.lower() != ".tlog":
                self._open.pop(path)[0].close()
                self._begin(path, path.with_stem(f"{path.stem}_{self._boots}"))

    def _inertial(self, a: Autopilot) -> list[Inertial]:
        """One IMU after the other: the gyro with its bias, the accelerometer with its noise."""
        s, (bp, bq, br) = a.state, a.gyro_bias_rads
        rate: Vector = (s.p_rads + bp, s.q_rads + bq, s.r_rads + br)
        out = []
        for _ in range(a.imus):
            if not self._noise:
                self._noise = (self._rng.standard_normal((_BLOCK, 3)) * _JITTER_MSS).tolist()
            x, y, z = self._noise.pop()
            out.append(Inertial(rate, (s.force_x_mss + x, s.force_y_mss + y, s.force_z_mss + z)))
        return out
