"""lumidock: the pose of an underwater vehicle relative to its dock, from one camera and the dock's guiding lights.

Each name is loaded when it is first asked for: a vehicle does not wait for what it does not use.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lumidock.camera import Camera, load_camera
    from lumidock.config import Config, PaperConfig, load_config
    from lumidock.datatypes import (
        AidingMeasurement,
        Attitude,
        Detections,
        Fix,
        Frame,
        Guide,
        LayerPose,
        Match,
        Protection,
        SensorUse,
        Velocity,
    )
    from lumidock.errors import DataError, FrameError, InputError, LumidockError
    from lumidock.localizer import Localizer
    from lumidock.paper import PaperLocalizer
    from lumidock.pose import PoseSolution, solve_pose
    from lumidock.station import Station, load_station

__all__ = [
    "AidingMeasurement",
    "Attitude",
    "Camera",
    "Config",
    "DataError",
    "Detections",
    "Fix",
    "Frame",
    "FrameError",
    "Guide",
    "InputError",
    "LayerPose",
    "Localizer",
    "LumidockError",
    "Match",
    "PaperConfig",
    "PaperLocalizer",
    "PoseSolution",
    "Protection",
    "SensorUse",
    "Station",
    "Velocity",
    "load_camera",
    "load_config",
    "load_station",
    "solve_pose",
]

_HOMES = {
    "camera": ("Camera", "load_camera"),
    "config": ("Config", "PaperConfig", "load_config"),
    "datatypes": (
        "AidingMeasurement",
        "Attitude",
        "Detections",
        "Fix",
        "Frame",
        "Guide",
        "LayerPose",
        "Match",
        "Protection",
        "SensorUse",
        "Velocity",
    ),
    "errors": ("DataError", "FrameError", "InputError", "LumidockError"),
    "localizer": ("Localizer",),
    "paper": ("PaperLocalizer",),
    "pose": ("PoseSolution", "solve_pose"),
    "station": ("Station", "load_station"),
}


def __getattr__(name: str) -> object:
    """A public name, from the module that it lives in (PEP 562)."""
    for home, names in _HOMES.items():
        if name in names:
            return getattr(import_module(f"lumidock.{home}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """The public names."""
    return __all__
