"""The paper's Table 1 at point level: matching success with missing and with spurious lights, section 4.1 conditions.

A frame counts when all seven front lights are in view; it is right when every true detection carries its own name and
no spurious one carries any.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from functools import partial
from multiprocessing import get_context

from bench.shipped import shipped_camera, shipped_station
from lumidock.reproduce import trials
from lumidock.reproduce.experiments import ROWS
from lumidock.reproduce.paper_figures import TABLE_1
from lumidock.reproduce.trials import Counts

TRIALS = 30
FIRST_SEED = 20_000


def trial(missing: int, spurious: int, seed: int, *, clean_start: bool = False) -> Counts:
    """One run toward the shipped dock."""
    return trials.trial(shipped_station(), shipped_camera(), missing, spurious, seed, clean_start=clean_start)


def condition(missing: int, spurious: int, first_seed: int = FIRST_SEED, *, clean_start: bool = False) -> Counts:
    """All trials of one condition, on all cores."""
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        job = partial(trial, missing, spurious, clean_start=clean_start)
        return sum(pool.map(job, range(first_seed, first_seed + TRIALS)), Counts())


def main() -> tuple[dict[str, object], list[str]]:
    """The table, with the paper's own figures."""
    lines = [
        "| front lights missing + spurious | frames | PSO, % | paper | wrong ones the filter passes "
        "| PSO + filter + BTEKF, % | paper | wrong identities accepted |",
        "|---|---|---|---|---|---|---|---|",
    ]
    content: dict[str, object] = {}
    for missing, spurious, clean_start in ROWS:
        counts = condition(missing, spurious, clean_start=clean_start)
        paper = ("-", "-") if clean_start else TABLE_1.get((missing, spurious), ("-", "-"))
        swarm, whole = (100.0 * n / counts.frames for n in (counts.swarm_right, counts.right))
        name = f"{missing} + {spurious}{', after a clean start' * clean_start}"
        lines.append(
            f"| {name} | {counts.frames} | {swarm:.2f} | {paper[0]} | {counts.filter_passes_wrong} "
            f"| {whole:.2f} | {paper[1]} | {counts.wrong} |"
        )
        content[f"{missing}+{spurious}{'-warm' * clean_start}"] = asdict(counts)
    return content, lines
