"""The main job on a simulated flight, over real UDP: fly, learn, land, upload, fly again, undo.

The vehicle is another process (magmav_sim) that shares nothing with us but the socket. Before and after are both the
heading of the autopilot's own corrected stream, and learning is off in the second flight, so that only a real upload
can change it. The simulator's own log is the truth.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.core.types import FieldModel, Reading, Record, State, UploadResult, VehicleReading
from magmav.link import Link
from magmav.link.recorder import TlogRecorder
from magmav.link.udp import udp_in
from magmav.live import Session, outcome
from magmav.mavlink.change import code_needed
from magmav.reference import Reference, shortest_rad
from magmav.score import score_headings
from magmav.settings import Settings, with_value
from magmav.store import Store
from magmav.view.plot_demo import DemoFlight, DemoOffsets, plot_demo

Result = dict[str, Any]
_OPERATOR = (255, 190)
_GIVE_UP_S = 150.0
_OWN_FILES = ("demo.tlog", "demo.sqlite", "demo.sqlite-wal", "demo.sqlite-shm", "demo.sqlite-writer")


class DemoError(Exception):
    """The demonstration did not come to its end; the text says where it stuck."""


class Act(Enum):
    """What happens, in order."""

    MEET = "on the ground: reading what the vehicle holds"
    FIRST_FLIGHT = "first flight: learning"
    UPLOAD = "landed: uploading"
    SECOND_FLIGHT = "second flight: learning is off"
    UNDO = "landed: undoing the upload of compass 1"
    END = "done"


class Director:
    """Watches the flights and gives the cues an operator would give."""

    def __init__(self, session: Session, link: Link, seed: int | None) -> None:
        self.session = session
        self.act = Act.MEET
        self.flights: list[list[Record]] = [[], []]
        self.uploads: list[Result] = []
        self.undo: Result | None = None
        self.known: dict[int, Record] = {}
        self._link = link
        self._armed = False
        self._todo: list[int] = []
        self._asked_ns = 0

    def watch(self, reading: Reading, record: Record | None) -> None:
        """Collect what is flown; notice landings."""
        if isinstance(reading, VehicleReading):
            if self._armed and not reading.armed:
                self._landed()
            self._armed = reading.armed
        if record is None:
            return
        self.known[record.compass] = record
        if self._armed and self.act in (Act.FIRST_FLIGHT, Act.SECOND_FLIGHT):
            self.flights[self.act is Act.SECOND_FLIGHT].append(record)

    def _landed(self) -> None:
        if self.act is Act.FIRST_FLIGHT:
            self.act, self._todo = Act.UPLOAD, sorted(self.known)
        elif self.act is Act.SECOND_FLIGHT:
            self.act, self._todo = Act.UNDO, [1]

    def turn(self, now_ns: int) -> None:
        """After every packet: begin what is due, note what has ended."""
        companion = self.session.companion
        if companion.ended is not None:
            job, companion.ended = companion.ended, None
            above_mg = companion.settings.upload.confirm_above_mg
            done = outcome(job.change, job.result, job.reasons, int(companion.confirm), above_mg)
            if self.act is Act.UPLOAD:
                self.uploads.append(done)
            else:
                self.undo = done
        if companion.job is not None:
            return
        if self.act is Act.MEET and companion.settled:
            self.act = Act.FIRST_FLIGHT
        elif self.act is Act.FIRST_FLIGHT and not self._armed and not self.flights[0]:
            self._start_mission(now_ns)
        elif self._todo:
            compass = self._todo.pop(0)
            if self.act is Act.UPLOAD:
                self._upload(compass, now_ns)
            else:
                companion.request_restore(compass, now_ns)
        elif self.act is Act.UPLOAD:
            companion.choose("learn", "on", 0.0, keep=False)
            self.act = Act.SECOND_FLIGHT
        elif self.act is Act.SECOND_FLIGHT and not self._armed and not self.flights[1]:
            self._start_mission(now_ns)
        elif self.act is Act.UNDO:
            self.act = Act.END

    def _upload(self, compass: int, now_ns: int) -> None:
        """As an operator does it: look at the dry run, take its code, write the parameter."""
        companion = self.session.companion
        change = companion.plan(compass)
        if change is None or self.known[compass].verdict.state is not State.READY:
            why = "; ".join(r.text for r in self.known[compass].verdict.reasons)
            raise DemoError(f"compass {compass} is not ready after the first flight: {why}")
        companion.confirm = float(code_needed(change, companion.settings.upload.confirm_above_mg) or 0)
        companion.request_upload(compass, now_ns)

    def _start_mission(self, now_ns: int) -> None:
        autopilot = self.session.companion.presence.autopilot
        if autopilot is None or now_ns - self._asked_ns < 1_000_000_000:
            return
        self._asked_ns = now_ns
        command = dialect.MAVLink_command_long_message(
            autopilot.system, autopilot.component, dialect.MAV_CMD_MISSION_START, 0, 0, 0, 0, 0, 0, 0, 0
        )
        self._link.send(self.session.service.hearing.codec.encode(command, *_OPERATOR), autopilot.route)


def demo(
    settings: Settings,
    model: FieldModel,
    folder: Path,
    *,
    scenario: str = "demo",
    seed: int | None = None,
    plot: Path | None = None,
    progress: Callable[[str], None] = lambda text: None,
) -> Result:
    """Run it all; the result is the JSON document of ``magmav demo``. Writes its evidence into ``folder``.

    Raises DemoError when it does not come to its end, LinkError when no socket can be had.
    """
    begun = time.monotonic()
    folder.mkdir(parents=True, exist_ok=True)
    for name in _OWN_FILES:  # of an earlier demonstration; a recording would be appended to
        (folder / name).unlink(missing_ok=True)
    socket = udp_in("127.0.0.1", 0)
    link = TlogRecorder(socket, folder / "demo.tlog")
    with Store(folder / "demo.sqlite") as store, _vehicle(scenario, socket.port, folder, seed):
        session = Session.on(link, with_value(settings, "vehicle", "system", 1), model, store)
        director = Director(session, link, seed)
        session.service.watchers = (director.watch,)
        try:
            _play(session, director, link, begun, progress)
        finally:
            link.close()
    truth = Reference.from_csv(folder / "truth.csv")
    facts = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    result = _result(director, truth, facts) | {
        "wall_s": round(time.monotonic() - begun, 2),
        "folder": str(folder),
    }
    if plot is not None:
        _plot(plot, director, truth, facts, result)
    return result


def _play(session: Session, director: Director, link: Link, begun: float, progress: Callable[[str], None]) -> None:
    act = None
    for packet in link.packets():
        session.service.turn(packet)
        director.turn(packet.t_ns)
        if director.act is not act:
            act = director.act
            progress(act.value)
        if act is Act.END:
            return
        if time.monotonic() - begun > _GIVE_UP_S:
            break
    raise DemoError(f"gave up after {_GIVE_UP_S:.0f} s in the act '{director.act.value}'")


@contextmanager
def _vehicle(scenario: str, port: int, folder: Path, seed: int | None) -> Iterator[None]:
    """The simulated vehicle in a process of its own; gone when this ends, whatever happened."""
    command = [sys.executable, "-m", "magmav_sim", scenario, "--to", f"udpout:127.0.0.1:{port}"]
    command += ["--speed", "max", "--truth", str(folder)]
    command += [] if seed is None else ["--seed", str(seed)]
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as run:
        try:
            yield
        finally:
            run.terminate()
            try:
                _, words = run.communicate(timeout=10.0)
            except subprocess.TimeoutExpired:
                run.kill()
                _, words = run.communicate()
    if run.returncode != 0:
        raise DemoError(f"the simulated vehicle failed: {words.decode(errors='replace').strip()}")


def _errors(flight: list[Record], compass: int, truth: Reference) -> tuple[Any, Any]:
    """Boot times (N,) s and error (N,) deg of the streamed heading of one compass."""
    mine = [r for r in flight if r.compass == compass and r.stored_heading.true_valid]
    boot_s = np.array([r.boot_ns for r in mine]) / 1e9
    heading = np.array([r.stored_heading.true_rad for r in mine])
    return boot_s, np.degrees(shortest_rad(heading - truth.interpolate(boot_s).yaw_true_rad))


def _rms(flight: list[Record], compass: int, truth: Reference) -> float | None:
    mine = [r for r in flight if r.compass == compass and r.stored_heading.true_valid]
    boot_s = np.array([r.boot_ns for r in mine]) / 1e9
    headings = {"stream": np.array([r.stored_heading.true_rad for r in mine])}
    return score_headings(boot_s, headings, truth)["stream"].rms_deg


def _result(director: Director, truth: Reference, facts: Any) -> Result:
    compasses = []
    for n, true in enumerate(facts["compasses"], start=1):
        new = director.uploads[n - 1]["new"]
        error = [round(v - t, 2) for v, t in zip(new.values(), true["offsets_mg"], strict=False)]
        compasses.append(
            {
                "compass": n,
                "device_id": true["device_id"],
                "offsets_mg": [round(v, 2) for v in new.values()],
                "true_offsets_mg": true["offsets_mg"],
                "offset_error_mg": error,
                "sigma_mg": [round(float(s), 2) for s in director.known[n].sigma_mg],
                "before_rms_deg": _rms(director.flights[0], n, truth),
                "after_rms_deg": _rms(director.flights[1], n, truth),
                "upload": director.uploads[n - 1],
            }
        )
    results = {u["result"] for u in director.uploads}
    worst = {"heading_rms_deg": max((c["before_rms_deg"] for c in compasses), default=None)}
    after = {"heading_rms_deg": max((c["after_rms_deg"] for c in compasses), default=None)}
    all_new = results == {UploadResult.ALL_NEW.name}
    return {
        "reference": "simulated truth",
        "before": worst,
        "after": after,
        "compasses": compasses,
        "upload": {
            "result": UploadResult.ALL_NEW.name if all_new else next(iter(results - {"ALL_NEW"}), None),
            "confirmed_by_code": all(u["confirmed"] for u in director.uploads if u["confirm_code"] is not None),
        },
        "restore": director.undo or {"result": None},
    }


def _plot(path: Path, director: Director, truth: Reference, facts: Any, result: Result) -> None:
    worst = max(result["compasses"], key=lambda c: c["before_rms_deg"])
    n = worst["compass"]
    flights = [
        DemoFlight(*_errors(flight, n, truth), rms)
        for flight, rms in zip(director.flights, (worst["before_rms_deg"], worst["after_rms_deg"]), strict=True)
    ]
    offsets = [
        DemoOffsets(
            c["compass"],
            np.array(list(c["upload"]["old"].values())),
            np.array(c["offsets_mg"]),
            np.array(c["sigma_mg"]),
            np.array(c["true_offsets_mg"]),
        )
        for c in result["compasses"]
    ]
    title = f"Two flights of a simulated quadrotor, compass {n} as the autopilot streams it"
    plot_demo(path, flights[0], flights[1], offsets, title, "simulated truth")
