"""S2: the process is killed (SIGKILL) at each step of an upload, and another one starts: all old or all new again.

The vehicle outlives the process: what was on the wire still arrives, and what it stores is kept in a file.
"""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from scripted_vehicle import S, Vehicle
from test_kept import Bench
from upload_rig import NAMES, OLD, a_change

from magmav.core.types import UploadResult
from magmav.mavlink.terms import Phase
from magmav.store import Store

NEW = a_change().new
STEPS = (
    "PREFLIGHT", "BASELINE", "before record", "recorded", "WRITE", "set 1", "set 2", "set 3", "READ_BACK", "SETTLE",
    "PROOF", "before end", "ended", "ARMING",
)  # fmt: skip
DONE = ("ended", "ARMING")
BEFORE = ("PREFLIGHT", "BASELINE", "before record")


def in_a_process(work: Callable[[], None]) -> int:
    """Run in a process of its own; how it ended (minus the signal)."""
    child = os.fork()
    if child == 0:
        code = 70
        try:
            work()
            code = 0
        finally:
            os._exit(code)  # never back into pytest
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


class Life:
    """One life of the companion on the vehicle of ``state``."""

    def __init__(self, folder: Path, step: str = "") -> None:
        self.state = folder / "vehicle.json"
        self.step = step
        self.vehicle = Vehicle()
        if self.state.exists():
            self.vehicle.params.update(json.loads(self.state.read_text()))
            self.vehicle.applied.update(self.vehicle.params)
        self.sets = 0
        self.vehicle.on_set = lambda name: self.was_set()
        self.bench = Bench(folder / "s.sqlite", self.vehicle)

    def was_set(self) -> None:
        self.sets += 1
        self.reached(f"set {self.sets}")

    def reached(self, step: str) -> None:
        if step == self.step:
            self.vehicle.on_set = lambda name: None
            self.step = ""
            if not step.startswith("set"):  # there, the rest of the vector was lost with the process
                for _, _, where, message in sorted(self.vehicle._queue, key=lambda item: item[:2]):
                    if where == "vehicle":
                        self.vehicle._handle(message)  # what was sent still arrives
            self.keep()
            os.kill(os.getpid(), signal.SIGKILL)

    def keep(self) -> None:
        self.state.write_text(json.dumps(self.vehicle.params))

    def upload(self) -> None:
        store, bench = self.bench.store, self.bench
        begin, finish = store.begin, store.finish

        def spied_begin(*a, **k):  # type: ignore[no-untyped-def]
            self.reached("before record")
            row = begin(*a, **k)
            self.reached("recorded")
            return row

        def spied_finish(*a, **k):  # type: ignore[no-untyped-def]
            self.reached("before end")
            finish(*a, **k)
            self.reached("ended")

        store.begin, store.finish = spied_begin, spied_finish  # type: ignore[method-assign]
        bench.run(7.0)
        bench.companion.start(a_change(), None, self.vehicle.now_ns)
        job = bench.companion.job
        assert job is not None
        phase, end_ns = Phase.IDLE, self.vehicle.now_ns + 30 * S
        while job.result is None and self.vehicle.now_ns < end_ns:
            if job.phase is not phase:
                phase = job.phase
                self.reached(phase.name)
            bench.run(0.02)
        self.keep()


def held(folder: Path) -> tuple[float, ...]:
    params = json.loads((folder / "vehicle.json").read_text())
    return tuple(params[name] for name in NAMES)


@pytest.mark.parametrize("step", STEPS)
def test_S2_killed_at_each_step_and_started_again_it_is_all_old_or_all_new(tmp_path: Path, step: str) -> None:
    assert in_a_process(lambda: Life(tmp_path, step).upload()) == -signal.SIGKILL, f"{step} was never reached"
    left = held(tmp_path)
    with Store(tmp_path / "s.sqlite") as store:
        rows, pending = store.history(), store.pending()
    if step in BEFORE:
        assert (rows, left) == ([], OLD), "nothing is written before it is on record"
    elif step in DONE:
        assert ([r.result for r in rows], pending, left) == ([UploadResult.ALL_NEW], [], NEW)
    else:
        assert [r.result for r in pending] == [None], "cut short, and known to be"
        if step.startswith("set"):
            done = int(step[-1])
            assert left == (*NEW[:done], *OLD[done:]), "every mixture is met"

    def again() -> None:
        life = Life(tmp_path)
        life.bench.run(26.0)
        life.keep()

    assert in_a_process(again) == 0
    with Store(tmp_path / "s.sqlite") as store:
        assert store.pending() == []
        after = store.history()
    if pending:
        assert held(tmp_path) == OLD
        assert (after[0].result, after[0].undoes, after[1].undone) == (UploadResult.ALL_OLD, 1, True)
    else:
        assert (held(tmp_path), after) == (left, rows), "nothing is pending: nothing is touched (S18)"


@pytest.mark.parametrize("step", ["set 1", "set 2"])
def test_S2_killed_twice_while_the_way_back_runs_too(tmp_path: Path, step: str) -> None:
    assert in_a_process(lambda: Life(tmp_path, step).upload()) == -signal.SIGKILL
    assert held(tmp_path) not in (OLD, NEW)

    def dies_on_the_way_back() -> None:
        life = Life(tmp_path, "set 1")
        life.bench.run(26.0)

    assert in_a_process(dies_on_the_way_back) == -signal.SIGKILL

    def again() -> None:
        life = Life(tmp_path)
        life.bench.run(26.0)
        life.keep()

    assert in_a_process(again) == 0
    assert held(tmp_path) == OLD
    with Store(tmp_path / "s.sqlite") as store:
        assert store.pending() == [] and store.history()[0].result is UploadResult.ALL_OLD


def test_S2_killed_and_somebody_else_wrote_meanwhile_asks_and_touches_nothing(tmp_path: Path) -> None:
    """The rule: only while every value is the old or our written one (design, rule 10)."""
    assert in_a_process(lambda: Life(tmp_path, "set 1").upload()) == -signal.SIGKILL
    params = json.loads((tmp_path / "vehicle.json").read_text()) | {NAMES[2]: 77.0}
    (tmp_path / "vehicle.json").write_text(json.dumps(params))
    life = Life(tmp_path)
    life.bench.run(26.0)
    assert life.sets == 0 and life.vehicle.params[NAMES[2]] == 77.0
    assert [row.result for row in life.bench.store.pending()] == [None]
    assert any("not undone: magmav history" in text for text in life.bench.texts)
    life.bench.store.close()
