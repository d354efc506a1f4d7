"""One light in a small window: cut out, flattened, and grown at a level.

A window is one plane of floats in 8-bit grey levels: the planes (colours) weighted by how far the light stands out in
each. Large windows are thinned out.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lumidock._kernels.samples import COS, RING, SIN, insert
from lumidock.datatypes import Array, Image, Indices

COARSE_SIDE, SIDE = 32, 48  # samples a side of the window that finds a spot's level, and of the one that measures it
ROOM = SIDE + 16
_ROOT_TWO = np.sqrt(2.0)
_LEAST_ROWS = 4.0  # of a field
# entries of `sums`, see `grow`; weights w are over the level
N, X, Y, XX, XY, YY, W, WX, WY, CLIPPED, EDGE, OPEN, FIRST_COLUMN, LAST_COLUMN, FIRST_ROW, LAST_ROW = range(16)
SUMS = 16
# the window's geometry, see `cut`
LEFT, TOP, UNIT, COLUMNS, ROWS, SLOPE_U, SLOPE_V = range(7)
Window = tuple[Array, NDArray[np.int16], NDArray[np.int32], Array]


@njit(error_model="numpy")
def cut(
    image: Image,
    planes: int,
    scale: float,
    weight: Array,
    v: int,
    u: int,
    reach: float,
    side: int,
    patch: Array,
    where: Array,
) -> None:
    """Fill `patch` with the window of `reach` px around a pixel, thinned out to about `side` samples a side.

    `where` becomes its left, top, unit, columns, rows.
    """
    pitch = 2 if planes == 4 else 1
    unit = pitch * max(int(np.ceil(2.0 * reach / (pitch * side))), 1)
    left, top = max(u - int(reach), 0) // pitch * pitch, max(v - int(reach), 0) // pitch * pitch
    columns = min((min(u + int(reach) + 1, image.shape[1]) - left) // unit, ROOM)
    rows = min((min(v + int(reach) + 1, image.shape[0]) - top) // unit, ROOM)
    where[0], where[1], where[2], where[3], where[4] = left, top, unit, max(columns, 1), max(rows, 1)
    n, m = int(where[COLUMNS]), int(where[ROWS])
    samples, first = image.reshape(len(image), -1), left * image.shape[2]  # rows of which a loop can take many at once
    w0, w1, w2, w3 = scale * weight[0], scale * weight[1], scale * weight[2], scale * weight[3]
    last = image.shape[1] - 1 - left
    for i in range(m):
        y, out = top + i * unit, patch[i]
        line = samples[y, first:]
        if planes == 1:
            if unit == 1:
                for j in range(n):
                    out[j] = scale * line[j]
            else:
                for j in range(n):
                    out[j] = scale * line[j * unit]
        elif planes == 3:
            if unit == 1:
                for j in range(n):
                    out[j] = w0 * line[3 * j] + w1 * line[3 * j + 1] + w2 * line[3 * j + 2]
            else:
                for j in range(n):
                    x = 3 * j * unit
                    out[j] = w0 * line[x] + w1 * line[x + 1] + w2 * line[x + 2]
        else:
            odd = samples[min(y + 1, len(image) - 1), first:]
            if unit == 2 and 2 * n - 1 <= last:
                for j in range(n):
                    out[j] = w0 * line[2 * j] + w1 * line[2 * j + 1] + w2 * odd[2 * j] + w3 * odd[2 * j + 1]
            else:
                for j in range(n):
                    x, z = j * unit, min(j * unit + 1, last)
                    out[j] = w0 * line[x] + w1 * line[z] + w2 * odd[x] + w3 * odd[z]


@njit(error_model="numpy")
def flatten(patch: Array, where: Array, x: float, y: float, radius: float) -> tuple[float, float, float]:
    """Level, spread and unevenness (1 sigma) of the ring of `radius` around a sample, without its slope.

    The slope, which is taken out of the patch, is what a neighbour's halo adds: by least squares, from opposite samples
    within Tukey's fences. The level is the mean of the middle half, the spread from the quartiles. The unevenness is
    the spread of what opposite samples differ by: what bends alike on either side displaces nothing.
    """
    columns, rows = int(where[COLUMNS]), int(where[ROWS])
    values, ordered = np.empty(RING), np.empty(RING)
    count = 0
    for k in range(RING):
        a, b = int(np.floor(x + radius * COS[k] + 0.5)), int(np.floor(y + radius * SIN[k] + 0.5))
        values[k] = np.nan
        if 0 <= a < columns and 0 <= b < rows:
            values[k] = patch[b, a]
            count = insert(ordered, count, patch[b, a])
    if count == 0:
        return 0.0, 0.0, 0.0
    quarter = count // 4
    low, high = ordered[quarter], ordered[count - 1 - quarter]
    fence = 1.5 * (high - low)
    gx, gy, opposite = 0.0, 0.0, 0
    where[SLOPE_U], where[SLOPE_V] = 0.0, 0.0
    for k in range(RING // 2):
        a, b = values[k], values[k + RING // 2]
        if low - fence <= a <= high + fence and low - fence <= b <= high + fence:
            gx += (a - b) * COS[k]
            gy += (a - b) * SIN[k]
            opposite += 1
    if opposite < RING // 3:
        spread = (high - low) / 1.35
        return ordered[quarter : count - quarter].mean(), spread, spread
    gx, gy = gx / opposite, gy / opposite
    count = 0
    for k in range(RING):
        if not np.isnan(values[k]):
            count = insert(ordered, count, values[k] - gx * COS[k] - gy * SIN[k])
    level, spread = ordered[quarter : count - quarter].mean(), (ordered[count - 1 - quarter] - ordered[quarter]) / 1.35
    uneven, pairs = np.empty(RING // 2), 0
    for k in range(RING // 2):
        odd = abs(0.5 * (values[k] - values[k + RING // 2]) - gx * COS[k] - gy * SIN[k])
        if not np.isnan(odd):
            pairs = insert(uneven, pairs, odd)
    gx, gy = gx / radius, gy / radius
    if max(abs(gx), abs(gy)) * radius > 0.3 * spread:
        where[SLOPE_U], where[SLOPE_V] = gx / where[UNIT], gy / where[UNIT]
        for i in range(rows):
            for j in range(columns):
                patch[i, j] -= gx * (j - x) + gy * (i - y)
    return level, spread, _ROOT_TWO * uneven[pairs // 2] / 0.674


@njit(error_model="numpy")
def smooth(patch: Array, where: Array) -> None:
    """Average with the neighbours by 1 2 1 in either direction: a clipped core is torn by noise, and by interlacing."""
    columns, rows = int(where[COLUMNS]), int(where[ROWS])
    before = np.empty(columns + 2)
    for i in range(rows):
        line = patch[i, :columns]
        before[0], before[1 : columns + 1], before[columns + 1] = line[0], line, line[columns - 1]
        for j in range(columns):
            line[j] = 0.25 * (before[j] + 2.0 * before[j + 1] + before[j + 2])
    above = patch[0, :columns].copy()
    for i in range(rows):
        line, below = patch[i, :columns], patch[min(i + 1, rows - 1), :columns]
        for j in range(columns):
            here = line[j]
            line[j] = 0.25 * (above[j] + 2.0 * here + below[j])
            above[j] = here


@njit(error_model="numpy")
def rim_noise(patch: Array, where: Array) -> float:
    """1 sigma of a sample, from second differences along the outer rows of a window; large ones, of edges, left out."""
    columns, rows = int(where[COLUMNS]), int(where[ROWS])
    if columns < 5 or rows < 3:
        return 0.0
    limit, sigma = 1e9, 0.0
    for _ in range(2):
        total, count = 0.0, 0
        for i in (0, 1, rows - 2, rows - 1):
            for j in range(columns - 4):
                d = abs(patch[i, j] - 2.0 * patch[i, j + 2] + patch[i, j + 4])
                if d <= limit:
                    total += d
                    count += 1
        sigma = 0.5117 * total / max(count, 1)
        limit = 8.0 * sigma
    return sigma


@njit(error_model="numpy")
def filtered(patch: Array, where: Array, x: float, y: float, width: float, level: float) -> tuple[float, float]:
    """Amplitude of a Gaussian of `width` samples at a place, and how many samples' worth of averaging is in it."""
    reach = int(np.ceil(2.5 * width))
    total, power = 0.0, 1e-12
    first, last = max(int(x) - reach, 0), min(int(x) + reach + 2, int(where[COLUMNS]))
    across = np.empty(2 * reach + 2)
    for j in range(first, last):
        across[j - first] = np.exp(-0.5 * (j - x) ** 2 / (width * width))
    for i in range(max(int(y) - reach, 0), min(int(y) + reach + 2, int(where[ROWS]))):
        b = np.exp(-0.5 * (i - y) ** 2 / (width * width))
        for j in range(first, last):
            window = b * across[j - first]
            total += window * (patch[i, j] - level)
            power += window * window
    return total / power, power


@njit(error_model="numpy")
def grow(window: Window, where: Array, image: Image, x: int, y: int, level: float, clipped: float, mark: int) -> None:
    """Sum up the connected samples over `level` around one, coordinates relative to it, into the window's sums.

    `CLIPPED` counts saturated samples, `EDGE` those at the picture's edge, `OPEN` those at the window's. The first and
    last column and row are the window's.
    """
    patch, stamp, stack, sums = window
    columns, rows = int(where[COLUMNS]), int(where[ROWS])
    at_left, at_top = where[LEFT] <= 1.0, where[TOP] <= 1.0
    at_right = where[LEFT] + where[UNIT] * columns >= image.shape[1] - 1
    at_bottom = where[TOP] + where[UNIT] * rows >= image.shape[0] - 1
    sums[:] = 0.0
    left, right, upper, lower = x, x, y, y
    stack[0, 0], stack[0, 1] = x, y
    stamp[y, x] = 0
    top = 1
    while top:  # a run of one row at a time
        top -= 1
        first, i = stack[top, 0], stack[top, 1]
        line, mine = patch[i], stamp[i]
        if mine[first] == mark:
            continue
        last = first + 1
        while first > 0 and line[first - 1] > level:
            first -= 1
        while last < columns and line[last] > level:
            last += 1
        left, right, upper, lower = min(left, first), max(right, last - 1), min(upper, i), max(lower, i)
        _add_run(line[first:last], float(first - x), float(i - y), level, clipped, sums)
        mine[first:last] = mark
        if i == 0 or i == rows - 1:
            sums[EDGE if (at_top if i == 0 else at_bottom) else OPEN] += last - first
        else:
            for end, at_end in ((first == 0, at_left), (last == columns, at_right)):
                if end:
                    sums[EDGE if at_end else OPEN] += 1.0
        for d in (i - 1, i + 1):
            new = _unmarked(patch[d, first:last], stamp[d, first:last], level, mark) if 0 <= d < rows else 0
            for c in range(first, last if new else first):
                if patch[d, c] > level and stamp[d, c] != mark:
                    if c == first or not (patch[d, c - 1] > level and stamp[d, c - 1] != mark):
                        stack[top, 0], stack[top, 1] = c, d
                        top += 1
                    if new == last - first:  # all of it is one run
                        break
    sums[FIRST_COLUMN], sums[LAST_COLUMN], sums[FIRST_ROW], sums[LAST_ROW] = left, right, upper, lower


@njit(error_model="numpy")
def take_all(sums: Array, where: Array) -> None:
    """Of a region that is a whole window, its columns and rows."""
    sums[FIRST_COLUMN], sums[LAST_COLUMN], sums[FIRST_ROW], sums[LAST_ROW] = 0, where[COLUMNS] - 1, 0, where[ROWS] - 1


@njit(error_model="numpy")
def _unmarked(values: Array, stamp: Image, level: float, mark: int) -> int:
    """How many of some samples are over the level and not marked yet."""
    count = 0
    for k in range(len(values)):
        count += (values[k] > level) & (stamp[k] != mark)
    return count


@njit(error_model="numpy", fastmath={"reassoc", "contract"})
def _add_run(values: Array, a: float, b: float, level: float, clipped: float, sums: Array) -> None:
    """Add samples of one row, the first at `a`, `b`, to the sums of a region."""
    n, x, xx, w, wx, burnt = float(len(values)), 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(len(values)):
        weight = values[k] - level
        x += a
        xx += a * a
        w += weight
        wx += weight * a
        burnt += values[k] >= clipped
        a += 1.0
    sums[N] += n
    sums[X] += x
    sums[Y] += n * b
    sums[XX] += xx
    sums[XY] += x * b
    sums[YY] += n * b * b
    sums[W] += w
    sums[WX] += wx
    sums[WY] += w * b
    sums[CLIPPED] += burnt


@njit(error_model="numpy")
def soften(window: Window, where: Array, start: Indices, level: float, lower: float) -> None:
    """Give the region grown last, at `level` around `start`, a soft edge: weights over `lower`, and a rim of a sample.

    The edge of an overexposed light is narrower than a sample: cut at one level, its centre would follow the grid.
    """
    patch, stamp, rim, sums = window
    columns, rows, mark = int(where[COLUMNS]), int(where[ROWS]), stamp[start[1], start[0]]
    for k, of in ((W, N), (WX, X), (WY, Y)):
        sums[k] += (level - lower) * sums[of]
    left, right = max(int(sums[FIRST_COLUMN]) - 1, 0), min(int(sums[LAST_COLUMN]) + 1, columns - 1)
    upper, down = max(int(sums[FIRST_ROW]) - 1, 0), min(int(sums[LAST_ROW]) + 1, rows - 1)
    count = 0
    for i in range(upper, down + 1):
        line, mine = patch[i], stamp[i]
        for j in range(left, right + 1):
            if line[j] <= lower or mine[j] == mark:
                continue
            if _is_beside(stamp, i, j, rows, columns, mark):
                rim[count, 0], rim[count, 1] = j, i
                count += 1
    sums[FIRST_COLUMN], sums[LAST_COLUMN], sums[FIRST_ROW], sums[LAST_ROW] = left, right, upper, down
    for k in range(count):
        j, i = rim[k]
        _add_run(patch[i, j : j + 1], float(j - start[0]), float(i - start[1]), lower, np.inf, sums)
        stamp[i, j] = mark


@njit(error_model="numpy")
def _is_beside(stamp: Image, i: int, j: int, rows: int, columns: int, mark: int) -> bool:
    """Whether one of the eight samples around one has the mark."""
    for d in range(max(i - 1, 0), min(i + 2, rows)):
        for c in range(max(j - 1, 0), min(j + 2, columns)):
            if stamp[d, c] == mark:
                return True
    return False


@njit(error_model="numpy")
def fields_apart(window: Window, where: Array, start: Indices, level: float) -> tuple[float, float]:
    """How far the centre by even rows lies from that by odd rows, px: the way between the fields of interlaced video.

    Of the region grown last, around `start`; nothing where rows are left out, or a field has too few.
    """
    patch, stamp, mark, sums = window[0], window[1], window[1][start[1], start[0]], window[3]
    if where[UNIT] > 1.0:
        return 0.0, 0.0
    total, rows = np.zeros((2, 3)), np.zeros(2)
    for i in range(int(sums[FIRST_ROW]), int(sums[LAST_ROW]) + 1):
        k, before = i & 1, total[i & 1, 0]
        for j in range(int(sums[FIRST_COLUMN]), int(sums[LAST_COLUMN]) + 1):
            if stamp[i, j] == mark:
                w = patch[i, j] - level
                total[k, 0] += w
                total[k, 1] += w * (j - start[0])
                total[k, 2] += w * (i - start[1])
        rows[k] += total[k, 0] > before
    if min(rows[0], rows[1]) < _LEAST_ROWS:
        return 0.0, 0.0
    return total[0, 1] / total[0, 0] - total[1, 1] / total[1, 0], total[0, 2] / total[0, 0] - total[1, 2] / total[1, 0]


@njit(error_model="numpy")
def shape(sums: Array) -> tuple[float, float]:
    """Ratio of the axes of the ellipse with the region's second moments, and the region's area over the ellipse's."""
    n = sums[N]
    uu, uv, vv = moments(sums)
    half, turn = 0.5 * (uu + vv), np.hypot(0.5 * (uu - vv), uv)
    area = 4.0 * np.pi * np.sqrt(max(uu * vv - uv * uv, 1e-12))
    return np.sqrt(max(half - turn, 1e-12) / (half + turn)), n / area


@njit(error_model="numpy")
def moments(sums: Array) -> tuple[float, float, float]:
    """Second central moments of the region, of samples that are unit squares."""
    n = sums[N]
    uu = (sums[XX] - sums[X] ** 2 / n) / n + 1.0 / 12.0
    vv = (sums[YY] - sums[Y] ** 2 / n) / n + 1.0 / 12.0
    return uu, (sums[XY] - sums[X] * sums[Y] / n) / n, vv


@njit(error_model="numpy")
def balance(sums: Array, variance: float, center: Array, cov: Array) -> None:
    """Write a region's weighted centre (2,), relative to its start, and its covariance (3,) by noise of `variance`."""
    x, y = sums[WX] / sums[W], sums[WY] / sums[W]
    center[0], center[1] = x, y
    cov[0] = sums[XX] - 2.0 * x * sums[X] + sums[N] * x * x
    cov[1] = sums[XY] - x * sums[Y] - y * sums[X] + sums[N] * x * y
    cov[2] = sums[YY] - 2.0 * y * sums[Y] + sums[N] * y * y
    cov *= variance / sums[W] ** 2
