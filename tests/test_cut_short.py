"""A soak that is cut short tells what it has."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from fuzz_wire import TURNS


def test_rubbish_cut_short_tells_what_it_has(tmp_path: Path) -> None:
    """SIGTERM in the second of five turns, as when a machine is shared: the first is told whole."""
    script = str(Path(__file__).parents[1] / "benchmarks" / "fuzz_wire.py")
    each = 100_000
    command = [sys.executable, script, f"{len(TURNS) * each}", "1", "1"]
    out = tmp_path / "out.txt"
    with out.open("w") as stdout:
        child = subprocess.Popen(command, stdout=stdout, env=os.environ | {"TMPDIR": str(tmp_path)})
        begun: set[Path] = set()  # each turn keeps its store in a folder of its own
        while len(begun) < 2 and child.poll() is None:
            begun |= {path.parent for path in tmp_path.glob("*/fuzz.sqlite")}
            time.sleep(0.02)
        child.terminate()
        assert child.wait() == 0
    said = out.read_text()
    cells = [[cell.strip() for cell in line.split("\u2502")[1:3]] for line in said.splitlines()]
    sizes = {row[0]: int(row[1]) for row in cells if row and row[0] in TURNS}
    assert "cut short" in said
    assert sizes[TURNS[0]] >= each
    assert all(size < each for name, size in sizes.items() if name != TURNS[0])
    assert not list(tmp_path.glob("*/fuzz.sqlite")), "nothing is left behind"
