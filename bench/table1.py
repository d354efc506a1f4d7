"""The paper's Table 1 at point level: matching success with missing and with spurious lights, section 4.1 conditions.

A frame counts when all seven front lights are in view; it is right when every true detection carries its own name and
no spurious one carries any.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from multiprocessing import get_context

import numpy as np

from bench.shipped import shipped_camera, shipped_station
from lumidock.config import PaperConfig
from lumidock.paper import PaperLocalizer
from lumidock.paper.consistency import consistent
from lumidock.paper.layer import LayerLocalizer
from lumidock.sim.scenario import Scenario, load_scenario
from lumidock.sim.spots import SpotFrame, spot_frames

TRIALS = 30
FIRST_SEED = 20_000
PAPER = {
    (3, 0): (90.3, 100.0),
    (2, 0): (98.6, 100.0),
    (1, 0): (100.0, 100.0),
    (0, 1): (99.6, 100.0),
    (0, 2): (99.6, 99.9),
}
CONDITIONS = (*PAPER, (1, 1))
CLEAN_FRAMES = 4  # before the faults begin, in the rows with history


@dataclass(slots=True)
class Counts:
    """Frames; those right by the swarm alone, let pass wrongly by the filter, and right and wrong in the end."""

    frames: int = 0
    swarm_right: int = 0
    filter_passes_wrong: int = 0
    right: int = 0
    wrong: int = 0

    def __add__(self, other: Counts) -> Counts:
        return Counts(*(a + b for a, b in zip(asdict(self).values(), asdict(other).values(), strict=True)))


def trials_scenario(missing: int, spurious: int) -> Scenario:
    """Section 4.1 with the rear layer out of sight."""
    settings = (f"faults.missing={missing}", f"faults.spurious={spurious}", "spots.rear_range_m=0.01")
    return load_scenario("trials", settings)


def trial(missing: int, spurious: int, seed: int, *, clean_start: bool = False) -> Counts:
    """One run toward the dock: the swarm alone without history, and the whole method with it.

    With `clean_start` the faults begin after a few frames without, which are not counted.
    """
    station, camera = shipped_station(), shipped_camera()
    front = station.lights_of("front")
    alone, whole = LayerLocalizer(station, "front", camera, PaperConfig()), PaperLocalizer(station, camera)
    counts = Counts()
    clean = spot_frames(trials_scenario(0, 0), station, camera, seed)
    faulty = spot_frames(trials_scenario(missing, spurious), station, camera, seed)
    in_view = [pair for pair in zip(clean, faulty, strict=True) if pair[1].in_view[front].all()]
    warming = CLEAN_FRAMES if clean_start else 0
    for before, _ in in_view[:warming]:
        whole.process_detections(before.detections)
    for _, frame in in_view[warming:]:
        _count(counts, frame, alone, whole)
    return counts


def _count(counts: Counts, frame: SpotFrame, alone: LayerLocalizer, whole: PaperLocalizer) -> None:
    registration = alone.register(frame.detections.uv)
    assert registration is not None
    swarm_right = np.array_equal(registration.light, frame.light)
    named = registration.light >= 0
    xy = alone.plane(frame.detections.uv)[named]
    passes = consistent(alone.p_dock[registration.light[named], :2], xy, alone.config.consistency)
    fix = whole.process_detections(frame.detections)
    counts.frames += 1
    counts.swarm_right += swarm_right
    counts.filter_passes_wrong += passes and not swarm_right
    if fix.match is not None and fix.valid:
        right = np.array_equal(fix.match.light, frame.light)
        counts.right += right
        counts.wrong += not right


def condition(
    missing: int, spurious: int, trials: int = TRIALS, first_seed: int = FIRST_SEED, *, clean_start: bool = False
) -> Counts:
    """All trials of one condition, on all cores."""
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        job = partial(trial, missing, spurious, clean_start=clean_start)
        return sum(pool.map(job, range(first_seed, first_seed + trials)), Counts())


def main() -> tuple[dict[str, object], list[str]]:
    """The table, with the paper's own figures."""
    lines = [
        "| front lights missing + spurious | frames | PSO, % | paper | wrong ones the filter passes "
        "| PSO + filter + BTEKF, % | paper | wrong names accepted |",
        "|---|---|---|---|---|---|---|---|",
    ]
    content: dict[str, object] = {}
    rows = [(*condition_, False) for condition_ in CONDITIONS] + [(1, 1, True), (3, 2, True)]
    for missing, spurious, clean_start in rows:
        counts = condition(missing, spurious, clean_start=clean_start)
        paper = ("-", "-") if clean_start else PAPER.get((missing, spurious), ("-", "-"))
        swarm, whole = (100.0 * n / counts.frames for n in (counts.swarm_right, counts.right))
        name = f"{missing} + {spurious}{', after a clean start' * clean_start}"
        lines.append(
            f"| {name} | {counts.frames} | {swarm:.2f} | {paper[0]} | {counts.filter_passes_wrong} "
            f"| {whole:.2f} | {paper[1]} | {counts.wrong} |"
        )
        content[f"{missing}+{spurious}{'-warm' * clean_start}"] = asdict(counts)
    return content, lines
