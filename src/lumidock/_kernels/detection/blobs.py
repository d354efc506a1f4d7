"""Blobs of a scale space: maxima of one difference of Gaussians, and which of them belong to one light.

Candidates are rows of a table; the columns are the names below. Positions `X`, `Y` are in pixels of the pyramid level,
`U`, `V` and `SIZE` (the filter's standard deviation) in pixels of the frame.
"""

from __future__ import annotations

import math

import numpy as np

from lumidock._kernels.compiling import entry, part
from lumidock.datatypes import Array, Indices

X, Y, PLANE, LEVEL, SCALE, HEIGHT, NOISE, TEXTURE, PATCH, U, V, SIZE = range(12)
COLUMNS = 12
_RINGS, _SPOKES = (5.0, 8.0), 16  # radii over the filter's size; a blob of its own size has 2 % of its height there
_SIGMA = 1.4826  # standard deviation of a Gaussian over its median absolute deviation
LEFT, TOP, RIGHT, BOTTOM, U0, V0, CORE_LEFT, CORE_TOP, CORE_RIGHT, CORE_BOTTOM = range(10)
SEEN_LEFT, SEEN_TOP, SEEN_RIGHT, SEEN_BOTTOM = range(10, 14)
PATCH_COLUMNS = 14


@entry
def differences(fine: Array, wide: Array, response: Array) -> None:
    """Write the difference of two blurred pictures (H, W, P) to `response` (H, W, 1 or 4), with the mean of planes."""
    height, width, planes = fine.shape
    for y in range(height):
        for x in range(width):
            total = np.float32(0.0)
            for p in range(planes):
                d = fine[y, x, p] - wide[y, x, p]
                response[y, x, p] = d
                total += d
            if planes == 3:
                response[y, x, 3] = total * np.float32(1.0 / 3.0)


@entry
def maxima(
    response: Array,
    least: Array,
    noise: Array,
    roundness: float,
    clear: float,
    level: int,
    scale: float,
    patches: Indices,
    first: int,
    last: int,
    found: Array,
    count: int,
) -> int:
    """Append the 3 x 3 maxima of `response` (H, W, P) to `found`; returns the new count.

    A maximum must exceed `least` (P,) and `clear` times the texture around it, and have a ratio of its curvatures over
    `roundness`. `patches` (N, PATCH_COLUMNS), rectangles of the canvas in pixels of the frame, are searched from
    `first` to `last`; a maximum counts where it lies in the core of one.
    """
    height, width, planes = response.shape
    away = np.empty(2 * _SPOKES)
    pixel = 1 << level
    for n in range(first, last):
        patch = patches[n]
        x0, x1 = max(patch[CORE_LEFT] // pixel - 1, 1), min(-(-patch[CORE_RIGHT] // pixel) + 1, width - 1)
        y0, y1 = max(patch[CORE_TOP] // pixel - 1, 1), min(-(-patch[CORE_BOTTOM] // pixel) + 1, height - 1)
        for y in range(y0, y1):
            for x in range(x0, x1):
                for p in range(planes):
                    r = response[y, x, p]
                    if r <= least[p] or count >= len(found):
                        continue
                    a, b = response[y, x - 1, p], response[y, x + 1, p]
                    c, d = response[y - 1, x, p], response[y + 1, x, p]
                    if not (r >= a and r > b and r >= c and r > d):
                        continue
                    e, f = response[y - 1, x - 1, p], response[y + 1, x + 1, p]
                    g, h = response[y - 1, x + 1, p], response[y + 1, x - 1, p]
                    if not (r >= e and r > f and r >= g and r > h):
                        continue
                    h_xx, h_yy, h_xy = a + b - 2.0 * r, c + d - 2.0 * r, 0.25 * (e + f - g - h)
                    half_trace, root = 0.5 * (h_xx + h_yy), np.hypot(0.5 * (h_xx - h_yy), h_xy)
                    if half_trace + root > roundness * (half_trace - root):  # both are negative at a maximum
                        continue
                    around = _texture(response, p, x, y, scale, limits(patch, pixel), seen_limits(patch, pixel), away)
                    if r <= clear * around:
                        continue
                    row = found[count]
                    row[X] = x + min(max(0.5 * (a - b) / min(h_xx, -1e-9), -0.5), 0.5)
                    row[Y] = y + min(max(0.5 * (c - d) / min(h_yy, -1e-9), -0.5), 0.5)
                    row[PLANE], row[LEVEL], row[SCALE], row[SIZE] = p, level, scale, scale * pixel
                    row[HEIGHT], row[NOISE], row[TEXTURE], row[PATCH] = r, noise[p], around, n
                    row[U] = (row[X] + 0.5) * pixel - 0.5 - patch[LEFT] + patch[U0]
                    row[V] = (row[Y] + 0.5) * pixel - 0.5 - patch[TOP] + patch[V0]
                    count += 1
    return count


@part
def limits(patch: Indices, pixel: int) -> tuple[int, int, int, int]:
    """First and last column and row of a patch on a level whose pixels are so large: left, top, right, bottom."""
    return patch[LEFT] // pixel, patch[TOP] // pixel, patch[RIGHT] // pixel - 1, patch[BOTTOM] // pixel - 1


@part
def seen_limits(patch: Indices, pixel: int) -> tuple[int, int, int, int]:
    """The same of the part of a patch that is in the frame."""
    right, bottom = max(patch[SEEN_RIGHT] // pixel, 1) - 1, max(patch[SEEN_BOTTOM] // pixel, 1) - 1
    return min(patch[SEEN_LEFT] // pixel, right), min(patch[SEEN_TOP] // pixel, bottom), right, bottom


@part
def _texture(
    response: Array,
    p: int,
    x: int,
    y: int,
    scale: float,
    box: tuple[int, int, int, int],
    seen: tuple[int, int, int, int],
    away: Array,
) -> float:
    """The noise of a response around a maximum: from the median absolute value on two rings, outside of its own.

    What lies beyond the frame, where a lamp at the border has its mirror image, does not count.
    """
    count = 0
    for ring in _RINGS:
        for k in range(_SPOKES):
            angle = 2.0 * math.pi * k / _SPOKES
            i, j = x + round(ring * scale * math.cos(angle)), y + round(ring * scale * math.sin(angle))
            i, j = min(max(i, box[0]), box[2]), min(max(j, box[1]), box[3])
            if i < seen[0] or i > seen[2] or j < seen[1] or j > seen[3]:
                continue
            value, at = abs(response[j, i, p]), count
            while at > 0 and away[at - 1] > value:
                away[at] = away[at - 1]
                at -= 1
            away[at] = value
            count += 1
    return float(_SIGMA * 0.5 * (away[(count - 1) // 2] + away[count // 2])) if count else 0.0
