"""Colour of each spot: the light of blue, green and red over its background, read where the sensor is not saturated."""

from __future__ import annotations

import numpy as np
from numba import njit

from lumidock.datatypes import Array, Image, Indices

_SAMPLES, _RIM_SAMPLES = 16, 12  # a side of a window at most: of the spot, and of its surroundings
_CLIP_ROUNDS, _CLIP = 2, 2.5  # outliers of the background, in sigmas


@njit(cache=True, error_model="numpy")
def colors(
    image: Image,
    planes: int,
    order: Indices,
    scale: float,
    linear: Array,
    clipped: float,
    uv: Array,
    radius: Array,
    ring: tuple[float, float],
    clear_px: float,
    least_reach_px: float,
    decide: tuple[float, float, float, float],
    p_rear: Array,
) -> None:
    """Write `p_rear` (N,) of the spots `uv` (N, 2), by their light of B, G, R over the background.

    `order` (4,): colour of each plane. `linear` (256,) undoes the camera's gamma. A saturated core is white whatever
    the lamp, so the ring around it is asked, from `clear_px` beyond its edge to `ring` radii + px. `decide`: see
    `_of_light`. NaN where there is too little light.
    """
    pitch = 2 if planes == 4 else 1
    value = np.empty(4)
    rim = np.empty((3, (_RIM_SAMPLES + 4) ** 2))
    total, count, signal, sigma = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for n in range(len(uv)):
        u, v = uv[n]
        outer = ring[0] * radius[n] + ring[1]
        reach = 2.0 * outer + 2.0
        step = pitch * (1 + int(2.0 * reach) // (_SAMPLES * pitch))
        coarse = pitch * (1 + int(2.0 * reach) // (_RIM_SAMPLES * pitch))
        inner = max(radius[n], least_reach_px)
        burnt = _is_burnt(image, scale, clipped, u, v, inner)
        low, high = (radius[n] + clear_px, outer) if burnt else (0.0, inner)
        fine = max(step // 2 // pitch * pitch, pitch) if high < 8.0 else step
        total[:], count[:], dark = 0.0, 0.0, 0
        center_u, center_v = u - 0.5 * (pitch - 1), v - 0.5 * (pitch - 1)
        for y in _steps(v, high, image.shape[0], pitch, fine):
            for x in _steps(u, high, image.shape[1], pitch, fine):
                square = (x - center_u) ** 2 + (y - center_v) ** 2
                if low * low <= square <= high * high and _read(image, planes, scale, y, x, value) < clipped:
                    for p in range(planes):
                        total[order[p]] += _light(value[p], linear)
                        count[order[p]] += 1.0
        for y in _steps(v, reach, image.shape[0], pitch, coarse):
            for x in _steps(u, reach, image.shape[1], pitch, coarse):
                if (x - u) ** 2 + (y - v) ** 2 > 2.25 * outer * outer and dark < rim.shape[1]:
                    _read(image, planes, scale, y, x, value)
                    for p in range(planes):
                        rim[order[p], dark] = _light(value[p], linear)
                    dark += 1
        p_rear[n] = np.nan
        if dark == 0 or count.min() == 0.0:
            continue
        for c in range(3):
            level, spread = _clipped_moments(rim[c, :dark])
            signal[c] = total[c] / count[c] - level
            sigma[c] = spread / np.sqrt(count[c]) + 1e-3
        p_rear[n] = _of_light(signal, sigma, decide)


@njit(error_model="numpy")
def _of_light(signal: Array, sigma: Array, decide: tuple[float, float, float, float]) -> float:
    """P(rear) from linear light (3,) of B, G, R and its error, NaN where it is too weak.

    `decide`: blue over the larger of green and red where both layers are as likely, the spread of its logarithm, the
    sigmas below which nothing is known, and the limit to 0 and 1.
    """
    ratio, softness, least, limit = decide
    k = 2 if signal[2] > signal[1] else 1
    if not max(signal[0] / sigma[0], signal[k] / sigma[k]) >= least:
        return np.nan
    blue, rest = max(signal[0], sigma[0]), max(signal[k], sigma[k])
    odds = np.log(blue / rest / ratio) / np.hypot(softness, np.hypot(sigma[0] / blue, sigma[k] / rest))
    return min(max(1.0 / (1.0 + np.exp(-odds)), limit), 1.0 - limit)


@njit(error_model="numpy")
def _steps(center: float, reach: float, size: int, pitch: int, step: int) -> range:
    """Rows or columns around a place, as far as they are in the picture."""
    return range(max(int(center - reach), 0) // pitch * pitch, min(int(center + reach) + 2, size - pitch + 1), step)


@njit(error_model="numpy")
def _read(image: Image, planes: int, scale: float, y: int, x: int, value: Array) -> float:
    """Samples of all planes at a pixel, or in a cell of a mosaic; returns the largest."""
    largest = 0.0
    for p in range(planes):
        value[p] = scale * (image[y, x, p] if planes == 3 else image[y + (p >> 1), x + (p & 1), 0])
        largest = max(largest, value[p])
    return largest


@njit(error_model="numpy")
def _light(value: float, linear: Array) -> float:
    return float(linear[min(int(value + 0.5), 255)]) if len(linear) else value


@njit(error_model="numpy")
def _is_burnt(image: Image, scale: float, clipped: float, u: float, v: float, reach: float) -> bool:
    step = 1 + int(reach) // 8
    for y in range(max(int(v - reach), 0), min(int(v + reach) + 2, image.shape[0]), step):
        for x in range(max(int(u - reach), 0), min(int(u + reach) + 2, image.shape[1]), step):
            if (x - u) ** 2 + (y - v) ** 2 <= reach * reach:
                for p in range(image.shape[2]):
                    if scale * image[y, x, p] >= clipped:
                        return True
    return False


@njit(error_model="numpy", fastmath={"reassoc", "contract"})
def _clipped_moments(values: Array) -> tuple[float, float]:
    """Mean and standard deviation without outliers."""
    level, spread = 0.0, np.inf
    for _ in range(_CLIP_ROUNDS + 1):
        total, squares, count = 0.0, 0.0, 0
        for x in values:
            d, kept = x - level, abs(x - level) <= _CLIP * spread
            total += d if kept else 0.0
            squares += d * d if kept else 0.0
            count += kept
        if count == 0:
            break
        shift = total / count
        level, spread = level + shift, np.sqrt(max(squares / count - shift * shift, 0.0))
    return level, spread
