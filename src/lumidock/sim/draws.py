"""Purposes of random draws; each has its own generator, so that settings of one do not change draws of another."""

from __future__ import annotations

from enum import IntEnum


class Draw(IntEnum):
    """The purpose of a draw: the part of a generator's seed that follows the seed of the scenario or of the run."""

    COURSE = 0
    DETECTIONS = 1
    WANDERING_LIGHTS = 2
    MISSING_LIGHTS = 3
    RUN = 4
    ATTITUDE = 5
    STREAM_FAULTS = 6
    DROPPED_LIGHTS = 7
    SPURIOUS_LIGHTS = 8
    SENSOR_NOISE = 9
    FOULING = 10
    MIRROR_IMAGES = 11
    GLINTS = 12
    SNOW = 13
    FISH = 14
    DETECTOR_ERRORS = 15
    BENT_LIGHT = 16
    STRUCTURE_GLINTS = 17
    POINT_FAULTS = 18
    POINT_NOISE = 19
    HOT_PIXELS = 20
    JELLYFISH = 21
    POINT_STREAM = 23
    AIDING = 22
    STATION = 23
    VEHICLE = 24
