"""Where fixes go besides the run folder: a sink is opened by the name of its file or address."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from lumidock.camera import Camera
from lumidock.datatypes import Detections, Fix, Frame, Image, Unusable
from lumidock.errors import InputError, extra
from lumidock.go_no_go import Watch
from lumidock.picture import developed
from lumidock.station import Station
from lumidock.streams.overlay import draw, whole
from lumidock.streams.vehicle import Vehicle

if TYPE_CHECKING:
    from lumidock.streams.ros2 import Publication

FILE_KINDS = (".mcap", ".rrd", ".mp4")
_WIDTH = 1224  # of an annotated video, px


class Sink(Protocol):
    """Takes one frame and its fix after the other."""

    def add(self, item: Frame | Detections | Unusable, fix: Fix, latency_us: int | None) -> None:
        """Take one frame. Raises: OSError when it cannot."""
        ...

    def close(self) -> None:
        """Write what is left."""
        ...


@dataclass(frozen=True, slots=True)
class Setting:
    """What every sink needs beside the fixes: the dock, the camera and how it is mounted on the vehicle.

    `watch`: where go or no-go is to be said, what it says it by.
    """

    station: Station
    camera: Camera
    vehicle: Vehicle | None = None
    watch: Watch | None = None

    def publication(self) -> Publication:
        """The fixes as ROS 2 messages. Raises: InputError where the extra `bag` is not installed."""
        with extra("bag"):
            from lumidock.streams.ros2 import Publication
        return Publication(self.camera, self.vehicle, self.station.ids, self.watch)


def open_file_sink(path: Path, setting: Setting) -> Sink:
    """A sink that writes `path`, whose ending says what it becomes. Raises: InputError for another ending."""
    if path.suffix == ".mcap":
        with extra("bag"):
            from lumidock.streams.mcapfile import McapFile
        return McapFile(path, setting.publication())
    if path.suffix == ".rrd":
        return open_rerun(str(path), setting)
    if path.suffix == ".mp4":
        return _AnnotatedVideo(open_video(path), setting)
    raise InputError(f"{path}: not one of {', '.join(FILE_KINDS)}")


def open_rerun(target: str, setting: Setting) -> Sink:
    """A Rerun file, or the viewer at rerun+http://HOST:PORT/proxy."""
    with extra("rerun"):
        from lumidock.streams.rerunlog import RerunLog
    return RerunLog(target, setting.station, setting.camera)


class Numbered:
    """Opens FILE, and after a failure FILE-1, FILE-2, ..., so that what was written stays."""

    def __init__(self, path: Path, setting: Setting) -> None:
        self._path, self._setting, self._number, self._opened = path, setting, 0, False

    def open(self) -> Sink:
        """A sink of the first file that was not written to before."""
        current = self._current()
        self._number += self._opened and current.exists() and current.stat().st_size > 0
        self._opened = True
        return open_file_sink(self._current(), self._setting)

    def _current(self) -> Path:
        return self._path.with_stem(f"{self._path.stem}-{self._number}") if self._number else self._path


class ImageSink(Protocol):
    """Takes one image after the other, as a video file does."""

    def add(self, picture: Image, t_ns: int) -> None:
        """Append an image (H, W, 3) bgr8 of time `t_ns`."""
        ...

    def close(self) -> None:
        """Write what is left."""
        ...


def open_video(path: Path) -> ImageSink:
    """An H.264 video that browsers play. Raises: InputError when PyAV is not installed (extra `video`)."""
    with extra("video"):
        from lumidock.streams.mp4 import Mp4
    return Mp4(path)


@dataclass(frozen=True, slots=True)
class _AnnotatedVideo:
    video: ImageSink
    setting: Setting

    def add(self, item: Frame | Detections | Unusable, fix: Fix, latency_us: int | None) -> None:
        """Draw one fix; frames without a picture leave the last one standing."""
        del latency_us
        if isinstance(item, Frame):
            image = developed(item)
            crop = whole(image, min(_WIDTH, image.shape[1]))
            picture = draw(image, fix, self.setting.station, self.setting.camera, crop)
            self.video.add(picture, item.t_ns)

    def close(self) -> None:
        self.video.close()
