"""How likely a blob is a lamp: named features of what surrounds it, and a logistic model of them.

All features are ratios, so that gain and exposure do not matter, and none knows the place in the picture. The weights
stand in `lamp.json`, which `python -m bench.lamp_weights` makes from rendered scenes.
"""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files
from typing import NamedTuple

import numpy as np

from lumidock._kernels.detection import blobs, centroid
from lumidock._kernels.detection.centroid import GRADIENT_VAR
from lumidock._kernels.detection.profiles import MEAN, MOST, SPREAD, STEP
from lumidock.datatypes import Array

MODEL = "lamp.json"
_LEAST, _MOST = -1.0, 3.0  # limits of a ratio to the contrast, beyond which it says no more
_OUTER = 8  # rings from here on, four sizes and more, are the background
_RANGE = {  # beyond which a feature says no more: no camera draws a lamp as round and even as its formula
    "log_snr": (0.0, 2.5),
    "log_height": (-5.0, 1.0),
    "roundness": (0.0, 0.6),
    "brightest_3": (0.4, 3.0),
    "fall_1": (-1.0, 3.0),
    "fall_2": (-1.0, 3.0),
    "uneven_1": (0.08, 3.0),
    "uneven_2": (0.15, 3.0),
    "uneven_3": (0.2, 3.0),
    "shift": (0.2, 1.5),
    "lost": (0.0, 2.0),
    "white": (0.0, 1.0),
    "widest": (-1.0, 3.0),
}
_STRONGEST = 4  # of a frame, whose mean height is what others are compared to: no pose takes fewer lights


class Seen(NamedTuple):
    """N blobs, one of each light: `rows`, `cov` (N, 2, 2) px^2, `measured`, `rings` (N, 3, P, RINGS).

    `area_px2` (N,): of what was searched for them.
    """

    rows: Array
    cov: Array
    measured: Array
    rings: Array
    area_px2: Array


class _Profile(NamedTuple):
    """Of each blob's own plane: `mean`, `spread`, `most` (N, RINGS), the background and the contrast (N,)."""

    mean: Array
    spread: Array
    most: Array
    background: Array
    contrast: Array


def _profile(seen: Seen) -> _Profile:
    own = np.arange(len(seen.rows)), seen.rows[:, blobs.PLANE].astype(np.int64)
    mean, spread, most = (seen.rings[:, kind][own] for kind in (MEAN, SPREAD, MOST))
    background = np.median(mean[:, _OUTER:], axis=1)
    return _Profile(mean, spread, most, background, np.maximum(mean[:, 0] - background, 1e-3))


def features(seen: Seen) -> dict[str, Array]:
    """The features (N,) by name; rings are counted in sizes of the blob, heights over the background."""
    own, rows, at = _profile(seen), seen.rows, {size: round(size / STEP) for size in range(7)}
    height = rows[:, blobs.HEIGHT]

    def ratio(value: Array) -> Array:
        return np.asarray(np.clip(value / own.contrast, _LEAST, _MOST))

    found = {
        "log_snr": np.log(height / np.maximum(rows[:, blobs.NOISE], rows[:, blobs.TEXTURE])),
        "log_height": np.log(height / np.sort(height)[-_STRONGEST:].mean()) if len(rows) else height,
        "roundness": seen.measured[:, centroid.M_RATIO],
        "brightest_3": ratio(own.most[:, at[3]] - own.background),
    }
    found |= {f"fall_{r}": ratio(own.mean[:, at[r]] - own.background) for r in (1, 2)}
    found |= {f"uneven_{r}": ratio(own.spread[:, at[r]]) for r in (1, 2, 3)}
    found |= _over_scales(seen) | _over_planes(seen)
    return {name: value.clip(*_RANGE[name]) for name, value in found.items()}


def _over_scales(seen: Seen) -> dict[str, Array]:
    """How the maximum moves, and whether it is one, in the filters half an octave finer and wider."""
    shift = seen.measured[:, centroid.M_SHIFT_X] + seen.measured[:, centroid.M_SHIFT_Y]
    lost = 2.0 - seen.measured[:, centroid.M_SHIFTS]
    return {"shift": np.sqrt(shift) / seen.rows[:, blobs.SCALE], "lost": lost}


def _over_planes(seen: Seen) -> dict[str, Array]:
    """How white the core is, and how far the halo reaches in the plane where it is widest."""
    mean = seen.rings[:, MEAN, :3]
    background = np.median(mean[:, :, _OUTER:], axis=2)
    contrast = np.maximum(mean[:, :, 0] - background, 0.0)
    wide = (mean[:, :, round(3 / STEP)] - background) / np.maximum(contrast, 1.0)
    return {
        "white": contrast.min(axis=1) / np.maximum(contrast.max(axis=1), 1e-3),
        "widest": wide.max(axis=1),
    }


@cache
def _model() -> tuple[tuple[str, ...], Array, float]:
    """Names of the features, their weights, and the constant."""
    read = json.loads((files("lumidock") / MODEL).read_text(encoding="utf-8"))
    weights = read["weights"]
    return tuple(weights), np.array(list(weights.values())), float(read["constant"])


def likelihood(seen: Seen) -> Array:
    """Probability (N,) that each blob is a lamp: that it looks like one, and that noise has not made it."""
    names, weights, constant = _model()
    found = features(seen)
    log_odds = np.column_stack([found[name] for name in names]) @ weights + constant
    return np.asarray(1.0 / ((1.0 + np.exp(-log_odds)) * (1.0 + noise_maxima(seen))))


def noise_maxima(seen: Seen) -> Array:
    """How many maxima (N,) as high and at least as large as each blob noise alone is expected to make in all planes.

    Of a Gaussian field f with var f' = l var f there are l k exp(-k^2 / 2) / (2 pi)^1.5 maxima over k sigma in a unit
    of area (R. Adler, "The Geometry of Random Fields", 1981). For white noise l = 13 / (12 s^2), and all scales from
    s on in steps of sqrt(2) have twice as many as s alone.
    """
    k = seen.rows[:, blobs.HEIGHT] / seen.rows[:, blobs.NOISE]
    density = GRADIENT_VAR / seen.rows[:, blobs.SIZE] ** 2 * k * np.exp(-0.5 * k * k) / (2.0 * np.pi) ** 1.5
    return np.asarray(2.0 * seen.rings.shape[2] * seen.area_px2 * density)


def radius_and_flux(seen: Seen) -> tuple[Array, Array]:
    """Radius px at half of the peak, and grey levels summed over three sizes, in each blob's own plane."""
    own, size = _profile(seen), seen.rows[:, blobs.SIZE]
    share = (own.mean - own.background[:, None]) / own.contrast[:, None]
    below = share < 0.5
    below[:, 0], below[:, -1] = False, True
    k, n = below.argmax(axis=1), np.arange(len(share))
    before, after = share[n, k - 1], share[n, k]
    part = ((before - 0.5) / np.maximum(before - after, 1e-3)).clip(0.0, 1.0)
    rings = np.arange(round(3 / STEP) + 1) * STEP
    area = 2.0 * np.pi * np.maximum(rings, 0.25 * STEP) * STEP * size[:, None] ** 2
    flux = (np.maximum(share[:, : len(rings)], 0.0) * area).sum(axis=1) * own.contrast
    return (k - 1 + part) * STEP * size, flux
