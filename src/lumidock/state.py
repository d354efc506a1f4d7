"""What a localizer carries from one frame to the next, and what it knows before the first."""

from __future__ import annotations

from dataclasses import dataclass

from lumidock.aiding import NO_AIDING, AidingState
from lumidock.camera import Camera
from lumidock.config import Config
from lumidock.datatypes import Contradiction, Detections, Stage
from lumidock.digest import Digest
from lumidock.file_check import NOTHING_TOLD, DistortionTest, Parameters, parameters
from lumidock.light_counts import CHECKED_LIGHTS
from lumidock.model import StationModel, believed, station_model
from lumidock.station import Station
from lumidock.track import CalibrationStates, Track


@dataclass(frozen=True, slots=True, eq=False)
class Context:
    """What stays the same from frame to frame: the dock, the camera, the settings, and `model`, made of them.

    `station` has the sigmas that the filter takes, `model` those that the file declares.
    `parameters`: what may be wrong in the files. `layer_alone`: the model of each layer by itself, where there are
    several and it has lights enough to be identified so, else None.
    """

    station: Station
    camera: Camera
    config: Config
    model: StationModel
    cold: bool
    parameters: Parameters
    layer_alone: tuple[StationModel | None, ...]

    @classmethod
    def of(cls, station: Station, camera: Camera, config: Config, *, cold: bool) -> Context:
        """Everything that is derived from station and camera, made once."""
        alone = tuple(
            station_model(station.only(name), camera, config.match)
            if len(station.lights_of(name)) >= CHECKED_LIGHTS and len(station.layers) > 1
            else None
            for name in station.layers
        )
        taken = believed(station, config.files)
        return cls(
            taken,
            camera,
            config,
            station_model(station, camera, config.match),
            cold,
            parameters=parameters(station, taken),
            layer_alone=alone,
        )


@dataclass(frozen=True, slots=True, eq=False)
class LocalizerState:
    """All memory of a localizer, as it stands after a frame.

    `hypotheses`: poses held possible, the likeliest first; before the track is `confirmed` they may differ in their
    assignments. `margin`: log odds that the array is where the track has it, the best of one frame; 0 where none told.
    `thin_frames`: frames in a row, up to the last that was checked, in which fewer than four lights held the track.
    `twin`: another array of the same layout was in view. `frozen`: the last frame was the picture before it again.
    `failures`: frames since the first hypothesis last held. `stage`: docking stage of the last fix. `last`: detections
    of the frame before. `calibration`: what an earlier track has learned of survey and calibration. `contradiction`:
    a layer in view contradicts the files, and no frame since has shown two layers that fit together. `distortion`: what
    all innovations say of it. `contradicted`: the last frame that could tell contradicted a file. `digest`: of the
    frame's picture, where there is one. `aiding`: the vehicle's own sensors. `dark_frames`: frames in a row in which no
    light held the track.
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
    contradiction: Contradiction | None = None
    distortion: DistortionTest = NOTHING_TOLD
    contradicted: bool = False
    digest: Digest | None = None
    aiding: AidingState = NO_AIDING
    dark_frames: int = 0

    @property
    def first(self) -> Track:
        """The likeliest hypothesis. Raises: IndexError where there is none."""
        return self.hypotheses[0]
