"""The grey level from which on samples are saturated, read from the picture."""

from __future__ import annotations

import numpy as np

from lumidock._kernels.compiling import part
from lumidock._kernels.detection.samples import Picture, value
from lumidock._kernels.detection.tiles import TILE_PX, Map
from lumidock.datatypes import Image

SATURATED = 250.0  # of 255, in a picture that uses them all
_LEAST_TOP = 160.0  # grey levels: nothing saturates lower
_FLAT_TILES, _PLATEAU, _ALIKE = 4, 6, 16  # tiles with so many samples that only saturation makes alike, or the same
_RIPPLE, _ENOUGH = 5.0, 400  # levels that compression leaves on them; tiles that are looked at


@part
def saturation(picture: Picture, known: Map) -> float:
    """The grey level from which on a sample is saturated: the usual, or where the brightest spots are flat below it.

    They are in video that does not use the whole range, at 235 of 255 for one. The level is where most of the tiles
    under the brightest have a plateau.
    """
    most, top, scale = 0, known.top, picture.scale
    for p in range(len(known.peak)):
        for i in range(known.peak.shape[1]):
            most = max(most, _largest(known.peak[p, i]))
    if scale * most < _LEAST_TOP:
        return SATURATED
    top[:], asked = 0, 0
    for p in range(len(known.peak)):
        for i in range(known.peak.shape[1]):
            row = known.peak[p, i]
            if scale * (most - _largest(row)) < len(top):
                for j in range(len(row)):
                    below = int(scale * (most - row[j]))
                    if below < len(top) and asked < _ENOUGH:
                        top[below] += _is_flat(picture, p, i, j, row[j])
                        asked += 1
    at = 0
    for k in range(len(top)):
        at = k if top[k] > top[at] else at
    return min(scale * most - at - _RIPPLE, SATURATED) if top[at] >= _FLAT_TILES else SATURATED


@part
def _is_flat(picture: Picture, p: int, i: int, j: int, most: int) -> bool:
    """Whether much of a tile is saturated if its largest sample is: noise and colour leave less of it alike.

    In a picture of one channel that many samples are exactly the largest, of three they nearly are in two channels.
    """
    count, channels, least = 0, 3 if picture.planes == 3 else 1, most - _RIPPLE / picture.scale
    for v in range(i * TILE_PX, min((i + 1) * TILE_PX, picture.height)):
        for u in range(j * TILE_PX, min((j + 1) * TILE_PX, picture.width)):
            if channels == 1:
                count += value(picture, v, u) == most
            elif value(picture, v, 3 * u + p) >= least:
                a, b = value(picture, v, 3 * u + (p + 1) % 3), value(picture, v, 3 * u + (p + 2) % 3)
                count += max(a, b) >= least
    return count >= (_PLATEAU if channels == 3 else _ALIKE)


@part
def _largest(row: Image) -> int:
    most = np.uint16(0)
    for j in range(len(row)):
        most = max(most, row[j])
    return int(most)
