"""What people install: the wheel carries scenarios and settings, and its demo runs from anywhere."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from process_rig import WALL_S, environment

_ROOT = Path(__file__).parents[1]
_UV = shutil.which("uv", path=os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", ""))))
pytestmark = pytest.mark.skipif(_UV is None, reason="uv is not installed")


def run(*words, **options):
    command = [str(w) for w in words]
    return subprocess.run(command, capture_output=True, text=True, timeout=WALL_S, check=False, **options)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel, built from a copy of what would be released, so that nothing is written into the checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    for name in ("magmav", "sim", "config"):
        shutil.copytree(_ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(_ROOT / name, source / name)
    done = run(_UV, "build", "--wheel", "--out-dir", folder, source, "--python", sys.executable)
    if done.returncode != 0 and any(w in done.stderr for w in ("resolve", "network", "connect", "download", "fetch")):
        pytest.skip(f"the build backend cannot be had here: {done.stderr.strip().splitlines()[-1]}")
    assert done.returncode == 0, done.stderr
    (built,) = folder.glob("*.whl")
    return built


def test_wheel_holds_code_and_configuration_and_nothing_else(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    scenarios = {p.name for p in (_ROOT / "config" / "scenarios").glob("*.toml")}
    assert scenarios == {n.rsplit("/", 1)[1] for n in names if n.startswith("magmav/_config/scenarios/")}
    settings = {f"magmav/_config/{p.name}" for p in (_ROOT / "config").glob("*.toml")}
    assert settings | {"magmav/cli.py", "magmav_sim/vehicle.py"} <= set(names)
    tops = {n.split("/", 1)[0] for n in names}
    assert {t for t in tops if not t.endswith(".dist-info")} == {"magmav", "magmav_sim"}
    assert not [n for n in names if n.endswith((".csv", ".tlog", ".pyc", ".sqlite"))]


@pytest.mark.long
def test_demo_runs_from_the_wheel_without_the_checkout(wheel, tmp_path):
    target, elsewhere, scratch = (tmp_path / n for n in ("target", "elsewhere", "scratch"))
    elsewhere.mkdir()
    scratch.mkdir()
    installed = run(
        _UV, "pip", "install", "--no-deps", "--offline", "--target", target, "--python", sys.executable, wheel
    )
    assert installed.returncode == 0, installed.stderr
    env = environment(scratch) | {"PYTHONPATH": str(target), "PYTHONDONTWRITEBYTECODE": "1"}
    asked = "import magmav, magmav_sim; print(magmav.__file__); print(magmav_sim.__file__)"
    where = run(sys.executable, "-c", asked, cwd=elsewhere, env=env)
    assert where.stdout.splitlines() == [str(target / m / "__init__.py") for m in ("magmav", "magmav_sim")]
    done = run(sys.executable, "-m", "magmav.cli", "demo", "--json", cwd=elsewhere, env=env)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["upload"]["result"] == "ALL_NEW" and result["restore"]["result"] == "ALL_OLD"
    assert result["after"]["heading_rms_deg"] < result["before"]["heading_rms_deg"] / 5.0
    assert list(elsewhere.iterdir()) == [] and list(scratch.iterdir()) == []
