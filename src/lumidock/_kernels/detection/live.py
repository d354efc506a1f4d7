"""Where a frame is searched at full resolution: tiles whose brightest pixels stand out of their surroundings."""

from __future__ import annotations

import cv2
import numpy as np

from lumidock._kernels.compiling import entry
from lumidock.datatypes import Array, Image, Indices

TILE_PX = 8
_SIGMA = 1.4826  # standard deviation of a Gaussian over its median absolute deviation
_MEAN, _MOST = 1.42, 0.95  # the same over its mean absolute deviation without the largest twentieth
_SAMPLES = 8192  # tiles whose deviation is that of the frame
_AROUND = 5  # tiles along each side of the square whose median is the surroundings; the largest of cv2 for float32


def halvings(image: Image, count: int) -> list[Image]:
    """The frame, and means of 2 x 2 of its pixels, of those and so on; an odd last row or column is left out."""
    pyramid = [image]
    for _ in range(count):
        height, width = (side // 2 for side in pyramid[-1].shape[:2])
        even = pyramid[-1][: 2 * height, : 2 * width]
        pyramid.append(np.asarray(cv2.resize(even, (width, height), interpolation=cv2.INTER_AREA)))
    return pyramid


def cores(image: Image, half: Image, sigmas: float, clear: float, least: float) -> Indices:
    """Boxes (N, 4) u0, v0, u1, v1 px around the live tiles of a frame (H, W[, P]), whose half size is given too.

    A tile is live when the largest mean of 4 x 4 of its pixels exceeds the median of the tiles around by `sigmas` of
    the whole frame's tiles and by `clear` of those around, in any plane. `least` is the least such sigma, grey levels.
    """
    height, width = image.shape[:2]
    h, w = half.shape[0] // 4, half.shape[1] // 4
    planes = 1 if half.ndim == 2 else half.shape[2]
    peak = np.empty((planes, h, w), np.float32)
    peaks(half.reshape(len(half), -1), planes, np.empty((2, half.shape[1] * planes), np.float32), peak)
    if half.dtype == np.uint16:
        peak *= np.float32(255.0 / 65535.0)
    live = np.zeros((h, w), bool)
    for p in range(planes):
        live |= _stands_out(peak[p], sigmas, clear, least)
    wide = cv2.dilate(live.astype(np.uint8), np.ones((3, 3), np.uint8))
    boxes = np.asarray(cv2.connectedComponentsWithStats(wide, connectivity=8)[2][1:, :4], np.int64)
    found = TILE_PX * np.column_stack([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]])
    found[found[:, 2] == TILE_PX * w, 2] = width
    found[found[:, 3] == TILE_PX * h, 3] = height
    return found


def _stands_out(peak: Array, sigmas: float, clear: float, least: float) -> Array:
    over = peak - cv2.medianBlur(peak, _AROUND)
    away = np.abs(over)
    sample = np.sort(away.reshape(-1)[:: 1 + away.size // _SAMPLES])
    sigma = max(_MEAN * float(sample[: int(_MOST * len(sample)) + 1].mean()), least)
    return np.asarray(over > np.maximum(sigmas * sigma, clear * _SIGMA * cv2.medianBlur(away, _AROUND)))


@entry
def peaks(half: Image, planes: int, scratch: Array, peak: Array) -> None:
    """Write the largest mean of 2 x 2 in each tile of 4 x 4 pixels of a picture (H, W * P) to `peak` (P, h, w)."""
    n, (_, h, w) = half.shape[1], peak.shape
    pair, most = scratch[0], scratch[1]
    for i in range(h):
        most[:] = 0.0
        for v in range(4 * i, 4 * i + 4):
            below = min(v + 1, len(half) - 1)
            for x in range(n):
                pair[x] = np.float32(half[v, x]) + np.float32(half[below, x])
            for x in range(n - planes):
                most[x] = max(most[x], pair[x] + pair[x + planes])
        for j in range(w):
            for p in range(planes):
                a = np.float32(0.0)
                for k in range(4):
                    a = max(a, most[(4 * j + k) * planes + p])
                peak[p, i, j] = np.float32(0.25) * a
