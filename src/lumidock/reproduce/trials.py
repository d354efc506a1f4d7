"""The paper's section 4.1 at point level: names with lights missing and spurious, by both methods.

A frame counts when all seven front lights are in view; it is right when every true detection carries its own name and
no spurious one carries any.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from lumidock.camera import Camera
from lumidock.config import PaperConfig
from lumidock.datatypes import Fix
from lumidock.localizer import Localizer
from lumidock.paper import PaperLocalizer
from lumidock.paper.consistency import consistent
from lumidock.paper.layer import LayerLocalizer
from lumidock.sim.detections import SimulatedFrame, simulated_frames
from lumidock.sim.scenario import Scenario, load_scenario
from lumidock.station import Station

CLEAN_FRAMES = 4  # before the faults begin, in the rows with history


@dataclass(slots=True)
class Counts:
    """Frames, and in how many of them who was right.

    The paper's method: right by the swarm alone, let pass wrongly by the filter, and right and wrong in the end. Ours:
    right and wrong (some name that is not so) without history, and with it.
    """

    frames: int = 0
    swarm_right: int = 0
    filter_passes_wrong: int = 0
    right: int = 0
    wrong: int = 0
    ours_cold_right: int = 0
    ours_cold_wrong: int = 0
    ours_right: int = 0
    ours_wrong: int = 0

    def __add__(self, other: Counts) -> Counts:
        return Counts(*(a + b for a, b in zip(asdict(self).values(), asdict(other).values(), strict=True)))


@dataclass(slots=True)
class _Methods:
    """Who takes part in a trial."""

    swarm: LayerLocalizer
    paper: PaperLocalizer
    cold: Localizer
    ours: Localizer


def trials_scenario(missing: int, spurious: int) -> Scenario:
    """Section 4.1 with the rear layer out of sight."""
    settings = (f"faults.missing={missing}", f"faults.spurious={spurious}", "detections.rear_range_m=0.01")
    return load_scenario("trials", settings)


def trial(
    station: Station, camera: Camera, missing: int, spurious: int, seed: int, *, clean_start: bool = False
) -> Counts:
    """One run toward the dock: the swarm alone and our method without history, and both methods with it.

    With `clean_start` the faults begin after a few frames without, which are not counted.
    """
    front = station.lights_of(station.layers_front_to_rear()[0])
    layer = station.layers_front_to_rear()[0]
    methods = _Methods(
        LayerLocalizer(station, layer, camera, PaperConfig()),
        PaperLocalizer(station, camera),
        Localizer(station, camera, cold=True),
        Localizer(station, camera),
    )
    counts = Counts()
    clean = simulated_frames(trials_scenario(0, 0), station, camera, seed)
    faulty = simulated_frames(trials_scenario(missing, spurious), station, camera, seed)
    in_view = [pair for pair in zip(clean, faulty, strict=True) if pair[1].in_view[front].all()]
    warming = CLEAN_FRAMES if clean_start else 0
    for before, _ in in_view[:warming]:
        methods.paper.process_detections(before.detections)
        methods.ours.process_detections(before.detections)
    for _, frame in in_view[warming:]:
        _count(counts, frame, methods)
    return counts


def _count(counts: Counts, frame: SimulatedFrame, methods: _Methods) -> None:
    counts.frames += 1
    _count_swarm(counts, frame, methods.swarm)
    right, wrong = verdict(methods.paper.process_detections(frame.detections), frame)
    counts.right, counts.wrong = counts.right + right, counts.wrong + wrong
    right, wrong = verdict(methods.cold.process_detections(frame.detections), frame)
    counts.ours_cold_right, counts.ours_cold_wrong = counts.ours_cold_right + right, counts.ours_cold_wrong + wrong
    right, wrong = verdict(methods.ours.process_detections(frame.detections), frame)
    counts.ours_right, counts.ours_wrong = counts.ours_right + right, counts.ours_wrong + wrong


def _count_swarm(counts: Counts, frame: SimulatedFrame, swarm: LayerLocalizer) -> None:
    registration = swarm.register(frame.detections.uv)
    assert registration is not None
    right = np.array_equal(registration.light, frame.light)
    named = registration.light >= 0
    xy = swarm.plane(frame.detections.uv)[named]
    passes = consistent(swarm.p_dock[registration.light[named], :2], xy, swarm.config.consistency)
    counts.swarm_right += right
    counts.filter_passes_wrong += passes and not right


def verdict(fix: Fix, frame: SimulatedFrame) -> tuple[bool, bool]:
    """Whether all names of an answer are right, and whether one of them is wrong; neither without an answer."""
    if fix.match is None or fix.status == "none":
        return False, False
    named = fix.match.light >= 0
    return np.array_equal(fix.match.light, frame.light), bool((fix.match.light != frame.light)[named].any())
