"""The main job in one go: a simulated docking, the run, its evaluation and the pictures."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np
from typing_extensions import Self

from lumidock.camera import Camera
from lumidock.datatypes import Fix, Frame, Image
from lumidock.picture import developed
from lumidock.station import Station
from lumidock.streams.overlay import around_lights, draw, whole
from lumidock.streams.sources import Item

_WIDTH = 1224
_PICTURE_OF_STAGE = {"search": 1, "front": 50, "transition": 60, "rear": 20}  # which fix of a stage the sheet shows


@dataclass(slots=True)
class Album:
    """Turns every fix into an annotated video frame and keeps one picture of each stage; a context manager."""

    station: Station
    camera: Camera
    video: Path
    fps: float
    fixes: list[Fix] = field(default_factory=list)
    by_stage: dict[str, Image] = field(default_factory=dict)
    _writer: cv2.VideoWriter | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._writer is not None:
            self._writer.release()

    def add(self, item: Item, fix: Fix) -> None:
        """Draw one fix."""
        self.fixes.append(fix)
        if not isinstance(item, Frame):
            return
        image = developed(item)
        picture = draw(image, fix, self.station, self.camera, whole(image, _WIDTH))
        if self._writer is None:
            codec = cv2.VideoWriter.fourcc(*"mp4v")
            self._writer = cv2.VideoWriter(str(self.video), codec, self.fps, (picture.shape[1], picture.shape[0]))
        self._writer.write(picture)
        usable = [one.stage for one in self.fixes if _is_usable(one)]
        if not _is_usable(fix) or usable.count(fix.stage) > _PICTURE_OF_STAGE[fix.stage]:
            return
        near = around_lights(image, fix, _WIDTH)
        slot = "search" if len(usable) == 1 else fix.stage  # the very first one ends the search
        self.by_stage[slot] = draw(image, fix, self.station, self.camera, near)

    def sheet(self) -> list[Image]:
        """One picture per stage, in the order of the approach; an even number of them."""
        pictures = [self.by_stage[stage] for stage in _PICTURE_OF_STAGE if stage in self.by_stage]
        return pictures[len(pictures) % 2 :]


def _is_usable(fix: Fix) -> bool:
    """Whether a vehicle may do something with it."""
    return fix.valid or fix.guide is not None


def summary_lines(result: dict[str, Any], counts: dict[str, Any]) -> list[str]:
    """Five lines about a run against its truth."""
    error, labels = result["error"], result.get("labels", {})
    hazards = result["hazardous"]
    gap = result["longest_gap_s"]
    latency = counts["latency_us"].get("p50", np.nan) / 1000.0
    return [
        f"fixes       {result['valid']} of {result['frames']} frames, longest gap {gap:.2f} s"
        if gap
        else "fixes       none",
        f"guidance    {result.get('guide', 0)} of {result['frames']} frames (bearing and range)",
        f"hazardous   {hazards['valid']['any']} poses, {hazards['guide']['any']} guides over their alert limit",
        f"error       median {error['lateral_m']['median']:.3f} m lateral, {error['axial_m']['median']:.3f} m axial, "
        f"{error['angle_deg']['median']:.2f} deg; wrong names {labels.get('wrong', 0)} of {labels.get('named', 0)}"
        if error
        else "error       none",
        f"time        {latency:.0f} ms a frame (median, decoding excluded)",
    ]
