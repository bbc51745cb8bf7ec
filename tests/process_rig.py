"""Programs in processes of their own, on ephemeral ports; whatever happens, they are gone afterwards."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

WALL_S = 150.0


class Done(NamedTuple):
    """How a program ended."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """The one JSON document it printed."""
        (line,) = self.out.splitlines()
        return json.loads(line)


def free_port() -> int:
    """A UDP port of loopback that nobody has just now."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


def environment(folder: Path) -> dict[str, str]:
    """Ours, with every place a program might leave something in moved into ``folder``."""
    places = {"HOME": folder, "TMPDIR": folder, "XDG_STATE_HOME": folder, "XDG_DATA_HOME": folder}
    return os.environ | {name: str(place) for name, place in places.items()}


def magmav(*words: object, cwd: Path | None = None, env: dict[str, str] | None = None) -> Done:
    """Run one command to its end."""
    command = [sys.executable, "-m", "magmav.cli", *map(str, words)]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=WALL_S, check=False, cwd=cwd, env=env, stdin=subprocess.DEVNULL
    )
    return Done(done.returncode, done.stdout, done.stderr)


@contextmanager
def started(*words: object) -> Iterator[subprocess.Popen[str]]:
    """A command that goes on; stopped by SIGTERM at the end, and killed if that is not enough."""
    command = [sys.executable, "-m", "magmav.cli", *map(str, words)]
    pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, text=True, **pipes) as run:  # type: ignore[call-overload]
        try:
            yield run
        finally:
            if run.poll() is None:
                run.terminate()
                try:
                    run.communicate(timeout=20)
                except subprocess.TimeoutExpired:
                    run.kill()
                    run.communicate()


def stopped(run: subprocess.Popen[str]) -> Done:
    """SIGTERM, and how it took it."""
    run.send_signal(signal.SIGTERM)
    out, err = run.communicate(timeout=20)
    return Done(run.returncode, out, err)
