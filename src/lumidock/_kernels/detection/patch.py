"""One light close up: cut out of the picture once, flattened, and smoothed.

Behind `cut` nobody asks of what type the picture is: the close-up has its planes (colours, or corners of a mosaic's
cell) as floats in 8-bit grey levels, and their mean, weighted by how far the light stands out in each. Large windows
are thinned out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lumidock._kernels.compiling import fast_part, part
from lumidock._kernels.detection.samples import COS, RING, SIN, Picture, insert, mean
from lumidock.datatypes import Array, Image, Indices

COARSE_SIDE, SIDE = 32, 48  # samples a side of the window that finds a spot's level, and of the one that measures it
ROOM = SIDE + 16
LINES, LINE = 16, 512  # scratch
_ROOT_TWO = np.sqrt(2.0)
SUMS = 16  # of a region, see `region`
# of a window: the picture's column and row of its first sample, pixels a sample, samples a row, rows; where the light's
# brightest sample is, and the mark of the region grown last
LEFT, TOP, UNIT, COLUMNS, ROWS, START_X, START_Y, MARK = range(8)
WHERE = 8
# of its surroundings: level, noise, texture that hides a spot, texture that moves it, how far noise is shared, the
# noise that shows, and the slope per pixel
LEVEL, NOISE, HIDES, MOVES, SHARED, RIM, SLOPE_U, SLOPE_V = range(8)
GROUND = 8
_QUARTER, _TWO = np.float32(0.25), np.float32(2.0)


class CloseUp(NamedTuple):
    """Room for the close-up of one light, used for one after the other.

    `stack` (4, ROOM, ROOM) its planes, `part` (ROOM, ROOM) their mean by `weight` (4,); `where`, `ground`: see
    above. `stamp` and `taken` (ROOM + 2, ROOM + 2), from row and column 1 on, have the mark of the region that a
    sample was counted to last, by `grow` and by `soften`; `fitted` (2, 4): amplitude and background of each plane;
    `across` (ROOM, ROOM), `runs` (ROOM^2, 5), `rings` (8, RING) and `lines` (LINES, LINE) are scratch.
    """

    stack: NDArray[np.float32]
    part: NDArray[np.float32]
    across: NDArray[np.float32]
    stamp: NDArray[np.int32]
    taken: NDArray[np.int32]
    runs: NDArray[np.int32]
    where: Indices
    ground: Array
    sums: Array
    weight: Array
    fitted: Array
    rings: NDArray[np.float32]
    lines: NDArray[np.float32]


def close_up() -> CloseUp:
    """Make room for one."""
    return CloseUp(
        stack=np.zeros((4, ROOM, ROOM), np.float32),
        part=np.zeros((ROOM, ROOM), np.float32),
        across=np.zeros((ROOM, ROOM), np.float32),
        stamp=np.zeros((ROOM + 2, ROOM + 2), np.int32),
        taken=np.zeros((ROOM + 2, ROOM + 2), np.int32),
        runs=np.zeros((ROOM * ROOM, 5), np.int32),
        where=np.zeros(WHERE, np.int64),
        ground=np.zeros(GROUND),
        sums=np.zeros(SUMS),
        weight=np.zeros(4),
        fitted=np.zeros((2, 4)),
        rings=np.zeros((8, RING), np.float32),
        lines=np.zeros((LINES, LINE), np.float32),
    )


@part
def cut(picture: Picture, v: int, u: int, reach: float, side: int, close: CloseUp) -> None:
    """Fill the close-up with the window of `reach` px around a pixel, thinned out to about `side` samples a side."""
    where = close.where
    pitch = 2 if picture.planes == 4 else 1
    unit = pitch * max(int(np.ceil(2.0 * reach / (pitch * side))), 1)
    left, top = max(u - int(reach), 0) // pitch * pitch, max(v - int(reach), 0) // pitch * pitch
    columns = min((min(u + int(reach) + 1, picture.width) - left) // unit, ROOM)
    rows = min((min(v + int(reach) + 1, picture.height) - top) // unit, ROOM)
    where[LEFT], where[TOP], where[UNIT], where[COLUMNS], where[ROWS] = left, top, unit, max(columns, 1), max(rows, 1)
    where[START_X] = min((u - left) // unit, where[COLUMNS] - 1)
    where[START_Y] = min((v - top) // unit, where[ROWS] - 1)
    if picture.deep == 1:
        _read(picture.rows, picture, where, close.stack)
    else:
        _read(picture.rows.view(np.uint16), picture, where, close.stack)
    _mix(picture.planes, close)


@part
def _read(rows: Image, picture: Picture, where: Indices, stack: NDArray[np.float32]) -> None:
    left, top, unit, n = where[LEFT], where[TOP], where[UNIT], where[COLUMNS]
    scale, mosaic = np.float32(picture.scale), picture.planes == 4
    for p in range(picture.planes):
        step, first = unit, min(left + (p & 1 if mosaic else 0), picture.width - 1)
        if picture.planes == 3:
            step, first = 3 * unit, 3 * left + p
        for i in range(where[ROWS]):
            line = rows[min(top + i * unit + (p >> 1 if mosaic else 0), picture.height - 1), first:]
            out = stack[p, i]
            if step == 1:  # a loop for each step that is frequent, which takes many at once
                for j in range(n):
                    out[j] = scale * np.float32(line[j])
            elif step == 2:
                for j in range(n):
                    out[j] = scale * np.float32(line[2 * j])
            elif step == 3:
                for j in range(n):
                    out[j] = scale * np.float32(line[3 * j])
            else:
                for j in range(n):
                    out[j] = scale * np.float32(line[step * j])


@part
def _mix(planes: int, close: CloseUp) -> None:
    """Write the weighted mean of the planes to the part."""
    stack, n, weight = close.stack, wide(close.where[COLUMNS]), close.weight
    w0, w1, w2, w3 = np.float32(weight[0]), np.float32(weight[1]), np.float32(weight[2]), np.float32(weight[3])
    for i in range(close.where[ROWS]):
        out, a, b, c, d = close.part[i], stack[0, i], stack[1, i], stack[2, i], stack[3, i]
        if planes == 1:
            for j in range(n):
                out[j] = a[j]
        elif planes == 3:
            for j in range(n):
                out[j] = w0 * a[j] + w1 * b[j] + w2 * c[j]
        else:
            for j in range(n):
                out[j] = w0 * a[j] + w1 * b[j] + w2 * c[j] + w3 * d[j]


@part
def flatten(close: CloseUp, reach: float) -> tuple[float, float, float]:
    """Level, spread and unevenness (1 sigma) of the ring of `reach` px around the start, without its slope.

    The slope, which is taken out of the part, is what a neighbour's halo adds: by least squares, from opposite samples
    within Tukey's fences. The level is the mean of the middle half, the spread from the quartiles. The unevenness is
    the spread of what opposite samples differ by: what bends alike on either side displaces nothing.
    """
    part, where, values, ordered = close.part, close.where, close.rings[0], close.rings[1]
    x, y, columns, rows, radius = where[START_X], where[START_Y], where[COLUMNS], where[ROWS], reach / where[UNIT]
    close.ground[SLOPE_U], close.ground[SLOPE_V] = 0.0, 0.0
    count = 0
    for k in range(RING):
        a, b = int(np.floor(x + radius * COS[k] + 0.5)), int(np.floor(y + radius * SIN[k] + 0.5))
        values[k] = np.nan
        if 0 <= a < columns and 0 <= b < rows:
            values[k] = part[b, a]
            count = insert(ordered, count, values[k])
    if count == 0:
        return 0.0, 0.0, 0.0
    quarter = count // 4
    low, high = ordered[quarter], ordered[count - 1 - quarter]
    fence = 1.5 * (high - low)
    gx, gy, opposite = 0.0, 0.0, 0
    for k in range(RING // 2):
        a, b = values[k], values[k + RING // 2]
        if low - fence <= a <= high + fence and low - fence <= b <= high + fence:
            gx += (a - b) * COS[k]
            gy += (a - b) * SIN[k]
            opposite += 1
    if opposite < RING // 3:
        spread = (high - low) / 1.35
        return mean(ordered, quarter, count - quarter), spread, spread
    gx, gy = gx / opposite, gy / opposite
    count, pairs, uneven = 0, 0, close.rings[2]
    for k in range(RING):
        if not np.isnan(values[k]):
            count = insert(ordered, count, values[k] - gx * COS[k] - gy * SIN[k])
    for k in range(RING // 2):
        odd = abs(0.5 * (values[k] - values[k + RING // 2]) - gx * COS[k] - gy * SIN[k])
        if not np.isnan(odd):
            pairs = insert(uneven, pairs, odd)
    level, spread = mean(ordered, quarter, count - quarter), (ordered[count - 1 - quarter] - ordered[quarter]) / 1.35
    gx, gy = gx / radius, gy / radius
    if max(abs(gx), abs(gy)) * radius > 0.3 * spread:
        close.ground[SLOPE_U], close.ground[SLOPE_V] = gx / where[UNIT], gy / where[UNIT]
        slope = np.float32(gx)
        for i in range(rows):
            line, first = part[i], np.float32(gy * (i - y) - gx * x)
            for j in range(wide(columns)):
                line[j] -= first + slope * np.float32(j)
    return level, spread, _ROOT_TWO * uneven[pairs // 2] / 0.674


@part
def smooth(close: CloseUp) -> None:
    """Average with the neighbours by 1 2 1 in either direction: a clipped core is torn by noise, and by interlacing."""
    part, across, last, rows = close.part, close.across, close.where[COLUMNS] - 1, close.where[ROWS]
    n = min(wide(last + 1), ROOM - 1)
    for i in range(rows):
        line, out = part[i], across[i]
        for j in range(1, n):
            out[j] = _QUARTER * (line[j - 1] + _TWO * line[j] + line[j + 1])
        out[0] = _QUARTER * (line[0] + _TWO * line[0] + line[min(1, last)])
        out[last] = _QUARTER * (line[max(last - 1, 0)] + _TWO * line[last] + line[last])
    for i in range(rows):
        out, above, here, below = part[i], across[max(i - 1, 0)], across[i], across[min(i + 1, rows - 1)]
        for j in range(n + 1):
            out[j] = _QUARTER * (above[j] + _TWO * here[j] + below[j])


@part
def wide(columns: int) -> int:
    """So many samples, and some more of no meaning that fill what is taken at once."""
    return (columns + 15) & -16


@part
def rim_noise(close: CloseUp) -> float:
    """1 sigma of a sample, from second differences along the outer rows of a window; large ones, of edges, left out."""
    columns, rows = close.where[COLUMNS], close.where[ROWS]
    if columns < 5 or rows < 3:
        return 0.0
    limit, sigma = np.inf, 0.0
    for _ in range(2):
        total, count = 0.0, 0.0
        for i in (0, 1, rows - 2, rows - 1):
            more, used = _differences(close.part[i, :columns], limit)
            total, count = total + more, count + used
        sigma = 0.5117 * total / max(count, 1.0)
        limit = 8.0 * sigma
    return sigma


@fast_part
def _differences(line: Array, limit: float) -> tuple[float, float]:
    """Sum and number of the absolute second differences of every other sample that are not over a limit."""
    total, count, most = np.float32(0.0), np.float32(0.0), np.float32(limit)
    for j in range(len(line) - 4):
        d = abs(line[j] - _TWO * line[j + 2] + line[j + 4])
        used = np.float32(d <= most)
        total += used * d
        count += used
    return float(total), float(count)


@part
def bell(first: float, step: float, width: float, n: int, out: Array) -> None:
    """Write a Gaussian of `width` at `n` places `step` apart, the first one `first` from its middle."""
    value = np.exp(-0.5 * (first / width) ** 2)
    ratio, ratio_of_ratios = np.exp(-step * (first + 0.5 * step) / width**2), np.exp(-((step / width) ** 2))
    for k in range(n):
        out[k] = value
        value *= ratio
        ratio *= ratio_of_ratios


@part
def filtered(close: CloseUp, x: float, y: float, width: float, level: float) -> tuple[float, float]:
    """Amplitude of a Gaussian of `width` samples at a place, and how many samples' worth of averaging is in it."""
    reach, part, ex, ey = int(np.ceil(2.5 * width)), close.part, close.lines[0], close.lines[1]
    left, right = max(int(x) - reach, 0), min(int(x) + reach + 2, close.where[COLUMNS])
    top, bottom = max(int(y) - reach, 0), min(int(y) + reach + 2, close.where[ROWS])
    bell(left - x, 1.0, width, right - left, ex)
    bell(top - y, 1.0, width, bottom - top, ey)
    total, across, down = 0.0, 0.0, 1e-12
    for j in range(right - left):
        across += ex[j] * ex[j]
    for i in range(bottom - top):
        line, along = part[top + i], 0.0
        for j in range(right - left):
            along += ex[j] * (line[left + j] - level)
        total += ey[i] * along
        down += ey[i] * ey[i]
    power = across * down
    return total / power, power
