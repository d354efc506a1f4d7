"""What a localizer carries from one frame to the next, and what it knows before the first."""

from __future__ import annotations

from dataclasses import dataclass

from lumidock.camera import Camera
from lumidock.config import Config
from lumidock.datatypes import Detections, Stage
from lumidock.model import StationModel, station_model
from lumidock.station import Station
from lumidock.track import CalibrationStates, Track


@dataclass(frozen=True, slots=True, eq=False)
class Context:
    """What stays the same from frame to frame: the dock, the camera, the settings, and `model`, made of them."""

    station: Station
    camera: Camera
    config: Config
    model: StationModel
    cold: bool

    @classmethod
    def of(cls, station: Station, camera: Camera, config: Config, *, cold: bool) -> Context:
        """Everything that is derived from station and camera, made once."""
        return cls(station, camera, config, station_model(station, camera, config.match), cold)


@dataclass(frozen=True, slots=True, eq=False)
class LocalizerState:
    """All memory of a localizer, as it stands after a frame.

    `hypotheses`: poses held possible, the likeliest first; before the track is `confirmed` they may differ in their
    assignments. `margin`: log odds of the assignment, from the frame that confirmed it, 0 where no single frame could.
    `failures`: frames since the first hypothesis last held. `stage`: docking stage of the last fix. `last`: detections
    of the frame before. `calibration`: what an earlier track has learned of survey and calibration.
    """

    hypotheses: tuple[Track, ...] = ()
    confirmed: bool = False
    margin: float = 0.0
    failures: int = 0
    stage: Stage = "search"
    last: Detections | None = None
    calibration: CalibrationStates | None = None

    @property
    def first(self) -> Track:
        """The likeliest hypothesis. Raises: IndexError where there is none."""
        return self.hypotheses[0]
