"""The work of a reproduction, cut into jobs whose results land in files of their own, so that it can go on later."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

from lumidock.errors import LumidockError
from lumidock.evaluation.campaign import read_json, source_digest, write_whole
from lumidock.evaluation.workers import worker_pool

Progress = Callable[[int, int | None], None]


@dataclass(frozen=True, slots=True)
class Job:
    """`call(*arguments)` gives a result that JSON can hold; `name` is its file, `weight_s` about how long it takes.

    `leaves` are files that it writes beside its result: where one is gone, the job is run again. `code` stands for the
    code of methods that are not of this package.
    """

    name: str
    weight_s: float
    call: Callable[..., dict[str, Any]]
    arguments: tuple[Any, ...]
    leaves: tuple[Path, ...] = ()
    code: str = ""

    def key(self, dock: str) -> str:
        """Stands for all that the result depends on: the source of the package, the arguments and the dock's files."""
        what = f"{source_digest()} {dock} {self.code} {self.name} {self.call.__name__} {self.arguments!r}"
        return hashlib.sha256(what.encode()).hexdigest()[:24]


def run_jobs(
    jobs: Sequence[Job], out: Path, dock: str, *, workers: int, progress: Progress = lambda _done, _total: None
) -> dict[str, Any]:
    """Results of all jobs by name; those whose file is in `out` with the same key are not run again.

    With `workers` 0 they run in this process. Progress counts seconds of expected work. Raises: LumidockError when a
    worker dies; what is done stays done.
    """
    out.mkdir(parents=True, exist_ok=True)
    results, todo = {}, []
    for job in jobs:
        before = read_json(out / f"{job.name}.json")
        whole = all(path.exists() for path in job.leaves)
        if whole and before is not None and before.get("key") == job.key(dock) and "result" in before:
            results[job.name] = before["result"]
        else:
            todo.append(job)
    total = round(sum(job.weight_s for job in jobs))
    left = {job.name: job.weight_s for job in todo}
    progress(total - round(sum(left.values())), total)
    for job, result, seconds in _done(sorted(todo, key=lambda job: -job.weight_s), workers):
        write_whole(out / f"{job.name}.json", json.dumps({"key": job.key(dock), "seconds": seconds, "result": result}))
        results[job.name] = json.loads(json.dumps(result))  # as it will be read the next time
        del left[job.name]
        progress(total - round(sum(left.values())), total)
    return results


def _done(jobs: Sequence[Job], workers: int) -> Any:  # noqa: ANN401  # an iterator of job, result and seconds
    if not workers:
        yield from ((job, *_timed(job)) for job in jobs)
        return
    try:
        with worker_pool(workers, None) as pool:
            futures = {pool.submit(_timed, job): job for job in jobs}
            for future in as_completed(futures):
                yield futures[future], *future.result()
    except BrokenProcessPool:
        raise LumidockError("a worker died; the same command goes on where it was") from None


def _timed(job: Job) -> tuple[dict[str, Any], float]:
    cv2.setNumThreads(1)
    start = time.perf_counter()
    return job.call(*job.arguments), time.perf_counter() - start
