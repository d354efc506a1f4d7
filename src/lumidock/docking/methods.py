"""The methods that can guide a docking: all that there are by name, and two variants of the default one.

`aided` is given the vehicle's gyro and DVL; `raw` follows the poses whether or not they are proven.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lumidock.camera import Camera
from lumidock.config import Config
from lumidock.datatypes import Detections, Fix, Frame
from lumidock.geometry import se3_inverse
from lumidock.localizer import Localizer
from lumidock.methods import Method, localizer_of, require_method
from lumidock.station import Station

RAW, AIDED = "raw", "aided"


def require_docking_method(name: str) -> None:
    """Raises: InputError for a method that there is not."""
    if name not in (RAW, AIDED):
        require_method(name)


def docking_method(name: str, station: Station, camera: Camera, config: Config) -> Method:
    """A method by its name. Raises: InputError for one that there is not."""
    if name == RAW:
        return RawPoses(station, camera, config)
    return localizer_of("lumidock" if name == AIDED else name, station, camera, config)


class RawPoses:
    """The likeliest pose of the default method in every frame, whether or not it is proven or protected.

    It shows what a vehicle would follow without `valid`: the comparison that protection levels have to win.
    """

    def __init__(self, station: Station, camera: Camera, config: Config) -> None:
        self._localizer = Localizer(station, camera, config)

    def process(self, frame: Frame) -> Fix:
        """Fix of one frame."""
        return self._unproven(self._localizer.process(frame))

    def process_detections(self, detections: Detections) -> Fix:
        """Fix of one frame's detections."""
        return self._unproven(self._localizer.process_detections(detections))

    def forget(self) -> None:
        """Begin anew, without history."""
        self._localizer.forget()

    def _unproven(self, fix: Fix) -> Fix:
        tracks = self._localizer.state.hypotheses
        if not tracks:
            return replace(fix, guide=None)
        T_cam_dock = np.eye(4)
        T_cam_dock[:3, :3], T_cam_dock[:3, 3] = tracks[0].state.R, tracks[0].state.t
        return replace(fix, T_dock_cam=se3_inverse(T_cam_dock), reason="", covariance=None, protection=None, guide=None)
