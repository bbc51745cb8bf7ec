"""Virtual environments for other people's programs: made when first wanted, kept in a cache, never the project's own.

The cache is MAGMAV_PEERS, or XDG_CACHE_HOME/magmav/peers, or ~/.cache/magmav/peers; delete it whenever you like.
benchmarks/estimator_bench keeps larger ones there under other names.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
import sys
from pathlib import Path

# MAVProxy's own list of needs is 1.2 GB of maps and pictures, none of which a console without windows loads.
# What the plugin needs of magmav's own comes last: magmav itself is taken from this checkout.
NEEDS = {
    "wire-mavproxy": (
        ("--no-deps", "mavproxy==1.8.75"),
        ("pymavlink==2.4.50", "pyserial>=3.5", "defusedxml", "numpy>=2.0"),
        ("filterpy>=2.0.0", "pygeomag>=1.1.0", "msgspec>=0.19", "rich>=13", "pyulog>=1.2.0"),
    ),
    "wire-mavsdk": (("mavsdk==4.1.0",),),
    "wire-dronekit2": (("dronekit2==3.0.0",),),
    "page-playwright": (("playwright>=1.49",),),  # the browser itself is the system's, or playwright's where fetched
}
_ENOUGH_S = 300.0


class NoEnvironment(Exception):
    """It could not be made; the text says why, in one line."""


def cache() -> Path:
    """Where the environments are kept."""
    named = os.environ.get("MAGMAV_PEERS")
    above = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(named) if named else Path(above) / "magmav" / "peers"


def python_of(name: str) -> Path:
    """The Python of one environment, made first where it is not there yet. NoEnvironment where that fails.

    One process makes it while others wait: tests run side by side.
    """
    home = cache() / name
    python, mark, wanted = home / "bin" / "python", home / "made-for", repr(NEEDS[name])
    try:
        home.parent.mkdir(parents=True, exist_ok=True)
        with (home.parent / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if python.exists() and mark.is_file() and mark.read_text(encoding="utf-8") == wanted:
                return python
            for command in _making(home, python, NEEDS[name]):
                subprocess.run(command, check=True, capture_output=True, text=True, timeout=_ENOUGH_S)
            mark.write_text(wanted, encoding="utf-8")
    except subprocess.CalledProcessError as error:
        lines = [line for line in str(error.stderr).splitlines() if line.strip()] or ["no reason given"]
        raise NoEnvironment(f"{name}: cannot be installed: {lines[-1][:160]}") from None
    except (OSError, subprocess.TimeoutExpired) as error:
        raise NoEnvironment(f"{name}: cannot be made: {str(error)[:160]}") from None
    return python


def _making(home: Path, python: Path, needs: tuple[tuple[str, ...], ...]) -> list[list[str]]:
    """The commands that make one. uv, which the Makefile brings, needs a fifth of pip's time."""
    uv = shutil.which("uv", path=os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", ""))))
    if uv is None:
        install = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        make = [sys.executable, "-m", "venv", "--clear", str(home)]
    else:
        install = [uv, "pip", "install", "--quiet", "--python", str(python)]
        make = [uv, "venv", "--quiet", "--clear", "--python", sys.executable, str(home)]
    return [make, *([*install, *packages] for packages in needs)]
