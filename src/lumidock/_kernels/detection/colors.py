"""Colour of each light: what it has of blue, green and red over its background, where the sensor is not saturated."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lumidock._kernels.compiling import entry, part
from lumidock.datatypes import Array, Frame, Image, Indices

_SAMPLES, _RIM_SAMPLES = 12, 9  # a side of a window at most: of the light, and of its surroundings
_CLIP_ROUNDS, _CLIP = 2, 2.5  # outliers of the background, in sigmas
_SIXTEEN = 255.0 / 65535.0  # 8-bit levels of a 16-bit step


class Picture(NamedTuple):
    """A frame as the camera gives it, of any type.

    `rows` (H, n) its bytes, `deep` of which are a sample, least byte first; `planes` 1, 3 or, for a mosaic, 4, of which
    a sample, in a mosaic a 2 x 2 cell, has one value each; `scale` makes 8-bit grey levels of them.
    """

    rows: Image
    deep: int
    planes: int
    scale: float
    height: int
    width: int


def picture(frame: Frame) -> Picture:
    """A frame as the kernels take it."""
    image, (height, width) = np.ascontiguousarray(frame.image), frame.image.shape[:2]
    planes = 4 if frame.encoding.startswith("bayer") else 3 if image.ndim == 3 else 1
    deep = image.dtype.itemsize
    rows = image.reshape(height, -1).view(np.uint8)
    rows.flags.writeable = False  # or what is read only, as messages are, would be of another type, compiled anew
    return Picture(rows, deep, planes, 1.0 if deep == 1 else _SIXTEEN, height, width)


@part
def value(picture: Picture, v: int, x: int) -> int:
    """The `x`th number of row `v`."""
    if picture.deep == 1:
        return int(picture.rows[v, x])
    return int(picture.rows[v, 2 * x]) + 256 * int(picture.rows[v, 2 * x + 1])


@part
def sample(picture: Picture, p: int, v: int, u: int) -> float:
    """One sample of plane `p`, in grey levels, at a pixel or, on a mosaic, in the 2 x 2 cell of a pixel."""
    if picture.planes == 1:
        return picture.scale * value(picture, v, u)
    if picture.planes == 3:
        return picture.scale * value(picture, v, 3 * u + p)
    v, u = min((v & -2) + (p >> 1), picture.height - 1), min((u & -2) + (p & 1), picture.width - 1)
    return picture.scale * value(picture, v, u)


@entry
def colors(
    picture: Picture,
    order: Indices,
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
    """Write `p_rear` (N,) of the detections `uv` (N, 2), by their light of B, G, R over the background.

    `order` (4,): colour of each plane. `linear` (256,) undoes the camera's gamma. A saturated core is white whatever
    the lamp, so the ring around it is asked, from `clear_px` beyond its edge to `ring` radii + px. `decide`: see
    `_of_light`. NaN where there is too little light.
    """
    pitch = 2 if picture.planes == 4 else 1
    rim = np.empty((3, 2 * (_RIM_SAMPLES + 4) ** 2), np.float32)
    light = np.empty((4, 3))  # of each colour: sum, number of samples, over the background, 1 sigma
    for n in range(len(uv)):
        u, v = uv[n]
        outer, inside = ring[0] * radius[n] + ring[1], max(radius[n], least_reach_px)
        burnt = _is_burnt(picture, clipped, u, v, inside)
        low, high = (radius[n] + clear_px, outer) if burnt else (0.0, inside)
        step = pitch * (1 + int(2.0 * (2.0 * outer + 2.0)) // (16 * pitch))
        fine = max(step // 2 // pitch * pitch, pitch) if high < 8.0 else step
        _add_disc(picture, order, linear, clipped, u, v, low, high, fine, light)
        dark = _rim(picture, order, linear, u, v, outer, rim)
        p_rear[n] = np.nan
        if dark == 0 or min(light[1, 0], min(light[1, 1], light[1, 2])) == 0.0:
            continue
        for c in range(3):
            level, spread = _clipped_moments(rim[c, :dark])
            light[2, c] = light[0, c] / light[1, c] - level
            light[3, c] = spread / np.sqrt(light[1, c]) + 1e-3
        p_rear[n] = _of_light(light[2], light[3], decide)


@part
def _add_disc(
    picture: Picture,
    order: Indices,
    linear: Array,
    clipped: float,
    u: float,
    v: float,
    low: float,
    high: float,
    step: int,
    light: Array,
) -> None:
    """Write the sums of light of each colour, and how many samples of it, between two radii around a place."""
    light[:2] = 0.0
    pitch = 2 if picture.planes == 4 else 1
    center_u, center_v = u - 0.5 * (pitch - 1), v - 0.5 * (pitch - 1)
    for y in _steps(v, high, picture.height, pitch, step):
        for x in _steps(u, high, picture.width, pitch, step):
            square = (x - center_u) ** 2 + (y - center_v) ** 2
            if not low * low <= square <= high * high:
                continue
            most = 0.0
            for p in range(picture.planes):
                most = max(most, sample(picture, p, y, x))
            if most < clipped:
                for p in range(picture.planes):
                    light[0, order[p]] += _light(sample(picture, p, y, x), linear)
                    light[1, order[p]] += 1.0


@part
def _rim(picture: Picture, order: Indices, linear: Array, u: float, v: float, outer: float, rim: Array) -> int:
    """Write the light of each colour in the surroundings of a detection to `rim` (3, N); returns how many samples."""
    pitch, reach, count = 2 if picture.planes == 4 else 1, 2.0 * outer + 2.0, 0
    step = pitch * (1 + int(2.0 * reach) // (_RIM_SAMPLES * pitch))
    for y in _steps(v, reach, picture.height, pitch, step):
        for x in _steps(u, reach, picture.width, pitch, step):
            if (x - u) ** 2 + (y - v) ** 2 > 2.25 * outer * outer and count < rim.shape[1]:
                for p in range(picture.planes):
                    rim[order[p], count] = _light(sample(picture, p, y, x), linear)
                count += 1
    return count


@part
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


@part
def _steps(center: float, reach: float, size: int, pitch: int, step: int) -> range:
    """Rows or columns around a place, as far as they are in the picture."""
    return range(max(int(center - reach), 0) // pitch * pitch, min(int(center + reach) + 2, size - pitch + 1), step)


@part
def _light(value: float, linear: Array) -> float:
    return float(linear[min(int(value + 0.5), 255)]) if len(linear) else value


@part
def _is_burnt(picture: Picture, clipped: float, u: float, v: float, reach: float) -> bool:
    """Whether any sample of a disc is saturated."""
    step, channels = 1 + int(reach) // 8, 3 if picture.planes == 3 else 1
    limit = clipped / picture.scale
    for y in range(max(int(v - reach), 0), min(int(v + reach) + 2, picture.height), step):
        for x in range(max(int(u - reach), 0), min(int(u + reach) + 2, picture.width), step):
            if (x - u) ** 2 + (y - v) ** 2 <= reach * reach:
                for p in range(channels):
                    if value(picture, y, channels * x + p) >= limit:
                        return True
    return False


@part
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
