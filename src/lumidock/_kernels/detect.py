"""The search of the detector: candidate tiles in order of strength, each measured in its own window.

What is found goes to rows of `spots`, whose columns are named in `fields`.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lumidock._kernels import constant, fields, patch, peaks, tiles
from lumidock._kernels.likelihood import dim_glints, dim_small_fry, lamp_probability, weigh_steadiness
from lumidock._kernels.measure import measure
from lumidock.datatypes import Array, Image, Indices

SWEEP = 8  # frames in which a tracked search has seen everything
_DRIFT_PX = 20.0  # around a spot, in which it is looked for in the next frame
_MOST_WINDOWS = 0.25  # of the frame; for more a full search is cheaper
_MOST_SHARED = 6.0  # more is a texture
_NO_LIMIT = 1 << 16  # of a sample
_NO_CANDIDATE = 1 << 20  # more than there are
_STAY, _STEP = constant(0), constant(1)  # along rows or columns
_SWEPT_STEP = constant(2)  # of rows, in a tracked search's sweep: the smallest spot still has half its height


@njit(cache=True, error_model="numpy")
def see(
    image: Image,
    planes: int,
    scale: float,
    known: tiles.Map,
    part: int,
    expected: Array,
    before: int,
    since: tuple[float, bool],
    most: tuple[int, int],
    q: Array,
    spots: Array,
) -> tuple[int, bool]:
    """Write the spots of a frame to `spots` (N, COLUMNS), the strongest first.

    `image` (H, W, C); `planes` 1, 3 or, for a mosaic, 4; `scale` makes 8-bit levels of its samples. Looked at is all of
    it, with `part` -1; else the tiles around the `expected` places (n, 3) u, v, reach px, and around the spots of the
    frame before, which are the first `before` in `spots`, and the `part` of `SWEEP` of the rest. `since`: how far, px,
    a lamp may have moved since that frame (0: nothing is known of it), and whether it was all looked at. `most`:
    candidates and measurements. Returns how many spots there are, and whether all was looked at, as where windows are
    much of it.
    """
    rows, (h, w), blocks = image.reshape(len(image), -1), known.peak.shape[1:], len(known.sigma)
    rects = np.empty((len(expected) + before + 1, 4), np.int64)
    count, whole, past = 0, part < 0, spots[:before, : fields.FLUX + 1].copy()
    first, last = part * blocks // SWEEP, (part + 1) * blocks // SWEEP
    if not whole:
        count = tiles.windows(expected, spots[:before], _DRIFT_PX, h, w, rects)
        rects[count, 0], rects[count, 1] = first * tiles.BLOCK, min(last * tiles.BLOCK, h)
        rects[count, 2], rects[count, 3] = 0, w
        whole = tiles.area(rects[: count + 1]) >= _MOST_WINDOWS * h * w
    if whole:
        count, first, last = 0, 0, blocks
        rects[0, 0], rects[0, 1], rects[0, 2], rects[0, 3] = 0, h, 0, w
    tiles.survey(rows, planes, (first, last), tiles.EVERY if whole else _SWEPT_STEP, known)
    for k in range(count):
        tiles.refresh(rows, planes, rects[k], tiles.EVERY, known.peak, known.line)
    if whole or part == SWEEP - 1:
        tiles.settle(known, q[fields.MIN_NOISE] / scale, 1.0 if planes == 4 else _MOST_SHARED)
    return _search(image, planes, scale, known, rects[: count + 1], past, since, most, q, spots), whole


@njit(inline="always", error_model="numpy")
def _search(
    image: Image,
    planes: int,
    scale: float,
    known: tiles.Map,
    rects: Indices,
    past: Array,
    since: tuple[float, bool],
    most: tuple[int, int],
    q: Array,
    spots: Array,
) -> int:
    """Write the spots of the tiles in `rects` (n, 4) to `spots`, see `see`; returns how many."""
    peak, level, sigma, spread, shared_by_plane = known.peak, known.level, known.sigma, known.spread, known.shared
    seen, found = known.seen, known.found
    count = 0
    clipped = q[fields.CLIPPED] / scale
    contrast = q[fields.CONTRAST] * np.sqrt(shared_by_plane.max())
    for p in range(len(peak)):
        tiles.clear(seen, rects)  # a tile may hold a light in one plane and noise in another
        for k in range(len(rects)):
            more = peaks.candidates(
                peak[p],
                level[p],
                sigma,
                spread[p],
                q[fields.SIGNAL_NOISE] / scale,
                contrast,
                clipped,
                peak if planes == 3 else peak[p : p + 1],
                rects[k],
                seen,
                found[count:],
            )
            found[count : count + more, 4] = p
            count += more
    count = _most_outstanding(found, count, most[0])
    queue, waiting, at, n_waiting = _brightest_first(planes, peak, int(clipped), found, count), np.empty(count), 0, 0
    tiles.clear(seen, rects)  # from here on: tiles of spots
    n, work = 0, most[1]
    side = patch.SIDE + 16
    window = (
        np.empty((side, side)),
        np.zeros((side, side), np.int16),
        np.empty((side * side, 2), np.int32),
        np.empty(patch.SUMS),
    )
    while (at < count or n_waiting) and n < len(spots) and work > 0:
        ranked = n_waiting > 0 and (at == count or waiting[n_waiting - 1] < queue[at])
        k = int((waiting[n_waiting - 1] if ranked else queue[at]) % _NO_CANDIDATE)
        n_waiting, at = n_waiting - ranked, at + (not ranked)
        i, j, p = int(found[k, 0]), int(found[k, 1]), int(found[k, 4])
        if seen[i, j]:
            continue
        if not ranked:
            v, u, rank = _brightest(image, planes, p, i, j)
            found[k, 2], found[k, 3] = rank, v * image.shape[1] + u
            if planes == 3 and peak[p, i, j] >= clipped:  # its place in the queue was the best that it could have
                n_waiting = _insert(waiting, n_waiting, k - _NO_CANDIDATE * float(rank))
                continue
        rank, v, u = int(found[k, 2]), int(found[k, 3]) // image.shape[1], int(found[k, 3]) % image.shape[1]
        v, u, is_peak = _peak_pixel(image, planes, p, v, u, rank, peak[p, i, j] >= clipped, int(clipped))
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
    if since[0] > 0.0:
        weigh_steadiness(spots, n, past, *since)
    dim_glints(spots, n, q)
    dim_small_fry(spots, n, q)
    return n


@njit(error_model="numpy")
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


@njit(error_model="numpy")
def _brightest_first(planes: int, peak: Image, clipped: int, found: Array, count: int) -> Array:
    """The candidates by their tile's largest value, the brightest first: their number less `_NO_CANDIDATE` times that.

    Saturated ones of three channels by the highest rank that their brightest pixel may have: it tells a core from its
    halo.
    """
    queue = np.empty(count)
    for k in range(count):
        i, j, p = int(found[k, 0]), int(found[k, 1]), int(found[k, 4])
        rank = 1024.0 * peak[p, i, j]
        if planes == 3 and peak[p, i, j] >= clipped:
            rank += float(peak[0, i, j]) + float(peak[1, i, j]) + float(peak[2, i, j])
        queue[k] = k - _NO_CANDIDATE * rank
    return np.sort(queue)


@njit(error_model="numpy")
def _insert(waiting: Array, count: int, value: float) -> int:
    """Insert into the first `count` values, of which the smallest is the last; returns the new count."""
    k = count
    while k > 0 and waiting[k - 1] < value:
        waiting[k] = waiting[k - 1]
        k -= 1
    waiting[k] = value
    return count + 1


@njit(error_model="numpy")
def _brightest(image: Image, planes: int, p: int, i: int, j: int) -> tuple[int, int, int]:
    """Row, column and rank of a tile's brightest pixel of a map."""
    best, row, column = -1, 0, 0
    top, left = i * tiles.TILE_PX, j * tiles.TILE_PX
    step = 2 if planes == 4 else 1
    for v in range(top, min(top + tiles.TILE_PX, image.shape[0])):
        first = left + ((p - v) & 1 if planes == 4 else 0)
        if planes == 4 and p != 1 and v & 1 != p >> 1:
            continue
        line = image[v]
        for u in range(first, min(left + tiles.TILE_PX, image.shape[1]), step):
            rank = int(line[u, 0])
            if planes == 3:
                rank = 1024 * int(line[u, p]) + int(line[u, 0]) + int(line[u, 1]) + int(line[u, 2])
            if rank > best:
                best, row, column = rank, v, u
    return row, column, best


@njit(error_model="numpy")
def _peak_pixel(
    image: Image, planes: int, p: int, row: int, column: int, best: int, saturated: bool, clipped: int
) -> tuple[int, int, bool]:
    """Row and column of the middle of the plateau that a tile's brightest pixel of a map, of rank `best`, stands on.

    And whether it is a peak: none next to it, beyond the tile, is brighter.
    """
    reach = 2 if planes == 4 else 1
    for v in range(max(row - reach, 0), min(row + reach + 1, image.shape[0])):
        for u in range(max(column - reach, 0), min(column + reach + 1, image.shape[1])):
            if _rank(image, planes, p, v, u) > best:
                return row, column, False
    farthest = 64 if saturated else tiles.TILE_PX
    least, most, white = best, _NO_LIMIT, (1027 if planes == 3 else 1) * clipped
    if _rank(image, planes, p, row, column, clipped) == white:
        # noise in what is clipped in every channel would cut the run short, and a core be measured from its rim
        least, most = white, clipped
    for _ in range(2):
        row = _middle_of_run(image, planes, p, row, column, _STEP, _STAY, least, most, farthest)
        column = _middle_of_run(image, planes, p, row, column, _STAY, _STEP, least, most, farthest)
    return row, column, best > 0


@njit(error_model="numpy")
def _middle_of_run(
    image: Image, planes: int, p: int, v: int, u: int, dv: int, du: int, rank: int, most: int, farthest: int
) -> int:
    """Row or column in the middle of the run of pixels of at least this rank through a pixel, along one of both."""
    pitch = 2 if planes == 4 else 1
    ends = [0, 0]
    for side in range(2):
        sign = 1 if side else -1
        k = pitch
        while k < farthest * pitch:
            y, x = v + sign * dv * k, u + sign * du * k
            if not (0 <= y < image.shape[0] and 0 <= x < image.shape[1]) or _rank(image, planes, p, y, x, most) < rank:
                break
            k += pitch
        ends[side] = sign * (k - pitch)
    return (v if dv else u) + (ends[0] + ends[1]) // (2 * pitch) * pitch


@njit(error_model="numpy")
def _rank(image: Image, planes: int, p: int, v: int, u: int, most: int = _NO_LIMIT) -> int:
    """Order of a pixel in map `p`: by its value there, among equals by all channels, which tell a saturated core.

    Values over `most` count as it.
    """
    if planes == 4 and (v & 1) + (u & 1) != p:
        return -1
    if planes != 3:
        return min(int(image[v, u, 0]), most)
    rank = 1024 * min(int(image[v, u, p]), most)
    for k in range(3):
        rank += min(int(image[v, u, k]), most)
    return rank
