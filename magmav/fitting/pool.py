"""Processes that each work on one log at a time. One that dies takes down nothing but its own log's turn.

Not concurrent.futures: there the death of one process breaks the whole pool, and nobody knows which log did it.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing import connection, get_context, parent_process
from multiprocessing.context import SpawnProcess
from typing import Any

from magmav.fitting import FitOptions
from magmav.fitting.work import FAULT, Job, refused, work
from magmav.settings import Settings

Result = dict[str, Any]
Watch = Callable[[Job, int, int], None]
"""Told of (job, done, in all) now and then, and of (job, 0, 0) when it begins."""
_TRIES = 2
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_STEPS = 50  # so often a log's progress is told


class _Worker:
    """One process and the log it has now."""

    def __init__(self, settings: Settings, options: FitOptions) -> None:
        context = get_context("spawn")  # a fork would copy locks that threads of ours may hold
        self.pipe, theirs = context.Pipe()
        self.process: SpawnProcess = context.Process(target=_serve, args=(theirs, settings, options), daemon=True)
        with _one_thread():
            self.process.start()
        theirs.close()
        self.job: Job | None = None

    def give(self, job: Job) -> None:
        self.job = job
        with suppress(OSError):  # it is dead; its pipe says so in a moment, and the log has another turn
            self.pipe.send(job)

    def end(self) -> None:
        self.pipe.close()
        self.process.join(0.0)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


def in_pool(
    jobs: Iterator[Job], count: int, settings: Settings, options: FitOptions, watch: Watch
) -> Iterator[tuple[Job, Result]]:
    """Every job with its outcome (see work.work), in the order they end. No more jobs are taken than are worked on.

    A log whose process dies has one more turn; then it is refused, and the others go on.
    """
    workers: list[_Worker] = []
    again: deque[Job] = deque()
    tries: dict[Job, int] = {}

    def next_job() -> Job | None:
        return again.popleft() if again else next(jobs, None)

    try:
        while True:
            idle = [w for w in workers if w.job is None]
            while idle or len(workers) < count:
                job = next_job()
                if job is None:
                    break
                if not idle:
                    workers.append(_Worker(settings, options))
                    idle.append(workers[-1])
                watch(job, 0, 0)
                idle.pop().give(job)
            busy = {w.pipe: w for w in workers if w.job is not None}
            if not busy:
                return
            for pipe in connection.wait(list(busy)):
                worker = busy[pipe]  # type: ignore[index]  # they are the ones that were given
                job = worker.job
                assert job is not None
                said = _hear(worker.pipe)
                if said is not None and said[0] == "progress":
                    watch(job, *said[1:])
                    continue
                if said is not None and said[0] == "done":
                    worker.job = None
                    yield job, said[1]
                    continue
                workers.remove(worker)
                worker.process.join(5.0)
                worker.end()
                tries[job] = tries.get(job, 0) + 1
                if said is not None:
                    text = f"{job.path}: a fault of magmav ({said[1]}); please report it with this file"
                    yield job, refused(text, FAULT)
                elif tries[job] < _TRIES:
                    again.append(job)
                else:
                    yield job, refused(f"{job.path}: {_died(worker.process.exitcode)}", FAULT)
    finally:
        for worker in workers:
            worker.end()


def _hear(pipe: connection.Connection) -> tuple[Any, ...] | None:
    """What it said; None when it is gone."""
    try:
        said: tuple[Any, ...] = pipe.recv()
    except (EOFError, OSError):
        return None
    return said


def _died(code: int | None) -> str:
    how = f"exit code {code}" if code is None or code >= 0 else f"signal {-code}"
    return f"the process working on it died {_TRIES} times ({how}), as when memory runs out; try again with --jobs 1"


@contextmanager
def _one_thread() -> Iterator[None]:
    """A process each is what fills the cores; numpy in it does not multiply them, and adds up in one order."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


# ------------------------------------------------------------ in the process


def _serve(pipe: connection.Connection, settings: Settings, options: FitOptions) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the one who gave us the work
    threading.Thread(target=_follow_parent, daemon=True).start()
    while True:
        try:
            job: Job = pipe.recv()
        except (EOFError, OSError):
            return
        try:
            outcome = work(job, settings, options, _teller(pipe))
        except Exception as error:
            pipe.send(("fault", f"{type(error).__name__}: {error}"))
            sys.stderr = open(os.devnull, "w")  # noqa: SIM115  the fault was told; its trace is for nobody
            raise
        pipe.send(("done", outcome))


def _teller(pipe: connection.Connection) -> Callable[[int, int], None]:
    last = -1

    def tell(done: int, total: int) -> None:
        nonlocal last
        step = done * _STEPS // total if total else 0
        if step != last:
            last = step
            pipe.send(("progress", done, total))

    return tell


def _follow_parent() -> None:
    """Nobody is left to hear the answer: end at once, whatever the work is at."""
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)
