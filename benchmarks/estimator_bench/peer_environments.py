"""Virtual environments for other people's packages: made when first wanted, kept in a cache, never the project's own.

The cache is MAGMAV_PEERS, or XDG_CACHE_HOME/magmav/peers, or ~/.cache/magmav/peers; delete it whenever you like.
"""

from __future__ import annotations

import os
import subprocess
import venv
from collections.abc import Callable
from pathlib import Path

NEEDS = {
    "mavproxy": ("MAVProxy==1.8.75", "scipy>=1.11"),
    "magyc": ("magyc==1.0.0",),
    "ahrs": ("imufusion==1.3.3", "vqf==2.1.2", "ahrs==0.4.0"),
}
_ENOUGH_S = 900.0


class NoEnvironment(Exception):
    """It could not be made; the text says why, in one line."""


def cache() -> Path:
    """Where the environments are kept."""
    named = os.environ.get("MAGMAV_PEERS")
    above = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(named) if named else Path(above) / "magmav" / "peers"


def python_of(name: str, say: Callable[[str], None] = lambda text: None) -> Path:
    """The Python of one environment, made first where it is not there yet. NoEnvironment where that fails."""
    home = cache() / name
    python, mark = home / "bin" / "python", home / "made-for"
    wanted = " ".join(NEEDS[name])
    if python.exists() and mark.is_file() and mark.read_text(encoding="utf-8") == wanted:
        return python
    say(f"{name}: making {home} with {wanted}")
    try:
        venv.create(home, clear=True, with_pip=True)
        pip = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *NEEDS[name]]
        subprocess.run(pip, check=True, capture_output=True, text=True, timeout=_ENOUGH_S)
    except subprocess.CalledProcessError as error:
        lines = [line for line in str(error.stderr).splitlines() if "ERROR" in line] or ["pip failed"]
        raise NoEnvironment(f"{name}: cannot be installed: {lines[-1][:160]}") from None
    except (OSError, subprocess.TimeoutExpired) as error:
        raise NoEnvironment(f"{name}: cannot be made: {str(error)[:160]}") from None
    mark.write_text(wanted, encoding="utf-8")
    return python
