"""What a source of frames is, and how it is to be read; the readers of each format make one."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from lumidock.camera import Camera
from lumidock.datatypes import AidingMeasurement, Detections, Frame, Unusable

Item = Frame | Detections | Unusable
Size = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Reading:
    """How a source is read.

    `fps` is for sources without stamps; `topic` and `info_topic` choose pictures and calibration of a bag; pixels of 16
    bits have `bits` that count; `gray` says that colour is not needed; `as_stored` leaves a picture unturned that EXIF
    or a video's header says to turn; `trusted` accepts a calibration that looks impossible; `follow_calibration` ends a
    bag where its calibration changes, which is of no interest where the calibration comes from a file.
    """

    fps: float | None = None
    topic: str | None = None
    info_topic: str | None = None
    bits: int = 16
    gray: bool = False
    as_stored: bool = False
    trusted: bool = False
    follow_calibration: bool = True


@dataclass(frozen=True, slots=True)
class Source:
    """An opened source: `items()` iterates over its frames from the start; `count` is how many, if known.

    `camera` and `station` are files found beside the frames, `calibration` the camera that a recording describes (of
    `rectified` pictures, perhaps) and `no_calibration` why it has none to offer; `inputs` are the files whose hashes
    identify the source, `notes` what a person should know of how it is read, a line each. A `live` one has no end, and
    is opened again when it is lost. `sensors` gives the values of the vehicle's own sensors as they come.
    `read` is given the size (width, height) that pictures must have, or None, and reads none that has another.
    """

    path: Path
    kind: str
    read: Callable[[Size | None], Iterator[Item]]
    count: int | None = None
    camera: Path | None = None
    station: Path | None = None
    inputs: tuple[Path, ...] = ()
    calibration: Camera | None = None
    no_calibration: str = ""
    rectified: bool = False
    live: bool = False
    notes: tuple[str, ...] = field(default=())
    sensors: Callable[[], Iterable[AidingMeasurement]] = tuple

    def items(self, size: Size | None = None) -> Iterator[Item]:
        """All frames from the first; one that is not of `size` (width, height) is a bad frame, its pixels unread."""
        return self.read(size)


def delayed(source: Source, delay_ms: float) -> Source:
    """The same source with every stamp earlier by `delay_ms`: what passes between exposure and stamping."""
    delay_ns = round(delay_ms * 1e6)
    if not delay_ns:
        return source

    def read(size: Size | None) -> Iterator[Item]:
        for item in source.read(size):
            yield item if item.t_ns is None else replace(item, t_ns=item.t_ns - delay_ns)

    return replace(source, read=read)


def in_natural_order(file: Path) -> list[str | int]:
    """Sorting key that puts picture 2 before picture 10."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", file.name)]
