"""One frame's detections as acquisition, association and filter take them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lumidock._kernels.compiling import entry
from lumidock.datatypes import Array, Indices


class Measurements(NamedTuple):
    """N detections with all that the estimator weighs them by.

    Centroids `uv` (N, 2) px, their covariance `cov` (N, 2, 2) px^2 and its mean `var` (N,) px^2 per axis; log
    likelihood ratio against clutter for each layer `like` (N, L); `p_light` (N,), 1 where nobody has said how likely
    it is a lamp; `log_density`, log of the clutter's density 1/px^2.
    """

    uv: Array
    cov: Array
    var: Array
    like: Array
    p_light: Array
    log_density: float


class Appearance(NamedTuple):
    """What a detection's looks are worth.

    `trust`: share of `p_rear` - 1/2 that is believed. The centroid of a detection of `p_light` under `p_usual` is
    uncertain by up to `share` of its radius, or of `most_px` where the radius is larger or unknown.
    """

    trust: float
    share: float
    most_px: float
    p_usual: float


@entry
def weigh(radius_px: Array, p_rear: Array, is_rear: Indices, looks: Appearance, frame: Measurements) -> float:
    """Fill `like` and `var`, raise `cov`, and set `p_light` to 1 where it is NaN; the area px^2 of all detections."""
    low_u, high_u, low_v, high_v = np.inf, -np.inf, np.inf, -np.inf
    layers, uv, cov, p_light = len(is_rear), frame.uv, frame.cov, frame.p_light
    for i in range(len(uv)):
        if math.isnan(p_light[i]):
            p_light[i] = 1.0
        own = radius_px[i] if radius_px[i] < looks.most_px else looks.most_px
        wider = (looks.share * max(1.0 - p_light[i] / looks.p_usual, 0.0) * own) ** 2
        cov[i, 0, 0] += wider
        cov[i, 1, 1] += wider
        low_u, high_u = min(low_u, uv[i, 0]), max(high_u, uv[i, 0])
        low_v, high_v = min(low_v, uv[i, 1]), max(high_v, uv[i, 1])
        frame.var[i] = 0.5 * (cov[i, 0, 0] + cov[i, 1, 1])
        lamp = math.log(min(max(2.0 * p_light[i], 0.05), 1.0))
        p = 0.5 if math.isnan(p_rear[i]) or layers == 1 else 0.5 + looks.trust * (p_rear[i] - 0.5)
        for k in range(layers):
            frame.like[i, k] = lamp + math.log(2.0 * (p if is_rear[k] == 1 or layers == 1 else 1.0 - p))
    return (high_u - low_u) * (high_v - low_v)
