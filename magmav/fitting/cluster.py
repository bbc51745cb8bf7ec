"""The same work on an existing Dask cluster. distributed is an extra and is imported only here, when asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any

from magmav import __version__
from magmav.fitting import FitOptions
from magmav.fitting.work import FAULT, Job, refused, work
from magmav.settings import Settings

Result = dict[str, Any]
_ANSWER_S = 10.0
_AHEAD = 2  # jobs handed out per thread of the cluster, so that none waits for us


class ClusterError(Exception):
    """No cluster to work on; the text says what is missing and what to do."""


def on_cluster(
    address: str, jobs: Iterator[Job], settings: Settings, options: FitOptions, watch: Callable[[Job, int, int], None]
) -> Iterator[tuple[Job, Result]]:
    """Every job with its outcome, in the order they end, as pool.in_pool.

    The workers must see the logs under the same absolute paths, and have this magmav installed. Raises ClusterError.
    """
    try:
        dask: Any = import_module("distributed")
    except ImportError:
        text = "--dask: the package distributed is not installed; pip install 'magmav[dask]', or leave --dask out"
        raise ClusterError(text) from None
    try:
        client = dask.Client(address, timeout=_ANSWER_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        why = f"no Dask scheduler answers there ({_first_line(error)})"
        raise ClusterError(f"--dask {address}: {why}; want the address it printed, as tcp://HOST:8786") from None
    with client:
        threads = sum(client.nthreads().values())
        if not threads:
            raise ClusterError(f"--dask {address}: the cluster has no workers; start some with `dask worker {address}`")
        told = client.scatter((settings, options), broadcast=True, hash=False)
        running: dict[Any, Job] = {}
        ended = dask.as_completed(loop=client.loop)

        def feed() -> None:
            while len(running) < _AHEAD * threads and (job := next(jobs, None)) is not None:
                watch(job, 0, 0)
                future = client.submit(_remote, job, told, pure=False, retries=1)
                running[future] = job
                ended.add(future)

        feed()
        while running:
            future = next(ended)
            job = running.pop(future)
            yield job, _outcome(job, future)
            future.release()
            feed()


def _remote(job: Job, told: tuple[Settings, FitOptions]) -> tuple[str, Result]:
    return __version__, work(job, *told)


def _outcome(job: Job, future: Any) -> Result:
    error = future.exception()
    if error is not None:
        why = f"{type(error).__name__}: {_first_line(error)}"
        return refused(f"{job.path}: the cluster could not do it ({why}); look at its workers, and their magmav", FAULT)
    version, outcome = future.result()
    if version != __version__:
        text = f"{job.path}: a worker has magmav {version}, we are {__version__}; install the same everywhere"
        return refused(text, FAULT)
    result: Result = outcome
    return result


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [""])[0][:200]
