"""Serialized messages in, serialized messages out: all that the node does, without ROS."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from lumidock import Config, load_camera, load_config, load_station
from lumidock.app.run import process
from lumidock.camera import Camera
from lumidock.datatypes import Frame, Stage, Unusable
from lumidock.errors import FrameError, InputError
from lumidock.methods import Method, localizer_of, require_method
from lumidock.station import Station
from lumidock.streams.camera_info import camera_of, is_rectified
from lumidock.streams.ros import CAMERA_INFO, Message, content_of, info_of, picture_of
from lumidock.streams.ros2 import Publication
from lumidock.streams.rostypes import TYPES, Serialized
from lumidock.streams.source import Reading
from lumidock.streams.vehicle import Vehicle, load_vehicle

# what a display needs, and the driver publishes already
SHOWN = ("/lumidock/camera_info", "/lumidock/image/compressed", "/lumidock/annotations")


@dataclass(frozen=True)
class Options:
    """The node's parameters; an empty text is one that was not given."""

    station: str
    camera: str = ""
    vehicle: str = ""
    method: str = "lumidock"
    config: str = ""
    bits: int = 16
    pictures: bool = False


@dataclass
class Bridge:
    """Localizes one picture after the other; until the camera is known it says what it waits for."""

    station: Station
    vehicle: Vehicle | None
    options: Options
    config: Config
    image_topic: str
    camera: Camera | None = None
    localizer: Method | None = field(default=None, init=False)
    publication: Publication | None = field(default=None, init=False)
    stage: Stage = field(default="search", init=False)
    number: int = field(default=0, init=False)

    @classmethod
    def of(cls, options: Options, image_topic: str) -> Bridge:
        """Read the files that the parameters name. Raises: InputError, one line, for one that cannot be used."""
        require_method(options.method)
        if not options.station:
            raise InputError("parameter station: give the dock's station file")
        bridge = cls(
            load_station(Path(options.station)),
            load_vehicle(Path(options.vehicle)) if options.vehicle else None,
            options,
            load_config(Path(options.config)) if options.config else Config(),
            image_topic,
        )
        if options.camera:
            bridge._use(load_camera(Path(options.camera)))
        return bridge

    def topics(self) -> dict[str, str]:
        """The topics that are published, and their types."""
        return {topic: kind for topic, kind in TYPES.items() if self.options.pictures or topic not in SHOWN}

    def info(self, data: bytes) -> tuple[str, ...]:
        """Take the calibration of the first calibrated CameraInfo; what a person should know of it.

        Raises: InputError, one line, for one that cannot be used.
        """
        if self.camera is not None:
            return ()
        message = Message("camera_info", CAMERA_INFO, "cdr", 0, data)
        camera, notes = camera_of(info_of(message), rectified=is_rectified(self.image_topic))
        self._use(camera)
        return notes

    def image(self, kind: str, data: bytes, arrival_ns: int) -> Iterator[Serialized]:
        """The messages about one picture; none while there is no calibration."""
        camera, localizer, publication = self.camera, self.localizer, self.publication
        if camera is None or localizer is None or publication is None:
            return
        item = self._item(Message(self.image_topic, kind, "cdr", arrival_ns, data), camera)
        fix, latency_us, _ = process(localizer, item, self.stage)
        self.stage = fix.stage
        yield from publication.messages(item, fix, latency_us, picture=self.options.pictures)

    def _use(self, camera: Camera) -> None:
        self.camera = camera
        self.localizer = localizer_of(self.options.method, self.station, camera, self.config)
        self.publication = Publication(camera, self.vehicle, self.station.ids)

    def _item(self, message: Message, camera: Camera) -> Frame | Unusable:
        name, self.number = f"{self.number:06d}", self.number + 1
        try:
            content = content_of(message)
            reading, size = Reading(bits=self.options.bits), (camera.width, camera.height)
            image, encoding = picture_of(content, message.topic, reading, size)
            return Frame(name, content.stamp_ns or message.log_ns, image, encoding=encoding)
        except FrameError as error:
            return Unusable(name, message.log_ns, error.reason, str(error))
