"""The demo: a simulated docking, the run, its evaluation, and pictures of it."""

from __future__ import annotations

import importlib.util
from collections import Counter
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from typing_extensions import Self

from lumidock.camera import Camera
from lumidock.datatypes import Fix, Frame, Image, Stage
from lumidock.evaluation.claims import nees_in_words
from lumidock.evaluation.run_description import over_limit_in_words
from lumidock.picture import developed
from lumidock.station import Station
from lumidock.streams.overlay import around_lights, draw, whole
from lumidock.streams.sinks import ImageSink, open_video
from lumidock.streams.source import Item

SCENARIO = "approach"
# the dock and the lens differ from their files as the files say they may; without it the stated errors look too wide
SETTINGS = ("detections.survey=true", "detections.calibration=true")
EXTRA_GIVES = {
    "report": ("matplotlib", "report.html and trajectory.png"),
    "video": ("av", "annotated.mp4, a video of the docking (H.264)"),
}
_WIDTH = 1224
# the picture of each stage on the sheet is that of the stage's usable fix of this number, or of its last
_FIX_SHOWN: dict[Stage, int] = {"search": 1, "front": 50, "transition": 60, "rear": 20}


def missing_extras() -> dict[str, str]:
    """Extras that are not installed, with what the demo would write with them."""
    return {name: gives for name, (module, gives) in EXTRA_GIVES.items() if importlib.util.find_spec(module) is None}


@dataclass(slots=True)
class Album:
    """Annotates every frame for a video and keeps one picture of each stage; a context manager.

    Without the extra `video` there is no video; the pictures are kept all the same.
    """

    station: Station
    camera: Camera
    video: Path
    fixes: list[Fix] = field(default_factory=list)
    by_stage: dict[Stage, Image] = field(default_factory=dict)
    _usable: Counter[str] = field(default_factory=Counter)
    _writer: ImageSink | None = None

    def __enter__(self) -> Self:
        if "video" not in missing_extras():
            self._writer = open_video(self.video)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._writer is not None:
            with closing(self._writer):
                pass

    def add(self, item: Item, fix: Fix) -> None:
        """Draw one fix."""
        self.fixes.append(fix)
        if not isinstance(item, Frame):
            return
        image = developed(item)
        if self._writer is not None:
            picture = draw(image, fix, self.station, self.camera, whole(image, _WIDTH))
            self._writer.add(picture, item.t_ns)
        if not fix.valid and fix.guide is None:
            return
        self._usable[fix.stage] += 1
        slot: Stage = "search" if self._usable.total() == 1 else fix.stage  # the very first fix ends the search
        if self._usable[fix.stage] <= _FIX_SHOWN[slot]:
            near = around_lights(image, fix, _WIDTH)
            self.by_stage[slot] = draw(image, fix, self.station, self.camera, near, brighten=True)

    def sheet(self) -> list[Image]:
        """One picture per stage, in the order of the approach; an even number of them."""
        pictures = [self.by_stage[stage] for stage in _FIX_SHOWN if stage in self.by_stage]
        return pictures[len(pictures) % 2 :]


def summary_lines(result: dict[str, Any], counts: dict[str, Any]) -> list[str]:
    """A line for each topic about a run against its truth."""
    frames, hazards, gap = result["frames"], result["hazardous"], result["longest_gap_s"]
    wrong = result.get("identities", {"wrong": 0, "identified": 0})
    latency = counts["latency_us"].get("p50", np.nan) / 1000.0
    lines = [
        f"valid       {result['valid']} of {frames} frames have a full pose"
        + (f", longest gap {gap:.2f} s" * bool(gap)),
        f"guide       {result.get('guide', 0)} of {frames} frames have bearing and range",
        *(f"protection  {line}" for line in over_limit_in_words({"counts": counts})),
        f"hazardous   {hazards['valid']['any']} poses and {hazards['guide']['any']} guides are off by more than their "
        "alert limit",
    ]
    if error := result["error"]:
        lines += [
            f"error       median {error['lateral_m']['median']:.3f} m lateral, "
            f"{error['axial_m']['median']:.3f} m axial, {error['angle_deg']['median']:.2f} deg",
            f"identities  {wrong['wrong']} of {wrong['identified']} identified detections are another light",
        ]
    if result["nees"]["frames"]:
        mean = result["nees"]["mean"]
        lines.append("\n            ".join([f"NEES        {mean:.1f}", *nees_in_words(mean)]))
    return [*lines, f"time        {latency:.0f} ms a frame (median, without decoding)"]
