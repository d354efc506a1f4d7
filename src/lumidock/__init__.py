"""lumidock: the pose of an underwater vehicle relative to its dock, from one camera and the dock's guiding lights."""

from lumidock.camera import Camera, load_camera
from lumidock.config import Config, PaperConfig, load_config
from lumidock.datatypes import Attitude, Detections, Fix, Frame, Guide, LayerPose, Match, Protection
from lumidock.errors import FrameError, InputError, LumidockError
from lumidock.localizer import Localizer
from lumidock.paper import PaperLocalizer
from lumidock.pose import PoseSolution, solve_pose
from lumidock.station import Station, load_station

__all__ = [
    "Attitude",
    "Camera",
    "Config",
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
    "Station",
    "load_camera",
    "load_config",
    "load_station",
    "solve_pose",
]
