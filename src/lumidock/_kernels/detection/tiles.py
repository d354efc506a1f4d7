"""The one pass over a frame: largest value of every 8 x 8 tile, local background and noise, and windows of tiles.

Rows are (H, W * channels) of an unsigned type.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lumidock._kernels.compiling import part
from lumidock._kernels.detection import fields
from lumidock.datatypes import Array, Image, Indices

TILE_PX, BLOCK = 8, 8  # pixels a side of a tile, tiles a side of a block
_0, _1, _2, _3, _4, _5, _6, _7 = range(8)
EVERY = _1  # step of rows
SPARSE = 4  # one block in so many says how samples share their noise
TOPS = 24  # grey levels under the brightest, see `saturation`
_SIGMA = 0.5117  # of the mean absolute second difference of normal noise: sqrt(pi / 12)


class Map(NamedTuple):
    """What is known of a camera's tiles (h, w) and blocks (hb, wb), in P planes, and scratch.

    `peak` (P, h, w) largest values of the tiles; of the blocks `raw_level` (P, hb, wb), `raw_sigma` (hb, wb) and
    `by_plane` (2, P, hb, wb / 4), see `look`; from these `level`, `sigma`, `spread` (P,) and `shared` (4,), see
    `settle`. Scratch: `line` (3, n) bytes, n = 8 w times those of a pixel; `difference` (2, 8 w times the channels);
    `middle` (9, w), `ordered` (hb wb + 4,) and `top` (TOPS,); `least` (2, w) and `worth` (8 w,) of a row of tiles;
    `seen` (h, w); `found` (N, 5) and `queue` (2, N).
    """

    peak: Image
    raw_level: Image
    raw_sigma: Array
    by_plane: Array
    level: Array
    sigma: Array
    spread: Array
    shared: Array
    line: Image
    difference: NDArray[np.int32]
    middle: Image
    ordered: Array
    top: NDArray[np.int32]
    least: NDArray[np.int32]
    worth: Image
    seen: Image
    found: Array
    queue: Array


@part
def refresh(rows: Image, planes: int, rect: tuple[int, int, int, int], step: int, peak: Image, line: Image) -> None:
    """Write the largest values of each tile of `rect` into `peak` (P, h, w); `rect` is two rows and two columns.

    One map for mono; for `planes` 3 one for each channel; for a mosaic, `planes` 4, the corners of its 2 x 2 cell that
    stand on one diagonal are one map if they are alike, so that there are three: a light in one colour must not hide
    behind the background of another. Where the greens are the first and fourth corner, the maps mix colours, and lose
    only sharpness. Only every `step`th row is looked at, of a mosaic every `step`th pair. `line`: see `Map`.
    """
    channels = 3 if planes == 3 else 1
    left, right = rect[2] * TILE_PX * channels, min(rect[3] * TILE_PX * channels, rows.shape[1])
    n, padded = right - left, (rect[3] - rect[2]) * TILE_PX * channels
    even, odd, most = line[0, :padded], line[1, :padded], line[2, :padded]
    even[n:], odd[n:] = 0, 0
    for i in range(rect[0], rect[1]):
        top = i * TILE_PX
        if planes == 4:
            _max_of_four(rows, top, _0, step, left, even[:n])
            _max_of_four(rows, top, _1, step, left, odd[:n])
            a, b = peak[0, i, rect[2] : rect[3]], peak[1, i, rect[2] : rect[3]]
            c = peak[2, i, rect[2] : rect[3]]
            _largest_of_corner(even, 0, a)
            _largest_of_corner(even, 1, b)
            _largest_of_corner(odd, 0, c)
            for j in range(len(b)):
                b[j] = max(b[j], c[j])
            _largest_of_corner(odd, 1, c)
            continue
        if step == 1:
            _max_of_eight(rows, top, left, even[:n])
        else:
            _max_of_four(rows, top, _0, EVERY, left, even[:n])
        if channels == 1:
            _largest_of_tiles(even, peak[0, i, rect[2] : rect[3]])
        else:
            _largest_of_wide_tiles(even, most, peak, i, rect[2])


@part
def _row(rows: Image, top: int, k: int) -> int:
    """Row `k` of a tile, or one of its own kind where the picture ends before it."""
    return top + k if top + k < len(rows) else top + (k & 1 if top + 1 < len(rows) else 0)


@part
def _max_of_eight(rows: Image, top: int, left: int, line: Image) -> None:
    right = left + len(line)
    a, b = rows[top, left:right], rows[_row(rows, top, _1), left:right]
    c, d = rows[_row(rows, top, _2), left:right], rows[_row(rows, top, _3), left:right]
    e, f = rows[_row(rows, top, _4), left:right], rows[_row(rows, top, _5), left:right]
    g, h = rows[_row(rows, top, _6), left:right], rows[_row(rows, top, _7), left:right]
    for x in range(len(line)):
        line[x] = max(max(max(a[x], b[x]), max(c[x], d[x])), max(max(e[x], f[x]), max(g[x], h[x])))


@part
def _max_of_four(rows: Image, top: int, first: int, step: int, left: int, line: Image) -> None:
    """The larger of every second row of a tile from `first` on; of every fourth with `step` 2."""
    right = left + len(line)
    a, b = rows[_row(rows, top, first), left:right], rows[_row(rows, top, first + 4), left:right]
    if step == 2:
        for x in range(len(line)):
            line[x] = max(a[x], b[x])
        return
    c, d = rows[_row(rows, top, first + 2), left:right], rows[_row(rows, top, first + 6), left:right]
    for x in range(len(line)):
        line[x] = max(max(a[x], b[x]), max(c[x], d[x]))


@part
def _largest_of_tiles(line: Image, out: Image) -> None:
    for j in range(len(out)):
        largest = line[TILE_PX * j]
        for k in range(1, TILE_PX):
            largest = max(largest, line[TILE_PX * j + k])
        out[j] = largest


@part
def _largest_of_corner(line: Image, first: int, out: Image) -> None:
    """The largest of every second value of each tile."""
    for j in range(len(out)):
        x = TILE_PX * j + first
        out[j] = max(max(line[x], line[x + 2]), max(line[x + 4], line[x + 6]))


@part
def _largest_of_wide_tiles(line: Image, most: Image, peak: Image, i: int, left: int) -> None:
    """The same for three channels: the largest of eight pixels from each value on, in one run, then those of tiles."""
    n = len(line) - 21
    for x in range(n):
        a, b = max(line[x], line[x + 3]), max(line[x + 6], line[x + 9])
        c, d = max(line[x + 12], line[x + 15]), max(line[x + 18], line[x + 21])
        most[x] = max(max(a, b), max(c, d))
    tiles = len(line) // (3 * TILE_PX)
    a, b = peak[0, i, left : left + tiles], peak[1, i, left : left + tiles]
    c = peak[2, i, left : left + tiles]
    for j in range(tiles):
        x = 3 * TILE_PX * j
        a[j], b[j], c[j] = most[x], most[x + 1], most[x + 2]


@part
def look(
    rows: Image, line: Image, planes: int, blocks: tuple[int, int], step: int, rects: Indices, count: int, known: Map
) -> None:
    """Bring the rows of blocks from `blocks[0]` to `blocks[1]` up to date, and the first `count` windows `rects`.

    Of the rows of blocks by every `step`th row of pixels: `peak` of their tiles, and of blocks `raw_level`, the median
    of their tiles, `raw_sigma`, the noise of a sample, and `by_plane`, the noise of each plane, and what the sums of
    eight neighbours make of it over the root of eight: demosaicing and JPEG share noise. One row of pixels speaks for a
    row of blocks, by second differences, which no slope reaches, of every other pixel, which a mosaic does not. `line`:
    scratch in the type of `rows`, see `Map`.
    """
    peak = known.peak
    h, w = peak.shape[1:]
    for b in range(blocks[0], blocks[1]):
        refresh(rows, planes, (b * BLOCK, min((b + 1) * BLOCK, h), _0, w), step, peak, line)
        for p in range(len(peak)):
            _levels(peak[p], b, known.raw_level[p], known.middle)
        v = min(b * BLOCK * TILE_PX + 3 * TILE_PX, (len(rows) - 2) & -2)
        _noise(rows[v], rows[v + 1], planes, known.difference, known.raw_sigma[b], known.by_plane[:, :, b])
    for k in range(count):
        refresh(rows, planes, (rects[k, 0], rects[k, 1], rects[k, 2], rects[k, 3]), EVERY, peak, line)


@part
def clear(seen: Image, rects: Indices) -> None:
    """Forget that tiles of some windows `rects` (n, 4) were seen."""
    for k in range(len(rects)):
        for i in range(rects[k, 0], rects[k, 1]):
            seen[i, rects[k, 2] : rects[k, 3]] = 0


@part
def windows(expected: Array, before: Array, drift_px: float, h: int, w: int, rects: Indices) -> int:
    """Write the tiles, `rects` (n, 4), around the `expected` places (n, 3), u, v and reach px, and the spots `before`.

    A spot well inside a window gets none of its own. Returns how many there are.
    """
    count = 0
    for k in range(len(expected) + len(before)):
        if k < len(expected):
            u, v, reach = expected[k, 0], expected[k, 1], expected[k, 2]
        else:
            spot = before[k - len(expected)]
            u, v, reach = spot[fields.U], spot[fields.V], 2.0 * spot[fields.RADIUS] + drift_px
        top, bottom = _clip((v - reach) / TILE_PX, h), _clip((v + reach) / TILE_PX + 1.0, h)
        left, right = _clip((u - reach) / TILE_PX, w), _clip((u + reach) / TILE_PX + 1.0, w)
        known = top >= bottom or left >= right
        i, j = int(v) // TILE_PX, int(u) // TILE_PX
        for m in range(count):
            r = rects[m]
            known |= k >= len(expected) and r[0] < i < r[1] - 1 and r[2] < j < r[3] - 1
            known |= r[0] <= top and bottom <= r[1] and r[2] <= left and right <= r[3]
        if not known:
            rects[count, 0], rects[count, 1], rects[count, 2], rects[count, 3] = top, bottom, left, right
            count += 1
    return count


@part
def _clip(x: float, most: int) -> int:
    return int(min(max(x, 0.0), float(most)))


@part
def area(rects: Indices) -> int:
    """Tiles in all windows together, those in several counted as often."""
    total = 0
    for k in range(len(rects)):
        total += (rects[k, 1] - rects[k, 0]) * (rects[k, 3] - rects[k, 2])
    return total


@part
def _noise(even: Image, odd: Image, planes: int, difference: NDArray[np.int32], sigma: Array, by_plane: Array) -> None:
    """The noise of one row of blocks, from an even and, of a mosaic, an odd row of pixels, see `survey`.

    `difference` (2, W * channels) is scratch: second differences of either row.
    """
    channels = 3 if planes == 3 else 1
    n = min(BLOCK * TILE_PX * channels, len(even))
    step = 2 * channels
    _second_differences(even, step, difference[0])
    if planes == 4:
        _second_differences(odd, step, difference[1])
    for k in range(len(sigma)):
        low = max(min(k * BLOCK * TILE_PX * channels, len(even) - n), 0)
        last = low + n - 2 * step
        sigma[k] = _SIGMA * _mean(difference[0], low, last, _1)
        if k % SPARSE:
            continue
        for p in range(by_plane.shape[1]):
            if planes == 4:  # corners 0, 2 and 3 of the cell
                own = _mean(difference[1 if p else 0], (low & -2) + (p == 2), last, _2)
            else:
                own = _mean(difference[0], low + p, last, channels) if channels > 1 else sigma[k] / _SIGMA
                by_plane[1, p, k // SPARSE] = _SIGMA * _second_difference_of_sums(even[low + p : low + n : channels])
            by_plane[0, p, k // SPARSE] = _SIGMA * own


@part
def _second_differences(row: Image, step: int, out: NDArray[np.int32]) -> None:
    """Absolute second differences of samples `step` apart."""
    n = max(len(row) - 2 * step, 0)
    a, b, c, d = row[:n], row[step : n + step], row[2 * step :], out[:n]
    for x in range(n):
        d[x] = abs(np.int32(a[x]) - np.int32(2) * np.int32(b[x]) + np.int32(c[x]))


@part
def _mean(values: NDArray[np.int32], first: int, last: int, step: int) -> float:
    """Mean of every so many of `values`, 0 where there are none."""
    part = values[first : max(last, first)]
    total = 0
    if step == 1:
        for x in range(len(part)):
            total += part[x]
        return total / max(len(part), 1)
    for x in range(0, len(part), step):
        total += part[x]
    return total / max((len(part) + step - 1) // step, 1)


@part
def settle(known: Map, least: float, most: float) -> None:
    """Write what a frame's blocks say together.

    Smooth `level` and `sigma`, at `least` so much, and of each plane the `spread`, its noise over sigma, and how many
    times over, `shared`, noise averages out less than that of independent samples, up to `most`.
    """
    level, sigma, spread, shared, by_plane = known.level, known.sigma, known.spread, known.shared, known.by_plane
    for p in range(len(level)):
        _smoothed(known.raw_level[p], level[p], known.ordered)
    _smoothed(known.raw_sigma, sigma, known.ordered)
    for i in range(sigma.shape[0]):
        for j in range(sigma.shape[1]):
            sigma[i, j] = max(sigma[i, j], least)
    typical = _median(sigma[::2, ::2], known.ordered)
    for p in range(len(level)):
        own = _median(by_plane[0, p], known.ordered)
        spread[p] = min(max(own / typical, 0.3, least / typical), 3.0)  # less than a step of the sensor is none
        shared[p] = min(max((_median(by_plane[1, p], known.ordered) / max(own, 0.7 * least)) ** 2, 1.0), most)


@part
def _second_difference_of_sums(row: Image) -> float:
    """The same of sums of `TILE_PX` neighbours, over the root of their number."""
    count = len(row) // TILE_PX
    if count < 3:
        return 0.0
    total, first, second = 0.0, 0.0, 0.0
    for k in range(count):
        s = np.int32(0)
        for x in range(TILE_PX):
            s += np.int32(row[k * TILE_PX + x])
        if k > 1:
            total += abs(first - 2.0 * second + s)
        first, second = second, float(s)
    return total / ((count - 2) * np.sqrt(TILE_PX))


@part
def _median(values: Array, ordered: Array) -> float:
    """The median of `values` (m, n), which are put into `ordered`."""
    count = _0
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            ordered[count] = values[i, j]
            count += 1
    upper, lower = select(ordered, count, count // 2), -np.inf
    for k in range(count // 2):
        lower = max(lower, ordered[k])
    return upper if count % 2 else 0.5 * (lower + upper)


@part
def select(values: Array, count: int, k: int) -> float:
    """The value that would be at `k` if the first `count` were sorted; they change places (Hoare's selection)."""
    low, high = 0, count - 1
    while low < high:
        pivot, i, j = values[(low + high) // 2], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i, j = i + 1, j - 1
        if k <= j:
            high = j
        elif k >= i:
            low = i
        else:
            break
    return float(values[k])


@part
def _levels(peak: Image, b: int, level: Image, middle: Image) -> None:
    """Write the median of the tiles of each block of one row of blocks, row by row and then of those, to `level[b]`."""
    h, w = peak.shape
    i, last, columns = b * BLOCK, h - 1, middle[BLOCK, :w]
    _middle_of_eight(
        peak[i],
        peak[min(i + 1, last)],
        peak[min(i + 2, last)],
        peak[min(i + 3, last)],
        peak[min(i + 4, last)],
        peak[min(i + 5, last)],
        peak[min(i + 6, last)],
        peak[min(i + 7, last)],
        columns,
    )
    for k in range(BLOCK):
        for j in range(level.shape[1]):
            middle[k, j] = columns[min(j * BLOCK + k, w - 1)]
    r = middle
    _middle_of_eight(r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7], level[b])


@part
def _middle_of_eight(
    a: Image, b: Image, c: Image, d: Image, e: Image, f: Image, g: Image, h: Image, out: Image
) -> None:
    """Write the fifth smallest of each column of eight rows to `out`: of two sorted halves."""
    for x in range(len(out)):
        i, j, k, m = _sorted_four(a[x], b[x], c[x], d[x])
        p, q, r, s = _sorted_four(e[x], f[x], g[x], h[x])
        out[x] = min(min(max(i, s), max(j, r)), min(max(k, q), max(m, p)))


@part
def _sorted_four(a: float, b: float, c: float, d: float) -> tuple[float, float, float, float]:
    a, b, c, d = min(a, b), max(a, b), min(c, d), max(c, d)
    a, c, b, d = min(a, c), max(a, c), min(b, d), max(b, d)
    return a, min(b, c), max(b, c), d


@part
def _smoothed(values: Array, out: Array, middle: Array) -> None:
    """Write the median of five columns of the medians of five rows around each of `values` (h, w) to `out`.

    `middle`: scratch, four longer than a row.
    """
    h, w = values.shape
    for i in range(h):
        a, b = values[max(i - 2, 0)], values[max(i - 1, 0)]
        c, d, e = values[i], values[min(i + 1, h - 1)], values[min(i + 2, h - 1)]
        inner, row = middle[2 : w + 2], out[i]
        for j in range(w):
            inner[j] = _median_of_five(a[j], b[j], c[j], d[j], e[j])
        middle[:2], middle[w + 2 :] = middle[2], middle[w + 1]
        for j in range(w):
            row[j] = _median_of_five(middle[j], middle[j + 1], middle[j + 2], middle[j + 3], middle[j + 4])


@part
def _median_of_five(a: float, b: float, c: float, d: float, e: float) -> float:
    f, g = max(min(a, b), min(c, d)), min(max(a, b), max(c, d))
    return max(min(f, g), min(max(f, g), e))
