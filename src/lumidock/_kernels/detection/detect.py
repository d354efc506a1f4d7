"""The search of the detector: candidate tiles in order of strength, each measured in its own window.

What is found goes to rows of `spots`, whose columns are named in `fields`.
"""

from __future__ import annotations

import numpy as np

from lumidock._kernels.compiling import entry, part
from lumidock._kernels.detection import fields, peaks, samples, tiles
from lumidock._kernels.detection.likelihood import dim_glints, dim_small_fry, lamp_probability, weigh_steadiness
from lumidock._kernels.detection.measure import measure
from lumidock._kernels.detection.patch import CloseUp
from lumidock._kernels.detection.samples import Picture
from lumidock._kernels.detection.saturation import saturation
from lumidock.datatypes import Array, Indices

SWEEP = 8  # frames in which a tracked search has seen everything
_DRIFT_PX = 20.0  # around a spot, in which it is looked for in the next frame
_MOST_WINDOWS = 0.25  # of the frame; for more a full search is cheaper
_MOST_SHARED = 6.0  # more is a texture
_NO_LIMIT = 1 << 16  # of a sample
_NO_CANDIDATE = 1 << 20  # more than there are
_OF_TILE = tiles.TILE_PX * tiles.TILE_PX
_LAST_OF_TILE = _OF_TILE - 1
_WHITE = _OF_TILE * 255  # nothing is brighter in 8 bits
_NONE = _STAY = 0
_STEP = 1  # along rows or columns
_SWEPT_STEP = 2  # of rows, in a tracked search's sweep: the smallest spot still has half its height


@entry
def see(
    picture: Picture,
    known: tiles.Map,
    close: CloseUp,
    part: int,
    expected: Array,
    before: int,
    since: tuple[float, bool],
    most: tuple[int, int],
    q: Array,
    rects: Indices,
    past: Array,
    spots: Array,
) -> tuple[int, bool]:
    """Write the spots of a frame to `spots` (N, COLUMNS), the strongest first.

    Looked at is all of the picture, with `part` -1; else the tiles around the `expected` places (n, 3) u, v, reach px,
    and around the spots of the frame before, which are the first `before` in `spots`, and the `part` of `SWEEP` of the
    rest; `rects` has room for a window each, and one, `past` (N, 4) for the spots before. `since`: how far, px, a lamp
    may have moved since that frame (0: nothing is known of it), and whether it was all looked at. `most`: candidates
    and measurements. Returns how many spots there are, and whether all was looked at, as where windows are much of it.
    """
    planes, (h, w), blocks = picture.planes, known.peak.shape[1:], len(known.sigma)
    count, whole = _NONE, part < 0
    for k in range(before):
        for c in range(past.shape[1]):
            past[k, c] = spots[k, c]
    first, last = part * blocks // SWEEP, (part + 1) * blocks // SWEEP
    if not whole:
        count = tiles.windows(expected, spots[:before], _DRIFT_PX, h, w, rects)
        rects[count, 0], rects[count, 1] = first * tiles.BLOCK, min(last * tiles.BLOCK, h)
        rects[count, 2], rects[count, 3] = 0, w
        whole = tiles.area(rects[: count + 1]) >= _MOST_WINDOWS * h * w
    if whole:
        count, first, last = _NONE, _NONE, blocks
        rects[0, 0], rects[0, 1], rects[0, 2], rects[0, 3] = 0, h, 0, w
    step = tiles.EVERY if whole else _SWEPT_STEP
    if picture.deep == 1:
        tiles.look(picture.rows, known.line, planes, (first, last), step, rects, count, known)
    else:
        wide, line = picture.rows.view(np.uint16), known.line.view(np.uint16)
        tiles.look(wide, line, planes, (first, last), step, rects, count, known)
    if whole or part == SWEEP - 1:
        q[fields.CLIPPED] = saturation(picture, known)
        tiles.settle(known, q[fields.MIN_NOISE] / picture.scale, 1.0 if planes == 4 else _MOST_SHARED)
    rects = rects[: count + 1]
    count = _candidates(picture, known, rects, most[0], q)
    tiles.clear(known.seen, rects)  # from here on: tiles of spots
    n = _measured(picture, known, close, count, most[1], q, spots)
    for k in range(n):
        spots[k, fields.P_LIGHT] = lamp_probability(spots[k], q)
    if since[0] > 0.0:
        weigh_steadiness(spots, n, past[:before], since[0], since[1])
    dim_glints(spots, n, q, known.queue[0])
    dim_small_fry(spots, n, q, known.queue[0])
    return n, whole


@part
def _candidates(picture: Picture, known: tiles.Map, rects: Indices, most: int, q: Array) -> int:
    """Write the tiles in `rects` (n, 4) that may hold a light's peak to `known.found`; returns how many."""
    peak, level, sigma, spread, found = known.peak, known.level, known.sigma, known.spread, known.found
    clipped, count = q[fields.CLIPPED] / picture.scale, _NONE
    contrast = q[fields.CONTRAST] * np.sqrt(samples.largest(known.shared))
    for p in range(len(peak)):
        tiles.clear(known.seen, rects)  # a tile may hold a light in one plane and noise in another
        for k in range(len(rects)):
            more = peaks.candidates(
                peak[p],
                level[p],
                sigma,
                spread[p],
                q[fields.SIGNAL_NOISE] / picture.scale,
                contrast,
                clipped,
                peak if picture.planes == 3 else peak[p : p + 1],
                rects[k],
                ((known.least[0], known.least[1]), known.worth),
                known.seen,
                found[count:],
            )
            found[count : count + more, 4] = p
            count += more
    return _most_outstanding(found, count, most, known.queue[0])


@part
def _measured(picture: Picture, known: tiles.Map, close: CloseUp, count: int, most: int, q: Array, spots: Array) -> int:
    """Measure the `count` candidates, the brightest first, until `most` are; returns how many spots there are."""
    planes, peak, seen, found = picture.planes, known.peak, known.seen, known.found
    clipped = int(q[fields.CLIPPED] / picture.scale)
    queue, waiting, at, n_waiting, n, work = known.queue[0], known.queue[1], _NONE, _NONE, _NONE, most
    _brightest_first(planes, peak, clipped, found, count, queue)
    while (at < count or n_waiting) and n < len(spots) and work > 0:
        ranked = n_waiting > 0 and (at == count or waiting[n_waiting - 1] < queue[at])
        k = int((waiting[n_waiting - 1] if ranked else queue[at]) % _NO_CANDIDATE)
        n_waiting, at = n_waiting - ranked, at + (not ranked)
        i, j, p = int(found[k, 0]), int(found[k, 1]), int(found[k, 4])
        if seen[i, j]:
            continue
        if not ranked:
            v, u, rank = _brightest(picture, p, i, j)
            found[k, 2], found[k, 3] = rank, v * picture.width + u
            if planes == 3 and peak[p, i, j] >= clipped:  # its place in the queue was the best that it could have
                n_waiting = _insert(waiting, n_waiting, k - _NO_CANDIDATE * float(rank))
                continue
        rank, v, u = int(found[k, 2]), int(found[k, 3]) // picture.width, int(found[k, 3]) % picture.width
        v, u, is_peak = _peak_pixel(picture, p, v, u, rank, peak[p, i, j] >= clipped, clipped)
        if not is_peak or seen[v // tiles.TILE_PX, u // tiles.TILE_PX]:
            continue
        noise = max(picture.scale * known.sigma[i // tiles.BLOCK, j // tiles.BLOCK], q[fields.MIN_NOISE])
        status = measure(picture, known, close, (i, j), v, u, p, noise, q, spots, n)
        work -= status >= 0
        n += status > 0
    return n


@part
def _most_outstanding(found: Array, count: int, most: int, scratch: Array) -> int:
    """Move the `most` candidates that stand out most to the front; returns how many there are."""
    if count <= most:
        return count
    for k in range(count):
        scratch[k] = found[k, 2]
    least, kept = tiles.select(scratch, count, count - most), 0
    for k in range(count):
        if found[k, 2] >= least and kept < most:
            for c in range(found.shape[1]):
                found[kept, c] = found[k, c]
            kept += 1
    return kept


@part
def _brightest_first(planes: int, peak: Array, clipped: int, found: Array, count: int, queue: Array) -> None:
    """Queue the candidates by their tile's largest value, the brightest first: number less `_NO_CANDIDATE` times that.

    Saturated ones of three channels by the highest rank that their brightest pixel may have: it tells a core from its
    halo.
    """
    for k in range(count):
        i, j, p = int(found[k, 0]), int(found[k, 1]), int(found[k, 4])
        rank = 1024.0 * peak[p, i, j]
        if planes == 3 and peak[p, i, j] >= clipped:
            rank += float(peak[0, i, j]) + float(peak[1, i, j]) + float(peak[2, i, j])
        queue[k] = k - _NO_CANDIDATE * rank
    gap = count // 2
    while gap > 0:  # Shell's sort
        for k in range(gap, count):
            value, m = queue[k], k
            while m >= gap and queue[m - gap] > value:
                queue[m] = queue[m - gap]
                m -= gap
            queue[m] = value
        gap = 1 if gap == 2 else int(gap / 2.2)


@part
def _insert(waiting: Array, count: int, value: float) -> int:
    """Insert into the first `count` values, of which the smallest is the last; returns the new count."""
    k = count
    while k > 0 and waiting[k - 1] < value:
        waiting[k] = waiting[k - 1]
        k -= 1
    waiting[k] = value
    return count + 1


@part
def _brightest(picture: Picture, p: int, i: int, j: int) -> tuple[int, int, int]:
    """Row, column and rank of a tile's brightest pixel of a map, the first of several."""
    top, left, step, mosaic = i * tiles.TILE_PX, j * tiles.TILE_PX, 1, picture.planes == 4
    right, best = min(left + tiles.TILE_PX, picture.width), -1
    for v in range(top, min(top + tiles.TILE_PX, picture.height)):
        if mosaic and p != 1 and v & 1 != p >> 1:
            continue
        first = left
        if mosaic:
            first, step = left + ((p - v) & 1), 2
        after = tiles.TILE_PX * (top - v) + left + _LAST_OF_TILE  # less for every pixel, so that the first wins
        if picture.deep == 1 and picture.planes != 3:
            line = picture.rows[v]
            for u in range(first, right, step):
                best = max(best, _OF_TILE * int(line[u]) + after - u)
            if best >= _WHITE:
                break
        else:
            for u in range(first, right, step):
                best = max(best, _OF_TILE * _rank(picture, p, v, u) + after - u)
    at = _LAST_OF_TILE - best % _OF_TILE
    return top + at // tiles.TILE_PX, left + at % tiles.TILE_PX, best // _OF_TILE


@part
def _peak_pixel(
    picture: Picture, p: int, row: int, column: int, best: int, saturated: bool, clipped: int
) -> tuple[int, int, bool]:
    """Row and column of the middle of the plateau that a tile's brightest pixel of a map, of rank `best`, stands on.

    And whether it is a peak: none next to it, beyond the tile, is brighter.
    """
    reach = 2 if picture.planes == 4 else 1
    for v in range(max(row - reach, 0), min(row + reach + 1, picture.height)):
        for u in range(max(column - reach, 0), min(column + reach + 1, picture.width)):
            if _rank(picture, p, v, u) > best:
                return row, column, False
    farthest = 64 if saturated else tiles.TILE_PX
    least, most, white = best, _NO_LIMIT, (1027 if picture.planes == 3 else 1) * clipped
    if _rank(picture, p, row, column, clipped) == white:
        # noise in what is clipped in every channel would cut the run short, and a core be measured from its rim
        least, most = white, clipped
    for _ in range(2):
        row = _middle_of_run(picture, p, row, column, _STEP, _STAY, least, most, farthest)
        column = _middle_of_run(picture, p, row, column, _STAY, _STEP, least, most, farthest)
    return row, column, best > 0


@part
def _middle_of_run(
    picture: Picture, p: int, v: int, u: int, dv: int, du: int, rank: int, most: int, farthest: int
) -> int:
    """Row or column in the middle of the run of pixels of at least this rank through a pixel, along one of both."""
    pitch, before, after = 2 if picture.planes == 4 else 1, 0, 0
    for sign in (-1, 1):
        k = pitch
        while k < farthest * pitch:
            y, x = v + sign * dv * k, u + sign * du * k
            inside = 0 <= y < picture.height and 0 <= x < picture.width
            if not inside or _rank(picture, p, y, x, most) < rank:
                break
            k += pitch
        before, after = after, sign * (k - pitch)
    return (v if dv else u) + (before + after) // (2 * pitch) * pitch


@part
def _rank(picture: Picture, p: int, v: int, u: int, most: int = _NO_LIMIT) -> int:
    """Order of a pixel in map `p`: by its value there, among equals by all channels, which tell a saturated core.

    Values over `most` count as it.
    """
    if picture.planes == 4 and (v & 1) + (u & 1) != p:
        return -1
    if picture.planes != 3:
        return min(samples.value(picture, v, u), most)
    rank = 1024 * min(samples.value(picture, v, 3 * u + p), most)
    for k in range(3):
        rank += min(samples.value(picture, v, 3 * u + k), most)
    return rank
