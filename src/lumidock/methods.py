"""The methods by their names, and the two doors that each of them has."""

from __future__ import annotations

from typing import Protocol

from lumidock.camera import Camera
from lumidock.config import Config
from lumidock.datatypes import Detections, Fix, Frame
from lumidock.errors import InputError
from lumidock.localizer import Localizer
from lumidock.paper import PaperLocalizer
from lumidock.station import Station

METHODS = ("lumidock", "paper")


class Method(Protocol):
    """What every method offers: an image door and a light door."""

    def process(self, frame: Frame) -> Fix:
        """Fix of one picture. Raises: FrameError for one that does not fit the calibration."""
        ...

    def process_detections(self, detections: Detections) -> Fix:
        """Fix of one frame's detections."""
        ...

    def forget(self) -> None:
        """Begin anew, without history."""
        ...


def require_method(name: str) -> None:
    """Raises: InputError for a method that there is not."""
    if name not in METHODS:
        raise InputError(f"--method {name}: no such method; there are {' and '.join(METHODS)}")


def localizer_of(method: str, station: Station, camera: Camera, config: Config, *, cold: bool = False) -> Method:
    """A localizer by the name of its method; a `cold` one forgets all history before each frame.

    Raises: InputError for a method that there is not, or a station that it cannot tell apart.
    """
    require_method(method)
    if method == "paper":
        return PaperLocalizer(station, camera, config.paper, cold=cold)
    return Localizer(station, camera, config, cold=cold)
