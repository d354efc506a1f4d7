"""What a localizer carries from one frame to the next, and what it knows before the first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumidock.aiding import NO_AIDING, AidingState
from lumidock.camera import Camera
from lumidock.config import Config
from lumidock.datatypes import Array, Detections, Stage
from lumidock.model import StationModel, station_model
from lumidock.station import Station
from lumidock.track import CalibrationStates, Track, calibration_prior


@dataclass(frozen=True, slots=True, eq=False)
class Context:
    """What stays the same from frame to frame: the dock, the camera, the settings, and `model`, made of them.

    `prior_var` (n,): what the files say of the variance of each of the filter's calibration states.
    """

    station: Station
    camera: Camera
    config: Config
    model: StationModel
    cold: bool
    prior_var: Array

    @classmethod
    def of(cls, station: Station, camera: Camera, config: Config, *, cold: bool) -> Context:
        """Everything that is derived from station and camera, made once."""
        model, declared = station_model(station, camera, config.match), calibration_prior(station, None)
        return cls(station, camera, config, model, cold, np.diagonal(declared.P).copy())


@dataclass(frozen=True, slots=True, eq=False)
class LocalizerState:
    """All memory of a localizer, as it stands after a frame.

    `hypotheses`: poses held possible, the likeliest first; before the track is `confirmed` they may differ in their
    assignments. `margin`: log odds of the assignment, from the frame that confirmed it, 0 where no single frame could.
    `thin_frames`: frames in a row, up to the last that was checked, in which fewer than four lights held the track.
    `twin`: another array of the same layout was in view. `frozen`: the last frame was the picture before it again.
    `failures`: frames since the first hypothesis last held. `stage`: docking stage of the last fix. `last`: detections
    of the frame before. `calibration`: what an earlier track has learned of survey and calibration. `aiding`: the
    vehicle's own sensors. `dark_frames`: frames in a row in which no light held the track.
    """

    hypotheses: tuple[Track, ...] = ()
    confirmed: bool = False
    margin: float = 0.0
    failures: int = 0
    thin_frames: int = 0
    twin: bool = False
    frozen: bool = False
    stage: Stage = "search"
    last: Detections | None = None
    calibration: CalibrationStates | None = None
    aiding: AidingState = NO_AIDING
    dark_frames: int = 0

    @property
    def first(self) -> Track:
        """The likeliest hypothesis. Raises: IndexError where there is none."""
        return self.hypotheses[0]
