"""The parts of a frame that are searched, side by side in one picture, so that one filter call serves them all."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from lumidock._kernels.detection.blobs import (
    CORE_BOTTOM,
    CORE_LEFT,
    CORE_RIGHT,
    CORE_TOP,
    PATCH_COLUMNS,
    SEEN_BOTTOM,
    SEEN_LEFT,
    SEEN_RIGHT,
    SEEN_TOP,
)
from lumidock.datatypes import Array, Image, Indices

_LEAST_WIDTH_PX = 512  # of the picture; more where a part is wider


class Canvas(NamedTuple):
    """`levels` (H, W, P) of a pyramid of 2 x 2 means, the first of them level `base`, and its `patches`.

    Blobs are searched from level `first` on; finer ones serve to measure them. `patches` (N, PATCH_COLUMNS), columns of
    `blobs`: left, top, right and bottom on the canvas, u and v of the frame at its left top pixel, the core of the
    patch on the canvas, in which blobs count, and the part of it that is in the frame; all in pixels of level 0. The
    last `unsearched` of the patches serve to measure the noise; where there are none, all patches do.
    """

    base: int
    first: int
    levels: list[Array]
    patches: Indices
    unsearched: int = 0


def halved(image: Array) -> Array:
    """Means of 2 x 2 pixels (H, W, P) of a picture whose sides are even."""
    small = cv2.resize(image, (image.shape[1] // 2, image.shape[0] // 2), interpolation=cv2.INTER_AREA)
    return np.asarray(small.reshape(small.shape[0], small.shape[1], -1), np.float32)


def canvas(
    image: Image, given: int, cores: Indices, margin: int, levels: tuple[int, int], unsearched: int = 0
) -> Canvas:
    """Cut `cores` (N, 4: u0, v0, u1, v1) with `margin` px around them out of level `given` of a frame's pyramid.

    `levels` are the first and the last that are made; the last `unsearched` of the cores serve to measure the noise.
    Beyond the border the frame is mirrored.
    """
    base, top = levels
    pixel = 1 << top
    outer = np.empty((len(cores), 4), np.int64)
    outer[:, :2] = (cores[:, :2] - margin) // pixel * pixel
    outer[:, 2:] = -(-(cores[:, 2:] + margin) // pixel) * pixel
    patches, width, height = _packed(outer, cores)
    _mark_seen(patches, image.shape[1] << given, image.shape[0] << given)
    small = 1 << base
    planes = 3 if image.ndim == 3 else 1
    room = np.zeros((height // small, width // small, planes), np.float32)
    for box, patch in zip(outer >> given, patches >> base, strict=True):
        room[patch[1] : patch[3], patch[0] : patch[2]] = _cut(image, box, 1 << (base - given))
    if image.dtype == np.uint16:
        room *= np.float32(255.0 / 65535.0)
    pyramid = [room]
    for _ in range(base, top):
        pyramid.append(halved(pyramid[-1]))
    return Canvas(base, base, pyramid, patches, unsearched)


def _packed(outer: Indices, cores: Indices) -> tuple[Indices, int, int]:
    """Places of rectangles on shelves, the highest first; width and height of the canvas."""
    size = outer[:, 2:] - outer[:, :2]
    width = max(_LEAST_WIDTH_PX, int(size[:, 0].max(initial=0)))
    patches = np.zeros((len(outer), PATCH_COLUMNS), np.int64)
    x, y, shelf = 0, 0, 0
    for k in np.argsort(-size[:, 1], kind="stable"):
        w, h = (int(side) for side in size[k])
        if x + w > width:
            x, y, shelf = 0, y + shelf, 0
        shelf = max(shelf, h)
        patches[k, :6] = x, y, x + w, y + h, outer[k, 0], outer[k, 1]
        x += w
    shift = patches[:, :2] - outer[:, :2]
    patches[:, CORE_LEFT], patches[:, CORE_TOP] = (cores[:, :2] + shift).T
    patches[:, CORE_RIGHT], patches[:, CORE_BOTTOM] = (cores[:, 2:] + shift).T
    return patches, width, y + shelf


def _mark_seen(patches: Indices, width: int, height: int) -> None:
    """Write which part of each patch is in a frame of this size."""
    shift = patches[:, :2] - patches[:, 4:6]
    low, high = patches[:, :2], patches[:, 2:4]
    patches[:, [SEEN_LEFT, SEEN_TOP]] = np.maximum(low, shift)
    patches[:, [SEEN_RIGHT, SEEN_BOTTOM]] = np.minimum(high, shift + np.array([width, height]))


def _cut(image: Image, box: Indices, small: int) -> Image:
    """The pixels of a box (h, w, P), `small` of them along each side in one."""
    u0, v0, u1, v1 = (int(side) for side in box)
    height, width = image.shape[:2]
    part = image[max(v0, 0) : max(v1, 0), max(u0, 0) : max(u1, 0)]
    beyond = (max(-v0, 0), max(v1 - height, 0), max(-u0, 0), max(u1 - width, 0))
    if any(beyond):
        part = cv2.copyMakeBorder(part, *beyond, cv2.BORDER_REFLECT)
    if small > 1:
        shape = ((u1 - u0) // small, (v1 - v0) // small)
        part = cv2.resize(part, shape, interpolation=cv2.INTER_AREA)
    return np.asarray(part.reshape(part.shape[0], part.shape[1], -1))
