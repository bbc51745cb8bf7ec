"""What the peers' tests stand on: their programs, a router between all ends, and a vehicle with a companion."""

from __future__ import annotations

import os
import re
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from environments import NoEnvironment, python_of
from process_rig import environment
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.link.frames import V2, cut

ROOT = Path(__file__).parents[2]
CLIENTS = Path(__file__).parent / "clients"
PATIENCE_S = 60.0


def peer(name: str) -> Path:
    """The peer's Python, or this test is skipped with the reason."""
    try:
        return python_of(name)
    except NoEnvironment as why:
        pytest.skip(f"needs the package index, or a cache filled before: {why}")


class Program:
    """A program with its output read as it comes, and lines to its input."""

    def __init__(self, words: Sequence[object], env: dict[str, str], cwd: Path) -> None:
        self.lines: list[str] = []
        self.read = 0  # lines that ``expect`` is done with
        self._run = subprocess.Popen(
            [str(w) for w in words],
            env=env | {"PYTHONUNBUFFERED": "1"},
            cwd=cwd,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
        )
        self._ended = False  # there will be no more lines
        self._more = threading.Condition()
        self._reader = threading.Thread(target=self._listen, daemon=True)
        self._reader.start()

    def _listen(self) -> None:
        for line in self._run.stdout or ():
            with self._more:
                self.lines.append(line.rstrip("\n"))
                self._more.notify_all()
        with self._more:
            self._ended = True
            self._more.notify_all()

    def say(self, line: str) -> None:
        """One line to its input."""
        assert self._run.stdin is not None
        self._run.stdin.write(line + "\n")
        self._run.stdin.flush()

    def expect(self, pattern: str, within_s: float = PATIENCE_S) -> re.Match[str]:
        """The first line from here on that holds the pattern; AssertionError with all lines where it does not come."""
        end = time.monotonic() + within_s
        with self._more:
            while True:
                while self.read < len(self.lines):
                    self.read += 1
                    found = re.search(pattern, self.lines[self.read - 1])
                    if found:
                        return found
                left_s = end - time.monotonic()
                if self._ended or left_s <= 0 or not self._more.wait(left_s):
                    raise AssertionError("\n".join([f"no {pattern!r} in", *self.lines[-60:]]))

    def expect_all(self, *patterns: str) -> None:
        """Each of these from here on, in whichever order; reading goes on after the last of them."""
        begin, reached = self.read, self.read
        for pattern in patterns:
            self.read = begin
            self.expect(pattern)
            reached = max(reached, self.read)
        self.read = reached

    def end(self) -> int:
        """Close its input and wait; the exit code."""
        assert self._run.stdin is not None
        self._run.stdin.close()
        code = self._run.wait(PATIENCE_S)
        self._reader.join(5)
        return code

    def gone(self) -> None:
        """End it, whatever it does."""
        if self._run.poll() is None:
            self._run.terminate()
            try:
                self._run.wait(10)
            except subprocess.TimeoutExpired:
                self._run.kill()
                self._run.wait()
        for pipe in (self._run.stdin, self._run.stdout):
            if pipe is not None and not pipe.closed:
                self._reader.join(5)
                pipe.close()


@contextmanager
def program(words: Sequence[object], folder: Path) -> Iterator[Program]:
    """A program that sees this checkout's magmav and leaves what it leaves in ``folder``."""
    paths = os.pathsep.join((str(ROOT), str(ROOT / "sim")))
    running = Program(words, environment(folder) | {"PYTHONPATH": paths}, folder)
    try:
        yield running
    finally:
        running.gone()


def magmav_words(*words: object) -> list[object]:
    """One of magmav's own commands."""
    return [sys.executable, "-m", "magmav.cli", *words]


class Hub:
    """A router on one UDP port, as mavlink-router is one: what has a target goes to the end that target was heard on.

    Everything else goes to all other ends. Without the first rule ArduPilot, and the simulated one, would carry out
    what is meant for component 191 itself.
    """

    def __init__(self) -> None:
        self._sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sock.bind(("127.0.0.1", 0))
        self.port = int(self._sock.getsockname()[1])
        self._ends: dict[Any, set[tuple[int, int]]] = {}
        self._mav = dialect.MAVLink(None)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)

    def _work(self) -> None:
        while not self._stop.is_set():
            if not select.select([self._sock], [], [], 0.1)[0]:
                continue
            try:
                data, sender = self._sock.recvfrom(65535)
            except ConnectionError:
                continue  # an end that went away
            for frame in cut(data, whole=True).frames:
                self._route(frame, sender)

    def _route(self, frame: bytes, sender: Any) -> None:
        source = (frame[5], frame[6]) if frame[0] == V2 else (frame[3], frame[4])
        self._ends.setdefault(sender, set()).add(source)
        target = self._target(frame)
        others = [end for end in self._ends if end != sender]
        for end in [end for end in others if target in self._ends[end]] or others:
            try:
                self._sock.sendto(frame, end)
            except OSError:
                del self._ends[end]

    def _target(self, frame: bytes) -> tuple[int, int]:
        """System and component it is for; (0, 0) where it names none or is not known to the dialect."""
        try:
            message = self._mav.decode(bytearray(frame))
        except (dialect.MAVError, UnicodeError):
            return 0, 0
        return getattr(message, "target_system", 0), getattr(message, "target_component", 0)

    def __enter__(self) -> Hub:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stop.set()
        self._thread.join()
        self._sock.close()


@contextmanager
def stage(folder: Path, scenario: str) -> Iterator[Hub]:
    """A simulated ArduPilot vehicle and `magmav run` on one hub, both heard."""
    (where := folder / "scenario.toml").write_text(scenario)
    with Hub() as hub:
        link = f"udpout:127.0.0.1:{hub.port}"
        run = magmav_words("run", link, "--store", folder / "run.sqlite", "--system", 1)
        with program(run, folder) as service:
            service.expect("listening on")
            with program(magmav_words("sim", where, "--to", link), folder):
                service.expect("compass 1 of system 1")
                yield hub
