"""The samples of one light: grown at a level in its close-up, given a soft edge, and summed up."""

from __future__ import annotations

import numpy as np

from lumidock._kernels.compiling import fast_part, part
from lumidock._kernels.detection import patch
from lumidock._kernels.detection.patch import CloseUp
from lumidock._kernels.detection.samples import Picture
from lumidock.datatypes import Array, Image

_LEAST_ROWS = 4.0  # of a field
# entries of `sums`, see `grow`; weights w are over the level
N, X, Y, XX, XY, YY, W, WX, WY, CLIPPED, EDGE, OPEN, FIRST_COLUMN, LAST_COLUMN, FIRST_ROW, LAST_ROW = range(16)
_MARKS = (1 << 31) - 1
_NOTHING, _NO_MARK = np.float32(0.0), np.int32(0)


@part
def grow(picture: Picture, close: CloseUp, level: float, clipped: float) -> None:
    """Sum up the connected samples over `level` around the start, coordinates relative to it, into the sums.

    `CLIPPED` counts saturated samples, `EDGE` those at the picture's edge, `OPEN` those at the window's. The first and
    last column and row are the window's.
    """
    part, stamp, stack, sums, where = close.part, close.stamp, close.runs, close.sums, close.where
    columns, rows, x, y = where[patch.COLUMNS], where[patch.ROWS], where[patch.START_X], where[patch.START_Y]
    at_left, at_top = where[patch.LEFT] <= 1, where[patch.TOP] <= 1
    at_right = where[patch.LEFT] + where[patch.UNIT] * columns >= picture.width - 1
    at_bottom = where[patch.TOP] + where[patch.UNIT] * rows >= picture.height - 1
    where[patch.MARK] = where[patch.MARK] % _MARKS + 1
    mark = np.int32(where[patch.MARK])
    limit, burnt = np.float32(level), np.float32(clipped)
    sums[:] = 0.0
    left, right, upper, lower = x, x, y, y
    _push(stack, 0, x, y, -1, 0, 0)
    top = 1
    while top:  # a run of one row at a time
        top -= 1
        first, i = int(stack[top, 0]), int(stack[top, 1])
        line, mine = part[i], stamp[i + 1]
        if mine[first + 1] == mark:
            continue
        last = first + 1
        while first > 0 and line[first - 1] > limit:
            first -= 1
        while last < columns and line[last] > limit:
            last += 1
        left, right, upper, lower = min(left, first), max(right, last - 1), min(upper, i), max(lower, i)
        _add_run(line[first:last], mine[first + 1 : last + 1], mark, first - x, i - y, level, burnt, sums)
        if i == 0 or i == rows - 1:
            sums[EDGE if (at_top if i == 0 else at_bottom) else OPEN] += last - first
        else:
            if first == 0:
                sums[EDGE if at_left else OPEN] += 1.0
            if last == columns:
                sums[EDGE if at_right else OPEN] += 1.0
        behind, begun, ended = int(stack[top, 2]), int(stack[top, 3]), int(stack[top, 4])
        for d in (i - 1, i + 1):
            if not 0 <= d < rows:
                continue
            c = first
            while c < last:
                if d == behind and begun <= c < ended:  # the run that this one was found from
                    c = ended
                elif part[d, c] > limit and stamp[d + 1, c + 1] != mark:
                    _push(stack, top, c, d, i, first, last)
                    top += 1
                    while c < last and part[d, c] > limit:
                        c += 1
                else:
                    c += 1
    sums[FIRST_COLUMN], sums[LAST_COLUMN], sums[FIRST_ROW], sums[LAST_ROW] = left, right, upper, lower


@part
def _push(stack: Image, top: int, column: int, row: int, behind: int, begun: int, ended: int) -> None:
    """Remember where a run goes through, and the run that it was found from."""
    stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3], stack[top, 4] = column, row, behind, begun, ended


@part
def unmark(close: CloseUp, p: int, least: float) -> None:
    """Take what plane `p` shows darker than `least` out of the region grown last."""
    mark, stamp, sums = np.int32(close.where[patch.MARK]), close.stamp, close.sums
    for i in range(int(sums[FIRST_ROW]), int(sums[LAST_ROW]) + 1):
        for j in range(int(sums[FIRST_COLUMN]), int(sums[LAST_COLUMN]) + 1):
            if stamp[i + 1, j + 1] == mark and close.stack[p, i, j] < least:
                stamp[i + 1, j + 1] = 0


@part
def take_all(close: CloseUp) -> None:
    """Of a region that is a whole window, its columns and rows."""
    sums = close.sums
    sums[FIRST_COLUMN], sums[LAST_COLUMN] = 0.0, close.where[patch.COLUMNS] - 1
    sums[FIRST_ROW], sums[LAST_ROW] = 0.0, close.where[patch.ROWS] - 1


@fast_part
def _add_run(
    values: Array, marks: Image, mark: np.int32, a: int, b: int, level: float, clipped: np.float32, sums: Array
) -> None:
    """Add samples of one row, the first at `a`, `b`, to the sums of a region, and mark them."""
    n, w, wx, burnt = float(len(values)), np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for k in range(len(values)):
        w += values[k]
        wx += values[k] * np.float32(k)
        burnt += np.float32(values[k] >= clipped)
        marks[k] = mark
    x = n * (a + 0.5 * (n - 1.0))
    weight = w - n * level
    sums[N] += n
    sums[X] += x
    sums[Y] += n * b
    sums[XX] += a * (x + n * 0.5 * (n - 1.0)) + (n - 1.0) * n * (2.0 * n - 1.0) / 6.0
    sums[XY] += x * b
    sums[YY] += n * b * b
    sums[W] += weight
    sums[WX] += wx + a * w - level * x
    sums[WY] += weight * b
    sums[CLIPPED] += burnt


@part
def soften(close: CloseUp, lower: float) -> tuple[float, float]:
    """Give the region grown last a soft edge: weights over `lower`, and a rim of a sample.

    The edge of an overexposed light is narrower than a sample: cut at one level, its centre would follow the grid.
    Returns how far the centre by even rows lies from that by odd rows, px: the way between the fields of interlaced
    video; nothing where rows are left out, or a field has too few.
    """
    sums, where, mark = close.sums, close.where, np.int32(close.where[patch.MARK])
    left, right = max(int(sums[FIRST_COLUMN]) - 1, 0), min(int(sums[LAST_COLUMN]) + 2, where[patch.COLUMNS])
    upper, down = max(int(sums[FIRST_ROW]) - 1, 0), min(int(sums[LAST_ROW]) + 2, where[patch.ROWS])
    sums[: WY + 1] = 0.0
    w0, x0, y0, rows0, w1, x1, y1, rows1 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(upper, down):
        n, x, xx, w, wx = _soft_row(
            close.part[i, left:right],
            close.stamp[i, left : right + 2],
            close.stamp[i + 1, left : right + 2],
            close.stamp[i + 2, left : right + 2],
            mark,
            np.float32(lower),
            close.taken[i + 1, left + 1 : right + 1],
        )
        a, b = float(left - where[patch.START_X]), float(i - where[patch.START_Y])
        xx, x, wx = xx + a * (2.0 * x + a * n), x + a * n, wx + a * w
        sums[N] += n
        sums[X] += x
        sums[Y] += n * b
        sums[XX] += xx
        sums[XY] += x * b
        sums[YY] += n * b * b
        sums[W] += w
        sums[WX] += wx
        sums[WY] += w * b
        if i & 1:
            w1, x1, y1, rows1 = w1 + w, x1 + wx, y1 + w * b, rows1 + (w > 0.0)
        else:
            w0, x0, y0, rows0 = w0 + w, x0 + wx, y0 + w * b, rows0 + (w > 0.0)
    sums[FIRST_COLUMN], sums[LAST_COLUMN], sums[FIRST_ROW], sums[LAST_ROW] = left, right - 1, upper, down - 1
    if where[patch.UNIT] > 1 or min(rows0, rows1) < _LEAST_ROWS:
        return 0.0, 0.0
    return x0 / w0 - x1 / w1, y0 / w0 - y1 / w1


@part
def _soft_row(
    values: Array, above: Image, here: Image, below: Image, mark: np.int32, lower: np.float32, taken: Image
) -> tuple[float, float, float, float, float]:
    """Number, sum of places and of their squares, weight and its first moment of a row's samples that count.

    Those with the mark do, and those over `lower` beside one; the three rows of marks begin one before. `taken` gets
    it.
    """
    n, x, xx, w, wx = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(len(values)):
        over = values[k] - lower
        counts = here[k + 1] == mark
        if not counts and over > _NOTHING:
            counts = here[k] == mark or here[k + 2] == mark or above[k + 1] == mark or below[k + 1] == mark
            counts = counts or above[k] == mark or above[k + 2] == mark or below[k] == mark or below[k + 2] == mark
        taken[k] = mark if counts else _NO_MARK
        if counts:
            n += 1.0
            x += k
            xx += k * k
            w += over
            wx += over * k
    return n, x, xx, w, wx


@part
def shape(sums: Array) -> tuple[float, float]:
    """Ratio of the axes of the ellipse with the region's second moments, and the region's area over the ellipse's."""
    n = sums[N]
    uu, uv, vv = moments(sums)
    half, turn = 0.5 * (uu + vv), np.hypot(0.5 * (uu - vv), uv)
    area = 4.0 * np.pi * np.sqrt(max(uu * vv - uv * uv, 1e-12))
    return np.sqrt(max(half - turn, 1e-12) / (half + turn)), n / area


@part
def moments(sums: Array) -> tuple[float, float, float]:
    """Second central moments of the region, of samples that are unit squares."""
    n = sums[N]
    uu = (sums[XX] - sums[X] ** 2 / n) / n + 1.0 / 12.0
    vv = (sums[YY] - sums[Y] ** 2 / n) / n + 1.0 / 12.0
    return uu, (sums[XY] - sums[X] * sums[Y] / n) / n, vv


@part
def balance(sums: Array, variance: float) -> tuple[float, float, float, float, float]:
    """A region's weighted centre x, y, relative to its start, and its covariance xx, xy, yy by noise of `variance`."""
    x, y = sums[WX] / sums[W], sums[WY] / sums[W]
    by_weight = variance / sums[W] ** 2
    xx = sums[XX] - 2.0 * x * sums[X] + sums[N] * x * x
    xy = sums[XY] - x * sums[Y] - y * sums[X] + sums[N] * x * y
    yy = sums[YY] - 2.0 * y * sums[Y] + sums[N] * y * y
    return x, y, by_weight * xx, by_weight * xy, by_weight * yy
