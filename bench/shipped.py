"""The shipped station and camera."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from lumidock.camera import Camera, load_camera
from lumidock.station import Station, load_station

PACKAGE = Path(str(files("lumidock")))
STATION_FILE = PACKAGE / "stations" / "cage-2x2x5.yaml"
CAMERA_FILE = PACKAGE / "cameras" / "imx264-60deg.yaml"


def shipped_station() -> Station:
    """The cage of the paper."""
    return load_station(STATION_FILE)


def shipped_camera() -> Camera:
    """The paper's camera."""
    return load_camera(CAMERA_FILE)
