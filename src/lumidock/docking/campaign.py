"""Many dockings: seeds x methods over processes, and what is counted in them."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from lumidock.docking.loop import Docking, DockingResult, Moment, run
from lumidock.evaluation.workers import worker_pool

_BLOCK = 5  # dockings of one method in one job
Progress = Callable[[int, int | None], None]


@dataclass(frozen=True, slots=True)
class Block:
    """What came of successive seeds by one method, and the processor seconds that they took."""

    method: str
    results: tuple[DockingResult, ...]
    seconds: float


@dataclass(frozen=True, slots=True, eq=False)
class InFull:
    """One docking with all its moments."""

    block: Block
    moments: tuple[Moment, ...]

    @property
    def result(self) -> DockingResult:
        """What came of it."""
        return self.block.results[0]


def in_full(docking: Docking) -> InFull:
    """One docking, of which everything is kept."""
    start = time.process_time()
    result, moments = run(docking)
    return InFull(Block(docking.method, (result,), time.process_time() - start), tuple(moments))


def run_block(first: Docking, count: int) -> Block:
    """So many dockings from the seed of the `first` on; runs in a worker process."""
    cv2.setNumThreads(1)
    start = time.process_time()
    results = tuple(run(replace(first, seed=first.seed + k))[0] for k in range(count))
    return Block(first.method, results, time.process_time() - start)


def run_campaign(
    first: Docking, methods: Sequence[str], runs: int, workers: int, progress: Progress = lambda _done, _all: None
) -> dict[str, list[Block]]:
    """The dockings `first.seed` to `first.seed` + `runs` - 1 by each method; the order of seeds is kept."""
    jobs = [
        (replace(first, method=method, seed=first.seed + k), min(_BLOCK, runs - k))
        for method in methods
        for k in range(0, runs, _BLOCK)
    ]
    found: dict[str, list[Block]] = {method: [] for method in methods}
    for done, block in enumerate(_blocks(jobs, workers), 1):
        found[block.method].append(block)
        progress(done, len(jobs))
    return found


def _blocks(jobs: list[tuple[Docking, int]], workers: int) -> Iterator[Block]:
    if workers <= 1:
        yield from (run_block(first, count) for first, count in jobs)
        return
    with worker_pool(workers, None) as pool:
        yield from pool.map(run_block, *zip(*jobs, strict=True))


def counted(blocks: Sequence[Block]) -> dict[str, Any]:
    """What came of the dockings of one method, as numbers for JSON and tables."""
    results = [result for block in blocks for result in block.results]
    docked = [result for result in results if result.docked]
    aborted = [result for result in results if result.outcome == "aborted"]
    worst = [result.worst_fix_m for result in results if math.isfinite(result.worst_fix_m)]
    seconds = sum(block.seconds for block in blocks)
    return {
        "runs": len(results),
        "docked": len(docked),
        "not_at_the_point": sum(v.outcome == "docked" and not v.docked for v in results),
        "contacts": sum(v.contact for v in results),
        "aborts_right": sum(v.right for v in aborted),
        "aborts_wrong": sum(not v.right for v in aborted),
        "out_of_time": sum(v.outcome == "out_of_time" for v in results),
        "why": dict(Counter(v.word for v in results if not v.docked)),
        "median_s": float(np.median([v.time_s for v in docked])) if docked else None,
        "retries": sum(v.tries for v in results),
        "worst_fix_m": max(worst, default=None),
        "misleading": sum(v.misleading for v in results),
        "valid_share": sum(v.valid for v in results) / max(sum(v.frames for v in results), 1),
        "least_room_m": min((v.room_m for v in results if math.isfinite(v.room_m)), default=None),
        "dockings_per_s": len(results) / seconds if seconds else None,
        "by_current": by_current(results),
    }


def by_current(results: Sequence[DockingResult]) -> dict[str, list[int]]:
    """Docked and all dockings in currents under 0.17, under 0.34, and faster, m/s."""
    bins: dict[str, list[int]] = {"<0.17": [0, 0], "<0.34": [0, 0], ">0.34": [0, 0]}
    for result in results:
        name = "<0.17" if result.current_m_s < 0.17 else "<0.34" if result.current_m_s < 0.34 else ">0.34"
        bins[name][0] += result.docked
        bins[name][1] += 1
    return bins


HEAD = (
    "method", "runs", "docked", "contacts", "aborts right", "wrong", "other ends", "median s", "retries",
    "worst fix followed, m", "over alert limit", "valid, %",
)  # fmt: skip


def row(method: str, content: dict[str, Any]) -> list[str]:
    """One row of the table under `HEAD`."""
    runs = content["runs"]
    return [
        method,
        str(runs),
        f"{content['docked']} ({100.0 * content['docked'] / max(runs, 1):.1f} %)",
        str(content["contacts"]),
        str(content["aborts_right"]),
        str(content["aborts_wrong"]),
        str(content["not_at_the_point"] + content["out_of_time"]),
        "-" if content["median_s"] is None else f"{content['median_s']:.0f}",
        str(content["retries"]),
        "-" if content["worst_fix_m"] is None else f"{content['worst_fix_m']:.2f}",
        str(content["misleading"]),
        f"{100.0 * content['valid_share']:.1f}",
    ]
