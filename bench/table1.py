"""The paper's Table 1 at point level: matching success with missing and with spurious lights, section 4.1 conditions.

A frame counts when all seven front lights are in view; it is right when every true detection carries the identity of
its own light and no spurious one carries any.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from functools import partial
from multiprocessing import get_context

from bench.shipped import shipped_camera, shipped_station
from lumidock.config import Config
from lumidock.reproduce import trials
from lumidock.reproduce.intervals import share
from lumidock.reproduce.paper_figures import TABLE_1
from lumidock.reproduce.table1 import LARGE, ROWS
from lumidock.reproduce.trials import Condition, Count, Counts, Participants

TRIALS = 30
FIRST_SEED = 20_000
START = "30 m"
METHODS = (LARGE, "paper")  # the swarm alone, and the whole method in its recommended preset


def trial(condition: Condition, seed: int, names: Sequence[str] = METHODS) -> Counts:
    """One run toward the shipped dock."""
    station, camera = shipped_station(), shipped_camera()
    return trials.trial(station, camera, condition, seed, Participants(names, station, camera, Config()))


def counts_of(condition: Condition, first_seed: int = FIRST_SEED) -> dict[str, Count]:
    """All trials of one condition, on all cores."""
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        return trials.merged(pool.map(partial(trial, condition), range(first_seed, first_seed + TRIALS)))[START]


def main() -> tuple[dict[str, object], list[str]]:
    """The table, with the paper's own figures."""
    lines = [
        "| front lights | frames | PSO, % | paper | wrong ones the filter passes "
        "| PSO + filter + BTEKF, % | paper | wrong identities accepted |",
        "|---|---|---|---|---|---|---|---|",
    ]
    content: dict[str, object] = {}
    for missing, spurious, clean_start in ROWS:
        condition = Condition(missing, spurious, clean_start)
        swarm, whole = (counts_of(condition)[name] for name in METHODS)
        paper = ("-", "-") if clean_start else TABLE_1.get((missing, spurious), ("-", "-"))
        lines.append(
            f"| {condition.name} | {swarm.frames} | {share(swarm.right, swarm.frames)} | {paper[0]} "
            f"| {swarm.passed_wrong} | {share(whole.right, whole.frames)} | {paper[1]} | {whole.wrong} |"
        )
        content[condition.name] = {"swarm": asdict(swarm), "whole": asdict(whole)}
    return content, lines
