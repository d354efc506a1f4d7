"""Work over processes of this machine or a dask cluster; a worker that dies is replaced."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import CancelledError, Executor, Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Any, TypeVar

from lumidock.errors import InputError, LumidockError
from lumidock.sim.children import end_children, start_child

_MAX_POOLS = 4  # a worker that dies breaks its pool; after so many broken pools the work is given up
_Job = TypeVar("_Job")
_Result = TypeVar("_Result")


def results(
    work: Callable[[_Job], _Result],
    jobs: Mapping[str, _Job],
    workers: int,
    cluster: str | None = None,
    *,
    called: str = "jobs",
) -> Iterator[tuple[str, _Result]]:
    """Name and result of each job as it is finished; when a worker dies, the jobs that are left go to a new pool.

    Over `workers` processes (0: in this one), or on the dask cluster at the address `cluster`; `work` and jobs have to
    be picklable. Raises: InputError for a cluster that is not there; LumidockError when workers keep dying.
    """
    if cluster is None and not workers:
        yield from ((name, work(job)) for name, job in jobs.items())
        return
    left = dict(jobs)
    for _ in range(_MAX_POOLS):
        with worker_pool(workers, cluster) as pool:
            for name, result in _pooled(pool, work, dict(left)):
                del left[name]
                yield name, result
        if not left:
            return
    raise LumidockError(f"workers died {_MAX_POOLS} times; {len(left)} {called} are left")


def _pooled(pool: Executor, work: Callable[[_Job], _Result], jobs: Mapping[str, _Job]) -> Iterator[tuple[str, _Result]]:
    """Results as they are finished, except those whose worker died."""
    futures: dict[Future[_Result], str] = {}
    try:
        for name, job in jobs.items():
            futures[pool.submit(work, job)] = name
    except BrokenProcessPool:
        pass  # the futures of the jobs that were submitted raise the same error below
    for future in as_completed(futures):
        try:
            result = future.result()
        except Exception as error:
            if not _worker_died(error):
                raise
        else:
            yield futures[future], result


def _worker_died(error: Exception) -> bool:
    """Whether the worker died; dask's own error is recognised by its name, since dask need not be installed."""
    return isinstance(error, (BrokenProcessPool, CancelledError)) or type(error).__name__ == "KilledWorker"


@contextmanager
def worker_pool(workers: int, cluster: str | None) -> Iterator[Executor]:
    """Worker processes on this machine, or those of a dask cluster."""
    if cluster is not None:
        with _dask_client(cluster) as client:
            yield client.get_executor()
        return
    spawn = get_context("spawn")  # a fork would inherit the locks of OpenCV's threads
    with ProcessPoolExecutor(workers, mp_context=spawn, initializer=_start_worker) as pool:
        try:
            yield pool
        except SystemExit:  # SIGTERM: what is not finished is begun again by the next call
            end_children()
            raise
        finally:
            pool.shutdown(cancel_futures=True)


def _dask_client(address: str) -> Any:  # noqa: ANN401
    try:
        from distributed import Client
    except ImportError:
        raise InputError("--cluster needs dask distributed: pip install 'lumidock[cluster]'") from None
    try:
        return Client(address, timeout="10s", set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"--cluster {address}: {error or type(error).__name__}") from None


def _start_worker() -> None:
    """Let a worker end silently at Ctrl-C, and when its parent process ends."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    start_child()
