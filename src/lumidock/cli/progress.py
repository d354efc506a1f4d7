"""Progress of the commands on standard error."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

PLAIN_EVERY_S = 10.0  # between two lines of progress where there is no terminal
_TELLING = 0.02  # share of the items after which the rate tells the time that remains
_RECENT = 0.1  # share of the items, the last ones, that the rate is taken from: so a stop to compile is soon forgotten
Report = Callable[[int, int | None], None]


@contextmanager
def progress_bar(title: str) -> Iterator[Report]:
    """Progress on standard error: a bar on a terminal, elsewhere a line every ten seconds.

    Yields a callback (done, total).
    """
    console = Console(stderr=True)
    if not console.is_terminal:
        yield _PlainProgress(title).report
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("elapsed"),
        TimeElapsedColumn(),
        TextColumn("{task.fields[left]}"),
    )
    rate = _Rate()
    with Progress(*columns, console=console) as bar:
        task = bar.add_task(title, total=None, left="")
        yield lambda done, total: bar.update(
            task, completed=done, total=total, left=rate.remaining(time.monotonic(), done, total)
        )


class _Rate:
    """The time that remains, by the rate of the last items."""

    def __init__(self) -> None:
        self._seen: deque[tuple[float, int]] = deque()

    def remaining(self, now_s: float, done: int, total: int | None) -> str:
        """Words for the time that remains with `done` of `total` finished at `now_s`; empty where that is not known."""
        if not done:
            return ""  # the rate counts from the first item on, which may compile code
        self._seen.append((now_s, done))
        if not total:
            return ""
        while len(self._seen) > 1 and done - self._seen[1][1] >= _RECENT * total:
            self._seen.popleft()
        first_s, first_done = self._seen[0]
        if done - first_done <= _TELLING * total:
            return ""
        return f"remaining about {duration((now_s - first_s) * (total - done) / (done - first_done))}"


class _PlainProgress:
    """Lines for a log or a pipe, the first after ten seconds: what is over sooner needs none."""

    def __init__(self, title: str) -> None:
        self._title, self._start_s, self._rate = title, time.monotonic(), _Rate()
        self._next_s = self._start_s + PLAIN_EVERY_S

    def report(self, done: int, total: int | None) -> None:
        """Print a line if the last one was long enough ago."""
        now = time.monotonic()
        left = self._rate.remaining(now, done, total)
        if now < self._next_s:
            return
        self._next_s = now + PLAIN_EVERY_S
        line = f"{self._title}: {done}{f' of {total}' if total else ''}, elapsed {duration(now - self._start_s)}"
        print(f"{line}, {left}" if left else line, file=sys.stderr, flush=True)


def duration(seconds: float) -> str:
    """Hours, minutes and seconds as h:mm:ss."""
    whole = round(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"
