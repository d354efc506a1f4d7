"""Settings of faults at point level: what may be wrong with dock, camera, vehicle and stream of detections in a run."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from lumidock.sim.knobs import Angle, Counts, Interval, KnobSection, Lengths, Place, Probability

_Seconds = Annotated[float, Field(ge=0.0, le=1e4)]
_Metres = Annotated[float, Field(ge=0.0, le=100.0)]


class PointFaults(KnobSection):
    """Faults of bare detections along a path; each breaks or strains an assumption of the safety case.

    A range [low, high] is drawn once a run, its sign too where it has one; times at which something happens are random.
    """

    # lamps
    theft: Counts = (0, 0)  # lamps that go out for good, each at its own time, while a glint beside it comes on
    front_left: Counts | None = None  # front lamps that work; all of them by default
    unlisted: Counts = (0, 0)  # lamps on the structure that the station file does not list
    blink_hz: Interval = (0.0, 0.0)  # at which a lamp blinks, drawn for each lamp
    blink_on: Probability = 0.6  # share of the time that a blinking lamp is on
    layer_off_s: _Seconds = 0.0  # time in which the front layer is dark
    dock_off_s: _Seconds = 0.0  # time in which all lamps of the dock are dark; other lights and images are not
    # other arrays
    image: Literal["none", "surface", "wall", "floor"] = "none"  # that mirrors the dock; `image_m` away from its axis
    image_m: Lengths = (1.3, 3.0)
    twin_m: Place = (0.0, 0.0, 0.0)  # from the dock to another of the same layout, in `dock`; none at [0, 0, 0]
    # a dock that is not as surveyed
    off_m: _Metres = 0.0  # error of every light along each axis, 1 sigma
    layer_shift_m: _Metres = 0.0  # by which the rear layer, or half of a single one, is shifted sideways ...
    layer_depth_m: Interval = (0.0, 0.0)  # ... and lies deeper
    layer_turn_deg: Interval = (0.0, 0.0)  # by which the front layer, or half of a single one, is turned about z
    # a camera that is not as calibrated
    focal_error: Interval = (0.0, 0.0)  # of the true focal length against camera.yaml, relative, either sign
    center_px: Interval = (0.0, 0.0)  # of the true principal point against camera.yaml, in any direction
    distortion: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0  # radial, k1 of plumb_bob, that camera.yaml leaves out
    # errors with memory: a first-order process with the time constant `memory_s`
    memory_s: Annotated[tuple[float, float], Field()] = (0.5, 2.0)
    memory_share: Probability = 0.0  # of the variance of a centroid's noise, that has memory
    shift_px: Annotated[float, Field(ge=0.0, le=100.0)] = 0.0  # of all centroids together, 1 sigma
    scale: Annotated[float, Field(ge=0.0, le=0.1)] = 0.0  # of the focal length, relative, 1 sigma
    outliers: Probability = 0.0  # share of centroids that are off by `outlier_px` in any direction
    outlier_px: Lengths = (3.0, 6.0)
    # the stream
    jitter_s: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0  # largest error of a stamp, either sign, in order
    gap_s: Interval = (0.0, 0.0)  # length of gaps without any frame, one every 2-4 s
    frozen_s: Interval = (0.0, 0.0)  # time in which the same picture is repeated under new stamps ...
    frozen_px: Annotated[float, Field(ge=0.0, le=10.0)] = 0.0  # ... with so much noise that is new, 1 sigma
    # motion
    roll_deg: Interval = (0.0, 0.0)  # of the camera against head-on, either sign
    turn_deg_s: Angle = 0.0  # rate of turns by 20 degrees to one side and back, every 3-5 s
    jerk_m_s2: Interval = (0.0, 0.0)  # of pulses of 0.2-0.6 s there and back in any direction, every 2-5 s
    bump_m_s: Interval = (0.0, 0.0)  # by which the velocity changes at once, and back after 0.7 s, three times a run
    jump_m: Interval = (0.0, 0.0)  # by which the camera is elsewhere from one frame to the next, once a run

    @property
    def any(self) -> bool:
        """Whether there is a fault at all."""
        return self != PointFaults()
