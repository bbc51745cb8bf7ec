"""What a whole `magmav fit` costs: on a written hour of flight, and beside MAVProxy's magfit on a real log."""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from dataflash_writer import ARM, ATT, CTUN, GPS, IMU, MAG, MSG, PARM, POS, Log
from estimator_bench.peer_environments import NoEnvironment, python_of
from estimator_bench.telemetry import UNIX_AT_BOOT_NS
from estimator_cost import packets, parsed_s
from pymavlink.dialects.v20 import ardupilotmega as dialect
from rich.console import Console

from magmav.comparison import Columns, Tape, first_half, scored
from magmav.core.after_flight import after_flight
from magmav.core.channel import Circumstances
from magmav.core.types import Sample
from magmav.geomag import world_magnetic_model
from magmav.recording import open_recording, replay
from magmav.reference import Reference
from magmav.score import Calibration, Window
from magmav.settings import Settings

_IRONS = {2: (40, -25, 90), 3: (-150, 60, -30)}  # mG beside the first compass's
_BOUND_S = 60.0  # AT-14d, for 60 minutes on four cores
_BOOT_US = 10_000_000
_GPS_EPOCH_MS, _WEEK_MS = 315_964_800_000 - 18_000, 604_800_000  # 1980-01-06, less the leap seconds since
_TWINS = {2: dialect.MAVLink_scaled_imu2_message, 3: dialect.MAVLink_scaled_imu3_message}
_MAGFIT = """
import sys, types
class Nothing(types.ModuleType):
    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return type(name, (), {})
for module in ("wx", "wx.lib", "wx.lib.agw", "wx.grid", "wx.dataview"):
    sys.modules[module] = Nothing(module)
from MAVProxy.modules.lib import magfit
path, mag, until_s, plot = sys.argv[1], sys.argv[2], float(sys.argv[3]), sys.argv[4]
whole = magfit.magfit
def within(mlog, in_range, save_plot=None):
    first = mlog.recv_match(type=["ATT"])
    start = first._timestamp - (1e-6 * first.TimeUS if hasattr(first, "TimeUS") else 1e-3 * first.TimeMS)
    mlog.rewind()
    return whole(mlog, lambda t: 1 if t - start > until_s else 0, save_plot=save_plot)
magfit.magfit = within
sys.argv = ["magfit", path, "--mag", mag, "--save-plot", plot]
magfit.main()
"""
_NEW = re.compile(r"^New: Vector3\(([^,]+), ([^,]+), ([^)]+)\)", re.MULTILINE)


class Spent(NamedTuple):
    """A process that ended: seconds by the clock and of processor time, the most memory it held, what it printed."""

    wall_s: float
    cpu_s: float
    rss_mb: float
    out: str


def spent(command: list[str]) -> Spent:
    """Run it. RuntimeError where it fails."""
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        began = time.perf_counter()
        child = subprocess.Popen(command, stdout=out, stderr=err)
        _, status, usage = os.wait4(child.pid, 0)
        wall_s = time.perf_counter() - began
        child.returncode = os.waitstatus_to_exitcode(status)
        out.seek(0)
        err.seek(0)
        if child.returncode != 0:
            raise RuntimeError(f"{' '.join(command[:4])}: exit code {child.returncode}: {err.read()[-500:]!r}")
        return Spent(wall_s, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024.0, out.read().decode())


def fitted(path: Path, folder: Path) -> tuple[Spent, dict[str, Any]]:
    """`magmav fit --json` of one log, in a process of its own; and its entry."""
    got = spent([sys.executable, "-m", "magmav.cli", "fit", str(path), "--json", "--out", str(folder / "out")])
    return got, json.loads(got.out)["logs"][0]


# ---------------------------------------------------------------- the hour


def with_twins(seconds: float) -> Iterator[tuple[int, bytes]]:
    """The flight of estimator_cost with a second and a third compass in it."""
    mav = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    reader = dialect.MAVLink(None)
    first = True
    for us, frame in packets(seconds):
        for compass in _TWINS if first else ():
            told = [(f"COMPASS_OFS{compass}_{axis}", 0.0) for axis in "XYZ"]
            told += [(f"COMPASS_{name}{compass}", 0.0) for name in ("ORIENT", "EXTERN", "SCALE")]
            for name, value in [*told, (f"COMPASS_DEV_ID{compass}", 97539.0 + compass)]:
                message = dialect.MAVLink_param_value_message(name.encode(), value, 9, 900, 65535)
                yield us, bytes(message.pack(mav))
        first = False
        yield us, frame
        if frame[7] == dialect.MAVLINK_MSG_ID_RAW_IMU:
            m = reader.decode(bytearray(frame))
            for compass, kind in _TWINS.items():
                x, y, z = (v + iron for v, iron in zip((m.xmag, m.ymag, m.zmag), _IRONS[compass], strict=True))
                twin = kind(m.time_usec // 1000, m.xacc, m.yacc, m.zacc, m.xgyro, m.ygyro, m.zgyro, x, y, z)
                yield us, bytes(twin.pack(mav))


def as_dataflash(frames: Iterator[tuple[int, bytes]]) -> bytes:
    """The same flight as ArduPilot's own .bin: what the messages say, at the vehicle's time."""
    log = Log()
    reader = dialect.MAVLink(None)
    log.add(MSG, _BOOT_US, "ArduCopter V4.5.1 (written)")
    log.add(PARM, _BOOT_US, "SYSID_THISMAV", 1.0, 0.0)
    began = False
    for unix_us, frame in frames:
        m = reader.decode(bytearray(frame))
        us = unix_us - UNIX_AT_BOOT_NS // 1000
        kind = m.get_type()
        if kind == "PARAM_VALUE":
            log.add(PARM, us, m.param_id, m.param_value, 0.0)
        elif kind == "HEARTBEAT" and not began:
            began = True
            log.add(ARM, us, 1, 0)
        elif kind == "ATTITUDE":
            roll, pitch, yaw = (math.degrees(v) for v in (m.roll, m.pitch, m.yaw))
            log.add(ATT, us, 0.0, roll, 0.0, pitch, 0.0, round(yaw % 360.0 * 100) % 36000 / 100)
            log.add(IMU, us, 0, m.rollspeed, m.pitchspeed, m.yawspeed, 0.0, 0.0, -9.80665)
        elif kind in ("RAW_IMU", "SCALED_IMU2", "SCALED_IMU3"):
            number = {"RAW_IMU": 0, "SCALED_IMU2": 1, "SCALED_IMU3": 2}[kind]
            log.add(MAG, us, number, m.xmag, m.ymag, m.zmag, *(0,) * 6, 1, us)
        elif kind == "GLOBAL_POSITION_INT":
            lat, lon, alt = m.lat / 1e7, m.lon / 1e7, m.alt / 1e3
            week, since_ms = divmod(unix_us // 1000 - _GPS_EPOCH_MS, _WEEK_MS)
            log.add(GPS, us, 0, 3, since_ms, week, 12, 0.8, lat, lon, alt, 0.0, 0.0, 0.0)
            log.add(POS, us, lat, lon, alt, m.relative_alt / 1e3, m.relative_alt / 1e3)
        elif kind == "VFR_HUD":
            log.add(CTUN, us, m.throttle / 100.0, m.throttle / 100.0)
    return log.binary()


def hour_of_bin(minutes: float, console: Console) -> None:
    """AT-14d: a 60-minute .bin, whole command, one compass and three, against the bound of 60 s on four cores."""
    with tempfile.TemporaryDirectory(prefix="magmav-hour-") as place:
        folder = Path(place)
        for many, flight in ((1, packets), (3, with_twins)):
            path = folder / f"hour{many}.bin"
            path.write_bytes(as_dataflash(flight(60.0 * minutes)))
            got, entry = fitted(path, folder)
            compasses = entry["vehicles"][0]["compasses"]
            if len(compasses) != many or any(c["fit"] is None for c in compasses):
                raise RuntimeError(f"{path.name}: not all of {many} compasses were fitted")
            kept = "met" if got.wall_s <= _BOUND_S else "NOT met"
            console.print(
                f".bin, {many} compass{'es' if many > 1 else ''}, {minutes:g} min, {path.stat().st_size / 1e6:.1f} MB: "
                f"fit {got.wall_s:.1f} s by the clock, {got.cpu_s:.1f} s of processor time (one process, so four cores "
                f"are no faster), {got.rss_mb:.0f} MB; bound {_BOUND_S:g} s for 60 min: "
                f"{kept if minutes >= 60.0 else 'not tried, that is shorter'}"
            )


def hour(minutes: float, console: Console) -> None:
    """One compass, then three, as a .tlog; three as a .bin."""
    with tempfile.TemporaryDirectory(prefix="magmav-hour-") as place:
        folder = Path(place)
        for many, flight in ((1, packets), (3, with_twins)):
            path = folder / f"hour{many}.tlog"
            frames = []
            with path.open("wb") as file:
                for us, frame in flight(60.0 * minutes):
                    file.write(us.to_bytes(8, "big") + frame)
                    frames.append(frame)
            parse_s = parsed_s(frames)
            got, entry = fitted(path, folder)
            compasses = entry["vehicles"][0]["compasses"]
            if len(compasses) != many or any(c["fit"] is None for c in compasses):
                raise RuntimeError(f"{path.name}: not all of {many} compasses were fitted")
            console.print(
                f"{many} compass{'es' if many > 1 else ''}, {minutes:g} min, {len(frames)} messages: "
                f"fit {got.cpu_s:.1f} s of processor time, {got.rss_mb:.0f} MB; "
                f"pymavlink's bare parse {parse_s:.1f} s, ratio {got.cpu_s / parse_s:.2f}"
            )
    hour_of_bin(minutes, console)


# ---------------------------------------------------------------- beside magfit


def magfit(path: Path, console: Console) -> int:
    """Both on all compasses of one DataFlash log; 3 where magfit cannot be had."""
    try:
        python = str(python_of("mavproxy", console.print))
    except NoEnvironment as error:
        console.print(str(error))
        return 3
    tapes, references = taped(path)
    system = next(iter(references))
    with tempfile.TemporaryDirectory(prefix="magmav-magfit-") as place:
        folder = Path(place)
        mine, _ = fitted(path, folder)
        theirs_s = 0.0
        for (_, compass), tape in sorted(tapes.items()):
            columns = Columns.of(tape.heard)
            half = first_half(columns)
            split_s = float(columns.boot_s[half])
            asked = [python, "-c", _MAGFIT, str(path), source(path, compass)]
            theirs_s += spent([*asked, "1e12", str(folder / "a.png")]).cpu_s
            held = _NEW.search(spent([*asked, f"{split_s:.3f}", str(folder / "b.png")]).out)
            known = after_flight([h.sample for h in tape.heard[:half]])
            marks = {}
            if held is not None:
                marks["magfit"] = Calibration(-np.array([float(v) for v in held.groups()]), np.eye(3), None)
            if known is not None:
                matrix = known.answer.soft_iron_b @ tape.heard[-1].sample.shaping.matrix
                marks["magmav"] = Calibration(known.answer.hard_iron_b_mg, matrix, None)
            scores, name = scored(columns, marks, references[system], Window(split_s))
            said = ", ".join(f"{k} {s.rms_deg:.2f}" for k, s in scores.items() if k in (*marks, "uncalibrated"))
            console.print(
                f"compass {compass}, fitted up to {split_s:.0f} s, heading RMS after it, deg: {said} ({name})"
            )
    console.print(
        f"magmav fit, all compasses {mine.cpu_s:.1f} s, {mine.rss_mb:.0f} MB; magfit, one run each, {theirs_s:.1f} s; "
        f"ratio {theirs_s / mine.cpu_s:.1f}"
    )
    return 0


def source(path: Path, compass: int) -> str:
    """What magfit calls a compass: older logs have messages MAG, MAG2 and MAG3."""
    if "MAG2" not in open_recording(path).heard:
        return f"MAG[{compass - 1}]"
    return "MAG" if compass == 1 else f"MAG{compass}"


def taped(path: Path) -> tuple[dict[tuple[int, int], Tape], dict[int, Reference]]:
    """What each compass had to learn from, and what headings are held against."""
    tapes: dict[tuple[int, int], Tape] = {}
    references: dict[int, Reference] = {}

    def tap(sample: Sample, circumstances: Circumstances, stretch: tuple[int, int]) -> None:
        tapes.setdefault((sample.system, sample.compass), Tape()).add(sample, circumstances, stretch)

    replay(open_recording(path), Settings(), world_magnetic_model, references=references, tap=tap)
    for tape in tapes.values():
        tape.close()
    return tapes, references
