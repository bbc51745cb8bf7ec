"""The arrows never turn back: who may import whom, who may know the time, who may print."""

import ast
import statistics
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SOURCES = {
    ".".join(path.relative_to(top).with_suffix("").parts).removesuffix(".__init__"): path
    for top, package in ((ROOT, "magmav"), (ROOT / "sim", "magmav_sim"))
    for path in sorted((top / package).rglob("*.py"))
}
TREES = {name: ast.parse(path.read_text()) for name, path in SOURCES.items()}


def inside(name: str, *packages: str) -> bool:
    return any(name == p or name.startswith(p + ".") for p in packages)


def imports(name: str) -> Iterator[str]:
    """Full names of all modules a module imports, wherever in it; ``from package import module`` names the module."""
    for node in ast.walk(TREES[name]):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name}: relative import"
            base = node.module or ""
            for alias in node.names:
                full = f"{base}.{alias.name}"
                yield full if full in SOURCES else base


CORE_FOR_READERS = (
    *("magmav.core.types", "magmav.core.reasons", "magmav.core.rotation", "magmav.core.orientation"),
    "magmav.core.motion_run",  # what columns of attitudes are handed on as
)

# Package: what it may import of ours, and of others' (None: anything installed).
STOREYS = {
    "magmav.core": (("magmav.core",), ("numpy", "filterpy")),
    "magmav.link": (("magmav.link",), None),
    # core.reasons is the part of core.types that holds the one vocabulary.
    "magmav.mavlink": (("magmav.mavlink", *CORE_FOR_READERS), None),
    # A .tlog is a link's bytes, and read by columns it must give what link and codec give one by one.
    "magmav.logs": (("magmav.logs", "magmav.link", "magmav.mavlink.codec", *CORE_FOR_READERS), None),
    "magmav.view": (("magmav.view", "magmav.core.types", "magmav.core.reasons"), None),
    "magmav_sim": (("magmav_sim", "magmav.link", "magmav.mavlink.codec"), None),
}


@pytest.mark.parametrize("storey", STOREYS)
def test_arrows_never_turn_back(storey):
    ours, others = STOREYS[storey]
    wrong = []
    for name in (n for n in SOURCES if inside(n, storey)):
        for got in imports(name):
            top = got.partition(".")[0]
            if top in ("magmav", "magmav_sim"):
                fine = inside(got, *ours)
            else:
                fine = others is None or top in others or top in sys.stdlib_module_names
            if not fine:
                wrong.append(f"{name} imports {got}")
    assert wrong == []


def test_the_walk_sees_the_whole_tree():
    """A test that looks at nothing would always be green."""
    assert len(SOURCES) > 60
    assert "magmav.core.types" in set(imports("magmav.core.estimators.kalman"))
    assert "filterpy.kalman" in set(imports("magmav.core.estimators.kalman"))
    assert "magmav.core.gate" in set(imports("magmav.channels"))


def test_licences_that_do_not_mix_are_never_imported():
    """pymavlink's DFReader and mavftp are GPL; mavutil opens sockets and keeps clocks of its own."""
    forbidden = ("DFReader", "mavftp", "mavutil")
    assert [f"{n} imports {i}" for n in SOURCES for i in imports(n) if i.rpartition(".")[2] in forbidden] == []
    for name, tree in TREES.items():
        named = {a.name for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for a in node.names}
        assert not named & set(forbidden), name


CLOCK = {
    "time": {"time", "time_ns", "monotonic", "monotonic_ns", "sleep", "perf_counter", "perf_counter_ns"},
    "datetime": {"now", "utcnow", "today"},
    "date": {"today"},
}
MAY_KNOW_THE_TIME = {
    "magmav.link": "the link is the only clock",
    "magmav.demo": "measures wall time and waits for its child process",
    "magmav.cli": "measures wall time for progress",
    "magmav.commands": "the command line's own bodies",
    "magmav_sim.serve": "paces a simulated vehicle over a real link",
}


def clock_reads(tree: ast.AST) -> Iterator[int]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, (ast.Name, ast.Attribute)):
            owner = node.value.id if isinstance(node.value, ast.Name) else node.value.attr
            if node.attr in CLOCK.get(owner, ()):
                yield node.lineno
        elif isinstance(node, ast.ImportFrom) and node.module == "time":
            yield from (node.lineno for alias in node.names if alias.name in CLOCK["time"])


def test_the_link_is_the_only_clock():
    wrong = [
        f"{name}:{line}"
        for name, tree in TREES.items()
        if not inside(name, *MAY_KNOW_THE_TIME)
        for line in clock_reads(tree)
    ]
    assert wrong == []


def test_only_the_command_line_prints():
    may = ("magmav.cli", "magmav.commands", "magmav_sim.__main__")
    wrong = [
        f"{name}:{node.lineno}"
        for name, tree in TREES.items()
        if not inside(name, *may)
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"
    ]
    assert wrong == []


def catches_all(node: ast.AST) -> bool:
    broad = ("Exception", "BaseException")
    return isinstance(node, ast.ExceptHandler) and (
        node.type is None or (isinstance(node.type, ast.Name) and node.type.id in broad)
    )


def test_no_error_is_swallowed_whole():
    """Cleaning up on the way out is no swallowing, so a handler that ends in a bare ``raise`` may catch all."""
    wrong = [
        f"{name}:{node.lineno}"
        for name, tree in TREES.items()
        for node in ast.walk(tree)
        if catches_all(node) and not (isinstance(node.body[-1], ast.Raise) and node.body[-1].exc is None)
    ]
    assert wrong == []


def test_chance_is_seeded():
    """Only generators made with a seed: random.Random(seed), numpy's default_rng(seed)."""
    wrong = []
    for name, tree in TREES.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "random":
                wrong += [] if node.attr == "Random" else [f"{name}:{node.lineno} {node.attr}"]
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                unseeded = node.func.attr in ("default_rng", "Random") and not node.args
                wrong += [f"{name}:{node.lineno} unseeded"] if unseeded else []
    assert wrong == []


# Files over 150 lines pull the median; over 400 none is read in one go.
LONGER_THAN_400: dict[str, str] = {}


def test_files_stay_small():
    lengths = {name: len(path.read_text().splitlines()) for name, path in SOURCES.items()}
    lengths = {name: n for name, n in lengths.items() if n > 0}
    assert statistics.median(lengths.values()) <= 150
    assert {name: n for name, n in lengths.items() if n > 400 and name not in LONGER_THAN_400} == {}


def test_a_screen_holds_the_path():
    assert len(SOURCES["magmav.pipeline"].read_text().splitlines()) <= 60
