"""Work that takes seconds: lumidock's own commands in processes of their own, at a low priority.

A process of its own takes neither the interpreter from guidance nor, with the kernel's help, the processor.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal

from lumidock.errors import InputError, LumidockError

_NICE = 10  # a tenth of the share of guidance where both want the same core; 19 would starve on a busy computer
_MOST_KEPT = 50  # jobs whose results can still be asked for
_MOST_WAITING = 4

Work = Callable[["Job"], Any]


@dataclass(slots=True)
class Job:
    """One piece of work: what it is, how far it is, and its result or the line that says why there is none."""

    number: int
    title: str
    state: Literal["waiting", "running", "done", "failed"] = "waiting"
    line: str = ""
    result: Any = None
    process: subprocess.Popen[str] | None = None

    def view(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "number": self.number,
            "title": self.title,
            "state": self.state,
            "line": self.line,
            "result": self.result,
        }

    def command(self, words: Sequence[str], *, codes: Sequence[int] = (0,)) -> Any:  # noqa: ANN401  # whatever JSON says
        """Run `lumidock WORDS` and read the JSON that it prints.

        Raises: InputError with the command's own line where its exit code is none of `codes`.
        """
        command = [sys.executable, "-m", "lumidock", *words]
        pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        self.process = process = subprocess.Popen(command, text=True, start_new_session=True, **pipes)  # type: ignore[call-overload]
        with suppress(OSError):  # it may have ended by now
            os.setpriority(os.PRIO_PROCESS, process.pid, _NICE)
        out, err = process.communicate()
        if process.returncode not in codes:
            lines = [line for line in err.splitlines() if line.startswith("lumidock: ")] or err.splitlines()[-1:]
            raise InputError(
                (lines[-1] if lines else f"ended by signal {-process.returncode}").removeprefix("lumidock: ")
            )
        return json.loads(out) if out.strip() else None


class Jobs:
    """Runs one job after the other on a thread of its own."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, "console-jobs", _lower_priority)
        self._lock = threading.Lock()
        self._jobs: dict[int, Job] = {}
        self._next = 1

    def start(self, title: str, work: Work) -> Job:
        """Queue `work`, which is given its job. Raises: InputError where too much waits already."""
        with self._lock:
            if sum(job.state == "waiting" for job in self._jobs.values()) >= _MOST_WAITING:
                raise InputError("four jobs wait already; let them end first")
            job = Job(self._next, title)
            self._jobs[job.number] = job
            self._next += 1
            for number in list(self._jobs)[:-_MOST_KEPT]:
                del self._jobs[number]
        self._pool.submit(_run, job, work)
        return job

    def get(self, number: int) -> Job:
        """A job by its number. Raises: InputError for one that there is not."""
        with self._lock:
            if number not in self._jobs:
                raise InputError(f"no job {number}")
            return self._jobs[number]

    def close(self) -> None:
        """End what runs and drop what waits."""
        with self._lock:
            jobs = list(self._jobs.values())
        self._pool.shutdown(wait=False, cancel_futures=True)
        for job in jobs:
            if job.process is not None and job.process.poll() is None:
                job.process.terminate()


def _run(job: Job, work: Work) -> None:
    job.state = "running"
    try:
        job.result = work(job)
        job.state = "done"
    except Exception as error:  # whatever it is: a page waits for the end of the job
        expected = isinstance(error, LumidockError | OSError | ValueError)
        job.line = " ".join((str(error) if expected else repr(error)).split())
        job.state = "failed"


def _lower_priority() -> None:
    """Linux gives each thread a priority of its own."""
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
