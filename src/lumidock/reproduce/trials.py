"""The paper's section 4.1 at point level: lights missing and spurious detections, by everyone who takes part.

A frame counts when all seven front lights are in view. It is right when every true detection carries the identity of
its own light and no spurious one carries any; it is wrong when any detection carries an identity that is not its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from lumidock.camera import Camera
from lumidock.config import Config, PaperConfig, PsoConfig
from lumidock.datatypes import Fix
from lumidock.methods import Method, localizer_of
from lumidock.paper.layer import LayerLocalizer
from lumidock.reproduce.plan import resolved
from lumidock.sim.detections import SimulatedFrame, simulated_frames
from lumidock.sim.scenario import Scenario, load_scenario
from lumidock.station import Station

CLEAN_FRAMES = 4  # before the faults begin, in the rows after a clean start
START_M = {"30 m": 1e9, "18.6 m": 18.64}  # where a trial begins; section 3.2.1 puts the paper's own start at 18.64 m
_PRINTED = PaperConfig(preset="as_printed").pso
_WIDE = PsoConfig()
# the swarm alone, without filter and without history
SWARMS = {
    "20 x 40, printed bounds": _PRINTED,
    "20 x 40, wide bounds": _PRINTED.model_copy(update={"scale": _WIDE.scale, "shift": _WIDE.shift}),
    "80 x 120, printed bounds": _WIDE.model_copy(update={"scale": _PRINTED.scale, "shift": _PRINTED.shift}),
    "80 x 120, wide bounds": _WIDE,
}
HISTORY = ", with history"  # eqs. (7) and (8) in use
ACQUISITION = " without history"


@dataclass(frozen=True, slots=True)
class Condition:
    """A row of Table 1: so many front lights missing and spurious detections, from the start or after clean frames."""

    missing: int
    spurious: int
    clean_start: bool = False
    layout: str = "as given"

    @property
    def name(self) -> str:
        """As it stands in tables."""
        parts = [f"{self.missing} missing"] * bool(self.missing) + [f"{self.spurious} spurious"] * bool(self.spurious)
        return " + ".join(parts) + ", after a clean start" * self.clean_start


@dataclass(slots=True)
class Count:
    """Frames, and in how many of them one participant was right or wrong; the others have no answer or a partial one.

    `passed_wrong`: wrong associations of a swarm that the ratio filter lets pass.
    """

    frames: int = 0
    right: int = 0
    wrong: int = 0
    passed_wrong: int = 0

    def __add__(self, other: Count) -> Count:
        return Count(*(a + b for a, b in zip(asdict(self).values(), asdict(other).values(), strict=True)))


Counts = dict[str, dict[str, Count]]  # by start and participant
Answer = Callable[[SimulatedFrame], tuple[bool, bool, bool]]  # right, wrong, passed the filter though wrong


def merged(parts: Iterable[Counts]) -> Counts:
    """All counts added up."""
    total: Counts = {}
    for part in parts:
        for start, by_name in part.items():
            into = total.setdefault(start, {})
            for name, count in by_name.items():
                into[name] = into.get(name, Count()) + count
    return total


def trials_scenario(missing: int, spurious: int) -> Scenario:
    """PageSection 4.1 with the rear layer out of sight."""
    settings = (f"faults.missing={missing}", f"faults.spurious={spurious}", "detections.rear_range_m=0.01")
    return load_scenario("trials", settings)


class Participants:
    """Everyone who answers in a trial, each with a memory of its own."""

    def __init__(self, names: Sequence[str], station: Station, camera: Camera, config: Config) -> None:
        """`names` are of `SWARMS`, with or without `HISTORY`, or of methods, with or without `ACQUISITION`."""
        self.front = station.lights_of(station.layers_front_to_rear()[0])
        self._localizers: list[Method] = []
        self.answers: dict[str, Answer] = {}
        layer = station.layers_front_to_rear()[0]
        for name in names:
            if (plain := name.removesuffix(HISTORY)) in SWARMS:
                paper = config.paper.model_copy(update={"pso": SWARMS[plain]})
                swarm = LayerLocalizer(station, layer, camera, paper)
                self.answers[name] = _swarm_answer(swarm, remembers=name.endswith(HISTORY))
                continue
            method, settings = resolved(name.removesuffix(ACQUISITION), config)
            localizer = localizer_of(method, station, camera, settings, cold=name.endswith(ACQUISITION))
            self._localizers.append(localizer)
            self.answers[name] = _method_answer(localizer)

    def see(self, frame: SimulatedFrame) -> None:
        """Show a frame that is not counted to all that have a memory."""
        for localizer in self._localizers:
            localizer.process_detections(frame.detections)


def _swarm_answer(swarm: LayerLocalizer, *, remembers: bool) -> Answer:
    def answer(frame: SimulatedFrame) -> tuple[bool, bool, bool]:
        found = swarm.register(frame.detections.uv)
        if found is None:
            return False, False, False
        passes = swarm.passes(frame.detections.uv, found.light)
        swarm.registration = found if remembers and passes else None
        wrong = bool((found.light != frame.light)[found.light >= 0].any())
        return np.array_equal(found.light, frame.light), wrong, passes and wrong

    return answer


def _method_answer(localizer: Method) -> Answer:
    def answer(frame: SimulatedFrame) -> tuple[bool, bool, bool]:
        right, wrong = verdict(localizer.process_detections(frame.detections), frame)
        return right, wrong, False

    return answer


def verdict(fix: Fix, frame: SimulatedFrame) -> tuple[bool, bool]:
    """Whether all identities of an answer are right, and whether one of them is wrong; neither without an answer."""
    if fix.match is None or fix.status == "none":
        return False, False
    identified = fix.match.light >= 0
    return np.array_equal(fix.match.light, frame.light), bool((fix.match.light != frame.light)[identified].any())


def trial(station: Station, camera: Camera, condition: Condition, seed: int, participants: Participants) -> Counts:
    """One run toward the dock. With a clean start the faults begin after a few frames, which are not counted."""
    counts: Counts = {start: {name: Count() for name in participants.answers} for start in START_M}
    clean = simulated_frames(trials_scenario(0, 0), station, camera, seed)
    faulty = simulated_frames(trials_scenario(condition.missing, condition.spurious), station, camera, seed)
    in_view = [pair for pair in zip(clean, faulty, strict=True) if pair[1].in_view[participants.front].all()]
    first = CLEAN_FRAMES if condition.clean_start else 0
    for before, _ in in_view[:first]:
        participants.see(before)
    for _, frame in in_view[first:]:
        for name, answer in participants.answers.items():
            right, wrong, passed = answer(frame)
            for start, from_m in START_M.items():
                if frame.T_dock_cam[2, 3] <= from_m:
                    counts[start][name] += Count(1, right, wrong, passed)
    return counts
