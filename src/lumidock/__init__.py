"""lumidock: the pose of an underwater vehicle relative to its dock, from one camera and the dock's guiding lights."""

from lumidock.camera import Camera, load_camera
from lumidock.config import Config, PaperConfig, load_config
from lumidock.datatypes import Detections, Fix, Frame, LayerPose, Match
from lumidock.errors import FrameError, InputError, LumidockError
from lumidock.paper import PaperLocalizer
from lumidock.station import Station, load_station

__all__ = [
    "Camera",
    "Config",
    "Detections",
    "Fix",
    "Frame",
    "FrameError",
    "InputError",
    "LayerPose",
    "LumidockError",
    "Match",
    "PaperConfig",
    "PaperLocalizer",
    "Station",
    "load_camera",
    "load_config",
    "load_station",
]
