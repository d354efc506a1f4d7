"""The search of the detector: candidate tiles in order of strength, each measured in its own window.

What is found goes to rows of `spots`, whose columns are named in `fields`.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lumidock._kernels import fields, patch, tiles
from lumidock._kernels.likelihood import dim_glints, dim_small_fry, lamp_probability
from lumidock._kernels.measure import measure
from lumidock.datatypes import Array, Image, Indices


@njit(cache=True)
def search(
    image: Image,
    planes: int,
    scale: float,
    peak: Image,
    level: Array,
    sigma: Array,
    spread: Array,
    shared_by_plane: Array,
    rects: Indices,
    most: tuple[int, int],
    q: Array,
    seen: Image,
    found: Array,
    spots: Array,
) -> int:
    """Write the spots of the tiles in `rects` (n, 4) to `spots` (N, COLUMNS), the strongest first; returns how many.

    `image` (H, W, C); `planes` 1, 3 or, for a mosaic, 4; `scale` makes 8-bit levels of its samples. `peak` (P, h, w)
    of its tiles, `level` (P, h, w) and `sigma` (h, w) of its blocks in samples, `spread` (P,), see `tiles`. `most`:
    candidates and measurements.
    """
    count = 0
    clipped = q[fields.CLIPPED] / scale
    contrast = q[fields.CONTRAST] * np.sqrt(shared_by_plane.max())
    for p in range(len(peak)):
        seen[:] = 0  # a tile may hold a light in one plane and noise in another
        for k in range(len(rects)):
            more = tiles.candidates(
                peak[p], level[p], sigma, spread[p], contrast, clipped, rects[k], seen, found[count:]
            )
            found[count : count + more, 4] = p
            count += more
    count = _most_outstanding(found, count, most[0])
    order = _brightest_first(image, planes, peak, int(clipped), found, count)
    seen[:] = 0  # from here on: tiles of spots
    n, work = 0, most[1]
    side = patch.SIDE + 16
    window = (
        np.empty((side, side)),
        np.zeros((side, side), np.int16),
        np.empty((side * side, 2), np.int32),
        np.empty(12),
    )
    for k in order:
        if n == len(spots) or work <= 0:
            break
        i, j = int(found[k, 0]), int(found[k, 1])
        if seen[i, j]:
            continue
        p = int(found[k, 4])
        v, u, is_peak = _peak_pixel(image, planes, p, i, j, peak[p, i, j] >= clipped)
        if not is_peak or seen[v // tiles.TILE_PX, u // tiles.TILE_PX]:
            continue
        noise = max(scale * sigma[i // tiles.BLOCK, j // tiles.BLOCK], q[fields.MIN_NOISE])
        status = measure(
            image, planes, scale, peak, i, j, v, u, p, level, noise, shared_by_plane, q, window, seen, spots, n
        )
        work -= status >= 0
        n += status > 0
    for k in range(n):
        spots[k, fields.P_LIGHT] = lamp_probability(spots[k], q)
    dim_glints(spots, n, q)
    dim_small_fry(spots, n, q)
    return n


@njit(cache=True)
def _most_outstanding(found: Array, count: int, most: int) -> int:
    """Move the `most` candidates that stand out most to the front; returns how many there are."""
    if count <= most:
        return count
    least = np.sort(found[:count, 2])[count - most]
    kept = 0
    for k in range(count):
        if found[k, 2] >= least and kept < most:
            found[kept] = found[k]
            kept += 1
    return kept


@njit(cache=True)
def _brightest_first(image: Image, planes: int, peak: Image, clipped: int, found: Array, count: int) -> Indices:
    """Order of the candidates by their tile's largest value; saturated ones by all channels of their brightest pixel.

    For these the other channels tell the core from its halo.
    """
    key = np.empty(count)
    for k in range(count):
        i, j, p = int(found[k, 0]), int(found[k, 1]), int(found[k, 4])
        key[k] = -1024.0 * peak[p, i, j]
        if planes == 3 and peak[p, i, j] >= clipped:
            key[k] = -_brightest(image, planes, p, i, j)[2]
    return np.argsort(key, kind="mergesort")


@njit(cache=True)
def _brightest(image: Image, planes: int, p: int, i: int, j: int) -> tuple[int, int, int]:
    """Row, column and rank of a tile's brightest pixel of a map."""
    best, row, column = -1, 0, 0
    top, left = i * tiles.TILE_PX, j * tiles.TILE_PX
    for v in range(top, min(top + tiles.TILE_PX, image.shape[0])):
        for u in range(left, min(left + tiles.TILE_PX, image.shape[1])):
            rank = _rank(image, planes, p, v, u)
            if rank > best:
                best, row, column = rank, v, u
    return row, column, best


@njit(cache=True)
def _peak_pixel(image: Image, planes: int, p: int, i: int, j: int, saturated: bool) -> tuple[int, int, bool]:
    """Row and column of a tile's brightest pixel of a map, on a plateau of its middle.

    And whether it is a peak: none next to it, beyond the tile, is brighter.
    """
    row, column, best = _brightest(image, planes, p, i, j)
    reach = 2 if planes == 4 else 1
    for v in range(max(row - reach, 0), min(row + reach + 1, image.shape[0])):
        for u in range(max(column - reach, 0), min(column + reach + 1, image.shape[1])):
            if _rank(image, planes, p, v, u) > best:
                return row, column, False
    farthest = 64 if saturated else tiles.TILE_PX
    for _ in range(2):
        row = _middle_of_run(image, planes, p, row, column, 1, 0, best, farthest)
        column = _middle_of_run(image, planes, p, row, column, 0, 1, best, farthest)
    return row, column, best > 0


@njit(cache=True)
def _middle_of_run(
    image: Image, planes: int, p: int, v: int, u: int, dv: int, du: int, rank: int, farthest: int
) -> int:
    """Row or column in the middle of the run of pixels of at least this rank through a pixel, along one of both."""
    pitch = 2 if planes == 4 else 1
    ends = [0, 0]
    for side in range(2):
        sign = 1 if side else -1
        k = pitch
        while k < farthest * pitch:
            y, x = v + sign * dv * k, u + sign * du * k
            if not (0 <= y < image.shape[0] and 0 <= x < image.shape[1]) or _rank(image, planes, p, y, x) < rank:
                break
            k += pitch
        ends[side] = sign * (k - pitch)
    return (v if dv else u) + (ends[0] + ends[1]) // (2 * pitch) * pitch


@njit(cache=True)
def _rank(image: Image, planes: int, p: int, v: int, u: int) -> int:
    """Order of a pixel in map `p`: by its value there, among equals by all channels, which tell a saturated core."""
    if planes == 1:
        return int(image[v, u, 0])
    if planes == 4:
        return int(image[v, u, 0]) if (v & 1) + (u & 1) == p else -1
    return 1024 * int(image[v, u, p]) + int(image[v, u, 0]) + int(image[v, u, 1]) + int(image[v, u, 2])
