"""The lights in a frame: the first detector of the default method, which knows nothing of earlier frames.

The frame is touched once, for the statistics of its 8 x 8 tiles. Tiles that clear the background around them are looked
at pixel by pixel, and what stands out of its own ring there is cut out at half height and measured.
"""

from __future__ import annotations

from functools import reduce

import cv2
import numpy as np
from numpy.typing import NDArray

from lumidock._kernels import detect as kernels
from lumidock.config import DetectConfig
from lumidock.datatypes import Array, Detections, Frame, Image, Indices

_BLOCK = 8  # tiles; background and noise are medians over blocks of 8 x 8 tiles ...
_FAR_TILES = 4  # at which the slopes of a wide light show
_MEDIAN_ABS = 0.6745  # median of |x| of a normal x
_MOST_SHARED = 6.0
_AROUND = 5  # ... and over 5 x 5 blocks


def lights(frame: Frame, config: DetectConfig) -> Detections:
    """Find the lights of a frame: centres with their covariance, radii, fluxes and how much each looks like a lamp.

    The layer is not known yet. Takes any picture; one without lights gives no detections.
    """
    image = np.ascontiguousarray(frame.image.reshape(*frame.image.shape[:2], -1))
    if not image.size:
        return _detections(frame, np.empty((0, kernels.COLUMNS)), np.empty(0), config)
    peak, mean, variance = kernels.tile_statistics(image.reshape(len(image), -1), image.shape[2])
    background = _surroundings(mean)
    noise = np.maximum(np.sqrt(_surroundings(variance)), np.float32(config.min_noise))
    tiles = _bright_tiles(peak, background, noise, config)
    noise = noise * np.float32(np.sqrt(_shared_noise(mean, variance)))
    found = _found(image, mean, background, noise, tiles, config)
    spots = _measured(image, found, noise, background, config)
    p_light = _lamp_probability(spots, _largest_radius(image, config), config)
    kept = ~_glints(spots, p_light, config)
    return _detections(frame, spots[kept], p_light[kept], config)


def _surroundings(values: Array) -> Array:
    """Median (h, w) of a value of the tiles over a few hundred pixels around each."""
    h, w = values.shape
    rows, columns = -h % _BLOCK, -w % _BLOCK
    padded = np.pad(values, ((0, rows), (0, columns)), mode="symmetric" if min(h, w) >= _BLOCK else "edge")
    blocks = padded.reshape((h + rows) // _BLOCK, _BLOCK, (w + columns) // _BLOCK, _BLOCK)
    middle = _BLOCK * _BLOCK // 2
    medians = np.partition(blocks.swapaxes(1, 2).reshape(*blocks.shape[::2], -1), middle, axis=2)[:, :, middle]
    smooth = np.asarray(cv2.medianBlur(np.ascontiguousarray(medians), _AROUND), np.float32)
    return np.repeat(np.repeat(smooth, _BLOCK, axis=0), _BLOCK, axis=1)[:h, :w]


def _shared_noise(mean: Array, variance: Array) -> float:
    """How much more the tiles' means vary than independent pixels would make them: demosaicing and JPEG share noise.

    From second differences between tiles, which no slope reaches, and their median, which no light reaches.
    """
    rows = mean[:: 1 + len(mean) // 64]
    if rows.shape[1] < 3:
        return 1.0
    differences = np.abs(rows[:, :-2] - 2.0 * rows[:, 1:-1] + rows[:, 2:])
    of_means = (float(np.median(differences)) / (_MEDIAN_ABS * np.sqrt(6.0))) ** 2
    return float(np.clip(2 * kernels.TILE_PX * of_means / max(float(np.median(variance[::4])), 0.1), 1.0, _MOST_SHARED))


def _bright_tiles(peak: Image, background: Array, noise: Array, config: DetectConfig) -> Indices:
    """Rows and columns (N, 2) of the tiles that may hold a light's peak, the strongest where there are too many.

    A tile on a slope has a brighter and a darker neighbour on opposite sides whose mean it does not exceed; a tile of a
    halo hardly exceeds that of any two.
    """
    over = (peak - background) / noise
    margin = 4.0 * noise
    near = _over_pairs(peak, 1)
    alone = (near >= margin) | (_over_pairs(peak, _FAR_TILES) >= margin) | (peak == 255)
    bright = (over > config.pixel_contrast) & alone & (near >= 0)
    tiles = np.argwhere(bright)
    if len(tiles) <= config.max_candidates:
        return tiles
    strongest = np.argsort(-over[bright], kind="stable")[: config.max_candidates]
    return tiles[np.sort(strongest)]


def _found(image: Image, mean: Array, background: Array, noise: Array, tiles: Indices, config: DetectConfig) -> Array:
    """Peaks (N, 4), columns u, v, value, contrast, in the `tiles`, the brightest first."""
    least = config.contrast
    found = kernels.peaks(image, mean, background, noise, tiles, config.ring_px, config.tile_step, least)
    return np.asarray(found[np.lexsort((found[:, 3], found[:, 2]))[::-1]])


def _over_pairs(peak: Image, distance: int) -> NDArray[np.int16]:
    """Twice the value (h, w) of each tile less that of two neighbours on opposite sides, the least of four ways."""
    d = distance
    p = np.pad(peak.astype(np.int16), d, mode="edge")
    h, w = peak.shape
    pairs = [(0, d), (d, 0), (d, d), (d, -d)]
    sums = (p[d + i : d + i + h, d + j : d + j + w] + p[d - i : d - i + h, d - j : d - j + w] for i, j in pairs)
    return np.asarray(2 * p[d : d + h, d : d + w] - reduce(np.maximum, sums))


def _measured(image: Image, found: Array, noise: Array, background: Array, config: DetectConfig) -> Array:
    """The spots (n, COLUMNS) around the peaks `found` (N, 4), each cut out once."""
    rows, columns = (found[:, 1] // kernels.TILE_PX).astype(int), (found[:, 0] // kernels.TILE_PX).astype(int)
    limits = config.max_spots, int(np.pi * _largest_radius(image, config) ** 2), config.max_work_px
    return np.asarray(
        kernels.measure(
            image,
            found,
            noise[rows, columns].astype(float),
            background[rows, columns].astype(float),
            limits,
            config.small_px,
            config.ring_px,
            np.array([config.min_elongation, config.min_fill]),
            config.signal_noise,
            config.min_snr,
        )
    )


def _largest_radius(image: Image, config: DetectConfig) -> float:
    """Radius px beyond which nothing is a spot."""
    return float(max(config.max_radius * max(image.shape[:2]), 2.0 * config.ring_px))


def _glints(spots: Array, p_light: Array, config: DetectConfig) -> NDArray[np.bool_]:
    """Whether each spot (N,) is near a much stronger one that may be a lamp: its reflection on the frame beside it."""
    uv, flux = spots[:, :2], spots[:, kernels.FLUX]
    distance = np.hypot(*(uv[:, None] - uv[None]).transpose(2, 0, 1))
    near = distance < config.glint_radii * spots[:, kernels.RADIUS]
    weaker = flux > config.glint_ratio * flux[:, None]
    trusted = p_light > config.glint_trust * p_light[:, None]
    return np.asarray((near & weaker & trusted).any(axis=1))


def _detections(frame: Frame, spots: Array, p_light: Array, config: DetectConfig) -> Detections:
    return Detections(
        frame.name,
        frame.t_ns,
        spots[:, :2].copy(),
        spots[:, kernels.RADIUS].copy(),
        spots[:, kernels.FLUX].copy(),
        p_light,
        np.full(len(spots), np.nan),
        _covariances(spots, config),
        frame.attitude,
    )


def _covariances(spots: Array, config: DetectConfig) -> Array:
    """Covariance (N, 2, 2) px^2 of the centres: the noise's share and what remains without noise."""
    cov = spots[:, [kernels.VAR_UU, kernels.VAR_UV, kernels.VAR_UV, kernels.VAR_VV]].reshape(-1, 2, 2)
    fine = np.where(spots[:, kernels.COARSE] > 0.0, config.coarse_px, config.floor_px)
    floor = fine**2 + np.where(spots[:, kernels.SATURATED] > 0.0, config.saturated_px, 0.0) ** 2
    cut = np.where(spots[:, kernels.CUT] > 0.0, config.cut * spots[:, kernels.RADIUS], 0.0) ** 2
    return np.asarray(cov + (floor + cut)[:, None, None] * np.eye(2))


def _lamp_probability(spots: Array, largest: float, config: DetectConfig) -> Array:
    """Probability (N,) of being a lamp, from contrast, shape and size alone: soft, so that geometry can overrule it."""
    radius = spots[:, kernels.RADIUS]
    seen = _logistic(spots[:, kernels.SNR] - 8.5)
    small = np.exp(-radius / 3.0)  # the outline of a small spot says little of its shape
    round_ = _logistic((spots[:, kernels.ELONGATION] - 0.5) / 0.06)
    full = _logistic((spots[:, kernels.FILL] - 0.75) / 0.04)
    shape = small + (1.0 - small) * round_ * full
    size = _logistic((0.5 * largest - radius) / (0.1 * largest)) * _logistic((radius - config.min_radius_px) / 0.1)
    usual = np.where(spots[:, kernels.SATURATED] > 0.0, 0.7, 0.5)
    raised = np.maximum(spots[:, kernels.LEVEL] - usual, 0.0)  # to part it from something as bright
    alone = 1.0 - 2.0 * raised
    return np.asarray(np.clip(seen * shape * size * alone, 0.02, 0.98))


def _logistic(x: Array) -> Array:
    return np.asarray(1.0 / (1.0 + np.exp(-x)))
