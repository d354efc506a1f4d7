"""What the lights of a frame say of its exposure, and the exposure and gain that a camera driver should set next.

Cores that are saturated no longer say what colour a light has, and halos around them merge with what they light.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lumidock.datatypes import Array

SHORTEN = 0.4  # factor of one step where light is saturated: how far it is over the top cannot be seen
_LENGTHEN = 2.5  # largest factor of a step up, as large as that down
_TARGET, _DARK = 0.5, 0.2  # light of the brightest core over saturation: wanted, and below which it is too dark
_MOST_SATURATED = 0.5  # share of the lamps whose cores may be saturated: a near one may, if the far ones are seen
GLARE = 0.1  # share of the picture that is saturated, of which no lamp comes: 100 lamps 20 px wide fill 1 %
_GAMMA = 2.2  # grey level over saturation is light to the power of 1 / 2.2 (ITU-R BT.709), if it is not linear
_SATURATED = 0.98  # of the saturated level, that the mean of a core has at least
_DB = 20.0  # decibels of a gain of 10 (EMVA 1288)


@dataclass(frozen=True, slots=True)
class Exposure:
    """Settings of a camera: exposure time ms and gain dB."""

    time_ms: float
    gain_db: float = 0.0


def factor(levels: Array, glare: float, *, linear: bool) -> float:
    """By what exposure times gain should be multiplied: below 1 too bright, 1 right, above 1 too dark; NaN unknown.

    `levels` (N,): grey levels of the lamps' cores over the saturated one, in the plane where each is measured;
    `glare`: share of the picture that is saturated; `linear`: whether grey levels are proportional to light.
    """
    if glare > GLARE:
        return SHORTEN
    if not len(levels):
        return math.nan
    saturated = levels >= _SATURATED
    if saturated.mean() > _MOST_SATURATED:
        return SHORTEN
    brightest = float(levels.max()) ** (1.0 if linear else _GAMMA)
    return min(_TARGET / max(brightest, 1e-3), _LENGTHEN) if brightest < _DARK else 1.0


def recommended(now: Exposure, exposure_factor: float, least_ms: float, most_ms: float) -> Exposure:
    """The settings whose product of time and gain is `exposure_factor` times that of `now`, at the least gain.

    The time stays between `least_ms` and `most_ms`, above which motion blurs the lights; gain makes up the rest, and is
    not negative. A factor of NaN changes nothing.
    """
    if not math.isfinite(exposure_factor):
        return now
    wanted_ms = now.time_ms * 10.0 ** (now.gain_db / _DB) * exposure_factor
    time_ms = float(np.clip(wanted_ms, least_ms, most_ms))
    return Exposure(time_ms, max(_DB * math.log10(wanted_ms / time_ms), 0.0))
