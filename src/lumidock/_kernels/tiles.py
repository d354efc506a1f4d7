"""The one pass over a frame: largest value of every 8 x 8 tile, local noise, and the tiles worth a closer look.

Rows are (H, W * channels) of an unsigned type.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lumidock.datatypes import Array, Image, Indices

TILE_PX, BLOCK = 8, 8  # pixels a side of a tile, tiles a side of a block
SPARSE = 4  # one block in so many says how samples share their noise
_FAR = 4  # tiles at which the slopes of a wide light show
_SIGMA = 0.5117  # of the mean absolute second difference of normal noise: sqrt(pi / 12)


@njit(cache=True)
def refresh(rows: Image, planes: int, rect: Indices, peak: Image, line: Image) -> None:
    """Write the largest values of each tile of `rect` into `peak` (P, h, w); `rect` is two rows and two columns.

    One map for mono; for `planes` 3 one for each channel; for a mosaic, `planes` 4, the corners of its 2 x 2 cell that
    stand on one diagonal are one map if they are alike, so that there are three: a light in one colour must not hide
    behind the background of another. `line` (2, n) is scratch, n = (W + 16) times the channels.
    """
    height = len(rows)
    channels = 3 if planes == 3 else 1
    span = TILE_PX * channels
    left, right = rect[2] * span, min(rect[3] * span, rows.shape[1])
    n, padded = right - left, (rect[3] - rect[2]) * span
    for i in range(rect[0], rect[1]):
        part = rows[i * TILE_PX : min((i + 1) * TILE_PX, height), left:right]
        line[:, n:padded] = 0
        if planes == 4:
            _max_of_rows(part[0::2], line[0, :n])
            _max_of_rows(part[1::2] if len(part) > 1 else part, line[1, :n])
            _largest_of_mosaic(line[0, :padded], line[1, :padded], peak[:, i, rect[2] : rect[3]])
            continue
        if len(part) == TILE_PX:
            _max_of_eight(part, line[0, :n])
        else:
            _max_of_rows(part, line[0, :n])
        if channels == 1:
            _largest_of_tiles(line[0, :padded], peak[0, i, rect[2] : rect[3]])
        else:
            _largest_of_wide_tiles(line[0, :padded], line[1, :padded], peak[:, i, rect[2] : rect[3]])


@njit(cache=True)
def _max_of_eight(r: Image, line: Image) -> None:
    a, b, c, d, e, f, g, h = r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7]
    for x in range(len(line)):
        line[x] = max(max(max(a[x], b[x]), max(c[x], d[x])), max(max(e[x], f[x]), max(g[x], h[x])))


@njit(cache=True)
def _max_of_rows(rows: Image, line: Image) -> None:
    if len(rows) == 4:
        a, b, c, d = rows[0], rows[1], rows[2], rows[3]
        for x in range(len(line)):
            line[x] = max(max(a[x], b[x]), max(c[x], d[x]))
        return
    line[:] = rows[0]
    for v in range(1, len(rows)):
        _larger(line, rows[v], line)


@njit(cache=True)
def _larger(a: Image, b: Image, out: Image) -> None:
    for x in range(len(out)):
        out[x] = max(a[x], b[x])


@njit(cache=True)
def _largest_of_tiles(line: Image, out: Image) -> None:
    for j in range(len(out)):
        highest = line[TILE_PX * j]
        for k in range(1, TILE_PX):
            value = line[TILE_PX * j + k]
            highest = value if value > highest else highest
        out[j] = highest


@njit(cache=True)
def _largest_of_mosaic(even: Image, odd: Image, out: Image) -> None:
    """The largest of the four corners of a cell, the second and third as one: the greens of most mosaics.

    Where the greens are the first and fourth, the maps mix colours, and lose only sharpness.
    """
    for j in range(out.shape[1]):
        x = TILE_PX * j
        out[0, j] = max(max(even[x], even[x + 2]), max(even[x + 4], even[x + 6]))
        a = max(max(even[x + 1], even[x + 3]), max(even[x + 5], even[x + 7]))
        b = max(max(odd[x], odd[x + 2]), max(odd[x + 4], odd[x + 6]))
        out[1, j] = max(a, b)
        out[2, j] = max(max(odd[x + 1], odd[x + 3]), max(odd[x + 5], odd[x + 7]))


@njit(cache=True)
def _largest_of_wide_tiles(line: Image, scratch: Image, out: Image) -> None:
    """The same for three channels: each halving is one run along the whole line."""
    n = len(line) - 12
    _larger(line[:n], line[12:], scratch[:n])
    _larger(scratch[: n - 6], scratch[6:n], line[: n - 6])
    _larger(line[: n - 9], line[3 : n - 6], scratch[: n - 9])
    for j in range(out.shape[1]):
        x = 3 * TILE_PX * j
        out[0, j], out[1, j], out[2, j] = scratch[x], scratch[x + 1], scratch[x + 2]


@njit(cache=True)
def survey(
    rows: Image,
    planes: int,
    blocks: tuple[int, int],
    peak: Image,
    line: Image,
    level: Image,
    sigma: Array,
    by_plane: Array,
) -> None:
    """Bring the rows of blocks from `blocks[0]` to `blocks[1]` up to date.

    That is `peak` of their tiles (P, h, w), and of blocks
    `level` (P, h, w), the median of their tiles, `sigma` (h, w), the noise of a sample, and `by_plane` (2, P, h, w /
    4).

    That is the noise of each plane, and what the sums of eight neighbours make of it over the root of eight:
    demosaicing and JPEG share noise. One row of pixels speaks for a row of blocks, by second differences, which no
    slope reaches, of every other pixel, which a mosaic does not.
    """
    rect = np.array([0, 0, 0, peak.shape[2]])
    difference = np.zeros((2, rows.shape[1]), np.int32)
    for b in range(blocks[0], blocks[1]):
        rect[0], rect[1] = b * BLOCK, min((b + 1) * BLOCK, peak.shape[1])
        refresh(rows, planes, rect, peak, line)
        for p in range(len(peak)):
            _levels(peak[p], b, level[p])
        v = min(b * BLOCK * TILE_PX + 3 * TILE_PX, (len(rows) - 2) & -2)
        _noise(rows[v], rows[v + 1], planes, difference, sigma[b], by_plane[:, :, b])


@njit(cache=True)
def revisit(rows: Image, planes: int, rects: Indices, peak: Image, line: Image) -> None:
    """Bring the tiles of some windows `rects` (n, 4) up to date."""
    for k in range(len(rects)):
        refresh(rows, planes, rects[k], peak, line)


@njit(cache=True)
def windows(expected: Array, seen: Array, drift_px: float, h: int, w: int, rects: Indices) -> int:
    """Write the tiles, `rects` (n, 4), around the `expected` places (n, 3), u, v and reach px, and those `seen` last.

    Of these u, v and radius; what lies in a window already gets none of its own. Returns how many there are.
    """
    count = 0
    for k in range(len(expected) + len(seen)):
        if k < len(expected):
            u, v, reach = expected[k, 0], expected[k, 1], expected[k, 2]
        else:
            u, v = seen[k - len(expected), 0], seen[k - len(expected), 1]
            reach = 2.0 * seen[k - len(expected), 2] + drift_px
        top, bottom = _clip((v - reach) / TILE_PX, h), _clip((v + reach) / TILE_PX + 1.0, h)
        left, right = _clip((u - reach) / TILE_PX, w), _clip((u + reach) / TILE_PX + 1.0, w)
        known = top >= bottom or left >= right
        for m in range(count):
            r = rects[m]
            known |= r[0] <= top and bottom <= r[1] and r[2] <= left and right <= r[3]
        if not known:
            rects[count, 0], rects[count, 1], rects[count, 2], rects[count, 3] = top, bottom, left, right
            count += 1
    return count


@njit(cache=True)
def _clip(x: float, most: int) -> int:
    return int(min(max(x, 0.0), float(most)))


@njit(cache=True)
def area(rects: Indices) -> int:
    """Tiles in all windows together, those in several counted as often."""
    total = 0
    for k in range(len(rects)):
        total += (rects[k, 1] - rects[k, 0]) * (rects[k, 3] - rects[k, 2])
    return total


@njit(cache=True)
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
        sigma[k] = _SIGMA * _mean(difference[0], low, last, 1)
        if k % SPARSE:
            continue
        for p in range(by_plane.shape[1]):
            if planes == 4:  # corners 0, 2 and 3 of the cell
                own = _mean(difference[1 if p else 0], (low & -2) + (p == 2), last, 2)
            else:
                own = _mean(difference[0], low + p, last, channels) if channels > 1 else sigma[k] / _SIGMA
                by_plane[1, p, k // SPARSE] = _SIGMA * _second_difference_of_sums(even[low + p : low + n : channels])
            by_plane[0, p, k // SPARSE] = _SIGMA * own


@njit(cache=True)
def _second_differences(row: Image, step: int, out: NDArray[np.int32]) -> None:
    """Absolute second differences of samples `step` apart."""
    n = max(len(row) - 2 * step, 0)
    a, b, c, d = row[:n], row[step : n + step], row[2 * step :], out[:n]
    for x in range(n):
        d[x] = abs(np.int32(a[x]) - np.int32(2) * np.int32(b[x]) + np.int32(c[x]))


@njit(cache=True)
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


@njit(cache=True)
def settle(
    raw_level: Image,
    raw_sigma: Array,
    by_plane: Array,
    least: float,
    most: float,
    level: Array,
    sigma: Array,
    spread: Array,
    shared: Array,
) -> None:
    """Write what a frame's blocks say together.

    Smooth `level` and `sigma`, and of each plane the `spread`, its noise over sigma,
    and how many times over, `shared` (4,), noise averages out less than that of independent samples, up to `most`.
    """
    for p in range(len(level)):
        _smoothed(raw_level[p], level[p])
    _smoothed(raw_sigma, sigma)
    for i in range(sigma.shape[0]):
        for j in range(sigma.shape[1]):
            sigma[i, j] = max(sigma[i, j], least)
    typical = np.median(sigma[::2, ::2].copy())
    for p in range(len(level)):
        own = np.median(by_plane[0, p].copy())
        spread[p] = min(max(own / typical, 0.3, least / typical), 3.0)  # less than a step of the sensor is none
        shared[p] = min(max((np.median(by_plane[1, p].copy()) / max(own, 0.7 * least)) ** 2, 1.0), most)


@njit(cache=True)
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


@njit(cache=True)
def _levels(peak: Image, b: int, level: Image) -> None:
    """Write the median of the tiles of each block of one row of blocks, row by row and then of those, to `level[b]`."""
    h, w = peak.shape
    i = b * BLOCK
    columns, rows = np.empty(w, peak.dtype), np.empty((BLOCK, level.shape[1]), peak.dtype)
    if i + BLOCK <= h:
        _middle_of_eight(peak[i : i + BLOCK], columns)
    else:
        last = np.empty((BLOCK, w), peak.dtype)
        for k in range(BLOCK):
            last[k] = peak[min(i + k, h - 1)]
        _middle_of_eight(last, columns)
    for j in range(level.shape[1]):
        for k in range(BLOCK):
            rows[k, j] = columns[min(j * BLOCK + k, w - 1)]
    _middle_of_eight(rows, level[b])


@njit(cache=True)
def _middle_of_eight(r: Image, out: Image) -> None:
    """Write the fifth smallest of each column of `r` (8, n) to `out`: of two sorted halves."""
    for x in range(len(out)):
        a, b, c, d = _sorted_four(r[0, x], r[1, x], r[2, x], r[3, x])
        e, f, g, h = _sorted_four(r[4, x], r[5, x], r[6, x], r[7, x])
        out[x] = min(min(max(a, h), max(b, g)), min(max(c, f), max(d, e)))


@njit(cache=True)
def _sorted_four(a: float, b: float, c: float, d: float) -> tuple[float, float, float, float]:
    a, b, c, d = min(a, b), max(a, b), min(c, d), max(c, d)
    a, c, b, d = min(a, c), max(a, c), min(b, d), max(b, d)
    return a, min(b, c), max(b, c), d


@njit(cache=True)
def _smoothed(values: Array, out: Array) -> None:
    """Write the median of five columns of the medians of five rows around each of `values` (h, w) to `out`."""
    h, w = values.shape
    middle = np.empty(w + 4, np.float32)
    for i in range(h):
        a, b = values[max(i - 2, 0)], values[max(i - 1, 0)]
        c, d, e = values[i], values[min(i + 1, h - 1)], values[min(i + 2, h - 1)]
        inner, row = middle[2 : w + 2], out[i]
        for j in range(w):
            inner[j] = _median_of_five(a[j], b[j], c[j], d[j], e[j])
        middle[:2], middle[w + 2 :] = middle[2], middle[w + 1]
        for j in range(w):
            row[j] = _median_of_five(middle[j], middle[j + 1], middle[j + 2], middle[j + 3], middle[j + 4])


@njit(cache=True)
def _median_of_five(a: float, b: float, c: float, d: float, e: float) -> float:
    f, g = max(min(a, b), min(c, d)), min(max(a, b), max(c, d))
    return max(min(f, g), min(max(f, g), e))


@njit(cache=True)
def candidates(
    peak: Image,
    level: Array,
    sigma: Array,
    spread: float,
    contrast: float,
    clipped: float,
    rect: Indices,
    seen: Image,
    found: Array,
) -> int:
    """Write the tiles of `rect` that may hold a light's peak to `found`: row, column, sigmas over the background.

    Of one plane: `peak` (h, w), `level` of its blocks, and `spread` times `sigma` for its noise. Such a tile clears its
    background by `contrast` sigmas; no two neighbours on opposite sides are brighter together, as on a slope, and next
    to it or a few tiles away they are darker by a margin, as on a halo they are not. Tiles that are `seen` (h, w) are
    left out, and the others become it. Returns how many there are.
    """
    count, least, worth = 0, np.empty(peak.shape[1], peak.dtype), np.empty(peak.shape[1], np.uint8)
    for i in range(rect[0], rect[1]):
        b = i // BLOCK
        if i == rect[0] or i % BLOCK == 0:
            for k in range(rect[2] // BLOCK, (rect[3] + BLOCK - 1) // BLOCK):
                value = min(np.ceil(level[b, k] + contrast * spread * sigma[b, k]), clipped)
                for j in range(max(k * BLOCK, rect[2]), min((k + 1) * BLOCK, rect[3])):
                    least[j] = value
        if not _worth_a_look(peak[i], least, rect[2], rect[3], worth):
            continue
        for j in range(rect[2], rect[3]):
            if not worth[j] or seen[i, j] or count == len(found):
                continue
            here = spread * sigma[b, j // BLOCK]
            if not _stands_out(peak, i, j, max(int(1.5 * contrast * here), 2), int(clipped)):
                continue
            seen[i, j] = 1
            found[count, 0], found[count, 1] = i, j
            found[count, 2] = (peak[i, j] - level[b, j // BLOCK]) / here
            count += 1
    return count


@njit(cache=True)
def _worth_a_look(row: Image, least: Image, first: int, last: int, worth: Image) -> bool:
    """Mark the tiles of a part of a row that reach the `least` value and stand on no slope along it; whether any."""
    here, limit, mark = row[first:last], least[first:last], worth[first:last]
    total = 0
    for x in range(len(here)):
        mark[x] = here[x] >= limit[x]
        total += mark[x]
    if total == 0:
        return False
    left, middle, right, inner = here[:-2], here[1:-1], here[2:], mark[1:-1]
    for x in range(len(inner)):
        inner[x] &= 2 * np.int32(middle[x]) >= np.int32(left[x]) + np.int32(right[x])
    return True


@njit(cache=True)
def _stands_out(peak: Image, i: int, j: int, margin: int, clipped: int) -> bool:
    """Whether a tile is neither on a slope nor on a halo, see `candidates`: along the row first, which settles most."""
    w = peak.shape[1]
    twice = 2 * int(peak[i, j])
    near = twice - int(peak[i, max(j - 1, 0)]) - int(peak[i, min(j + 1, w - 1)])
    if near < 0:
        return False
    if twice < 2 * clipped and near < margin:
        far = twice - int(peak[i, max(j - _FAR, 0)]) - int(peak[i, min(j + _FAR, w - 1)])
        if far < margin:
            return False
    near = over_pairs(peak, i, j, 1)
    if near < 0:
        return False
    if twice >= 2 * clipped or near >= margin:
        return True
    for d in range(2, _FAR):  # the top of a wide light, and not every bump on its flanks
        if over_pairs(peak, i, j, d) < 0:
            return False
    return over_pairs(peak, i, j, _FAR) >= margin


@njit(cache=True)
def over_pairs(peak: Image, i: int, j: int, d: int) -> int:
    """Twice the value of a tile less that of two on opposite sides, `d` tiles away, the least of four ways."""
    h, w = peak.shape
    top, bottom, left, right = max(i - d, 0), min(i + d, h - 1), max(j - d, 0), min(j + d, w - 1)
    most = max(
        max(int(peak[top, j]) + int(peak[bottom, j]), int(peak[i, left]) + int(peak[i, right])),
        max(int(peak[top, left]) + int(peak[bottom, right]), int(peak[top, right]) + int(peak[bottom, left])),
    )
    return 2 * int(peak[i, j]) - most
