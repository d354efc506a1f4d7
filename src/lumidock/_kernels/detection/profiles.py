"""What surrounds a blob: rings of samples in every plane around its centroid."""

from __future__ import annotations

import math

import numpy as np

from lumidock._kernels.compiling import entry, part
from lumidock._kernels.detection.blobs import LEVEL, PATCH, SCALE, limits, seen_limits
from lumidock._kernels.detection.centroid import mirrored, plane_value
from lumidock.datatypes import Array, Indices

STEP, RINGS, SPOKES = 0.5, 13, 16  # rings every half standard deviation of the filter out to six, 16 samples each
MEAN, SPREAD, MOST = range(3)


@entry
def rings(image: Array, patches: Indices, level: int, blobs: Array, xy: Array, out: Array) -> None:
    """Write mean, standard deviation and largest sample of the rings around the blobs of one level of the pyramid.

    `image` (H, W, P), `xy` (N, 2) centroids in level pixels, `out` (N, 3, P, RINGS). Samples beyond the frame do not
    count: there a lamp at the border has its mirror image.
    """
    for n in range(len(blobs)):
        if int(blobs[n, LEVEL]) != level:
            continue
        patch, pixel = patches[int(blobs[n, PATCH])], 1 << level
        box, seen = limits(patch, pixel), seen_limits(patch, pixel)
        for k in range(RINGS):
            for p in range(out.shape[2]):
                total, squares, most, count = 0.0, 0.0, -np.inf, 0
                for i in range(SPOKES):
                    angle = 2.0 * math.pi * (i + 0.5 * (k % 2)) / SPOKES
                    x = xy[n, 0] + k * STEP * blobs[n, SCALE] * math.cos(angle)
                    y = xy[n, 1] + k * STEP * blobs[n, SCALE] * math.sin(angle)
                    if k > 0 and not (seen[0] <= x <= seen[2] and seen[1] <= y <= seen[3]):
                        continue
                    sample = _sample(image, p, x, y, box)
                    count += 1
                    total += sample
                    squares += sample * sample
                    most = max(most, sample)
                if count == 0:  # a ring that is beyond the frame is as the one within
                    out[n, :, p, k] = out[n, :, p, k - 1]
                    continue
                mean = total / count
                out[n, MEAN, p, k] = mean
                out[n, SPREAD, p, k] = math.sqrt(max(squares / count - mean * mean, 0.0))
                out[n, MOST, p, k] = most


@part
def _sample(image: Array, p: int, x: float, y: float, box: tuple[int, int, int, int]) -> float:
    """Bilinear; mirrored beyond the box."""
    i, j = math.floor(x), math.floor(y)
    a, b = x - i, y - j
    i0, i1 = mirrored(i, box[0], box[2]), mirrored(i + 1, box[0], box[2])
    j0, j1 = mirrored(j, box[1], box[3]), mirrored(j + 1, box[1], box[3])
    upper = (1.0 - a) * plane_value(image, p, j0, i0) + a * plane_value(image, p, j0, i1)
    lower = (1.0 - a) * plane_value(image, p, j1, i0) + a * plane_value(image, p, j1, i1)
    return (1.0 - b) * upper + b * lower
